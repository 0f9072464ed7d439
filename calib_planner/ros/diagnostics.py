# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the identifier publishes on ``/diagnostics``: its streams, its session, its estimate, its store.

A snapshot goes in and findings come out. The level is ERROR where no measurement can be accepted, WARN where
somebody should look, STALE where no message comes, and OK otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from calib_planner.acquisition import NANO, Intake, Offset
from calib_planner.campaign import VALIDATION
from calib_planner.identification import Estimate
from calib_planner.io import UnavailableStore
from calib_planner.ros.lifecycle import ERROR, OK, STALE, WARN, Finding
from calib_planner.ros.session import Session, condition_of
from calib_planner.units import milliseconds


@dataclass(frozen=True)
class StreamHealth:
    """One stream since the last message on ``/diagnostics``.

    Attributes:
        name: Its topic.
        rate: Messages per second [Hz].
        age: The node's time less the newest stamp [s]; ``None`` before the first.
        skew: Newest stamp of the joints less that of this stream [s]; ``None`` without one of them.
        messages: Since the node became active.
        refused, late, lost: Without stamp or joints; too late, twice or set back; not delivered.
        reason: Why the last message was refused; empty once one was usable again.
        rest: How long what it shows has stood still [s]; about 0 while it moves, ``None`` without a robot.
        offset: Of the clocks, by standstills; ``None`` for the joints or as long as too little was seen.
    """

    name: str
    rate: float
    age: float | None
    skew: float | None
    messages: int
    refused: int
    late: int
    lost: int
    reason: str
    rest: float | None = None
    offset: Offset | None = None


def health(intake: Intake, now: int, seconds: float) -> list[StreamHealth]:
    """Every stream of ``intake`` in the last ``seconds``, at the time ``now`` [ns]."""
    detector, first = intake.detector, intake.joint_topics
    joints = max(count.last for count in intake.streams[:first])
    return [
        StreamHealth(
            name=count.name,
            rate=count.rate(seconds),
            age=(now - count.last) / NANO if count.last else None,
            skew=(joints - count.last) / NANO if count.last and joints else None,
            messages=count.messages,
            refused=count.refused,
            late=intake.dropped(k),
            lost=count.lost,
            reason=count.reason,
            rest=intake.rest(k),
            offset=None if detector is None or k < first else detector.clocks.offset(k - first),
        )
        for k, count in enumerate(intake.streams)
    ]


def identifier_findings(
    streams: Sequence[StreamHealth], bound: float, session: Session | None, waiting: str
) -> list[Finding]:
    """What the identifier has to say.

    Args:
        streams: The streams, joints first.
        bound: Largest clock offset [s].
        session: The session, or ``None``.
        waiting: Why there is no session.
    """
    heard = [Finding(f"stream {s.name}", *_stream(s, bound)) for s in streams]
    if session is None:
        return [*heard, Finding("campaign", ERROR, waiting)]
    parts = (("campaign", _campaign), ("estimate", _estimate), ("store", _store))
    return [*heard, *(Finding(part, *tell(session)) for part, tell in parts)]


Told = tuple[bytes, str, Mapping[str, object]]
"""Level, message and values."""


def _stream(s: StreamHealth, bound: float) -> Told:
    values = {
        "rate [Hz]": f"{s.rate:.1f}",
        "age [s]": "" if s.age is None else f"{s.age:.3f}",
        "skew to the joints [s]": "" if s.skew is None else f"{s.skew:.3f}",
        "clock offset [s]": "" if s.offset is None else f"{s.offset.seconds:+.3f}",
        "clock offset, doubt [s]": "" if s.offset is None else f"{s.offset.doubt:.3f}",
        "standing still [s]": "" if s.rest is None else f"{s.rest:.1f}",
        "messages": s.messages,
        "refused": s.refused,
        "too late or twice": s.late,
        "lost": s.lost,
    }
    if s.offset is not None and s.offset.exceeds(bound):
        offset = milliseconds(s.offset.seconds, plus=True)
        text = f"clock {offset} from the joints', {milliseconds(bound)} are allowed"
        return ERROR, text, values
    if s.reason:
        return WARN, s.reason, values
    if s.rate == 0:
        return STALE, "nothing heard", values
    return OK, f"{s.rate:.0f} Hz", values


def _campaign(session: Session) -> Told:
    rejections, missing = session.rejections, session.missing()
    values: dict[str, object] = {
        "campaign": session.campaign_id,
        "plan": session.plan_id,
        "planned measurements": 0 if session.plan is None else session.plan.measurements,
        "accepted": len(session.accepted),
        "of them held out for validation": sum(r.role == VALIDATION for r in session.accepted),
        "rejected": sum(rejections.values()),
        **{f"rejected: {status}": count for status, count in sorted(rejections.items())},
        "configurations missing": len(missing),
        "complete": session.complete,
        "next configuration": "",
        "next joints [rad | m]": "",
    }
    if session.plan is None:
        return WARN, "there is no plan", values
    if not missing:
        return OK, "complete", values
    q = session.plan.configurations[missing[0]].tolist()
    pairs = zip(session.plan.joint_names, q, strict=True)
    values["next configuration"] = missing[0]
    values["next joints [rad | m]"] = ", ".join(f"{n}={v:.4f}" for n, v in pairs)
    return OK, f"{len(missing)} configurations missing, next {missing[0]}", values


def _estimate(session: Session) -> Told:
    estimate = session.newest
    if not isinstance(estimate, Estimate):
        text = "no estimate yet" if estimate is None else estimate.message
        return (OK if estimate is None or estimate.missing else WARN), text, {}
    values = {
        "parameters": len(estimate.fit.parameters),
        "rank": estimate.observability.rank,
        "condition": f"{condition_of(estimate):.3g}",
        "points used": estimate.points.used,
        "outliers": len(estimate.points.rejected),
        "noise of a coordinate [m]": f"{estimate.noise.sigma:.3g}",
        "residual rms [m]": f"{estimate.residuals.after.rms:.3g}",
        "left-out error rms [m]": f"{estimate.left_out.rms:.3g}",
        "left-out error predicted [m]": f"{estimate.left_out.predicted_rms:.3g}",
        "predicted accuracy [m]": f"{estimate.accuracy.overall:.3g}",
        "verdict": estimate.verdict.level,
        "seconds": f"{estimate.seconds:.4f}",
    }
    reasons = "; ".join(r.text for r in estimate.verdict.reasons if r.level != "PASS")
    level = OK if estimate.fit.status == "ok" else WARN
    return level, reasons or estimate.fit.message, values


def _store(session: Session) -> Told:
    store = session.store
    values = {"file": "" if store.path is None else store.path, "standstills kept": len(session.records)}
    if store.trouble:
        return ERROR, f"the last standstill was not stored: {store.trouble}; the next one tries again", values
    if store.path is None and not isinstance(store, UnavailableStore):
        return WARN, "in memory only, lost with the node: set store_folder", values
    return OK, "every accepted measurement is on disk", values
