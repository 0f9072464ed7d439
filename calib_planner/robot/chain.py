# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The robot: eq. (1) and (2), a serial chain of elementary transforms with named parameters.

A ``Robot`` never changes. ``with_parameters``, ``with_base``, ``with_targets`` and ``with_deviations`` return
another robot. All geometric parameters that a robot could have are in its elements from the start; those that
are not active are constants, and constants that are zero cost nothing (see ``kinematics``).

Frames: positions are in the *base frame of the chain's first element*: the robot's base, or the tracker's
frame once the base pose has been set. Order of joints: ``joint_names``. Order of parameters:
``parameter_names``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_planner.arrays import FloatArray, check_array, check_configurations, frozen, remembered
from calib_planner.errors import CalibPlannerError, InputError, UnknownNameError
from calib_planner.robot.coupling import Coupling, coupling_matrix, enclosing_limits
from calib_planner.robot.elements import Element, roll_pitch_yaw, rotation
from calib_planner.robot.kinematics import Program, Structure, codes_of, compile_program, structure_of
from calib_planner.robot.linearisation import Layout, Linearisation, Posture
from calib_planner.robot.masses import LinkMass, fault_of
from calib_planner.robot.parameters import Parameter, resolve_parameters
from calib_planner.units import Told, listed

POINT = (Element("Tx"), Element("Ty"), Element("Tz"))
"""The branch from a link to a point of it."""
MOST_PROGRAMS = 64
"""Programs that a robot remembers."""
OF_STRUCTURE = ("coupling", "_layout", "_turning", "_programs")
"""What a robot has computed that does not depend on the amounts of its elements."""
LIMIT_TOLERANCE = 1e-6
"""A coordinate beyond its joint limit by less than this is on it [rad | m]: files and screens round limits and
coordinates to six decimals."""


def _no_file_reader(source: object, **links: object) -> Robot:
    raise CalibPlannerError(f"{source}: robot files are read by calib_planner.io; import it first")


_file_reader: list[Callable[..., Robot]] = [_no_file_reader]


def register_file_reader(reader: Callable[..., Robot]) -> None:
    """Make ``reader(source, base_link=…, tip_link=…)`` what ``Robot.load`` calls.

    ``calib_planner.io`` registers its reader when it is imported. The kinematic model itself knows no files.
    """
    _file_reader[0] = reader


@dataclass(frozen=True, eq=False, repr=False)
class Robot(Told):
    """A serial robot with one or more targets at its tip.

    Attributes:
        name: Short name.
        elements: The trunk, base pose first, up to the tip.
        targets: Per target the three translations from the tip, in the tip's frame.
        joint_names: Names in joint order.
        joint_limits: (joints, 2) lower and upper [rad | m]; with ``couplings`` the box around what
            ``motion_limits`` allow.
        levels: Level name → parameter names.
        parameter_names: Active parameters, the order of all Jacobian columns.
        source: What the robot was read from.
        from_urdf: Whether it was read from a URDF, that is from the description of a real robot.
        links: Base link and tip link of the chain in its URDF; empty otherwise.
        link_masses: What its file says of the masses of its links; see ``mass_fault``.
        remarks: What is odd in its file, or was chosen when it was read, sentences without a full stop.
        couplings: Joints that the controller shows against others; see ``coupling``. All coordinates are then
            the controller's.
        motion_limits: (joints, 2) limits of the joints' own motions [rad | m], if there are couplings.
    """

    name: str
    elements: tuple[Element, ...]
    targets: tuple[tuple[Element, ...], ...]
    joint_names: tuple[str, ...]
    joint_limits: FloatArray
    levels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    parameter_names: tuple[str, ...] = ()
    source: str = ""
    from_urdf: bool = False
    links: tuple[str, ...] = ()
    link_masses: tuple[LinkMass, ...] = ()
    remarks: tuple[str, ...] = ()
    couplings: tuple[Coupling, ...] = ()
    motion_limits: FloatArray | None = None

    def _facts(self) -> list[tuple[str, object]]:
        shown = [("coupled", listed(map(str, self.couplings)))] if self.couplings else []
        return [
            ("name", self.name),
            ("joints", f"{len(self.joint_names)} ({listed(self.joint_names, 8)})"),
            *shown,
            ("targets", len(self.targets)),
            ("parameters", f"{len(self.parameter_names)} of {len(self.available_parameters)}"),
        ]

    def __post_init__(self) -> None:
        joints = [e.joint for e in self.elements if e.joint is not None]
        if sorted(joints) != list(range(len(self.joint_names))):
            raise InputError("elements", f"joints {sorted(joints)}", "every joint to move exactly one element")
        limits = check_array("joint_limits", self.joint_limits, (len(self.joint_names), 2))
        for name, (low, high) in zip(self.joint_names, limits, strict=True):
            if not low < high:
                raise InputError(f"joint_limits of {name}", f"[{low}, {high}]", "lower < upper")
        object.__setattr__(self, "joint_limits", limits)
        names = [e.parameter for e in self._flat if e.parameter]
        known = set(names)
        if len(known) < len(names):
            doubled = ", ".join(sorted(n for n in known if names.count(n) > 1))
            raise InputError("elements", doubled, "each parameter name once")
        for name in self.parameter_names:
            if name not in known:
                raise UnknownNameError("parameters", name, names)
        for part in self.link_masses:
            if not 0 <= part.joint < len(self.joint_names):
                raise InputError("link_masses", f"joint number {part.joint}", "the number of a joint, from 0")

    # ── making ───────────────────────────────────────────────────────────────────────────────────────

    @staticmethod
    def load(source: str | Path, *, base_link: str | None = None, tip_link: str | None = None) -> Robot:
        """Load a shipped robot by name, or a robot YAML or URDF by path.

        Raises:
            UnknownNameError: No shipped robot or file of that name.
            FileFormatError: The file does not parse; names the key or element at fault.
        """
        return _file_reader[0](source, base_link=base_link, tip_link=tip_link)

    def with_parameters(self, request: str | Sequence[str], unknown: Iterable[str] = ()) -> Robot:
        """The same robot with other active parameters; see ``parameters.resolve_parameters``."""
        names = resolve_parameters(request, unknown, self.available_parameters, self.levels, len(self.targets))
        return replace(self, parameter_names=names)

    def with_deviations(self, deviations: Mapping[str, float]) -> Robot:
        """The robot whose named parameters are nominal + deviation [m | rad]."""
        known = self._by_name
        for name in deviations:
            if name not in known:
                raise UnknownNameError("deviations", name, self.available_parameters)

        def moved(e: Element) -> Element:
            delta = deviations.get(e.parameter or "", 0.0)
            return e.moved(float(delta)) if delta else e

        result = object.__new__(Robot)  # other amounts: nothing to check, and its programs are the same
        same = (*(f.name for f in fields(Robot)), *OF_STRUCTURE)
        result.__dict__.update((name, getattr(self, name)) for name in same)
        result.__dict__["elements"] = tuple(map(moved, self.elements))
        result.__dict__["targets"] = tuple(tuple(map(moved, branch)) for branch in self.targets)
        return result

    def with_base(self, rotation_matrix: ArrayLike, xyz: ArrayLike) -> Robot:
        """The robot placed at ``xyz`` [m] with axes ``rotation_matrix`` (3, 3), e.g. in a tracker's frame."""
        matrix = check_array("rotation_matrix", rotation_matrix, (3, 3))
        offset = check_array("xyz", xyz, (3,))
        roll, pitch, yaw = roll_pitch_yaw(matrix)
        values = [*offset, yaw, pitch, roll, 0.0, 0.0, 0.0]
        head = tuple(replace(e, value=float(v)) for e, v in zip(self.elements[:9], values, strict=True))
        return replace(self, elements=head + self.elements[9:])

    def with_targets(self, xyz: ArrayLike) -> Robot:
        """The robot with targets at ``xyz``, shape (targets, 3), in the tip's frame [m].

        Parameters of targets that are no longer there are no longer active.
        """
        branches = target_elements(check_array("targets", xyz, (None, 3)))
        gone = {e.parameter for b in self.targets for e in b}
        gone -= {e.parameter for b in branches for e in b}
        names = tuple(n for n in self.parameter_names if n not in gone)
        return replace(self, targets=branches, parameter_names=names)

    def with_couplings(self, couplings: Sequence[Coupling], field: str = "couple") -> Robot:
        """The robot whose controller shows some joints against others, in place of what was said of it before.

        Raises:
            InputError: Not joints of the robot, or nothing that could be undone; names ``field``.
        """
        own = self.own_limits
        if not couplings:
            return replace(self, couplings=(), motion_limits=None, joint_limits=own)
        matrix = coupling_matrix(couplings, self.joint_names, field)
        box = enclosing_limits(own, matrix)
        return replace(self, couplings=tuple(couplings), motion_limits=own, joint_limits=box)

    # ── what it is ───────────────────────────────────────────────────────────────────────────────────

    @cached_property
    def _flat(self) -> tuple[Element, ...]:
        return self.elements + tuple(e for branch in self.targets for e in branch)

    @cached_property
    def _by_name(self) -> dict[str, Parameter]:
        return {
            e.parameter: Parameter(e.parameter, e.unit, e.value, i)
            for i, e in enumerate(self._flat)
            if e.parameter
        }

    @property
    def available_parameters(self) -> tuple[str, ...]:
        """Names of all parameters that can be made active, in chain order."""
        return tuple(self._by_name)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The active parameters, in the order of the Jacobian's columns."""
        return tuple(self._by_name[n] for n in self.parameter_names)

    @cached_property
    def base_pose(self) -> tuple[FloatArray, FloatArray]:
        """Rotation (3, 3) and position (3,) [m] of the base, its placement parameters included."""
        matrix = np.eye(3)
        for e in self.elements[3:9]:
            matrix = matrix @ rotation(e.axis, e.sign * e.value)
        return frozen(matrix), frozen(np.array([e.value for e in self.elements[:3]]))

    @property
    def target_offsets(self) -> FloatArray:
        """(targets, 3) target positions in the tip's frame [m]."""
        return np.array([[e.value for e in branch] for branch in self.targets])

    @property
    def joint_is_revolute(self) -> NDArray[np.bool_]:
        """(joints,) whether each joint turns; the others slide."""
        return np.array(self._layout.joint_rotates)

    @cached_property
    def mass_fault(self) -> str:
        """Why ``link_masses`` are not what the links weigh, in words; empty if nothing speaks against them."""
        reach = 0.0
        for e in self.elements[9:]:
            if not e.is_rotation:
                slide = 0.0 if e.joint is None else float(np.abs(self.joint_limits[e.joint]).max())
                reach += abs(e.value) + slide
        return fault_of(self.link_masses, self.joint_names, reach)

    @cached_property
    def coupling(self) -> FloatArray | None:
        """(joints, joints) C: motions are ``q @ C.T``; ``None`` where every joint is shown by itself."""
        return coupling_matrix(self.couplings, self.joint_names) if self.couplings else None

    @property
    def own_limits(self) -> FloatArray:
        """(joints, 2) limits of the joints' own motions [rad | m]."""
        return self.joint_limits if self.motion_limits is None else self.motion_limits

    def motions(self, q: NDArray[Any]) -> NDArray[Any]:
        """(N, joints) coordinates as shown → (N, joints) motions of the chain's joints [rad | m]."""
        return q if self.coupling is None else q @ self.coupling.T

    def beyond_limits(self, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) [rad | m] → (N, joints) bool: which joints are outside their limits."""
        low, high = self.own_limits.T
        moved = self.motions(q)
        return np.asarray((moved < low - LIMIT_TOLERANCE) | (moved > high + LIMIT_TOLERANCE))

    def check_within_limits(self, field: str, q: FloatArray) -> None:
        """Refuse configurations (N, joints) [rad | m] outside the joint limits.

        Raises:
            InputError: Names row and joint.
        """
        beyond = np.argwhere(self.beyond_limits(q))
        if len(beyond):
            i, j = (int(k) for k in beyond[0])
            low, high = self.own_limits[j]
            raise InputError(
                f"{field}[{i}], joint {self.joint_names[j]}",
                f"{self.motions(q)[i, j]:.6g}",
                f"a value within the joint limits [{low:.6g}, {high:.6g}] rad or m",
                "check units (degrees?) and joint order",
            )

    # ── where things are ─────────────────────────────────────────────────────────────────────────────

    def positions(self, q: ArrayLike, deviations: ArrayLike | None = None) -> FloatArray:
        """Target positions, eq. (1).

        Args:
            q: (N, joints) or (joints,) joint coordinates in the order of ``joint_names`` [rad | m].
            deviations: (P,) deviations of the active parameters from nominal [m | rad]; default zero.

        Returns:
            (N, targets, 3) positions in the base frame [m].

        Raises:
            InputError: Wrong shape or not finite.
        """
        rows = self._run(self._check_q(q), self._check_deviations(deviations), columns=False)
        return rows.reshape(len(self.targets), 3, -1).transpose(2, 0, 1)

    def jacobian(self, q: ArrayLike, deviations: ArrayLike | None = None) -> FloatArray:
        """Identification Jacobian of eq. (3): ∂position/∂parameter.

        Arguments and errors as for ``positions``.

        Returns:
            (N, 3·targets, P): rows x, y, z target by target, columns in the order of ``parameter_names``,
            base frame [m/m | m/rad].
        """
        return self.positions_and_jacobian(q, deviations)[1]

    def positions_and_jacobian(
        self, q: ArrayLike, deviations: ArrayLike | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Both at the cost of one; see ``positions`` and ``jacobian``."""
        rows = self._run(self._check_q(q), self._check_deviations(deviations), columns=True)
        t = len(self.targets)
        points = rows[: 3 * t].reshape(t, 3, -1).transpose(2, 0, 1)
        columns = rows[3 * t :].reshape(len(self.parameter_names), 3 * t, -1)
        return points, columns.transpose(2, 1, 0)

    def linearise(self, q: ArrayLike, deviations: ArrayLike | None = None) -> Linearisation:
        """Positions, parameter and joint columns and axes at once; see ``Linearisation``."""
        return self._linearise(self._check_q(q), self._check_deviations(deviations))

    def joint_jacobian(self, q: ArrayLike, deviations: ArrayLike | None = None) -> FloatArray:
        """∂position/∂joint, shape (N, 3·targets, joints) [m/rad | 1], base frame."""
        clean, amounts = self._check_q(q), self._amounts(self._check_deviations(deviations))
        joints, t = self._layout.joint_elements, len(self.targets)
        rows = self._program(amounts, joints, ()).run(np.ascontiguousarray(self.motions(clean).T), amounts)
        columns: FloatArray = rows[3 * t :].reshape(len(joints), 3 * t, -1).transpose(2, 1, 0)
        return columns if self.coupling is None else columns @ self.coupling

    def posture(self, q: ArrayLike) -> Posture:
        """Where joints, tip and targets are: every frame of the chain in one pass; see ``Posture``."""
        clean = np.ascontiguousarray(self.motions(self._check_q(q)).T)
        rows = self._posture_program.run(clean, self._nominal_amounts)
        n, t = len(self.joint_names), len(self.targets)
        points = rows.reshape(t + 2 * n + 4, 3, -1).transpose(2, 0, 1)
        return Posture(
            targets=points[:, :t],
            joint_axes=points[:, t : t + n],
            tip_rotation=points[:, t + n : t + n + 3].transpose(0, 2, 1),
            joint_origins=points[:, t + n + 3 : t + 2 * n + 3],
            tip_origin=points[:, -1],
        )

    def link_points(self, q: ArrayLike, joint: int | None, xyz: Sequence[float]) -> FloatArray:
        """(N, 3) where a point of a link is [m].

        Args:
            q: (N, joints) joint coordinates [rad | m].
            joint: Number of the joint that moves the link; ``None``: the tip.
            xyz: (3,) the point in the frame of the link, or of the tip [m].
        """
        known, key = self._links, (joint, *xyz)
        program, amounts = remembered(known, key, MOST_PROGRAMS, lambda: self._link(joint, xyz))
        return program.run(np.ascontiguousarray(self.motions(self._check_q(q)).T), amounts).T

    @cached_property
    def _links(self) -> dict[tuple[float | None, ...], tuple[Program, FloatArray]]:
        return {}

    def _link(self, joint: int | None, xyz: Sequence[float]) -> tuple[Program, FloatArray]:
        """The program and the amounts of ``link_points`` for one point (3,)."""
        trunk, point = self._trunk_to(joint), np.array(xyz, float)
        amounts = np.concatenate([self._nominal_amounts[: len(trunk)], point])
        own = codes_of(point, np.zeros(len(POINT), bool))
        codes = np.concatenate([self._nominal_codes[: len(trunk)], own])

        def structure() -> Structure:
            return structure_of(trunk, (POINT,), codes.tolist(), (), ())

        return self._remembered(("link", codes.tobytes()), structure), amounts

    def _trunk_to(self, joint: int | None) -> tuple[Element, ...]:
        """The elements up to the link that a joint moves; ``None``: up to the tip."""
        if joint is None:
            return self.elements
        end = self._layout.joint_elements[joint] + 1
        # A joint with an oblique axis is turned back behind its motion; its link is there.
        before, behind = self.elements[end - 2], self.elements[end : end + 2]
        if len(behind) == 2 and behind[0] == Element(before.kind, -before.value) and before.value:
            end += 2
        return self.elements[:end]

    # ── inside: arrays are clean from here on ────────────────────────────────────────────────────────

    def _check_q(self, q: ArrayLike) -> FloatArray:
        # Nothing here keeps or changes configurations: an array that is right already needs no copy.
        right = type(q) is np.ndarray and q.dtype == np.float64 and q.shape[1:] == (len(self.joint_names),)
        if right and np.isfinite(q).all():
            return np.asarray(q)
        return check_configurations("configurations", q, self.joint_names)

    def _check_deviations(self, deviations: ArrayLike | None) -> FloatArray | None:
        if deviations is None:
            return None
        meaning = f"deviations of {', '.join(self.parameter_names)}"
        return check_array("deviations", deviations, (len(self.parameter_names),), meaning=meaning)

    @cached_property
    def _layout(self) -> Layout:
        joint_elements = {e.joint: i for i, e in enumerate(self.elements) if e.joint is not None}
        at = tuple(p.element for p in self.parameters)
        joints = tuple(joint_elements[k] for k in range(len(self.joint_names)))
        return Layout(
            at,
            tuple(self._flat[i].is_rotation for i in at),
            joints,
            tuple(self._flat[i].is_rotation for i in joints),
        )

    @cached_property
    def _nominal_amounts(self) -> FloatArray:
        return frozen(np.array([e.value for e in self._flat]))

    @cached_property
    def _turning(self) -> NDArray[np.bool_]:
        return np.array([e.is_rotation and e.joint is None for e in self._flat])

    @cached_property
    def _nominal_codes(self) -> NDArray[np.int8]:
        return codes_of(self._nominal_amounts, self._turning)

    @cached_property
    def _posture_program(self) -> Program:
        joints, trunk = self._layout.joint_elements, len(self.elements)
        # A target's branch begins with Tx, Ty, Tz from the tip: their axes are the tip's.
        axes, origins = (*joints, trunk, trunk + 1, trunk + 2), (*joints, trunk - 1)
        codes = self._nominal_codes

        def structure() -> Structure:
            return structure_of(self.elements, self.targets, codes.tolist(), (), axes, origins)

        return self._remembered(("posture", codes.tobytes()), structure)

    @cached_property
    def _programs(self) -> dict[tuple[Any, ...], Program]:
        return {}

    def _remembered(self, key: tuple[Any, ...], structure: Callable[[], Structure]) -> Program:
        """The program of a structure, remembered by ``key``, which holds the codes and what is wanted."""
        return remembered(self._programs, key, MOST_PROGRAMS, lambda: compile_program(structure()))

    def _program(self, amounts: NDArray[Any], columns: Sequence[int], axes: Sequence[int]) -> Program:
        """The compiled chain: the amounts matter by their codes alone, and programs are remembered by them."""
        codes = self._nominal_codes if amounts is self._nominal_amounts else codes_of(amounts, self._turning)

        def structure() -> Structure:
            return structure_of(self.elements, self.targets, codes.tolist(), columns, axes)

        return self._remembered((codes.tobytes(), columns, axes), structure)

    def _amounts(self, deviations: NDArray[Any] | None) -> NDArray[Any]:
        if deviations is None or not deviations.any():
            return self._nominal_amounts
        amounts = self._nominal_amounts.astype(np.result_type(deviations, np.float64))
        amounts[list(self._layout.parameter_elements)] += deviations
        return amounts

    def _run(self, q: NDArray[Any], deviations: NDArray[Any] | None, *, columns: bool) -> NDArray[Any]:
        """Rows of the program; ``q`` (N, joints), real or complex."""
        amounts = self._amounts(deviations)
        wanted = self._layout.parameter_elements if columns else ()
        return self._program(amounts, wanted, ()).run(np.ascontiguousarray(self.motions(q).T), amounts)

    def _linearise(self, q: NDArray[Any], deviations: NDArray[Any] | None) -> Linearisation:
        lay = self._layout
        amounts = self._amounts(deviations)
        both = lay.parameter_elements + lay.joint_elements
        rows = self._program(amounts, both, both).run(np.ascontiguousarray(self.motions(q).T), amounts)
        t, p, n = len(self.targets), len(lay.parameter_elements), q.shape[0]
        split = 3 * t * (1 + len(both))
        columns = rows[3 * t : split].reshape(len(both), t, 3, n)
        axes = rows[split:].reshape(len(both), 3, n)
        points = rows[: 3 * t].reshape(t, 3, n)
        return Linearisation(points, columns[:p], columns[p:], axes[:p], axes[p:], lay, self.coupling)


def target_elements(xyz: FloatArray) -> tuple[tuple[Element, ...], ...]:
    """Branches from the tip to targets at ``xyz`` (targets, 3) [m], with parameters target_k.x, .y, .z."""
    return tuple(
        tuple(Element("T" + a, float(v), parameter=f"target_{t}.{a}") for a, v in zip("xyz", row, strict=True))
        for t, row in enumerate(xyz, start=1)
    )
