"""Runs one node in a process of its own: ends on Ctrl-C or SIGTERM with status 0, on a bad set-up with 1."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node

from calib_planner.errors import CalibPlannerError


def run(make: Callable[[], Node], threads: int, args: Sequence[str] | None = None) -> int:
    """Make the node, spin it, clean up once.

    rclpy's own handlers shut the context down, which ends the spinning. Python's are replaced, so that a
    second Ctrl-C during the clean-up does no harm.

    Returns:
        Exit status.
    """
    asked: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda n, _: asked.append(n))
    rclpy.init(args=None if args is None else list(args))
    node = None
    try:
        if asked:
            return 0
        node = make()
        executor = MultiThreadedExecutor(num_threads=threads)
        executor.add_node(node)
        while rclpy.ok() and not asked:
            executor.spin_once()
        return 0
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except (CalibPlannerError, ParameterException) as error:
        print(f"{sys.argv[0]}: {error}", file=sys.stderr)
        return 1
    finally:
        close = getattr(node, "close", None)
        if close is not None:
            close()
        rclpy.try_shutdown()
