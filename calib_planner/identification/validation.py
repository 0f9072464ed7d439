# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Does the calibrated robot predict poses that took no part in the fit, and as well as it said it would?

At a held-out point measured − predicted should scatter like the covariance that ``Knowledge.predict`` gives. If
it is right, 95 % of the points lie inside their 95 % region (χ²₃).

Chance moves the mean square distance, the more so as errors of the parameters are common to all points: with the
covariance S of all residuals together it has the mean tr S/n and the variance 2 tr S²/n², that is, those of a χ²
with (tr S)²/tr S² degrees of freedom.

A *re-seated target* is a new one, of which nothing is known but what the rows of the seat tell
(``Knowledge.with_new_targets``, ``updated``). The test rows are not changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from calib_planner.arrays import FloatArray, one_thread
from calib_planner.error_model import Knowledge
from calib_planner.errors import InputError, NotEnoughDataError
from calib_planner.identification.estimate import Estimate, Validation
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.registration import register
from calib_planner.identification.solver import place_nominal
from calib_planner.identification.verdict import judged
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot

INSIDE = float(np.sqrt(chdtri(3, 0.05)))


@one_thread
def validate(
    problem: IdentificationProblem,
    estimate: Estimate,
    held_out: Sequence[Measurements],
    target_from: int = 0,
) -> Estimate:
    """``estimate`` with the distances on held-out data.

    Args:
        problem: What was identified.
        estimate: Its answer.
        held_out: One or more sets; the statistics are over all their points.
        target_from: The target was re-seated for each set: the first ``target_from`` rows of each give its
            offset, all else being kept, and only the other rows are the test. 0: target 1 … as identified.

    Raises:
        NotEnoughDataError: A set has no rows left to test.
        InputError: Points of more targets than the estimate knows, and no rows to tell them.
    """
    if target_from < 0:
        raise InputError("validate_target_from", target_from, "a whole number >= 0")
    before = place_nominal(problem)
    predictions = []
    for data in (d.in_order_of(problem.robot.joint_names) for d in held_out):
        if len(data) <= target_from:
            raise NotEnoughDataError(
                len(data),
                target_from + 1,
                f"{len(data)} validation rows, the first {target_from} of "
                "which give the target: nothing is left to test",
            )
        seat, rest = data.select(np.arange(target_from)), data.select(np.arange(target_from, len(data)))
        targets, known = rest.p.shape[1], len(estimate.calibrated.targets)
        if known < targets and not len(seat):
            raise InputError("validation data", f"{targets} targets", f"at most {known} targets")
        alone, nominal = (_distances(robot, seat, rest) for robot in (estimate.calibrated, before))
        predictions.append(_predict(estimate, seat, rest, alone, nominal))
    return judged(replace(estimate, validation=_statistics(predictions)))


@dataclass(frozen=True, eq=False)
class _Prediction:
    """What one set says of its points.

    Attributes:
        residuals: (points, 3) measured − predicted [m].
        covariance: (points, 3, 3) what these should scatter like [m²].
        measured: (points, 3) variances of the measurement alone [m²]; NaN where nobody states them.
        alone, nominal: (points,) distances from placement alone, and from the nominal kinematics [m].
        spread: tr S² of the covariance S of all residuals together [m⁴].
    """

    residuals: FloatArray
    covariance: FloatArray
    measured: FloatArray
    alone: FloatArray
    nominal: FloatArray
    spread: float


def _predict(
    estimate: Estimate, seat: Measurements, rest: Measurements, alone: FloatArray, nominal: FloatArray
) -> _Prediction:
    """The mean of the error model against ``rest``; targets that were put on anew are told by ``seat``."""
    known, targets = estimate.knowledge, rest.p.shape[1]
    if len(seat):
        offsets = np.zeros((targets, 3))
        there = estimate.calibrated.target_offsets[:targets]
        offsets[: len(there)] = there
        known = known.with_new_targets(offsets)
        known = known.updated(
            seat.q, np.where(seat.seen[:, :, None], seat.p, 0.0), seat.seen, payload=seat.payload
        )
    told = known.predict(rest.q, rest.payload)
    measured = np.diagonal(told.noise, axis1=2, axis2=3)[:, :targets]
    if estimate.noise.source == "residuals":  # the robot's own scatter may be part of it
        measured = np.full_like(measured, np.nan)
    seen = rest.seen
    residuals = (rest.p - told.mean[:, :targets])[seen]
    spread = _squared_trace(known, rest)
    return _Prediction(residuals, told.total[:, :targets][seen], measured[seen], alone, nominal, spread)


def _squared_trace(known: Knowledge, rest: Measurements) -> float:
    """tr S² [m⁴] of S = J⁺ C J⁺ᵀ + blockdiag(R_i) of all points of ``rest``: what the parameters have of their
    errors they share.
    """
    poses, seen = known.poses(rest.q, rest.payload), rest.seen
    there = np.zeros((len(poses), len(known.robot.targets)))
    there[:, : seen.shape[1]] = seen
    use = np.repeat(there, 3, axis=1)
    values, vectors = np.linalg.eigh(known.covariance)
    half = (known.model.columns(poses) * use[:, :, None]) @ (vectors * np.sqrt(np.maximum(values, 0.0)))
    own = known.model.visit_covariance(poses) * use[:, :, None] * use[:, None, :]
    flat = half.reshape(-1, half.shape[2])
    shared, cross = np.sum((flat.T @ flat) ** 2), np.sum(half * (own @ half))
    return float(shared + 2.0 * cross + np.sum(own**2))


def _distances(robot: Robot, seat: Measurements, rest: Measurements) -> FloatArray:
    """(points,) distances of ``rest`` from ``robot``, its targets put by ``seat`` if that has rows [m]."""
    targets = rest.p.shape[1]
    if len(seat):
        robot = register(robot.with_targets(np.zeros((targets, 3))), seat, base=False, tool=True)
    points = replace(robot, parameter_names=()).with_targets(robot.target_offsets[:targets]).positions(rest.q)
    return np.asarray(np.linalg.norm(rest.p - points, axis=2)[rest.seen])


def _statistics(parts: list[_Prediction]) -> Validation:
    """Of the predictions of all sets."""
    residuals = np.concatenate([p.residuals for p in parts])
    covariance = np.concatenate([p.covariance for p in parts])
    if not len(residuals):
        raise NotEnoughDataError(0, 1, "the validation data hold no measured point")
    alone, nominal = np.concatenate([p.alone for p in parts]), np.concatenate([p.nominal for p in parts])
    lengths, noise = np.linalg.norm(residuals, axis=1), np.concatenate([p.measured for p in parts])
    return Validation(
        count=len(lengths),
        mean=float(lengths.mean()),
        median=float(np.median(lengths)),
        rms=float(np.sqrt(np.mean(lengths**2))),
        max=float(lengths.max()),
        before_mean=float(nominal.mean()),
        predicted_rms=float(np.sqrt(np.mean(np.einsum("kii->k", covariance)))),
        within_95=float(np.mean(normalised(residuals, covariance) <= INSIDE)),
        placement_mean=float(alone.mean()),
        placement_rms=float(np.sqrt(np.mean(alone**2))),
        noise_rms=float(np.sqrt(np.mean(np.sum(noise, axis=1)))),
        freedom=float(np.einsum("kii->", covariance) ** 2 / sum(p.spread for p in parts)),
    )


def normalised(residuals: FloatArray, covariance: FloatArray) -> FloatArray:
    """(…,) Mahalanobis lengths of residuals (…, 3) under (…, 3, 3); NaN where not measured."""
    seen = np.isfinite(residuals).all(axis=-1)
    result = np.full(seen.shape, np.nan)
    solved = np.linalg.solve(covariance[seen], residuals[seen][:, :, None])[:, :, 0]
    result[seen] = np.sqrt(np.maximum(np.sum(solved * residuals[seen], axis=-1), 0.0))
    return result
