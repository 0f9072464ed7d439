"""Runs one node in a process of its own: ends on Ctrl-C or SIGTERM with status 0, on a bad set-up with 1."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
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
from rclpy.signals import SignalHandlerOptions

from calib_planner.errors import CalibPlannerError

LAST_WORDS = 1.0
"""Time for answers that are on their way when the process ends [s]."""


def run(make: Callable[[], Node], threads: int, args: Sequence[str] | None = None) -> int:
    """Make the node, spin it, clean up once.

    Args:
        make: Makes the node; its ``close``, if it has one, ends what is under way and says whether it did.
        threads: 1 for a node whose callbacks are all short: rclpy's executor of many threads costs several
            times the processor time per message.
        args: Command line; default the process's own.

    Returns:
        Exit status.
    """
    ended = Ended()
    ended.listen()
    # Without rclpy's handlers the context outlives the signal, and whoever waits for an answer gets one.
    words = None if args is None else list(args)
    rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
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
        if ended.executor is not None:
            ended.executor.shutdown(timeout_sec=LAST_WORDS)
        rclpy.try_shutdown()
        if not in_time:
            # Python would wait for the thread that is still at work.
            os._exit(0)


class Ended:
    """Whether the process was told to end; a future, as far as rclpy's executors use one.

    Python calls its signal handlers between two steps of the main thread, which sleeps in the middleware, and a
    signal may arrive just before it goes to sleep. So a thread of its own waits for signals and wakes it; what it
    wakes looks at ``done`` before it sleeps again.
    """

    def __init__(self) -> None:
        self._noted = False
        self.executor: Executor | None = None

    def listen(self) -> None:
        """From now on SIGINT and SIGTERM end the process; main thread only."""
        self._read, self._write = socket.socketpair()
        self._write.setblocking(False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: None)
        signal.set_wakeup_fd(self._write.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=self._wait, daemon=True, name="signals").start()

    def _wait(self) -> None:
        while number := self._read.recv(1):
            if number[0] in (signal.SIGINT, signal.SIGTERM):
                self._noted = True
                if self.executor is not None:
                    self.executor.wake()

    def done(self) -> bool:
        """Called by rclpy."""
        return self._noted

    def add_done_callback(self, callback: object) -> None:
        """Called by rclpy at every step, to be woken; ``_wait`` does that by itself."""


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
