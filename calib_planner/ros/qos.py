"""The three qualities of service in use."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Results: a late joiner gets the newest."""

EVENTS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
"""Every message counts: measurements."""

SENSOR_OUT = QoSProfile(depth=200, reliability=ReliabilityPolicy.RELIABLE)
"""Streams that we publish."""

SENSOR_IN = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Streams that we hear: best effort matches every publisher, reliable or not."""
