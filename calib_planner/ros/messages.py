# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
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
from calib_planner_msgs.msg import CalibrationEstimate, ErrorTerm, JointConfiguration, Measurement
from calib_planner_msgs.msg import Plan as PlanMessage
from calib_planner_msgs.msg import Reason as ReasonMessage
from calib_planner_msgs.msg import Verdict as VerdictMessage
from geometry_msgs.msg import Point, PointStamped, Vector3
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from calib_planner.acquisition import NANO, Rejection, Standstill
from calib_planner.arrays import FloatArray, check_array, check_number
from calib_planner.campaign import FIT, VALIDATION
from calib_planner.errors import InputError
from calib_planner.identification import Verdict
from calib_planner.io import ACCEPTED, DECISIONS
from calib_planner.planning import STATUS as PLAN_WORDS
from calib_planner.planning import Pace, Plan, PlannedTerm, PlanQuality, timetable
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
                    "left_out_max", "left_out_predicted_rms", "validation_rms",
                    "validation_predicted_rms")  # fmt: skip
"""Numbers of an estimate that are not known while there is none."""
PLAN_NUMBERS = ("predicted_accuracy", "lower_bound", "efficiency")
"""Fields of ``PlanQuality`` and of the message that are the same number."""
PURPOSE = {FIT: PlanMessage.FIT, VALIDATION: PlanMessage.VALIDATION}
LEVELS = {"PASS": VerdictMessage.PASS, "WARN": VerdictMessage.WARN, "FAIL": VerdictMessage.FAIL}
MEASUREMENT_STATUS = {
    word: getattr(Measurement, word.upper() if word == ACCEPTED else f"REJECTED_{word.upper()}")
    for word in DECISIONS
}


def in_ros(text: str) -> str:
    """A text of the library for a message: its advice names parameters and services, not options of commands."""
    for pattern, replacement in IN_ROS:
        text = re.sub(pattern, replacement, text)
    return text


def nanoseconds(stamp: Time | Duration) -> int:
    """A stamp or a duration [ns]."""
    return int(stamp.sec) * NANO + int(stamp.nanosec)


def seconds_of(duration: Duration) -> float:
    """A duration [s]."""
    return nanoseconds(duration) / NANO


def duration_message(seconds: float) -> Duration:
    """A duration [s] as message, at most what one can hold."""
    whole = round(min(seconds, 2.0**31 - 1) * NANO)
    return Duration(sec=whole // NANO, nanosec=whole % NANO)


def rows_message(q: FloatArray) -> list[JointConfiguration]:
    """Configurations (rows, joints) [rad | m] as messages."""
    return [JointConfiguration(positions=row) for row in q.tolist()]


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
        campaign_id: Name of the campaign that it is part of; empty for none.
        purpose: What its measurements are for: ``fit`` or ``validation``.
    """

    plan_id: str
    plan: Plan
    campaign_id: str = ""
    purpose: str = FIT


def plan_to_message(
    plan: Plan, plan_id: str, stamp: int, frame_id: str, campaign_id: str = "", purpose: str = FIT
) -> PlanMessage:
    """A plan as message, made at ``stamp`` [ns]; ``purpose`` is a key of ``PURPOSE``."""
    quality = plan.quality
    message = PlanMessage(
        plan_id=plan_id,
        campaign_id=campaign_id,
        purpose=PURPOSE[purpose],
        robot=plan.robot,
        parameters=list(plan.parameters),
        joint_names=list(plan.joint_names),
        configurations=rows_message(plan.configurations),
        repetitions=plan.repetitions.tolist(),
        test_poses=rows_message(plan.test_poses),
        terms=[term_message(t, True) for t in quality.terms],
        sigma=float(plan.sigma),
        predicted_accuracy_per_test_pose=quality.predicted_accuracy_per_test_pose.tolist(),
        seed=int(quality.seed) % 2**32,
        status=PLAN_STATUS[quality.status],
        message=in_ros(quality.message),
        search_time=duration_message(quality.seconds),
        **{name: getattr(quality, name) for name in ("criterion", "bound", "accuracy_frame", "error_model")},
        **{name: float(getattr(quality, name)) for name in PLAN_NUMBERS},
    )
    message.header.stamp, message.header.frame_id = stamp_message(stamp), frame_id
    return message


def term_message(term: Any, used: bool) -> ErrorTerm:
    """A term of the error model, planned (``PlannedTerm``) or identified (``TermGain``)."""
    return ErrorTerm(name=term.name, size=float(term.size), std=float(term.std), gain=float(term.gain), used=used)


def no_plan() -> PlanMessage:
    """The plan of an answer that has none."""
    return PlanMessage(status=PLAN_STATUS["empty"], **dict.fromkeys(PLAN_NUMBERS, NAN))


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
            accuracy_frame=message.accuracy_frame,
            error_model=message.error_model,
            terms=tuple(PlannedTerm(t.name, t.size, t.std, t.gain) for t in message.terms),
            seconds=seconds_of(message.search_time),
            status=status,
            message=message.message,
            seed=int(message.seed),
            **numbers,
        ),
    )
    purpose = {v: k for k, v in PURPOSE.items()}.get(message.purpose)
    if purpose is None:
        raise InputError("purpose", message.purpose, "Plan.FIT or Plan.VALIDATION")
    return ReceivedPlan(message.plan_id, plan, message.campaign_id, purpose)


def check_rows(
    field: str, given: Sequence[JointConfiguration], joints: Sequence[str], least: int = 1
) -> FloatArray:
    """(rows, joints) [rad | m] from configurations of finite numbers.

    Raises:
        InputError: There are too many or too few, or one has another number of joints, or one is not finite.
    """
    if not least <= len(given) <= MOST_ROWS:
        raise InputError(field, f"{len(given)} configurations", f"{least} to {MOST_ROWS}")
    for row, one in enumerate(given):
        if len(one.positions) != len(joints):
            expected = f"{len(joints)} numbers, joints in the order {', '.join(joints)}"
            raise InputError(f"{field}[{row}].positions", f"{len(one.positions)} numbers", expected)
    rows = np.array([one.positions for one in given]).reshape(-1, len(joints))
    return check_array(field, rows, (None, len(joints)), meaning="joints in rad or m")


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
    campaign_id: str = "",
    purpose: str = FIT,
    index: int | None = None,
    repetition: int = 0,
    number: int = 0,
    unused: Sequence[int] = (),
) -> Measurement:
    """What became of a standstill; ``status`` is a key of ``MEASUREMENT_STATUS``."""
    message = Measurement(
        id=number,
        plan_id=plan_id,
        campaign_id=campaign_id,
        purpose=PURPOSE[purpose],
        configuration_index=Measurement.UNPLANNED if index is None else index,
        repetition=repetition,
        joint_names=list(joint_names),
        configuration=JointConfiguration(positions=acquired.joints.tolist()),
        samples=acquired.samples.tolist(),
        duration=duration_message((acquired.end - acquired.start) / NANO),
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
    held_out = estimate.validation
    numbers = {
        "nominal": estimate.fit.nominal,
        "value": estimate.fit.values,
        "deviation": estimate.fit.deviations,
        "std": estimate.fit.std,
        "covariance": estimate.fit.covariance,
        "predicted_accuracy": estimate.accuracy.predicted,
    }
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
        "left_out_max": float(estimate.left_out.max),
        "left_out_predicted_rms": float(estimate.left_out.predicted_rms),
        "validation_rms": NAN if held_out is None else float(held_out.rms),
        "validation_predicted_rms": NAN if held_out is None else float(held_out.predicted_rms),
        "terms": [term_message(t, t.used) for t in estimate.terms],
        "joint_names": list(estimate.calibrated.joint_names),
        "test_poses": rows_message(np.asarray(estimate.accuracy.test_poses, float)),
        "accuracy_frame": estimate.accuracy.frame,
        "status": ESTIMATE_STATUS[estimate.fit.status],
        "message": in_ros(estimate.fit.message),
        "condition": NAN,
        "outliers": len(estimate.points.rejected),
        "verdict": verdict_message(estimate.verdict),
    }
    message = CalibrationEstimate(**(fields | others))
    message.header.frame_id = frame_id
    return message


def verdict_message(verdict: Verdict) -> VerdictMessage:
    """A verdict as message."""
    reasons = [
        ReasonMessage(level=LEVELS[r.level], code=r.code, text=in_ros(r.text), advice=in_ros(r.advice))
        for r in verdict.reasons
    ]
    return VerdictMessage(level=LEVELS[verdict.level], reasons=reasons)


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
