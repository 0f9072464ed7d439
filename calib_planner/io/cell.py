# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""One file for one cell: the robot, what it carries, where the reflectors sit, the instrument, what is unknown.

``cell.yaml`` says once what every command needs. Its keys are the names of the options; a value is what the
option takes, and a length may carry its unit:

    robot: irb120.urdf            # a path from this file's folder, or the name of a shipped robot
    tip-link: tool0
    targets: [[60mm, 20mm, 90mm]] # a row per reflector
    unknown: base,tool
    payload: [3.2, 0, 0, 0.05]    # kg, then m
    mounting: ceiling
    sigma: 20um
    units: mm,deg                 # of data files and of angles in arguments

``CELL_KEYS`` is the whole schema. ``Cell`` gives the pieces of problems; the command line takes the same values
as options (``Cell.options``), and what is given there wins. The keys of ``ROS_KEYS`` are for the nodes alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.error_model import ACCURACIES, ErrorModel, Payload, gravity_of, typical
from calib_planner.errors import InputError
from calib_planner.io.conditions import read_constraints, read_instrument, read_vertical
from calib_planner.io.error_model import read_error_model
from calib_planner.io.robots import Robot, shipped_robots
from calib_planner.io.sizes import angle_factors
from calib_planner.io.text import user_path, write_text
from calib_planner.io.yaml import Node, read_yaml, yaml_line
from calib_planner.planning import Constraint
from calib_planner.robot import parse_coupling
from calib_planner.tracker import Isotropic, Noise
from calib_planner.units import Units

NAMED_MODELS = ("typical", "paper")
MOUNTINGS = ("floor", "ceiling")
UNITS = ("mm", "deg")
EVERYTHING_KNOWN = "none"
"""Value of ``unknown`` for a base and targets that are as they are stated."""


@dataclass(frozen=True)
class Key:
    """A key of the file.

    Attributes:
        read: What makes the value of ``Cell`` out of the node.
        takes: What stands there, for people.
        meaning: What it says.
    """

    read: Callable[[Node], Any]
    takes: str
    meaning: str


# ── the kinds of values ──────────────────────────────────────────────────────────────────────────────


def _file(node: Node) -> str:
    """A file that is there, its path from the folder of this one."""
    path = Path(node.path).parent / user_path(node.text())
    if not path.is_file():
        raise node.refused("a file that is there", "paths are from the folder of the file that names them")
    return str(path)


def _robot(node: Node) -> str:
    name = node.text()
    if name in shipped_robots():
        return name
    path = Path(node.path).parent / user_path(name)
    if not path.is_file():
        valid = f"a file that is there, or one of: {', '.join(shipped_robots())}"
        raise node.refused(valid, "paths are from the folder of the file that names them")
    return str(path)


def _model(node: Node) -> str:
    return node.text() if node.value in NAMED_MODELS else _file(node)


def _words(node: Node) -> tuple[str, ...]:
    """Words with commas between, or a list of them."""
    given = node.value if isinstance(node.value, list) else node.text().split(",")
    if not all(isinstance(word, str) and word.strip() for word in given):
        raise node.refused("names with commas between, or a list of names")
    return tuple(word.strip() for word in given)


def _some_of(valid: Sequence[str]) -> Callable[[Node], tuple[str, ...]]:
    def read(node: Node) -> tuple[str, ...]:
        words = _words(node)
        for word in words:
            if word not in valid:
                raise node.refused(f"some of: {', '.join(valid)}")
        return words

    return read


def _items(node: Node, counts: Sequence[int] = ()) -> list[Node]:
    """The numbers of a list, or of a text with blanks or commas between."""
    value = node.value
    if isinstance(value, str):
        value = value.replace(",", " ").split()
    items = Node(node.path, node.where, value if isinstance(value, list) else [value]).items()
    if counts and len(items) not in counts:
        raise node.refused(f"{' or '.join(map(str, counts))} numbers")
    return items


def _folder(node: Node) -> str:
    """A folder that need not be there, its path from the folder of this file."""
    return str(Path(node.path).parent / user_path(node.text()))


def _count(low: int) -> Callable[[Node], int]:
    def read(node: Node) -> int:
        value = node.value
        if type(value) is not int or value < low:
            raise node.refused(f"a whole number, at least {low}")
        return value

    return read


def _seconds(node: Node) -> float:
    value = node.quantity("s")
    if not 0 <= value <= 3600:
        raise node.refused("0 to 3600 s")
    return value


def _above_zero(most: float, unit: str) -> Callable[[Node], float]:
    def read(node: Node) -> float:
        value = node.number()
        if not 0 < value <= most:
            raise node.refused(f"above 0, at most {most:g}{unit}")
        return value

    return read


def _lengths(node: Node) -> tuple[float, ...]:
    return tuple(item.quantity("m") for item in _items(node, (3,)))


def _rows(read: Callable[[Node], tuple[float, ...]]) -> Callable[[Node], tuple[tuple[float, ...], ...]]:
    """A list of rows, or a single row."""

    def rows(node: Node) -> tuple[tuple[float, ...], ...]:
        several = isinstance(node.value, list) and node.value and isinstance(node.value[0], (list, str))
        several = several and not (isinstance(node.value[0], str) and len(_items(node.items()[0])) == 1)
        return tuple(read(row) for row in (node.items() if several else [node]))

    return rows


def _numbers(node: Node) -> tuple[float, ...]:
    return tuple(_plain(item).number() for item in _items(node))


def _plain(node: Node) -> Node:
    """A number of a row that was written as text."""
    if not isinstance(node.value, str):
        return node
    try:
        return replace(node, value=float(node.value))
    except ValueError:
        raise node.refused("a number") from None


def _payload(node: Node) -> tuple[float, ...]:
    mass, *place = _items(node, (1, 4))
    return (mass.quantity("kg"), *(item.quantity("m") for item in place))


def _mounting(node: Node) -> str | tuple[float, float, float]:
    if isinstance(node.value, str) and node.value in MOUNTINGS:
        return node.value
    if isinstance(node.value, str) and node.value.isalpha():
        raise node.refused(f"{', '.join(MOUNTINGS)} or a direction downwards: [x, y, z]")
    return _direction(node)


def _couplings(node: Node) -> tuple[str, ...]:
    texts = []
    for item in node.items() if isinstance(node.value, list) else [node]:
        try:
            texts.append(str(parse_coupling(item.text())))
        except InputError as error:
            raise item.error(error.got, error.expected, error.advice) from None
    return tuple(texts)


def _direction(node: Node) -> tuple[float, float, float]:
    x, y, z = (_plain(item).number() for item in _items(node, (3,)))
    if not any((x, y, z)):
        raise node.refused("a direction that is not zero")
    return x, y, z


CELL_KEYS: dict[str, Key] = {
    "robot": Key(_robot, "path, or name of a shipped robot", "URDF or robot YAML"),
    "base-link": Key(Node.text, "name", "first link of the chain in a URDF (its root)"),
    "tip-link": Key(Node.text, "name", "last link of the chain in a URDF (its only end, or tool0)"),
    "targets": Key(
        _rows(_lengths), "[x, y, z], or a list of these [m]", "reflectors in the frame of the last link"
    ),
    "couple": Key(_couplings, "j3+=j2, or a list of these", "joints that the controller shows beside others"),
    "parameters": Key(_words, "level or names", "what is identified (the robot's own)"),
    "unknown": Key(
        _some_of(("base", "tool", EVERYTHING_KNOWN)), "base, tool, base,tool or none", "places that nobody knows"
    ),
    "payload": Key(_payload, "mass [kg], or [mass, x, y, z] [kg, m]", "what the robot carries, in the last link"),
    "mounting": Key(_mounting, "floor, ceiling or [x, y, z]", "which way is down in the frame of the base"),
    "vertical": Key(_direction, "[x, y, z]", "which way is up in the frame of the points, instead of mounting"),
    "instrument": Key(_file, "path", "noise by direction, and the station"),
    "sigma": Key(lambda node: node.quantity("m"), "length [m]", "noise of a coordinate, instead of instrument"),
    "constraints": Key(_file, "path", "workspace, floor, the tracker's view, …"),
    "error-model": Key(_model, "typical, paper or path", "how the robot errs; also an earlier estimate"),
    "accuracy-frame": Key(lambda node: node.choice(ACCURACIES), "world or robot", "what an accuracy is"),
    "required-accuracy": Key(lambda node: node.quantity("m"), "length [m]", "largest acceptable error at a pose"),
    "test-pose": Key(_rows(_numbers), "[q1, …, qn], or a list of these [rad | m]", "where accuracy matters"),
    "test-path": Key(_file, "path", "table of further test poses"),
    "units": Key(_some_of(UNITS), "mm, deg or mm,deg", "of data files and of angles in arguments (m and rad)"),
    "speed": Key(_above_zero(100, " rad/s or m/s"), "number [rad/s | m/s]", "largest speed of every joint"),
    "speed-share": Key(_above_zero(1, ""), "share", "of the speed limits in the URDF, instead of speed"),
    "settle": Key(_seconds, "time [s]", "at rest before each measurement, until the arm is still (2)"),
    "dwell": Key(_seconds, "time [s]", "of each measurement, at rest (3)"),
    "budget": Key(_count(2), "number", "measurements allowed in all in a campaign, with validation (60)"),
    "validation": Key(_count(0), "number", "measurements of a campaign that take no part in the fit (6)"),
    "store-folder": Key(_folder, "path", "what was measured and what came of it; a restart goes on with it"),
    "joint-topics": Key(_words, "names", "topics of joint states, each with some of the joints (joint_states)"),
    "tracker-topics": Key(_words, "names", "topics of the points, one per target (tracker/point)"),
    "tracker-frames": Key(_words, "names", "child frame of each target, where the tracker sends transforms"),
    "tracker-state-topics": Key(_words, "names", "topics on which the tracker says whether it holds each target"),
    "controller": Key(Node.text, "name", "action FollowJointTrajectory of the robot's controller"),
    "moveit-group": Key(Node.text, "name", "MoveIt plans every move of this group (straight lines of joints)"),
    "base-frame": Key(Node.text, "name", "frame of the robot's base (base_link)"),
}
"""Key → how it is read and what it means; the names are those of the options."""
EITHER = (("instrument", "sigma"), ("mounting", "vertical"), ("speed", "speed-share"))
"""Keys of which one says what the other would."""
ROS_KEYS = ("store-folder", "joint-topics", "tracker-topics", "tracker-frames", "tracker-state-topics",
            "controller", "moveit-group", "base-frame")  # fmt: skip
"""Keys that no command has as an option."""


@dataclass(frozen=True)
class Cell:
    """What ``cell.yaml`` says; ``None`` where it says nothing. Paths are as seen from here.

    Attributes:
        path: The file.
        robot: Path of a URDF or robot YAML, or name of a shipped robot.
        base_link, tip_link: The ends of the chain in a URDF.
        targets: Rows x, y, z of the reflectors in the frame of the last link [m].
        couple: Joints that the controller shows together with others, ``j3+=j2``.
        parameters: Names, or one level, of the parameters to be identified.
        unknown: ``base``, ``tool``, both, or ``none``.
        payload: Mass [kg], and where its centre of gravity is if that is said [m].
        mounting: ``floor``, ``ceiling`` or the direction downwards in the frame of the base.
        vertical: The direction upwards in the frame of the points.
        instrument, constraints, test_path: Paths of files.
        sigma: Standard deviation of a coordinate [m].
        error_model: A name or the path of a file.
        accuracy_frame: ``world`` or ``robot``.
        required_accuracy: Largest acceptable error [m].
        test_pose: Rows of joint values, in the unit that ``units`` says.
        units: Of data files and of angles: ``mm``, ``deg`` or both; metres and radians otherwise.
        speed: Largest speed of every joint [rad/s | m/s].
        speed_share: Share of the joints' speed limits.
        settle, dwell: Times at rest, before and for a measurement [s].
        budget, validation: Measurements of a campaign.
        store_folder: Path of a folder.
        joint_topics, tracker_topics, tracker_frames, tracker_state_topics: Names of topics and frames.
        controller: Name of an action.
        moveit_group: Name of a planning group.
        base_frame: Name of a frame.
    """

    path: str
    robot: str | None = None
    base_link: str | None = None
    tip_link: str | None = None
    targets: tuple[tuple[float, ...], ...] | None = None
    couple: tuple[str, ...] | None = None
    parameters: tuple[str, ...] | None = None
    unknown: tuple[str, ...] | None = None
    payload: tuple[float, ...] | None = None
    mounting: str | tuple[float, float, float] | None = None
    vertical: tuple[float, float, float] | None = None
    instrument: str | None = None
    sigma: float | None = None
    constraints: str | None = None
    error_model: str | None = None
    accuracy_frame: str | None = None
    required_accuracy: float | None = None
    test_pose: tuple[tuple[float, ...], ...] | None = None
    test_path: str | None = None
    units: tuple[str, ...] | None = None
    speed: float | None = None
    speed_share: float | None = None
    settle: float | None = None
    dwell: float | None = None
    budget: int | None = None
    validation: int | None = None
    store_folder: str | None = None
    joint_topics: tuple[str, ...] | None = None
    tracker_topics: tuple[str, ...] | None = None
    tracker_frames: tuple[str, ...] | None = None
    tracker_state_topics: tuple[str, ...] | None = None
    controller: str | None = None
    moveit_group: str | None = None
    base_frame: str | None = None

    def options(self) -> dict[str, tuple[str, ...]]:
        """Option → the values that it would be given; without a value for one that is switched on."""
        given: dict[str, tuple[str, ...]] = {}
        for key in (key for key in CELL_KEYS if key not in ROS_KEYS):
            value = getattr(self, field_of(key))
            if key == "units":
                given |= {"--degrees": ()} if "deg" in (value or ()) else {}
                given |= {"--millimetres": ()} if "mm" in (value or ()) else {}
            elif key == "couple" and value is not None:
                given[f"--{key}"] = value
            elif key in ("targets", "test-pose") and value is not None:
                given[f"--{key}"] = tuple(_joined(row, " ") for row in value)
            elif value is not None:
                given[f"--{key}"] = (_joined(value, "," if key in ("unknown", "parameters") else " "),)
        return given

    # ── the pieces of problems ───────────────────────────────────────────────────────────────────────

    def load_robot(self) -> Robot:
        """The robot with its targets and its active parameters.

        Raises:
            FileFormatError: The cell names no robot, or the robot's file cannot be used.
            InputError: Links, targets or parameters do not fit it.
        """
        if self.robot is None:
            raise Node(self.path, "robot", None).error("no such key", "this key", "name the robot")
        robot = Robot.load(self.robot, base_link=self.base_link, tip_link=self.tip_link)
        if self.couple is not None:
            robot = robot.with_couplings([parse_coupling(text) for text in self.couple])
        if self.targets is not None:
            robot = robot.with_targets(self.targets)
        unknown = [u for u in self.unknown or () if u != EVERYTHING_KNOWN]
        wanted = robot.parameter_names if self.parameters is None else ",".join(self.parameters)
        return robot.with_parameters(wanted, unknown)

    def load_noise(self) -> Noise | None:
        """The instrument; ``None`` where the cell does not say."""
        if self.instrument is not None:
            return read_instrument(self.instrument)
        return None if self.sigma is None else Isotropic(self.sigma)

    def load_test_poses(self, robot: Robot) -> FloatArray | None:
        """(K, joints) where accuracy matters [rad | m]; ``None`` where the cell does not say.

        Raises:
            FileFormatError: A row does not fit ``robot``, or the file of further ones cannot be used.
        """
        # What reads tables, 0.05 s, is imported for test poses only.
        from calib_planner.io.data import read_configurations
        from calib_planner.io.understanding import Reading

        units, names, poses = self.units or (), robot.joint_names, []
        for row in self.test_pose or ():
            if len(row) != len(names):
                node = Node(self.path, "test-pose", row)
                raise node.error(f"{len(row)} numbers", f"{len(names)} numbers a pose: {', '.join(names)}")
            poses.append(np.array([row]) * angle_factors(robot, degrees="deg" in units))
        if self.test_path is not None:
            otherwise = Units("mm" if "mm" in units else "", "deg" if "deg" in units else "")
            poses.append(read_configurations(self.test_path, robot, Reading(otherwise=otherwise)))
        return np.vstack(poses) if poses else None

    def load_constraints(self, robot: Robot) -> tuple[Constraint, ...]:
        """What may be measured."""
        return () if self.constraints is None else read_constraints(self.constraints, robot)

    def load_error_model(self, robot: Robot) -> ErrorModel:
        """How ``robot`` errs (typical, where the cell does not say), with its payload and its mounting.

        Raises:
            FileFormatError: The file cannot be used, or payload or mounting are said of a model without gravity.
        """
        source = self.error_model or "typical"
        model = read_error_model(source, self.load_noise())
        if source == "typical":
            model = typical(self.load_noise(), gravity=gravity_of(robot))
        if model.gravity is None:
            for key in ("payload", "mounting", "vertical"):
                if getattr(self, key) is not None:
                    node = Node(self.path, key, getattr(self, key))
                    raise node.error("a value", "an error model with gravity", "give error-model: typical")
            return model
        gravity, vertical = model.gravity, self.vertical
        if self.payload is not None:
            mass, *place = self.payload
            x, y, z = place or (0.0, 0.0, 0.0)
            gravity = gravity.with_payload(Payload(mass, (x, y, z)) if mass else None)
        if vertical is None and self.mounting is None and self.instrument is not None:
            vertical = read_vertical(self.instrument)
        if self.mounting is not None:
            gravity = replace(gravity, mounting=self.mounting, vertical=None)
        elif vertical is not None:
            gravity = replace(gravity, vertical=vertical)
        return replace(model, gravity=gravity)


def field_of(key: str) -> str:
    """The field of ``Cell`` that a key of the file fills."""
    return key.replace("-", "_")


def _joined(value: str | float | Sequence[Any], mark: str) -> str:
    if isinstance(value, (str, float, int)):
        return str(value)
    return mark.join(str(item) for item in value)


def read_cell(path: str | Path) -> Cell:
    """Read a cell.

    Raises:
        FileFormatError: Names the key at fault, what it holds and what is valid.
    """
    return _cell(read_yaml(path, "a YAML file of a cell"))


def _cell(top: Node) -> Cell:
    top.mapping(CELL_KEYS)
    for one, other in EITHER:
        if one in top and other in top:
            raise top[other].error(f"{one} beside it", "one of the two")
    return Cell(str(top.path), **{field_of(key): CELL_KEYS[key].read(node) for key, node in top.entries()})


def write_cell(path: str | Path, values: Mapping[str, Any], field: str = "output") -> Cell:
    """Write a cell, with what each key means beside it.

    Args:
        path: The file.
        values: Key → plain value, as in the file; paths are from its folder.
        field: The argument or option that named the path, for errors.

    Returns:
        What ``read_cell`` reads from it.

    Raises:
        InputError: It cannot be written.
        FileFormatError: A value that a cell cannot have; nothing is written.
    """
    cell = _cell(Node(path, "", dict(values)))
    lines = [
        "# A cell of calib_planner: every command takes it with --cell. Paths are from this file's folder.\n"
    ]
    for key, meaning in CELL_KEYS.items():
        if key in values:
            lines.append(f"\n# {meaning.meaning}: {meaning.takes}\n{yaml_line(key, values[key])}")
    write_text(path, "".join(lines), field)
    return cell
