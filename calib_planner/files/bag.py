"""Measurements out of a rosbag2 recording: joint states and tracker points, paired where the robot stood still.

The decisions are the live node's: every message goes, in the order of recording, through the same
``StandstillDetector`` with the same settings; only the stamps in the headers count. The bag is read as a stream.
Every standstill is a row of its own, also if the robot was there before. Nothing is left out in silence: what
took no part is counted by topic and reason, and a bag whose end cannot be read is refused, unless the part before
is explicitly accepted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib_planner._arrays import IntArray, check_number, frozen
from calib_planner.errors import FileFormatError
from calib_planner.files.bag_intake import UNFIT, UNSTAMPED, Intake, Stream
from calib_planner.files.bag_storage import BagTopics, open_bag
from calib_planner.identification.measurements import Measurements
from calib_planner.instrument.standstill import NANO, Rejection, Standstill, StandstillSettings
from calib_planner.instrument.standstill_noise import mean_std
from calib_planner.robot.chain import Robot


@dataclass(frozen=True, eq=False)
class BagMeasurements:
    """What a bag says.

    Attributes:
        data: One row per standstill, in the order of time; std from the scatter of the samples unless given.
        standstills: The same with their intervals and numbers of samples.
        rejections: Standstills that gave no row, with the reason.
        streams: What became of the messages, joints first, then each target.
        frame_id: Frame of the points; empty if no message told.
        damage: Why the end of the bag is missing; empty if it is whole.
    """

    data: Measurements
    standstills: tuple[Standstill, ...]
    rejections: tuple[Rejection, ...]
    streams: tuple[Stream, ...]
    frame_id: str
    damage: str

    @property
    def stamps(self) -> IntArray:
        """(N,) middle of each row's interval [ns]."""
        return frozen(np.array([s.stamp for s in self.standstills], np.int64))

    def describe(self) -> list[str]:
        """Lines for people: rows, rejections by reason with an example, messages by topic, damage."""
        lines = [f"{len(self.standstills)} standstills in frame {self.frame_id or '(not named)'}"]
        lines += _reasons(self.rejections) + [s.describe() for s in self.streams]
        return lines + ([f"damaged: {self.damage}"] if self.damage else [])


def read_bag(
    path: str | Path,
    robot: Robot,
    topics: BagTopics | None = None,
    settings: StandstillSettings | None = None,
    *,
    sigma: float = 0.0,
    repeatability: float = 0.0,
    accept_damaged: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> BagMeasurements:
    """Read a bag; the joints come in the robot's order, targets in that of the topics.

    Args:
        path: The bag's folder, or its .db3 or .mcap file.
        robot: Gives the names of the joints.
        topics: Where joint states and points are.
        settings: What counts as standing still.
        sigma: Standard deviation of one coordinate of one sample [m]; 0: from the samples' scatter.
        repeatability: Standard deviation that averaging does not reduce [m].
        accept_damaged: Take what could be read of a damaged bag; it says so in ``damage``.
        progress: Called with the share done and a text now and then.

    Raises:
        MissingExtraError: rosbags is not installed.
        FileFormatError: Not a bag; a topic missing, of another type or without usable messages; damaged;
            points in several frames; clocks that do not overlap; no standstill.
    """
    topics, settings = topics or BagTopics(), settings or StandstillSettings()
    check_number("sigma", sigma, low=0, high=1, unit="m")
    check_number("repeatability", repeatability, low=0, high=1, unit="m")
    with open_bag(path, topics) as recording:
        intake = Intake(path, robot.joint_names, topics, settings)
        damage = intake.drain(recording, progress)
    streams, found = intake.streams(), intake.standstills
    if damage and not accept_damaged:
        counts = ", ".join(f"{s.messages} of {n}" for s, n in zip(streams, recording.promised, strict=True))
        got = f"{damage}; read: {counts} messages of {', '.join(recording.names)}, {len(found)} standstills"
        raise FileFormatError(
            path, "bag", got, "an undamaged bag", "repair it, or accept it with --accept-damaged"
        )
    _check_streams(path, streams, robot.joint_names)
    if not found:
        raise _no_standstill(path, intake.rejections, streams[0], settings)
    q, points = np.array([s.joints for s in found]), np.array([s.points for s in found])
    data = Measurements(robot.joint_names, q, points, mean_std(found, sigma, repeatability))
    return BagMeasurements(data, tuple(found), tuple(intake.rejections), streams, intake.frame_id, damage)


# ── what makes a bag unusable ────────────────────────────────────────────────────────────────────────


def _check_streams(path: str | Path, streams: tuple[Stream, ...], joint_names: Sequence[str]) -> None:
    for number, stream in enumerate(streams):
        where = f"topic {stream.topic}"
        if not stream.messages:
            raise FileFormatError(path, where, "no messages", "at least one standstill's", "was the driver on?")
        if not stream.usable:
            got = stream.describe().partition(": ")[2] + (f" ({stream.example})" if stream.example else "")
            advice = "check the driver and the line of sight"
            if stream.left_out.get(UNSTAMPED):
                advice = "the driver has to fill header.stamp"
            elif stream.left_out.get(UNFIT):
                advice = f"each message has to name and position {', '.join(joint_names)}"
            wanted = "stamped, finite points" if number else "stamped, finite positions of the robot's joints"
            raise FileFormatError(path, where, got, wanted, advice)
    joints = streams[0]
    for points in streams[1:]:
        apart = max(points.first - joints.last, joints.first - points.last)  # type: ignore[operator]
        if apart > 0:
            got = " and ".join(
                f"{s.topic} from {_seconds(s.first)} to {_seconds(s.last)}" for s in (joints, points)
            )
            advice = "synchronise the clocks (PTP or NTP) and record again, or correct the stamps"
            raise FileFormatError(path, "header stamps", got, "streams that overlap in time", advice)


def _no_standstill(
    path: str | Path, rejections: list[Rejection], joints: Stream, settings: StandstillSettings
) -> FileFormatError:
    seconds = ((joints.last or 0) - (joints.first or 0)) / NANO
    got = f"none in {seconds:.1f} s"
    if rejections:
        got += "; " + "; ".join(_reasons(rejections))
        advice = "see the reasons"
    else:
        got += f"; the joints never rest within joint_tolerance = {settings.joint_tolerance:g}"
        advice = "dwell longer, or raise joint_tolerance above the noise of the encoders"
    rest = settings.settle + settings.duration
    return FileFormatError(path, "standstills", got, f"the robot at rest for {rest:g} s at least", advice)


def _reasons(rejections: list[Rejection] | tuple[Rejection, ...]) -> list[str]:
    """How many of each reason, with the first one's own words."""
    counts = Counter(r.reason for r in rejections)
    first = {r.reason: r.message for r in reversed(rejections)}
    return [f"{n} rejected as {why.value} ({first[why]})" for why, n in counts.items()]


def _seconds(stamp: int | None) -> str:
    return f"{(stamp or 0) / NANO:.3f} s"
