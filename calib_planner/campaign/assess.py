# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the measurements of a campaign say: how large the error at the test poses is, and what of it will stay.

The error of a visit to a test pose has two parts. What is not known of the robot, (M3), falls with the
measurements. What is new at each visit, the robot's *repeatability*, stays: it is the *floor*. Both are the error
model's, with the sizes that the measurements tell.

The noise that a campaign is told is an expectation: by which factor it is wrong is a scale of the error model.
The paper's model takes the noise for granted.

A size σ is never known exactly: its logarithm has a standard deviation s. A visit errs by the mean of σ², which
is σ² e^(2s²), and what that is more than σ² falls with the measurements as well. The *sure* part of the floor is
what is left of it where every size is smaller by e^(3s); a robot that was hardly measured has little of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.campaign.problem import CampaignProblem, Round
from calib_planner.campaign.state import FIT, CampaignState, Measurement, together
from calib_planner.error_model import ErrorModel, gravity_of, typical
from calib_planner.identification import Estimate, IdentificationProblem, identify
from calib_planner.measurements import Measurements, configuration_labels
from calib_planner.tracker import Isotropic, Noise
from calib_planner.units import cut, length, lengths

FEWEST_SPARE = 10
"""Equations beyond the parameters from which an estimate can be judged."""
SURE = 3.0
"""Standard deviations of the logarithm of a scale within which it surely lies, looking after each batch."""
WIDEST = 2.0
"""A scale of which less is known than this counts as known so well: a factor of e² is nothing known."""


@dataclass(frozen=True, eq=False)
class Assessment:
    """What the measurements of the fit say.

    Attributes:
        problem: What was identified.
        estimate: Its answer.
    """

    problem: IdentificationProblem
    estimate: Estimate

    @cached_property
    def floor_per_test_pose(self) -> FloatArray:
        """(K,) repeatability there, root mean square distance over the targets [m]; it stays."""
        return self._repeatability(lambda spread: 0.0)

    @cached_property
    def accuracy_per_test_pose(self) -> FloatArray:
        """(K,) error of a visit: what is not known of the robot, and its repeatability [m]."""
        return np.hypot(self.estimate.accuracy.predicted, self._repeatability(lambda spread: spread**2))

    @property
    def accuracy(self) -> float:
        """The same at the worst test pose [m]; infinite where the data are blind."""
        return float(np.max(self.accuracy_per_test_pose))

    @property
    def floor(self) -> float:
        """``floor_per_test_pose`` at the worst test pose [m]."""
        return float(np.max(self.floor_per_test_pose))

    @cached_property
    def surely(self) -> float:
        """The sure part of ``floor`` [m]."""
        return float(np.max(self._repeatability(lambda spread: -SURE * spread)))

    def _repeatability(self, change: Callable[[float], float]) -> FloatArray:
        """(K,) at the test poses [m]; ``change``: of the logarithm of a scale, from its standard deviation."""
        known, spread = self.estimate.knowledge, self.estimate.scale_spread
        names = () if known.model.visits is None else known.model.visits.scales
        values = {n: v for n, v in known.model.values.items() if n in names}
        model = known.model.with_values(
            {n: v * float(np.exp(change(min(spread.get(n, 0.0), WIDEST)))) for n, v in values.items()}
        )
        told = replace(known, model=model).predict(self.estimate.accuracy.test_poses).repeatability
        return np.asarray(np.sqrt(np.trace(told, axis1=2, axis2=3).mean(axis=1)))

    @property
    def noise(self) -> Noise:
        """Noise of a point, as the measurements show it."""
        return Isotropic(self.estimate.noise.sigma)

    @property
    def model(self) -> ErrorModel:
        """All terms that were wanted, with the sizes that are known by now and the noise as estimated."""
        wanted, now = self.problem.model, self.estimate.knowledge.model
        values = {n: v for n, v in now.values.items() if n in wanted.values}
        return replace(wanted.with_values(values), points=now.points)

    @property
    def used(self) -> Measurements:
        """The measurements that were not rejected."""
        data = self.problem.data.without(self.estimate.points.rejected)
        return data.select(np.flatnonzero(data.seen.any(axis=1)))


def assess(state: CampaignState) -> Assessment | None:
    """What the measurements of the fit say; ``None`` if there are none.

    Raises:
        NotEnoughDataError: Too few measurements that agree.
        InputError: The points look like millimetres.
    """
    fit = state.measurements_of(FIT)
    return _assessed(state.problem, fit) if fit else None


@lru_cache(maxsize=1)
def _assessed(campaign: CampaignProblem, fit: tuple[Measurement, ...]) -> Assessment:
    """``assess`` of these measurements, remembered: after the validation it is the one that ended the fit."""
    problem = identification_problem(campaign, together(campaign, fit))
    return Assessment(problem, identify(problem))


def expected(problem: CampaignProblem) -> ErrorModel:
    """How robot and measurement err before anything is measured; the noise is an expectation."""
    model, prior = problem.identification.get("error_model"), problem.identification.get("prior")
    model = typical(gravity=gravity_of(problem.robot)) if model is None else model
    if not model.is_papers and not model.points.estimate_scale:
        factor = next(s for s in typical(estimate_scale=True).scales if s.name == "instrument")
        points = replace(model.points, estimate_scale=True)
        model = replace(model, points=points, scales=(*model.scales, factor))
    if prior is not None:
        model = replace(model, placement=replace(model.placement, stated=prior))
    return model.with_noise(problem.instrument)


def identification_problem(problem: CampaignProblem, data: Measurements) -> IdentificationProblem:
    """What is identified from ``data``; their own standard deviations go before the instrument's."""
    model = expected(problem)
    if data.std is not None and not model.is_papers:
        model = replace(model, points=replace(model.points, noise=None))
    return IdentificationProblem(
        problem.robot,
        data,
        error_model=model,
        loss=problem.identification.get("loss", "auto"),
        test_poses=problem.test_pose_array,
        accuracy_frame=problem.accuracy_frame,
    )


# ── Is it enough to judge by, enough altogether, or never enough? ────────────────────────────────────────────


def outcome_of(state: CampaignState, known: Assessment | None) -> tuple[str, str]:
    """A key of ``OUTCOMES`` and why; empty: go on."""
    problem, required = state.problem, f"{length(state.problem.required_accuracy)} required"
    if known is not None and ready(state, known) and known.accuracy <= problem.required_accuracy and sound(known):
        predicted, wanted = lengths(known.accuracy, problem.required_accuracy)
        return "reached", f"{predicted} predicted, {wanted} required"
    if state.given_up > problem.most_failures:
        reasons = sorted({e.reason for e in state.exclusions if not e.requested})
        return "unreachable", f"{state.given_up} configurations given up: {cut('; '.join(reasons), 300)}"
    if state.spent(FIT) >= problem.fit_budget:
        return "budget_spent", f"{_now(state, known)}, {required}{_forecast_text(state, known)}"
    if known is not None and ready(state, known) and limited(state, known):
        floor, least, wanted = lengths(known.floor, known.surely, problem.required_accuracy)
        surely = f"{floor} of repeatability at a test pose, surely more than {least}"
        return "limited", f"{surely}; {wanted} required"
    return "", ""


def ready(state: CampaignState, known: Assessment) -> bool:
    """Whether there is enough to judge by."""
    apart = different(known.used)
    spare = 3 * int(apart.seen.sum()) - known.estimate.observability.rank
    return len(apart) >= state.problem.minimum and spare >= FEWEST_SPARE


def sound(known: Assessment) -> bool:
    """Whether the measurements agree with the estimate: without that its predictions mean nothing."""
    return known.estimate.verdict.level != "FAIL"


def limited(state: CampaignState, known: Assessment) -> bool:
    """Whether no number of measurements would do."""
    return known.surely > state.problem.required_accuracy


def different(data: Measurements) -> Measurements:
    """Without repetitions."""
    return data.select(np.unique(configuration_labels(data.q), return_index=True)[1])


def forecast(known: Assessment, required: float) -> float:
    """Measurements still needed; infinite where the floor is above what is required."""
    floor, total = known.floor_per_test_pose, known.accuracy_per_test_pose
    room = required**2 - floor**2
    if not np.isfinite(total).all() or (room <= 0).any():
        return float("inf")
    more = len(known.used) * (np.maximum(total**2 - floor**2, 0.0) / room - 1.0)
    return max(float(np.ceil(more.max() - 1e-9)), 0.0) + 0.0


def _now(state: CampaignState, known: Assessment | None) -> str:
    """What is known when the budget is spent."""
    if known is None:
        return "nothing identified"
    if known.accuracy > state.problem.required_accuracy:
        return f"{length(known.accuracy)} predicted"
    if not ready(state, known):
        return f"{length(known.accuracy)} predicted, by too few measurements to judge it"
    return f"{length(known.accuracy)} predicted, but {known.estimate.verdict.reasons[0].text}"


def _forecast_text(state: CampaignState, known: Assessment | None) -> str:
    left = float("inf") if known is None else forecast(known, state.problem.required_accuracy)
    return f"; about {left:.0f} more measurements would do" if np.isfinite(left) and left > 0 else ""


def round_of(state: CampaignState, known: Assessment | None, planned: int, note: str) -> Round:
    """The record of this round."""
    number = len(state.rounds)
    if known is None:
        nan = float("nan")
        return Round(number, 0, 0, float("inf"), nan, nan, nan, planned, note)
    return Round(
        number,
        len(known.used),
        len(different(known.used)),
        known.accuracy,
        known.floor,
        known.noise.typical,
        forecast(known, state.problem.required_accuracy),
        planned,
        note,
        known.estimate.left_out.rms,
    )
