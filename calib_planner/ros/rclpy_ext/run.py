# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Runs one node in a process of its own, which ends on Ctrl-C or SIGTERM with status 0, on a bad set-up with 1.

*What rclpy does.* Its signal handlers shut the context down at once, so that nobody who waits for an answer gets
one. Without them Python's own handlers apply; these run between two steps of the main thread, which sleeps in the
middleware, and a signal that arrives just before it goes to sleep is not seen. And where an executor has several
threads, one may destroy a publisher (transition ``cleanup``) just when another one collects what to wait for: the
executor then raises ``InvalidHandle``, although it works again at the next call.

*What is done here.* rclpy's handlers are not installed. A thread of its own waits for signals and wakes the
executor, which looks whether the process is to end before it sleeps again. Once it ends, further signals are
ignored: Ctrl-C in a terminal reaches a node twice when ``ros2 launch`` passes it on, too. ``InvalidHandle`` while
collecting is passed over.

*The end.* First the threads of the executor: its ``shutdown`` marks it as shut down and then, for that reason,
does not wait for them. Then the node is destroyed, and the middleware's participant with it: else Fast DDS ends
it while the libraries of the process end, and if a message of discovery comes just then, it hangs or the
process dies. Fast DDS hangs even so, though seldom: the thread that takes the listener away holds a lock again
and again for which the thread that has such a message waits. It holds Python's interpreter, too; so a timer of
the system ends the process after ``LONGEST_END``.

*Upstream.* ros2/rclpy#844 (shutdown by a signal), #1142 and #1206 (``InvalidHandle``, open). This file may go
when rclpy's handlers leave the context alone until the executor has returned, when the executor passes over
what was destroyed while it collected, and when a process may end with a node at work.
"""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import sys
import threading
import time
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

LONGEST_END = 3.0
"""Time for answers that are being sent, and for the middleware, when the process ends [s]; 0.1 s is enough."""
SIGEV_THREAD = 2
"""A timer that calls a function in a thread of its own, in the numbers of Linux."""


def run(make: Callable[[], Node], threads: int, args: Sequence[str] | None = None) -> int:
    """Make the node, spin it and clean up; returns the exit status.

    Args:
        make: Makes the node. Its ``close``, if it has one, ends what is under way and returns whether it did.
        threads: 1 for a node whose callbacks are all short: rclpy's executor of many threads costs several
            times the processor time per message.
        args: Command line; by default that of the process.
    """
    ended = Ended()
    ended.listen()
    words = None if args is None else list(args)
    rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
    node = None
    try:
        if ended.done():
            return 0
        node = make()
        executor: Executor = SingleThreadedExecutor()
        if threads > 1:
            executor = MultiThreadedExecutor(num_threads=threads)
        ended.executor = executor
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
        # A callback may be using the context while it is shut down: the process is ending, which is no fault.
        if ended.done() or not rclpy.ok():
            return 0
        raise
    finally:
        ended.is_heard()
        close = getattr(node, "close", None)
        in_time = close() if close is not None else True
        if not in_time:
            # Python would wait for the thread that is still at work.
            os._exit(0)
        end_after(LONGEST_END)
        if ended.executor is not None:
            ended.executor.shutdown()
            if isinstance(ended.executor, MultiThreadedExecutor):
                ended.executor._executor.shutdown(cancel_futures=True)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


class _Event(ctypes.Structure):
    """``struct sigevent`` of Linux: 64 bytes, whatever the event is."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("kind", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("unused", ctypes.c_char * 32),
    )


class _Times(ctypes.Structure):
    """``struct itimerspec``: interval and time to wait, in seconds and nanoseconds."""

    _fields_ = tuple((name, ctypes.c_long) for name in ("every", "every_ns", "seconds", "nanoseconds"))


def end_after(seconds: float) -> None:
    """End this process with status 0 after so many seconds, even if C code holds Python's interpreter then."""
    if sys.platform != "linux":
        return
    system = ctypes.CDLL(None)
    event = _Event(kind=SIGEV_THREAD, function=ctypes.cast(system._exit, ctypes.c_void_p))
    timer = ctypes.c_void_p()
    if system.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0:
        whole = int(seconds)
        times = _Times(seconds=whole, nanoseconds=int(1e9 * (seconds - whole)))
        system.timer_settime(timer, 0, ctypes.byref(times), None)


class Ended:
    """Whether the process was told to end; rclpy's executor, which calls these methods, takes it for a future."""

    def __init__(self) -> None:
        self._noted = False
        self.executor: Executor | None = None

    def listen(self) -> None:
        """From now on SIGINT and SIGTERM are noted; may be called in the main thread only."""
        self._read, self._write = socket.socketpair()
        self._write.setblocking(False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: None)
        signal.set_wakeup_fd(self._write.fileno(), warn_on_full_buffer=False)
        threading.Thread(target=self._wait, daemon=True, name="signals").start()

    def is_heard(self) -> None:
        """From now on both are ignored: the process ends, whether it is told once more or not."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
        signal.set_wakeup_fd(-1)

    def _wait(self) -> None:
        while number := self._read.recv(1):
            if number[0] in (signal.SIGINT, signal.SIGTERM):
                self._noted = True
                if self.executor is not None:
                    self.executor.wake()

    def done(self) -> bool:
        """Whether it was told."""
        return self._noted

    def add_done_callback(self, callback: object) -> None:
        """Nothing: ``_wait`` wakes the executor by itself."""


NEVER = Ended()


def spin_once(executor: Executor, timeout: float | None = None, ended: Ended = NEVER) -> None:
    """Have an executor do what is next.

    Args:
        executor: The executor.
        timeout: Longest time to wait for something to do [s]; ``None`` for no limit.
        ended: Ends the waiting.
    """
    try:
        executor.spin_once_until_future_complete(ended, timeout)
    except InvalidHandle:  # something was destroyed while the executor collected what to wait for
        return
