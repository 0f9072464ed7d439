"""One thread of linear algebra while we compute: our matrices are small.

BLAS libraries hand matrices of a few hundred rows to all cores, where the threads spin until the slowest is done.
On a machine that has anything else to do an identification takes tens of times as long that way, on an idle one
it gains nothing. threadpoolctl tells the libraries, and puts back what was set when the last of ours has ended;
without it (extra ``threads``; no package of ROS) set ``OMP_NUM_THREADS=1``.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, TypeVar

try:
    from threadpoolctl import ThreadpoolController
except ImportError:  # pragma: no cover
    ThreadpoolController = None

F = TypeVar("F", bound=Callable[..., Any])


class _OneThread:
    """A context manager that any number of threads may be in at once."""

    def __init__(self) -> None:
        self._lock, self._inside = threading.Lock(), 0
        self._controller: Any = None
        self._limit: Any = None

    def __enter__(self) -> None:
        if ThreadpoolController is None:
            return
        with self._lock:
            if not self._inside:
                # Looked for once: numpy's and scipy's libraries are there when this is first called.
                self._controller = self._controller or ThreadpoolController()
                self._limit = self._controller.limit(limits=1, user_api="blas")
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        if ThreadpoolController is None:
            return
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._limit.restore_original_limits()


ONE_THREAD = _OneThread()


def one_thread(function: F) -> F:
    """Decorator: linear algebra in ``function`` is done by the thread that calls it."""

    @functools.wraps(function)
    def within(*args: Any, **kwargs: Any) -> Any:
        with ONE_THREAD:
            return function(*args, **kwargs)

    return within  # type: ignore[return-value]
