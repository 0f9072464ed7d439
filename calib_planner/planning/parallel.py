# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Work in parts, here or by any ``concurrent.futures`` executor.

The parts depend on the problem only, never on the executor, and a random part has a seed of its own. So the same
request gives the same numbers whoever works, and in whatever order. An executor of processes or of other machines
sends function and arguments by pickle: functions of a module, frozen values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any, TypeVar

from calib_planner.arrays import FloatArray, check_count, one_thread_here

T = TypeVar("T")
PART = 500
"""Configurations in one part of a list of candidates: a millisecond of work with the paper's model, some tens of
them with a whole error model."""


def results_of(executor: Executor | None, function: Callable[..., T], jobs: Iterable[tuple[Any, ...]]) -> list[T]:
    """``function(*job)`` of every job, in their order; what a job raises is raised here."""
    if executor is None:
        return [function(*job) for job in jobs]
    futures = [executor.submit(function, *job) for job in jobs]
    return [future.result() for future in futures]


@contextmanager
def processes(count: int, field: str = "processes") -> Iterator[Executor | None]:
    """An executor of so many processes on this machine, each with one thread; ``None`` for one."""
    if check_count(field, count, high=1_000) == 1:
        yield None
        return
    with ProcessPoolExecutor(count, get_context("spawn"), initializer=one_thread_here) as executor:
        yield executor


def cut(q: FloatArray) -> list[FloatArray]:
    """(N, joints) configurations in parts of at most ``PART`` rows; one empty part if there are none."""
    return [q[first : first + PART] for first in range(0, max(len(q), 1), PART)]
