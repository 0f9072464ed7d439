"""Numbers, lists and foreign texts as people read them: the one place where a value becomes words.

Values come in SI units and radians and go out in the unit that a person at a robot uses. Texts that came from a
file or over a wire are of any length; messages show no more of them than a line can hold.
"""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterable

import numpy as np

MOST_CHARACTERS = 60
"""Characters of a refused value that an error shows."""

PER_UNIT = {
    "m": {"m": 1.0, "cm": 1e2, "mm": 1e3, "um": 1e6, "µm": 1e6, "μm": 1e6, "nm": 1e9, "in": 1 / 0.0254},
    "rad": {"rad": 1.0, "mrad": 1e3, "urad": 1e6, "µrad": 1e6, "μrad": 1e6}
    | dict.fromkeys(("deg", "°"), 180.0 / np.pi),
    "s": {"s": 1.0, "ms": 1e3, "min": 1 / 60, "h": 1 / 3600},
    "kg": {"kg": 1.0, "g": 1e3},
}
"""Unit of a quantity → the units in which people may state it, and how many of these make one of it."""
QUANTITY = re.compile(r"\s*([-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|nan|inf))\s*([^\s\d.]*)\s*", re.IGNORECASE)

MILLI_UNIT = {"m": "mm", "rad": "mrad"}
"""Unit of a parameter → the unit of 1000 times its value, which tables for people show."""


def quantity(text: str, unit: str = "m") -> float:
    """The number [unit] of a text such as ``2e-5``, ``20um``, ``0.02mm`` or ``20 µm``.

    Args:
        text: A number, in ``unit`` if it names none.
        unit: A key of ``PER_UNIT``.

    Raises:
        ValueError: Another text; says what is valid.
    """
    match = QUANTITY.fullmatch(text)
    others = PER_UNIT[unit]
    if match is None or match[2] not in {"", *others}:
        examples = ", ".join(name for name in others if name.isascii())
        hint = "; use a decimal point" if re.fullmatch(r"\s*[-+]?\d+,\d+\s*\D*", text) else ""
        raise ValueError(f"expected a number [{unit}], or one with its unit ({examples}), got {text!r}{hint}")
    return float(match[1]) / others[match[2] or unit]


def length(metres: float) -> str:
    """A length with its unit: three digits in µm below one millimetre, else four digits in mm."""
    if not np.isfinite(metres):
        return "unlimited"
    if abs(metres) < 1e-3:
        return f"{1e6 * metres:.3g} µm"
    return f"{1e3 * metres:.4g} mm"


def milli(value: float, digits: int = 4) -> str:
    """A length [m] in mm or an angle [rad] in mrad for a column of a table, with ``digits`` decimals, no unit."""
    return f"{1e3 * value:.{digits}f}" if np.isfinite(value) else "unknown"


def milliradians(radians: float, digits: int = 2) -> str:
    """A small angle in mrad with ``digits`` significant digits."""
    return f"{1e3 * radians:.{digits}g} mrad"


def milliseconds(seconds: float, *, plus: bool = False) -> str:
    """A short time in whole milliseconds; ``plus`` gives positive ones a sign too."""
    return f"{1e3 * seconds:{'+' if plus else ''}.0f} ms"


def joint_value(value: float, turns: bool, digits: int = 2) -> str:
    """A joint coordinate [rad | m] in the unit of ``joint_unit``, with ``digits`` decimals, no unit."""
    return f"{joint_factor(turns) * value:.{digits}f}"


def joint_unit(turns: bool) -> str:
    """What joint coordinates are shown in: degrees for a joint that turns, millimetres for one that slides."""
    return "°" if turns else "mm"


def joint_factor(turns: bool) -> float:
    """What makes ``joint_unit`` out of rad or m."""
    return 180.0 / np.pi if turns else 1e3


def duration(seconds: float) -> str:
    """A time as a person plans with it: whole seconds up to 99, then whole minutes, then hours and minutes."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


def clock(seconds: float) -> str:
    """A time since the beginning as a clock shows it: hours, minutes and seconds."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def signed(value: float, digits: int, *, plus: bool = False) -> str:
    """A number with ``digits`` decimals and a true minus sign.

    What rounds to zero has no sign; other positive numbers have one if ``plus`` is set.
    """
    text = f"{value:.{digits}f}"
    if float(text) == 0:
        return text.lstrip("-")
    return "+" + text if plus and value > 0 else text.replace("-", "−")


def counted(number: int, noun: str) -> str:
    """A number with its noun, which takes an s for its plural."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def listed(names: Iterable[object], most: int = 30, *, width: int = 40, none: str = "") -> str:
    """``a, b, c and 5 more``: the first ``most`` names with commas between.

    Args:
        names: Names from anywhere; one that cannot be printed is escaped.
        most: Number of names shown.
        width: Characters shown of each name.
        none: What stands for an empty list.
    """
    texts = list(map(str, names))
    shown = [t[:width] if t.isprintable() else ascii(t[:width]) for t in texts[:most]]
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(shown) + more or none


def cut(text: object, most: int = 1000) -> str:
    """A text of at most ``most`` characters; of a longer one the middle is left out, for ``…``.

    The beginning of a message says what happened and its end what to do.
    """
    text = str(text)
    end = (most - 3) // 2
    return text if len(text) <= most else f"{text[: most - 3 - end]} … {text[-end:]}"


def brief(value: object, most: int = MOST_CHARACTERS) -> str:
    """A value as Python writes it, at most ``most`` characters of it, without ever building a longer text."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = most
    short.maxlist = short.maxtuple = short.maxdict = 10
    short.maxlevel = 3
    return short.repr(value)[:most]
