# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Waits of the nodes follow simulated time where ``use_sim_time`` is set, and nothing else."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

from bench import Bench
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from calib_planner.acquisition import NANO
from calib_planner.ros.lifecycle import JUMP, LifecycleParameters, ManagedNode, Stopwatch
from calib_planner.ros.messages import stamp_message


@dataclass(frozen=True)
class NoParameters(LifecycleParameters):
    """Those that every node has."""


class Idle(ManagedNode[NoParameters]):
    """Does nothing."""

    def __init__(self, **options: Any) -> None:
        super().__init__("idle", NoParameters(), **options)


def test_what_a_clock_jumps_by_has_not_passed() -> None:
    watch = Stopwatch()
    began = watch.at(0.0, True)  # no message of the clock yet
    assert watch.at(1.7e9, True) == began
    assert watch.at(1.7e9 + 2.0, True) == began + 2.0
    assert watch.at(1.7e9 - 60.0, True) == began + 2.0  # the bag begins again
    assert watch.at(1.7e9 - 59.5, True) == began + 2.5
    assert watch.at(1.7e9 - 59.5 + JUMP, True) == began + 2.5  # another bag
    assert watch.at(1e6, False) == began + 2.5  # no longer simulated
    assert watch.at(1e6 + 2 * JUMP, False) == began + 2.5 + 2 * JUMP  # real time does not jump


def test_a_node_waits_as_long_as_simulated_time_says(bench: Bench) -> None:
    node = bench.start(Idle, use_sim_time=True)
    clock = bench.client.create_publisher(Clock, "/clock", QoSProfile(depth=1))
    bench.wait(clock.get_subscription_count)

    def set_to(seconds: float) -> None:
        def there() -> bool:
            clock.publish(Clock(clock=stamp_message(round(seconds * NANO))))
            return bool(node.now == round(seconds * NANO))

        bench.wait(there)

    set_to(100.0)
    began, ended = node.seconds, threading.Event()

    def wait() -> None:
        node.rest(3000.0, threading.Event())
        ended.set()

    waiting = threading.Thread(target=wait, daemon=True)
    waiting.start()
    bench.wait(lambda: not ended.wait(0.05))
    for now in (1000.0, 2000.0, 2500.0):
        set_to(now)
        assert node.seconds == began + now - 100.0 and not ended.is_set()
    set_to(3101.0)
    bench.wait(ended.is_set)
    waiting.join()


def test_a_wait_ends_early_when_told(bench: Bench) -> None:
    for simulated in (True, False):
        node = bench.start(Idle, use_sim_time=simulated, autostart=False)
        end = threading.Event()
        waiting = threading.Thread(target=node.rest, args=(1e6, end), daemon=True)
        waiting.start()
        end.set()
        waiting.join(60.0)
        assert not waiting.is_alive()
