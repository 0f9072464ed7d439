"""The qualities of service in use, and how a user overrides them.

Every publisher and subscription of the nodes takes parameters like

    qos_overrides./tracker/point.subscription.reliability: best_effort

(full topic name; reliability, durability, history, depth). They are read when the node is configured.
"""

from __future__ import annotations

import copy

from rcl_interfaces.msg import SetParametersResult
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Results: a subscriber that comes late gets the newest."""

EVENTS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""Measurements, of which none may be lost."""

SENSOR_OUT = QoSProfile(depth=200, reliability=ReliabilityPolicy.RELIABLE)
"""Streams that the nodes publish."""

SENSOR_IN = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Streams that the nodes subscribe to: best effort matches every publisher, reliable or not."""

STREAM_IN = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""The same where few may be lost: the queue holds five seconds at 1 kHz."""

REQUESTS = QoSProfile(depth=100)
"""Requests: rclpy's depth of 10 loses some of a burst, whose clients then wait for ever."""

DEEPEST = 100_000
"""Largest depth of a queue in an override."""

POLICIES = (QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY, QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH)


def overridable(entity_id: str | None = None) -> QoSOverridingOptions:
    """The option that makes a publisher or subscription take overrides.

    Args:
        entity_id: Tells two publishers or subscriptions of one topic in one node apart.
    """
    return QoSOverridingOptions(POLICIES, callback=_check, entity_id=entity_id)


def own(qos: QoSProfile | int) -> QoSProfile:
    """A copy, since rclpy writes overrides into the profile that it gets."""
    return QoSProfile(depth=qos) if isinstance(qos, int) else copy.copy(qos)


def _check(profile: QoSProfile) -> SetParametersResult:
    if not 1 <= profile.depth <= DEEPEST:
        return SetParametersResult(successful=False, reason=f"depth {profile.depth}, valid is 1 to {DEEPEST}")
    return SetParametersResult(successful=True)
