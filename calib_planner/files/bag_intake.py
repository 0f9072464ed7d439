"""Takes a bag's messages one by one: to the standstill detector, or to the count of what was left out and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.errors import FileFormatError, InputError, UnknownNameError
from calib_planner.files.bag_storage import BagTopics, BrokenStorage, Recording
from calib_planner.instrument.joint_state import MOST_NAMES, pick_joints
from calib_planner.instrument.standstill import (
    NANO,
    Rejection,
    Standstill,
    StandstillDetector,
    StandstillSettings,
)

REPORT_EVERY = 2000
"""Messages between two reports of progress."""
UNREADABLE, UNSTAMPED, UNFIT = "not decodable", "without a stamp", "without the robot's joints"
NOT_FINITE, DROPPED = "not finite", "too late or twice"


@dataclass(frozen=True)
class Stream:
    """What became of the messages of a topic.

    Attributes:
        topic: Its name.
        messages: Read from the bag.
        left_out: How many of them took no part, by reason.
        first, last: Earliest and latest stamp [ns], ``None`` without any.
        example: What was wrong with the first message that was left out, where there is more to say.
    """

    topic: str
    messages: int
    left_out: dict[str, int]
    first: int | None
    last: int | None
    example: str

    @property
    def usable(self) -> int:
        """Messages that are stamped, finite and of the robot, in time or not."""
        return self.messages - sum(n for why, n in self.left_out.items() if why != DROPPED)

    def describe(self) -> str:
        """One line: messages, and those left out."""
        lost = ", ".join(f"{n} {why}" for why, n in self.left_out.items())
        return f"{self.topic}: {self.messages} messages" + (f", left out: {lost}" if lost else "")


@dataclass
class _Tally:
    messages: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    first: int | None = None
    last: int | None = None
    example: str = ""

    def leave_out(self, why: str, example: str = "") -> None:
        self.left_out[why] += 1
        self.example = self.example or example

    def count(self, stamp: int, values: FloatArray) -> None:
        self.first = stamp if self.first is None else min(stamp, self.first)
        self.last = stamp if self.last is None else max(stamp, self.last)
        if not np.isfinite(values).all():
            self.left_out[NOT_FINITE] += 1


class Intake:
    """Takes messages one by one and collects what they complete.

    Attributes:
        standstills, rejections: What was found so far, in the order of completion.
        frame_id: Frame of the points; empty while no message told.
    """

    def __init__(
        self, path: str | Path, joint_names: tuple[str, ...], topics: BagTopics, settings: StandstillSettings
    ) -> None:
        self.path, self.joint_names, self.names = path, joint_names, topics.names
        self.standstills: list[Standstill] = []
        self.rejections: list[Rejection] = []
        self.frame_id = ""
        self._detector = StandstillDetector(len(joint_names), len(topics.points), settings)
        self._tallies = [_Tally() for _ in self.names]

    def drain(self, recording: Recording, progress: Callable[[float, str], None] | None) -> str:
        """Take all there is; returns what is damaged, in words, or nothing."""
        total, done, stopped = max(sum(recording.promised), 1), 0, ""
        try:
            for stream, data in recording.messages():
                self._take(stream, recording, data)
                done += 1
                if progress is not None and done % REPORT_EVERY == 0:
                    progress(min(done / total, 1.0), f"{len(self.standstills)} standstills")
        except BrokenStorage as error:
            stopped = f"unreadable after {done} messages: {error}"
        self._sort(self._detector.flush())
        damage = [recording.unread, stopped]
        for name, tally, promised in zip(self.names, self._tallies, recording.promised, strict=True):
            if tally.messages < promised and not stopped:
                damage.append(f"{promised - tally.messages} of {promised} messages of {name} are missing")
            if tally.left_out[UNREADABLE]:
                count = f"{tally.left_out[UNREADABLE]} of {tally.messages} messages"
                damage.append(f"{count} of {name} cannot be decoded ({tally.example})")
        return "; ".join(filter(None, damage))

    def streams(self) -> tuple[Stream, ...]:
        """What became of the messages."""
        result = []
        for name, tally, dropped in zip(self.names, self._tallies, self._detector.dropped, strict=True):
            left_out = dict(tally.left_out + Counter({DROPPED: dropped}))
            result.append(Stream(name, tally.messages, left_out, tally.first, tally.last, tally.example))
        return tuple(result)

    def _take(self, stream: int, recording: Recording, data: bytes) -> None:
        tally = self._tallies[stream]
        tally.messages += 1
        try:
            message = recording.decode(stream, data)
        except BrokenStorage as error:
            tally.leave_out(UNREADABLE, str(error))
            return
        stamp = int(message.header.stamp.sec) * NANO + int(message.header.stamp.nanosec)
        if stamp <= 0:
            tally.leave_out(UNSTAMPED)
            return
        if stream:
            xyz = self._point(message)
            tally.count(stamp, xyz)
            self._sort(self._detector.add_point(stream - 1, stamp, xyz))
            return
        try:
            joints = pick_joints(message.name, message.position, self.joint_names)
        except InputError as error:
            names = f"it names {', '.join(message.name[:MOST_NAMES])}"
            tally.leave_out(UNFIT, names if isinstance(error, UnknownNameError) else str(error))
            return
        tally.count(stamp, joints)
        self._sort(self._detector.add_joints(stamp, joints))

    def _point(self, message: Any) -> FloatArray:
        frame = message.header.frame_id
        if frame and self.frame_id and frame != self.frame_id:
            got = f"{self.frame_id!r} and {frame!r}"
            advice = "transform the points, or split the bag where the station changed"
            raise FileFormatError(self.path, "frame_id of the points", got, "one frame", advice)
        self.frame_id = self.frame_id or frame
        return np.array([message.point.x, message.point.y, message.point.z])

    def _sort(self, results: list[Standstill | Rejection]) -> None:
        for found in results:
            if isinstance(found, Standstill):
                self.standstills.append(found)
            else:
                self.rejections.append(found)
