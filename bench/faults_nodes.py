# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Every fault of the simulated shop floor × seeds, and some pairs, through the nodes on a simulated clock.

What ``fault_matrix`` does without nodes and ``campaign_faults`` in real time happens here in ``lockstep``: the
nodes of identifier, simulator and campaign with their messages, as fast as they work. A campaign of the KR-270
decides by itself where to measure and when to stop; if it pauses, it is helped as in ``campaign_faults``, by
whose rules it is judged: nothing *wrong* (PASS beyond ``WITHIN`` standard deviations, or an end without a
reason), nothing *lost* (told accepted and not kept), no *crash*, none *hung*. The same seed gives the same
campaign.

    python bench/faults_nodes.py                            # all faults × 20 seeds, a process per core
    python bench/faults_nodes.py --faults none --seeds 3 --jobs 1

The table goes to stderr, JSON with the processor time of each campaign to stdout; Ctrl-C ends it with what is
done. A fault and a seed can be looked at alone: ``--faults NAME --first SEED --seeds 1 --keep FOLDER``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import campaign_faults
import fault_matrix
from calib_planner_msgs.msg import CalibrationEstimate, CampaignStatus, Measurement
from campaign_faults import BAD, HALF, LONGEST, NAME, SPAN, Run, S, describe, given, judge, table
from lockstep import Stage
from std_srvs.srv import Trigger

from calib_planner.ros.nodes.campaign import CampaignNode
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.nodes.simulator import SimulatorNode
from calib_planner.ros.parameters import EVENTS, LATCHED
from calib_planner.simulation import Faults

BUDGET = 24
"""Measurements that a campaign may make: without faults it needs 15 to 17; one that ends badly makes them all."""
PAIRS = 4
"""Pairs of faults, of which there are many, are looked at with so many times fewer seeds."""
SHARE = 10
"""Campaigns of one process: each makes a ROS context, with threads of its own."""
PATIENCE = 300.0
"""Time for a campaign on a busy machine [s]; with nobody else there it takes some three."""
ONCE = 10.0
"""Simulated time after the end of a campaign, in which what is under way comes [s]."""


def cases() -> dict[str, Faults]:
    """Faults by name: those of both matrices, and pairs of them."""
    others = {
        "transmission_0.1mrad": Faults(transmission_error=1e-4),
        "encoder_0.05mrad": Faults(encoder_resolution=5e-5),
        "reseat_late": Faults(reseat_at=HALF + 5, reseat_by=3e-4),
        "clock_+3s": Faults(tracker_clock_offset=3.0),
        "rough": fault_matrix.cases("known")["rough"],
        "reseat_and_outliers": Faults(reseat_at=HALF, reseat_by=3e-4, outlier_standstills=0.1),
        "beam_breaks_and_latency": Faults(
            beam_break_interval=5.0, beam_break_duration=1.5, tracker_latency=0.2, tracker_jitter=0.02
        ),
        "drift_and_dropouts": Faults(
            drift_translation=3e-4 / SPAN, drift_rotation=1e-4 / SPAN, dropout_probability=0.3
        ),
        "swing_and_reordered": Faults(
            unsettled_probability=0.5, oscillation=1e-3, reorder_probability=0.2, shuffle_delay=0.5
        ),
    }
    return campaign_faults.cases() | others


class Desk:
    """The person at the campaign; the same attributes as that of ``campaign_faults``."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.heard: list[CampaignStatus] = []
        self.results: list[CalibrationEstimate] = []
        self.measurements: list[Measurement] = []
        hear, create = stage.client.create_subscription, stage.client.create_client
        hear(CampaignStatus, f"{NAME}/status", self.heard.append, LATCHED)
        hear(CalibrationEstimate, f"{NAME}/estimate", self.results.append, LATCHED)
        hear(Measurement, "calibration_identifier/measurements", self.measurements.append, EVENTS)
        self._start, self._resume = (create(Trigger, f"{NAME}/{name}") for name in ("start", "resume"))

    def begin(self) -> None:
        """Start the campaign."""
        answer = self.stage.call(self._start, Trigger.Request())
        assert answer.success, answer.message

    def resume(self) -> None:
        """Have it go on."""
        self.stage.call(self._resume, Trigger.Request())
        self.stage.until(lambda: self.heard[-1].state != S.PAUSED, ONCE)

    def watch(self) -> bool:
        """Wait until it is done or pauses; whether that came."""
        over = (S.DONE, S.PAUSED)
        ended = self.stage.until(lambda: bool(self.heard) and self.heard[-1].state in over, LONGEST)
        self.stage.until(lambda: False, 1.0)  # what is still under way
        return ended


def run(fault: str, seed: int, folder: Path) -> Run:
    """One campaign from start to end."""
    found, began = Run(fault, seed, ""), time.process_time()
    with Stage() as stage:
        parameters = {name: plain(values) for name, values in given(cases()[fault], seed, folder).items()}
        # No search ends by the time that it took: that would depend on the machine.
        parameters["campaign_node"] |= {"budget": BUDGET, "time_limit": 86400.0, "longest_wait": 15.0}
        desk = Desk(stage)
        try:
            stage.start(IdentifierNode, parameters["identifier_node"])
            stage.start(SimulatorNode, parameters["simulator_node"])
            stage.start(CampaignNode, parameters["campaign_node"])
            desk.begin()
            ended = desk.watch()
            if ended and (last := desk.heard[-1]).state == S.PAUSED:
                found.helped = last.reason or "without a reason"
                stage.end(SimulatorNode)
                stage.start(SimulatorNode, plain(given(Faults(), seed, folder)["simulator_node"]))
                desk.resume()
                ended = desk.watch()
            if not ended:
                found.end, found.why = "hung", desk.heard[-1].reason if desk.heard else "nothing heard"
        except Exception:
            found.end, found.why = "crash", traceback.format_exc()[-1500:]
    describe(found, desk)
    if not found.end:
        judge(found, desk, folder)
    if stage.errors:
        found.end, found.why = "crash", stage.errors[0][-1500:]
    found.seconds = time.process_time() - began
    return found


def plain(values: dict[str, Any]) -> dict[str, Any]:
    """Parameters as values: ``given`` has texts quoted, as for a command line."""
    return {k: v.strip("'") if isinstance(v, str) else v for k, v in values.items()}


def one(fault: str, seed: int, keep: Path | None) -> Run:
    """The same in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="faults_nodes_") as name:
        return run(fault, seed, Path(name) if keep is None else keep / f"{fault}_{seed}")


def work() -> None:
    """A process of its own: campaigns (fault, seed, folder) from stdin, a line of JSON for each to stdout."""
    for line in sys.stdin:
        fault, seed, keep = json.loads(line)
        print(json.dumps(asdict(one(fault, seed, None if keep is None else Path(keep)))), flush=True)


STOPPED = threading.Event()
"""Set by Ctrl-C: what is done is shown."""
RUNNING: list[subprocess.Popen[str]] = []
"""The processes at work."""


def share(tasks: list[tuple[str, int]], keep: Path | None, note: Callable[[Run], None]) -> None:
    """Have processes make ``tasks``, one after the other; one that ends or does nothing more is replaced."""
    left = list(tasks)
    while left and not STOPPED.is_set():
        with subprocess.Popen(
            [sys.executable, __file__, "--work"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdin is not None and process.stdout is not None
            RUNNING.append(process)
            timer = threading.Timer(PATIENCE * len(left), process.kill)
            timer.start()
            where = None if keep is None else str(keep)
            process.stdin.write("".join(json.dumps([*task, where]) + "\n" for task in left))
            process.stdin.close()
            for line in process.stdout:
                note(Run(**json.loads(line)))
                left.pop(0)
            timer.cancel()
            RUNNING.remove(process)
        if left and not STOPPED.is_set():
            end, why = ("hung", "killed") if process.returncode == -9 else ("crash", f"{process.returncode}")
            note(Run(*left.pop(0), end, why=f"its process ended: {why}"))


def runs(names: Sequence[str], seeds: Sequence[int], jobs: int, keep: Path | None) -> dict[str, list[Run]]:
    """All of them, ``jobs`` processes at a time."""
    done: dict[str, list[Run]] = {name: [] for name in names}

    def note(found: Run) -> None:
        done[found.fault].append(found)
        text = f"{found.fault} {found.seed}: {found.end} in {found.seconds:.1f} s"
        print(f"{text}{'; ' * bool(found.why)}{found.why}", file=sys.stderr, flush=True)

    few = seeds[: -(-len(seeds) // PAIRS)]
    wanted = [(name, seed) for seed in seeds for name in names if seed in few or "_and_" not in name]
    with ThreadPoolExecutor(jobs) as pool:
        shares = [wanted[i : i + SHARE] for i in range(0, len(wanted), SHARE)]
        try:
            for future in [pool.submit(share, tasks, keep, note) for tasks in shares]:
                future.result()
        except KeyboardInterrupt:
            STOPPED.set()
            for process in list(RUNNING):
                process.terminate()
            print("interrupted: what is done so far", file=sys.stderr)
    return {name: sorted(found, key=lambda r: r.seed) for name, found in done.items()}


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--faults", nargs="+", choices=list(cases()), default=list(cases()))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--keep", type=Path, help="folder for the stores")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        work()
        return 0
    if args.seeds < 1 or args.jobs < 1:
        parser.error("--seeds, --jobs: at least 1")
    began = time.monotonic()
    done = runs(args.faults, range(args.first, args.first + args.seeds), args.jobs, args.keep)
    table(done)
    every = [r for found in done.values() for r in found]
    spent = sum(r.seconds for r in every)
    print(f"{len(every)} campaigns in {time.monotonic() - began:.0f} s, processor {spent:.0f} s", file=sys.stderr)
    print(json.dumps({name: [asdict(r) for r in found] for name, found in done.items()}, indent=1))
    return int(any(r.end in BAD for r in every))


if __name__ == "__main__":
    raise SystemExit(main())
