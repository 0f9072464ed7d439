# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Which robot a node works for: a shipped one by name, or the URDF heard on ``robot_description``.

Anyone on the graph may publish a robot description. It is therefore bounded before it is parsed (length, number
of links and joints), and the reader of URDFs refuses document types, which are the way to entities. A description
that is refused changes nothing: the robot before it stays, or a bad description could take the planner out of
service. Since the refused one may describe the robot that is there, ``ModelSource.refusal`` is said beside every
plan until a description is accepted again; and no robot executes a plan for a robot of another name.

The identifier keeps the text from which its robot was read with its measurements: if the model changed under
them, they would say something else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from std_msgs.msg import String

from calib_planner.arrays import FloatArray, frozen
from calib_planner.errors import CalibPlannerError, FileFormatError, InputError, UnknownNameError
from calib_planner.io import (
    URDF_SUFFIXES,
    Cell,
    StoredModel,
    parse_chain,
    parse_speed_limits,
    parse_urdf,
    read_speed_limits,
    read_text,
    read_urdf_text,
    shipped_robots,
    split_arguments,
    stored_model,
)
from calib_planner.planning import Plan
from calib_planner.robot import Robot
from calib_planner.ros.cell import cell_of
from calib_planner.ros.lifecycle import ManagedNode
from calib_planner.ros.messages import in_ros
from calib_planner.ros.parameters import LATCHED
from calib_planner.ros.settings import IdentifierParameters, PlanParameters, RobotParameters, unknown_words
from calib_planner.units import brief, cut

TOPIC = "robot_description"
LONGEST_TEXT = 4_000_000
"""Characters of a description, at most; the longest in common use have some 400 000."""
MOST_ITEMS = 2000
"""Links, and joints, of a description, at most."""
MOST_MOVING = 64
"""Moving joints of the chain, at most."""
LONGEST_NAME = 200
DEFAULT_LEVEL = "lengths+offsets"
DEFAULT_TIP = "tool0"
"""Name of the tip's frame of robots that are not from a URDF, as in ROS-Industrial."""
"""What is identified while neither a parameter nor a plan says so."""


class NotReady(CalibPlannerError):
    """There is no robot to plan for; the text says what is missing."""


@dataclass(frozen=True, eq=False)
class Model:
    """A robot and the speed limits of its description.

    Attributes:
        robot: The robot.
        speeds: (joints,) speed limits [rad/s | m/s]; infinite where none is known.
    """

    robot: Robot
    speeds: FloatArray


def shipped_model(name: str, parameters: str | Sequence[str], unknown: str) -> Model:
    """A shipped robot without speed limits; errors as ``load_shipped``."""
    robot = load_shipped(name, parameters, unknown)
    return Model(robot, _no_limits(robot))


def cell_model(cell: Cell, parameters: str | Sequence[str], unknown: str) -> Model:
    """The robot of a cell and the speed limits of its URDF.

    Raises:
        CalibPlannerError: The cell, or the file of its robot, cannot be used.
    """
    robot = cell.load_robot().with_parameters(parameters, unknown_words(unknown))
    speeds = read_speed_limits(robot.source, robot.joint_names) if is_urdf(robot) else None
    return Model(robot, _no_limits(robot) if speeds is None else speeds)


def is_urdf(robot: Robot) -> bool:
    """Whether a robot was read from a URDF."""
    return split_arguments(robot.source)[0].suffix in URDF_SUFFIXES


def load_shipped(
    name: str, parameters: str | Sequence[str], unknown: str = "", targets: int | None = None
) -> Robot:
    """A shipped robot with free parameters; paths are refused, since anyone may send a name.

    Args:
        name: Name of the robot.
        parameters: A level or names.
        unknown: What else is unknown, see ``unknown_words``.
        targets: Number of targets, see ``with_targets``.

    Raises:
        UnknownNameError: Not a shipped robot, or it has no such parameters.
    """
    if name not in shipped_robots():
        raise UnknownNameError("robot", name, shipped_robots())
    return with_targets(Robot.load(name), targets, unknown).with_parameters(parameters, unknown_words(unknown))


def with_targets(robot: Robot, targets: int | None, unknown: str) -> Robot:
    """The robot with as many targets; another number than its own puts all at the tip, with ``tool`` unknown.

    Raises:
        InputError: ``unknown`` does not hold ``tool``.
    """
    if targets is None or targets == len(robot.targets):
        return robot
    if "tool" not in unknown_words(unknown):
        expected = f"{len(robot.targets)} topics, as the robot has targets"
        raise InputError("tracker_topics", f"{targets} topics", expected, "or set unknown to tool")
    return robot.with_targets(np.zeros((targets, 3)))


def described_model(text: str, base_link: str = "", tip_link: str = "") -> Model:
    """The robot of a URDF from the wire.

    Raises:
        FileFormatError: Too large, not a URDF, or no single chain between the links.
    """
    _check_size(text)
    robot = parse_urdf(text, TOPIC, base_link or None, tip_link or None)
    if len(robot.joint_names) > MOST_MOVING:
        got, advice = f"{len(robot.joint_names)} moving joints in the chain", "set base_link and tip_link"
        raise FileFormatError(TOPIC, "chain", got, f"at most {MOST_MOVING}", advice)
    for name in (robot.name, *robot.joint_names):
        if len(name) > LONGEST_NAME or not name.isprintable():
            raise FileFormatError(TOPIC, "name", brief(name, 40), f"at most {LONGEST_NAME} printable characters")
    speeds = parse_speed_limits(text, TOPIC, robot.joint_names)
    return Model(robot, _no_limits(robot) if speeds is None else speeds)


def _no_limits(robot: Robot) -> FloatArray:
    return frozen(np.full(len(robot.joint_names), np.inf))


def _check_size(text: str) -> None:
    if len(text) > LONGEST_TEXT:
        raise FileFormatError(TOPIC, "text", f"{len(text)} characters", f"at most {LONGEST_TEXT}")
    for item in ("link", "joint"):
        count = text.count(f"<{item}")
        if count > MOST_ITEMS:
            raise FileFormatError(TOPIC, f"<{item}>", f"{count} of them", f"at most {MOST_ITEMS}")


class ModelSource:
    """The model in use by a node that plans; it changes by assignment of one value at a time.

    Attributes:
        model: The model, or why there is none.
        refusal: Why the newest description was refused and which robot stays; empty if it was not refused.
    """

    def __init__(self, settings: RobotParameters) -> None:
        self._settings = settings
        self._text = self.refusal = ""
        self.model: Model | NotReady = NotReady(
            f"no robot yet: publish a URDF on {TOPIC} (latched), or set the parameter robot; "
            "a request may also name a shipped robot"
        )
        wanted = (DEFAULT_LEVEL, "")
        if isinstance(settings, PlanParameters):
            wanted = (settings.parameters, settings.unknown)
        cell = cell_of(settings)
        if cell is not None:
            self.model = cell_model(cell, *wanted)
        elif settings.robot:
            self.model = shipped_model(settings.robot, *wanted)

    def follow(self, node: ManagedNode[Any], taken: Callable[[Model], None], **options: Any) -> None:
        """In ``configure``: subscribe to descriptions, if they are wanted; ``taken`` gets every new model."""

        def on_description(message: String) -> None:
            try:
                model = self.take(message.data)
            except CalibPlannerError:
                node.get_logger().error(self.refusal, throttle_duration_sec=1.0)
                return
            if model is not None:
                taken(model)

        if self._settings.use_robot_description and not self._settings.cell:
            node.create_subscription(String, TOPIC, on_description, LATCHED, **options)

    def take(self, text: str) -> Model | None:
        """Take a description; ``None`` if it is the one in use.

        Raises:
            CalibPlannerError: It is refused; ``refusal`` says what that means.
        """
        if text and text == self._text:
            self.refusal = ""
            return None
        try:
            model = described_model(text, self._settings.base_link, self._settings.tip_link)
        except CalibPlannerError as error:
            self.refusal = f"{TOPIC} refused: {cut(in_ros(str(error)), 800)}"
            if isinstance(self.model, Model):
                self.refusal += f"; {self.model.robot.name} stays the robot"
            else:
                self.model = NotReady(self.refusal)
            raise
        self.model, self._text, self.refusal = model, text, ""
        return model


@dataclass(frozen=True, eq=False)
class IdentifiedModel:
    """The robot of the identifier, with a target per topic.

    Attributes:
        robot: The robot; its free parameters are those of the node's parameter.
        stored: What a store says of it.
        settings: The node's parameters.
    """

    robot: Robot
    stored: StoredModel
    settings: IdentifierParameters

    @property
    def urdf(self) -> str:
        """The URDF that it was read from; empty if it was not read from one."""
        text = self.stored.source
        return text if text.lstrip().startswith("<") else ""

    @cached_property
    def ends(self) -> tuple[str, str]:
        """Names of the frames of base and tip: links of the URDF, or as the parameters say."""
        chosen, cell = self.settings, cell_of(self.settings)
        if not self.urdf:
            return chosen.frame_id, chosen.tip_frame or DEFAULT_TIP
        links = (chosen.base_link, chosen.tip_link) if cell is None else (cell.base_link, cell.tip_link)
        chain = parse_chain(self.urdf, self.stored.origin, *(link or None for link in links))
        return chain.base, chosen.tip_frame or chain.tip

    def follow(self, plan: Plan) -> Robot:
        """The robot with the free parameters of a plan, unless the node's own say otherwise.

        Raises:
            UnknownNameError: It has no such parameters.
        """
        chosen = self.settings
        return self.robot.with_parameters(chosen.parameters or plan.parameters, unknown_words(chosen.unknown))


def first_model(settings: IdentifierParameters) -> IdentifiedModel | None:
    """The model to begin with: that of the store, or that of the parameter; ``None`` to wait for a description.

    Raises:
        CalibPlannerError: There is no such robot, it has no such parameters, or the store cannot be used.
    """
    cell, level = cell_of(settings), settings.parameters or DEFAULT_LEVEL
    targets = len(settings.tracker_topics)
    if cell is not None:
        robot = with_targets(cell.load_robot(), targets, settings.unknown)
        robot = robot.with_parameters(level, unknown_words(settings.unknown))
        text = read_urdf_text(robot.source) if is_urdf(robot) else read_text(robot.source, "a robot YAML")
        return _identified(robot, text, cell.path, settings)
    if settings.use_robot_description:
        stored = stored_model(settings.store_folder)
        if stored is not None and stored.origin == TOPIC:
            return heard_model(stored.source, settings)
    if not settings.robot:
        return None
    robot = load_shipped(settings.robot, level, settings.unknown, targets)
    return _identified(robot, read_text(robot.source, "a robot YAML"), settings.robot, settings)


def heard_model(text: str, settings: IdentifierParameters) -> IdentifiedModel:
    """The robot of a URDF from the wire.

    Raises:
        CalibPlannerError: It is refused.
    """
    described = described_model(text, settings.base_link, settings.tip_link).robot
    robot = with_targets(described, len(settings.tracker_topics), settings.unknown)
    robot = robot.with_parameters(settings.parameters or DEFAULT_LEVEL, unknown_words(settings.unknown))
    return _identified(robot, text, TOPIC, settings)


def _identified(robot: Robot, text: str, origin: str, settings: IdentifierParameters) -> IdentifiedModel:
    stored = StoredModel(robot.name, robot.joint_names, len(robot.targets), text, origin)
    return IdentifiedModel(robot, stored, settings)
