"""What the measurements of a campaign say: how large the error at the test poses is, and what of it will stay.

The error of a visit to a test pose has two parts. What is not known of the robot, (M3), falls with the
measurements. What is new at each visit, the robot's *repeatability*, stays: it is the *floor*. Both are the error
model's, with the sizes that the measurements tell.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.campaign.problem import CampaignProblem, Round
from calib_planner.campaign.state import FIT, CampaignState
from calib_planner.identification import Estimate, IdentificationProblem, identify
from calib_planner.measurements import Measurements, configuration_labels
from calib_planner.tracker import Isotropic, Noise
from calib_planner.units import cut, length

FEWEST_SPARE = 10
"""Equations beyond the parameters from which an estimate can be judged."""


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
        told = self.estimate.knowledge.predict(self.estimate.accuracy.test_poses)
        return np.asarray(np.sqrt(np.einsum("ktii->kt", told.repeatability).mean(axis=1)))

    @property
    def accuracy_per_test_pose(self) -> FloatArray:
        """(K,) error of a visit: what is not known of the robot, and its repeatability [m]."""
        return np.hypot(self.estimate.accuracy.predicted, self.floor_per_test_pose)

    @property
    def accuracy(self) -> float:
        """The same at the worst test pose [m]; infinite where the data are blind."""
        return float(np.max(self.accuracy_per_test_pose))

    @property
    def floor(self) -> float:
        """``floor_per_test_pose`` at the worst test pose [m]."""
        return float(np.max(self.floor_per_test_pose))

    @property
    def surely(self) -> float:
        """Lower limit of ``floor`` [m]: a variance from ν residuals is known to √(2/ν)."""
        freedom = max(self.estimate.residuals.chi_square.freedom, 1)
        return self.floor * float(np.sqrt(max(1.0 - 2.0 * np.sqrt(2.0 / freedom), 0.0)))

    @property
    def noise(self) -> Noise:
        """Noise of a point, as the measurements show it."""
        return Isotropic(self.estimate.noise.sigma)

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
    data = state.data(FIT)
    if data is None:
        return None
    problem = identification_problem(state.problem, data)
    return Assessment(problem, identify(problem))


def identification_problem(problem: CampaignProblem, data: Measurements) -> IdentificationProblem:
    """What is identified from ``data``; their own standard deviations go before the instrument's."""
    instrument = None if data.std is not None else problem.instrument
    alike = isinstance(instrument, Isotropic)
    return IdentificationProblem(
        problem.robot,
        data,
        sigma=instrument.typical if instrument is not None and alike else None,
        instrument=None if alike else instrument,
        test_poses=problem.test_pose_array,
        **problem.identification,
    )


# ── Is it enough to judge by, enough altogether, or never enough? ────────────────────────────────────────────


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
    )
