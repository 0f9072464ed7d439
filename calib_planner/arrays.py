# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The only gatekeepers for arrays: each ``check_*`` returns the canonical, read-only float64 copy.

Inner code assumes that what passed here is clean: right shape, finite, C-ordered, immutable.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Sequence
from dataclasses import field, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib_planner.errors import InputError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
K = TypeVar("K")
V = TypeVar("V")


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Return a C-ordered copy that cannot be written to."""
    copy = np.array(array, order="C", copy=True)
    copy.setflags(write=False)
    return copy


def remembered(known: dict[K, V], key: K, most: int, make: Callable[[], V]) -> V:
    """The value of a key, made where it is not known; of more than ``most`` keys the oldest is forgotten."""
    if key not in known:
        if len(known) >= most:
            known.pop(next(iter(known)))
        known[key] = make()
    return known[key]


def plain(value: Any, *, keep_infinite: bool = False, keep_nan: bool = False) -> Any:
    """What JSON and YAML can hold: arrays and tuples as lists, NumPy's numbers as Python's, recursively.

    Numbers that are not finite become ``None``, unless they are to be kept.
    """
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, dict):
        return {str(k): plain(v, keep_infinite=keep_infinite, keep_nan=keep_nan) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v, keep_infinite=keep_infinite, keep_nan=keep_nan) for v in value]
    if not isinstance(value, float) or np.isfinite(value):
        return value
    return value if (keep_nan if np.isnan(value) else keep_infinite) else None


def check_array(
    field: str,
    value: ArrayLike,
    shape: Sequence[int | None],
    *,
    finite: bool = True,
    meaning: str | Callable[[], str] = "",
) -> FloatArray:
    """Return ``value`` as a read-only float64 array of the wanted shape.

    Args:
        field: Name used in the error.
        value: Anything NumPy reads as numbers.
        shape: Wanted shape; ``None`` matches any length on that axis.
        finite: Refuse NaN and infinities.
        meaning: Words for the axes, e.g. ``"(configurations, joints) in rad"``, or a function that makes them.

    Raises:
        InputError: Naming ``field``, what came in and what is valid.
    """

    def expected() -> str:
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        words = meaning if isinstance(meaning, str) else meaning()
        return f"an array of shape {wanted}" + (f", {words}" if words else "")

    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(field, f"{type(value).__name__} ({error})", expected()) from None
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise InputError(field, f"shape {array.shape}", expected())
    if finite and b"\0" in np.isfinite(array).tobytes():  # a third of the time of all() for a few numbers
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(
            field,
            f"{array[where]} at index {where}",
            "finite numbers only",
            "remove or repair that entry",
        )
    return frozen(array)


def check_configurations(field: str, value: ArrayLike, joint_names: Sequence[str]) -> FloatArray:
    """Return joint configurations as ``(N, joints)``; one configuration may come as ``(joints,)``."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.asarray(value, dtype=object)
    if array.ndim == 1 and array.size:
        array = array[None, :]
    return check_array(
        field,
        array,
        (None, len(joint_names)),
        meaning=lambda: f"(configurations, joints) in rad or m, joints in the order {', '.join(joint_names)}",
    )


def check_number(
    field: str,
    value: object,
    *,
    low: float = -np.inf,
    high: float = np.inf,
    low_open: bool = False,
    unit: str = "",
) -> float:
    """Return ``value`` as a finite float within ``[low, high]`` (``(low, high]`` if ``low_open``)."""
    left = "(" if low_open else "["
    expected = f"a finite number in {left}{low:g}, {high:g}]" + (f" {unit}" if unit else "")
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise InputError(field, repr(value), expected) from None
    below = number <= low if low_open else number < low
    if not np.isfinite(number) or below or number > high:
        raise InputError(field, repr(value), expected)
    return number


def check_count(field: str, value: object, *, low: int = 1, high: int = 10_000_000) -> int:
    """Return ``value`` as an int within ``[low, high]``."""
    expected = f"a whole number from {low} to {high}"
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise InputError(field, repr(value), expected)
    if not low <= int(value) <= high:
        raise InputError(field, repr(value), expected)
    return int(value)


def ranged(default: float, description: str, unit: str, low: float, high: float) -> Any:
    """A dataclass field with a default (an int makes it a whole number), description, unit and range.

    ``check_ranges`` and the parameters of the nodes read them, so that they stand here only.
    """
    return field(default=default, metadata={"description": description, "unit": unit, "low": low, "high": high})


def check_ranges(settings: Any, kind: type) -> None:
    """Check the fields of ``settings`` that ``kind`` declares with ``ranged``, and store them as int or float.

    Raises:
        InputError: A value is of another type, not finite or out of its range.
    """
    for item in fields(kind):
        low, high, unit = (item.metadata[k] for k in ("low", "high", "unit"))
        given = getattr(settings, item.name)
        if isinstance(item.default, int):
            value: float = check_count(item.name, given, low=low, high=high)
        else:
            value = check_number(item.name, given, low=low, high=high, unit=unit)
        object.__setattr__(settings, item.name, value)


# ── One thread of linear algebra while we compute: our matrices are small ───────────────────────────────────
# BLAS libraries hand matrices of a few hundred rows to all cores, where the threads spin until the slowest is
# done. On a machine that has anything else to do an identification takes tens of times as long that way, on an
# idle one it gains nothing. threadpoolctl tells the libraries, and puts back what was set when the last of ours
# has ended; without it (extra ``threads``; no package of ROS) set ``OMP_NUM_THREADS=1``.

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


def one_thread_here() -> None:
    """From now on linear algebra in this process is done by the thread that calls it."""
    ONE_THREAD.__enter__()


def one_thread(function: F) -> F:
    """Decorator: linear algebra in ``function`` is done by the thread that calls it."""

    @functools.wraps(function)
    def within(*args: Any, **kwargs: Any) -> Any:
        with ONE_THREAD:
            return function(*args, **kwargs)

    return within  # type: ignore[return-value]
