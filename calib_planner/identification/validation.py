"""Does the calibrated robot predict poses that took no part in the fit?

A re-seated target has a new offset, to be found from a few rows of the validation data. The systematic error
that no geometric model holds would go straight into that offset, so what the calibration residuals predict of
it at those rows (see ``discrepancy``) is taken off first. The rows that are the test stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.errors import InputError, NotEnoughDataError
from calib_planner.identification.discrepancy import Discrepancy, fit_discrepancy
from calib_planner.identification.estimate import Estimate, Validation
from calib_planner.identification.evidence import distances, fit_placement
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.registration import register
from calib_planner.identification.solver import start_robot
from calib_planner.robot.chain import Robot


def validate(
    problem: IdentificationProblem,
    estimate: Estimate,
    held_out: Sequence[Measurements],
    target_from: int = 0,
) -> Estimate:
    """``estimate`` with the distances on held-out data.

    Args:
        held_out: One or more sets; the statistics are over all their points.
        target_from: The target was re-seated for each set: the first ``target_from`` rows of each give its
            offset, all else being kept, and only the other rows are the test. 0: target 1 … as identified.

    Raises:
        NotEnoughDataError: A set has no rows left to test.
    """
    if target_from < 0:
        raise InputError("validate_target_from", target_from, "a whole number >= 0")
    before_robot = fit_placement(start_robot(problem.robot, problem.data), problem.data)
    discrepancy = _discrepancy(problem, estimate) if target_from else None
    after, before = [], []
    for data in (d.in_order_of(problem.robot.joint_names) for d in held_out):
        if len(data) <= target_from:
            raise NotEnoughDataError(
                len(data),
                target_from + 1,
                f"{len(data)} validation rows, the first {target_from} of "
                "which give the target: nothing is left to test",
            )
        first, rest = np.arange(target_from), np.arange(target_from, len(data))
        seat = data.select(first) if target_from else None
        before.append(_distances(before_robot, seat, data.select(rest)))
        if seat is not None and discrepancy is not None:
            expected = discrepancy.predict(seat.q)[:, None]
            seat = Measurements(seat.joint_names, seat.q, seat.p - expected, seat.std)
        after.append(_distances(estimate.calibrated, seat, data.select(rest)))
    after_all, before_all = np.concatenate(after), np.concatenate(before)
    return estimate.with_validation(
        Validation(
            count=len(after_all),
            mean=float(after_all.mean()),
            median=float(np.median(after_all)),
            rms=float(np.sqrt(np.mean(after_all**2))),
            max=float(after_all.max()),
            before_mean=float(before_all.mean()),
        )
    )


def _discrepancy(problem: IdentificationProblem, estimate: Estimate) -> Discrepancy | None:
    """The systematic error over joint space, from the mean residual of each configuration's targets."""
    seen = problem.data.seen
    rows = seen.any(axis=1)
    if rows.sum() < 2:
        return None
    mean = np.nansum(estimate.residuals[rows], axis=1) / seen[rows].sum(axis=1)[:, None]
    return fit_discrepancy(estimate.calibrated, problem.data.q[rows], mean)


def _distances(robot: Robot, seat: Measurements | None, data: Measurements) -> FloatArray:
    targets = data.p.shape[1]
    if seat is not None:
        robot = register(robot.with_targets(np.zeros((targets, 3))), seat, base=False, tool=True)
    elif len(robot.targets) < targets:
        raise InputError("validation data", f"{targets} targets", f"at most {len(robot.targets)} targets")
    else:
        robot = robot.with_targets(robot.target_offsets[:targets])
    return distances(data.p - robot.positions(data.q))
