# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Anyone on the graph may send anything: the nodes refuse it with a reason, go on, and write nowhere else.

Planner, identifier and simulator run in this process and hear each other, as in a cell. After every attack each
of them answers an ordinary request, and at the end a plan is still measured and identified.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from bench import Bench
from builtin_interfaces.msg import Duration, Time
from calib_planner_msgs.action import ExecutePlan, PlanCalibration
from calib_planner_msgs.msg import CalibrationEstimate, Measurement, PlanRequest
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.srv import PlanCalibration as PlanService
from calib_planner_msgs.srv import UndoMeasurement
from geometry_msgs.msg import PointStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from poses import poses
from rcl_interfaces.msg import Log, ParameterType, ParameterValue
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.qos import QoSProfile
from robots import plan_of, random_configurations, repeats
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger

from calib_planner import Plan, Robot
from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.messages import plan_to_message
from calib_planner.ros.nodes.identifier import IdentifierNode
from calib_planner.ros.nodes.planner import PlannerNode
from calib_planner.ros.nodes.simulator import SimulatorNode
from calib_planner.ros.parameters import EVENTS, LATCHED, SENSOR_OUT

PLANNER, IDENTIFIER, SIMULATOR = "calibration_planner", "calibration_identifier", "tracker_simulator"
PATHS = (
    "../../escaped",
    "/etc/escaped",
    "~/escaped",
    "a/../../escaped",
    "escaped\0.csv",
    "\u202e" * 50,
    "x" * 10**6,
)
IDS = [p[:500] for p in PATHS if "\0" not in p]
BIG = 10**6
POSE = poses([0.3, 0.5])
CANDIDATES = poses(*random_configurations(Robot.load("planar_2r"), 6).tolist())


class Cell:
    """Three nodes, and a peer that sends what it likes."""

    def __init__(self, bench: Bench, folder: Path) -> None:
        self.bench, self.folder = bench, folder
        self.outside = folder / "outside"
        self.outside.mkdir()
        (self.outside / "secret.txt").write_text("0123-secret")
        robot = {"robot": "planar_2r"}
        self.simulator = bench.start(SimulatorNode, joint_speed=100.0, dwell=0.4, **robot)
        kept = {"store_folder": str(folder / "store"), "save_folder": str(folder / "saved")}
        short = {"settle": 0.05, "duration": 0.2, "samples": 10}
        self.identifier = bench.start(IdentifierNode, **robot, **kept, **short)
        self.planner = bench.start(PlannerNode, starts=4, time_limit=5.0, **robot)
        self.logs = bench.hear(Log, "/rosout", QoSProfile(depth=1000))
        self.measurements = bench.hear(Measurement, f"{IDENTIFIER}/measurements", EVENTS)
        self.estimates = bench.hear(CalibrationEstimate, f"{IDENTIFIER}/estimate", LATCHED)
        create = bench.client.create_publisher
        self.joints = create(JointState, "joint_states", SENSOR_OUT)
        self.points = create(PointStamped, "tracker/point", SENSOR_OUT)
        self.plans = create(PlanMessage, f"{PLANNER}/current_plan", LATCHED)
        self.descriptions = create(String, "robot_description", LATCHED)
        for publisher in (self.joints, self.points, self.plans, self.descriptions):
            bench.wait(publisher.get_subscription_count)
        bench.wait(lambda: self.estimates)

    def request(self, **changes: Any) -> PlanService.Request:
        wanted = PlanRequest(**({"test_poses": POSE, "configurations": 3} | changes))
        return PlanService.Request(request=wanted)

    def ask(self, **changes: Any) -> PlanService.Response:
        return self.bench.call(PlanService, f"{PLANNER}/request_plan", self.request(**changes), 30.0)

    def refused(self, node: ManagedNode[Any], send: Callable[[], None], *words: str) -> str:
        """What the node says on the log why it refuses."""
        return self.bench.said(self.logs, node, send, *words)

    def check(self) -> None:
        """All nodes are at work and answer; nothing was written elsewhere."""
        # The node's own robot may be one that a peer described; candidates make the search short.
        answer = self.ask(robot="planar_2r", candidates=CANDIDATES)
        assert answer.status == PlanService.Response.SUCCESS, answer.message
        undo = self.bench.call(
            UndoMeasurement, f"{IDENTIFIER}/undo_measurement", UndoMeasurement.Request(id=2**63)
        )
        assert undo.status == UndoMeasurement.Response.UNKNOWN_ID and undo.message
        read = self.bench.call(
            GetParameters, f"{SIMULATOR}/get_parameters", GetParameters.Request(names=["robot"])
        )
        assert read.values[0].string_value == "planar_2r"
        assert all(node.is_active for node in (self.planner, self.identifier, self.simulator))
        for watch in self.identifier._intake.streams:
            heard = watch.messages
            self.bench.wait(lambda w=watch, n=heard: w.messages > n)
        assert sorted(p.name for p in self.outside.iterdir()) == ["secret.txt"]
        assert {p.name for p in self.folder.iterdir()} <= {"outside", "store", "saved"}
        assert not any("secret" in line.msg for line in self.logs)


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    with Bench() as bench:
        yield Cell(bench, tmp_path_factory.mktemp("cell"))


@pytest.fixture(scope="module")
def planned() -> Plan:
    robot = Robot.load("planar_2r").with_parameters("lengths+offsets")
    return plan_of(robot, random_configurations(robot, 5, 1))


# ── streams ──────────────────────────────────────────────────────────────────────────────────────────

NAMES = ["q1", "q2"]
STATES: dict[str, tuple[list[str], list[float], int]] = {
    "10 000 joints": ([f"j{i}" for i in range(10_000)], [0.0] * 10_000, 0),
    "a million positions": (NAMES, [0.0] * BIG, 0),
    "NaN": (NAMES, [float("nan")] * 2, 0),
    "infinite": (NAMES, [float("inf"), -float("inf")], 0),
    "too few": (NAMES, [1.0], 0),
    "nothing": ([], [], 0),
    "empty names": (["", ""], [1.0, 2.0], 0),
    "twice": (["q1", "q1", "q2"], [1.0] * 3, 0),
    "a long name": (["x" * BIG], [1.0], 0),
    "before time": (NAMES, [0.3, 0.5], -(2**31)),
    "far future": (NAMES, [0.3, 0.5], 2**31 - 1),
    "long ago": (NAMES, [0.3, 0.5], 1),
}


@pytest.mark.parametrize("case", STATES)
def test_joint_states(cell: Cell, case: str) -> None:
    names, positions, seconds = STATES[case]
    state = JointState(name=names, position=positions)
    state.header.stamp = Time(sec=seconds) if seconds else cell.bench.client.get_clock().now().to_msg()
    for _ in range(5):
        cell.joints.publish(state)
    cell.check()


@pytest.mark.parametrize("seconds", [-(2**31), 0, 1, 2**31 - 1], ids=str)
@pytest.mark.parametrize("value", [0.0, float("nan"), float("inf"), 1e308], ids=str)
def test_points(cell: Cell, value: float, seconds: int) -> None:
    point = PointStamped()
    point.header.stamp = Time(sec=seconds, nanosec=2**32 - 1)
    point.header.frame_id = PATHS[0]
    point.point.x = point.point.y = point.point.z = value
    for _ in range(5):
        cell.points.publish(point)


def test_after_points(cell: Cell) -> None:
    cell.check()


# ── plans ────────────────────────────────────────────────────────────────────────────────────────────

PLANS: dict[str, dict[str, Any]] = {
    "a million joints": {"configurations": poses([0.5] * BIG)},
    "NaN": {"configurations": poses([float("nan")] * 2) * 5},
    "wrong length": {"configurations": poses([0.0] * 2) * 4},
    "10 000 joints": {"joint_names": [f"j{i}" for i in range(10_000)]},
    "empty names": {"joint_names": ["", ""]},
    "twice": {"joint_names": ["q1", "q1"]},
    "no joints": {"joint_names": []},
    "a million times": {"repetitions": [2**32 - 1] * 5},
    "never": {"repetitions": [0] * 5},
    "another robot": {"robot": PATHS[0]},
    "100 000 parameters": {"parameters": [f"p{i}" for i in range(100_000)]},
    "a long id": {"plan_id": "x" * BIG},
    "20 000 configurations": {"configurations": poses([0.5, 0.5]) * 20_000},
    "no purpose": {"purpose": 7},
    "no status": {"status": 255},
    "sigma": {"sigma": float("nan")},
    "poses": {"test_poses": poses([float("inf")] * 2) * 5},
}


@pytest.mark.parametrize("case", PLANS)
def test_plans(cell: Cell, planned: Plan, case: str) -> None:
    message = plan_to_message(planned, "hostile", 0, "base")
    for name, value in PLANS[case].items():
        setattr(message, name, value)
    assert cell.refused(cell.identifier, lambda: cell.plans.publish(message), "refused")
    assert all(e.plan_id != "hostile" for e in cell.estimates)
    goal = ExecutePlan.Goal(plan=message)
    client = cell.bench.action(ExecutePlan, f"{SIMULATOR}/execute_plan")
    if case in ("a long id", "100 000 parameters", "sigma"):  # not what it executes
        goal.plan.robot = "other"
    result = cell.bench.future(cell.bench.goal(client, goal).get_result_async()).result
    assert result.status == ExecutePlan.Result.INVALID_PLAN and 0 < len(result.message) < 3000
    cell.check()


@pytest.mark.parametrize(
    "dwell", [Duration(sec=-1), Duration(sec=601), Duration(sec=2**31 - 1, nanosec=2**32 - 1)]
)
def test_dwell(cell: Cell, planned: Plan, dwell: Duration) -> None:
    client = cell.bench.action(ExecutePlan, f"{SIMULATOR}/execute_plan")
    goal = ExecutePlan.Goal(plan=plan_to_message(planned, "p", 0, "base"), dwell=dwell)
    result = cell.bench.future(cell.bench.goal(client, goal).get_result_async()).result
    assert result.status == ExecutePlan.Result.INVALID_PLAN and "dwell" in result.message


# ── requests ─────────────────────────────────────────────────────────────────────────────────────────

REQUESTS: dict[str, dict[str, Any]] = {
    "20 000 poses": {"test_poses": poses([0.1, 0.1]) * 20_000},
    "a million joints": {"test_poses": poses([0.1] * BIG)},
    "NaN": {"test_poses": poses([float("nan")] * 2)},
    "odd": {"test_poses": poses([0.1] * 3)},
    "20 000 candidates": {"candidates": poses([0.1, 0.1]) * 20_000},
    "a million joints of a candidate": {"candidates": poses([0.1] * BIG)},
    "configurations": {"configurations": 2**32 - 1},
    "repetitions": {"repetitions": 2**32 - 1},
    "weights": {"test_pose_weights": [float("inf")]},
    "sigma": {"sigma": -1.0},
    "time": {"time_limit": Duration(sec=-5)},
    "criterion": {"criterion": "x" * 100_000},
    "names": {"parameters": [f"p{i}" for i in range(100_000)]},
    **{f"robot {p[:16]!r}": {"robot": p} for p in PATHS if "\0" not in p},
}


@pytest.mark.parametrize("case", REQUESTS)
def test_requests(cell: Cell, case: str) -> None:
    answer = cell.ask(**REQUESTS[case])
    assert answer.status == PlanService.Response.INVALID_REQUEST, answer
    assert answer.field and 0 < len(answer.message) < 3000
    client = cell.bench.action(PlanCalibration, f"{PLANNER}/plan")
    goal = PlanCalibration.Goal(request=cell.request(**REQUESTS[case]).request)
    result = cell.bench.future(cell.bench.goal(client, goal).get_result_async()).result
    assert (result.status, result.field) == (answer.status, answer.field)
    cell.check()


# ── descriptions ─────────────────────────────────────────────────────────────────────────────────────

NESTED = "".join(f'<!ENTITY b{i} "{f"&b{i - 1};" * 10}">' for i in range(1, 20))
BOMB = f'<?xml version="1.0"?><!DOCTYPE r [<!ENTITY b0 "boom">{NESTED}]><robot name="&b19;"/>'


def urdfs(secret: Path) -> dict[str, str]:
    link = (
        '<link name="a{0}"/><joint name="j{0}" type="revolute"><parent link="a{0}"/><child link="a{1}"/></joint>'
    )
    chain = "".join(link.format(i, i + 1) for i in range(100_000))
    return {
        "bomb": BOMB,
        "external": f'<!DOCTYPE r [<!ENTITY x SYSTEM "file://{secret}">]><robot name="&x;"/>',
        "parameter entity": f'<!DOCTYPE r [<!ENTITY % x SYSTEM "file://{secret}"> %x;]><robot name="r"/>',
        "dtd": '<!DOCTYPE r SYSTEM "http://localhost:1/x.dtd"><robot name="r"/>',
        "include": f'<robot xmlns:xi="http://www.w3.org/2001/XInclude"><xi:include href="{secret}"/></robot>',
        "100 000 links": f'<robot name="r">{chain}</robot>',
        "nested": "<robot>" + "<link>" * 100_000 + "</link>" * 100_000 + "</robot>",
        "deep": "<robot>" + "<a>" * 300_000 + "</a>" * 300_000 + "</robot>",
        "long": "x" * 5_000_000,
        "nothing": "",
        "a path": str(secret),
    }


@pytest.mark.parametrize("case", urdfs(Path("x")))
def test_descriptions(cell: Cell, case: str) -> None:
    text = urdfs(cell.outside / "secret.txt")[case]
    before = cell.planner._source.model, cell.identifier._session
    said = [
        cell.refused(node, lambda: cell.descriptions.publish(String(data=text)), "refused")
        for node in (cell.planner, cell.identifier)
    ]
    assert all("0123" not in words for words in said)
    assert cell.identifier._session is before[1] and cell.planner._source.model is before[0]
    answer = cell.ask(robot="planar_2r")
    assert answer.status == PlanService.Response.SUCCESS


# ── parameters and transitions ───────────────────────────────────────────────────────────────────────


def text_parameter(name: str, value: str) -> ParameterMessage:
    return ParameterMessage(
        name=name, value=ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=value)
    )


@pytest.mark.parametrize("node", repeats([IDENTIFIER], [PLANNER, IDENTIFIER, SIMULATOR]))
def test_parameters(cell: Cell, node: str) -> None:
    numbers = ParameterValue(type=ParameterType.PARAMETER_DOUBLE_ARRAY, double_array_value=[0.0] * BIG)
    nan = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=float("nan"))
    for given in (
        [text_parameter("x" * BIG, "x")],
        [text_parameter("", "")],
        [text_parameter(f"p{i}", "x") for i in range(10_000)],
        [text_parameter("robot", p) for p in PATHS if "\0" not in p],
        [ParameterMessage(name=name, value=numbers) for name in ("robot", "sigma", "dwell")],
        [ParameterMessage(name=name, value=nan) for name in ("sigma", "dwell", "plan_tolerance", "time_limit")],
    ):
        for kind, name in (
            (SetParameters, "set_parameters"),
            (SetParametersAtomically, "set_parameters_atomically"),
        ):
            answer = cell.bench.call(kind, f"{node}/{name}", kind.Request(parameters=given), 30.0)
            results = answer.results if kind is SetParameters else [answer.result]
            assert results and all(not r.successful and r.reason for r in results)
            assert max(len(r.reason) for r in results) < 3000


@pytest.mark.parametrize("name", ["store_folder", "save_folder"])
def test_no_peer_chooses_where_is_written(cell: Cell, name: str) -> None:
    """Not even one that takes the node out of service first."""

    def change(number: int) -> None:
        request = ChangeState.Request(transition=Transition(id=number))
        assert cell.bench.call(ChangeState, f"{IDENTIFIER}/change_state", request, attempts=1).success

    change(Transition.TRANSITION_DEACTIVATE)
    change(Transition.TRANSITION_CLEANUP)
    try:
        given = SetParameters.Request(parameters=[text_parameter(name, str(cell.outside))])
        answer = cell.bench.call(SetParameters, f"{IDENTIFIER}/set_parameters", given)
        assert not answer.results[0].successful and answer.results[0].reason
    finally:
        change(Transition.TRANSITION_CONFIGURE)
        change(Transition.TRANSITION_ACTIVATE)
    cell.bench.call(Trigger, f"{IDENTIFIER}/save", Trigger.Request())
    cell.check()


# ── in the end ───────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("plan_id", repeats(IDS[:1] + IDS[-2:], IDS), ids=lambda p: ascii(p[:16]))
def test_a_plan_is_measured_and_saved_whatever_its_name(cell: Cell, planned: Plan, plan_id: str) -> None:
    message = plan_to_message(planned, plan_id, 0, "base")
    cell.plans.publish(message)
    cell.bench.wait(lambda: cell.estimates[-1].plan_id == plan_id)
    client, known = cell.bench.action(ExecutePlan, f"{SIMULATOR}/execute_plan"), len(cell.measurements)

    def accepted() -> set[int]:
        return {m.configuration_index for m in cell.measurements[known:] if m.status == Measurement.ACCEPTED}

    for again in range(5):  # a busy machine misses a standstill now and then
        goal = cell.bench.goal(client, ExecutePlan.Goal(plan=message))
        assert cell.bench.future(goal.get_result_async()).result.status == ExecutePlan.Result.SUCCESS
        try:
            cell.bench.wait(lambda: len(accepted()) >= 4, 5.0)
            break
        except AssertionError:
            assert again < 4
    for name in ("save", "report"):
        answer = cell.bench.call(Trigger, f"{IDENTIFIER}/{name}", Trigger.Request(), 60.0)
        assert answer.success, answer.message
    saved = [p for p in cell.folder.rglob("*") if p.is_file() and p.parent.name not in ("store", "outside")]
    assert saved and all(p.parent == cell.folder / "saved" for p in saved)
    cell.check()
