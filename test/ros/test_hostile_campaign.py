# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Anyone on the graph may send anything to the campaign node, too; a robot may answer anything.

A campaign is under way, its robot at a configuration. After every attack the node answers, the campaign stands
where it stood, and nothing was written elsewhere; at the end it is measured to its end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Bench
from calib_planner_msgs.msg import CalibrationEstimate, JointConfiguration, Measurement
from desk import NAME, Desk, S
from fake_cell import FakeCell
from geometry_msgs.msg import Point
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Log, ParameterType, ParameterValue
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.qos import QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger
from test_hostile_peer import BIG, PATHS, text_parameter, urdfs

from calib_planner.errors import InputError
from calib_planner.io.store import CAMPAIGN_FILE as FILE
from calib_planner.ros.parameters import EVENTS, LATCHED

IDENTIFIER = "calibration_identifier"
NAN, INF = float("nan"), float("inf")


class Attack:
    """A campaign under way, and a peer that hears its plan and sends what it likes."""

    def __init__(self, bench: Bench, folder: Path) -> None:
        self.bench, self.folder = bench, folder
        self.outside = folder / "outside"
        self.outside.mkdir()
        (self.outside / "secret.txt").write_text("0123-secret")
        self.cell = bench.start(FakeCell)
        self.held = True
        self.cell.answer = lambda q: "hang" if self.held and len(self.cell.visited) > 3 else "ok"
        self.logs = bench.hear(Log, "/rosout", QoSProfile(depth=1000))
        create = bench.client.create_publisher
        self.measurements = create(Measurement, f"{IDENTIFIER}/measurements", EVENTS)
        self.estimates = create(CalibrationEstimate, f"{IDENTIFIER}/estimate", LATCHED)
        self.descriptions = create(String, "robot_description", LATCHED)
        self.desk = Desk(bench, store_folder=str(folder / "store"), silence=600.0)
        for publisher in (self.measurements, self.estimates, self.descriptions):
            bench.wait(publisher.get_subscription_count)
        self.errors: list[str] = []
        self.watch()
        assert self.desk.call("start")[0]
        self.stuck()

    @property
    def node(self) -> Any:
        return self.desk.node

    def stuck(self) -> None:
        """Until the robot hangs at the fourth configuration."""
        self.desk.until(S.MEASURING, measured=3)
        self.bench.wait(lambda: self.node._measuring.visit and self.node._measuring.visit.phase == "moving")

    def message(self, **changes: Any) -> Measurement:
        """A measurement of the configuration that the robot is at, but for ``changes``."""
        plan, visit = self.cell._plan, self.node._measuring.visit
        point = Point(x=1.0, y=0.1, z=0.0)
        usual = {
            "id": 10**6,
            "plan_id": plan.plan_id,
            "configuration_index": self.node._measuring._plan.numbers.index(visit.action.index),
            "joint_names": ["q1", "q2"],
            "configuration": JointConfiguration(positions=visit.action.q.tolist()),
            "points": [point],
            "status": Measurement.ACCEPTED,
        }
        return Measurement(**(usual | changes))

    def refused(self, send: Callable[[], None], *words: str) -> None:
        """The node says on the log why it refuses."""
        assert "0123" not in self.bench.said(self.logs, self.node, send, *words)

    def watch(self) -> None:
        """Keep what the node refuses of measurements, which is more than it says."""
        heard = self.node._measuring.heard

        def hear(message: Measurement, state: Any) -> Any:
            try:
                return heard(message, state)
            except InputError as error:
                self.errors.append(str(error))
                raise

        self.node._measuring.heard = hear

    def check(self) -> None:
        """The node is at work and answers; the campaign stands where it stood; nothing was written elsewhere."""
        ok, text = self.desk.call("start")
        assert not ok and "not finished" in text
        state = self.node.campaign
        assert (
            self.node.is_active and len(state.measurements) == 3 and not state.exclusions and not state.failures
        )
        self.bench.wait(lambda: (self.desk.now.state, self.desk.now.measured) == (S.MEASURING, 3))
        assert len(self.desk.now.reason) <= 1000
        assert [p.name for p in self.outside.iterdir()] == ["secret.txt"]
        assert {p.name for p in self.folder.iterdir()} == {"outside", "store"}
        assert {p.name for p in (self.folder / "store").iterdir()} == {FILE, f"{FILE}-wal"}
        assert not any("secret" in line.msg or "Traceback" in line.msg for line in self.logs)

    def measure_to_its_end(self) -> None:
        """Let the robot go on: the campaign reaches its end, and writes there alone."""
        self.held = False
        assert self.desk.call("pause")[0] and self.desk.call("resume")[0]
        done = self.desk.until(S.DONE, 60.0)
        assert done.outcome == S.OUTCOME_REACHED and done.excluded == 0
        names = {p.name.replace(done.campaign_id, "ID") for p in (self.folder / "store").iterdir()}
        assert names == {FILE, "measurements_ID.csv", "validation_ID.csv", "estimate_ID.yaml"}
        assert [p.name for p in self.outside.iterdir()] == ["secret.txt"]
        read = GetParameters.Request(names=["store_folder"])
        answer = self.bench.call(GetParameters, f"{NAME}/get_parameters", read)
        assert answer.values[0].string_value == str(self.folder / "store")


@pytest.fixture(scope="module")
def attack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Attack]:
    """One campaign for all attacks, in whatever order; after the last one it is measured to its end."""
    with Bench() as bench:
        under_way = Attack(bench, tmp_path_factory.mktemp("campaign"))
        yield under_way
        under_way.measure_to_its_end()


# ── who says to be the identifier ────────────────────────────────────────────────────────────────────


def at(positions: list[float]) -> JointConfiguration:
    return JointConfiguration(positions=positions)


REFUSED: dict[str, dict[str, Any]] = {
    "10 000 joints": {"joint_names": [f"j{i}" for i in range(10_000)], "configuration": at([0.0] * 10_000)},
    "a million positions": {"configuration": at([0.0] * BIG)},
    "too few": {"configuration": at([0.1])},
    "no joints": {"joint_names": [], "configuration": at([])},
    "twice": {"joint_names": ["q1", "q1"]},
    "empty names": {"joint_names": ["", ""]},
    "a long name": {"joint_names": ["q1", "x" * BIG]},
    "NaN": {"configuration": at([NAN, NAN])},
    "infinite": {"configuration": at([INF, 0.0])},
    "no points": {"points": []},
    "100 000 points": {"points": [Point()] * 100_000},
    "NaN points": {"points": [Point(x=NAN, y=NAN, z=NAN)]},
    "infinite points": {"points": [Point(x=INF)]},
    "points far beyond": {"points": [Point(x=1e308, y=NAN, z=-1e308)]},
    "joints far beyond": {"configuration": at([1e308, 0.0])},
}


@pytest.mark.parametrize("case", REFUSED)
def test_measurements(attack: Attack, case: str) -> None:
    attack.errors.clear()
    attack.measurements.publish(attack.message(**REFUSED[case]))
    attack.bench.wait(lambda: attack.errors)
    attack.check()


def test_what_is_refused_is_said(attack: Attack) -> None:
    message = attack.message(points=[])
    attack.refused(lambda: attack.measurements.publish(message), "measurement refused", "points")
    description = String(data="<robot")
    words = "robot_description refused", "well-formed", "planar_2r stays the robot"
    attack.refused(lambda: attack.descriptions.publish(description), *words)


IGNORED: dict[str, dict[str, Any]] = {
    "another plan": {"plan_id": "another"},
    **{f"plan {p[:16]!r}": {"plan_id": p.replace("\0", "")} for p in PATHS},
    "no such row": {"configuration_index": 2**32 - 1},
    "no status": {"status": 255},
    "undone, unknown": {"status": Measurement.REJECTED_UNDONE, "id": 2**64 - 1},
    "a long reason": {"status": Measurement.REJECTED_MOVED, "reason": "x" * BIG},
    "told already": {"id": 1},
}


@pytest.mark.parametrize("case", IGNORED)
def test_measurements_of_nothing(attack: Attack, case: str) -> None:
    heard = len(attack.desk.heard)
    for _ in range(3):
        attack.measurements.publish(attack.message(**IGNORED[case]))
    attack.check()
    assert len(attack.desk.heard) - heard <= 3


def test_estimates(attack: Attack) -> None:
    for text in (*PATHS, "", "x"):
        attack.estimates.publish(
            CalibrationEstimate(plan_id=text.replace("\0", ""), covariance=[NAN] * 10_000, value=[INF] * 10)
        )
    attack.check()
    attack.estimates.publish(CalibrationEstimate(plan_id=attack.cell._plan.plan_id))


# ── descriptions, parameters, transitions ────────────────────────────────────────────────────────────


@pytest.mark.parametrize("case", urdfs(Path("x")))
def test_descriptions(attack: Attack, case: str) -> None:
    attack.node._source.refusal = ""
    attack.descriptions.publish(String(data=urdfs(attack.outside / "secret.txt")[case]))
    attack.bench.wait(lambda: attack.node._source.refusal)
    assert "planar_2r stays the robot" in attack.node._source.refusal
    assert "0123" not in attack.node._source.refusal
    attack.check()


def test_parameters(attack: Attack) -> None:
    names = (
        "budget",
        "required_accuracy",
        "test_poses",
        "sigma",
        "patience",
        "silence",
        "longest_wait",
        "starts",
    )
    numbers = ParameterValue(type=ParameterType.PARAMETER_DOUBLE_ARRAY, double_array_value=[0.0] * BIG)
    nan = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=NAN)
    fixed = ("store_folder", "constraints_folder", "robot", "execute_action", "identifier")
    paths = [p for p in PATHS if "\0" not in p]
    for given in (
        [text_parameter("x" * BIG, "x")],
        [text_parameter(f"p{i}", "x") for i in range(10_000)],
        [text_parameter(name, p[:1000]) for name in fixed for p in paths],
        [text_parameter("test_poses", p) for p in paths],
        [ParameterMessage(name=name, value=numbers) for name in names[:2]],
        [ParameterMessage(name=name, value=nan) for name in names],
    ):
        for kind, name in (
            (SetParameters, "set_parameters"),
            (SetParametersAtomically, "set_parameters_atomically"),
        ):
            answer = attack.bench.call(kind, f"{NAME}/{name}", kind.Request(parameters=given), 30.0)
            results = answer.results if kind is SetParameters else [answer.result]
            assert results and all(not r.successful and r.reason for r in results), results
            assert max(len(r.reason) for r in results) < 3000
    attack.check()


def test_services_in_any_order(attack: Attack) -> None:
    """A hundred calls by someone who does not wait for the answers."""
    rng = np.random.default_rng(3)
    names = ("start", "pause", "resume")
    pending = [attack.desk.clients[names[k]].call_async(Trigger.Request()) for k in rng.integers(0, 3, 100)]
    for future in pending[-10:]:
        assert attack.bench.future(future, 30.0).message
    assert attack.desk.call("pause")[0] and attack.desk.call("resume")[0]
    attack.stuck()
    attack.check()


def change(attack: Attack, *which: int) -> None:
    for number in which:
        request = ChangeState.Request(transition=Transition(id=number))
        answer = attack.bench.call(ChangeState, f"{NAME}/change_state", request, 20.0, attempts=1)
        assert answer.success


def test_no_peer_chooses_where_is_written(attack: Attack) -> None:
    """Not even one that takes the node out of service first; the campaign goes on when it is back."""
    change(attack, Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP)
    given = [text_parameter(name, str(attack.outside)) for name in ("store_folder", "constraints_folder")]
    answer = attack.bench.call(SetParameters, f"{NAME}/set_parameters", SetParameters.Request(parameters=given))
    assert all(not r.successful and r.reason for r in answer.results)
    change(attack, Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
    attack.watch()  # what it measures with is made anew
    attack.bench.wait(lambda: attack.node._measuring._out.get_subscription_count())
    attack.desk.until(S.PAUSED, measured=3)
    assert attack.desk.call("resume")[0]
    attack.stuck()
    attack.check()
