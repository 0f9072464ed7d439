# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of ``calibration_page``: first paint, and how soon an update is seen, with 20 clients, some slow.

    python bench/live_page.py [--updates 200] [--clients 20] [--idle 5] [--visits 60]

``page_node`` runs in a process of its own. This process is the rest of the graph: it publishes the status of a
campaign, estimates, residuals and measurements of ``--visits`` configurations of a KUKA KR-270, and joint states
at 100 Hz of a robot that moves. One client is a headless Chromium, the others are WebSockets, of which ``--idle``
never read.

*First paint* is the browser's own ``first-contentful-paint`` of a page loaded with an empty cache, with all other
clients connected; *live* is when the first state from the node is on the screen, both from the begin of the
navigation. *Update* runs from just before a status is published here to the animation frame in which the
browser has drawn its text; clocks are those of one machine. It holds the middleware, the node, the server, the
network and the page. ``load_average`` says what else the machine did. JSON goes to standard output.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path
from statistics import median
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "test" / folder) for folder in ("report", "ros")]
from browser import NAMES as BROWSERS  # noqa: E402
from browser import Browser, Tab, browser  # noqa: E402
from calib_planner_msgs.msg import CalibrationEstimate, CampaignStatus, Measurement, Residuals  # noqa: E402
from page_cases import COUNT, NAMES, Script  # noqa: E402

from calib_planner.ros.parameters import HISTORY, LATCHED, SENSOR_OUT  # noqa: E402
from calib_planner.ros.processes import Nodes, own_domain  # noqa: E402

LOADS = 7
WATCH = """
window.seen = [];
const node = document.getElementById("reason");
new MutationObserver(() => {
  const text = node.textContent;
  requestAnimationFrame(() => window.seen.push([text, Date.now()]));
}).observe(node, { childList: true, characterData: true, subtree: true });
"""


class Graph(Node):
    """What the page hears, as nodes of a campaign publish it."""

    def __init__(self, context: Context, visits: int) -> None:
        super().__init__("bench", context=context)
        self.script = Script()
        campaign, identifier = NAMES["campaign"], NAMES["identifier"]
        self.status = self.create_publisher(CampaignStatus, f"{campaign}/status", LATCHED)
        self.estimate = self.create_publisher(CalibrationEstimate, f"{identifier}/estimate", LATCHED)
        self.residuals = self.create_publisher(Residuals, f"{identifier}/residuals", LATCHED)
        self.measurements = self.create_publisher(Measurement, f"{identifier}/measurements", HISTORY)
        self._joints = self.create_publisher(JointState, "joint_states", SENSOR_OUT)
        self._visits, self._tick = visits, 0
        self.create_timer(0.01, self._move)

    def _move(self) -> None:
        self._tick += 1
        a, b = self.script.q[0], self.script.q[1]
        share = abs(self._tick % 400 - 200) / 200
        names = list(self.script.robot.joint_names)
        self._joints.publish(JointState(name=names, position=(a + share * (b - a)).tolist()))

    def begin(self) -> None:
        """The campaign as it is after all visits."""
        self.update(0)
        for i in range(self._visits):
            self.measurements.publish(self.script.measurement(i % COUNT, id=i + 1))
        self.estimate.publish(self.script.estimate(12))
        self.residuals.publish(self.script.residuals(self._visits))

    def update(self, number: int) -> float:
        """Publish a status whose text says ``number``; when [s since the epoch]."""
        message = self.script.status(CampaignStatus.MEASURING, 9, reason=f"update {number}")
        now = time.time()
        self.status.publish(message)
        return now


async def clients(
    url: str, count: int, idle: int, ready: threading.Event, end: threading.Event
) -> dict[str, int]:
    """Other clients until ``end``; how much those that read were told."""
    import aiohttp

    told = {"messages": 0, "bytes": 0}
    origin = url.rstrip("/")

    async def read(client: Any) -> None:
        async for message in client:
            told["messages"] += 1
            told["bytes"] += len(message.data)

    async with aiohttp.ClientSession() as session:
        made = [
            await session.ws_connect(f"{origin}/live", headers={"Origin": origin}, max_msg_size=0)
            for _ in range(count)
        ]
        for client in made[:idle]:
            client._response.connection.transport.pause_reading()
        tasks = [asyncio.ensure_future(read(client)) for client in made[idle:]]
        ready.set()
        while not end.is_set():
            await asyncio.sleep(0.05)
        for task in tasks:
            task.cancel()
    return told


def load(chromium: Browser, url: str) -> tuple[Tab, float, float]:
    """A fresh tab; first paint and first state on the screen [ms]."""
    tab = chromium.open(url, 1366, 900)
    script = """
    while (document.getElementById("link").textContent !== "live") await new Promise(requestAnimationFrame);
    await new Promise(requestAnimationFrame);
    const live = performance.now();
    const first = () => performance.getEntriesByType("paint").find((p) => p.name === "first-contentful-paint");
    while (!first()) await new Promise(requestAnimationFrame);
    const paint = first();
    return [paint.startTime, live];
    """
    paint, live = tab.run(script)
    return tab, paint, live


def measure(args: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """The figures."""
    with own_domain() as domain, Nodes(folder, domain) as nodes, browser(folder) as chromium:
        context = Context()
        rclpy.init(args=[], context=context, domain_id=domain)
        graph = Graph(context, args.visits)
        spinner = SingleThreadedExecutor(context=context)
        spinner.add_node(graph)

        def spin() -> None:
            try:
                spinner.spin()
            except ExternalShutdownException:
                return

        threading.Thread(target=spin, daemon=True).start()
        nodes.start("page_node", {"port": 0})
        log = folder / "page_node.log"
        while "the page is at" not in log.read_text():
            nodes.check()
            time.sleep(0.05)
        url = log.read_text().partition("the page is at ")[2].split()[0]
        graph.begin()
        ready, end, told = threading.Event(), threading.Event(), {}
        others = threading.Thread(
            target=lambda: told.update(asyncio.run(clients(url, args.clients - 1, args.idle, ready, end)))
        )
        others.start()
        ready.wait(60)
        loads = []
        for _ in range(LOADS):
            tab, paint, live = load(chromium, url)
            loads.append((paint, live))
            tab.ask("Page.close")
        tab, _, _ = load(chromium, url)
        tab.run(WATCH)
        published: dict[int, float] = {}
        for number in range(1, args.updates + 1):
            published[number] = graph.update(number)
            time.sleep(0.15)
        deadline = time.monotonic() + 30
        while not any(t == f"Update {args.updates}" for t, _ in tab.run("return window.seen;")):
            assert time.monotonic() < deadline, "the last update is not seen"
        seen = {int(text.split()[1]): at / 1e3 for text, at in tab.run("return window.seen;")}
        delays = sorted(1e3 * (seen[n] - published[n]) for n in seen if n in published)
        cpu = Path(f"/proc/{nodes.processes['page_node']}/stat").read_text().split()
        end.set()
        others.join()
        rclpy.shutdown(context=context)
        return {
            "clients": args.clients,
            "idle": args.idle,
            "visits": args.visits,
            "first_paint_ms": {"median": median(p for p, _ in loads), "max": max(p for p, _ in loads)},
            "live_ms": {"median": median(v for _, v in loads), "max": max(v for _, v in loads)},
            "updates": args.updates,
            "seen": len(delays),
            "update_ms": {
                "median": median(delays),
                "99 %": delays[int(0.99 * (len(delays) - 1))],
                "max": delays[-1],
            },
            "told_per_client_kB": told["bytes"] / max(args.clients - 1 - args.idle, 1) / 1e3,
            "node_cpu_seconds": (int(cpu[13]) + int(cpu[14])) / 100,
            "problems": tab.problems,
            "load_average": os.getloadavg()[0],
        }


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--updates", type=int, default=200)
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--idle", type=int, default=5)
    parser.add_argument("--visits", type=int, default=60)
    args = parser.parse_args()
    if not any(map(shutil.which, BROWSERS)):
        print("no Chromium or Chrome on this machine", file=sys.stderr)
        return 1
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(measure(args, Path(folder)), indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
