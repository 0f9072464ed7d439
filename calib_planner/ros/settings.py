# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The parameters of the nodes, and the writer of ``config/*.yaml``, which repeats them for users.

    python -m calib_planner.ros.settings

writes the files again after a parameter was added or described otherwise; a test compares. What counts as
standing still and what goes wrong in a simulation are settings of the library (``StandstillSettings``,
``Faults``), whose fields become parameters as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from calib_planner.acquisition import POINTS, StandstillSettings
from calib_planner.error_model import ACCURACIES
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.io import BagTopics, config_folder
from calib_planner.planning import CRITERIA
from calib_planner.ros.execution import Watch
from calib_planner.ros.lifecycle import LifecycleParameters
from calib_planner.ros.parameters import at_configure, constraints_text, described, parameter
from calib_planner.simulation import ANGLE_ERROR, LENGTH_ERROR, Faults
from calib_planner.units import cut, listed

LEVEL = "error parameters: a level (offsets, lengths, lengths+offsets, full) or names with commas between"
UNKNOWN = "what else is unknown: base, tool or base,tool"
CONSTRAINTS = "what may be measured: name of a file in constraints_folder; empty = joint limits only"
ERROR_MODEL = "how the robot errs: typical, paper (noise alone), or the path of a YAML file, also an estimate"
FRAME = "accuracy at the test poses: in the frame of the points (world), or up to a rigid motion (robot)"
BASE_FRAME = "name of the robot's base frame"
TOPICS = "topics of the tracker's points, one per target"
JOINT_TOPICS = "topics of the joint states: one, or several with some of the joints each"
PLAN_TOPIC = "topic of the plan that ~/execute executes"
CELL = (
    "path of a cell.yaml, whose robot, instrument, constraints and error model take the place of the parameters "
    "for them; empty = none"
)
LARGEST_SEED = 2**31 - 1


def shipped_instruments() -> tuple[str, ...]:
    """Names of the instruments in config/instruments, sorted."""
    return tuple(sorted(p.stem for p in (config_folder() / "instruments").glob("*.yaml")))


def unknown_words(text: str) -> list[str]:
    """The words between the commas of a parameter ``unknown``."""
    return [w.strip() for w in text.split(",") if w.strip()]


@dataclass(frozen=True)
class RobotParameters(LifecycleParameters):
    """Which robot a node works for."""

    cell: str = parameter("", CELL, read_only=True)
    robot: str = at_configure("kuka_kr270", "name of a shipped robot; empty = wait for robot_description")
    use_robot_description: bool = at_configure(
        True, "a URDF on robot_description replaces robot (in the identifier until a measurement is accepted)"
    )
    base_link: str = at_configure("", "first link of the chain in robot_description; empty = its root")
    tip_link: str = at_configure("", "last link of the chain in robot_description; empty = its only tip")


@dataclass(frozen=True)
class PlanParameters(RobotParameters):
    """What the nodes that plan have in common."""

    parameters: str = parameter("lengths+offsets", LEVEL)
    unknown: str = parameter("", UNKNOWN)
    constraints: str = parameter("", CONSTRAINTS)
    constraints_folder: str = parameter("", "folder of constraints; empty = the package's config", read_only=True)
    time_limit: float = parameter(60.0, "longest search of a plan", "s", 0.01, 86400.0)
    frame_id: str = parameter("base_link", BASE_FRAME)

    def __post_init__(self) -> None:
        for word in unknown_words(self.unknown):
            if word not in ("base", "tool"):
                raise UnknownNameError("unknown", cut(word, 100), ("base", "tool"))


@dataclass(frozen=True)
class PaceParameters:
    """How fast the robot moves and is measured: in the planner, which promises minutes, and in the executor."""

    joint_speed: float = parameter(0.5, "largest speed of turning joints", "rad/s", 1e-3, 100.0)
    slide_speed: float = parameter(0.1, "largest speed of sliding joints", "m/s", 1e-4, 100.0)
    speed_share: float = parameter(
        1.0, "share that is used of these speeds, or of a joint's own limit if that is lower", "", 0.001, 1.0
    )
    settle: float = parameter(2.0, "time at rest before each measurement", "s", 0.0, 3600.0)
    dwell: float = parameter(3.0, "time of each measurement, at rest", "s", 0.0, 3600.0)


@dataclass(frozen=True)
class PlannerParameters(PaceParameters, PlanParameters):
    """Parameters of ``calibration_planner``."""

    criterion: str = parameter("test_pose", "the criterion, unless the request says otherwise", choices=CRITERIA)
    configurations: int = parameter(12, "configurations of a plan, if the request names none", "", 1, 10000)
    repetitions: int = parameter(1, "measurements at each configuration, if the request names none", "", 1, 10000)
    sigma: float = parameter(3e-5, "noise of one coordinate of one measurement", "m", 1e-9, 1.0)
    starts: int = parameter(0, "random starts of the search; 0: as many as usual", "", 0, 100000)
    most_configurations: int = parameter(200, "largest number of configurations in a request", "", 1, 10000)
    most_test_poses: int = parameter(1000, "largest number of test poses in a request", "", 1, 10000)
    most_candidates: int = parameter(2000, "largest number of candidates in a request", "", 1, 10000)
    error_model: str = parameter(
        "", ERROR_MODEL + "; empty = typical, but paper for the robots of the paper", read_only=True
    )
    accuracy_frame: str = parameter("world", FRAME, choices=ACCURACIES)
    constraints: str = at_configure("", CONSTRAINTS)
    time_budget: float = parameter(
        0.0,
        "time for all measurements of a plan, if the request names no number of configurations: the planner "
        "chooses it, and how often each is measured; 0: the parameter configurations decides",
        "s",
        0.0,
        864000.0,
    )


@dataclass(frozen=True)
class IdentifierParameters(StandstillSettings, RobotParameters):
    """Parameters of ``calibration_identifier``."""

    parameters: str = at_configure("", LEVEL + "; empty = those of the plan")
    unknown: str = at_configure("", UNKNOWN)
    sigma: float = parameter(3e-5, "noise of a coordinate of a point; 0 = from the scatter of points", "m", 0, 1)
    repeatability: float = parameter(
        0.0, "scatter that averaging does not reduce (robot, reflector)", "m", 0.0, 1.0
    )
    error_model: str = at_configure("typical", ERROR_MODEL)
    accuracy_frame: str = parameter("world", FRAME, choices=ACCURACIES)
    frame_id: str = parameter("base_link", BASE_FRAME)
    joint_topics: tuple[str, ...] = at_configure(("joint_states",), JOINT_TOPICS)
    publish_transforms: bool = at_configure(
        True, "publish base to tracker and tip to targets on /tf_static, if tf2_msgs is installed"
    )
    tip_frame: str = at_configure(
        "", "name of the tip's frame on /tf_static; empty = the last link of robot_description, else tool0"
    )
    target_frames: tuple[str, ...] = at_configure(
        ("",), "names of the targets' frames on /tf_static; empty = target_1, target_2, …"
    )
    tracker_topics: tuple[str, ...] = at_configure(("tracker/point",), TOPICS)
    tracker_type: str = at_configure(
        "", "type of the messages on tracker_topics; empty = that of their publishers", choices=("", *POINTS)
    )
    tracker_child_frames: tuple[str, ...] = at_configure(
        ("",), "child_frame_id of each target, where transforms are published; empty = the first one that comes"
    )
    tracker_state_topics: tuple[str, ...] = at_configure(
        ("",), "topics of std_msgs/Bool, one per target: whether the tracker sees it; empty = none"
    )
    plan_topic: str = at_configure("calibration_planner/current_plan", "topic of the plan")
    plan_tolerance: float = parameter(
        0.01, "largest joint difference to a planned configuration", "rad or m", 1e-6, 1.0
    )
    accept_unplanned: bool = parameter(False, "accept standstills at configurations that are in no plan")
    keep_measurements: bool = parameter(
        False,
        "a new plan begins with the measurements of the plan before, if both are part of no campaign; plans of "
        "one campaign share their measurements anyway",
    )
    most_measurements: int = parameter(5000, "largest number of measurements in use", "", 1, 1000000)
    store_folder: str = parameter(
        "",
        "folder of the session, which a restart goes on with: a measurement is accepted once it is on the disk; "
        "empty = in memory only, lost with the node",
        read_only=True,
    )
    save_folder: str = parameter(
        "", "folder for ~/save and ~/report; empty = store_folder; with neither both are refused", read_only=True
    )
    clock_offset: float = parameter(
        0.1,
        "largest offset between the clocks of joints and points, estimated from when both stop and start",
        "s",
        1e-3,
        60.0,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.tracker_topics or not all(self.tracker_topics):
            raise InputError("tracker_topics", self.tracker_topics, "one topic name per target")
        _ = self.topics, self.target_names

    @property
    def target_names(self) -> tuple[str, ...]:
        """Names of the targets' frames, one per target."""
        count = len(self.tracker_topics)
        names = tuple(filter(None, self.target_frames)) or tuple(f"target_{k + 1}" for k in range(count))
        if len(names) != count or len(set(names)) != count:
            raise InputError("target_frames", listed(names), f"{count} names, one per target, or none")
        twice = set(names) & set(self.tracker_child_frames)
        if twice and self.publish_transforms:
            advice = "name them otherwise: a frame has one parent"
            raise InputError("target_frames", listed(sorted(twice)), "others than tracker_child_frames", advice)
        return names

    @property
    def topics(self) -> BagTopics:
        """The topics of the drivers; the same rules hold for those of a node and of a bag."""
        children, states = (
            tuple(filter(None, t)) for t in (self.tracker_child_frames, self.tracker_state_topics)
        )
        return BagTopics(self.joint_topics, self.tracker_topics, children, states)


@dataclass(frozen=True)
class ExecutorParameters(Watch, PaceParameters, RobotParameters):
    """Parameters of ``plan_executor``."""

    controller_action: str = at_configure(
        "joint_trajectory_controller/follow_joint_trajectory",
        "action control_msgs/FollowJointTrajectory of the robot's controller",
    )
    plan_topic: str = at_configure(
        "calibration_planner/current_plan", "topic of the plan that ~/execute executes"
    )
    joint_topics: tuple[str, ...] = at_configure(("joint_states",), JOINT_TOPICS)
    tracker_state_topics: tuple[str, ...] = at_configure(
        ("tracker/locked",),
        "topics std_msgs/Bool on which the tracker says whether it holds a target, one per target; a topic on "
        "which nothing was heard is not watched",
    )
    step: bool = parameter(False, "wait for ~/confirm before every move")
    moveit_group: str = at_configure(
        "", "planning group of MoveIt, which plans every move; empty = straight lines in joint space"
    )
    moveit_service: str = at_configure("plan_kinematic_path", "service moveit_msgs/GetMotionPlan of MoveIt")
    planning_time: float = parameter(5.0, "longest time for the planning of a move", "s", 0.1, 600.0)


@dataclass(frozen=True)
class SimulatorParameters(LifecycleParameters, Faults):
    """Parameters of ``tracker_simulator``."""

    cell: str = parameter("", CELL, read_only=True)
    robot: str = at_configure("kuka_kr270", "name of a shipped robot")
    parameters: str = at_configure("lengths+offsets", "which parameters have true errors: a level or names")
    seed: int = at_configure(0, "seed of everything that is drawn", "", 0, LARGEST_SEED)
    error_model: str = at_configure(
        "typical",
        "how the robot errs besides its parameters: typical (gravity, joint functions, repeatability), "
        "paper (not at all), or the path of a YAML file, also of an estimate",
    )
    length_error: float = at_configure(
        LENGTH_ERROR, "standard deviation of the true errors of lengths", "m", 0.0, 1.0
    )
    angle_error: float = at_configure(
        ANGLE_ERROR, "standard deviation of the true errors of angles", "rad", 0.0, 1.0
    )
    true_deviations: str = at_configure("", "true errors instead of random ones, as d1=0.0005,q2=-0.001 [m, rad]")
    sigma: float = at_configure(3e-5, "noise of one coordinate of a tracker point", "m", 0.0, 1.0)
    instrument: str = at_configure(
        "sigma",
        "the tracker's noise: sigma for all coordinates, or that of a shipped instrument",
        choices=("sigma", *shipped_instruments()),
    )
    joint_rate: float = at_configure(100.0, "rate of joint_states", "Hz", 1.0, 1000.0)
    tracker_rate: float = at_configure(50.0, "rate of tracker points", "Hz", 0.1, 1000.0)
    joint_speed: float = parameter(6.0, "largest joint speed", "rad/s", 1e-3, 100.0)
    dwell: float = parameter(0.8, "length of a standstill, per measurement", "s", 0.0, 600.0)
    tracker_topics: tuple[str, ...] = at_configure(("tracker/point",), TOPICS)
    tracker_state_topics: tuple[str, ...] = at_configure(
        ("tracker/locked",), "topics on which it says whether the tracker holds its targets"
    )
    controller_action: str = at_configure(
        "joint_trajectory_controller/follow_joint_trajectory",
        "action control_msgs/FollowJointTrajectory by which the robot is moved, if control_msgs is installed",
    )
    plan_topic: str = at_configure("calibration_planner/current_plan", PLAN_TOPIC)
    frame_id: str = at_configure("tracker", "name of the tracker's frame")

    def deviations(self, names: Sequence[str]) -> dict[str, float]:
        """``true_deviations`` by parameter name; refuses names not in ``names`` and values not finite."""
        result = {}
        for word in filter(None, (w.strip() for w in self.true_deviations.split(","))):
            name, _, text = word.partition("=")
            if name.strip() not in names:
                raise UnknownNameError("true_deviations", name.strip(), names)
            (result[name.strip()],) = _numbers(
                "true_deviations", text, word, "name=number with commas between", 1
            )
        return result


@dataclass(frozen=True)
class CampaignParameters(PlanParameters):
    """Parameters of ``calibration_campaign``; what can change is taken when a campaign begins (~/start)."""

    targets: int = parameter(0, "reflectors; 0 = as the robot has, others need unknown: tool", "", 0, 100)
    test_poses: str = parameter(
        "", "where accuracy matters: joint coordinates [rad | m] with spaces between, poses with semicolons"
    )
    required_accuracy: float = parameter(1e-4, "largest rms error at the test poses that will do", "m", 1e-9, 1.0)
    budget: int = parameter(60, "measurements allowed in all, with validation and failed ones", "", 2, 10000)
    batch: int = parameter(6, "configurations planned at a time", "", 1, 200)
    validation: int = parameter(6, "measurements at the end that take no part in the fit", "", 0, 1000)
    minimum: int = parameter(4, "fewest different configurations, however good the estimate seems", "", 1, 1000)
    attempts: int = parameter(2, "attempts at a configuration before it is given up", "", 1, 100)
    most_failures: int = parameter(20, "configurations given up before the campaign ends", "", 0, 10000)
    exclusion: float = parameter(
        0.05,
        "half width of the neighbourhood that is given up with a configuration, share of each joint's range",
        "",
        1e-4,
        0.5,
    )
    sigma: float = parameter(1e-5, "expected noise of one coordinate of one measurement", "m", 1e-9, 1.0)
    error_model: str = parameter("typical", ERROR_MODEL)
    accuracy_frame: str = parameter("world", FRAME, choices=ACCURACIES)
    starts: int = parameter(0, "random starts of the search; 0: as many as usual", "", 0, 100000)
    seed: int = parameter(0, "seed of the plans", "", 0, LARGEST_SEED)
    store_folder: str = parameter(
        "",
        "folder of the campaign and its results, which a restart goes on with; empty = lost with the node",
        read_only=True,
    )
    review: bool = parameter(
        False,
        "wait for ~/resume after the first plan, so that its configurations can be looked at, and left out or "
        "replaced with ~/skip_configuration",
    )
    execute_action: str = at_configure("tracker_simulator/execute_plan", "action ExecutePlan of the robot")
    identifier: str = at_configure(
        "calibration_identifier", "name of the identifier, whose parameter plan_topic names ~/plan of this node"
    )
    dwell: float = parameter(0.0, "length of a standstill, per measurement; 0 = the robot's", "s", 0.0, 600.0)
    patience: float = parameter(10.0, "longest wait for the identifier after a standstill", "s", 0.1, 3600.0)
    silence: float = parameter(30.0, "longest time without feedback from the robot as it moves", "s", 0.5, 3600.0)
    longest_wait: float = parameter(
        600.0, "pause when robot or identifier is away for so long", "s", 1.0, 86400.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.budget <= self.validation:
            raise InputError("budget", self.budget, f"more than validation, which is {self.validation}")
        _ = self.test_pose_rows

    @property
    def test_pose_rows(self) -> tuple[tuple[float, ...], ...]:
        """``test_poses`` as numbers [rad | m], a row per pose."""
        expected = "numbers with spaces between, poses with semicolons"
        poses = (text.strip() for text in self.test_poses.split(";"))
        return tuple(_numbers("test_poses", t.replace(",", " "), t, expected) for t in poses if t)


@dataclass(frozen=True)
class PageParameters(RobotParameters):
    """Parameters of ``calibration_page``."""

    robot: str = at_configure(
        "", "name of a shipped robot, to be drawn; empty = the campaign's, if it is shipped"
    )
    host: str = at_configure(
        "127.0.0.1", "address to listen at; 127.0.0.1 = this machine alone, 0.0.0.0 = every network, with a token"
    )
    port: int = at_configure(8470, "port to listen at; 0 = any, which the node logs", "", 0, 65535)
    token: str = at_configure(
        "",
        "what a browser has to know, 16 letters or more; empty = nothing on this machine alone, else one is made "
        "and logged",
    )
    report_folder: str = at_configure(
        "", "folder of the reports that the page may show, the identifier's save_folder; empty = it shows none"
    )
    campaign: str = at_configure("calibration_campaign", "name of the campaign's node")
    identifier: str = at_configure("calibration_identifier", "name of the identifier")
    executor: str = at_configure(
        "plan_executor", "name of the node with action ~/execute_plan and services ~/stop and ~/confirm"
    )
    joint_topics: tuple[str, ...] = at_configure(("joint_states",), "topics of the joint states")


def _numbers(field: str, text: str, got: str, expected: str, count: int | None = None) -> tuple[float, ...]:
    """The finite numbers between the blanks of ``text``, ``count`` of them unless it is ``None``."""
    try:
        row = tuple(float(word) for word in text.split())
    except ValueError:
        row = (np.nan,)
    if not np.isfinite(row).all() or count not in (None, len(row)):
        raise InputError(field, cut(got, 100), expected)
    return row


NODES: dict[str, tuple[type[Any], str]] = {
    "planner": (PlannerParameters, "calibration_planner"),
    "identifier": (IdentifierParameters, "calibration_identifier"),
    "simulator": (SimulatorParameters, "tracker_simulator"),
    "campaign": (CampaignParameters, "calibration_campaign"),
    "executor": (ExecutorParameters, "plan_executor"),
    "page": (PageParameters, "calibration_page"),
}
"""Name of the file in config → parameters and name of the node."""


def yaml_text(name: str) -> str:
    """The text of ``config/NAME.yaml``: every parameter at its default, with its description."""
    kind, node = NODES[name]
    lines = [
        f"# All parameters of the node {node} ({name}_node), at their defaults.",
        f"# Use: python -m calib_planner.ros.nodes.{name} --ros-args --params-file config/{name}.yaml",
        "/**:",
        "  ros__parameters:",
    ]
    for item in fields(kind):
        comment = "; ".join(filter(None, (described(item), constraints_text(item))))
        lines += [f"    # {comment}", f"    {item.name}: {_yaml_value(item.default)}"]
    return "\n".join(lines) + "\n"


def _yaml_value(value: Any) -> str:
    """As YAML that ROS reads with the right type: it would take 3e-05 for a text."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(text or '""' for text in value) + "]"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, float):
        text = f"{value:.12f}".rstrip("0")
        return text + "0" if text.endswith(".") else text
    return str(value)


def main() -> int:
    """Write the files."""
    for name in NODES:
        (config_folder() / f"{name}.yaml").write_text(yaml_text(name), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
