# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""From messages to standstills: one intake for the topics of a node and for the messages of a recording.

Only the stamps in the headers count. Several publishers may share the robot's joints, on one topic or on
several: each part of the joints is a stream of its own (``rest.py``). The points of all targets are in one frame,
the first one that is named: a mean of points in two frames has no meaning. What takes no part is counted by
reason.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calib_planner.acquisition.clocks import NANO
from calib_planner.acquisition.messages import (
    MOST_NAMES,
    JointReader,
    JointStateLike,
    PointLike,
    stamp_of,
)
from calib_planner.acquisition.standstill import (
    IN_A_ROW,
    Rejection,
    RejectionReason,
    Standstill,
    StandstillDetector,
    StandstillSettings,
)
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.units import brief, listed

UNREADABLE, UNSTAMPED, UNFIT = "not decodable", "without a stamp", "without the robot's joints"
NOT_FINITE, DROPPED, OTHER_FRAME = "not finite", "too late or twice", "in another frame"
LOST = "while the target was lost"
"""Why a message takes no part. Values that are not finite mean: the target was not seen."""
LOST_TEXT = "the tracker says that it has lost the target"
LONGEST_FRAME = 500
"""Characters that are kept of a frame's name, which may come from anyone."""


@dataclass
class StreamCount:
    """What became of the messages of one stream.

    Attributes:
        name: Its topic.
        messages: Number of messages that came.
        left_out: How many of them took no part, by reason.
        reason: Why the last one was refused; empty once one is usable again.
        example: What was wrong with the first message that was left out, where there is more to say.
        lost: Messages that were not delivered, as the middleware says.
        first, last: Smallest and largest stamp [ns]; 0 before the first.
        columns: Numbers of the robot's joints that it has named, from 0.
    """

    name: str
    messages: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    reason: str = ""
    example: str = ""
    lost: int = 0
    first: int = 0
    last: int = 0
    columns: frozenset[int] = frozenset()
    _before: int = 0

    @property
    def refused(self) -> int:
        """Messages that could not be used: without a stamp, without the robot's joints, in another frame."""
        return self.left_out[UNSTAMPED] + self.left_out[UNFIT] + self.left_out[OTHER_FRAME]

    @property
    def usable(self) -> int:
        """Messages that are stamped, finite and of the robot, in time or not."""
        return self.messages - sum(n for why, n in self.left_out.items() if why != DROPPED)

    def stamped(self, stamp: int) -> bool:
        """Count a message; ``False`` if it has no stamp."""
        self.messages += 1
        if stamp <= 0:
            self.leave_out(UNSTAMPED, f"stamp {stamp / NANO:g} s, which is none: the driver has to set it")
            return False
        self.first = min(self.first or stamp, stamp)
        self.last = max(self.last, stamp)
        self.reason = ""
        return True

    def leave_out(self, why: str, reason: str, example: str = "") -> None:
        """Count a message that cannot be used."""
        self.left_out[why] += 1
        self.reason, self.example = reason, self.example or example

    def rate(self, seconds: float) -> float:
        """Messages per second since the last call, ``seconds`` ago [Hz]."""
        count, self._before = self.messages - self._before, self.messages
        return count / seconds

    def describe(self) -> str:
        """One line: messages, and those left out."""
        lost = ", ".join(f"{n} {why}" for why, n in self.left_out.items())
        return f"{self.name}: {self.messages} messages" + (f", left out: {lost}" if lost else "")


class Intake:
    """From messages to standstills.

    Args:
        joint_names: The robot's joints; ``None``: not known yet, messages are counted only.
        joint_topics: Names of the streams of joints.
        topics: Names of the streams of points, a target each.
        settings: What counts as standing still.
        children: The ``child_frame_id`` of each target, for transforms; without them the first one that comes.

    Attributes:
        streams: The count of every stream, those of joints first.
        joint_topics: How many of them are of joints.
        frame: Points of other frames are refused; empty: the next frame named. Points that name none are taken.
        bound: Whether that frame has to stay, since points in it are kept. Else another one takes its place when
            ``IN_A_ROW`` points in a row, of all targets, are in it.
        metre: The unit of the points' coordinates [m].
    """

    def __init__(
        self,
        joint_names: Sequence[str] | None,
        joint_topics: Sequence[str],
        topics: Sequence[str],
        settings: StandstillSettings,
        children: Sequence[str] = (),
    ) -> None:
        self.streams = [StreamCount(name) for name in (*joint_topics, *topics)]
        self.joint_topics = len(joint_topics)
        self.frame, self.bound, self._strange = "", False, 0
        self.metre = 1.0
        self._settings = settings
        self._children = tuple(children) or ("",) * len(topics)
        self._lost = [False] * len(topics)
        s = settings
        self._longest = round(
            (s.skew + s.gap + s.window) * NANO
        )  # that a part of the joints may be behind another
        self.use(joint_names)

    def use(self, joint_names: Sequence[str] | None) -> None:
        """Begin anew for a robot with these joints."""
        names = self._names = tuple(joint_names or ())
        self._reader = JointReader(names)
        targets = len(self.streams) - self.joint_topics
        self._other_frame = [""] * targets
        self._child = list(self._children)
        self._heard: list[int] = [0] * len(names)  # newest stamp of every joint, 0 before the first
        self._every = frozenset(range(len(names)))
        for count in self.streams:
            count.columns = frozenset()
        self._first = self._newest = 0  # stamps of states of some joints only, after the last pause
        self.detector = StandstillDetector(len(names), targets, self._settings) if names else None
        for target, lost in enumerate(self._lost):
            if self.detector is not None:
                self.detector.set_lost(target, lost)

    def joints(self, message: JointStateLike, topic: int = 0) -> list[Standstill | Rejection]:
        """Take a joint state from a topic, from 0; what it completes.

        Raises:
            InputError: Without the robot's joints, the same for thousands of messages perhaps.
        """
        count, stamp = self.streams[topic], stamp_of(message)
        if not count.stamped(stamp) or self.detector is None:
            return []
        try:
            columns, joints = self._reader.read(message)
            self._hear(topic, columns, stamp)
        except InputError as error:
            names = f"it names {', '.join(message.name[:MOST_NAMES])}"
            count.leave_out(UNFIT, str(error), names if isinstance(error, UnknownNameError) else str(error))
            raise
        if not np.isfinite(joints).all():
            count.left_out[NOT_FINITE] += 1
        return self._explained(self.detector.add_joints(stamp, joints, columns))

    def _hear(self, topic: int, columns: tuple[int, ...] | None, stamp: int) -> None:
        """Note which joints a state has; refuse one of some joints if others are not heard at about that time.

        Raises:
            InputError: Of one of them nothing was heard for longer than a stream may be behind another.
        """
        if columns is None:
            self._heard = [stamp] * len(self._names)
            self.streams[topic].columns = self._every
            return
        self.streams[topic].columns |= {*columns}
        if stamp - self._newest > round(self._settings.gap * NANO):
            self._first = stamp
        self._newest = max(self._newest, stamp)
        for k in columns:
            self._heard[k] = max(self._heard[k], stamp)
        silent = [k for k, at in enumerate(self._heard) if stamp - max(at, self._first) > self._longest]
        if silent:
            got = f"nothing of {listed([self._names[k] for k in silent])} for {self._longest / NANO:g} s"
            raise InputError(
                "name", got, "every joint, in this message or in others", "is the topic listened to?"
            )

    @property
    def unheard(self) -> tuple[str, ...]:
        """Joints that no state has named so far."""
        heard = frozenset[int]().union(*(count.columns for count in self.streams))
        return tuple(name for k, name in enumerate(self._names) if k not in heard)

    def point(self, target: int, message: PointLike) -> list[Standstill | Rejection]:
        """Take a point of a target, from 0, as ``points_in`` reads it; what it completes."""
        count, stamp, frame = self.streams[self.joint_topics + target], stamp_of(message), message.header.frame_id
        if not count.stamped(stamp) or self.detector is None:
            return []
        other = self._other_child(target, getattr(message, "child_frame_id", ""))
        if not other and frame and frame != self.frame and not self._enter_frame(frame[:LONGEST_FRAME]):
            other = f"frame_id {brief(frame, 40)}, the points before are in {brief(self.frame, 40)}"
            other += ": publish all in one frame, or call ~/reset"
        self._other_frame[target] = other
        if other:
            count.leave_out(OTHER_FRAME, other)
            return []
        self._strange = 0
        if self._lost[target]:
            count.leave_out(LOST, LOST_TEXT)
        xyz = self.metre * np.array((message.point.x, message.point.y, message.point.z))
        if not np.isfinite(xyz).all():
            count.left_out[NOT_FINITE] += 1
        return self._explained(self.detector.add_point(target, stamp, xyz))

    def _other_child(self, target: int, child: str) -> str:
        """Why a transform to ``child`` is not the target's; empty if it is."""
        wanted = self._child[target] = self._child[target] or child[:LONGEST_FRAME]
        if not child or child == wanted:
            return ""
        text = f"child_frame_id {brief(child, 40)}, the target is {brief(wanted, 40)}"
        return f"{text}: publish one body per topic, or say which child_frame_id is the target"

    def tracker_state(self, target: int, locked: bool) -> None:
        """The tracker says whether it sees a target, from 0: ``True`` = locked, ``False`` = lost."""
        self._lost[target] = not locked
        self.streams[self.joint_topics + target].reason = "" if locked else LOST_TEXT
        if self.detector is not None:
            self.detector.set_lost(target, not locked)

    def rest(self, stream: int) -> float | None:
        """How long what a stream shows has stood still [s], of joints all of them; ``None`` without a robot."""
        if self.detector is None:
            return None
        of_joints = stream < self.joint_topics
        return self.detector.joints_rest() if of_joints else self.detector.points_rest(stream - self.joint_topics)

    def dropped(self, stream: int) -> int:
        """Finite messages of a stream that came too late, twice or with a clock set back."""
        if self.detector is None:
            return 0
        if stream < self.joint_topics:
            return self.detector.joints_dropped(self.streams[stream].columns)
        return self.detector.points_dropped(stream - self.joint_topics)

    def _enter_frame(self, frame: str) -> bool:
        self._strange += 1
        if not self.frame:
            self.frame = frame
        elif not self.bound and self._strange >= IN_A_ROW:
            self.use(self._names)  # no mean of both
            self.frame = frame
        return self.frame == frame

    def _explained(self, results: list[Standstill | Rejection]) -> list[Standstill | Rejection]:
        """Without points, or with too few, because they were refused."""
        text = next(filter(None, self._other_frame), "") if results else ""
        if not text:
            return results
        named = {"reason": RejectionReason.OTHER_FRAME, "message": text}
        return [replace(r, **named) if isinstance(r, Rejection) else r for r in results]  # type: ignore[arg-type]

    def offset_text(self, bound: float) -> str:
        """Which clock is more than ``bound`` [s] off, in words; empty if none is."""
        return "" if self.detector is None else self.detector.offset_text(bound)

    def misdated(self, bound: float) -> list[tuple[int, int]]:
        """Rests [ns] at which a clock was more than ``bound`` [s] off, once it is known to be."""
        return [] if self.detector is None else self.detector.misdated(bound)
