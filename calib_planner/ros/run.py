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

    rclpy's own handlers shut the context down, and Python's are replaced, so that a second Ctrl-C during the
    clean-up does no harm. See ``Ended`` for how the spinning comes to its end.

    Args:
        threads: 1 for a node whose callbacks are all short: rclpy's executor of many threads costs several
            times the processor time per message.

    Returns:
        Exit status.
    """
    ended = Ended()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, ended.note)
    rclpy.init(args=None if args is None else list(args))
    node = None
    try:
        if ended.done():
            return 0
        node = make()
        ended.executor = executor = _executor(threads)
        executor.add_node(node)
        while rclpy.ok() and not ended.done():
            spin_once(executor, ended=ended)
        return 0
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except (CalibPlannerError, ParameterException) as error:
        print(f"{sys.argv[0]}: {error}", file=sys.stderr)
        return 1
    except Exception:
        # The context may be shut down while a callback is using it: that is the end asked for, not a fault.
        if ended.done() or not rclpy.ok():
            return 0
        raise
    finally:
        close = getattr(node, "close", None)
        in_time = close() if close is not None else True
        rclpy.try_shutdown()
        if not in_time:
            # Python would wait for the thread that is still at work.
            os._exit(0)


class Ended:
    """Whether the process was told to end; a future, as far as rclpy's executors use one.

    rclpy wakes the executor before it shuts the context down. If the executor looks at the context in between, it
    goes back to sleep, and nothing wakes it again. It does look at its future, though, and Python calls ``note``
    before the executor's next step.
    """

    def __init__(self) -> None:
        self._noted = False
        self.executor: Executor | None = None

    def note(self, number: int, frame: object) -> None:
        """A signal handler."""
        self._noted = True
        if self.executor is not None:
            self.executor.wake()

    def done(self) -> bool:
        """Called by rclpy."""
        return self._noted

    def add_done_callback(self, callback: object) -> None:
        """Called by rclpy at every step, to be woken; ``note`` does that by itself."""


NEVER = Ended()


def spin_once(executor: Executor, timeout: float | None = None, ended: Ended = NEVER) -> None:
    """Do what is next.

    Args:
        executor: Whose turn it is.
        timeout: Longest time to wait for something [s]; ``None``: any.
        ended: Ends the waiting.

    Where there are several threads, one may destroy a publisher (transition ``cleanup``) just when another
    collects what to wait for; rclpy's executor then raises, and is as good as new when called again.
    """
    try:
        executor.spin_once_until_future_complete(ended, timeout)
    except InvalidHandle:
        return


def _executor(threads: int) -> Executor:
    return SingleThreadedExecutor() if threads == 1 else MultiThreadedExecutor(num_threads=threads)
