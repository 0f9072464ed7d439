"""Tests of the nodes: skipped without ROS, on a ROS domain of their own, a fresh context per test."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2: source env.sh")
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.pop("ROS_LOCALHOST_ONLY", None)
sys.path.insert(0, str(Path(__file__).parent))

from bench import Bench


@pytest.fixture
def bench() -> Iterator[Bench]:
    with Bench() as made:
        yield made
