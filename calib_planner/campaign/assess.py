"""What the measurements of a campaign say: is the scatter noise, which averages out, or the robot?

The instrument's σ is a statement. Residuals larger than it explains are either more noise than stated, or a model
discrepancy D, which no number of measurements reduces. The difference decides whether to go on or to stop, and
only repetitions can tell: with SS_r the sum of squares of repetitions about their configurations' means, ν_r
degrees of freedom, and SS, ν those of all residuals, the lack of fit

    F = ((SS − SS_r)/(ν − ν_r)) / (SS_r/ν_r)

is Fisher's F(ν − ν_r, ν_r) if all is noise. So there are four answers:

    as_stated     the residuals are what the instrument says
    noise         they are more (or far less), and repetitions scatter as much: σ is scaled to what they say
    discrepancy   F is improbable, or the joints' errors were learnt: the rest is the robot's
    open          they are more, and there are not ``ENOUGH`` repetitions to tell: measure some again

While the answer is ``open``, the accuracy is the worse one, that with the discrepancy.
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
class Assessment:
    """What the measurements of the fit say.

    Attributes:
        problem: What was identified.
        estimate: Its answer.
        scatter: One of the four answers.
        noise: The instrument as the measurements show it.
    """

    problem: IdentificationProblem
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
        """Lower limit of ``floor`` [m]: a variance from ν residuals is known to √(2/ν)."""
        freedom = max(self.estimate.residuals.chi_square.freedom, 1)
        return self.floor * float(np.sqrt(max(1.0 - 2.0 * np.sqrt(2.0 / freedom), 0.0)))

    @property
    def used(self) -> Measurements:
        """The measurements that were not rejected."""
        data = self.problem.data.without(self.estimate.points.rejected)
        return data.select(np.flatnonzero(data.seen.any(axis=1)))

    @property
    def discrepancy(self) -> ModelDiscrepancy | None:
        """The discrepancy to plan with, or ``None``."""
        if self.scatter != DISCREPANCY:
            return None
        learnt, usual = self.estimate.transmission, self.estimate.noise.for_planning()
        if learnt is None:
            return usual
        own = {"joint_sigma": learnt.amplitude, "joint_length": learnt.length, "point_sigma": learnt.point}
        return replace(usual, **own)


def assess(state: CampaignState) -> Assessment | None:
    """What the measurements of the fit say; ``None`` if there are none.

    Raises:
        NotEnoughDataError: Too few measurements that agree.
        InputError: The points look like millimetres.
    """
    data = state.data(FIT)
    if data is None:
        return None
    question = _question(state.problem, data, state.problem.instrument)
    estimate = identify(question)
    noise, chi = estimate.noise, estimate.residuals.chi_square
    stated = Scaled(state.problem.instrument, noise.scaled) if noise.scaled > 1 else state.problem.instrument
    if estimate.transmission is not None or _lack_of_fit(estimate):
        return Assessment(question, estimate, DISCREPANCY, stated)
    if noise.discrepancy > 0 and noise.repeat_freedom < ENOUGH:
        return Assessment(question, estimate, OPEN, stated)
    too_small = chi.freedom >= FEWEST_SPARE and chi.probability > 1.0 - DOUBT
    if noise.discrepancy > 0 or noise.scaled > 1 or too_small:
        # All of the scatter is taken as noise.
        factor = noise.scaled * float(np.sqrt(max(chi.value / max(chi.freedom, 1), 1e-12)))
        rescaled = Scaled(state.problem.instrument, factor)
        question = _question(state.problem, data, rescaled)
        return Assessment(question, identify(question), NOISE, rescaled)
    return Assessment(question, estimate, AS_STATED, stated)


def _lack_of_fit(estimate: Estimate) -> bool:
    """Whether the residuals are more than repetitions explain; see the module."""
    levels, chi = estimate.noise, estimate.residuals.chi_square
    if not levels.repeat_freedom or not levels.repeatability > 0 or levels.discrepancy <= 0:
        return False
    in_units_of_repetitions = chi.value * (levels.measurement / levels.repeatability) ** 2
    return improbable(in_units_of_repetitions, chi.freedom, levels.repeat_freedom)


def _question(problem: CampaignProblem, data: Measurements, noise: Noise) -> IdentificationProblem:
    alike = isinstance(noise, Isotropic)
    return IdentificationProblem(
        problem.robot,
        Measurements(data.joint_names, data.q, data.p),
        sigma=noise.typical if alike else None,
        instrument=None if alike else noise,
        test_poses=problem.test_pose_array,
        **problem.identification,
    )


# ── Is it enough to judge by, enough altogether, or never enough? ────────────────────────────────────────────

LEARNABLE = 24
"""Configurations from which on errors of the joints that could be learnt would have been."""


def outcome_of(state: CampaignState, known: Assessment | None) -> tuple[str, str]:
    """A key of ``OUTCOMES`` and why; empty: go on."""
    problem, required = state.problem, f"{length(state.problem.required_accuracy)} required"
    if known is not None and ready(state, known) and known.accuracy <= problem.required_accuracy:
        return "reached", f"{length(known.accuracy)} predicted, {required}"
    if state.given_up > problem.most_failures:
        reasons = sorted({e.reason for e in state.exclusions if not e.requested})
        return "unreachable", f"{state.given_up} configurations given up: {cut('; '.join(reasons), 300)}"
    if state.spent(FIT) >= problem.fit_budget:
        now = "nothing identified" if known is None else f"{length(known.accuracy)} predicted"
        return "budget_spent", f"{now}, {required}{_forecast_text(state, known)}"
    if known is not None and ready(state, known) and limited(state, known):
        return "limited", f"{length(known.floor)} at a test pose are the robot's own, {required}"
    return "", ""


def ready(state: CampaignState, known: Assessment) -> bool:
    """Whether there is enough to judge by."""
    apart = different(known.used)
    spare = 3 * int(apart.seen.sum()) - known.estimate.observability.rank
    enough = len(apart) >= state.problem.minimum and spare >= FEWEST_SPARE
    return enough and known.estimate.fit.status != "not_converged"


def limited(state: CampaignState, known: Assessment) -> bool:
    """Whether no number of measurements would do."""
    if known.scatter != DISCREPANCY or known.surely <= state.problem.required_accuracy:
        return False
    may_learn = state.problem.identification.get("joint_corrections", "auto") == "auto"
    return not may_learn or len(different(known.used)) >= LEARNABLE


def different(data: Measurements) -> Measurements:
    """Without repetitions."""
    return data.select(np.unique(configuration_labels(data.q), return_index=True)[1])


def forecast(known: Assessment, required: float) -> float:
    """Measurements still needed; infinite where the floor is above what is required."""
    floor = known.floor_per_test_pose
    total = known.estimate.accuracy.predicted
    room = required**2 - floor**2
    if not np.isfinite(total).all() or (room <= 0).any():
        return float("inf")
    more = len(known.used) * (np.maximum(total**2 - floor**2, 0.0) / room - 1.0)
    return max(float(np.ceil(more.max() - 1e-9)), 0.0) + 0.0


def _forecast_text(state: CampaignState, known: Assessment | None) -> str:
    left = float("inf") if known is None else forecast(known, state.problem.required_accuracy)
    return f"; about {left:.0f} more measurements would do" if np.isfinite(left) and left > 0 else ""


def round_of(state: CampaignState, known: Assessment | None, planned: int, note: str) -> Round:
    """The record of this round."""
    number = len(state.rounds)
    if known is None:
        nan = float("nan")
        return Round(number, 0, 0, float("inf"), nan, nan, "", nan, planned, note)
    return Round(
        number,
        len(known.used),
        len(different(known.used)),
        known.accuracy,
        known.floor,
        known.noise.typical,
        known.scatter,
        forecast(known, state.problem.required_accuracy),
        planned,
        note,
    )
