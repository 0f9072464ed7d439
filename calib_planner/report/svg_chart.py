"""Small charts as SVG text: axes with round numbers, many dots in one path, sizes that read on a phone.

A chart is a string for the inside of a page. Its colours come from the page's style sheet, by class.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import ArrayLike

from calib_planner._arrays import FloatArray


@dataclass(frozen=True)
class Axis:
    """Values ``low`` … ``high`` over ``start`` … ``end`` [drawing units]; ``log``: by their logarithm."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def __call__(self, values: FloatArray | float) -> FloatArray:
        """Where values lie; those outside are put on the border."""
        v = np.clip(np.asarray(values, float), self.low, self.high)
        a, b = self.low, self.high
        if self.log:
            v, a, b = np.log10(v), np.log10(a), np.log10(b)
        return np.asarray(self.start + (self.end - self.start) * (v - a) / (b - a))

    def ticks(self, most: int) -> FloatArray:
        """Round values, at most about ``most``."""
        if not self.log:
            step = round_step((self.high - self.low) / most)
            first = np.ceil(self.low / step - 1e-9)
            return step * np.arange(first, np.floor(self.high / step + 1e-9) + 1)
        decades = np.arange(np.floor(np.log10(self.low)), np.ceil(np.log10(self.high)) + 1)
        for steps in ((1, 2, 5), (1,)):
            found = np.array([s * 10.0**d for d in decades for s in steps])
            found = found[(found >= self.low * (1 - 1e-9)) & (found <= self.high * (1 + 1e-9))]
            if len(found) <= most:
                return found
        return found[:: -(-len(found) // most)]


def round_step(value: float) -> float:
    """The next 1, 2 or 5 times a power of ten, not below ``value``."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(s * power for s in (1, 2, 5, 10) if s * power >= value * (1 - 1e-9)))


def log_range(values: FloatArray, least: float = 1e-12) -> tuple[float, float]:
    """From below the smallest positive value to above the largest; at least a decade."""
    positive = values[np.isfinite(values) & (values > least)]
    if not positive.size:
        return 0.1, 10.0
    low, high = float(positive.min()) / 1.3, float(positive.max()) * 1.3
    middle = np.sqrt(low * high)
    return float(min(low, middle / np.sqrt(10))), float(max(high, middle * np.sqrt(10)))


@dataclass(frozen=True)
class Chart:
    """A frame with two axes.

    Attributes:
        x, y: Axes; ``y`` starts at the bottom.
        width, height: Of the drawing.
        x_label, y_label: What is along them, with the unit.
        title: For those who cannot see it.
        x_ticks: Ticks along x, at most about so many.
    """

    x: Axis
    y: Axis
    width: float
    height: float
    x_label: str
    y_label: str
    title: str
    x_ticks: int = 6

    def svg(self, *parts: str) -> str:
        """The frame with ``parts`` in it."""
        inside = "".join((self._grid(), *parts))
        return (
            f'<svg class="chart" viewBox="0 0 {self.width:g} {self.height:g}" role="img" '
            f'aria-label="{escape(self.title)}">{inside}</svg>'
        )

    def dots(self, name: str, x: ArrayLike, y: ArrayLike) -> str:
        """One path of dots of class ``name``; values that are not finite are left out."""
        pairs = self._inside(x, y)
        return f'<path class="dots {name}" d="{"".join(f"M{_n(a)} {_n(b)}h0" for a, b in pairs)}"/>'

    def crosses(self, name: str, x: ArrayLike, y: ArrayLike) -> str:
        """One path of × of class ``name``."""
        pairs = self._inside(x, y)
        marks = "".join(f"M{_n(a - 3.5)} {_n(b - 3.5)}l7 7m0-7l-7 7" for a, b in pairs)
        return f'<path class="cross {name}" d="{marks}"/>'

    def _inside(self, x: ArrayLike, y: ArrayLike) -> Iterator[tuple[float, float]]:
        """Where the pairs of finite values lie."""
        a, b = np.asarray(x, float), np.asarray(y, float)
        ok = np.isfinite(a) & np.isfinite(b)
        yield from zip(self.x(a[ok]).tolist(), self.y(b[ok]).tolist(), strict=True)

    def line(self, name: str, x: FloatArray, y: FloatArray) -> str:
        """A polyline of class ``name``."""
        points = " ".join(f"{_n(a)} {_n(b)}" for a, b in zip(self.x(x).tolist(), self.y(y).tolist(), strict=True))
        return f'<polyline class="{name}" points="{points}"/>'

    def level(self, name: str, y: float, label: str) -> str:
        """A horizontal line of class ``name`` with a label at its right end."""
        at = float(self.y(y))
        words = _text(_n(self.x.end - 4), _n(at - 4), "end", label, "label")
        return f'<path class="{name}" d="M{_n(self.x.start)} {_n(at)}H{_n(self.x.end)}"/>{words}'

    def _grid(self) -> str:
        left, right, bottom, top = (_n(v) for v in (self.x.start, self.x.end, self.y.start, self.y.end))
        parts = [f'<path class="axis" d="M{left} {bottom}H{right}"/>']
        for value in self.x.ticks(self.x_ticks):
            at = _n(float(self.x(value)))
            parts.append(f'<path class="grid" d="M{at} {bottom}V{top}"/>')
            parts.append(_text(at, _n(self.y.start + 15), "middle", plain_number(value)))
        for value in self.y.ticks(6):
            level = float(self.y(value))
            parts.append(f'<path class="grid" d="M{left} {_n(level)}H{right}"/>')
            parts.append(_text(_n(self.x.start - 5), _n(level + 4), "end", plain_number(value)))
        middle = _n((self.x.start + self.x.end) / 2)
        parts.append(_text(middle, _n(self.height - 5), "middle", self.x_label))
        parts.append(_text("2", "12", "start", self.y_label))
        return "".join(parts)


def _text(x: str, y: str, anchor: str, words: str, name: str = "axis-text") -> str:
    return f'<text class="{name}" x="{x}" y="{y}" text-anchor="{anchor}">{escape(words)}</text>'


def framed(
    width: float,
    height: float,
    x: tuple[float, float],
    y: tuple[float, float],
    labels: tuple[str, str, str],
    *,
    left: float = 44.0,
    log: tuple[bool, bool] = (False, False),
    x_ticks: int = 6,
) -> Chart:
    """A chart of the usual margins; ``labels`` are x, y and title."""
    across = Axis(*x, left, width - 8.0, log[0])
    up = Axis(*y, height - 38.0, 22.0, log[1])
    return Chart(across, up, width, height, *labels, x_ticks=x_ticks)


def plain_number(value: float) -> str:
    """A tick's value, with a true minus sign."""
    text = f"{value:.6g}" if abs(value) > 1e-12 else "0"
    return text.replace("-", "−")


def spread(count: int) -> tuple[float, float]:
    """Axis for rows 0 … count − 1."""
    return -0.02 * count - 0.5, 1.02 * count - 0.5


def _n(value: float) -> str:
    """One decimal, no more characters than needed."""
    text = f"{value:.1f}"
    return text[:-2] if text.endswith(".0") else text


def legend(entries: Sequence[tuple[str, str]]) -> str:
    """HTML for pairs (class of the mark, words)."""
    items = "".join(
        f'<span><svg class="mark" viewBox="0 0 16 12">{_mark(name)}</svg>{escape(words)}</span>'
        for name, words in entries
    )
    return f'<p class="legend">{items}</p>'


def _mark(name: str) -> str:
    if name.startswith("cross"):
        return f'<path class="{name}" d="M4.5 2.5l7 7m0-7l-7 7"/>'
    if name.startswith("dots"):
        return f'<path class="{name} big" d="M8 6h0"/>'
    return f'<path class="{name}" d="M1 6h14"/>'
