# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Every fault of the simulated shop floor × seeds, through the nodes: simulator, identifier and campaign.

What ``fault_matrix`` does in virtual time happens here as it does in a cell: three processes, their messages and
stamps, DDS between them, a campaign that decides by itself where to measure and when to stop. This process starts
it, listens and compares with the truth, which only the simulator knows. A campaign that pauses, with its reason,
is *helped*: the fault is remedied (the simulator is started again without it) and the campaign resumed.

Good is PASS with every parameter within ``WITHIN`` standard deviations of the truth, or WARN or FAIL with a
reason. *Wrong* is PASS beyond that, or a pause that help does not end; *lost* is a standstill that was told
accepted and is not in the identifier's store as it was told, or not in the campaign's results; a *crash* is a
node that ended, wrote a traceback or could not be ended with status 0, and *hung* a campaign without an end. Each
of them makes the exit status 1.

    python bench/campaign_faults.py                     # everything: some hours; runs sleep most of the time
    python bench/campaign_faults.py --faults reseat_0.3mm none --seeds 3 --jobs 3

Each run is on a ROS domain of its own; one that others have joined all the same is made again elsewhere. All
faults come with one seed before the next; Ctrl-C ends it with what is done. The table goes to stderr, JSON to
stdout; ``--keep FOLDER`` keeps logs and stores.
"""

from __future__ import annotations

import argparse
import json
import sqlite3
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from calib_planner_msgs.msg import CalibrationEstimate, CampaignStatus, Measurement, Verdict
from std_srvs.srv import Trigger

from calib_planner import Robot
from calib_planner.errors import CalibPlannerError
from calib_planner.io import read_data
from calib_planner.ros.demo import DemoClient
from calib_planner.ros.messages import LEVELS, estimate_from_message
from calib_planner.ros.parameters import LATCHED
from calib_planner.ros.processes import Nodes, own_domain
from calib_planner.simulation import Faults, random_deviations

ROBOT = "kuka_kr270"
POSE = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])
NAME = "calibration_campaign"
WITHIN = 4.0
LONGEST = 300.0
"""Time that a campaign gets [s]."""
NODES = ("identifier_node", "simulator_node", "campaign_node")
EXPECTED = {"calibration_identifier", "tracker_simulator", NAME}
MEASUREMENTS, SPAN = 16, 20.0
"""About what a campaign without faults takes; faults that begin do so half-way, the span is for drifts [s]."""
HALF = MEASUREMENTS // 2
BAD = ("wrong", "lost", "crash", "hung")
ENDS = ("PASS", "WARN", "FAIL", *BAD)
S = CampaignStatus


def cases() -> dict[str, Faults]:
    """Faults by name."""
    return {
        "none": Faults(),
        "dropouts_30%": Faults(dropout_probability=0.3),
        "dropouts_80%": Faults(dropout_probability=0.8),
        "outliers_2%": Faults(outlier_probability=0.02),
        "outlier_standstills_10%": Faults(outlier_standstills=0.1),
        "latency": Faults(tracker_latency=0.2, tracker_jitter=0.02, joint_latency=0.02, joint_jitter=0.005),
        "latency_2s": Faults(tracker_latency=2.0),
        "clock_+0.05s": Faults(tracker_clock_offset=0.05),
        "clock_-0.3s": Faults(tracker_clock_offset=-0.3),
        "clock_+1s": Faults(tracker_clock_offset=1.0),
        "clock_drift": Faults(tracker_clock_drift=1e-2),
        "beam_breaks": Faults(beam_break_interval=5.0, beam_break_duration=1.5),
        "relock_0.05mm": Faults(beam_break_interval=5.0, beam_break_duration=0.3, relock_error=5e-5),
        "swing_1mm": Faults(unsettled_probability=0.5, oscillation=1e-3),
        "swing_slow": Faults(unsettled_probability=0.5, oscillation=3e-4, oscillation_decay=5.0),
        "creep_0.2mm": Faults(unsettled_probability=0.5, oscillation=0.0, creep=2e-4),
        "drift_0.03mm": Faults(drift_translation=3e-5 / SPAN, drift_rotation=1e-5 / SPAN),
        "drift_0.3mm": Faults(drift_translation=3e-4 / SPAN, drift_rotation=1e-4 / SPAN),
        "reseat_0.03mm": Faults(reseat_at=HALF, reseat_by=3e-5),
        "reseat_0.3mm": Faults(reseat_at=HALF, reseat_by=3e-4),
        "bump_0.1mm": Faults(bump_at=HALF, bump_translation=1e-4, bump_rotation=3e-5),
        "duplicates_reordered": Faults(duplicate_probability=0.1, reorder_probability=0.2),
        "reordered_late": Faults(reorder_probability=0.2, shuffle_delay=0.5),
    }


def given(faults: Faults, seed: int, folder: Path) -> dict[str, dict[str, Any]]:
    """Parameters of each node; robots err by their parameters alone, and the nodes know that."""
    usual = asdict(Faults())
    off = {name: value for name, value in asdict(faults).items() if value != usual[name]}
    simulator = {"robot": ROBOT, "error_model": "paper", "seed": seed, "joint_speed": 12.0, "dwell": 0.5}
    identifier = {"robot": ROBOT, "error_model": "paper", "plan_topic": f"{NAME}/plan"}
    campaign = {
        "robot": ROBOT,
        "error_model": "paper",
        "test_poses": "'" + " ".join(map(str, POSE)) + "'",
        "sigma": 7e-6,
        "required_accuracy": 5e-6,
        "budget": 32,
        "validation": 4,
        "starts": 8,
        "seed": seed,
        "patience": 4.0,
        "longest_wait": 30.0,
        "most_failures": 5,
    }
    return {
        "identifier_node": identifier | {"store_folder": f"'{folder / 'store'}'"},
        "simulator_node": simulator | off,
        "campaign_node": campaign | {"store_folder": f"'{folder / 'results'}'"},
    }


# ── one campaign ─────────────────────────────────────────────────────────────────────────────────────


@dataclass
class Run:
    """One campaign: what became of it.

    Attributes:
        end: One of ``ENDS``.
        helped: Why it paused; empty if it did not.
        worst, at_pose: Largest |error|/std of a parameter, whose; error at the test pose over the predicted one.
        told: Standstills by the status told last.
        why: Of a bad end.
    """

    fault: str
    seed: int
    end: str
    helped: str = ""
    outcome: int = 0
    worst: float = float("nan")
    parameter: str = ""
    at_pose: float = float("nan")
    measured: int = 0
    validated: int = 0
    excluded: int = 0
    seconds: float = 0.0
    reasons: list[str] = field(default_factory=list)
    told: dict[str, int] = field(default_factory=dict)
    why: str = ""


class Disturbed(Exception):
    """Somebody else is on this ROS domain."""


class Desk(DemoClient):
    """The person at the campaign."""

    def __init__(self, domain: int, check: Any) -> None:
        super().__init__(domain, check, f"campaign_faults_{domain}")  # names that differ: one process, many nodes
        self._looked = time.monotonic()
        self.heard: list[CampaignStatus] = []
        self.results: list[CalibrationEstimate] = []
        self._node.create_subscription(CampaignStatus, f"{NAME}/status", self.heard.append, LATCHED)
        self._node.create_subscription(CalibrationEstimate, f"{NAME}/estimate", self.results.append, LATCHED)
        create = self._node.create_client
        self._start, self._resume = (create(Trigger, f"{NAME}/{name}") for name in ("start", "resume"))

    def wait(self, condition: Callable[[], bool], seconds: float, what: str = "") -> bool:
        """As it is, but that nobody else may be here."""

        def undisturbed() -> bool:
            if time.monotonic() - self._looked > 0.5:
                self._looked = time.monotonic()
                if self.strangers():
                    raise Disturbed
            return condition()

        return super().wait(undisturbed, seconds, what)

    def strangers(self) -> set[str]:
        """Nodes on the domain that are none of ours."""
        return set(self._node.get_node_names()) - EXPECTED - {self._node.get_name()}

    def begin(self) -> None:
        """Start the campaign."""
        hears = (("joint_states", 1), ("calibration_identifier/measurements", 2))
        self.wait(lambda: all(self._node.count_subscribers(n) >= k for n, k in hears), 60.0, "graph")
        answer = self._call(self._start, Trigger.Request(), 30.0, "answer from start")
        if not answer.success and "not finished" not in answer.message:  # it may have been asked twice
            raise CalibPlannerError(f"start: {answer.message}")

    def resume(self) -> None:
        """Have it go on; it is heard of."""
        self._call(self._resume, Trigger.Request(), 30.0, "answer from resume")
        self.wait(lambda: self.heard[-1].state != S.PAUSED, 10.0, "going on")

    def watch(self) -> CampaignStatus:
        """Wait until it is done or pauses."""
        over = (S.DONE, S.PAUSED)
        self.wait(lambda: bool(self.heard) and self.heard[-1].state in over, LONGEST, "end of the campaign")
        self.wait(lambda: False, 1.0)  # what is still under way
        return self.heard[-1]


def run(fault: str, seed: int, domain: int, folder: Path) -> Run:
    """One campaign from start to end."""
    parameters = given(cases()[fault], seed, folder)
    began = time.monotonic()
    with Nodes(folder / "log", domain) as nodes:
        desk = Desk(domain, nodes.check)
        try:
            for name in NODES:
                nodes.start(name, parameters[name])
            found = Run(fault, seed, "")
            try:
                desk.begin()
                if (last := desk.watch()).state == S.PAUSED:
                    found.helped = last.reason or "without a reason"
                    if status := nodes.end_one("simulator_node"):
                        raise CalibPlannerError(f"simulator_node ended with status {status}")
                    nodes.start("simulator_node", given(Faults(), seed, folder)["simulator_node"])
                    desk.resume()
                    desk.watch()
            except CalibPlannerError as error:
                alive = not str(error).startswith("no end")
                reason = desk.heard[-1].reason if desk.heard else "nothing heard"
                found.end, found.why = "crash" if alive else "hung", f"{error}; {reason}"[:1500]
        finally:
            desk.close()
        statuses = nodes.end()
    found.seconds = time.monotonic() - began
    describe(found, desk)
    if not found.end:
        judge(found, desk, folder)
    bad = [f"{n} ended with status {s}" for n, s in statuses.items() if s]
    for log in sorted((folder / "log").glob("*.log")):
        text = log.read_text(errors="replace")
        if "Traceback" in text:
            bad.append(f"{log.name}: {text[text.index('Traceback') :][:1500]}")
    if bad:
        found.end, found.why = "crash", "; ".join([found.why, *bad])
    return found


def last_told(desk: Desk) -> dict[int, Measurement]:
    """What was said last of every standstill that is stored."""
    return {m.id: m for m in desk.measurements if m.id}


def describe(found: Run, desk: Desk) -> None:
    """What was heard."""
    names = {v: k for k, v in vars(type(Measurement)).get("_Metaclass_Measurement__constants", {}).items()}
    told = Counter(names.get(m.status, str(m.status)) for m in last_told(desk).values())
    told += Counter(names.get(m.status, str(m.status)) for m in desk.measurements if not m.id)
    found.told = dict(told)
    if desk.heard:
        last = desk.heard[-1]
        found.outcome, found.measured, found.validated = last.outcome, last.measured, last.validated
        why = [f"{r.code}: {r.text}" for r in last.verdict.reasons if r.level != Verdict.PASS]
        found.excluded, found.reasons = last.excluded, [last.reason, *why]


def judge(found: Run, desk: Desk, folder: Path) -> None:
    """Verdict against truth, what was told against what was kept."""
    last = desk.heard[-1]
    found.end = next(name for name, level in LEVELS.items() if level == last.verdict.level)
    if last.state != S.DONE:
        found.end, found.why = "wrong", f"paused again: {last.reason}"
    if desk.results:
        compare(found, estimate_from_message(desk.results[-1]))
    if found.end == "PASS" and not found.worst <= WITHIN:
        found.end, found.why = "wrong", f"{found.parameter} is {found.worst:.1f} std off"
    if not last.reason or found.helped == "without a reason":
        found.end, found.why = "wrong", f"{found.end} without a reason"
    missing = lost(desk, folder, last)
    if missing:
        found.end, found.why = "lost", "; ".join(missing)[:1500]


def compare(found: Run, estimate: Any) -> None:
    """Distance from the truth."""
    robot = Robot.load(ROBOT).with_parameters("lengths+offsets")
    truth = random_deviations(robot, found.seed)
    off = np.abs(estimate.deviations - [truth[n] for n in estimate.parameters]) / estimate.std
    k = int(np.nanargmax(off))
    found.worst, found.parameter = float(off[k]), estimate.parameters[k]
    calibrated = robot.with_deviations(dict(zip(estimate.parameters, estimate.deviations, strict=True)))
    error = robot.with_deviations(truth).positions(POSE) - calibrated.positions(POSE)
    found.at_pose = float(np.linalg.norm(error) / estimate.predicted_accuracy.max())


def lost(desk: Desk, folder: Path, last: CampaignStatus) -> list[str]:
    """What was told accepted and is not kept, in words."""
    kept = (Measurement.ACCEPTED, Measurement.REJECTED_OUTLIER)
    told = {n: m for n, m in last_told(desk).items() if m.status in kept}
    with sqlite3.connect(next((folder / "store").glob("*.sqlite"))) as store:
        rows = dict(store.execute("SELECT number, points FROM standstills WHERE points IS NOT NULL"))
    gone = [f"standstill {n} is not in the store" for n in told if n not in rows]
    for number, message in told.items():
        if number in rows and json.loads(rows[number]) != [[p.x, p.y, p.z] for p in message.points]:
            gone.append(f"standstill {number} is another one in the store")
    if last.state != S.DONE:
        return gone
    results, robot = folder / "results", Robot.load(ROBOT)
    points = [
        tuple(p[0])
        for name in ("measurements", "validation")
        if (path := results / f"{name}_{last.campaign_id}.csv").exists()
        for p in read_data(path, robot).data.p.tolist()
    ]
    for number, message in told.items():
        p = message.points[0]
        if (p.x, p.y, p.z) not in points:
            gone.append(f"standstill {number} is not in the campaign's results")
    if len(points) != last.measured + last.validated:
        gone.append(f"{len(points)} results, {last.measured + last.validated} said")
    return gone


# ── the matrix ───────────────────────────────────────────────────────────────────────────────────────


def runs(names: Sequence[str], seeds: Sequence[int], jobs: int, keep: Path | None) -> dict[str, list[Run]]:
    """All of them, ``jobs`` at a time, each on a domain of its own."""

    def one(fault: str, seed: int) -> Run:
        for attempt in range(8):
            try:
                with own_domain() as domain, tempfile.TemporaryDirectory(prefix="campaign_faults_") as name:
                    where = Path(name) if keep is None else keep / f"{fault}_{seed}_{attempt}"
                    return run(fault, seed, domain, where)
            except Disturbed:
                continue
            except Exception as error:
                return Run(fault, seed, "crash", why=f"{type(error).__name__}: {error}"[:1500])
        return Run(fault, seed, "hung", why="others joined every ROS domain that was tried")

    done: dict[str, list[Run]] = {name: [] for name in names}
    with ThreadPoolExecutor(jobs) as pool:
        futures = [pool.submit(one, name, seed) for seed in seeds for name in names]
        try:
            for future in as_completed(futures):
                found = future.result()
                done[found.fault].append(found)
                text = f"{found.fault} {found.seed}: {found.end} in {found.seconds:.0f} s"
                print(f"{text}{'; ' * bool(found.why)}{found.why}", file=sys.stderr, flush=True)
        except KeyboardInterrupt:
            pool.shutdown(cancel_futures=True)
            print("interrupted: what is done so far", file=sys.stderr)
    return {name: sorted(found, key=lambda r: r.seed) for name, found in done.items()}


def table(done: dict[str, list[Run]]) -> None:
    """For people."""
    print(f"\n{'fault':<24}" + "".join(f"{e:>7}" for e in ENDS), end="", file=sys.stderr)
    print(" helped  worst of PASS  of WARN  at pose  seconds  measured  given up", file=sys.stderr)
    for name, found in ((n, f) for n, f in done.items() if f):
        ends = Counter(r.end for r in found)
        line = f"{name:<24}" + "".join(f"{ends.get(e, 0):>7}" for e in ENDS)
        line += f"{sum(bool(r.helped) for r in found):7}    "
        for level in ("PASS", "WARN"):
            line += f"{max((r.worst for r in found if r.end == level), default=float('nan')):11.1f}"
        line += f"{max((r.at_pose for r in found if r.end == 'PASS'), default=float('nan')):12.1f}"
        for attribute in ("seconds", "measured", "excluded"):
            line += f"{np.mean([getattr(r, attribute) for r in found]):9.1f}"
        print(line, file=sys.stderr)


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--faults", nargs="+", choices=list(cases()), default=list(cases()))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--jobs", type=int, default=3, help="campaigns at a time")
    parser.add_argument("--keep", type=Path, help="folder for logs and stores")
    args = parser.parse_args()
    if args.seeds < 1 or args.jobs < 1:
        parser.error("--seeds, --jobs: at least 1")
    done = runs(args.faults, range(args.first, args.first + args.seeds), args.jobs, args.keep)
    table(done)
    print(json.dumps({name: [asdict(r) for r in found] for name, found in done.items()}, indent=1))
    return int(any(r.end in BAD for found in done.values() for r in found))


if __name__ == "__main__":
    raise SystemExit(main())
