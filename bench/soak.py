# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Soak of the identifier node: joint states and tracker points at 1 kHz each, for minutes, none may be lost.

    python bench/soak.py [--minutes 10] [--rate 1000] [--stored 200] [--period 3]
        [--parameters lengths+offsets] [--unknown base,tool] [--erring 0.0001] [--targets 1]

``--parameters`` are those of a KR-270 that are identified, ``--unknown`` what else is not known beforehand:
``full`` with ``base,tool`` are 45. ``--targets`` up to three need the tool unknown; each is a stream.
``--erring`` is the standard deviation of errors that the joints have besides [rad]: no geometry explains them,
and a discrepancy is estimated, as on a real robot.

The node runs in a process of its own, with a campaign of ``--stored`` configurations in its store on disk; this
process is robot and tracker: it drives to a configuration, stands still, goes on, every ``--period`` seconds, and
counts what it publishes. The node counts what arrives; both counts are compared at the end, after the queues have
run empty. ``late`` are messages that arrived behind their stamps' turn, ``lost`` what the middleware reports.

A configuration is complete when the last sample of its standstill is there and none that belongs before it can
come any more, the parameter ``window`` (0.1 s) after that sample's stamp. ``estimate_ms`` runs from there
to the arrival of the new estimate here, commit to disk and identification included, and the wait of this process
for its interpreter, which is busy publishing. ``decided_ms`` runs to the arrival of the message that says
accepted, which leaves after the commit. Memory is the node's resident set once a second, growth the largest after
the first minute over the last of that minute. ``cpu`` is the node's share of one core.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from calib_planner_msgs.msg import CalibrationEstimate, Measurement
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rich.console import Console
from rich.table import Table
from sensor_msgs.msg import JointState

from calib_planner import PlanProblem, Robot, __version__, plan
from calib_planner.acquisition import NANO, Standstill
from calib_planner.io import open_store
from calib_planner.planning import Search
from calib_planner.ros.messages import stamp_message
from calib_planner.ros.model import first_model
from calib_planner.ros.parameters import EVENTS, LATCHED
from calib_planner.ros.processes import Nodes, own_domain
from calib_planner.ros.session import Matching, Session
from calib_planner.ros.settings import IdentifierParameters
from calib_planner.simulation import random_deviations

ROBOT, SIGMA, MOVE = "kuka_kr270", 3e-5, 1.0
TARGETS = [[0.05, 0.02, 0.12], [-0.06, 0.03, 0.1], [0.01, -0.08, 0.15]]
NODE = "calibration_identifier"
STREAM = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)


@dataclass
class Heard:
    """What the node says, with the time of arrival [ns]."""

    streams: dict[str, dict[str, str]] = field(default_factory=dict)
    decided: dict[int, int] = field(default_factory=dict)
    rejected: list[str] = field(default_factory=list)
    estimates: dict[int, tuple[int, int]] = field(default_factory=dict)
    latest: int = 0

    def diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            part = status.name.partition(": stream ")[2]
            if part:
                self.streams[part] = {v.key: v.value for v in status.values}

    def measurement(self, message: Measurement) -> None:
        now = time.time_ns()
        if message.status == Measurement.ACCEPTED:
            self.decided[nanoseconds(message.header.stamp) + nanoseconds(message.duration) // 2] = now
        else:
            self.rejected.append(f"{message.status}: {message.reason}")

    def estimate(self, message: CalibrationEstimate) -> None:
        self.latest = message.measurements
        self.estimates.setdefault(nanoseconds(message.header.stamp), (time.time_ns(), message.measurements))

    def counts(self) -> list[int]:
        """Messages per stream, joints first; empty before the node has said so."""
        return [int(self.streams[n]["messages"]) for n in sorted(self.streams)]


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * NANO + int(stamp.nanosec)


def topics_of(targets: int) -> list[str]:
    """Topics of the tracker's points."""
    return ["tracker/point"] if targets == 1 else [f"tracker/point_{k + 1}" for k in range(targets)]


def prepare(chosen: argparse.Namespace, folder: Path, more: int) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """A campaign with ``stored`` measurements on disk; joints and points of ``more`` configurations to go."""
    stored, asked = chosen.stored, {"parameters": chosen.parameters, "unknown": chosen.unknown}
    topics = tuple(topics_of(chosen.targets))
    settings = IdentifierParameters(
        robot=ROBOT, store_folder=str(folder), sigma=SIGMA, tracker_topics=topics, **asked
    )
    model = first_model(settings)
    assert model is not None
    robot = Robot.load(ROBOT).with_parameters(chosen.parameters)
    robot = robot.with_targets(TARGETS[: chosen.targets]) if "tool" in chosen.unknown else robot
    real = robot.with_deviations(random_deviations(robot, 1))
    rng = np.random.default_rng(1)
    low, high = robot.joint_limits.T
    q = rng.uniform(low, high, (stored + more, len(low)))
    points = real.positions(q + chosen.erring * rng.standard_normal(q.shape))
    promised = plan(
        PlanProblem(robot.with_parameters("lengths+offsets"), [q[0]], 5, noise=SIGMA, search=Search(starts=1))
    )
    found = replace(promised, configurations=q, repetitions=np.ones(len(q), dtype=int))
    store = open_store(str(folder), model.stored, asdict(settings), __version__)
    campaign = Session(model.robot, model.follow, store)
    campaign.begin("soak", found, settings.plan_tolerance)
    how, mean = Matching(settings.plan_tolerance, False, SIGMA, 0.0, settings.most_measurements), SIGMA / 20**0.5
    began = time.time_ns() - 10 * stored * NANO
    for i in range(stored):
        point = points[i] + mean * rng.standard_normal(points[i].shape)
        start = began + 3 * i * NANO
        stop = start + NANO // 2
        seen = Standstill(start, stop, q[i], point, np.full(len(point), mean), np.full(len(point), 20))
        assert campaign.take(seen, how, "tracker").status == "accepted"
    store.close()
    return q[stored:], points[stored:], list(robot.joint_names)


class Cell(threading.Thread):
    """Publishes both streams at a rate and hears the node."""

    def __init__(self, domain: int, names: list[str], targets: int) -> None:
        super().__init__(daemon=True)
        self.context, self.heard, self.names = Context(), Heard(), names
        rclpy.init(args=[], context=self.context, domain_id=domain)
        self.node = Node("soak", context=self.context)
        self._joints = self.node.create_publisher(JointState, "joint_states", STREAM)
        self._points = [self.node.create_publisher(PointStamped, t, STREAM) for t in topics_of(targets)]
        hear = self.node.create_subscription
        hear(DiagnosticArray, "/diagnostics", self.heard.diagnostics, EVENTS)
        hear(Measurement, f"{NODE}/measurements", self.heard.measurement, EVENTS)
        hear(CalibrationEstimate, f"{NODE}/estimate", self.heard.estimate, LATCHED)
        self.sent = [0] * (1 + targets)

    def run(self) -> None:
        executor = SingleThreadedExecutor(context=self.context)
        executor.add_node(self.node)
        try:
            executor.spin()
        except ExternalShutdownException:
            return

    def publish(self, stamp: int, q: np.ndarray, points: np.ndarray) -> None:
        """One message of each stream, with ``points`` (targets, 3)."""
        state = JointState(name=self.names, position=q.tolist())
        state.header.stamp = stamp_message(stamp)
        self._joints.publish(state)
        for publisher, (x, y, z) in zip(self._points, points.tolist(), strict=True):
            seen = PointStamped()
            seen.header.stamp, seen.header.frame_id = state.header.stamp, "tracker"
            seen.point.x, seen.point.y, seen.point.z = x, y, z
            publisher.publish(seen)
        self.sent = [count + 1 for count in self.sent]

    def settle(self) -> list[int]:
        """Counts of the node once they no longer change for three of its messages."""
        counts, still = self.heard.counts(), 0
        while still < 3:
            time.sleep(1.1)
            now = self.heard.counts()
            still = still + 1 if now == counts else 0
            counts = now
        return counts

    def close(self) -> None:
        rclpy.shutdown(context=self.context)
        self.join(5.0)


class Process:
    """Memory and processor time of a process, from /proc."""

    def __init__(self, pid: int) -> None:
        self.folder, self.samples = Path(f"/proc/{pid}"), list[tuple[float, float]]()

    def sample(self, seconds: float) -> None:
        """Keep the resident set [MB]."""
        pages = int((self.folder / "statm").read_text().split()[1])
        self.samples.append((seconds, pages * os.sysconf("SC_PAGE_SIZE") / 1e6))

    def processor(self) -> float:
        """Seconds used until now."""
        fields = (self.folder / "stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def growth(self, after: float) -> float | None:
        """Largest resident set after a time over the last one before it, less one."""
        before, later = ([m for t, m in self.samples if (t > after) == side] for side in (False, True))
        return max(later) / before[-1] - 1 if before and later else None


def drive(
    cell: Cell, process: Process, q: np.ndarray, points: np.ndarray, seconds: float, rate: float, period: float
) -> None:
    """Publish for a time: both streams, the same stamps, messages as they become due."""
    rng, began, done, second = np.random.default_rng(2), time.time_ns(), 0, 0
    total = round(seconds * rate)
    noise = SIGMA * rng.standard_normal((4096, *points.shape[1:]))
    while done < total:
        due = min(total, int((time.time_ns() - began) * rate / NANO))
        while done < due:
            t = done / rate
            k, rest = int(t // period), t % period
            share = max(0.0, (rest - (period - MOVE)) / MOVE)
            a, b = k % len(q), (k + 1) % len(q)
            joints = (1 - share) * q[a] + share * q[b]
            point = (1 - share) * points[a] + share * points[b] + noise[done % 4096]
            cell.publish(began + round(t * NANO), joints, point)
            done += 1
        if done / rate >= second:
            process.sample(done / rate)
            second += 1
        time.sleep(0.002)


def soak(chosen: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """The figures."""
    seconds = 60.0 * chosen.minutes
    q, points, names = prepare(chosen, folder / "store", int(seconds / chosen.period) + 2)
    with own_domain() as domain, Nodes(folder / "log", domain) as nodes:
        given = {"robot": ROBOT, "store_folder": f"'{folder / 'store'}'", "sigma": SIGMA}
        given |= {"parameters": chosen.parameters, "unknown": f"'{chosen.unknown}'"}
        nodes.start("identifier_node", given)
        given["tracker_topics"] = f"[{', '.join(topics_of(chosen.targets))}]"
        cell = Cell(domain, names, chosen.targets)
        cell.start()
        try:
            while (
                len(cell.heard.counts()) < len(cell.sent) or min(cell.heard.counts()) < 3
            ):  # until matched both ways
                nodes.check()
                cell.publish(time.time_ns(), q[0] + 0.05, points[0])
                time.sleep(0.5)
            time.sleep(2.0)
            base, sent = cell.settle(), list(cell.sent)
            process = Process(nodes.processes["identifier_node"])
            cpu, began = process.processor(), time.monotonic()
            drive(cell, process, q, points, seconds, chosen.rate, chosen.period)
            elapsed = time.monotonic() - began
            cpu = process.processor() - cpu
            counts = cell.settle()
            nodes.check()
        finally:
            cell.close()
    arrived = [c - b for c, b in zip(counts, base, strict=True)]
    return figures(cell, process, chosen, [c - s for c, s in zip(cell.sent, sent, strict=True)], arrived) | {
        "seconds": round(elapsed, 1),
        "cpu": round(cpu / elapsed, 3),
        "load": os.getloadavg()[0],
    }


def figures(
    cell: Cell, process: Process, chosen: argparse.Namespace, sent: list[int], arrived: list[int]
) -> dict[str, Any]:
    """What was counted and measured."""
    heard, window = cell.heard, round(IdentifierParameters().window * NANO)
    estimates = [(stop, now) for stop, (now, _) in heard.estimates.items() if stop in heard.decided]
    late = {n: v["too late or twice"] for n, v in heard.streams.items()}
    return {
        "sent": sent,
        "arrived": arrived,
        "missed": [s - a for s, a in zip(sent, arrived, strict=True)],
        "lost": {n: v["lost"] for n, v in heard.streams.items()},
        "late": late,
        "accepted": len(heard.decided),
        "rejected": heard.rejected,
        "stored_before": chosen.stored,
        "in_estimate": heard.latest,
        "estimate_ms": spread([(now - stop - window) / 1e6 for stop, now in estimates]),
        "decided_ms": spread([(now - stop - window) / 1e6 for stop, now in heard.decided.items()]),
        "memory_mb": [round(m, 1) for _, m in process.samples][:: max(1, len(process.samples) // 20)],
        "growth": process.growth(60.0),
    }


def spread(values: list[float]) -> dict[str, float]:
    """Median, 95 %, 99 % and largest."""
    if not values:
        return {}
    shares = {"median": 0.5, "p95": 0.95, "p99": 0.99, "max": 1.0}
    return {n: round(float(np.quantile(values, p)), 1) for n, p in shares.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=1000.0, help="of each stream [Hz]")
    parser.add_argument("--stored", type=int, default=200, help="configurations in the store at the start")
    parser.add_argument(
        "--period", type=float, default=3.0, help="time per configuration, a second of it driving [s]"
    )
    parser.add_argument("--parameters", default="lengths+offsets", help="what is identified")
    parser.add_argument("--unknown", default="", help="base, tool, base,tool or nothing")
    parser.add_argument("--targets", type=int, choices=range(1, 1 + len(TARGETS)), default=1, help="reflectors")
    parser.add_argument("--erring", type=float, default=0.0, help="errors of the joints' own [rad]")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        found = soak(chosen, Path(name))
    table = Table("figure", "value")
    for key, value in found.items():
        table.add_row(key, str(value) if len(str(value)) < 300 else f"{len(value)} values, the last {value[-1]}")
    Console(stderr=True).print(table)
    print(json.dumps(found, indent=1))
    return 0 if not any(found["missed"]) else 1


if __name__ == "__main__":
    sys.exit(main())
