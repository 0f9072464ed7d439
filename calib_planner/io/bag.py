# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements out of a rosbag2 recording: joint states and tracker points, paired where the robot stood still.

A bag is a folder with ``metadata.yaml``, a folder of storage files whose recorder never wrote that, or one
storage file (.db3, .mcap). rosbags reads it, only the topics wanted and a chunk at a time; the types are
those of ROS 2 Jazzy, whatever definitions the bag holds. Whatever rosbags raises on files that are no bags or
are damaged becomes an error of ours.

The live node and a bag decide alike: every message goes, in the order of recording, through the same intake
with the same settings, and only the stamps in the headers count. Every standstill is a row of its own, also
if the robot was there before. Every message that took no part is counted by topic and reason. A bag whose end
cannot be read is refused, unless the part before is explicitly accepted.

Messages hold metres and radians (REP-103). Where a driver sends millimetres or degrees, the sizes of the
numbers at the beginning of the recording tell, as in tables; the messages are converted before anything is
decided about them.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from calib_planner.acquisition import (
    DROPPED,
    JOINT_STATE,
    NANO,
    OTHER_FRAME,
    POINTS,
    STATE,
    TRANSFORMS,
    UNFIT,
    UNREADABLE,
    UNSTAMPED,
    Intake,
    Rejection,
    Standstill,
    StandstillSettings,
    StreamCount,
    mean_std,
    points_in,
)
from calib_planner.arrays import IntArray, check_number, frozen
from calib_planner.errors import FileFormatError, InputError, MissingExtraError
from calib_planner.io.sizes import angles_by_size, lengths_by_size
from calib_planner.io.text import user_path
from calib_planner.io.understanding import STORAGE, BagTopics
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot
from calib_planner.units import ANGLES, LENGTHS, SI, UNSAID, Units, brief, counted, cut, listed

WHAT = "a rosbag2 folder or a .db3 or .mcap file of one"
REPAIR = "repair it with 'ros2 bag reindex FOLDER' or, for .mcap, 'mcap recover FILE'"
REPORT_EVERY = 2000
"""Messages between two reports of progress."""
LOOKED_AT = 20_000
"""Messages from the beginning whose sizes tell the units: minutes of a robot that moves."""


@dataclass(frozen=True, eq=False)
class BagMeasurements:
    """The measurements of a bag, and what became of its messages.

    Attributes:
        data: One row per standstill, in the order of time; std from the scatter of the samples unless given.
        standstills: The same with their intervals and numbers of samples.
        rejections: Standstills that gave no row, with the reason.
        streams: What became of the messages, joints first, then each target.
        frame_id: Frame of the points; empty if no message told.
        damage: Why the end of the bag is missing; empty if it is whole.
        units: Units of the messages; ``data`` is in rad and m.
        remarks: What the sizes of the numbers told.
    """

    data: Measurements
    standstills: tuple[Standstill, ...]
    rejections: tuple[Rejection, ...]
    streams: tuple[StreamCount, ...]
    frame_id: str
    damage: str
    units: Units = SI
    remarks: tuple[str, ...] = ()

    @property
    def stamps(self) -> IntArray:
        """(N,) middle of each row's interval [ns]."""
        return frozen(np.array([s.stamp for s in self.standstills], np.int64))

    def describe(self) -> list[str]:
        """Lines for people: rows, rejections by reason with an example, messages by topic, damage."""
        lines = [f"{len(self.standstills)} standstills in frame {self.frame_id or '(not named)'}"]
        if self.units != SI:
            lines.append(f"messages in {self.units.length} and {self.units.angle}")
        lines += list(self.remarks)
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
    units: Units | None = None,
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
        units: Units of the messages; what is not stated is told by the sizes of the numbers.
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
        units, remarks = _units(recording, robot, units or UNSAID)
        bag = _BagIntake(path, robot, topics, settings, units)
        damage = bag.drain(recording, progress)
    streams, standstills = tuple(bag.intake.streams), tuple(bag.standstills)
    if bag.repeated:
        remarks = (*remarks, f"{counted(bag.repeated, 'standstill')} recorded twice, which count once")
    if damage and not accept_damaged:
        counts = ", ".join(f"{s.messages} of {n}" for s, n in zip(streams, recording.promised, strict=True))
        got = f"{damage}; read: {counts} messages of {', '.join(recording.names)}, {len(standstills)} standstills"
        raise FileFormatError(
            path, "bag", got, "an undamaged bag", "repair it, or accept it with --accept-damaged"
        )
    _check_streams(path, bag.intake, robot.joint_names)
    if not standstills:
        raise _no_standstill(path, bag.rejections, streams[: len(topics.joints)], settings)
    q, points = np.array([s.joints for s in standstills]), np.array([s.points for s in standstills])
    data = Measurements(robot.joint_names, q, points, mean_std(standstills, sigma, repeatability))
    rejections = tuple(bag.rejections)
    return BagMeasurements(data, standstills, rejections, streams, bag.intake.frame, damage, units, remarks)


def _units(recording: Recording, robot: Robot, stated: Units) -> tuple[Units, tuple[str, ...]]:
    """The units of the messages, and what told those that are not stated."""
    if stated.length and stated.angle:
        return stated, ()
    joints, points = [np.zeros(len(robot.joint_names))], []
    number = {name: j for j, name in enumerate(robot.joint_names)}
    first, targets = len(recording.topics.joints), len(recording.topics.points)
    with suppress(BrokenStorage):
        for streams, data in islice(recording.messages(), LOOKED_AT):
            message = recording.decode(streams[0], data)
            if streams[0] < first:
                q = np.zeros(len(number))
                for name, value in zip(message.name, message.position, strict=False):
                    if name in number:
                        q[number[name]] = value
                joints.append(q)
            for target in (k - first for k in streams if first <= k < first + targets):
                for p in recording.points(target, message):
                    row = np.full((targets, 3), np.nan)
                    row[target] = p.point.x, p.point.y, p.point.z
                    points.append(row)
    angle, why = angles_by_size(robot, np.nan_to_num(joints), robot.joint_is_revolute)
    metre, how = lengths_by_size(robot, np.array(points).reshape(len(points), targets, 3))
    remarks = [*(() if stated.angle else why), *(() if stated.length else how)]
    return Units(stated.length or metre, stated.angle or angle), tuple(remarks)


# ── what makes a bag unusable ────────────────────────────────────────────────────────────────────────


def _check_streams(path: str | Path, intake: Intake, joint_names: Sequence[str]) -> None:
    joints, points = intake.streams[: intake.joint_topics], intake.streams[intake.joint_topics :]
    for stream in intake.streams:
        where = f"topic {stream.name}"
        if not stream.messages:
            raise FileFormatError(path, where, "no messages", "at least one standstill's", "was the driver on?")
        unheard = [n for n in joint_names if n in intake.unheard] if stream in joints else []
        if unheard or not stream.usable:
            got = stream.describe().partition(": ")[2] + (f" ({stream.example})" if stream.example else "")
            advice = "check the driver and the line of sight"
            if stream.left_out.get(UNSTAMPED):
                advice = "the driver has to fill header.stamp"
            elif stream.left_out.get(UNFIT):
                names = ", ".join(unheard or joint_names)
                advice = f"name the topics that position {names}: one --joint-topic each"
            wanted = "stamped, finite positions of the robot's joints"
            raise FileFormatError(
                path, where, got, wanted if stream in joints else "stamped, finite points", advice
            )
    for one, other in ((j, p) for p in points for j in joints):
        apart = max(other.first - one.last, one.first - other.last)
        if apart > 0:
            spans = (f"{s.name} from {_seconds(s.first)} to {_seconds(s.last)}" for s in (one, other))
            got = " and ".join(spans)
            advice = "synchronise the clocks (PTP or NTP) and record again, or correct the stamps"
            raise FileFormatError(path, "header stamps", got, "streams that overlap in time", advice)


def _no_standstill(
    path: str | Path, rejections: list[Rejection], joints: Sequence[StreamCount], settings: StandstillSettings
) -> FileFormatError:
    seconds = (max(j.last for j in joints) - min(j.first for j in joints)) / NANO
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


def _seconds(stamp: int) -> str:
    return f"{stamp / NANO:.3f} s"


class _BagIntake:
    """Drains a recording into the intake, and collects what that completes.

    Attributes:
        intake: Counts the messages and finds the standstills.
        standstills, rejections: The results so far, in the order of completion.
        repeated: Standstills that came again: a recording was played while this one was made.
    """

    def __init__(
        self, path: str | Path, robot: Robot, topics: BagTopics, settings: StandstillSettings, units: Units
    ) -> None:
        self.path = path
        first = len(topics.joints)
        joints, points = topics.names[:first], topics.names[first : first + len(topics.points)]
        self.intake = Intake(robot.joint_names, joints, points, settings, topics.children)
        self.intake.metre = LENGTHS[units.length]
        factors = np.where(robot.joint_is_revolute, ANGLES[units.angle], LENGTHS[units.length]).tolist()
        self._factors = {n: f for n, f in zip(robot.joint_names, factors, strict=True) if f != 1.0}
        self.standstills: list[Standstill] = []
        self.repeated = 0
        self.rejections: list[Rejection] = []
        assert self.intake.detector is not None
        self._detector = self.intake.detector

    def drain(self, recording: Recording, progress: Callable[[float, str], None] | None) -> str:
        """Read the whole recording; returns a description of the damage, which is empty if there is none."""
        total, done, stopped = max(sum(recording.promised), 1), 0, ""
        try:
            for streams, data in recording.messages():
                for stream in streams:
                    self._take(stream, recording, data)
                done += 1
                if progress is not None and done % REPORT_EVERY == 0:
                    progress(min(done / total, 1.0), f"{len(self.standstills)} standstills")
        except BrokenStorage as error:
            stopped = f"unreadable after {done} messages: {error}"
        self._sort(self._detector.flush())
        damage = [recording.unread, stopped]
        for stream, (count, promised) in enumerate(zip(self.intake.streams, recording.promised, strict=False)):
            if count.messages < promised and not stopped:
                damage.append(f"{promised - count.messages} of {promised} messages of {count.name} are missing")
            if count.left_out[UNREADABLE]:
                unreadable = f"{count.left_out[UNREADABLE]} of {count.messages} messages"
                damage.append(f"{unreadable} of {count.name} cannot be decoded ({count.example})")
            count.left_out = +Counter({**count.left_out, DROPPED: self.intake.dropped(stream)})
        return "; ".join(filter(None, damage))

    def _take(self, stream: int, recording: Recording, data: bytes) -> None:
        intake, target = self.intake, stream - self.intake.joint_topics
        try:
            message = recording.decode(stream, data)
        except BrokenStorage as error:
            count = intake.streams[min(stream, len(intake.streams) - 1)]
            count.messages += 1
            count.leave_out(UNREADABLE, str(error), str(error))
            return
        if stream >= len(intake.streams):
            intake.tracker_state(stream - len(intake.streams), bool(message.data))
        elif target >= 0:
            for point in recording.points(target, message):
                self._sort(intake.point(target, point))
                self._check_frame(intake.streams[stream])
        else:
            self._take_joints(stream, message)

    def _take_joints(self, stream: int, message: Any) -> None:
        if self._factors and len(message.name) == len(message.position):
            q = [v * self._factors.get(n, 1.0) for n, v in zip(message.name, message.position, strict=True)]
            message = SimpleNamespace(header=message.header, name=message.name, position=q)
        with suppress(InputError):  # counted with its reason
            self._sort(self.intake.joints(message, stream))

    def _check_frame(self, count: StreamCount) -> None:
        """A bag with points in two frames is refused as a whole: only its owner can say which frame is meant."""
        if count.left_out[OTHER_FRAME]:
            advice = "transform the points, split the bag where the station changed, or name the --child-frame"
            got = count.reason.partition(": ")[0]
            raise FileFormatError(self.path, f"frames of {count.name}", got, "one frame", advice)

    def _sort(self, results: list[Standstill | Rejection]) -> None:
        for result in results:
            if isinstance(result, Standstill):
                if any(result.is_again(one) for one in self.standstills):
                    self.repeated += 1
                else:
                    self.standstills.append(result)
            else:
                self.rejections.append(result)


# ── messages out of a recording ──────────────────────────────────────────────────────────────────────


class BrokenStorage(Exception):
    """Reading stopped before the end; the text says why."""


@dataclass(frozen=True, eq=False)
class Recording:
    """An open bag.

    Attributes:
        topics: The topics wanted; the position of one in their ``names`` is the number of its stream.
        promised: Messages of each topic, as the bag's own index says.
        kinds: Types of their messages.
        unread: What the bag holds but no reader gets at, in words; empty if there is nothing.
    """

    topics: BagTopics
    promised: tuple[int, ...]
    kinds: tuple[str, ...]
    unread: str
    _readers: tuple[Any, ...]
    _types: Any

    @property
    def names(self) -> tuple[str, ...]:
        """The topics wanted, as in the bag."""
        return self.topics.names

    def messages(self) -> Iterator[tuple[tuple[int, ...], bytes]]:
        """Numbers of the streams and undecoded message, in the order of recording.

        A topic with transforms of several targets is a stream of each.

        Raises:
            BrokenStorage: The storage is damaged here; nothing more can be read.
        """
        streams = {name: tuple(k for k, n in enumerate(self.names) if n == name) for name in self.names}
        for reader in self._readers:
            wanted = [c for c in reader.connections if c.topic in self.names]
            source = iter(reader.messages(wanted)) if wanted else iter(())
            while True:
                try:
                    connection, _, data = next(source)
                except StopIteration:
                    break
                except Exception as error:  # rosbags lets through what sqlite, zstd, lz4 and struct raise
                    raise BrokenStorage(reason(error)) from None
                yield streams[connection.topic], data

    def decode(self, stream: int, data: bytes) -> Any:
        """The message as an object with the fields of its type.

        Raises:
            BrokenStorage: These bytes are no such message.
        """
        try:
            return self._types.deserialize_cdr(data, self.kinds[stream])
        except Exception as error:
            raise BrokenStorage(reason(error)) from None

    def points(self, target: int, message: Any) -> list[Any]:
        """The points of a target, from 0, in a message of its stream."""
        child = self.topics.children[target] if self.topics.children else ""
        return points_in(self.kinds[len(self.topics.joints) + target], message, child)


@contextmanager
def open_bag(path: str | Path, topics: BagTopics) -> Iterator[Recording]:
    """Open a bag for reading the given topics.

    Raises:
        MissingExtraError: rosbags is not installed.
        FileFormatError: Not a bag, not readable, a topic missing or of another type.
    """
    reader_class, types = _rosbags()
    with ExitStack() as stack:
        readers = []
        for part in storage_parts(path):
            try:
                readers.append(stack.enter_context(reader_class(part)))
            except Exception as error:
                raise FileFormatError(part, "bag", reason(error), WHAT, REPAIR) from None
            for one in readers[-1].connections:
                if not (isinstance(one.topic, str) and isinstance(one.msgtype, str)):
                    got = f"a topic {brief(one.topic, 60)} of type {brief(one.msgtype, 60)}"
                    raise FileFormatError(part, "bag", got, "names that are texts", REPAIR)
        kinds = _kinds(path, readers, topics)
        promised = tuple(
            sum(c.msgcount for r in readers for c in r.connections if c.topic == name) for name in topics.names
        )
        yield Recording(topics, promised, kinds, _write_ahead(path), tuple(readers), types)


def storage_parts(path: str | Path) -> list[Path]:
    """What to open one after the other: the folder itself if it has metadata, else its storage files.

    Raises:
        FileFormatError: There is nothing of the kind.
    """
    place = user_path(path)
    place = place.parent if place.name == "metadata.yaml" else place
    try:
        if not place.is_dir():
            place.open("rb").close()
            if place.suffix in STORAGE:
                return [place]
            advice = "convert it with rosbags-convert" if place.suffix == ".bag" else "give the bag's folder"
            raise FileFormatError(path, "file", f"a file named {place.name}", WHAT, advice)
        files = sorted(p for p in place.iterdir())
    except OSError as error:
        raise FileFormatError(path, "file", error.strerror or error, WHAT, "check the path") from None
    if any(p.name == "metadata.yaml" for p in files):
        return [place]
    storage = sorted((p for p in files if p.suffix in STORAGE), key=_numbered)
    if storage:
        return storage
    inner = [p.name for p in files if (p / "metadata.yaml").is_file()]
    advice = f"give one of the folders in it: {_list(inner)}" if inner else "give the folder that ros2 bag wrote"
    raise FileFormatError(path, "folder", _list([p.name for p in files]), WHAT, advice)


def reason(error: BaseException) -> str:
    """What went wrong in one line, short; the kind of error where it has no text."""
    return cut(" ".join(str(error).split()), 300).rstrip(".") or type(error).__name__


def _rosbags() -> tuple[Any, Any]:
    """The class that reads bags, and the message types of Jazzy."""
    try:
        from rosbags.rosbag2 import Reader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise MissingExtraError("bags", "rosbags", "reading bags") from None
    return Reader, get_typestore(Stores.ROS2_JAZZY)


def _kinds(path: str | Path, readers: list[Any], topics: BagTopics) -> tuple[str, ...]:
    """The type of each topic's messages, which has to be one that holds what is needed."""
    types_of: dict[str, set[str]] = {}
    for connection in (c for r in readers for c in r.connections):
        types_of.setdefault(connection.topic, set()).add(connection.msgtype)
    described = _list([f"{t} ({', '.join(sorted(types_of[t]))})" for t in sorted(types_of)])
    names, wants = topics.names, [(JOINT_STATE,)] * len(topics.joints) + [tuple(POINTS)] * len(topics.points)
    for name, valid in zip(names, wants + [(STATE,)] * len(topics.states), strict=True):
        option = {JOINT_STATE: "--joint-topic", STATE: "--state-topic"}.get(valid[0], "--point-topic")
        fitting = [t for t in sorted(types_of) if len(types_of[t]) == 1 and types_of[t] <= {*valid}]
        wanted = " or ".join(valid)
        close = (get_close_matches(name, fitting, n=1, cutoff=0.3) or fitting)[:1]
        advice = f"is it {option} {close[0]}?" if close else f"record a topic of type {wanted}"
        if name not in types_of:
            got = f"a bag with {described}"
            raise FileFormatError(path, f"topic {name}", got, f"messages of {wanted}", advice)
        if name not in fitting:
            raise FileFormatError(path, f"topic {name}", ", ".join(sorted(types_of[name])), wanted, advice)
    kinds = tuple(next(iter(types_of[name])) for name in names)
    if TRANSFORMS in kinds and not topics.children:
        where, advice = f"topic {names[kinds.index(TRANSFORMS)]}", "name one per target with --child-frame"
        raise FileFormatError(
            path, where, "transforms of many frames", "the child_frame_id of the target", advice
        )
    return kinds


def _write_ahead(path: str | Path) -> str:
    """Names logs beside SQLite files that still hold messages: the recorder did not end properly."""
    place = user_path(path)
    logs = [place.with_name(place.name + "-wal")] if place.is_file() else sorted(place.glob("*.db3-wal"))
    full = [p.name for p in logs if p.is_file() and p.stat().st_size]
    return f"{_list(full)} holds messages not yet in the .db3 file (open that once with sqlite3)" if full else ""


def _numbered(path: Path) -> list[Any]:
    """Sorts bag_10 after bag_9."""
    words = re.split(r"([0-9]+)", path.name)
    return [int(w) if i % 2 else w for i, w in enumerate(words)]


def _list(names: list[str]) -> str:
    return listed(names, 20, width=200, none="nothing")
