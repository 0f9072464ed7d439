"""The parameters of the nodes; ``config/*.yaml`` repeats them for users, a test keeps both equal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import Field, dataclass, fields
from typing import Any

import numpy as np

from calib_planner.acquisition import StandstillSettings
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.io import config_folder, shipped_robots
from calib_planner.planning import CRITERIA
from calib_planner.robot import Robot
from calib_planner.ros.lifecycle import LifecycleParameters
from calib_planner.ros.parameters import constraints_text, parameter
from calib_planner.simulation import Faults
from calib_planner.units import cut

ROBOT = "shipped robot name"
LEVEL = "error parameters: a level (offsets, lengths, lengths+offsets, full) or names with commas"


def shipped_instruments() -> tuple[str, ...]:
    """Names of the instruments in config/instruments, sorted."""
    return tuple(sorted(p.stem for p in (config_folder() / "instruments").glob("*.yaml")))


@dataclass(frozen=True)
class PlannerParameters(LifecycleParameters):
    """Parameters of ``calibration_planner``."""

    robot: str = parameter("kuka_kr270", ROBOT + "; empty = only robot_description", at_configure=True)
    use_robot_description: bool = parameter(
        True, "a URDF heard on robot_description replaces robot", at_configure=True
    )
    base_link: str = parameter(
        "", "robot_description: first link of the chain; empty = the root", at_configure=True
    )
    tip_link: str = parameter("", "robot_description: last link; empty = the only tip", at_configure=True)
    parameters: str = parameter("lengths+offsets", LEVEL)
    unknown: str = parameter("", "what else is unknown: base, tool or base,tool")
    criterion: str = parameter(
        "test_pose", "what is optimised, unless the request says otherwise", choices=CRITERIA
    )
    configurations: int = parameter(12, "configurations of a plan, unless the request says", low=1, high=10000)
    repetitions: int = parameter(1, "measurements at each configuration", low=1, high=10000)
    sigma: float = parameter(3e-5, "noise of one measured coordinate", unit="m", low=1e-9, high=1.0)
    starts: int = parameter(64, "random starts of the search", low=1, high=100000)
    time_limit: float = parameter(60.0, "longest search", unit="s", low=0.01, high=86400.0)
    most_configurations: int = parameter(200, "largest plan that is accepted", low=1, high=10000)
    most_test_poses: int = parameter(1000, "most test poses that are accepted", low=1, high=10000)
    most_candidates: int = parameter(2000, "most candidates that are accepted", low=1, high=10000)
    constraints: str = parameter(
        "", "what may be measured: a file in constraints_folder; empty = joint limits only", at_configure=True
    )
    constraints_folder: str = parameter("", "folder of constraints; empty = the package's config", read_only=True)
    joint_speed: float = parameter(
        0.5, "~/trajectory: largest speed of turning joints", unit="rad/s", low=1e-3, high=100.0
    )
    slide_speed: float = parameter(
        0.1, "~/trajectory: largest speed of sliding joints", unit="m/s", low=1e-4, high=100.0
    )
    dwell: float = parameter(5.0, "~/trajectory: standing still per measurement", unit="s", low=0.0, high=3600.0)
    frame_id: str = parameter("base_link", "frame of the robot's base")

    def __post_init__(self) -> None:
        for word in unknown_words(self.unknown):
            if word not in ("base", "tool"):
                raise UnknownNameError("unknown", cut(word, 100), ("base", "tool"))


@dataclass(frozen=True)
class IdentifierParameters(LifecycleParameters):
    """Parameters of ``calibration_identifier``; the standstill's are those of ``StandstillSettings``."""

    robot: str = parameter("kuka_kr270", ROBOT + "; empty = only robot_description", at_configure=True)
    use_robot_description: bool = parameter(
        True, "a URDF heard on robot_description replaces robot, until something is accepted", at_configure=True
    )
    base_link: str = parameter(
        "", "robot_description: first link of the chain; empty = the root", at_configure=True
    )
    tip_link: str = parameter("", "robot_description: last link; empty = the only tip", at_configure=True)
    parameters: str = parameter("", LEVEL + "; empty = those of the plan", at_configure=True)
    unknown: str = parameter("", "what else is unknown: base, tool or base,tool", at_configure=True)
    sigma: float = parameter(
        3e-5, "noise of one coordinate of one tracker point; 0 = from their scatter", unit="m", low=0, high=1
    )
    repeatability: float = parameter(
        0.0, "noise that averaging does not reduce (robot, reflector)", unit="m", low=0.0, high=1.0
    )
    tracker_topics: tuple[str, ...] = parameter(("tracker/point",), "one topic per target", at_configure=True)
    plan_topic: str = parameter(
        "calibration_planner/current_plan", "where the plan comes from", at_configure=True
    )
    plan_tolerance: float = parameter(
        0.01, "largest joint difference to a planned configuration", unit="rad or m", low=1e-6, high=1.0
    )
    accept_unplanned: bool = parameter(False, "use standstills that are in no plan")
    keep_measurements: bool = parameter(False, "a new plan goes on with what was measured for the one before")
    most_measurements: int = parameter(5000, "measurements kept at most", low=1, high=1000000)
    store_folder: str = parameter(
        "",
        "folder of the campaign: accepted is what is on its disk, and a restart goes on there; "
        "empty = in memory only, lost with the node",
        read_only=True,
    )
    save_folder: str = parameter(
        "",
        "folder for ~/save and ~/report; empty = store_folder; without either saving is off",
        read_only=True,
    )
    clock_offset: float = parameter(
        0.1,
        "largest offset of the clocks of joints and points, by when both stop and start",
        unit="s",
        low=1e-3,
        high=60.0,
    )
    diagnostics_period: float = parameter(
        1.0, "time between two messages on /diagnostics", unit="s", low=0.05, high=3600.0, at_configure=True
    )
    joint_tolerance: float = parameter(
        1e-4, "standstill: largest range of a joint", unit="rad or m", low=1e-9, high=1.0, at_configure=True
    )
    point_tolerance: float = parameter(
        3e-4,
        "standstill: largest range of a coordinate, about ten times sigma",
        unit="m",
        low=1e-7,
        high=1.0,
        at_configure=True,
    )
    settle: float = parameter(
        0.1, "standstill: left out after the joints rest", unit="s", low=0.0, high=60.0, at_configure=True
    )
    duration: float = parameter(
        0.4, "standstill: shortest interval averaged", unit="s", low=0.01, high=600.0, at_configure=True
    )
    samples: int = parameter(
        20, "standstill: points of every target wanted", low=1, high=20000, at_configure=True
    )
    minimum_samples: int = parameter(
        5, "standstill: points of a target needed to use it", low=1, high=20000, at_configure=True
    )
    patience: float = parameter(
        2.0, "standstill: after this take what there is", unit="s", low=0.01, high=600.0, at_configure=True
    )
    gap: float = parameter(
        0.25, "standstill: longest pause within a stream", unit="s", low=1e-3, high=60.0, at_configure=True
    )
    window: float = parameter(
        0.1, "standstill: how late a message may come", unit="s", low=0.0, high=60.0, at_configure=True
    )
    skew: float = parameter(
        0.5,
        "standstill: largest difference of the streams' stamps",
        unit="s",
        low=1e-3,
        high=60.0,
        at_configure=True,
    )

    def __post_init__(self) -> None:
        _ = self.standstill
        if not self.tracker_topics or not all(self.tracker_topics):
            raise InputError("tracker_topics", self.tracker_topics, "one topic name per target")

    @property
    def standstill(self) -> StandstillSettings:
        """The part that decides what a standstill is."""
        return StandstillSettings(**{f.name: getattr(self, f.name) for f in fields(StandstillSettings)})


@dataclass(frozen=True)
class SimulatorParameters(LifecycleParameters, Faults):
    """Parameters of ``tracker_simulator``; what goes wrong is inherited, see ``Faults``."""

    robot: str = parameter("kuka_kr270", ROBOT, at_configure=True)
    parameters: str = parameter("lengths+offsets", "which have true errors: a level or names", at_configure=True)
    seed: int = parameter(0, "seed of all that is drawn", low=0, high=2**31 - 1, at_configure=True)
    length_error: float = parameter(
        1e-3, "standard deviation of the true errors of lengths", unit="m", low=0.0, high=1.0, at_configure=True
    )
    angle_error: float = parameter(
        1e-3, "standard deviation of the true errors of angles", unit="rad", low=0.0, high=1.0, at_configure=True
    )
    true_deviations: str = parameter(
        "", "true errors instead of random ones, as d1=0.0005,q2=-0.001 [m, rad]", at_configure=True
    )
    sigma: float = parameter(
        3e-5, "noise of one coordinate of a tracker point", unit="m", low=0.0, high=1.0, at_configure=True
    )
    instrument: str = parameter(
        "sigma",
        "the tracker's noise: sigma alike, or a shipped instrument",
        choices=("sigma", *shipped_instruments()),
        at_configure=True,
    )
    joint_rate: float = parameter(
        100.0, "rate of joint_states", unit="Hz", low=1.0, high=1000.0, at_configure=True
    )
    tracker_rate: float = parameter(
        50.0, "rate of tracker points", unit="Hz", low=0.1, high=1000.0, at_configure=True
    )
    joint_speed: float = parameter(6.0, "largest joint speed", unit="rad/s", low=1e-3, high=100.0)
    dwell: float = parameter(0.8, "standing still per measurement", unit="s", low=0.0, high=600.0)
    tracker_topics: tuple[str, ...] = parameter(("tracker/point",), "one topic per target", at_configure=True)
    frame_id: str = parameter("tracker", "frame of the tracker's points", at_configure=True)

    def deviations(self, names: Sequence[str]) -> dict[str, float]:
        """``true_deviations`` by parameter name; refuses names not in ``names`` and values not finite."""
        result = {}
        for word in filter(None, (w.strip() for w in self.true_deviations.split(","))):
            name, _, text = word.partition("=")
            if name.strip() not in names:
                raise UnknownNameError("true_deviations", name.strip(), names)
            try:
                value = float(text)
            except ValueError:
                value = float("nan")
            if not np.isfinite(value):
                raise InputError("true_deviations", word, "name=number with commas between")
            result[name.strip()] = value
        return result


@dataclass(frozen=True)
class CampaignParameters(LifecycleParameters):
    """Parameters of ``calibration_campaign``; what is asked is taken when a campaign begins (~/start)."""

    robot: str = parameter("kuka_kr270", ROBOT + "; empty = only robot_description", at_configure=True)
    use_robot_description: bool = parameter(
        True, "a URDF heard on robot_description replaces robot", at_configure=True
    )
    base_link: str = parameter(
        "", "robot_description: first link of the chain; empty = the root", at_configure=True
    )
    tip_link: str = parameter("", "robot_description: last link; empty = the only tip", at_configure=True)
    parameters: str = parameter("lengths+offsets", LEVEL)
    unknown: str = parameter("", "what else is unknown: base, tool or base,tool")
    targets: int = parameter(
        0, "reflectors; 0 = as the robot has; others are at the tip, with unknown tool", low=0, high=100
    )
    test_poses: str = parameter(
        "", "where accuracy matters: joint coordinates [rad | m] with spaces between, poses with semicolons"
    )
    required_accuracy: float = parameter(
        1e-4, "largest root mean square error at a test pose that will do", unit="m", low=1e-9, high=1.0
    )
    budget: int = parameter(60, "measurements allowed in all, validation and failures too", low=2, high=10000)
    batch: int = parameter(6, "configurations planned at a time", low=1, high=200)
    validation: int = parameter(6, "measurements at the end that take no part in the fit", low=0, high=1000)
    minimum: int = parameter(4, "fewest different configurations, however accurate they look", low=1, high=1000)
    attempts: int = parameter(2, "tries at a configuration before it is given up", low=1, high=100)
    most_failures: int = parameter(20, "configurations given up before the campaign ends", low=0, high=10000)
    exclusion: float = parameter(
        0.05,
        "half width of what is given up with a configuration, share of each joint's range",
        low=1e-4,
        high=0.5,
    )
    sigma: float = parameter(
        1e-5, "expected noise of one coordinate of one measurement", unit="m", low=1e-9, high=1.0
    )
    joint_corrections: str = parameter(
        "auto", "errors of the joints' transmissions are learnt where the data show them", choices=("auto", "off")
    )
    constraints: str = parameter(
        "", "what may be measured: a file in constraints_folder; empty = joint limits only"
    )
    constraints_folder: str = parameter("", "folder of constraints; empty = the package's config", read_only=True)
    starts: int = parameter(16, "random starts of each plan's search", low=1, high=100000)
    time_limit: float = parameter(60.0, "longest search of a plan", unit="s", low=0.01, high=86400.0)
    seed: int = parameter(0, "seed of the plans", low=0, high=2**31 - 1)
    store_folder: str = parameter(
        "",
        "folder of the campaign's journal and results: a restart goes on there; empty = lost with the node",
        read_only=True,
    )
    execute_action: str = parameter(
        "tracker_simulator/execute_plan", "the robot: an ExecutePlan action", at_configure=True
    )
    identifier: str = parameter(
        "calibration_identifier",
        "name of the identifier, whose plan_topic is this node's ~/plan",
        at_configure=True,
    )
    dwell: float = parameter(
        0.0, "standing still per measurement; 0 = the robot's", unit="s", low=0.0, high=600.0
    )
    patience: float = parameter(
        10.0, "after the robot stood, longest wait for the identifier's word", unit="s", low=0.1, high=3600.0
    )
    silence: float = parameter(
        30.0, "longest time without a sign of life from the robot while it moves", unit="s", low=0.5, high=3600.0
    )
    longest_wait: float = parameter(
        600.0, "a robot or identifier that is away this long pauses the campaign", unit="s", low=1.0, high=86400.0
    )
    frame_id: str = parameter("base_link", "frame of the robot's base")

    def __post_init__(self) -> None:
        for word in unknown_words(self.unknown):
            if word not in ("base", "tool"):
                raise UnknownNameError("unknown", cut(word, 100), ("base", "tool"))
        if self.budget <= self.validation:
            raise InputError("budget", self.budget, f"more than validation, which is {self.validation}")
        _ = self.test_pose_rows

    @property
    def test_pose_rows(self) -> tuple[tuple[float, ...], ...]:
        """``test_poses`` as numbers, a row per pose."""
        rows = []
        for text in filter(None, (p.strip() for p in self.test_poses.split(";"))):
            try:
                row = tuple(float(word) for word in text.replace(",", " ").split())
            except ValueError:
                row = (float("nan"),)
            if not np.isfinite(row).all():
                expected = "numbers with spaces between, poses with semicolons"
                raise InputError("test_poses", cut(text, 100), expected)
            rows.append(row)
        return tuple(rows)


def unknown_words(text: str) -> list[str]:
    """The words between the commas of a parameter ``unknown``."""
    return [w.strip() for w in text.split(",") if w.strip()]


def load_shipped(
    name: str, parameters: str | Sequence[str], unknown: str = "", targets: int | None = None
) -> Robot:
    """A shipped robot with active parameters; other sources are refused, since names may come from anyone.

    Args:
        targets: Number of targets; more than the robot has are at the tip, with ``tool`` unknown.
    """
    if name not in shipped_robots():
        raise UnknownNameError("robot", name, shipped_robots())
    robot = with_topics(Robot.load(name), targets, unknown)
    return robot.with_parameters(parameters, unknown_words(unknown))


def with_topics(robot: Robot, topics: int | None, unknown: str) -> Robot:
    """The robot with a target per topic; other than its own ones are at the tip, with ``tool`` unknown."""
    if topics is None or topics == len(robot.targets):
        return robot
    if "tool" not in unknown_words(unknown):
        expected = f"{len(robot.targets)} topics, as the robot has targets"
        raise InputError("tracker_topics", f"{topics} topics", expected, "or set unknown to tool")
    return robot.with_targets(np.zeros((topics, 3)))


# ── The files ``config/*.yaml`` of the nodes: written from the dataclasses, so that both say the same ───────
#     python -m calib_planner.ros.settings
#
# writes them again after a parameter was added; a test compares.

NODES: dict[str, tuple[type[Any], str]] = {
    "planner": (PlannerParameters, "calibration_planner"),
    "identifier": (IdentifierParameters, "calibration_identifier"),
    "simulator": (SimulatorParameters, "tracker_simulator"),
    "campaign": (CampaignParameters, "calibration_campaign"),
}
"""Name of the file → the parameters and the node's name."""


def yaml_text(name: str) -> str:
    """The text of ``config/NAME.yaml``: every parameter at its default, with its description."""
    kind, node = NODES[name]
    lines = [
        f"# Parameters of the node {node} ({name}_node): every one there is, at its default.",
        f"# Use: python -m calib_planner.ros.nodes.{name} --ros-args --params-file config/{name}.yaml",
        "/**:",
        "  ros__parameters:",
    ]
    for item in fields(kind):
        lines += [f"    # {_comment(item)}", f"    {item.name}: {_value(item.default)}"]
    return "\n".join(lines) + "\n"


def _comment(item: Field[Any]) -> str:
    unit = f" [{item.metadata['unit']}]" if item.metadata["unit"] else ""
    limits = constraints_text(item)
    return item.metadata["description"] + unit + (f"; {limits}" if limits else "")


def _value(value: Any) -> str:
    """As YAML that ROS reads with the right type: 3e-05 would be a text."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(value) + "]"
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
