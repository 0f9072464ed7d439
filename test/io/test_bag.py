# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags: what is read is what the live node would have measured, however the bag is named and written."""

from __future__ import annotations

import shutil
import sqlite3
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags")

from bags import (
    BEGIN,
    CELL,
    JOINTS,
    NANO,
    PLANAR,
    POINT,
    SAID,
    STOPS,
    TYPES,
    Said,
    campaign,
    message,
    robot_of,
    without_metadata,
    write_bag,
)
from robots import random_configurations
from rosbags.rosbag2 import StoragePlugin, Writer

from calib_planner import IdentificationProblem, identify
from calib_planner.acquisition import Rejection, Standstill, StandstillDetector, StandstillSettings
from calib_planner.errors import FileFormatError, InputError
from calib_planner.io import BagTopics, Reading, StoredModel, is_bag, open_store, read_bag, read_sources
from calib_planner.io.bag import storage_parts
from calib_planner.ros.session import Matching, Session
from calib_planner.simulation import SimulatedCell, random_deviations

KINDS = [("SQLITE3", "NONE"), ("SQLITE3", "MESSAGE"), ("SQLITE3", "FILE")]
KINDS += [("MCAP", "NONE"), ("MCAP", "MESSAGE"), ("MCAP", "FILE"), ("MCAP", "STORAGE")]


def as_the_node_does(said: list[Said], targets: int = 1) -> list[Standstill | Rejection]:
    """The detector fed by hand, as ``IdentifierNode`` feeds it, in the order of arrival."""
    joints = len(said[0].values) if not said[0].stream else 2
    detector = StandstillDetector(joints, targets)
    found = []
    for m in said:
        add = detector.add_joints
        found += detector.add_point(m.stream - 1, m.stamp, m.values) if m.stream else add(m.stamp, m.values)
    return found + detector.flush()


@pytest.mark.parametrize(("plugin", "compression"), KINDS)
def test_a_bag_gives_what_the_node_gives(tmp_path: Path, plugin: str, compression: str) -> None:
    path = write_bag(tmp_path / "bag", SAID, plugin=plugin, compression=compression)
    found = read_bag(path, PLANAR)
    expected = [s for s in as_the_node_does(SAID) if isinstance(s, Standstill)]
    assert len(found.data) == len(expected) == len(STOPS)
    for row, (mine, node) in enumerate(zip(found.standstills, expected, strict=True)):
        assert (mine.start, mine.end) == (node.start, node.end)
        assert mine.joints.tobytes() == node.joints.tobytes() == found.data.q[row].tobytes()
        assert mine.points.tobytes() == node.points.tobytes() == found.data.p[row].tobytes()
    model = StoredModel(PLANAR.name, PLANAR.joint_names, len(PLANAR.targets), "")
    live = Session(PLANAR, lambda _: PLANAR, open_store("", model, {}, ""))
    how = Matching(accept_unplanned=True, sigma=0.0)
    for node in expected:
        live.take(node, how)
    by_node = live.measurements(how)
    assert by_node is not None
    np.testing.assert_array_equal(np.asarray(found.data.std), np.asarray(by_node.std))
    assert [s.messages for s in found.streams] == [sum(m.stream == k for m in SAID) for k in (0, 1)]
    assert found.frame_id == "tracker" and found.damage == "" and found.rejections == ()
    assert found.stamps.tolist() == sorted(found.stamps) and (found.stamps > BEGIN).all()


def test_the_simulated_robot_is_recovered(tmp_path: Path) -> None:
    robot = robot_of("kuka_kr270")
    cell = SimulatedCell(robot, random_deviations(robot, 3))
    said = campaign(cell, random_configurations(robot, 14, 2), seed=4)
    found = read_bag(write_bag(tmp_path / "bag", said, plugin="MCAP"), robot)
    estimate = identify(IdentificationProblem(robot, found.data))
    true = np.array([cell.deviations[n] for n in estimate.fit.parameters])
    off = (np.asarray(estimate.fit.deviations) - true) / np.asarray(estimate.fit.std)
    assert np.abs(off).max() < 5 and np.abs(true).max() > 1e-4
    expected = cell.sigma / np.sqrt(np.array([s.samples for s in found.standstills]))
    np.testing.assert_allclose(np.asarray(found.data.std)[:, :, 0], expected, rtol=0.15)


def test_repeated_standstills_stay_rows_of_their_own(tmp_path: Path) -> None:
    said = campaign(CELL, STOPS[:2], repetitions=[3, 2])
    data = read_bag(write_bag(tmp_path / "bag", said), PLANAR).data
    np.testing.assert_allclose(data.q, np.repeat(STOPS[:2], [3, 2], axis=0), atol=1e-4)
    assert len(np.unique(data.p[:3, 0, 0])) == 3


def test_a_recording_of_a_recording_played_twice_counts_once(tmp_path: Path) -> None:
    """Also where it was played from its middle."""
    said = list(SAID)
    late = max(m.arrival for m in said) + NANO
    from_its_middle = [replace(m, arrival=m.arrival + late - BEGIN) for m in said if m.stamp > BEGIN + 3 * NANO]
    twice = read_bag(write_bag(tmp_path / "twice", [*said, *from_its_middle]), PLANAR)
    once = read_bag(write_bag(tmp_path / "once", said), PLANAR)
    np.testing.assert_array_equal(twice.data.p, once.data.p)
    assert any("recorded twice, which count once" in line for line in twice.describe())
    assert not any("twice, which" in line for line in once.describe())


def test_standstills_that_two_bags_share_count_once(tmp_path: Path) -> None:
    """The second bag begins within the second standstill, the first ends before the fourth."""
    said, notes = list(SAID), list[str]()
    whole = read_bag(write_bag(tmp_path / "whole", said), PLANAR)
    stops = whole.standstills
    first = [m for m in said if m.stamp < stops[3].start - NANO // 5]
    paths = [
        str(write_bag(tmp_path / "first", first)),
        str(write_bag(tmp_path / "second", [m for m in said if m.stamp > stops[1].start])),
    ]
    reading = Reading(note=notes.append)
    together = read_sources(paths, PLANAR, reading, noise_given=True)
    assert any("2 standstills that a bag before has, which count once" in note for note in notes)
    np.testing.assert_allclose(together.data.q, whole.data.q, atol=1e-4)
    assert together.where(3) == f"standstill 3 of {paths[1]}"
    copy = str(write_bag(tmp_path / "copy", first))
    with pytest.raises(FileFormatError, match="a copy is no measurement"):
        read_sources([paths[0], copy], PLANAR, reading, noise_given=True)


def test_two_targets_on_topics_of_any_name(tmp_path: Path) -> None:
    robot = robot_of("planar_2r", targets=2)
    cell = SimulatedCell(robot, {})
    names = ("/cell/joints", "/laser/b", "/laser/a")
    path = write_bag(tmp_path / "bag", campaign(cell, STOPS[:2]), names)
    data = read_bag(path, robot, BagTopics("cell/joints", ("laser/b", "/laser/a"))).data
    np.testing.assert_allclose(data.p, robot.positions(STOPS[:2]), atol=1e-4)
    swapped = read_bag(path, robot, BagTopics("cell/joints", ("laser/a", "laser/b"))).data
    np.testing.assert_array_equal(swapped.p, data.p[:, ::-1])


def test_a_target_not_seen_is_nan(tmp_path: Path) -> None:
    robot = robot_of("planar_2r", targets=2)
    half = BEGIN + 2 * NANO
    said = [m for m in campaign(SimulatedCell(robot, {}), STOPS, dwell=3.0) if m.stream < 2 or m.stamp < half]
    path = write_bag(tmp_path / "bag", said, ("/joint_states", "/a", "/b"))
    found = read_bag(path, robot, BagTopics(points=("a", "b")))
    assert found.data.seen.tolist() == [[True, True], *[[True, False]] * 3]


def dressed(m: Said) -> Said:
    """Joints backwards, a gripper between, velocities NaN."""
    if m.stream:
        return m
    values = np.array([m.values[1], 0.01, m.values[0]])
    return replace(m, values=values, names=("q2", "finger", "q1"), extra={"velocity": np.full(3, np.nan)})


def test_joint_order_strangers_and_velocities_do_not_matter(tmp_path: Path) -> None:
    plain = read_bag(write_bag(tmp_path / "a", SAID), PLANAR).data
    other = read_bag(write_bag(tmp_path / "b", map(dressed, SAID)), PLANAR).data
    assert plain.q.tobytes() == other.q.tobytes() and plain.p.tobytes() == other.p.tobytes()


def test_a_gripper_on_the_same_topic_is_counted_not_used(tmp_path: Path) -> None:
    gripper = [replace(m, arrival=m.arrival + 1, names=("a", "b")) for m in SAID if m.stream == 0]
    found = read_bag(write_bag(tmp_path / "bag", sorted(SAID + gripper, key=lambda m: m.arrival)), PLANAR)
    assert len(found.data) == len(STOPS)
    assert found.streams[0].left_out == {"without the robot's joints": len(gripper)}
    assert found.streams[0].example == "it names a, b"


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_only_stamps_count_not_arrival(tmp_path: Path, plugin: str) -> None:
    rng = np.random.default_rng(0)
    shuffled = [replace(m, arrival=m.stamp + round(rng.uniform(0, 0.08) * NANO)) for m in SAID]
    shuffled.sort(key=lambda m: m.arrival)
    assert [m.stamp for m in shuffled if not m.stream] != sorted(m.stamp for m in SAID if not m.stream)
    plain = read_bag(write_bag(tmp_path / "a", SAID, plugin=plugin), PLANAR)
    # the recorder's clock is an hour off, and its messages are written in no order at all
    shuffled = [replace(m, arrival=m.arrival - 3600 * NANO) for m in shuffled]
    late = read_bag(write_bag(tmp_path / "b", shuffled, plugin=plugin), PLANAR)
    assert late.data.p.tobytes() == plain.data.p.tobytes() and late.data.q.tobytes() == plain.data.q.tobytes()


def test_messages_that_take_no_part_are_counted(tmp_path: Path) -> None:
    odd = list(SAID)
    points = [i for i, m in enumerate(odd) if m.stream]
    for i in points[10:40:10]:
        odd[i] = replace(odd[i], values=np.full(3, np.nan))
    for i in points[45:49:2]:
        odd[i] = replace(odd[i], stamp=0)
    late = replace(odd[points[5]], arrival=odd[points[90]].arrival + 1)
    twice = replace(odd[points[60]], arrival=odd[points[60]].arrival + 1)
    odd = sorted([*odd, late, twice], key=lambda m: m.arrival)
    found = read_bag(write_bag(tmp_path / "bag", odd), PLANAR)
    assert found.streams[1].left_out == {"not finite": 3, "without a stamp": 2, "too late or twice": 2}
    assert len(found.data) == len(STOPS)
    text = "\n".join(found.describe())
    assert "4 standstills in frame tracker" in text and "3 not finite" in text


def test_rejections_say_why(tmp_path: Path) -> None:
    end = next(m.stamp for m in SAID if m.stream == 0 and np.allclose(m.values, STOPS[0])) + NANO
    shaken = [
        replace(m, values=m.values + 1e-3 * np.sin(m.stamp * 2e-8)) if m.stream and m.stamp < end else m
        for m in SAID
    ]
    found = read_bag(write_bag(tmp_path / "bag", shaken), PLANAR)
    assert len(found.data) == len(STOPS) - 1
    assert [r.reason.value for r in found.rejections] == ["moved"]
    assert any("1 rejected as moved (target 1 moved by" in line for line in found.describe())


def test_settings_noise_and_progress_are_passed_on(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", SAID)
    shares: list[float] = []
    settings = StandstillSettings(samples=10, duration=0.2)
    found = read_bag(
        path, PLANAR, settings=settings, sigma=1e-4, repeatability=5e-5, progress=lambda s, _: shares.append(s)
    )
    n = found.standstills[0].samples[0]
    assert 10 <= n < 20
    assert np.asarray(found.data.std)[0, 0, 0] == pytest.approx(np.sqrt(1e-8 / n + 25e-10))
    assert shares == sorted(shares) and all(0 < s <= 1 for s in shares)


def test_results_are_immutable(tmp_path: Path) -> None:
    found = read_bag(write_bag(tmp_path / "bag", SAID), PLANAR)
    with pytest.raises(AttributeError):
        found.damage = "none"  # type: ignore[misc]
    with pytest.raises(ValueError):
        found.stamps[0] = 0


# ── ways to name a bag ───────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_folder_storage_file_metadata_and_no_metadata(tmp_path: Path, plugin: str) -> None:
    bag = write_bag(tmp_path / "bag", SAID, plugin=plugin)
    whole = read_bag(bag, PLANAR)
    (storage,) = (p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))
    ways = [storage, bag / "metadata.yaml", bag]
    for way in ways:
        assert is_bag(way)
        assert read_bag(way, PLANAR).data.p.tobytes() == whole.data.p.tobytes()
    assert read_bag(without_metadata(bag), PLANAR).data.p.tobytes() == whole.data.p.tobytes()


def test_split_files_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    step = -(-len(SAID) // 12)
    for k in range(12):
        part = write_bag(tmp_path / f"part{k}", SAID[k * step : (k + 1) * step])
        shutil.copy(part / f"part{k}.db3", folder / f"split_{k}.db3")
    assert [p.stem for p in storage_parts(folder)] == [f"split_{k}" for k in range(12)]
    found = read_bag(folder, PLANAR)
    np.testing.assert_array_equal(found.data.p, read_bag(write_bag(tmp_path / "one", SAID), PLANAR).data.p)


def test_definitions_in_the_bag_are_not_needed(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", SAID)
    with sqlite3.connect(bag / "bag.db3") as base:
        base.execute("DELETE FROM message_definitions")
        base.execute("UPDATE schema SET schema_version = 3")
    base.close()
    assert len(read_bag(bag, PLANAR).data) == len(STOPS)


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_a_large_bag_is_read_as_a_stream(tmp_path: Path, plugin: str) -> None:
    path, blob = tmp_path / "bag", TYPES.types["std_msgs/msg/String"]("x" * 2_000_000)
    write_bag(tmp_path / "small", SAID)
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[plugin])
    with writer:
        to = [
            writer.add_connection(t, k, typestore=TYPES)
            for t, k in zip(("/joint_states", "/tracker/point"), (JOINTS, POINT), strict=True)
        ]
        camera = writer.add_connection("/camera", "std_msgs/msg/String", typestore=TYPES)
        picture = TYPES.serialize_cdr(blob, "std_msgs/msg/String")
        for i, one in enumerate(SAID):
            kind = POINT if one.stream else JOINTS
            writer.write(to[one.stream], one.arrival, TYPES.serialize_cdr(message(one), kind))
            if i % 50 == 0:
                writer.write(camera, one.arrival, picture)
    size = sum(p.stat().st_size for p in path.iterdir())
    read_bag(tmp_path / "small", PLANAR)  # what rosbags compiles on first use
    tracemalloc.start()
    found = read_bag(path, PLANAR)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(found.data) == len(STOPS) and size > 25e6 and peak < size / 2


@pytest.mark.parametrize(
    ("topics", "field"),
    [
        ({"points": ()}, "topics"),
        ({"points": ("p", "/p")}, "topics"),
        ({"points": ("p", "q"), "children": ("ball",)}, "children"),
        ({"points": ("p", "q"), "states": ("a", "b", "c")}, "states"),
    ],
)
def test_topics_that_are_not_one_per_target_are_refused(topics: dict[str, tuple[str, ...]], field: str) -> None:
    with pytest.raises(InputError) as caught:
        BagTopics(**topics)
    assert caught.value.field == field
