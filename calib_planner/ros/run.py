"""Runs one node in a process of its own: ends on Ctrl-C or SIGTERM with status 0, on a bad set-up with 1."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Sequence

import rclpy
from rclpy.exceptions import InvalidHandle, ParameterException
from rclpy.executors import (
    Executor,
    ExternalShutdownException,
    MultiThreadedExecutor,
    SingleThreadedExecutor,
)
from rclpy.node import Node

from calib_planner.errors import CalibPlannerError


def run(make: Callable[[], Node], threads: int, args: Sequence[str] | None = None) -> int:
    """Make the node, spin it, clean up once.

    rclpy's own handlers shut the context down, which ends the spinning. Python's are replaced, so that a
    second Ctrl-C during the clean-up does no harm.

    Args:
        threads: 1 for a node whose callbacks are all short: rclpy's executor of many threads costs several
            times the processor time per message.

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
        executor = _executor(threads)
        executor.add_node(node)
        while rclpy.ok() and not asked:
            spin_once(executor)
        return 0
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except (CalibPlannerError, ParameterException) as error:
        print(f"{sys.argv[0]}: {error}", file=sys.stderr)
        return 1
    except Exception:
        # The context may be shut down while a callback is using it: that is the end asked for, not a fault.
        if asked or not rclpy.ok():
            return 0
        raise
    finally:
        close = getattr(node, "close", None)
        ended = close() if close is not None else True
        rclpy.try_shutdown()
        if not ended:
            # Python would wait for the thread that is still at work.
            os._exit(0)


def spin_once(executor: Executor, timeout: float | None = None) -> None:
    """Do what is next.

    Where there are several threads, one may destroy a publisher (transition ``cleanup``) just when another
    collects what to wait for; rclpy's executor then raises, and is as good as new when called again.
    """
    try:
        executor.spin_once(timeout_sec=timeout)
    except InvalidHandle:
        return


def _executor(threads: int) -> Executor:
    return SingleThreadedExecutor() if threads == 1 else MultiThreadedExecutor(num_threads=threads)
