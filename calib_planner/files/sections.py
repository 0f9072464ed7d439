"""Sections of YAML files that users write: known keys only, plain numbers, errors that name the key."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.errors import FileFormatError, InputError

T = TypeVar("T")


@dataclass(frozen=True)
class Section:
    """One mapping of a file.

    Attributes:
        path: The file, for errors.
        where: Keys that lead here, with a dot at the end, or empty at the top.
        values: Its content.
    """

    path: Path
    where: str
    values: Mapping[str, Any]

    def only(self, keys: Sequence[str], required: Sequence[str] = ()) -> Section:
        """Itself, once it is known to hold no other keys, and all the required ones."""
        for key in self.values:
            if key not in keys:
                raise self.error(str(key), "an unknown key", f"only: {', '.join(keys)}")
        for key in required:
            if key not in self.values:
                raise self.error(key, "nothing", f"this key, of: {', '.join(keys)}")
        return self

    def section(self, key: str) -> Section:
        """The mapping below ``key``."""
        value = self.values[key]
        if not isinstance(value, Mapping):
            raise self.error(key, repr(value)[:60], "a mapping of keys to values")
        return Section(self.path, f"{self.where}{key}.", value)

    def number(self, key: str, default: float | None = None) -> float:
        """A number; text that is one (``3e-5``, which YAML takes for text) counts."""
        if key not in self.values and default is not None:
            return default
        return self._number(key, self.values.get(key))

    def numbers(self, key: str, length: int | None = None) -> FloatArray:
        """(length,) a list of numbers."""
        value = self.values.get(key)
        if not isinstance(value, list) or not value or (length is not None and len(value) != length):
            raise self.error(key, repr(value)[:60], f"a list of {length or 'one or more'} numbers")
        return np.array([self._number(f"{key}[{i}]", v) for i, v in enumerate(value)])

    def directions(self, key: str) -> FloatArray:
        """(K, 3) one direction, or a list of them."""
        value = self.values.get(key)
        if isinstance(value, list) and value and isinstance(value[0], list):
            rows = Section(self.path, self.where, {f"{key}[{i}]": row for i, row in enumerate(value)})
            return np.array([rows.numbers(name, 3) for name in rows.values])
        return self.numbers(key, 3)[None]

    def angles(self, key: str, length: int) -> FloatArray:
        """(length,) angles [rad], from ``key`` [rad] or ``key_deg`` [degrees]; a single one may be bare."""
        degrees = f"{key}_deg"
        if (key in self.values) == (degrees in self.values):
            got = "both" if key in self.values else "neither"
            raise self.error(key, got, f"either {key} [rad] or {degrees} [degrees]")
        given = key if key in self.values else degrees
        bare = length == 1 and not isinstance(self.values[given], list)
        found = np.array([self.number(given)]) if bare else self.numbers(given, length)
        return found if given == key else np.radians(found)

    def truth(self, key: str, default: bool) -> bool:
        """true or false."""
        value = self.values.get(key, default)
        if not isinstance(value, bool):
            raise self.error(key, repr(value)[:60], "true or false")
        return value

    def text(self, key: str) -> str:
        """Text that is not empty."""
        value = self.values.get(key)
        if not isinstance(value, str) or not value:
            raise self.error(key, repr(value)[:60], "text")
        return value

    def error(self, key: str, got: str, expected: str) -> FileFormatError:
        """What to raise about ``key``."""
        return FileFormatError(self.path, f"{self.where}{key}", got, expected)

    def made(self, make: Callable[[], T]) -> T:
        """What ``make`` returns; an error about a value becomes one about this section of the file."""
        try:
            return make()
        except FileFormatError:
            raise
        except InputError as error:
            where = self.where + error.field
            raise FileFormatError(self.path, where, error.got, error.expected, error.advice) from None

    def _number(self, key: str, value: Any) -> float:
        try:
            if isinstance(value, bool) or not isinstance(value, (int, float, str)):
                raise ValueError
            number = float(value)
        except (ValueError, OverflowError):
            raise self.error(key, repr(value)[:60], "a number") from None
        if not np.isfinite(number):
            raise self.error(key, repr(value)[:60], "a finite number")
        return number
