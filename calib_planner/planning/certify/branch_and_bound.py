"""The global maximum of a polynomial on a box, certainly: branch and bound on its Bernstein form.

On a box the polynomial lies below its largest Bernstein coefficient, and the coefficients at the corners are
values of it (see ``bernstein``). Boxes whose largest coefficient is at most (1 + tolerance) times the largest
value known are done; the others are halved along the axis in which their coefficients bend most. Hull and
polynomial approach each other with the square of the width, so that a maximum is soon alone. Boxes are handled
by the thousand, depth first: memory stays small. Coarse tolerances come first, so that what is proven when time
is up is never far behind.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.planning.certify.bernstein import Axis, along, first_boxes, halves

CHUNK = 2**20
"""Coefficients handled at once: 8 MB."""
DEEPEST = 40
"""Most halvings of one axis."""
COARSE = (0.1, 0.01, 1e-3)
"""Tolerances on the way."""


@dataclass(frozen=True, eq=False)
class Maximum:
    """What is certain of the maximum.

    Attributes:
        upper: The polynomial is nowhere larger, but for the rounding of its coefficients.
        largest: Largest value met, or known before.
        where: (k,) place of ``largest``; ``None`` if it was known before.
        boxes: Boxes bounded.
        late: Whether time was up before the tolerance was reached.
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
    cancel: Callable[[], bool] = lambda: False,
) -> Maximum:
    """Bound the maximum from above and below.

    Args:
        axes: The k axes of the box.
        tensor: Coefficients of the harmonics, one axis each; the polynomial is ≥ 0.
        known: A value that the polynomial takes somewhere on the box, or zero.
        tolerance: How close ``upper`` shall come to ``largest``, relative.
        time_limit: Seconds; what has been proven by then is returned.
        cancel: Called now and then; ``True`` ends the work as the time limit does.
    """
    deadline = time.perf_counter() + time_limit
    search = _Search(axes, tensor, known, lambda: time.perf_counter() > deadline or cancel())
    upper = np.inf
    for step in (*(c for c in COARSE if c > tolerance), tolerance):
        upper = min(upper, search.run(step))
        if search.late:
            break
    return Maximum(upper, search.largest, search.where, search.boxes, search.late)


@dataclass(eq=False)
class _Boxes:
    """N boxes: Bernstein forms (N, …), centres (N, k) and numbers of halvings (N, k)."""

    forms: FloatArray
    centres: FloatArray
    depths: IntArray
    tops: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.tops = self.forms.reshape(len(self.forms), -1).max(axis=1)

    def at(self, rows: IntArray) -> _Boxes:
        return _Boxes(self.forms[rows], self.centres[rows], self.depths[rows])


class _Search:
    """The state of one maximisation; ``run`` may be called again with a finer tolerance."""

    def __init__(
        self, axes: tuple[Axis, ...], tensor: FloatArray, known: float, out_of_time: Callable[[], bool]
    ) -> None:
        self.axes, self.tensor, self.out_of_time = axes, tensor, out_of_time
        self.largest = known
        self.where: FloatArray | None = None
        self.boxes, self.late = 0, False
        self.rows = max(CHUNK // max(tensor.size, 1), 1)

    def run(self, tolerance: float) -> float:
        """An upper bound within ``tolerance`` of the maximum; a looser one when late."""
        upper = 0.0
        batch: list[tuple[FloatArray, FloatArray]] = []
        for box in first_boxes(self.axes, self.tensor):
            batch.append(box)
            if len(batch) == self.rows:
                upper = max(upper, self._exhaust(batch, tolerance))
                batch = []
        if batch:
            upper = max(upper, self._exhaust(batch, tolerance))
        return max(upper, self.largest)

    def _exhaust(self, batch: list[tuple[FloatArray, FloatArray]], tolerance: float) -> float:
        """Depth first through the halves of ``batch``; the largest upper bound of boxes that are done."""
        centres = np.stack([centre for centre, _ in batch])
        stack = [_Boxes(np.stack([form for _, form in batch]), centres, np.zeros(centres.shape, np.int64))]
        upper = 0.0
        while stack:
            boxes = stack.pop()
            self.boxes += len(boxes.tops)
            self._look_at_corners(boxes)
            self.late = self.late or self.out_of_time()
            wide = boxes.depths.max(axis=1, initial=0) < DEEPEST
            open_ = (boxes.tops > (1.0 + tolerance) * self.largest) & wide
            if self.late or not self.axes:
                open_[:] = False
            upper = max(upper, float(boxes.tops[~open_].max(initial=0.0)))
            rows = np.flatnonzero(open_)
            for start in range(0, len(rows), self.rows):
                stack.extend(self._split(boxes.at(rows[start : start + self.rows])))
        return upper

    def _look_at_corners(self, boxes: _Boxes) -> None:
        """Raise the largest known value if a corner coefficient, which is a value, exceeds it."""
        ends = (slice(None), *(slice(None, None, size - 1) for size in boxes.forms.shape[1:]))
        flat = boxes.forms[ends].reshape(len(boxes.tops), -1)
        row, corner = np.unravel_index(int(np.argmax(flat)), flat.shape)
        if flat[row, corner] <= self.largest:
            return
        self.largest = float(flat[row, corner])
        sides = np.array(np.unravel_index(corner, (2,) * len(self.axes)), float)
        half = np.array([a.pieces[1] for a in self.axes]) * 0.5 ** boxes.depths[row]
        self.where = boxes.centres[row] + (2.0 * sides - 1.0) * half

    def _split(self, boxes: _Boxes) -> list[_Boxes]:
        """Halve every box along the axis in which its coefficients bend most, group by group."""
        count, k = len(boxes.tops), len(self.axes)
        bends = [np.abs(np.diff(boxes.forms, 2, axis=j + 1)).reshape(count, -1).max(axis=1) for j in range(k)]
        chosen = np.argmax(bends, axis=0)
        depth = boxes.depths[np.arange(count), chosen]
        out = []
        for j, level in sorted({(int(a), int(b)) for a, b in zip(chosen, depth, strict=True)}):
            group = boxes.at(np.flatnonzero((chosen == j) & (depth == level)))
            axis, unit = self.axes[j], np.arange(k) == j
            half = axis.pieces[1] * 0.5**level
            for side, matrix in zip((-0.5, 0.5), halves(half, axis.turns), strict=True):
                forms = along(matrix, group.forms, j + 1)
                out.append(_Boxes(forms, group.centres + side * half * unit, group.depths + unit))
        return out
