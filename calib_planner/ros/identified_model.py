"""Which robot the identifier identifies, with the text that says so.

A shipped robot by name, a URDF heard on ``robot_description``, or the one that a campaign in the store belongs
to. The text is kept with the campaign: a model that changes under it would change what its measurements say.
"""

from __future__ import annotations

from dataclasses import dataclass

from calib_planner.io import StoredModel, read_text, stored_model
from calib_planner.planning import Plan
from calib_planner.robot import Robot
from calib_planner.ros.model_source import TOPIC, described_model
from calib_planner.ros.settings import IdentifierParameters, load_shipped, unknown_words, with_topics

DEFAULT_LEVEL = "lengths+offsets"
"""What is identified while neither a parameter nor a plan says so."""


@dataclass(frozen=True, eq=False)
class IdentifiedModel:
    """A robot with a target per topic.

    Attributes:
        robot: Its active parameters are those of the node's parameter.
        stored: What a store says of it.
        settings: The node's parameters.
    """

    robot: Robot
    stored: StoredModel
    settings: IdentifierParameters

    @property
    def urdf(self) -> str:
        """The URDF it was read from; empty if it was not read from one."""
        return self.stored.source if self.stored.origin == TOPIC else ""

    def follow(self, plan: Plan) -> Robot:
        """The robot with the parameters that a plan is for, unless the node's own say otherwise.

        Raises:
            UnknownNameError: It has no such parameters.
        """
        chosen = self.settings
        return self.robot.with_parameters(chosen.parameters or plan.parameters, unknown_words(chosen.unknown))


def first_model(settings: IdentifierParameters) -> IdentifiedModel | None:
    """The model to begin with; ``None`` if a description has to be waited for.

    Raises:
        CalibPlannerError: There is no such robot, or the store cannot be used.
    """
    if settings.use_robot_description:
        stored = stored_model(settings.store_folder)
        if stored is not None and stored.origin == TOPIC:
            return heard_model(stored.source, settings)
    return shipped_model(settings) if settings.robot else None


def shipped_model(settings: IdentifierParameters) -> IdentifiedModel:
    """The robot that the parameter ``robot`` names.

    Raises:
        CalibPlannerError: There is no such robot, or it has no such parameters or targets.
    """
    level, topics = settings.parameters or DEFAULT_LEVEL, len(settings.tracker_topics)
    robot = load_shipped(settings.robot, level, settings.unknown, topics)
    return _model(robot, read_text(robot.source, "a robot YAML"), settings.robot, settings)


def heard_model(text: str, settings: IdentifierParameters) -> IdentifiedModel:
    """The robot of a URDF from the wire.

    Raises:
        CalibPlannerError: It is refused.
    """
    found = described_model(text, settings.base_link, settings.tip_link).robot
    robot = with_topics(found, len(settings.tracker_topics), settings.unknown)
    level = settings.parameters or DEFAULT_LEVEL
    return _model(robot.with_parameters(level, unknown_words(settings.unknown)), text, TOPIC, settings)


def _model(robot: Robot, text: str, origin: str, settings: IdentifierParameters) -> IdentifiedModel:
    stored = StoredModel(robot.name, robot.joint_names, len(robot.targets), text, origin)
    return IdentifiedModel(robot, stored, settings)
