"""The qualities of service in use, and how a user overrides them.

Every publisher and subscription of ours takes parameters like

    qos_overrides./tracker/point.subscription.reliability: best_effort

(full topic name; reliability, durability, history, depth). They are read when the node is configured.
"""

from __future__ import annotations

import copy

from rcl_interfaces.msg import SetParametersResult
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Results: a late joiner gets the newest."""

EVENTS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""Every message counts: measurements."""

SENSOR_OUT = QoSProfile(depth=200, reliability=ReliabilityPolicy.RELIABLE)
"""Streams that we publish."""

SENSOR_IN = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Streams that we hear: best effort matches every publisher, reliable or not."""

STREAM_IN = QoSProfile(depth=5000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""The same where none may be missed: five seconds at 1 kHz."""

REQUESTS = QoSProfile(depth=100)
"""Requests: rclpy's 10 lose some of a burst, and whoever asked waits for ever."""

DEEPEST = 100_000
"""Largest depth of a queue that an override may ask for."""

POLICIES = (QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY, QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH)


def overridable(entity_id: str | None = None) -> QoSOverridingOptions:
    """The option that makes a publisher or subscription take overrides.

    Args:
        entity_id: Tells two publishers or subscriptions of one topic in one node apart.
    """
    return QoSOverridingOptions(POLICIES, callback=_check, entity_id=entity_id)


def own(qos: QoSProfile | int) -> QoSProfile:
    """A copy, since rclpy writes overrides into the profile it is given."""
    return QoSProfile(depth=qos) if isinstance(qos, int) else copy.copy(qos)


def _check(profile: QoSProfile) -> SetParametersResult:
    if not 1 <= profile.depth <= DEEPEST:
        return SetParametersResult(successful=False, reason=f"depth {profile.depth}, valid is 1 to {DEEPEST}")
    return SetParametersResult(successful=True)
