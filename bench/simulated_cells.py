# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated cells for the benches: everything drawn from a seed, wrong in the ways that a case says.

How the robot errs is drawn from the error model (``error_model.Truth``). Gross errors come on top: 10–50 mm, in
any direction.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_planner import IdentificationProblem, Robot
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, Prior, Truth, typical
from calib_planner.identification import Estimate
from calib_planner.measurements import Measurements
from calib_planner.robot import is_nuisance, rotation
from calib_planner.simulation import SimulatedCell, random_deviations

SIGMA, LENGTH, ANGLE = 3e-5, 5e-4, 1e-3
TARGETS = np.array([[0.05, 0.02, 0.12], [-0.06, 0.04, 0.10], [0.01, -0.07, 0.14]])
OPTIONAL = ("gravity", "smooth.size", "short.size", "repeatability", "shared", "floor")
"""Scales of what a robot may do besides its parameters."""


@dataclass(frozen=True)
class Case:
    """What is simulated and what is asked.

    Attributes:
        robot: Name in the catalogue.
        level: Its parameters.
        placed: Base and targets are unknown.
        targets: Number of reflectors.
        count, repetitions: Configurations, and how often each is measured.
        asked: The error model of the identification: ``paper``, ``typical``, or what ``typical`` is without.
        options: Further arguments of the problem.
        scales: Scales of the true error model that are not nothing; empty: the paper's robot.
        gross: Share of the points that are gross errors; a hundredth of the rows are exchanged if ``exchanged``.
        prior: The true errors are drawn from the prior that is given.
    """

    robot: str = "kuka_kr270"
    level: str = "lengths+offsets"
    placed: bool = False
    targets: int = 1
    count: int = 20
    repetitions: int = 1
    asked: str = "paper"
    options: dict[str, Any] = field(default_factory=dict)
    scales: dict[str, float] = field(default_factory=dict)
    gross: float = 0.0
    exchanged: bool = False
    prior: bool = False

    @property
    def true_model(self) -> ErrorModel:
        """How the robot errs besides its parameters."""
        if not self.scales:
            return ErrorModel.paper(SIGMA)
        return typical().with_noise(SIGMA).with_values(dict.fromkeys(OPTIONAL, 1e-12) | self.scales)

    @property
    def asked_model(self) -> ErrorModel:
        """What is identified."""
        if self.asked in ("paper", "typical"):
            return ErrorModel.paper() if self.asked == "paper" else typical()
        return typical().without(self.asked)


@dataclass(frozen=True, eq=False)
class Cell:
    """A cell, the question about it, and what it draws from."""

    case: Case
    cell: SimulatedCell
    asked: Robot
    prior: Prior | None
    rng: np.random.Generator

    @property
    def truth(self) -> Truth:
        """The true robot."""
        return self.cell.truth

    def configurations(self, count: int) -> FloatArray:
        low, high = self.asked.joint_limits.T
        return np.asarray(self.rng.uniform(low, high, (count, len(low))))

    def measure(self, q: FloatArray, repetitions: int) -> Measurements:
        """Each of q (N, joints) ``repetitions`` times."""
        rows = np.repeat(q, repetitions, axis=0)
        return Measurements(self.asked.joint_names, rows, self.truth.measure(rows, self.rng))

    def problem(self, data: Measurements, **changes: Any) -> IdentificationProblem:
        """The question about ``data``."""
        options: dict[str, Any] = {"prior": self.prior, **self.case.options, **changes}
        return IdentificationProblem(self.asked, data, error_model=self.case.asked_model, **options)


def cell_of(case: Case, seed: int) -> Cell:
    """Drawn from ``seed``."""
    rng = np.random.default_rng([seed, 7])
    robot = Robot.load(case.robot)
    real = robot if case.robot == "planar_2r" else robot.with_targets(TARGETS[: case.targets])
    real = real.with_parameters(case.level)
    asked, prior = real, None
    if case.placed:
        yaw, pitch, roll = rng.uniform([-np.pi, -0.5, -0.5], [np.pi, 0.5, 0.5])
        place = rotation(2, yaw) @ rotation(1, pitch) @ rotation(0, roll)
        real = real.with_base(place, rng.uniform(-3.0, 3.0, 3))
        blank = robot.with_targets(np.zeros((case.targets, 3)))
        asked = blank.with_parameters(case.level, ("base", "tool"))
    if case.prior:
        std = np.array([LENGTH if p.unit == "m" else ANGLE for p in real.parameters])
        prior = Prior(real.parameter_names, np.array([p.nominal for p in real.parameters]), std)
    errors = random_deviations(real, seed, LENGTH, ANGLE)
    cell = SimulatedCell(real, errors, SIGMA, error_model=case.true_model, seed=seed)
    return Cell(case, cell, asked, prior, rng)


def spoil(data: Measurements, case: Case, rng: np.random.Generator) -> tuple[Measurements, NDArray[np.bool_]]:
    """Gross errors of 10–50 mm and, if asked for, exchanged rows; and which points they are."""
    points = np.array(data.p)
    bad = np.zeros(points.shape[:2], bool)
    bad.ravel()[rng.choice(bad.size, round(case.gross * bad.size), replace=False)] = True
    off = rng.standard_normal((int(bad.sum()), 3))
    off /= np.linalg.norm(off, axis=1)[:, None]
    points[bad] += off * rng.uniform(0.01, 0.05, len(off))[:, None]
    if case.exchanged:
        half = max(1, round(0.005 * len(points)))
        rows = rng.choice(np.flatnonzero(~bad.any(axis=1)), 2 * half, replace=False)
        points[rows] = points[np.roll(rows, half)]
        bad[rows] = True
    return Measurements(data.joint_names, data.q, points), bad


def parameter_errors(found: Estimate, cell: Cell) -> dict[str, float]:
    """Identified − true in standard deviations, of every parameter that has one and a true value.

    Without a prior the truth is what reproduces the true robot with the same parameters fixed: a combination that
    nothing shows was divided by a choice. With one, it is what the chain was drawn with; base and targets, of
    which the true robot has other coordinates, are left out.
    """
    fit = found.fit
    if cell.case.asked != "paper" or cell.prior is not None or not cell.case.placed:
        own = {p.name: p.nominal for p in cell.truth.robot.parameters}
        rows = [(n, v, s) for n, v, s in zip(fit.parameters, fit.values, fit.std, strict=True) if n in own]
        return {n: (v - own[n]) / s for n, v, s in rows if np.isfinite(s) and not is_nuisance(n)}
    robot, free = found.knowledge.robot, np.flatnonzero(np.isfinite(fit.std))
    low, high = robot.joint_limits.T
    q = np.random.default_rng(1).uniform(low, high, (100, len(low)))
    truth, deviations = cell.truth.robot.positions(q).ravel(), fit.deviations.copy()
    for _ in range(6):
        jacobian = np.ascontiguousarray(robot.jacobian(q, deviations)).reshape(len(truth), -1)[:, free]
        scale = np.linalg.norm(jacobian, axis=0)
        left = truth - robot.positions(q, deviations).ravel()
        deviations[free] += np.linalg.lstsq(jacobian / scale, left, rcond=1e-12)[0] / scale
    assert np.abs(truth - robot.positions(q, deviations).ravel()).max() < 1e-9
    error = (fit.deviations - deviations)[free] / fit.std[free]
    return {fit.parameters[i]: float(e) for i, e in zip(free, error, strict=True)}
