"""From messages to standstills: one intake for the topics of a node and for the messages of a recording.

A message is anything with the fields of ``sensor_msgs/msg/JointState`` or ``geometry_msgs/msg/PointStamped``:
those of rclpy and those that rosbags decodes are alike. Only the stamps in their headers count. A joint state
names its joints every time, in its own order and among others; where each one stands is remembered as long as
the names stay the same. Several publishers may share the robot's joints: their states are put together. The
points of all targets are in one frame, the first one that is named: a mean of points in two frames has no
meaning. What takes no part is counted by reason.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.acquisition.clocks import NANO
from calib_planner.acquisition.standstill import (
    IN_A_ROW,
    Rejection,
    RejectionReason,
    Standstill,
    StandstillDetector,
    StandstillSettings,
)
from calib_planner.arrays import FloatArray, frozen
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.units import brief

JointStateLike: TypeAlias = Any
PointLike: TypeAlias = Any

MOST_NAMES = 50
"""Names that an error lists."""


def pick_joints(names: Sequence[str], positions: ArrayLike, joint_names: Sequence[str]) -> FloatArray:
    """Positions (joints,) [rad | m] in the order wanted; other joints are ignored, values may be NaN.

    Args:
        names: Joints of the message, in any order.
        positions: (names,) their positions [rad | m].
        joint_names: Joints wanted.

    Raises:
        UnknownNameError: A joint is missing.
        InputError: A name is there twice, or names and positions differ in number.
    """
    names, values = list(names), np.asarray(positions, dtype=float)
    if len(names) != len(values):
        raise InputError("position", f"{len(values)} positions for {len(names)} names", "one position per name")
    where = {name: i for i, name in enumerate(names)}
    for name in joint_names:
        if name not in where:
            raise UnknownNameError("name", name, list(dict.fromkeys(filter(None, names)))[:MOST_NAMES])
    if len(where) != len(names):
        doubled = sorted({n for n in joint_names if names.count(n) > 1})
        if doubled:
            raise InputError("name", f"{', '.join(doubled)} more than once", "each joint once")
    return frozen(values[[where[name] for name in joint_names]])


UNREADABLE, UNSTAMPED, UNFIT = "not decodable", "without a stamp", "without the robot's joints"
NOT_FINITE, DROPPED, OTHER_FRAME = "not finite", "too late or twice", "in another frame"
"""Why a message takes no part. Values that are not finite mean: the target was not seen."""
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
    """

    name: str
    messages: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    reason: str = ""
    example: str = ""
    lost: int = 0
    first: int = 0
    last: int = 0
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


def stamp_of(message: JointStateLike | PointLike) -> int:
    """The stamp in a message's header [ns]."""
    return int(message.header.stamp.sec) * NANO + int(message.header.stamp.nanosec)


PARTS_APART = NANO // 10
"""States of some joints each belong together if their stamps are no further apart [ns]: as long as a robot is
given to settle, so that a value from before the rest does not look like one of the rest."""


class JointReader:
    """Reads joint states that name joints in any order, among others.

    A state that names only some of the joints is put together with those before it: the result is complete once
    every joint came since the last complete one.

    Args:
        joint_names: Joints wanted, in the order wanted.
    """

    def __init__(self, joint_names: Sequence[str]) -> None:
        self._wanted = tuple(joint_names)
        self._names: list[str] = []
        self._columns: list[int] = []
        self._latest: dict[str, tuple[int, float]] = {}
        self._waiting = set(self._wanted)

    def read(self, message: JointStateLike) -> FloatArray | None:
        """Positions (joints,) [rad | m] in the order wanted; values may be NaN. ``None``: other joints are to
        come.

        Raises:
            UnknownNameError: A joint is missing, and no state shortly before had it.
            InputError: A name is there twice, or names and positions differ in number.
        """
        names, positions = message.name, message.position
        if names != self._names or not names:
            if len(names) == len(positions) and self._is_part(names):
                return self._together(stamp_of(message), names, positions)
            pick_joints(names, positions, self._wanted)
            self._names, self._columns = list(names), [names.index(n) for n in self._wanted]
        elif len(positions) != len(names):
            got = f"{len(positions)} positions for {len(names)} names"
            raise InputError("position", got, "one position per name")
        return np.array([positions[k] for k in self._columns])

    def _is_part(self, names: Sequence[str]) -> bool:
        """Whether a state names some of the joints, each once, but not all."""
        ours = [n for n in names if n in self._wanted]
        return 0 < len(ours) < len(self._wanted) and len(set(ours)) == len(ours)

    def _together(self, stamp: int, names: Sequence[str], positions: Sequence[float]) -> FloatArray | None:
        for name, value in zip(names, positions, strict=True):
            if name in self._wanted:
                self._latest[name] = stamp, float(value)
                self._waiting.discard(name)
        for name in self._wanted:
            if name not in self._latest or abs(stamp - self._latest[name][0]) > PARTS_APART:
                raise UnknownNameError("name", name, list(names)[:MOST_NAMES])
        if self._waiting:
            return None
        self._waiting = set(self._wanted)
        return np.array([self._latest[name][1] for name in self._wanted])


class Intake:
    """From messages to standstills.

    Args:
        joint_names: The robot's joints; ``None``: not known yet, messages are counted only.
        joint_topic, topics: Names of the streams, a target each.
        settings: What counts as standing still.

    Attributes:
        streams: The count of every stream, joints first.
        frame: Points of other frames are refused; empty: the next frame named. Points that name none are taken.
        bound: Whether that frame has to stay, since points in it are kept. Else another one takes its place when
            ``IN_A_ROW`` points in a row, of all targets, are in it.
    """

    def __init__(
        self,
        joint_names: Sequence[str] | None,
        joint_topic: str,
        topics: Sequence[str],
        settings: StandstillSettings,
    ) -> None:
        self.streams = [StreamCount(name) for name in (joint_topic, *topics)]
        self.frame, self.bound, self._strange = "", False, 0
        self._settings = settings
        self.use(joint_names)

    def use(self, joint_names: Sequence[str] | None) -> None:
        """Begin anew for a robot with these joints."""
        names = self._names = tuple(joint_names or ())
        self._reader = JointReader(names)
        targets = len(self.streams) - 1
        self._other_frame = [""] * targets
        self.detector = StandstillDetector(len(names), targets, self._settings) if names else None

    def joints(self, message: JointStateLike) -> list[Standstill | Rejection]:
        """Take a joint state; what it completes.

        Raises:
            InputError: Without the robot's joints, the same for thousands of messages perhaps.
        """
        count, stamp = self.streams[0], stamp_of(message)
        if not count.stamped(stamp) or self.detector is None:
            return []
        try:
            joints = self._reader.read(message)
        except InputError as error:
            names = f"it names {', '.join(message.name[:MOST_NAMES])}"
            count.leave_out(UNFIT, str(error), names if isinstance(error, UnknownNameError) else str(error))
            raise
        if joints is None:
            return []
        if not np.isfinite(joints).all():
            count.left_out[NOT_FINITE] += 1
        return self._explained(self.detector.add_joints(stamp, joints))

    def point(self, target: int, message: PointLike) -> list[Standstill | Rejection]:
        """Take a point of a target, from 0; what it completes."""
        count, stamp, frame = self.streams[1 + target], stamp_of(message), message.header.frame_id
        if not count.stamped(stamp) or self.detector is None:
            return []
        if frame and frame != self.frame and not self._enter_frame(frame[:LONGEST_FRAME]):
            other = f"frame_id {brief(frame, 40)}, the points before are in {brief(self.frame, 40)}"
            self._other_frame[target] = f"{other}: publish all in one frame, or call ~/reset"
            count.leave_out(OTHER_FRAME, self._other_frame[target])
            return []
        self._other_frame[target], self._strange = "", 0
        xyz = np.array((message.point.x, message.point.y, message.point.z))
        if not np.isfinite(xyz).all():
            count.left_out[NOT_FINITE] += 1
        return self._explained(self.detector.add_point(target, stamp, xyz))

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
