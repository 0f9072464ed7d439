"""The estimate of a campaign: is what scatters noise, which more measurements average away, or the robot itself?

The instrument's σ is a statement. Residuals larger than it explains are either more noise than stated, or a model
discrepancy D, which no number of measurements reduces. The difference decides whether to go on or to stop, and
only repetitions can tell: with SS_r the sum of squares of repetitions about their configurations' means, ν_r
degrees of freedom, and SS, ν those of all residuals, the lack of fit

    F = ((SS − SS_r)/(ν − ν_r)) / (SS_r/ν_r)

is Fisher's F(ν − ν_r, ν_r) if all is noise. So there are four answers:

    as_stated     the residuals are what the instrument says
    noise         they are more (or far less), and repetitions scatter as much: σ is scaled to what they say
    discrepancy   F is improbable, or the joints' errors were learnt: what is left is the robot's
    open          they are more, and there are not ``ENOUGH`` repetitions to tell: measure some again

``open`` is never believed on the comfortable side: its accuracy is that with the discrepancy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_planner._arrays import FloatArray
from calib_planner.adaptive.problem import CampaignProblem
from calib_planner.design.discrepancy import ModelDiscrepancy
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.noise_levels import DOUBT, FEWEST_SPARE, improbable
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.solver import identify
from calib_planner.instrument.noise import Isotropic, Noise

ENOUGH = 30
"""Degrees of freedom of repetitions that tell noise from discrepancy: a ratio of variances of 3 is then seen."""
AS_STATED, NOISE, DISCREPANCY, OPEN = "as_stated", "noise", "discrepancy", "open"


@dataclass(frozen=True)
class Scaled:
    """An instrument whose standard deviations are ``factor`` times as large."""

    noise: Noise
    factor: float

    def covariance(self, points: NDArray[Any]) -> NDArray[Any]:
        """As of every ``Noise``."""
        return self.factor**2 * self.noise.covariance(points)

    @property
    def typical(self) -> float:
        """As of every ``Noise`` [m]."""
        return self.factor * self.noise.typical


@dataclass(frozen=True, eq=False)
class Finding:
    """What the measurements of the fit say.

    Attributes:
        asked: The identification's problem.
        estimate: Its answer.
        scatter: One of the four answers.
        noise: The instrument as the measurements show it.
    """

    asked: IdentificationProblem
    estimate: Estimate
    scatter: str
    noise: Noise

    @property
    def accuracy(self) -> float:
        """Error predicted at the worst test pose [m]; infinite where the data are blind."""
        return float(np.max(self.estimate.predicted_accuracy_per_test_pose))

    @property
    def floor_per_test_pose(self) -> FloatArray:
        """(K,) what more measurements leave of it, root mean square distance [m]."""
        learnt = self.estimate.transmission
        if learnt is None:
            return self.estimate.discrepancy_per_test_pose
        left = learnt.remainder(self.estimate.test_poses)
        return np.asarray(np.sqrt(np.einsum("ktii->kt", left).mean(axis=1)))

    @property
    def floor(self) -> float:
        """The same at the worst test pose [m]."""
        return float(np.max(self.floor_per_test_pose))

    @property
    def surely(self) -> float:
        """The part of ``floor`` that it is at least: a variance from ν residuals is known to √(2/ν)."""
        freedom = max(self.estimate.chi_square.freedom, 1)
        return self.floor * float(np.sqrt(max(1.0 - 2.0 * np.sqrt(2.0 / freedom), 0.0)))

    @property
    def used(self) -> Measurements:
        """The measurements that were believed."""
        points = np.array(self.asked.data.p)
        for point in self.estimate.rejected:
            points[point["row"], point["target"] - 1] = np.nan
        data = Measurements(self.asked.data.joint_names, self.asked.data.q, points)
        return data.select(np.flatnonzero(data.seen.any(axis=1)))

    @property
    def discrepancy(self) -> ModelDiscrepancy | None:
        """What to plan with."""
        if self.scatter != DISCREPANCY:
            return None
        learnt, usual = self.estimate.transmission, self.estimate.noise.for_planning()
        if learnt is None:
            return usual
        own = {"joint_sigma": learnt.amplitude, "joint_length": learnt.length, "point_sigma": learnt.point}
        return replace(usual, **own)


def find(problem: CampaignProblem, data: Measurements) -> Finding:
    """Identify, and say what scatters.

    Raises:
        NotEnoughDataError: Too few measurements that agree.
        InputError: The points look like millimetres.
    """
    asked = _asked(problem, data, problem.instrument)
    found = identify(asked)
    stated = Scaled(problem.instrument, found.noise.scaled) if found.noise.scaled > 1 else problem.instrument
    if found.transmission is not None or _lack_of_fit(found):
        return Finding(asked, found, DISCREPANCY, stated)
    if found.noise.discrepancy > 0:
        if found.noise.repeat_freedom < ENOUGH:
            return Finding(asked, found, OPEN, stated)
        return _rescaled(problem, data, found)
    if found.noise.scaled > 1:
        return _rescaled(problem, data, found)
    if found.chi_square.freedom >= FEWEST_SPARE and found.chi_square.probability > 1.0 - DOUBT:
        return _rescaled(problem, data, found)
    return Finding(asked, found, AS_STATED, stated)


def _rescaled(problem: CampaignProblem, data: Measurements, found: Estimate) -> Finding:
    """All of the scatter taken as noise."""
    chi = found.chi_square
    factor = found.noise.scaled * float(np.sqrt(max(chi.value / max(chi.freedom, 1), 1e-12)))
    noise = Scaled(problem.instrument, factor)
    asked = _asked(problem, data, noise)
    return Finding(asked, identify(asked), NOISE, noise)


def _lack_of_fit(found: Estimate) -> bool:
    """Whether the residuals are more than repetitions explain; see the module."""
    levels, chi = found.noise, found.chi_square
    if not levels.repeat_freedom or not levels.repeatability > 0 or levels.discrepancy <= 0:
        return False
    in_units_of_repetitions = chi.value * (levels.measurement / levels.repeatability) ** 2
    return improbable(in_units_of_repetitions, chi.freedom, levels.repeat_freedom)


def _asked(problem: CampaignProblem, data: Measurements, noise: Noise) -> IdentificationProblem:
    alike = isinstance(noise, Isotropic)
    return IdentificationProblem(
        problem.robot,
        Measurements(data.joint_names, data.q, data.p),
        sigma=noise.typical if alike else None,
        instrument=None if alike else noise,
        test_poses=problem.test_pose_array,
        **problem.identification,
    )
