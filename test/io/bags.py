# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags for tests: a simulated robot that moves and rests before a tracker, written with rosbags' own writer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from calib_planner import Robot
from calib_planner.simulation import SimulatedCell, make_tour, random_deviations

NANO = 1_000_000_000
BEGIN = 1_700_000_000 * NANO
TYPES = get_typestore(Stores.ROS2_JAZZY)
T: Any = TYPES.types
JOINTS, POINT = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PointStamped"
POSE, TRANSFORM = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TransformStamped"
TRANSFORMS, STATE = "tf2_msgs/msg/TFMessage", "std_msgs/msg/Bool"


@dataclass(frozen=True, eq=False)
class Said:
    """A message before it is one: when it arrived and what it says. Stream 0: joints, from 1: targets."""

    arrival: int
    stream: int
    stamp: int
    values: np.ndarray
    names: tuple[str, ...] = ()
    extra: dict[str, Any] = field(default_factory=dict)


def campaign(
    cell: SimulatedCell,
    configurations: np.ndarray,
    repetitions: Sequence[int] | int = 1,
    seed: int = 0,
    dwell: float = 0.8,
    rates: tuple[float, float] = (100.0, 50.0),
    delay: float = 0.02,
) -> list[Said]:
    """Visits the configurations; messages arrive up to ``delay`` [s] after their stamps, so in some disorder."""
    robot, rng = cell.nominal, np.random.default_rng(seed)
    counts = np.broadcast_to(np.asarray(repetitions), len(configurations))
    tour = make_tour(np.zeros(len(robot.joint_names)), configurations, counts, robot.joint_limits, 4.0, dwell)
    said = []
    for stream in range(1 + len(robot.targets)):
        rate = rates[min(stream, 1)]
        times = (np.arange(int(tour.seconds * rate)) + 0.13 * stream) / rate
        q = np.array([tour.at(t).joints(t) for t in times])
        points = cell.truth.positions(q)[:, stream - 1] + cell.sigma * rng.standard_normal((len(q), 3))
        for t, joints, xyz in zip(times, q, points, strict=True):
            stamp = BEGIN + round(t * NANO)
            arrival = stamp + round(rng.uniform(0, delay) * NANO)
            said.append(Said(arrival, stream, stamp, xyz if stream else joints, robot.joint_names))
    return sorted(said, key=lambda m: m.arrival)


def message(said: Said) -> Any:
    """The ROS message; ``extra`` may set ``frame_id``, ``kind`` of streams from 1, ``child`` of transforms."""
    time = T["builtin_interfaces/msg/Time"](sec=said.stamp // NANO, nanosec=said.stamp % NANO)
    header = T["std_msgs/msg/Header"](stamp=time, frame_id=said.extra.get("frame_id", "tracker"))
    kind = said.extra.get("kind", POINT)
    if kind == STATE:
        return T[STATE](bool(said.values[0]))
    xyz, turned = [float(v) for v in said.values[:3]], T["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.6, 0.8)
    if said.stream and kind == POSE:
        pose = T["geometry_msgs/msg/Pose"](T["geometry_msgs/msg/Point"](*xyz), turned)
        return T[POSE](header, pose)
    if said.stream and kind in (TRANSFORM, TRANSFORMS):
        at = T["geometry_msgs/msg/Vector3"]
        one = T[TRANSFORM](
            header, said.extra.get("child", "reflector"), T["geometry_msgs/msg/Transform"](at(*xyz), turned)
        )
        if kind == TRANSFORM:
            return one
        away = T["geometry_msgs/msg/Transform"](at(1.0, 2.0, 3.0), turned)
        return T[TRANSFORMS]([T[TRANSFORM](header, "other", away), one])
    if said.stream and kind != JOINTS:
        return T[POINT](header=header, point=T["geometry_msgs/msg/Point"](*map(float, said.values)))
    none, position = np.empty(0), np.asarray(said.values, float)
    return T[JOINTS](header, list(said.names), position, said.extra.get("velocity", none), none)


def write_bag(
    path: Path,
    said: Iterable[Said],
    topics: Sequence[str] = ("/joint_states", "/tracker/point"),
    plugin: str = "SQLITE3",
    compression: str = "NONE",
    types: Sequence[str] | None = None,
) -> Path:
    """Write a bag folder; ``types`` replaces the topics' types, whatever is written."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[plugin])
    writer.set_compression(CompressionMode[compression], CompressionFormat.ZSTD)
    kinds = types or [POINT if k else JOINTS for k in range(len(topics))]
    with writer:
        to = [writer.add_connection(t, k, typestore=TYPES) for t, k in zip(topics, kinds, strict=True)]
        other = writer.add_connection("/rosout_text", "std_msgs/msg/String", typestore=TYPES)
        for one in said:
            kind = one.extra.get("kind", POINT) if one.stream else JOINTS
            data = TYPES.serialize_cdr(message(one), kind)
            writer.write(to[one.stream], one.arrival, data)
            if one.arrival % 7 == 0:
                text = TYPES.serialize_cdr(T["std_msgs/msg/String"]("noise"), "std_msgs/msg/String")
                writer.write(other, one.arrival, text)
    return path


def without_metadata(bag: Path) -> Path:
    """The bag as a recorder leaves it that never ended."""
    (bag / "metadata.yaml").unlink()
    return bag


def robot_of(name: str, targets: int = 1) -> Robot:
    """A shipped robot with its own reflector, or with ``targets`` around its tip."""
    robot = Robot.load(name)
    if targets == 1:
        return robot
    return robot.with_targets(0.1 * np.random.default_rng(5).standard_normal((targets, 3)))


PLANAR = robot_of("planar_2r")
CELL = SimulatedCell(PLANAR, random_deviations(PLANAR, 1))
STOPS = np.array([[0.5, 1.0], [-1.0, 0.4], [0.5, 1.0], [0.2, -1.2]])
SAID = campaign(CELL, STOPS)
