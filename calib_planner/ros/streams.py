"""What comes in a thousand times per second: read cheaply, counted, searched for standstills.

A joint state names its joints every time; where each is found is remembered as long as the names stay the same.
Points of all targets are in one frame, the first one named: means of points in two frames would be of nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import JointState

from calib_planner.acquisition import (
    IN_A_ROW,
    NANO,
    Reason,
    Rejection,
    Standstill,
    StandstillDetector,
    StandstillSettings,
    pick_joints,
)
from calib_planner.arrays import FloatArray
from calib_planner.errors import InputError
from calib_planner.io import LONGEST
from calib_planner.ros.diagnostics import StreamHealth
from calib_planner.ros.messages import nanoseconds
from calib_planner.units import brief


class JointReader:
    """Reads joint states that name joints in any order, among others.

    Args:
        joint_names: Joints wanted, in the order wanted.
    """

    def __init__(self, joint_names: Sequence[str]) -> None:
        self._wanted = tuple(joint_names)
        self._names: list[str] = []
        self._columns: list[int] = []

    def read(self, message: JointState) -> FloatArray:
        """Positions (joints,) [rad | m] in the order wanted; values may be NaN.

        Raises:
            UnknownNameError: A joint is missing.
            InputError: A name is there twice, or names and positions differ in number.
        """
        names, positions = message.name, message.position
        if names != self._names or not names:
            pick_joints(names, positions, self._wanted)
            self._names, self._columns = list(names), [names.index(n) for n in self._wanted]
        elif len(positions) != len(names):
            got = f"{len(positions)} positions for {len(names)} names"
            raise InputError("position", got, "one position per name")
        return np.array([positions[k] for k in self._columns])


@dataclass
class StreamWatch:
    """Counts of one stream.

    Attributes:
        name: Its topic.
        messages: Heard since the node became active.
        refused: Of these not usable: without a stamp, without the robot's joints.
        reason: Why the last one was refused; empty once one was usable again.
        lost: Not delivered, as the middleware says.
        newest: Largest stamp [ns]; 0 before the first.
    """

    name: str
    messages: int = 0
    refused: int = 0
    reason: str = ""
    lost: int = 0
    newest: int = 0
    _before: int = 0

    def usable(self, stamp: int) -> bool:
        """Count a message; ``False`` if it has no stamp."""
        self.messages += 1
        if stamp <= 0:
            self.refuse(f"stamp {stamp / 1e9:g} s, which is none: the driver has to set it")
            return False
        if stamp > self.newest:
            self.newest = stamp
        if self.reason:
            self.reason = ""
        return True

    def refuse(self, reason: str) -> None:
        """Count a message that cannot be used."""
        self.refused += 1
        self.reason = reason

    def rate(self, seconds: float) -> float:
        """Messages per second since the last call, ``seconds`` ago [Hz]."""
        count, self._before = self.messages - self._before, self.messages
        return count / seconds


class Intake:
    """From messages to standstills.

    Args:
        joint_names: The robot's joints; ``None``: not known yet, messages are counted only.
        joint_topic, topics: Names of the streams, a target each.
        settings: What counts as standing still.

    Attributes:
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
        self.watches = [StreamWatch(name) for name in (joint_topic, *topics)]
        self.frame, self.bound, self._strange = "", False, 0
        self._settings = settings
        self.use(joint_names)

    def use(self, joint_names: Sequence[str] | None) -> None:
        """Begin anew for a robot with these joints."""
        names = self._names = tuple(joint_names or ())
        self._reader = JointReader(names)
        targets = len(self.watches) - 1
        self._other_frame = [""] * targets
        self.detector = StandstillDetector(len(names), targets, self._settings) if names else None

    def joints(self, message: JointState) -> list[Standstill | Rejection]:
        """Take a joint state; what it completes.

        Raises:
            InputError: Without the robot's joints, the same for thousands of messages perhaps.
        """
        watch, stamp = self.watches[0], nanoseconds(message.header.stamp)
        if not watch.usable(stamp) or self.detector is None:
            return []
        try:
            joints = self._reader.read(message)
        except InputError as error:
            watch.refuse(str(error))
            raise
        return self._explained(self.detector.add_joints(stamp, joints))

    def point(self, target: int, message: PointStamped) -> list[Standstill | Rejection]:
        """Take a point of a target, from 0; what it completes."""
        stamp, watch, frame = nanoseconds(message.header.stamp), self.watches[1 + target], message.header.frame_id
        if not watch.usable(stamp) or self.detector is None:
            return []
        if frame and frame != self.frame and not self._enter_frame(frame[:LONGEST]):
            other = f"frame_id {brief(frame, 40)}, the points before are in {brief(self.frame, 40)}"
            self._other_frame[target] = f"{other}: publish all in one frame, or call ~/reset"
            watch.refuse(self._other_frame[target])
            return []
        self._other_frame[target], self._strange = "", 0
        p = message.point
        return self._explained(self.detector.add_point(target, stamp, np.array((p.x, p.y, p.z))))

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
        named = {"reason": Reason.OTHER_FRAME, "message": text}
        return [replace(r, **named) if isinstance(r, Rejection) else r for r in results]  # type: ignore[arg-type]

    def offset_text(self, bound: float) -> str:
        """Which clock is more than ``bound`` [s] off, in words; empty if none is."""
        return "" if self.detector is None else self.detector.offset_text(bound)

    def misdated(self, bound: float) -> list[tuple[int, int]]:
        """Rests [ns] at which a clock was more than ``bound`` [s] off, once it is known to be."""
        return [] if self.detector is None else self.detector.misdated(bound)

    def health(self, now: int, seconds: float) -> list[StreamHealth]:
        """Every stream in the last ``seconds``, at the time ``now`` [ns]."""
        return [self._health(k, now, seconds) for k in range(len(self.watches))]

    def _health(self, k: int, now: int, seconds: float) -> StreamHealth:
        watch, detector, joints = self.watches[k], self.detector, self.watches[0].newest
        newest = watch.newest
        return StreamHealth(
            name=watch.name,
            rate=watch.rate(seconds),
            age=(now - newest) / NANO if newest else None,
            skew=(joints - newest) / NANO if newest and joints else None,
            messages=watch.messages,
            refused=watch.refused,
            late=0 if detector is None else detector.dropped[k],
            lost=watch.lost,
            reason=watch.reason,
            offset=None if detector is None or k == 0 else detector.clocks.offset(k - 1),
        )
