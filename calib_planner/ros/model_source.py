"""Which robot the planner plans for: a shipped one by name, or the URDF heard on ``robot_description``.

Anyone on the graph may publish a robot description, so it is bounded before it is parsed (length, number of
links and joints), and ``robot.urdf`` refuses document types, which are the way to entities. What is refused
changes nothing: the robot before it stays, heard or by name, or whoever sends rubbish could take the planner out
of service. Since the refused one may be the machine that is there, ``refusal`` is said beside every plan until a
description is accepted again; and no machine executes a plan of another robot's name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib_planner.arrays import FloatArray, frozen
from calib_planner.errors import CalibPlannerError, FileFormatError
from calib_planner.io import parse_speed_limits, parse_urdf
from calib_planner.robot import Robot
from calib_planner.ros.settings import PlannerParameters, load_shipped, unknown_words

TOPIC = "robot_description"
LONGEST_TEXT = 4_000_000
"""Characters of a description; the longest in common use have some 400 000."""
MOST_ITEMS = 2000
"""Links, and joints, of a description."""
MOST_MOVING = 64
"""Moving joints of the chain."""
LONGEST_NAME = 200


class NotReady(CalibPlannerError):
    """There is no robot to plan for; the text says what is missing."""


@dataclass(frozen=True, eq=False)
class Model:
    """A robot and what else is known of it.

    Attributes:
        robot: Its geometry.
        speeds: (joints,) speed limits of the description [rad/s | m/s]; infinite where none is known.
        described: Whether it was heard, not loaded by name.
    """

    robot: Robot
    speeds: FloatArray
    described: bool = False


def shipped_model(name: str, parameters: str | Sequence[str], unknown: str) -> Model:
    """A robot by name.

    Raises:
        UnknownNameError: Not a shipped robot, or it has no such parameters.
    """
    words = unknown_words(unknown)
    robot = _loaded(name).with_parameters(parameters, words)
    return Model(robot, _no_limits(robot))


@lru_cache(maxsize=16)
def _loaded(name: str) -> Robot:
    """Read once: a request that names a robot should not wait for its file."""
    return load_shipped(name, "full")


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
            raise FileFormatError(TOPIC, "name", ascii(name[:40]), f"at most {LONGEST_NAME} printable characters")
    speeds = parse_speed_limits(text, TOPIC, robot.joint_names)
    return Model(robot, _no_limits(robot) if speeds is None else speeds, described=True)


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
    """The model in force; the only thing here that changes, by assignment of one value at a time.

    Attributes:
        refusal: Why the newest description was refused and what stays; empty if it was not.
    """

    def __init__(self, settings: PlannerParameters) -> None:
        self._settings = settings
        self._text = self.refusal = ""
        self._found: Model | NotReady = NotReady(
            f"no robot yet: publish a URDF on {TOPIC} (latched), or set the parameter robot; "
            "a request may also name a shipped robot"
        )
        if settings.robot:
            self._found = shipped_model(settings.robot, settings.parameters, settings.unknown)

    @property
    def model(self) -> Model | NotReady:
        """The model, or why there is none."""
        return self._found

    def take(self, text: str) -> Model | None:
        """Take a description; ``None`` if it is the one in force.

        Raises:
            CalibPlannerError: It is refused; ``refusal`` says what that means.
        """
        if text and text == self._text:
            self.refusal = ""
            return None
        try:
            found = described_model(text, self._settings.base_link, self._settings.tip_link)
        except CalibPlannerError as error:
            self.refusal = f"{TOPIC} refused: {str(error)[:800]}"
            if isinstance(self._found, Model):
                self.refusal += f"; {self._found.robot.name} stays the robot"
            else:
                self._found = NotReady(self.refusal)
            raise
        self._found, self._text, self.refusal = found, text, ""
        return found
