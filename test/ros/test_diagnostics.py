# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the identifier says on /diagnostics, from snapshots with known content."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PointStamped
from sensor_msgs.msg import JointState
from sessions import HOW, PLAN, ROBOT, begun, measure, opened, seen

from calib_planner import Estimate
from calib_planner.acquisition import NANO, Intake, JointReader, Offset, StandstillSettings, StreamCount
from calib_planner.errors import InputError, StoreError
from calib_planner.io import StoredModel, UnavailableStore
from calib_planner.ros.diagnostics import StreamHealth, health, identifier_findings
from calib_planner.ros.messages import joints_message, point_message, stamp_message
from calib_planner.ros.session import Session

GOOD = StreamHealth("joint_states", 1000.0, 0.002, 0.0, 5000, 0, 0, 0, "")
POINT = replace(GOOD, name="tracker/point", skew=0.001, offset=Offset(0.004, 0.001, 9))


def said(campaign: Session | None, *streams: StreamHealth) -> dict[str, DiagnosticStatus]:
    found = identifier_findings(streams or (GOOD, POINT), 0.1, campaign, "no robot yet")
    robot = "" if campaign is None else campaign.robot.name
    parts = {f.part: f.status("identifier", robot) for f in found}
    assert len(found) == len(parts)
    assert all(status.name == f"identifier: {part}" for part, status in parts.items())
    return parts


def values(status: DiagnosticStatus) -> dict[str, str]:
    return {v.key: v.value for v in status.values}


def test_a_good_campaign() -> None:
    campaign = begun(opened(""))
    measure(campaign, *(seen(k) for k in range(8)), seen(8, 2e-3))
    found = said(campaign)
    assert set(found) == {"stream joint_states", "stream tracker/point", "campaign", "estimate", "store"}
    assert {s.hardware_id for s in found.values()} == {"planar_2r"}
    shown = values(found["campaign"])
    assert (shown["plan"], shown["accepted"], shown["rejected"]) == ("p", "8", "1")
    assert shown["rejected: outlier"] == "1" and shown["next configuration"] == "8"
    q = [float(word.split("=")[1]) for word in shown["next joints [rad | m]"].split(", ")]
    assert np.allclose(q, PLAN.configurations[8], atol=1e-4)
    shown, estimate = values(found["estimate"]), campaign.newest
    assert isinstance(estimate, Estimate)
    assert shown["rank"] == str(estimate.observability.rank) and shown["outliers"] == "1"
    assert float(shown["condition"]) >= 1 and shown["verdict"] == estimate.verdict.level
    assert float(shown["residual rms [m]"]) == pytest.approx(estimate.residuals.after.rms, rel=1e-2)
    measure(campaign, *(seen(k, attempt=1) for k in range(8, 12)))
    assert values(said(campaign)["campaign"])["complete"] == "True"


def test_before_anything_was_measured() -> None:
    found = said(Session(ROBOT, lambda _: ROBOT, opened("")))
    assert found["campaign"].level == DiagnosticStatus.WARN and "no plan" in found["campaign"].message
    assert found["estimate"].level == DiagnosticStatus.OK and not found["estimate"].values
    nothing = said(None)
    assert nothing["campaign"].level == DiagnosticStatus.ERROR and nothing["campaign"].message == "no robot yet"


def test_stores_in_and_out_of_trouble(tmp_path_factory: pytest.TempPathFactory) -> None:
    memory = said(begun(opened("")))["store"]
    assert memory.level == DiagnosticStatus.WARN and "store_folder" in memory.message
    campaign = begun(opened(tmp_path_factory.mktemp("store")))
    assert said(campaign)["store"].level == DiagnosticStatus.OK
    campaign.store._database.execute("PRAGMA query_only = ON")
    campaign.take(seen(0), HOW)
    trouble = said(campaign)["store"]
    assert trouble.level == DiagnosticStatus.ERROR and "readonly" in trouble.message
    campaign.store._database.execute("PRAGMA query_only = OFF")
    assert campaign.take(seen(0), HOW).status == "accepted"
    assert said(campaign)["store"].level == DiagnosticStatus.OK
    campaign.store.close()
    away = UnavailableStore(StoredModel("planar_2r", ("q1", "q2"), 1, ""), StoreError("/mnt/x", "no such device"))
    found = said(begun(away))["store"]
    assert found.level == DiagnosticStatus.ERROR and "no such device" in found.message


@pytest.mark.parametrize(
    ("stream", "level", "words"),
    [
        (GOOD, DiagnosticStatus.OK, "1000 Hz"),
        (replace(GOOD, rate=0.0), DiagnosticStatus.STALE, "nothing heard"),
        (replace(GOOD, reason="name: no joint q2"), DiagnosticStatus.WARN, "no joint q2"),
        (replace(POINT, offset=Offset(-0.3, 0.01, 5)), DiagnosticStatus.ERROR, "-300 ms"),
        (replace(POINT, offset=Offset(-0.3, 0.25, 5)), DiagnosticStatus.OK, "1000 Hz"),
    ],
)
def test_streams(stream: StreamHealth, level: bytes, words: str) -> None:
    found = said(None, stream)[f"stream {stream.name}"]
    assert found.level == level and words in found.message


def test_texts_are_bounded() -> None:
    found = said(None, replace(GOOD, reason="x" * 100_000))["stream joint_states"]
    assert len(found.message) == 1000


# ── what it is counted from ──────────────────────────────────────────────────────────────────────────


def intake(joints: tuple[str, ...] | None = ("a", "b")) -> Intake:
    return Intake(joints, ["joint_states"], ["p", "q"], StandstillSettings())


def test_counts_rates_ages_and_skews() -> None:
    streams = intake()
    for k in range(10):
        streams.joints(joints_message(("b", "a"), np.array([2.0, 1.0]), (100 + k) * NANO))
        streams.point(0, point_message(np.zeros(3), (98 + k) * NANO, "laser"))
    streams.point(0, point_message(np.zeros(3), 0, ""))
    streams.streams[1].lost += 3
    first, second, silent = health(streams, 110 * NANO, 2.0)
    assert (first.name, first.rate, first.age, first.skew, first.messages) == ("joint_states", 5.0, 1.0, 0.0, 10)
    assert (second.rate, second.age, second.skew, second.refused, second.lost) == (5.5, 3.0, 2.0, 1, 3)
    assert "stamp" in second.reason and streams.frame == "laser"
    assert (silent.rate, silent.age, silent.skew) == (0.0, None, None)
    assert health(streams, 110 * NANO, 2.0)[0].rate == 0.0


def test_without_a_robot_messages_are_only_counted() -> None:
    streams = intake(None)
    assert streams.joints(JointState(header=joints_message((), np.zeros(0), NANO).header)) == []
    assert streams.point(1, point_message(np.zeros(3), NANO, "")) == []
    assert [w.messages for w in streams.streams] == [1, 0, 1] and streams.offset_text(0.1) == ""
    streams.use(("a",))
    streams.joints(joints_message(("a",), np.zeros(1), NANO))
    assert streams.streams[0].messages == 2 and streams.detector is not None


def test_the_reader_follows_names_that_change() -> None:
    reader = JointReader(("a", "b"))
    for names, wanted in (("ab", [0.0, 1.0]), ("ab", [0.0, 1.0]), ("ba", [1.0, 0.0]), ("xbya", [3.0, 1.0])):
        state = JointState(name=list(names), position=[float(k) for k in range(len(names))])
        assert reader.read(state)[1].tolist() == wanted


@pytest.mark.parametrize(
    "state",
    [
        JointState(),
        JointState(name=["c"], position=[1.0]),
        JointState(name=["a", "b"], position=[1.0]),
        JointState(name=["a", "b"], position=[1.0] * 3),
        JointState(name=["a", "b", "a"], position=[1.0] * 3),
        JointState(name=["", "", ""], position=[1.0] * 3),
        JointState(name=[f"j{k}" for k in range(10_000)], position=[0.0] * 10_000),
    ],
)
@pytest.mark.parametrize("before", [True, False])
def test_the_reader_refuses_what_does_not_fit(state: JointState, before: bool) -> None:
    reader = JointReader(("a", "b"))
    if before:
        reader.read(JointState(name=["a", "b"], position=[1.0, 2.0]))
    with pytest.raises(InputError):
        reader.read(state)
    columns, positions = reader.read(JointState(name=["b", "a"], position=[1.0, 2.0]))
    assert columns is None and positions.tolist() == [2.0, 1.0]


def test_nonsense_gives_no_standstill() -> None:
    streams, rng = intake(), np.random.default_rng(0)
    numbers = [float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 0.0]
    for _ in range(3000):
        stamp = stamp_message(int(rng.integers(0, 2**62)) if rng.random() < 0.5 else int(rng.integers(1, 10**10)))
        q = rng.choice(numbers, 2).tolist()
        state = JointState(name=["a", "b"], position=q)
        state.header.stamp = stamp
        streams.joints(state)
        point = PointStamped()
        point.point.x, point.point.y, point.point.z = rng.choice(numbers, 3).tolist()
        point.header.stamp = stamp
        streams.point(int(rng.integers(2)), point)
    assert streams.streams[0].messages == 3000 and health(streams, 0, 1.0)


def test_a_stamp_before_the_epoch() -> None:
    watch = StreamCount("x")
    assert not watch.stamped(-5) and not watch.stamped(0) and watch.stamped(1)
    assert (watch.messages, watch.refused, watch.last, watch.reason) == (3, 2, 1, "")
