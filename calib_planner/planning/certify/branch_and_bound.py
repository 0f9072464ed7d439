# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The global maximum of a polynomial on a box, certainly: branch and bound on its Bernstein form.

On a box the polynomial lies below its largest Bernstein coefficient, and the coefficients at the corners are
values of it (see ``bernstein``). Boxes whose largest coefficient is at most (1 + tolerance) times the largest
value known are done; the others are halved along the axis in which their coefficients bend most. Hull and
polynomial approach each other with the square of the width, so that a maximum is soon alone. Those with the
largest coefficients are halved first, by the thousand, so that whenever the work is ended the largest coefficient
of the boxes that are left is a bound that is not far behind. Where they would fill the memory, the smallest boxes
come first, which are soon done.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.planning.certify.bernstein import Axis, first_boxes, halves

try:
    from calib_planner.planning._kernel import bend as _bend
except ImportError:  # not built, or an older one: NumPy does the same, more slowly
    _bend = None

CHUNK = 2**20
"""Coefficients handled at once: 8 MB."""
DEEPEST = 40
"""Most halvings of one axis."""
MEMORY = 2**24
"""Coefficients of boxes that may wait, 128 MB, before the smallest boxes come first."""


@dataclass(frozen=True, eq=False)
class Maximum:
    """What is certain of the maximum.

    Attributes:
        upper: The polynomial is nowhere larger, but for the rounding of its coefficients.
        largest: Largest value met, or known before.
        where: (k,) place of ``largest``; ``None`` if it was known before.
        boxes: Boxes bounded.
        late: Whether time or work was up before the tolerance was reached.
    """

    upper: float
    largest: float
    where: FloatArray | None
    boxes: int
    late: bool


def maximise(
    axes: tuple[Axis, ...],
    tensor: FloatArray,
    known: float,
    *,
    tolerance: float,
    time_limit: float = float("inf"),
    most_work: float = float("inf"),
    cancel: Callable[[], bool] = lambda: False,
) -> Maximum:
    """Bound the maximum from above and below.

    Args:
        axes: The k axes of the box.
        tensor: Coefficients of the harmonics, one axis each; the polynomial is ≥ 0.
        known: A value that the polynomial takes somewhere on the box, or zero.
        tolerance: How close ``upper`` shall come to ``largest``, relative.
        time_limit: Seconds; what has been proven by then is returned.
        most_work: Coefficients of boxes after which the same happens, on any machine at the same box.
        cancel: Called now and then; ``True`` ends the work as the time limit does.
    """
    deadline = time.perf_counter() + time_limit
    search = _Search(
        axes,
        tensor,
        known,
        lambda boxes: boxes * tensor.size > most_work or time.perf_counter() > deadline or cancel(),
    )
    upper = search.run(tolerance)
    return Maximum(upper, search.largest, search.where, search.boxes, search.late)


@dataclass(eq=False)
class _Boxes:
    """N boxes: Bernstein forms (N, …), largest coefficients (N,), centres and numbers of halvings (N, k) each."""

    forms: FloatArray
    tops: FloatArray
    centres: FloatArray
    depths: IntArray

    @staticmethod
    def of(forms: FloatArray, centres: FloatArray, depths: IntArray) -> _Boxes:
        return _Boxes(forms, forms.reshape(len(forms), -1).max(axis=1), centres, depths)

    def __len__(self) -> int:
        return len(self.tops)

    def at(self, rows: IntArray) -> _Boxes:
        return _Boxes(self.forms[rows], self.tops[rows], self.centres[rows], self.depths[rows])

    def with_(self, others: _Boxes) -> _Boxes:
        return _Boxes(
            np.concatenate([self.forms, others.forms]),
            np.concatenate([self.tops, others.tops]),
            np.concatenate([self.centres, others.centres]),
            np.concatenate([self.depths, others.depths]),
        )


class _Search:
    """The state of one maximisation."""

    def __init__(
        self, axes: tuple[Axis, ...], tensor: FloatArray, known: float, over: Callable[[int], bool]
    ) -> None:
        self.axes, self.tensor, self.over = axes, tensor, over
        self.largest = known
        self.where: FloatArray | None = None
        self.boxes, self.late = 0, False
        self.rows = max(CHUNK // max(tensor.size, 1), 1)
        self.halves = [a.pieces[1] for a in axes]

    def run(self, tolerance: float) -> float:
        """An upper bound within ``tolerance`` of the maximum; a looser one when late."""
        upper = 0.0
        every = first_boxes(self.axes, self.tensor)
        while batch := list(islice(every, self.rows)):
            centres, forms = (np.stack(part) for part in zip(*batch, strict=True))
            upper = max(
                upper, self._exhaust(_Boxes.of(forms, centres, np.zeros(centres.shape, np.int64)), tolerance)
            )
        return max(upper, self.largest)

    def _exhaust(self, waiting: _Boxes, tolerance: float) -> float:
        """Halve the boxes until all are done; the largest upper bound of any."""
        upper = 0.0
        self._look_at(waiting)
        while True:
            self.late = self.late or self.over(self.boxes)
            wide = waiting.depths.max(axis=1, initial=0) < DEEPEST
            open_ = (waiting.tops > (1.0 + tolerance) * self.largest) & wide
            if self.late or not self.axes:
                open_[:] = False
            upper = max(upper, float(waiting.tops[~open_].max(initial=0.0)))
            if not open_.any():
                return upper
            rows = np.flatnonzero(open_)
            full = len(rows) * self.tensor.size > MEMORY
            rank = -waiting.depths.sum(axis=1) if full else -waiting.tops
            order = rows[np.argsort(rank[rows], kind="stable")]
            children = self._split(waiting.at(order[: self.rows]))
            self._look_at(children)
            rest = order[self.rows :]
            waiting = waiting.at(rest).with_(children) if len(rest) else children

    def _look_at(self, boxes: _Boxes) -> None:
        """Raise the largest known value if a corner coefficient, which is a value, exceeds it."""
        self.boxes += len(boxes)
        ends = (slice(None), *(slice(None, None, size - 1) for size in boxes.forms.shape[1:]))
        flat = boxes.forms[ends].reshape(len(boxes), -1)
        row, corner = np.unravel_index(int(np.argmax(flat)), flat.shape)
        if flat[row, corner] <= self.largest:
            return
        self.largest = float(flat[row, corner])
        sides = np.array(np.unravel_index(corner, (2,) * len(self.axes)), float)
        half = np.array(self.halves) * 0.5 ** boxes.depths[row]
        self.where = boxes.centres[row] + (2.0 * sides - 1.0) * half

    def _split(self, boxes: _Boxes) -> _Boxes:
        """Halve every box along the axis in which its coefficients bend most, axis by axis."""
        shape, k = boxes.forms.shape, len(self.axes)
        chosen = np.argmax(bends(boxes.forms), axis=1)
        parts = []
        for j, axis in enumerate(self.axes):
            rows = np.flatnonzero(chosen == j)
            if not len(rows):
                continue
            levels = boxes.depths[rows, j]
            pairs = {level: halves(self.halves[j] * 0.5**level, axis.turns) for level in set(levels.tolist())}
            forms = boxes.forms[rows].reshape(len(rows), -1, shape[j + 1], _after(shape, j))
            unit = np.arange(k) == j
            for side in (0, 1):
                matrices = np.stack([pairs[level][side] for level in levels.tolist()])
                shift = (side - 0.5) * self.halves[j] * 0.5**levels
                moved = (matrices[:, None] @ forms).reshape(len(rows), *shape[1:])
                parts.append((moved, boxes.centres[rows] + shift[:, None] * unit, boxes.depths[rows] + unit))
        return _Boxes.of(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _after(shape: tuple[int, ...], axis: int) -> int:
    """Coefficients of a box, (N, …) being ``shape``, behind its axis of that number."""
    return int(np.prod(shape[axis + 2 :]))


def bends(forms: FloatArray) -> FloatArray:
    """(N, k) largest second differences of N boxes (N, …) along each of their k axes."""
    if _bend is None or not forms.flags.c_contiguous:
        return bends_numpy(forms)
    out = np.empty((len(forms), forms.ndim - 1))
    _bend(forms, out)
    return out


def bends_numpy(forms: FloatArray) -> FloatArray:
    """``bends`` without the compiled kernel."""
    shape = forms.shape
    every = (forms.reshape(len(forms), -1, shape[j + 1], _after(shape, j)) for j in range(len(shape) - 1))
    return np.stack([_along_third(each) for each in every], axis=1)


def _along_third(forms: FloatArray) -> FloatArray:
    """(N,) largest second difference of (N, before, size, after) along its third axis."""
    second = 2.0 * forms[:, :, 1:-1]
    np.subtract(forms[:, :, 2:], second, out=second)
    second += forms[:, :, :-2]
    return np.asarray(np.abs(second, out=second).reshape(len(forms), -1).max(axis=1))
