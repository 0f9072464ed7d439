"""Bags as drivers write them: poses and transforms, joints in parts, millimetres and degrees."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")

from bags import JOINTS, NANO, PLANAR, POSE, SAID, STOPS, TRANSFORM, Said, write_bag

from calib_planner import FileFormatError
from calib_planner.acquisition import JointReader
from calib_planner.errors import UnknownNameError
from calib_planner.io import Reading, read_bag, read_data
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
    assert bag.streams[0].left_out.get("without the robot's joints", 0) <= 1  # before the first whole one


def test_parts_that_never_become_whole_are_refused(tmp_path: Path) -> None:
    said = [m if m.stream else replace(m, names=m.names[:1], values=m.values[:1]) for m in SAID]
    with pytest.raises(FileFormatError, match="without the robot's joints"):
        read_bag(write_bag(tmp_path / "bag", said), PLANAR)


class State:
    """A joint state as far as the reader looks."""

    def __init__(self, stamp: float, **positions: float) -> None:
        self.name, self.position = list(positions), list(positions.values())
        seconds = int(stamp)
        time = type("Time", (), {"sec": seconds, "nanosec": round((stamp - seconds) * NANO)})
        self.header = type("Header", (), {"stamp": time})


def test_parts_belong_together_only_if_they_are_of_one_time() -> None:
    reader = JointReader(("a", "b", "c"))
    with pytest.raises(UnknownNameError):
        reader.read(State(1.0, a=1.0))
    with pytest.raises(UnknownNameError):
        reader.read(State(1.01, b=2.0))
    assert reader.read(State(1.02, c=3.0, z=9.0)).tolist() == [1.0, 2.0, 3.0]
    assert reader.read(State(1.03, a=1.5)) is None
    assert reader.read(State(1.04, c=3.5)) is None
    assert reader.read(State(1.05, b=2.5)).tolist() == [1.5, 2.5, 3.5]
    with pytest.raises(UnknownNameError, match="'a'"):  # that of a is from long before
        reader.read(State(2.0, b=2.5))
    assert reader.read(State(2.1, c=1.0, b=2.0, a=3.0)).tolist() == [3.0, 2.0, 1.0]
    with pytest.raises(UnknownNameError):
        reader.read(State(2.2, z=1.0))
