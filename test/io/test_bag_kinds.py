# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags as drivers write them: poses and transforms, joints in parts, millimetres and degrees."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")

from bags import (
    JOINTS,
    NANO,
    PLANAR,
    POINT,
    POSE,
    SAID,
    STATE,
    STOPS,
    TRANSFORM,
    TRANSFORMS,
    Said,
    robot_of,
    write_bag,
)

from calib_planner import FileFormatError
from calib_planner.acquisition import RejectionReason
from calib_planner.io import BagTopics, Reading, read_bag, read_data
from calib_planner.units import Units


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[np.ndarray, np.ndarray]:
    """Joints and points of the bag as ROS has it."""
    data = read_bag(write_bag(tmp_path_factory.mktemp("bag") / "plain", SAID), PLANAR).data
    return data.q, data.p


@pytest.mark.parametrize("kind", [POSE, TRANSFORM])
def test_poses_and_transforms_are_points(tmp_path: Path, kind: str, plain: tuple[np.ndarray, np.ndarray]) -> None:
    said = [replace(m, extra={"kind": kind}) if m.stream else m for m in SAID]
    bag = read_bag(write_bag(tmp_path / "bag", said, types=(JOINTS, kind)), PLANAR)
    assert bag.data.q.tobytes() == plain[0].tobytes() and bag.data.p.tobytes() == plain[1].tobytes()


def scaled(said: Said, joints: float, points: float) -> Said:
    return replace(said, values=np.asarray(said.values) * (points if said.stream else joints))


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize(("length", "metre"), [("m", 1.0), ("mm", 1e3)])
@pytest.mark.parametrize(("angle", "radian"), [("rad", 1.0), ("deg", np.rad2deg(1.0))])
def test_units_are_told_by_size_or_stated(
    tmp_path: Path,
    length: str,
    metre: float,
    angle: str,
    radian: float,
    stated: bool,
    plain: tuple[np.ndarray, np.ndarray],
) -> None:
    path = write_bag(tmp_path / "bag", [scaled(m, radian, metre) for m in SAID])
    told: list[str] = []
    units = Units(length, angle) if stated else Units()
    source = read_data(path, PLANAR, Reading(units=units, note=told.append))
    np.testing.assert_allclose(source.data.q, plain[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(source.data.p, plain[1], rtol=0, atol=1e-12)
    assert source.understanding.units == Units(length, angle)
    odd = (length, angle) != ("m", "rad")
    assert any(f"messages in {length} and {angle}" in line for line in told) == odd


def in_parts(said: list[Said], lag: int = 0) -> list[Said]:
    """Each joint in a message of its own, the second ``lag`` [ns] later."""
    parts = []
    for m in said:
        if m.stream:
            parts.append(m)
            continue
        parts.append(replace(m, names=m.names[:1], values=m.values[:1]))
        late = {"arrival": m.arrival + lag, "stamp": m.stamp + lag}
        parts.append(replace(m, names=("gripper", *m.names[1:]), values=np.array([0.1, *m.values[1:]]), **late))
    return sorted(parts, key=lambda m: m.arrival)


@pytest.mark.parametrize("lag", [0, NANO // 250])
def test_joint_states_in_parts_are_put_together(tmp_path: Path, lag: int) -> None:
    bag = read_bag(write_bag(tmp_path / "bag", in_parts(SAID, lag)), PLANAR)
    np.testing.assert_allclose(bag.data.q, STOPS, atol=1e-4)
    whole = read_bag(write_bag(tmp_path / "whole", SAID), PLANAR)
    np.testing.assert_allclose(bag.data.p, whole.data.p, rtol=0, atol=3e-5)
    assert bag.streams[0].left_out == {}


RAIL_AND_ARM = BagTopics(("rail/joint_states", "arm/joint_states"), ("tracker/point",))
TOPICS = ("/rail/joint_states", "/arm/joint_states", "/tracker/point")


def on_two_topics(every: int) -> list[Said]:
    """Joint 1 on a topic of its own, of which one message in so many comes; joint 2 on another one."""
    said, count = [], 0
    for m in SAID:
        if m.stream:
            said.append(replace(m, stream=2))
            continue
        said.append(replace(m, stream=1, names=m.names[1:], values=m.values[1:], extra={"kind": JOINTS}))
        if count % every == 0:
            said.append(replace(m, names=m.names[:1], values=m.values[:1]))
        count += 1
    return said


@pytest.mark.parametrize("every", [1, 7, 20])  # of 100 Hz
def test_joints_on_two_topics_are_one_robot(tmp_path: Path, every: int) -> None:
    path = write_bag(tmp_path / "bag", on_two_topics(every), TOPICS, types=(JOINTS, JOINTS, POINT))
    bag = read_bag(path, PLANAR, RAIL_AND_ARM)
    np.testing.assert_allclose(bag.data.q, STOPS, atol=1e-4)
    whole = read_bag(write_bag(tmp_path / "whole", SAID), PLANAR)
    np.testing.assert_allclose(bag.data.p, whole.data.p, rtol=0, atol=3e-5)
    assert [s.left_out for s in bag.streams] == [{}, {}, {}] and bag.rejections == ()
    with pytest.raises(FileFormatError, match="topics that position q1"):
        read_bag(path, PLANAR, BagTopics("arm/joint_states"))


def test_parts_that_never_become_whole_are_refused(tmp_path: Path) -> None:
    said = [m if m.stream else replace(m, names=m.names[:1], values=m.values[:1]) for m in SAID]
    with pytest.raises(FileFormatError, match="without the robot's joints"):
        read_bag(write_bag(tmp_path / "bag", said), PLANAR)


def test_a_target_among_the_transforms_of_tf(tmp_path: Path, plain: tuple[np.ndarray, np.ndarray]) -> None:
    said = [replace(m, extra={"kind": TRANSFORMS}) if m.stream else m for m in SAID]
    path = write_bag(tmp_path / "bag", said, ("/joint_states", "/tf"), types=(JOINTS, TRANSFORMS))
    bag = read_bag(path, PLANAR, BagTopics(points=("tf",), children=("reflector",)))
    assert bag.data.q.tobytes() == plain[0].tobytes() and bag.data.p.tobytes() == plain[1].tobytes()
    with pytest.raises(FileFormatError, match="child_frame_id"):
        read_bag(path, PLANAR, BagTopics(points=("tf",)))
    both = BagTopics(points=("tf", "tf"), children=("reflector", "other"))
    twice = read_bag(path, robot_of("planar_2r", 2), both)
    assert (twice.standstills[0].samples > 0).all() and len(twice.standstills) == len(STOPS)


@pytest.mark.parametrize("child", ["", "reflector"])
def test_transforms_of_two_bodies_on_one_topic_are_not_one_target(tmp_path: Path, child: str) -> None:
    said = [m if not m.stream else replace(m, extra={"kind": TRANSFORM}) for m in SAID]
    mixed = [replace(m, extra=m.extra | {"child": "other"}) if i % 9 == 8 else m for i, m in enumerate(said)]
    path = write_bag(tmp_path / "bag", mixed, types=(JOINTS, TRANSFORM))
    with pytest.raises(FileFormatError, match="child_frame_id 'other', the target is 'reflector'"):
        read_bag(path, PLANAR, BagTopics(children=(child,) if child else ()))


def test_points_while_the_tracker_says_that_it_lost_the_target_do_not_count(tmp_path: Path) -> None:
    """It is lost in the second standstill, and its points are those of a robot that never left the first one."""
    stops = read_bag(write_bag(tmp_path / "whole", SAID), PLANAR).standstills
    begin, end = stops[0].end + NANO // 10, stops[1].end + NANO // 10
    stale = next(m.values for m in SAID if m.stream and m.stamp > stops[0].start)
    said = [replace(m, values=stale) if m.stream and begin < m.stamp < end else m for m in SAID]
    told = [Said(t, 2, t, np.array([k]), extra={"kind": STATE}) for k, t in ((1, 1), (0, begin), (1, end))]
    both = sorted(said + told, key=lambda m: m.arrival)
    topics = ("/joint_states", "/tracker/point", "/tracker/locked")
    path = write_bag(tmp_path / "bag", both, topics, types=(JOINTS, POINT, STATE))
    bag = read_bag(path, PLANAR, BagTopics(states=("tracker/locked",)))
    np.testing.assert_allclose(bag.data.q, np.delete(STOPS, 1, axis=0), atol=1e-4)
    assert [r.reason for r in bag.rejections] == [RejectionReason.TARGET_LOST]
    assert bag.streams[1].left_out["while the target was lost"] > 10
    unaware = read_bag(path, PLANAR)
    assert len(unaware.standstills) == len(STOPS)  # of which one is wrong
