"""What a campaign came to: why it ended, how it went, what was identified, and whether it holds."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from calib_planner.adaptive.exclusion import Exclusion
from calib_planner.design.plan import plain
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.verdict import Verdict

OUTCOMES = {
    "reached": "the predicted accuracy is what was required",
    "budget_spent": "the budget was spent first: raise it, or live with the accuracy predicted",
    "limited": "more measurements cannot do it: what no geometric model holds is more than was required; "
    "calibrate closer to the task, or compensate locally",
    "unreachable": "too little is left that can be measured: widen limits and constraints, or move the tracker",
    "failed": "the measurements cannot be identified",
}
"""Every way to end, with advice."""


@dataclass(frozen=True)
class Round:
    """What was known after a batch, and what was planned then.

    Attributes:
        number: From 0; round 0 has nothing measured.
        measured: Measurements used.
        configurations: Different ones among them.
        accuracy: Error predicted at the worst test pose, noise and discrepancy as estimated [m].
        floor: What more measurements leave of it [m].
        sigma: Noise of one coordinate of one measurement, as estimated [m].
        scatter: What the residuals are, see ``scatter``.
        left: Forecast of measurements still needed; infinite: it cannot be reached.
        planned: Measurements planned next.
        note: What was decided, in words.
    """

    number: int
    measured: int
    configurations: int
    accuracy: float
    floor: float
    sigma: float
    scatter: str
    left: float
    planned: int
    note: str


@dataclass(frozen=True, eq=False)
class CampaignResult:
    """The end of a campaign.

    Attributes:
        outcome: A key of ``OUTCOMES``.
        message: What it means here.
        required_accuracy: What was asked for [m].
        rounds: How it went.
        estimate: What was identified, with its validation; ``None`` if nothing could be.
        verdict: PASS, WARN or FAIL with reasons.
        fit: Measurements of the fit, or ``None``.
        validation: Measurements that took no part in it, or ``None``.
        exclusions: Configurations given up.
        spent: Measurements made, those that failed included.
        budget: Measurements allowed.
    """

    outcome: str
    message: str
    required_accuracy: float
    rounds: tuple[Round, ...]
    estimate: Estimate | None
    verdict: Verdict
    fit: Measurements | None
    validation: Measurements | None
    exclusions: tuple[Exclusion, ...]
    spent: int
    budget: int

    @property
    def accuracy(self) -> float:
        """Error predicted at the worst test pose [m]; infinite without an estimate."""
        if self.estimate is None:
            return float("inf")
        return float(self.estimate.predicted_accuracy_per_test_pose.max())

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers; non-finite numbers become ``None``."""
        keys = ("outcome", "message", "required_accuracy", "spent", "budget")
        result = {name: getattr(self, name) for name in keys}
        result |= {
            "predicted_accuracy": self.accuracy,
            "rounds": [asdict(r) for r in self.rounds],
            "verdict": asdict(self.verdict),
            "measurements": _rows(self.fit),
            "validation_measurements": _rows(self.validation),
            "excluded": [{"configuration": e.q, "reason": e.reason, "asked": e.asked} for e in self.exclusions],
            "estimate": None if self.estimate is None else self.estimate.to_dict(),
        }
        found: dict[str, Any] = plain(result)
        return found


def _rows(data: Measurements | None) -> dict[str, Any] | None:
    if data is None:
        return None
    return {"joint_names": data.joint_names, "configurations": data.q, "points": data.p}
