# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Trigonometric polynomials on a box in Bernstein form: a hull that bounds them, and its halves.

A polynomial here is a tensor with one axis per joint. Along a joint that turns it is trigonometric of degree 2,
a combination of 1, cos t, sin t, cos 2t, sin 2t; along one that slides a quadratic. On an interval [c − h, c + h]
put t = c + s and, for a joint that turns, u = sin((h − s)/2) / sin h, v = sin((h + s)/2) / sin h. Then

    u² + 2 cos h · u v + v² = 1,    and squared:
    u⁴ + 4 cos h · u³v + (2 + 4 cos² h) u²v² + 4 cos h · u v³ + v⁴ = 1.                              (*)

For h < π/2 the five terms of (*) are ≥ 0 on the interval, sum to one and span the same five functions (Sánchez-
Reyes, "Harmonic rational Bézier curves, p-Bézier curves and trigonometric polynomials", 1998). So the polynomial
is a weighted mean of its coefficients b in this basis: min b ≤ polynomial ≤ max b. For a joint that slides the
same holds of the quadratic Bernstein basis. Products of the bases do the same on boxes; the coefficients at the
corners are values of the polynomial. Halving an interval is one small matrix, which depends on h alone and takes
weighted means: errors do not grow. The distance of hull and polynomial falls with h².
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib_planner.arrays import FloatArray

WIDEST = 2.0 * np.pi / 3.0
"""Widest first interval of a joint that turns [rad]; (*) needs less than π, this keeps the basis well apart."""


@dataclass(frozen=True)
class Axis:
    """One joint's interval.

    Attributes:
        low, high: Limits [rad | m]; of a joint that turns at most one turn.
        turns: Whether the joint turns; else it slides.
    """

    low: float
    high: float
    turns: bool

    @staticmethod
    def of(low: float, high: float, turns: bool) -> Axis:
        """The axis of a joint with these limits; more than one turn is one turn."""
        return Axis(-np.pi, np.pi, True) if turns and high - low > 2 * np.pi else Axis(low, high, turns)

    @property
    def nodes(self) -> FloatArray:
        """(5,) or (3,) places whose values determine the polynomial."""
        if self.turns:
            return np.array([2.0 * np.pi * k / 5.0 for k in range(5)])
        return np.array([self.low, 0.5 * (self.low + self.high), self.high])

    @property
    def pieces(self) -> tuple[FloatArray, float]:
        """Centres of the first intervals and their half-width."""
        count = max(int(np.ceil((self.high - self.low) / WIDEST)), 1) if self.turns else 1
        half = 0.5 * (self.high - self.low) / count
        return np.array([self.low + half * (2 * k + 1) for k in range(count)]), half

    def harmonics(self, t: FloatArray) -> FloatArray:
        """(N, 5 | 3): the functions spanned, the first being one and none larger than one on the axis."""
        if self.turns:
            return np.stack([np.ones_like(t), np.cos(t), np.sin(t), np.cos(2 * t), np.sin(2 * t)], axis=-1)
        x = (2.0 * t - self.low - self.high) / (self.high - self.low)
        return np.stack([np.ones_like(x), x, x * x], axis=-1)

    def analysis(self) -> FloatArray:
        """Matrix from values at the nodes to coefficients of the harmonics."""
        return np.asarray(np.linalg.inv(self.harmonics(self.nodes)), np.float64)

    def enter(self, centre: float, half: float) -> FloatArray:
        """Matrix from coefficients of the harmonics to the Bernstein form on [centre ± half]."""
        s = _inner_nodes(half, self.turns)
        return _solve(basis(half, s, self.turns), self.harmonics(centre + s))


def basis(half: float, s: FloatArray, turns: bool) -> FloatArray:
    """(N, 5 | 3) the Bernstein basis on [−half, half] at s (N,): (*), or the quadratic one."""
    if not turns:
        x = 0.5 * (s / half + 1.0)
        return np.stack([(1 - x) ** 2, 2 * x * (1 - x), x * x], axis=-1)
    c = np.cos(half)
    u, v = np.sin(0.5 * (half - s)) / np.sin(half), np.sin(0.5 * (half + s)) / np.sin(half)
    middle = (2.0 + 4.0 * c * c) * u**2 * v**2
    return np.stack([u**4, 4 * c * u**3 * v, middle, 4 * c * u * v**3, v**4], axis=-1)


def _inner_nodes(half: float, turns: bool) -> FloatArray:
    size = 5 if turns else 3
    return -half * np.cos(np.pi * np.arange(size) / (size - 1))


@lru_cache(maxsize=4096)
def halves(half: float, turns: bool) -> tuple[FloatArray, FloatArray]:
    """Matrices from the form on [−half, half] to those on its lower and its upper half."""
    s = _inner_nodes(half / 2, turns)
    inner = basis(half / 2, s, turns)
    lower = _solve(inner, basis(half, s - half / 2, turns))
    return lower, _solve(inner, basis(half, s + half / 2, turns))


def _solve(matrix: FloatArray, right: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.solve(matrix, right), np.float64)


def along(matrix: FloatArray, tensor: FloatArray, axis: int) -> FloatArray:
    """``tensor`` with ``matrix`` applied along one of its axes."""
    return np.ascontiguousarray(np.moveaxis(np.moveaxis(tensor, axis, -1) @ matrix.T, -1, axis))


def first_boxes(axes: tuple[Axis, ...], tensor: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Centres (k,) and Bernstein forms, shape of ``tensor``, of boxes that cover all axes.

    Args:
        axes: The k axes.
        tensor: Coefficients of the harmonics, one axis each.
    """

    def descend(k: int, centre: list[float], form: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
        if k == len(axes):
            yield np.array(centre), form
            return
        centres, half = axes[k].pieces
        for c in centres:
            yield from descend(k + 1, [*centre, float(c)], along(axes[k].enter(float(c), half), form, k))

    yield from descend(0, [], tensor)


def amplification(axes: tuple[Axis, ...]) -> float:
    """How much larger an error of the values at the nodes can be in the coefficients of any first box."""
    factor = 1.0
    for axis in axes:
        centres, half = axis.pieces
        maps = [np.abs(axis.enter(float(c), half) @ axis.analysis()).sum(axis=1).max() for c in centres]
        factor *= max(maps)
    return float(factor)
