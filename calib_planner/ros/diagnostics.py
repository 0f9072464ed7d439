"""What the identifier says on ``/diagnostics``: its streams, its campaign, its estimate, its store.

Pure: a snapshot goes in, a message comes out. Levels: ERROR where nothing can be accepted, WARN where somebody
should look, STALE where nothing is heard, OK else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from calib_planner.acquisition import NANO, Intake, Offset
from calib_planner.identification import Estimate
from calib_planner.io import UnavailableStore
from calib_planner.ros.messages import stamp_message
from calib_planner.ros.session import Campaign, condition_of
from calib_planner.units import cut, milliseconds

OK, WARN, ERROR, STALE = (
    DiagnosticStatus.OK,
    DiagnosticStatus.WARN,
    DiagnosticStatus.ERROR,
    DiagnosticStatus.STALE,
)


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
    offset: Offset | None = None


def health(intake: Intake, now: int, seconds: float) -> list[StreamHealth]:
    """Every stream of ``intake`` in the last ``seconds``, at the time ``now`` [ns]."""
    detector, joints = intake.detector, intake.streams[0].last
    return [
        StreamHealth(
            name=count.name,
            rate=count.rate(seconds),
            age=(now - count.last) / NANO if count.last else None,
            skew=(joints - count.last) / NANO if count.last and joints else None,
            messages=count.messages,
            refused=count.refused,
            late=0 if detector is None else detector.dropped[k],
            lost=count.lost,
            reason=count.reason,
            offset=None if detector is None or k == 0 else detector.clocks.offset(k - 1),
        )
        for k, count in enumerate(intake.streams)
    ]


def diagnostics(
    name: str,
    stamp: int,
    streams: Sequence[StreamHealth],
    bound: float,
    campaign: Campaign | None,
    waiting: str,
) -> DiagnosticArray:
    """The message.

    Args:
        name: Of the node.
        stamp: Now [ns].
        streams: Joints first.
        bound: Largest clock offset [s].
        campaign: The campaign, or ``None``.
        waiting: Why there is none.
    """
    robot = "" if campaign is None else campaign.robot.name
    parts = [(f"stream {s.name}", *_stream(s, bound)) for s in streams]
    if campaign is None:
        parts.append(("campaign", ERROR, waiting, {}))
    else:
        parts += [
            ("campaign", *_campaign(campaign)),
            ("estimate", *_estimate(campaign)),
            ("store", *_store(campaign)),
        ]
    message = DiagnosticArray()
    message.header.stamp = stamp_message(stamp)
    message.status = [_status(name, robot, *part) for part in parts]
    return message


Finding = tuple[bytes, str, Mapping[str, object]]


def _stream(s: StreamHealth, bound: float) -> Finding:
    values = {
        "rate [Hz]": f"{s.rate:.1f}",
        "age [s]": "" if s.age is None else f"{s.age:.3f}",
        "skew to the joints [s]": "" if s.skew is None else f"{s.skew:.3f}",
        "clock offset [s]": "" if s.offset is None else f"{s.offset.seconds:+.3f}",
        "clock offset, doubt [s]": "" if s.offset is None else f"{s.offset.doubt:.3f}",
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


def _campaign(campaign: Campaign) -> Finding:
    rejections, missing = campaign.rejections, campaign.missing()
    values: dict[str, object] = {
        "plan": campaign.plan_id,
        "planned measurements": 0 if campaign.plan is None else campaign.plan.measurements,
        "accepted": len(campaign.accepted),
        "rejected": sum(rejections.values()),
        **{f"rejected: {status}": count for status, count in sorted(rejections.items())},
        "configurations missing": len(missing),
        "complete": campaign.complete,
        "next configuration": "",
        "next joints [rad | m]": "",
    }
    if campaign.plan is None:
        return WARN, "there is no plan", values
    if not missing:
        return OK, "complete", values
    q = campaign.plan.configurations[missing[0]].tolist()
    pairs = zip(campaign.plan.joint_names, q, strict=True)
    values["next configuration"] = missing[0]
    values["next joints [rad | m]"] = ", ".join(f"{n}={v:.4f}" for n, v in pairs)
    return OK, f"{len(missing)} configurations missing, next {missing[0]}", values


def _estimate(campaign: Campaign) -> Finding:
    found = campaign.newest
    if not isinstance(found, Estimate):
        text = "no estimate yet" if found is None else found.message
        return (OK if found is None or found.missing else WARN), text, {}
    values = {
        "parameters": len(found.fit.parameters),
        "rank": found.observability.rank,
        "condition": f"{condition_of(found):.3g}",
        "points used": found.points.used,
        "outliers": len(found.points.rejected),
        "noise of a coordinate [m]": f"{found.noise.sigma:.3g}",
        "residual rms [m]": f"{found.residuals.after.rms:.3g}",
        "predicted accuracy [m]": f"{found.accuracy.overall:.3g}",
        "verdict": found.verdict.level,
        "seconds": f"{found.diagnostics.seconds:.4f}",
    }
    reasons = "; ".join(r.text for r in found.verdict.reasons if r.level != "PASS")
    level = OK if found.fit.status == "ok" else WARN
    return level, reasons or found.fit.message, values


def _store(campaign: Campaign) -> Finding:
    store = campaign.store
    values = {"file": "" if store.path is None else store.path, "standstills kept": len(campaign.kept)}
    if store.trouble:
        return ERROR, f"the last standstill was not stored: {store.trouble}; the next one tries again", values
    if store.path is None and not isinstance(store, UnavailableStore):
        return WARN, "in memory only, lost with the node: set store_folder", values
    return OK, "every accepted measurement is on disk", values


def _status(
    name: str, robot: str, part: str, level: bytes, message: str, values: Mapping[str, object]
) -> DiagnosticStatus:
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticStatus(
        name=f"{name}: {part}", hardware_id=robot, level=level, message=cut(message), values=pairs
    )
