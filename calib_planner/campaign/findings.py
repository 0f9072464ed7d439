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

from calib_planner.arrays import FloatArray
from calib_planner.campaign.problem import CampaignProblem, Round
from calib_planner.campaign.state import FIT, CampaignState
from calib_planner.identification import (
    DOUBT,
    FEWEST_SPARE,
    Estimate,
    IdentificationProblem,
    configuration_labels,
    identify,
    improbable,
)
from calib_planner.measurements import Measurements
from calib_planner.planning import ModelDiscrepancy
from calib_planner.tracker import Isotropic, Noise
from calib_planner.units import cut, length

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
        return float(np.max(self.estimate.accuracy.predicted))

    @property
    def floor_per_test_pose(self) -> FloatArray:
        """(K,) what more measurements leave of it, root mean square distance [m]."""
        learnt = self.estimate.transmission
        if learnt is None:
            return self.estimate.accuracy.discrepancy
        left = learnt.remainder(self.estimate.accuracy.test_poses)
        return np.asarray(np.sqrt(np.einsum("ktii->kt", left).mean(axis=1)))

    @property
    def floor(self) -> float:
        """The same at the worst test pose [m]."""
        return float(np.max(self.floor_per_test_pose))

    @property
    def surely(self) -> float:
        """The part of ``floor`` that it is at least: a variance from ν residuals is known to √(2/ν)."""
        freedom = max(self.estimate.residuals.chi_square.freedom, 1)
        return self.floor * float(np.sqrt(max(1.0 - 2.0 * np.sqrt(2.0 / freedom), 0.0)))

    @property
    def used(self) -> Measurements:
        """The measurements that were believed."""
        data = self.asked.data.without(self.estimate.points.rejected)
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
    if (
        found.residuals.chi_square.freedom >= FEWEST_SPARE
        and found.residuals.chi_square.probability > 1.0 - DOUBT
    ):
        return _rescaled(problem, data, found)
    return Finding(asked, found, AS_STATED, stated)


def _rescaled(problem: CampaignProblem, data: Measurements, found: Estimate) -> Finding:
    """All of the scatter taken as noise."""
    chi = found.residuals.chi_square
    factor = found.noise.scaled * float(np.sqrt(max(chi.value / max(chi.freedom, 1), 1e-12)))
    noise = Scaled(problem.instrument, factor)
    asked = _asked(problem, data, noise)
    return Finding(asked, identify(asked), NOISE, noise)


def _lack_of_fit(found: Estimate) -> bool:
    """Whether the residuals are more than repetitions explain; see the module."""
    levels, chi = found.noise, found.residuals.chi_square
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


# ── What is known after a batch: enough to judge by, enough altogether, or never enough; see ``decision`` ───

LEARNABLE = 24
"""Configurations from which on errors of the joints that could be learnt would have been."""


def found_in(state: CampaignState) -> Finding | None:
    data = state.data(FIT)
    return None if data is None else find(state.problem, data)


def outcome_of(state: CampaignState, found: Finding | None) -> tuple[str, str]:
    """A key of ``OUTCOMES`` and why; empty: go on."""
    problem, required = state.problem, f"{length(state.problem.required_accuracy)} required"
    if found is not None and ready(state, found) and found.accuracy <= problem.required_accuracy:
        return "reached", f"{length(found.accuracy)} predicted, {required}"
    if state.given_up > problem.most_failures:
        reasons = sorted({e.reason for e in state.exclusions if not e.asked})
        return "unreachable", f"{state.given_up} configurations given up: {cut('; '.join(reasons), 300)}"
    if state.spent(FIT) >= problem.fit_budget:
        now = "nothing identified" if found is None else f"{length(found.accuracy)} predicted"
        return (
            "budget_spent",
            f"{now}, {required}{_forecast_text(state, found)}",
        )
    if found is not None and ready(state, found) and limited(state, found):
        text = f"{length(found.floor)} at a test pose are the robot's own, {required}"
        return "limited", text
    return "", ""


def ready(state: CampaignState, found: Finding) -> bool:
    """Whether there is enough to judge by."""
    apart = different(found.used)
    spare = 3 * int(apart.seen.sum()) - found.estimate.observability.rank
    enough = len(apart) >= state.problem.minimum and spare >= FEWEST_SPARE
    return enough and found.estimate.fit.status != "not_converged"


def limited(state: CampaignState, found: Finding) -> bool:
    """Whether no number of measurements would do."""
    if found.scatter != DISCREPANCY or found.surely <= state.problem.required_accuracy:
        return False
    may_learn = state.problem.identification.get("joint_corrections", "auto") == "auto"
    return not may_learn or len(different(found.used)) >= LEARNABLE


def different(data: Measurements) -> Measurements:
    """Without repetitions."""
    return data.select(np.unique(configuration_labels(data.q), return_index=True)[1])


def forecast(found: Finding, required: float) -> float:
    """Measurements still needed; infinite where the floor is above what is required."""
    floor = found.floor_per_test_pose
    total = found.estimate.accuracy.predicted
    room = required**2 - floor**2
    if not np.isfinite(total).all() or (room <= 0).any():
        return float("inf")
    more = len(found.used) * (np.maximum(total**2 - floor**2, 0.0) / room - 1.0)
    return max(float(np.ceil(more.max() - 1e-9)), 0.0) + 0.0


def _forecast_text(state: CampaignState, found: Finding | None) -> str:
    left = float("inf") if found is None else forecast(found, state.problem.required_accuracy)
    return f"; about {left:.0f} more measurements would do" if np.isfinite(left) and left > 0 else ""


def round_of(state: CampaignState, found: Finding | None, planned: int, note: str) -> Round:
    number = len(state.rounds)
    if found is None:
        nan = float("nan")
        return Round(number, 0, 0, float("inf"), nan, nan, "", nan, planned, note)
    return Round(
        number,
        len(found.used),
        len(different(found.used)),
        found.accuracy,
        found.floor,
        found.noise.typical,
        found.scatter,
        forecast(found, state.problem.required_accuracy),
        planned,
        note,
    )
