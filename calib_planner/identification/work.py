"""What stays the same while points come and go: the problem at its start, and which parameters can be found."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calib_planner._arrays import FloatArray, IntArray
from calib_planner.design.identifiability import Identifiability, analyse
from calib_planner.identification.equations import Equations, configuration_labels, point_whitening
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.least_squares import gauss_newton
from calib_planner.identification.motion import Motion
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.robust import MEDIAN
from calib_planner.robot.chain import Robot

FIRST_ITERATIONS = 3
"""Iterations, at most, of the fit that tells how much the points scatter, roughly."""
ROUGHLY = 0.01
"""A step that takes off less than this share of the sum of squares changes nothing of that."""
UNSEEN = 0.05
"""A parameter that the data leave this uncertain is not identified by them [m | rad]."""


@dataclass(frozen=True, eq=False)
class Work:
    """A problem, its robot at the start, the instrument's covariance and which parameters can be found."""

    problem: IdentificationProblem
    motion: Motion
    use: NDArray[np.bool_]  # (N, targets) points that say what can be found
    instrument: FloatArray  # (N, targets, 3, 3); the identity where nothing is known
    source: str
    labels: IntArray
    at: FloatArray  # (P,) deviations where it was asked what can be found
    jacobian: FloatArray  # (N, targets, 3, P) there
    identifiability: Identifiability
    kept: tuple[int, ...]

    @staticmethod
    def of(problem: IdentificationProblem, robot: Robot, use: NDArray[np.bool_]) -> Work:
        """With the points ``use`` (N, targets) saying what can be found."""
        data, names = problem.data, robot.parameter_names
        instrument, source = problem.instrument_covariance()
        motion, at = Motion(robot, data.q), np.zeros(len(names))
        jacobian = motion.at(at)[1]
        found = analyse(jacobian[use].reshape(-1, len(names)), names)
        labels = configuration_labels(data.q)
        work = Work(problem, motion, use, instrument, source, labels, at, jacobian, found, found.kept)
        return replace(work, kept=work._with_prior(work.unit, np.zeros(len(names))))

    def told_by(self, use: NDArray[np.bool_]) -> Work:
        """The same at the start, with the points ``use`` (N, targets) saying what can be found."""
        names, at = self.robot.parameter_names, np.zeros(len(self.robot.parameter_names))
        jacobian = self.motion.at(at)[1]
        found = analyse(jacobian[use].reshape(-1, len(names)), names)
        work = replace(self, use=use, at=at, jacobian=jacobian, identifiability=found, kept=found.kept)
        return replace(work, kept=work._with_prior(work.unit, at))

    @property
    def robot(self) -> Robot:
        """At the start, its active parameters being the unknowns."""
        return self.motion.robot

    @property
    def lengths(self) -> FloatArray:
        """(kept,) what each parameter kept adds to its predecessors, by the data or the prior [m per unit]."""
        own = dict(zip(self.identifiability.kept, self.identifiability.lengths, strict=True))
        return np.array([own.get(k, np.inf) for k in self.kept])

    @property
    def unit(self) -> float:
        """Standard deviation of one coordinate that the instrument has [m]."""
        return float(np.sqrt(np.mean(np.einsum("kii->ki", self.instrument[self.use]))))

    def seeing(self, deviations: FloatArray, lengths: FloatArray, sigma: float) -> Work:
        """The same with what can be seen at ``deviations`` in spite of coordinates that scatter ``sigma`` [m].

        Args:
            lengths: (kept,) what each parameter kept adds to its predecessors there.
        """
        names = self.robot.parameter_names
        placed = np.array([n.startswith(("base.", "target_")) for n in names])
        shortest = np.where(placed, 0.0, sigma / UNSEEN)
        if not (lengths < shortest[list(self.kept)]).any():
            return self
        jacobian = self.motion.at(deviations)[1]
        # What could not be told apart before stays held, though it may differ a little here.
        held = np.isin(np.arange(len(names)), self.identifiability.held)
        rows = jacobian[self.use].reshape(-1, len(names))
        found = analyse(rows, names, shortest=np.where(held, np.inf, shortest))
        there = replace(self, at=deviations, jacobian=jacobian, identifiability=found, kept=found.kept)
        held = ~np.isin(np.arange(len(names)), self.kept)
        return replace(there, kept=there._with_prior(sigma, np.where(held, np.inf, shortest)))

    def _with_prior(self, sigma: float, shortest: FloatArray) -> tuple[int, ...]:
        """Parameters that the data or the prior can tell."""
        names, prior = self.robot.parameter_names, self.problem.prior
        if prior is None or not self.identifiability.held:
            return self.identifiability.kept
        # A prior is worth as many metres of the points as their scatter leaves undecided.
        rows = sigma * prior.rows(names, np.zeros(len(names)))[0]
        seen = self.jacobian[self.use].reshape(-1, len(names))
        return analyse(np.vstack([seen, rows]), names, shortest=shortest).kept

    def equations(self, use: NDArray[np.bool_], covariance: FloatArray) -> Equations:
        """Point by point, under ``covariance`` (N, targets, 3, 3)."""
        whitening = point_whitening(covariance, use)
        return Equations(self.robot, self.problem.data, use, whitening, self.problem.prior, self.motion)

    def start_values(self, start: Estimate | None) -> FloatArray:
        """(P,) deviations to begin from."""
        if start is None or start.parameters != self.robot.parameter_names:
            return np.zeros(len(self.robot.parameter_names))
        nominal = np.array([p.nominal for p in self.robot.parameters])
        warm = np.zeros(len(nominal))
        warm[list(self.kept)] = (start.values - nominal)[list(self.kept)]
        return warm


def without_unseen(work: Work) -> tuple[Work, FloatArray, bool]:
    """What can be seen in spite of the scatter that a first fit leaves; where that ended; if near the minimum.

    Asked at the start, since a fit may run so far along what it cannot see that it seems to see it; and again
    where the fit ended, since a reflector on the last axis, say, is not there before it has been found.
    """
    first, use = np.zeros(len(work.robot.parameter_names)), work.use
    if work.problem.iterations <= FIRST_ITERATIONS:
        return work, first, False
    equations = work.equations(use, work.instrument)
    fit = gauss_newton(equations, first, work.kept, FIRST_ITERATIONS, gain=ROUGHLY)
    count = int(use.sum())
    squares = np.sum(fit.residuals[: 3 * count].reshape(-1, 3) ** 2, axis=1)
    spare = max(3 * count - len(work.kept), 1) / (3 * count)
    sigma = work.unit * float(np.sqrt(np.median(squares) / MEDIAN / spare))
    seeing = work.seeing(work.at, work.lengths, sigma)
    if seeing is not work:
        fit = gauss_newton(equations, _only(seeing, first), seeing.kept, FIRST_ITERATIONS, gain=ROUGHLY)
    seeing = seeing.seeing(fit.deviations, np.abs(np.diag(fit.triangle)) * fit.scale * work.unit, sigma)
    return seeing, _only(seeing, fit.deviations), fit.converged


def _only(work: Work, deviations: FloatArray) -> FloatArray:
    """Zero but for what is kept."""
    result = np.zeros(len(deviations))
    result[list(work.kept)] = deviations[list(work.kept)]
    return result
