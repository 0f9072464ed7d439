# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Bags that are flawed, damaged or none at all: every flaw is named, what can be kept is kept."""

from __future__ import annotations

import builtins
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from robots import repeats

pytest.importorskip("rosbags")

from bags import BEGIN, CELL, NANO, PLANAR, SAID, STOPS, TYPES, campaign, write_bag
from rosbags.rosbag2 import StoragePlugin, Writer

from calib_planner import CalibPlannerError, FileFormatError, InputError
from calib_planner.errors import MissingExtraError
from calib_planner.io import BagTopics, read_bag

# ── flaws ────────────────────────────────────────────────────────────────────────────────────────────

ZEROS = [replace(m, stamp=0) if m.stream else m for m in SAID]
BOOT = [replace(m, stamp=m.stamp - BEGIN + NANO) if m.stream else m for m in SAID]
FLAWS: dict[str, tuple[dict, BagTopics, list[str]]] = {
    "no joints": (
        {"said": SAID, "topics": ("/robot/joint_states", "/tracker/point")},
        BagTopics(),
        ["topic /joint_states", "/robot/joint_states (sensor_msgs/msg/JointState)", "is it --joint-topic /robot"],
    ),
    "no points": (
        {"said": SAID, "topics": ("/joint_states", "/leica/point")},
        BagTopics(),
        ["topic /tracker/point", "/leica/point (geometry_msgs/msg/PointStamped)", "--point-topic /leica/point?"],
    ),
    "other type": (
        {"said": SAID, "types": ("sensor_msgs/msg/JointState", "geometry_msgs/msg/Vector3Stamped")},
        BagTopics(),
        ["topic /tracker/point", "got geometry_msgs/msg/Vector3Stamped", "record a topic of type"],
    ),
    "joints where points are": (
        {"said": SAID},
        BagTopics(joints="tracker/point", points=("joint_states",)),
        ["topic /tracker/point", "expected sensor_msgs/msg/JointState", "--joint-topic /joint_states"],
    ),
    "topic without messages": (
        {"said": [m for m in SAID if not m.stream]},
        BagTopics(),
        ["topic /tracker/point", "no messages"],
    ),
    "no messages at all": ({"said": []}, BagTopics(), ["topic /joint_states", "no messages"]),
    "other joints": (
        {"said": [replace(m, names=("shoulder", "elbow")) for m in SAID]},
        BagTopics(),
        ["topic /joint_states", "without the robot's joints", "shoulder, elbow", "q1, q2"],
    ),
    "positions missing": (
        {"said": [m if m.stream else replace(m, values=np.empty(0)) for m in SAID]},
        BagTopics(),
        ["topic /joint_states", "0 positions for 2 names"],
    ),
    "stamps of zero": ({"said": ZEROS}, BagTopics(), ["topic /tracker/point", "without a stamp", "header.stamp"]),
    "points all NaN": (
        {"said": [replace(m, values=m.values * np.nan) if m.stream else m for m in SAID]},
        BagTopics(),
        ["topic /tracker/point", "not finite", "line of sight"],
    ),
    "clocks apart": (
        {"said": BOOT},
        BagTopics(),
        ["header stamps", "/joint_states from 1700000000.000 s", "/tracker/point from 1.0", "synchronise"],
    ),
    "two frames": (
        {"said": [replace(m, extra={"frame_id": f"station_{i > 900}"}) for i, m in enumerate(SAID)]},
        BagTopics(),
        ["frame_id 'station_True'", "are in 'station_False'", "one frame"],
    ),
    "never at rest": (
        {"said": [m if m.stream else replace(m, values=m.values + m.stamp % 97 * 1e-4) for m in SAID]},
        BagTopics(),
        ["standstills", "joint_tolerance", "noise of the encoders"],
    ),
    "too few points": (
        {"said": [m for i, m in enumerate(SAID) if not m.stream or i % 40 == 0]},
        BagTopics(),
        ["standstills", "rejected as too_few_samples", "check the tracker"],
    ),
}


@pytest.mark.parametrize("case", FLAWS)
@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_flaws_are_named(tmp_path: Path, case: str, plugin: str) -> None:
    content, topics, words = FLAWS[case]
    path = write_bag(tmp_path / "bag", plugin=plugin, **content)
    with pytest.raises(FileFormatError) as caught:
        read_bag(path, PLANAR, topics)
    text = str(caught.value)
    assert str(path) in text and "\n" not in text and len(text) < 1500
    assert [w for w in words if w not in text] == [], text


def test_many_topics_are_not_all_listed(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        for k in range(500):
            writer.add_connection(f"/camera/{k}", "std_msgs/msg/String", typestore=TYPES)
    with pytest.raises(FileFormatError, match="and 480 more") as caught:
        read_bag(tmp_path / "bag", PLANAR)
    assert len(str(caught.value)) < 2000


@pytest.mark.parametrize(
    "topics", [("a", ("a",)), ("a", ()), ("", ("b",)), ("a", ("b", "/b")), ("a", ("/",))], ids=str
)
def test_topics_are_checked(topics: tuple) -> None:
    with pytest.raises(InputError, match="one per target, each once"):
        BagTopics(*topics)


@pytest.mark.parametrize("value", [-1.0, float("nan")])
def test_noise_is_checked(tmp_path: Path, value: float) -> None:
    with pytest.raises(InputError, match="sigma"):
        read_bag(tmp_path, PLANAR, sigma=value)


def test_without_rosbags_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def blocked(name: str, *args: object, **kwargs: object) -> object:
        if name.startswith("rosbags"):
            raise ModuleNotFoundError(name)
        return real(name, *args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(builtins, "__import__", blocked)
    with pytest.raises(MissingExtraError) as caught:
        read_bag(tmp_path, PLANAR)
    assert str(caught.value).endswith("pip install 'calib_planner[bags]'")


def folder_of_bags(path: Path) -> Path:
    (path / "monday").mkdir(parents=True)
    (path / "monday" / "metadata.yaml").write_text("")
    return path


def written(name: str, content: str | bytes) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        path.mkdir()
        (path / name).write_bytes(content.encode() if isinstance(content, str) else content)
        return path if name == "metadata.yaml" else path / name

    return make


NO_BAGS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "nothing there": (lambda p: p / "none", "No such file"),
    "nothing there, by name": (lambda p: p / "none.mcap", "No such file"),
    "empty folder": (lambda p: p.mkdir() or p, "got nothing"),  # type: ignore[func-returns-value]
    "folder of bags": (folder_of_bags, "give one of the folders in it: monday"),
    "text": (written("data.csv", "q1,q2\n"), "give the bag's folder"),
    "ros 1": (written("old.bag", "#ROSBAG V2.0\n"), "rosbags-convert"),
    "empty db3": (written("a.db3", ""), "missing tables"),
    "empty mcap": (written("a.mcap", ""), "empty"),
    "text as db3": (written("a.db3", "hello" * 1000), "not a database"),
    "text as mcap": (written("a.mcap", "hello"), "magic"),
    "metadata empty": (written("metadata.yaml", ""), "Invalid bag metadata"),
    "metadata no YAML": (written("metadata.yaml", "a: [b"), "Could not load YAML"),
    "metadata binary": (written("metadata.yaml", b"\xff\xfe\x00"), "codec can't decode"),
    "metadata of something else": (written("metadata.yaml", "a: 1"), "rosbag2_bagfile_information"),
}


@pytest.mark.parametrize("case", NO_BAGS)
def test_what_is_no_bag_is_refused(tmp_path: Path, case: str) -> None:
    make, word = NO_BAGS[case]
    path = make(tmp_path / "x")
    with pytest.raises(FileFormatError) as caught:
        read_bag(path, PLANAR)
    assert word in str(caught.value) and str(path) in str(caught.value)


# ── damage ───────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("share", [0.999, 0.5, 0.01])
def test_truncated_storage_is_refused(tmp_path: Path, plugin: str, share: float) -> None:
    bag = write_bag(tmp_path / "bag", SAID, plugin=plugin)
    (storage,) = (p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))
    data = storage.read_bytes()
    storage.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FileFormatError, match="repair it"):
        read_bag(bag, PLANAR)


def with_rotten_chunk(tmp_path: Path) -> Path:
    """An MCAP of several compressed chunks, the second of which is damaged."""
    long = campaign(CELL, np.vstack([STOPS] * 3))
    long = [m if m.stream else replace(m, extra={"frame_id": "long" * 500}) for m in long]
    bag = write_bag(tmp_path / "bag", long, plugin="MCAP", compression="STORAGE")
    storage = bag / "bag.mcap"
    data = bytearray(storage.read_bytes())
    magic = b"\x28\xb5\x2f\xfd"  # zstd's
    at = data.find(magic, data.find(magic) + 1)
    assert at > 0
    data[at + 20 : at + 4000] = b"\x55" * 3980
    storage.write_bytes(data)
    return bag


def test_damage_midway_is_counted_and_what_came_before_can_be_kept(tmp_path: Path) -> None:
    bag = with_rotten_chunk(tmp_path)
    with pytest.raises(FileFormatError) as caught:
        read_bag(bag, PLANAR)
    assert "unreadable after" in str(caught.value) and "--accept-damaged" in str(caught.value)
    found = read_bag(bag, PLANAR, accept_damaged=True)
    assert "unreadable after" in found.damage and any(found.damage in line for line in found.describe())
    assert 0 < len(found.data) < 12
    np.testing.assert_allclose(found.data.q, np.vstack([STOPS] * 3)[: len(found.data)], atol=1e-4)


def test_fewer_messages_than_promised_is_damage(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", SAID)
    with sqlite3.connect(bag / "bag.db3") as base:
        base.execute("DELETE FROM messages WHERE id % 100 = 0")
    base.close()
    with pytest.raises(FileFormatError, match=r"messages of /joint_states are missing"):
        read_bag(bag, PLANAR)
    found = read_bag(bag, PLANAR, accept_damaged=True)
    assert len(found.data) == len(STOPS) and "are missing" in found.damage


def test_messages_that_are_none_are_damage(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", SAID)
    with sqlite3.connect(bag / "bag.db3") as base:
        base.execute("UPDATE messages SET data = x'00010000ffffff' WHERE topic_id < 3 AND id % 500 = 0")
        (spoilt,) = base.execute("SELECT changes()").fetchone()
    base.close()
    with pytest.raises(FileFormatError, match="cannot be decoded"):
        read_bag(bag, PLANAR)
    found = read_bag(bag, PLANAR, accept_damaged=True)
    assert sum(s.left_out.get("not decodable", 0) for s in found.streams) == spoilt > 1


def test_a_write_ahead_log_is_not_overlooked(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", SAID)
    (bag / "bag.db3-wal").write_bytes(b"x" * 100)
    with pytest.raises(FileFormatError, match=r"bag\.db3-wal holds messages not yet in"):
        read_bag(bag, PLANAR)


@pytest.mark.parametrize(("plugin", "compression"), [("SQLITE3", "NONE"), ("MCAP", "NONE"), ("MCAP", "STORAGE")])
def test_no_byte_can_bring_a_traceback(tmp_path: Path, plugin: str, compression: str) -> None:
    rng = np.random.default_rng(7)
    bag = write_bag(tmp_path / "bag", SAID[:400], plugin=plugin, compression=compression)
    (storage,) = (p for p in bag.iterdir() if p.suffix in (".db3", ".mcap"))
    sound = storage.read_bytes()
    refused = 0
    for turn in range(repeats(30, 60)):
        data = bytearray(sound)
        ends = rng.integers(len(data), size=2) if rng.random() < 0.5 else (0, 2000)
        for at in rng.integers(min(ends), max(ends) + 1, size=rng.integers(1, 30)):
            data[min(at, len(data) - 1)] = rng.integers(256)
        storage.write_bytes(data)
        try:
            found = read_bag(bag, PLANAR, accept_damaged=turn % 2 == 1)
            if found.damage:
                continue
            assert [s.messages for s in found.streams] == [sum(m.stream == k for m in SAID[:400]) for k in (0, 1)]
        except CalibPlannerError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > 5
