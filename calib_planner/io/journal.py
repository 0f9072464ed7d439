"""An adaptive campaign on disk: every measurement and every configuration given up, a line each, as it comes.

``campaign_journal.jsonl`` in a folder that the user chose: a line of what it is about, then one JSON object per
event. A line is on the disk before the campaign goes on; the last one may be torn by a crash and is then ignored.
A state is rebuilt by ``from_measurements``: what was planned and not measured is planned anew.

    {"format": …, "campaign": "3f2a…", "robot": …, "joint_names": […], "targets": 1}
    {"measured": 7, "role": "fit", "configuration": […], "points": [[x, y, z]]}      number of the measurement
    {"withdrawn": 7}
    {"excluded": […], "radius": 0.05, "reason": "…", "asked": false}
    {"joined": true}                                  the validation so far is part of the fit from here on
    {"finished": "reached"}
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.campaign import (
    FIT,
    VALIDATION,
    CampaignProblem,
    CampaignState,
    Exclusion,
    Measurement,
    from_measurements,
)
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError, StoreError
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot

FILE = "campaign_journal.jsonl"
FORMAT = "calib_planner campaign journal 1"
MOST_BYTES = 200_000_000
WHAT = "a campaign journal that this package wrote"


@dataclass(frozen=True, eq=False)
class Journal:
    """A file that only grows; made by ``begin_journal`` or ``open_journal``."""

    path: Path

    def note(self, before: CampaignState, after: CampaignState) -> None:
        """Write what became of ``before``.

        Raises:
            StoreError: It cannot be written.
        """
        lines: list[dict[str, Any]] = []
        if [s.role for s in before.configurations] != [
            s.role for s in after.configurations[: len(before.configurations)]
        ]:
            lines.append({"joined": True})
        now = {r.number: r for r in after.measurements}
        then = {r.number: r for r in before.measurements}
        lines += [{"withdrawn": number} for number in then if number not in now]
        lines += [_row_line(after, r) for number, r in now.items() if then.get(number) is not r]
        lines += [_exclusion_line(e) for e in after.exclusions[len(before.exclusions) :]]
        if after.result is not None and before.result is None:
            lines.append({"finished": after.outcome})
        self._append(lines)

    def _append(self, lines: list[dict[str, Any]]) -> None:
        if not lines:
            return
        text = "".join(json.dumps(line, allow_nan=False) + "\n" for line in lines)
        try:
            with self.path.open("a", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise StoreError(self.path, error.strerror or str(error), "make space, then go on") from None


@dataclass(frozen=True, eq=False)
class Stored:
    """What a journal holds.

    Attributes:
        journal: The file.
        campaign_id: Name of the campaign.
        rows: ``(number, role, configuration, points)``.
        exclusions: Configurations given up.
        finished: The outcome; empty while it is not ended.
    """

    journal: Journal
    campaign_id: str
    rows: tuple[tuple[int, str, list[float], list[Any]], ...] = ()
    exclusions: tuple[Exclusion, ...] = field(default=())
    finished: str = ""

    def state(self, problem: CampaignProblem) -> CampaignState:
        """The campaign as far as it came.

        Raises:
            InputError: The measurements do not fit the robot.
        """
        ordered = sorted(self.rows, key=lambda r: r[1] != FIT)
        parts = [[r for r in ordered if (r[1] == FIT) == own] for own in (True, False)]
        data = [_measurements(problem.robot, part) for part in parts]
        state = from_measurements(problem, data[0], data[1], self.exclusions)
        measurements: list[Measurement] = [
            replace(r, number=o[0]) for r, o in zip(state.measurements, ordered, strict=True)
        ]
        return replace(state, measurements=tuple(measurements))


def begin_journal(folder: str | Path, campaign_id: str, robot: Robot) -> Journal:
    """A new journal in ``folder``, which is made if need be; one that is there is kept beside under its name.

    Raises:
        StoreError: It cannot be written.
    """
    path = Path(folder).expanduser() / FILE
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_symlink():
            raise StoreError(path, "a symbolic link", "move it away")
        if path.exists():
            path.rename(path.with_name(f"campaign_journal_before_{campaign_id}.jsonl"))
    except OSError as error:
        raise StoreError(path, error.strerror or str(error), "choose a folder that can be written to") from None
    journal = Journal(path)
    head = {"format": FORMAT, "campaign": campaign_id, "robot": robot.name}
    journal._append([head | {"joint_names": list(robot.joint_names), "targets": len(robot.targets)}])
    return journal


def open_journal(folder: str | Path, robot: Robot) -> Stored | None:
    """What the journal in ``folder`` holds; ``None`` if there is none.

    Raises:
        FileFormatError: Not a journal, damaged before its last line, or of another robot.
        StoreError: It cannot be read.
    """
    path = Path(folder).expanduser() / FILE
    try:
        if not path.exists():
            return None
        if path.stat().st_size > MOST_BYTES:
            raise FileFormatError(path, "size", f"{path.stat().st_size} bytes", f"at most {MOST_BYTES}")
        whole = path.read_bytes()
    except OSError as error:
        raise StoreError(path, error.strerror or str(error), "choose a folder that can be read") from None
    end = whole.rfind(b"\n") + 1
    if end < len(whole):
        _cut(path, end)  # or the next line would be written behind a torn one
    lines = [_parsed(path, number, line) for number, line in enumerate(whole[:end].splitlines(), 1)]
    if not lines or lines[0].get("format") != FORMAT:
        raise FileFormatError(path, "line 1", "something else", WHAT, "move the file away")
    _check_robot(path, lines[0], robot)
    try:
        return _folded(Journal(path), lines, robot)
    except (KeyError, TypeError, ValueError, OverflowError, CalibPlannerError) as error:
        raise FileFormatError(path, "events", str(error)[:200], WHAT, "move the file away") from None


def _folded(journal: Journal, lines: list[dict[str, Any]], robot: Robot) -> Stored:
    rows: dict[int, tuple[int, str, list[float], list[Any]]] = {}
    exclusions: list[Exclusion] = []
    finished = ""
    for line in lines[1:]:
        if "measured" in line:
            number, role = int(line["measured"]), str(line["role"])
            if role not in (FIT, VALIDATION):
                raise InputError("role", role[:100], f"{FIT} or {VALIDATION}")
            rows[number] = (number, role, list(line["configuration"]), list(line["points"]))
        elif "withdrawn" in line:
            rows.pop(int(line["withdrawn"]), None)
        elif "excluded" in line:
            q = np.array(line["excluded"], float).reshape(len(robot.joint_names))
            exclusions.append(Exclusion(-1, q, float(line["radius"]), str(line["reason"]), bool(line["asked"])))
        elif "joined" in line:
            rows = {n: (n, FIT, q, points) for n, (_, _, q, points) in rows.items()}
        elif "finished" in line:
            finished = str(line["finished"])
    _ = [_measurements(robot, [row]) for row in rows.values()]
    return Stored(journal, str(lines[0]["campaign"])[:100], tuple(rows.values()), tuple(exclusions), finished)


def _measurements(robot: Robot, rows: list[tuple[int, str, list[float], list[Any]]]) -> Measurements | None:
    if not rows:
        return None
    points = np.array([r[3] for r in rows], float)  # null becomes NaN
    if points.shape[1:] != (len(robot.targets), 3):
        raise InputError("points", points.shape[1:], f"({len(robot.targets)}, 3), as the robot has targets")
    return Measurements(robot.joint_names, np.array([r[2] for r in rows], float), points)


def _row_line(state: CampaignState, row: Measurement) -> dict[str, Any]:
    points = [[None if np.isnan(x) else float(x) for x in p] for p in row.points]
    role = state.configurations[row.index].role
    return {"measured": row.number, "role": role, "configuration": row.q.tolist(), "points": points}


def _exclusion_line(out: Exclusion) -> dict[str, Any]:
    return {"excluded": out.q.tolist(), "radius": out.radius, "reason": out.reason[:500], "asked": out.requested}


def _parsed(path: Path, number: int, line: bytes) -> dict[str, Any]:
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise FileFormatError(path, f"line {number}", ascii(line[:40]), WHAT, "move the file away")
    return found


def _check_robot(path: Path, head: dict[str, Any], robot: Robot) -> None:
    advice = "choose another folder, or start with that robot"
    for name, wanted in (
        ("robot", robot.name),
        ("joint_names", list(robot.joint_names)),
        ("targets", len(robot.targets)),
    ):
        if head.get(name) != wanted:
            raise FileFormatError(path, name, str(head.get(name))[:100], str(wanted), advice)


def _cut(path: Path, length: int) -> None:
    try:
        os.truncate(path, length)
    except OSError as error:
        raise StoreError(path, error.strerror or str(error), "choose a folder that can be written to") from None
