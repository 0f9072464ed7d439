# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""How a robot and its measurement err: the terms together, (M1).

For configuration i and target t, with J⁺ = [∂g/∂Π, B] and β = (ΔΠ, u),

    y_it = g(q_i; Π, base, target_t) + Σ_k B_k(q_i, t) u_k + c(q_i) h_i + s_i + ε_it ,                        (M1)

the terms placement (J), gravity and joint functions (B) bring columns with a normal prior each, M₀ being its
precision (zero where it is flat); the terms visits and points (h, s, ε) bring the covariance R_i of a visit,
whose rows are x, y, z target by target. How large each is, is a *scale* with a value and a log-normal prior.
Nothing else knows these sizes: plan, identification, prediction and simulation ask the same ``ErrorModel``.

The paper is the special case of no gravity, no joint functions, no visits, flat placement and R = σ² I.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_array, check_number
from calib_planner.error_model.gravity import Gravity
from calib_planner.error_model.joint_functions import JointFunctions
from calib_planner.error_model.placement import Placement
from calib_planner.error_model.points import Points
from calib_planner.error_model.poses import Poses
from calib_planner.error_model.visits import Visits
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.robot import Robot
from calib_planner.tracker import Isotropic, Noise

UNKNOWN_SIGMA = 1e-4
"""Standard deviation of a coordinate to begin with where nothing is known of it [m]."""
NOTHING_KNOWN = 1e300
"""Factor of a scale of which nothing is known."""


MEANINGS = {
    Placement.name: Placement.title,
    Gravity.name: Gravity.title,
    **JointFunctions.titles,
    Visits.name: Visits.title,
    Points.name: Points.title,
}
"""Term, or component of the joint functions → what it means."""
OPTIONAL_TERMS = (Gravity.name, JointFunctions.name, Visits.name)
"""Terms that a model may be without."""


@dataclass(frozen=True)
class Scale:
    """A size in the error model.

    Attributes:
        name: Its name, such as ``gravity``.
        value: The value in force [unit].
        median: What is expected before the data [unit].
        factor: Width of that expectation: one standard deviation is a factor of this; one: it is known.
        unit: ``m``, ``rad``, ``rad/m`` or 1.
    """

    name: str
    value: float
    median: float
    factor: float
    unit: str = ""

    def __post_init__(self) -> None:
        for field, low in (("value", 0.0), ("median", 0.0), ("factor", 1.0)):
            name = f"error_model.{self.name}.{field}"
            number = check_number(name, getattr(self, field), low=low, low_open=low == 0.0, unit=self.unit)
            object.__setattr__(self, field, number)

    def at(self, value: float) -> Scale:
        """The same with another value [unit]."""
        if not 0.0 < value < inf:
            return replace(self, value=value)  # which says what is wrong
        result = object.__new__(Scale)  # all else was checked when this one was made
        result.__dict__.update(self.__dict__, value=float(value))
        return result

    @property
    def known(self) -> bool:
        """Whether the data have no say."""
        return self.factor == 1.0


@dataclass(frozen=True)
class ErrorModel:
    """The terms and their scales.

    Attributes:
        placement: Parameters of chain, base and targets.
        gravity: Elastic term, or ``None``.
        joint_functions: Errors of the transmissions, or ``None``.
        visits: What is new at each visit, or ``None``.
        points: What is new at each point.
        scales: Exactly those that the terms use, in their order; others are dropped.
        name: ``typical``, ``paper``, ``estimated`` or the user's word.
    """

    placement: Placement
    gravity: Gravity | None
    joint_functions: JointFunctions | None
    visits: Visits | None
    points: Points
    scales: tuple[Scale, ...]
    name: str = "given"

    def __post_init__(self) -> None:
        have, need = [s.name for s in self.scales], [n for term in self.terms for n in term.scales]
        if len(set(have)) < len(have) or set(need) - set(have):
            raise InputError("error_model.scales", ", ".join(have), f"each of {', '.join(need)} once")
        if self.points.noise is None and not self.points.floor:
            raise InputError("error_model.points", "neither noise nor floor", "at least one of them")
        by_name = {s.name: s for s in self.scales}
        object.__setattr__(self, "scales", tuple(by_name[n] for n in need))

    # ── making ───────────────────────────────────────────────────────────────────────────────────────

    @staticmethod
    def paper(noise: Noise | float | None = None) -> ErrorModel:
        """The paper's, eqs. (6)–(15): flat parameters and nothing but noise.

        Args:
            noise: The instrument, or σ of every coordinate [m]; ``None``: the residuals tell σ, and nothing else.
        """
        if noise is None:
            floor = Scale("floor", UNKNOWN_SIGMA, UNKNOWN_SIGMA, NOTHING_KNOWN, "m")
            return ErrorModel(Placement("flat"), None, None, None, Points(), (floor,), "paper")
        stated = Isotropic(noise) if isinstance(noise, (float, int)) else noise
        points = Points(stated, floor=False)
        return ErrorModel(Placement("flat"), None, None, None, points, (), "paper")

    def with_values(self, values: Mapping[str, float], name: str | None = None) -> ErrorModel:
        """The same terms with other values of the scales; those not named stay."""
        for wrong in set(values) - {s.name for s in self.scales}:
            raise UnknownNameError("error_model.scales", wrong, [s.name for s in self.scales])
        result = object.__new__(ErrorModel)  # the same scales: nothing to check
        scales = tuple(s.at(values[s.name]) if s.name in values else s for s in self.scales)
        result.__dict__.update(self.__dict__, scales=scales, name=self.name if name is None else name)
        return result

    def with_noise(self, noise: Noise | float) -> ErrorModel:
        """The same with a stated instrument, or σ of every coordinate [m].

        The paper's has nothing but noise, so that a stated one leaves nothing to be estimated.
        """
        stated = ErrorModel.paper(noise).points
        points = stated if self.is_papers else replace(self.points, noise=stated.noise)
        return replace(self, points=points)

    def with_drawn_scales(self, rng: np.random.Generator) -> ErrorModel:
        """The same with each scale drawn from its spread, median · factor^N(0, 1).

        A scale that is known stays, and so does one of which nothing is known.
        """
        drawn = rng.standard_normal(len(self.scales))
        values = {
            s.name: s.median * s.factor ** float(d) if 1.0 < s.factor < NOTHING_KNOWN else s.value
            for s, d in zip(self.scales, drawn, strict=True)
        }
        return self.with_values(values)

    def without(self, term: str) -> ErrorModel:
        """The same without ``gravity``, ``joint_functions``, ``visits`` or one component of the second."""
        if self.joint_functions is not None and term in self.joint_functions.components:
            left = tuple(c for c in self.joint_functions.components if c != term)
            if not left:
                return replace(self, joint_functions=None)
            needed = min(JointFunctions(left).harmonics, self.joint_functions.harmonics)
            return replace(self, joint_functions=JointFunctions(left, needed))
        changes: dict[str, Any] = {term: None}
        if term not in OPTIONAL_TERMS:
            raise UnknownNameError("term", term, (*OPTIONAL_TERMS, "smooth", "short"))
        return replace(self, **changes)

    @property
    def placement_alone(self) -> ErrorModel:
        """The same without the terms beside placement that bring columns."""
        changes: dict[str, Any] = {term.name: None for term in self.systematic[1:]}
        return replace(self, **changes)

    # ── what it is ───────────────────────────────────────────────────────────────────────────────────

    @property
    def terms(self) -> tuple[Placement | Gravity | JointFunctions | Visits | Points, ...]:
        """The terms that are there."""
        scattering = () if self.visits is None else (self.visits,)
        return (*self.systematic, *scattering, self.points)

    @property
    def is_papers(self) -> bool:
        """Whether it has nothing but parameters and noise, as the paper's."""
        return len(self.terms) == 2

    @property
    def systematic(self) -> tuple[Placement | Gravity | JointFunctions, ...]:
        """Those that bring columns, placement first."""
        return tuple(t for t in (self.placement, self.gravity, self.joint_functions) if t is not None)

    @property
    def values(self) -> dict[str, float]:
        """Scale → value [unit]."""
        return {s.name: s.value for s in self.scales}

    def names(self, robot: Robot) -> tuple[str, ...]:
        """Names of the coefficients β: the robot's active parameters, then those of the other terms."""
        return tuple(name for term in self.systematic for name in term.names(robot))

    def slices(self, robot: Robot) -> dict[str, slice]:
        """Term → its place among the coefficients."""
        result, start = {}, 0
        for term in self.systematic:
            end = start + term.size(robot)
            result[term.name] = slice(start, end)
            start = end
        return result

    def payloads(self, payload: ArrayLike | None, count: int) -> FloatArray | None:
        """(count,) mass of the payload at each of ``count`` visits [kg], as ``Poses`` wants it.

        Args:
            payload: One for all or one for each visit [kg]; ``None``: what the elastic term states.

        Raises:
            InputError: A mass below zero, or a payload where the elastic term knows none.
        """
        if payload is None or self.gravity is None:
            return None
        given = np.asarray(payload, float)
        masses = check_array("payload", np.full(count, given) if given.ndim == 0 else given, (count,))
        if (masses < 0.0).any():
            raise InputError("payload", f"{masses.min():g} kg", "masses of 0 kg or more")
        if self.gravity.payload is None:
            if not masses.any():
                return None
            advice = "identify with --payload, or with a column payload in the measurements"
            raise InputError("payload", f"{masses.max():g} kg", "none: the error model knows no payload", advice)
        return masses

    # ── columns and priors ───────────────────────────────────────────────────────────────────────────

    def columns(self, poses: Poses) -> FloatArray:
        """J⁺ (N, 3·targets, coefficients), rows x, y, z target by target [m per unit of each coefficient]."""
        return np.concatenate([term.columns(poses) for term in self.systematic], axis=2)

    def deflection(self, poses: Poses, coefficients: FloatArray) -> FloatArray:
        """(N, joints) how far the joints stand from their readings, in units of ``joint_units``.

        Args:
            poses: The readings.
            coefficients: β; those of placement do not matter.
        """
        total, where = np.zeros(poses.q.shape), self.slices(poses.robot)
        for term in self.systematic:
            if not isinstance(term, Placement):
                total += term.deflection(poses, coefficients[where[term.name]])
        return total

    def deflected(self, readings: Poses, coefficients: FloatArray) -> Poses:
        """The same configurations with the deflection of β (coefficients,)."""
        return readings.deflected(self.deflection(readings, coefficients))

    def variances(self, robot: Robot) -> FloatArray:
        """(coefficients,) prior variances, infinite where flat [unit²]; see ``precision`` for M₀."""
        return np.concatenate([term.variances(robot, self.values) for term in self.systematic])

    def means(self, robot: Robot) -> FloatArray:
        """(coefficients,) prior means of β [unit]; 0 but for parameters of which the user states something."""
        means = np.zeros(sum(term.size(robot) for term in self.systematic))
        means[: self.placement.size(robot)] = self.placement.means(robot)
        return means

    def precision(self, robot: Robot) -> FloatArray:
        """M₀ (coefficients, coefficients), zero where the prior is flat [1/unit²]."""
        matrix, stated = np.diag(1.0 / self.variances(robot)), self.placement.stated
        if stated is not None:
            places = np.ix_(*[stated.places(robot.parameter_names)] * 2)
            matrix[places] = np.linalg.inv(np.asarray(stated.covariance))
        return matrix

    def draw_coefficients(self, robot: Robot, rng: np.random.Generator) -> FloatArray:
        """(coefficients,) β drawn from its prior at the scales in force; 0 where the prior is flat [unit].

        Gravity and joint functions come first: they stay the same whatever parameters are active.
        """
        variances, stated = self.variances(robot), self.placement.stated
        drawn = np.roll(rng.standard_normal(len(variances)), self.placement.size(robot))
        beta = np.sqrt(np.where(np.isinf(variances), 0.0, variances)) * drawn
        if stated is not None:
            places = stated.places(robot.parameter_names)
            beta[places] = stated.root @ drawn[places]
        return self.means(robot) + beta

    def gradients(self, robot: Robot) -> dict[str, FloatArray]:
        """Scale → (coefficients,) derivative of ``variances`` by its logarithm, for scales that are not known."""
        where, result = self.slices(robot), {}
        count = sum(term.size(robot) for term in self.systematic)
        for term in self.systematic:
            for name, gradient in term.gradients(robot, self.values).items():
                whole = np.zeros(count)
                whole[where[term.name]] = gradient
                result[name] = whole
        return {s.name: result[s.name] for s in self.scales if not s.known and s.name in result}

    def visit_covariance(
        self, poses: Poses, stated: FloatArray | None = None, points_only: bool = False
    ) -> FloatArray:
        """R_i of (M2), (N, 3·targets, 3·targets) [m²]; see ``visit_parts``."""
        parts = self.visit_parts(poses, stated)
        chosen = [v for n, v in parts.items() if not points_only or n in ("instrument", "floor")]
        return np.asarray(np.sum(chosen, axis=0))

    def visit_parts(self, poses: Poses, stated: FloatArray | None = None) -> dict[str, FloatArray]:
        """Scale → its part of R_i; each is proportional to the square of its scale.

        Args:
            poses: Where the robot stood.
            stated: (N, targets, 3, 3) covariance of the measured points that came with them [m²].
        """
        visits = {} if self.visits is None else self.visits.parts(poses, self.values)
        return visits | self.points.parts(poses, self.values, stated)
