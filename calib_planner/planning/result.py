# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The planner's answer: what to measure (``Plan``), and how good that provably is (``PlanQuality``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray, IntArray, frozen, plain
from calib_planner.units import Told, counted, length

STATUS = {
    "ok": "The plan is complete.",
    "singular": "The plan predicts the test poses but leaves parameter combinations unseen: raise the number "
    "of configurations, the general weight or add test poses.",
    "time_limit": "The time limit ended the search; this is the best plan so far.",
    "cancelled": "The search was cancelled; this is the best plan so far.",
}
"""Every status a plan can have, with advice."""

NAN = float("nan")


@dataclass(frozen=True)
class PlannedTerm:
    """A term of the error model.

    Attributes:
        name: ``placement``, ``gravity``, ``joint_functions``, ``visits`` or ``points``.
        size: Root mean square of what it moves a point at the test poses by before anything is measured [m]; NaN
            where nothing is known of it.
        std: The same after the plan [m]; NaN for visits and points, which are new each time.
        gain: Of the left-out log score; NaN, since nothing is measured yet.
    """

    name: str
    size: float
    std: float
    gain: float = NAN


@dataclass(frozen=True, eq=False)
class PlanQuality:
    """What a plan promises, how far that is from the best possible, and how the plan was reached.

    Attributes:
        predicted_accuracy_per_test_pose: (K,) ρ0 of eq. (14) at every test pose [m].
        parameter_std: (P,) predicted standard deviation of each parameter [m | rad]; infinite if this plan
            does not see it, NaN if no plan can tell it from others.
        criterion: Name of the criterion that was optimised.
        predicted_accuracy: ρ0 of eq. (14), root mean square over the test poses [m].
        unidentifiable: Combinations of parameters that no configuration within the limits can tell apart.
        general_accuracy: Root mean square error over random configurations within the limits [m].
        value: Value of the criterion, see ``criteria``; for ``test_pose`` the predicted accuracy.
        value_bound: No plan with as many measurements has a better value; NaN where the criterion has no bound.
        lower_bound: The same in metres for criteria that are accuracies, NaN for others.
        efficiency: Value over bound in the criterion's own convention, at most 1: for accuracies
            lower_bound / value, for D (det M / det M*)^(1/p).
        bound: ``"numerical"`` (the sensitivity was maximised by search), ``"proven"``, or ``"none"``.
        bound_tolerance: By how much the bound may be off, as a share of Ψ: of a proven one, how closely it was
            computed; of a numerical one, the rise below which the search for a larger sensitivity ended.
        rounded_efficiency: Efficiency of the approximate design rounded to whole visits at its configurations,
            where the plan's own is below ``planner.UNEXPLAINED``; NaN elsewhere. See ``bound``.
        status: A key of ``STATUS``.
        message: What the status means and what to do.
        seconds: Time spent.
        seed: The seed that reproduces the plan.
        starts: Number of starts of the search.
        evaluations: Number of plans evaluated.
        accuracy_frame: What the accuracies are, ``world`` or ``robot``, (M3).
        error_model: Name of the error model.
        terms: How large its terms are at the test poses.
    """

    predicted_accuracy_per_test_pose: FloatArray
    parameter_std: FloatArray
    criterion: str = "test_pose"
    predicted_accuracy: float = NAN
    unidentifiable: tuple[str, ...] = ()
    general_accuracy: float = NAN
    value: float = NAN
    value_bound: float = NAN
    lower_bound: float = NAN
    efficiency: float = NAN
    bound: str = "none"
    bound_tolerance: float = NAN
    rounded_efficiency: float = NAN
    status: str = "ok"
    message: str = ""
    seconds: float = 0.0
    seed: int = 0
    starts: int = 0
    evaluations: int = 0
    accuracy_frame: str = "world"
    error_model: str = "paper"
    terms: tuple[PlannedTerm, ...] = ()

    def __post_init__(self) -> None:
        for name in ("predicted_accuracy_per_test_pose", "parameter_std"):
            object.__setattr__(self, name, frozen(np.asarray(getattr(self, name), float)))


@dataclass(frozen=True, eq=False, repr=False)
class Plan(Told):
    """What to measure, with its proof.

    Attributes:
        robot: Name of the robot.
        parameters: (P,) names of the parameters to be identified.
        joint_names: Order of the columns of ``configurations`` and ``test_poses``.
        configurations: (m, joints) in the order of measuring [rad | m].
        repetitions: (m,) measurements at each.
        test_poses: (K, joints) [rad | m].
        weights: (K,) weights of the test poses.
        sigma: Standard deviation of one coordinate [m]; for a laser tracker a typical one.
        quality: How good the plan is and how it was reached.
    """

    robot: str
    parameters: tuple[str, ...]
    joint_names: tuple[str, ...]
    configurations: FloatArray
    repetitions: IntArray
    test_poses: FloatArray
    weights: FloatArray
    sigma: float
    quality: PlanQuality

    def _facts(self) -> list[tuple[str, object]]:
        quality = self.quality
        accuracy = [("accuracy", length(quality.predicted_accuracy))] if len(self.test_poses) else []
        efficiency = f"{100 * quality.efficiency:.1f} % ({quality.bound} bound)"
        return [
            ("robot", self.robot),
            ("measurements", f"{self.measurements} at {counted(len(self.configurations), 'configuration')}"),
            *accuracy,
            *([("efficiency", efficiency)] if np.isfinite(quality.efficiency) else []),
            ("criterion", quality.criterion),
            ("status", quality.status),
        ]

    def __post_init__(self) -> None:
        for name in ("configurations", "test_poses", "weights"):
            object.__setattr__(self, name, frozen(np.asarray(getattr(self, name), float)))
        object.__setattr__(self, "repetitions", frozen(np.asarray(self.repetitions, np.int64)))

    @property
    def measurements(self) -> int:
        """Number of measurements in all."""
        return int(self.repetitions.sum())

    def values(self) -> dict[str, Any]:
        """Every value of the plan and of its quality by ``KEYS``, as JSON, files and the store hold them."""
        both = vars(self) | vars(self.quality)
        return {name: both[name] for name in KEYS}

    @staticmethod
    def from_values(values: Mapping[str, Any]) -> Plan:
        """The plan whose ``values`` these are."""
        quality = {f.name: values[f.name] for f in fields(PlanQuality) if f.name in values}
        own = {name: value for name, value in values.items() if name not in quality}
        return Plan(**own, quality=PlanQuality(**quality))

    def to_dict(self) -> dict[str, Any]:
        """``values`` as plain lists and numbers, the keys of the contract; non-finite numbers become ``None``.

        With what the accuracies are, and the error model that they rest on.
        """
        quality = self.quality
        model = {"name": quality.error_model, "terms": [asdict(t) for t in quality.terms]}
        beside = ("bound_tolerance", "rounded_efficiency", "accuracy_frame")
        more: dict[str, Any] = {name: getattr(quality, name) for name in beside}
        return plain(self.values() | more | {"error_model": model})


KEYS = (
    "robot", "criterion", "parameters", "joint_names", "configurations", "repetitions", "test_poses", "weights",
    "sigma", "predicted_accuracy", "predicted_accuracy_per_test_pose", "parameter_std", "unidentifiable",
    "general_accuracy", "value", "value_bound", "lower_bound", "efficiency", "bound", "status", "message",
    "seconds", "seed", "starts", "evaluations",
)  # fmt: skip
"""Order of the keys of a plan in JSON and YAML."""
KINDS = {f.name: str(f.type) for f in (*fields(Plan), *fields(PlanQuality)) if f.name in KEYS}
"""Type of every value of a plan, by its key."""
