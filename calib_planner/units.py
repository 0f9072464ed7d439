# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Numbers, lists and foreign texts as people read them: the one place where a value becomes words.

Values come in SI units and radians and go out in the unit that a person at a robot uses. Texts that came from a
file or over a wire are of any length; messages show no more of them than a line can hold.
"""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal
from html import escape

import numpy as np

from calib_planner.errors import InputError

MOST_CHARACTERS = 60
"""Characters of a refused value that an error shows."""

LENGTHS = {"m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "µm": 1e-6, "in": 0.0254, "ft": 0.3048}
"""Unit of length in files and options → metres."""

ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0, "gon": math.pi / 200.0}
"""Unit of angle in files and options → radians."""

PER_UNIT = {
    "m": {n: 1.0 / LENGTHS[n] for n in ("m", "cm", "mm", "µm")}
    | {"um": 1e6, "μm": 1e6, "nm": 1e9, "in": 1.0 / LENGTHS["in"]},
    "rad": {"rad": 1.0, "mrad": 1e3, "urad": 1e6, "µrad": 1e6, "μrad": 1e6}
    | dict.fromkeys(("deg", "°"), 1.0 / ANGLES["deg"]),
    "s": {"s": 1.0, "ms": 1e3, "min": 1 / 60, "h": 1 / 3600},
    "kg": {"kg": 1.0, "g": 1e3},
}
"""Unit of a quantity → the units in which people may state it, and how many of these make one of it."""
QUANTITY = re.compile(r"\s*([-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|nan|inf))\s*([^\s\d.]*)\s*", re.IGNORECASE)

MILLI_UNIT = {"m": "mm", "rad": "mrad"}
"""Unit of a parameter → the unit of 1000 times its value, which tables for people show."""

SPELLINGS = {
    **{name: name for name in (*LENGTHS, *ANGLES)},
    **dict.fromkeys(("metre", "metres", "meter", "meters"), "m"),
    **dict.fromkeys(("millimetre", "millimetres", "millimeter", "millimeters"), "mm"),
    **dict.fromkeys(("centimetre", "centimetres", "centimeter", "centimeters"), "cm"),
    **dict.fromkeys(("um", "μm", "micron", "microns", "micrometre", "micrometres", "micrometer"), "µm"),
    **dict.fromkeys(("inch", "inches", '"'), "in"),
    **dict.fromkeys(("foot", "feet"), "ft"),
    **dict.fromkeys(("radian", "radians", "rads"), "rad"),
    **dict.fromkeys(("degree", "degrees", "degs", "°", "º"), "deg"),
}
"""How people write units, in small letters → the unit's name here."""


@dataclass(frozen=True)
class Units:
    """The units of the numbers in a file; an empty text where nothing is said.

    Attributes:
        length: A key of ``LENGTHS``.
        angle: A key of ``ANGLES``.
    """

    length: str = ""
    angle: str = ""

    def __str__(self) -> str:
        return ",".join(filter(None, (self.length, self.angle)))

    @staticmethod
    def parse(text: str, field: str = "--units") -> Units:
        """``mm,deg``, ``deg`` or ``millimetres degrees`` as units.

        Raises:
            InputError: A word is no unit, or there are two of one kind.
        """
        said: dict[str, str] = {}
        for word in text.replace(",", " ").split():
            unit = SPELLINGS.get(word.casefold(), "")
            kind = "length" if unit in LENGTHS else "angle"
            if not unit or kind in said:
                valid = f"one of {', '.join(LENGTHS)}, or of {', '.join(ANGLES)}, or one of each"
                raise InputError(field, repr(text), valid, f"for example {field} mm,deg")
            said[kind] = unit
        return Units(**said)


UNSAID = Units()
SI = Units("m", "rad")


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
    # In decimals: 0.03 mm is 3e-05 m, and not 2.9999999999999997e-05.
    try:
        return float(Decimal(match[1]) / Decimal(repr(others[match[2] or unit])))
    except ArithmeticError:  # an exponent of six digits: infinite or zero in any unit
        return float(match[1])


def length(metres: float) -> str:
    """A length with its unit: three digits in µm below one millimetre, else four digits in mm."""
    if not np.isfinite(metres):
        return "unlimited"
    if abs(metres) < 1e-3:
        return f"{1e6 * metres:.3g} µm"
    return f"{1e3 * metres:.4g} mm"


def lengths(*metres: float) -> tuple[str, ...]:
    """Lengths that are compared with each other, all in the unit of the largest, each with three digits."""
    known = [abs(m) for m in metres if np.isfinite(m)]
    factor, unit = (1e3, "mm") if max(known, default=0.0) >= 1e-3 else (1e6, "µm")
    return tuple(f"{_three_digits(factor * m)} {unit}" if np.isfinite(m) else length(m) for m in metres)


def _three_digits(value: float) -> str:
    """A number with three significant digits and without an exponent; at most six decimals."""
    places = 2 - int(np.floor(np.log10(abs(value)))) if value else 0
    return f"{value:.{min(max(places, 0), 6)}f}"


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


class Told:
    """A value that says what it is in one line, and in a notebook as a table; a subclass has ``_facts``."""

    def _facts(self) -> Iterable[tuple[str, object]]:
        """Pairs (what, how much), the most important first."""
        raise NotImplementedError

    def __repr__(self) -> str:
        facts = ", ".join(f"{what} {value}" for what, value in self._facts())
        return f"{type(self).__name__}({cut(facts, 300)})"

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><th>{escape(w)}</th><td>{escape(cut(v))}</td></tr>" for w, v in self._facts())
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"
