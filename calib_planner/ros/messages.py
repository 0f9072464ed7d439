"""Messages to values of the library and back; nothing here needs a node or spins.

What comes over the wire is checked here and nowhere else: lengths, finiteness, sizes. What does not fit raises
the library's own errors, with the message's field in ``InputError.field``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration, Time
from calib_planner_msgs.msg import CalibrationEstimate, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from geometry_msgs.msg import Point, PointStamped, Vector3
from numpy.typing import ArrayLike
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from calib_planner.acquisition import NANO, Rejection, Standstill
from calib_planner.arrays import FloatArray, check_array, check_number
from calib_planner.errors import InputError
from calib_planner.identification import Verdict
from calib_planner.io import ACCEPTED, DECISIONS
from calib_planner.planning import STATUS as PLAN_WORDS
from calib_planner.planning import Pace, Plan, PlanQuality, timetable
from calib_planner.robot import Robot
from calib_planner.units import brief

MOST_ROWS = 10_000
"""Largest number of configurations or test poses taken from a message."""
MOST_REPETITIONS = 100_000
NAN = float("nan")
"""Not known."""

PLAN_STATUS = {word: getattr(PlanMessage, f"STATUS_{word.upper()}") for word in (*PLAN_WORDS, "empty")}
ESTIMATE_STATUS = {
    "ok": CalibrationEstimate.STATUS_OK,
    "too_few": CalibrationEstimate.STATUS_TOO_FEW_MEASUREMENTS,
    "rank_deficient": CalibrationEstimate.STATUS_RANK_DEFICIENT,
    "not_converged": CalibrationEstimate.STATUS_NOT_CONVERGED,
    "error": CalibrationEstimate.STATUS_ERROR,
}
IN_ROS: tuple[tuple[str, str], ...] = (
    (r"add --couple (\S+)", r"declare the coupling \1 in the robot's YAML (couple:)"),
    (r"add --unknown (\S+)", r"set the parameter unknown to \1"),
    (r"add --millimetres|add --units \S+", "publish the points in metres"),
    (r"leave out --millimetres if the points are", "publish the points"),
    (r"(add|leave out) --degrees", "publish the joint positions in radians"),
    (
        r"calib-planner plan --measured … --accuracy …",
        "request a plan of more, or begin a campaign (campaign_node)",
    ),
    (r" \(--parameters full\)", " (parameter parameters: full)"),
    (r"use the robust loss \(--loss robust\)", "withdraw them (~/undo_measurement)"),
    (r", ask for it \(--prove\)", ""),
    (r" \(--base-link, --tip-link\)", ""),
    (r" \(--tip-link\)", " (parameter tip_link)"),
)
"""Pattern of an advice for the command line → what a user of the nodes does."""

ESTIMATE_NUMBERS = ("condition", "sigma_estimate", "residual_rms_before", "residual_rms_after", "left_out_rms",
                    "left_out_predicted_rms")  # fmt: skip
"""Numbers of an estimate that are not known while there is none."""
PLAN_NUMBERS = ("predicted_accuracy", "lower_bound", "efficiency", "seconds")
"""Fields of ``PlanQuality`` and of the message that are the same number."""
MEASUREMENT_STATUS = {
    word: getattr(
        Measurement,
        word.upper() if word == ACCEPTED else f"REJECTED_{word.upper()}",
        Measurement.REJECTED_NOT_FINITE,
    )
    for word in DECISIONS
}


def in_ros(text: str) -> str:
    """A text of the library for a message: its advice names parameters and services, not options of commands."""
    for pattern, replacement in IN_ROS:
        text = re.sub(pattern, replacement, text)
    return text


def nanoseconds(stamp: Time) -> int:
    """A stamp [ns]."""
    return int(stamp.sec) * NANO + int(stamp.nanosec)


def stamp_message(stamp: int) -> Time:
    """A stamp [ns] as message; the nearest that a message can hold."""
    stamp = min(max(stamp, 0), (2**31 - 1) * NANO)
    return Time(sec=stamp // NANO, nanosec=stamp % NANO)


@dataclass(frozen=True, eq=False)
class ReceivedPlan:
    """A plan that came over the wire.

    Attributes:
        plan_id: Its name.
        plan: The plan; what no message carries (weights, predicted standard deviations, counts) is NaN or 0.
    """

    plan_id: str
    plan: Plan


def plan_to_message(plan: Plan, plan_id: str, stamp: int, frame_id: str) -> PlanMessage:
    """A plan as message, made at ``stamp`` [ns]."""
    quality = plan.quality
    message = PlanMessage(
        plan_id=plan_id,
        robot=plan.robot,
        parameters=list(plan.parameters),
        joint_names=list(plan.joint_names),
        configurations=plan.configurations.ravel().tolist(),
        repetitions=plan.repetitions.tolist(),
        test_poses=plan.test_poses.ravel().tolist(),
        sigma=float(plan.sigma),
        predicted_accuracy_per_test_pose=quality.predicted_accuracy_per_test_pose.tolist(),
        seed=int(quality.seed) % 2**32,
        status=PLAN_STATUS[quality.status],
        message=in_ros(quality.message),
        **{name: getattr(quality, name) for name in ("criterion", "bound")},
        **{name: float(getattr(quality, name)) for name in PLAN_NUMBERS},
    )
    message.header.stamp, message.header.frame_id = stamp_message(stamp), frame_id
    return message


def no_plan() -> PlanMessage:
    """The plan of an answer that has none."""
    return PlanMessage(status=PLAN_STATUS["empty"], **dict.fromkeys(PLAN_NUMBERS[:3], NAN))


def plan_from_message(message: PlanMessage) -> ReceivedPlan:
    """Check a plan that came over the wire.

    Raises:
        InputError: A length that does not fit, a number that is not finite, an unusable status.
    """
    joints = tuple(message.joint_names)
    if not joints or len(set(joints)) != len(joints):
        raise InputError("joint_names", brief(list(joints)), "at least one name, each once")
    q = check_rows("configurations", message.configurations, joints)
    poses = check_rows("test_poses", message.test_poses, joints, least=0)
    counts = np.asarray(message.repetitions, np.int64)
    if counts.shape != (len(q),) or (counts < 1).any() or (counts > MOST_REPETITIONS).any():
        expected = f"{len(q)} numbers from 1 to {MOST_REPETITIONS}, one per configuration"
        raise InputError("repetitions", brief(counts.tolist()), expected)
    names = {v: k for k, v in PLAN_STATUS.items()}
    status = names.get(message.status, "")
    if status in ("", "empty"):
        raise InputError("status", status or message.status, "a plan that can be executed")
    accuracy = np.asarray(message.predicted_accuracy_per_test_pose, float)
    if accuracy.shape != (len(poses),):
        expected = f"{len(poses)} numbers, one per test pose"
        raise InputError("predicted_accuracy_per_test_pose", accuracy.shape, expected)
    numbers: dict[str, Any] = {name: float(getattr(message, name)) for name in PLAN_NUMBERS}
    plan = Plan(
        robot=message.robot,
        parameters=tuple(message.parameters),
        joint_names=joints,
        configurations=q,
        repetitions=counts,
        test_poses=poses,
        weights=np.full(len(poses), np.nan),
        sigma=check_number("sigma", message.sigma, low=0, high=1, unit="m"),
        quality=PlanQuality(
            predicted_accuracy_per_test_pose=accuracy,
            parameter_std=np.full(len(message.parameters), np.nan),
            criterion=message.criterion,
            value=float(message.predicted_accuracy),
            value_bound=float(message.lower_bound),
            bound=message.bound,
            status=status,
            message=message.message,
            seed=int(message.seed),
            **numbers,
        ),
    )
    return ReceivedPlan(message.plan_id, plan)


def check_rows(field: str, flat: ArrayLike, joints: Sequence[str], least: int = 1) -> FloatArray:
    """(rows, joints) [rad | m] from a row-major list of finite numbers.

    Raises:
        InputError: The length is no multiple of the number of joints, or too large, or a number is not finite.
    """
    values = np.asarray(flat, dtype=float).ravel()
    n = len(joints)
    if values.size % n or not least * n <= values.size <= MOST_ROWS * n:
        expected = f"rows of {n} numbers, joints in the order {', '.join(joints)}, {least} to {MOST_ROWS} rows"
        raise InputError(field, f"{values.size} numbers", expected)
    rows = values.reshape(-1, n)
    return check_array(field, rows, (None, n), meaning="joints in rad or m")


def joints_message(names: Sequence[str], positions: FloatArray, stamp: int) -> JointState:
    """Positions (joints,) [rad | m] at ``stamp`` [ns]."""
    message = JointState(name=list(names), position=positions.tolist())
    message.header.stamp = stamp_message(stamp)
    return message


def point_message(xyz: FloatArray, stamp: int, frame_id: str) -> PointStamped:
    """Point (3,) [m] at ``stamp`` [ns]."""
    message = PointStamped(point=Point(**_xyz(xyz)))
    message.header.stamp, message.header.frame_id = stamp_message(stamp), frame_id
    return message


def measurement_message(
    acquired: Standstill | Rejection,
    joint_names: Sequence[str],
    frame_id: str,
    *,
    status: str = ACCEPTED,
    reason: str = "",
    plan_id: str = "",
    index: int | None = None,
    repetition: int = 0,
    number: int = 0,
    unused: Sequence[int] = (),
) -> Measurement:
    """What became of a standstill; ``status`` is a key of ``MEASUREMENT_STATUS``."""
    message = Measurement(
        id=number,
        plan_id=plan_id,
        configuration_index=Measurement.UNPLANNED if index is None else index,
        repetition=repetition,
        joint_names=list(joint_names),
        joint_positions=acquired.joints.tolist(),
        samples=acquired.samples.tolist(),
        duration=(acquired.end - acquired.start) / NANO,
        status=MEASUREMENT_STATUS[status],
        unused_targets=list(unused),
        reason=reason,
    )
    message.header.stamp = stamp_message((acquired.start + acquired.end) // 2)
    message.header.frame_id = frame_id
    if isinstance(acquired, Standstill):
        message.points = [Point(**_xyz(p)) for p in acquired.points]
        message.std = [Vector3(**_xyz(np.full(3, s))) for s in acquired.std]
    return message


def _xyz(values: FloatArray) -> dict[str, float]:
    return dict(zip("xyz", map(float, values), strict=True))


@dataclass(frozen=True, eq=False)
class ReceivedEstimate:
    """The part of an estimate that a message carries, as arrays; see ``CalibrationEstimate``.

    Attributes:
        parameters: P names.
        nominal, deviations, std: (P,) [m | rad].
        predicted_accuracy: (t,) ρ0 at the test poses [m].
        sigma: Standard deviation of one coordinate [m].
        sigma_estimate: The same from the residuals [m].
    """

    parameters: tuple[str, ...]
    nominal: FloatArray
    deviations: FloatArray
    std: FloatArray
    predicted_accuracy: FloatArray
    sigma: float
    sigma_estimate: float


def estimate_to_message(estimate: Any, frame_id: str, **others: Any) -> CalibrationEstimate:
    """An ``Estimate`` as message, without stamp.

    Args:
        estimate: The estimate.
        frame_id: The robot's base frame.
        others: Further fields (``plan_id``, ``condition``, …).
    """
    numbers = {
        "nominal": estimate.fit.nominal,
        "value": estimate.fit.values,
        "deviation": estimate.fit.deviations,
        "std": estimate.fit.std,
        "covariance": estimate.fit.covariance,
        "test_poses": estimate.accuracy.test_poses,
        "predicted_accuracy": estimate.accuracy.predicted,
    }
    used = [t for t in estimate.terms if t.used]
    fields: dict[str, Any] = {k: np.asarray(v, float).ravel().tolist() for k, v in numbers.items()}
    fields |= {
        "robot": estimate.calibrated.name,
        "parameters": list(estimate.fit.parameters),
        "units": list(estimate.fit.units),
        "rank": estimate.observability.rank,
        "unidentifiable": list(estimate.observability.unidentifiable),
        "measurements": estimate.points.used,
        "sigma": float(estimate.noise.sigma),
        "sigma_estimate": float(estimate.residuals.sigma),
        "residual_rms_before": float(estimate.residuals.before.rms),
        "residual_rms_after": float(estimate.residuals.after.rms),
        "left_out_rms": float(estimate.left_out.rms),
        "left_out_predicted_rms": float(estimate.left_out.predicted_rms),
        "terms": [t.name for t in used],
        "term_sizes": [float(t.size) for t in used],
        "accuracy_frame": estimate.accuracy.frame,
        "status": ESTIMATE_STATUS[estimate.fit.status],
        "message": in_ros(estimate.fit.message),
        "condition": NAN,
        "outliers": len(estimate.points.rejected),
        "verdict": estimate.verdict.level,
        "reasons": reasons_of(estimate.verdict),
    }
    message = CalibrationEstimate(**(fields | others))
    message.header.frame_id = frame_id
    return message


def reasons_of(verdict: Verdict) -> list[str]:
    """The reasons of a verdict as lines, each with what to do."""
    return [in_ros(f"{r.level}: {r.text}{'; ' * bool(r.advice)}{r.advice}") for r in verdict.reasons]


def estimate_from_message(message: CalibrationEstimate) -> ReceivedEstimate:
    """Check an estimate that came over the wire.

    Raises:
        InputError: Lengths differ, or a value is not finite.
    """
    names = tuple(message.parameters)
    nominal = check_array("nominal", message.nominal, (len(names),))
    deviation = check_array("deviation", message.deviation, (len(names),))
    std = check_array("std", message.std, (len(names),), finite=False)
    accuracy = check_array("predicted_accuracy", message.predicted_accuracy, (None,), finite=False)
    sigma = float(message.sigma)
    return ReceivedEstimate(names, nominal, deviation, std, accuracy, sigma, float(message.sigma_estimate))


def pace_of(
    robot: Robot, turning: float, sliding: float, limits: FloatArray, dwell: float, settle: float = 0.0
) -> Pace:
    """Joint speeds: ``turning`` [rad/s] or ``sliding`` [m/s], and never above ``limits`` (joints,)."""
    wanted = np.where(robot.joint_is_revolute, turning, sliding)
    text = "of the node's parameters and the robot description"
    return Pace(np.minimum(wanted, limits), dwell, text, settle)


def trajectory_message(plan: Plan, robot: Robot, pace: Pace, frame_id: str) -> JointTrajectory:
    """A plan for a controller: at every visit a point of arrival and one of departure, at rest as all points.

    Before a further visit to the same configuration there is a point aside. The stamp is zero: a controller
    starts when it gets the trajectory. Another stamp is the time to start at, for which it would be late.

    Args:
        plan: Its configurations [rad | m], in the order of visiting.
        robot: Its limits bound the way to the first configuration, whose beginning is unknown.
        pace: Speeds and standstill; without a standstill there is no point of departure.
        frame_id: Frame of the header.

    Raises:
        InputError: The tour takes longer than a ROS duration can hold.
    """
    result = JointTrajectory(joint_names=list(plan.joint_names))
    result.header.frame_id = frame_id
    for q, after in timetable(plan, robot, pace).points(plan.configurations):
        point = JointTrajectoryPoint(positions=q, velocities=[0.0] * len(q))
        point.time_from_start = Duration(sec=after // NANO, nanosec=after % NANO)
        result.points.append(point)
    return result
