"""The border of robot files in YAML: every value comes out checked, or as an error that names its place."""

from __future__ import annotations

import reprlib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calib_planner._arrays import FloatArray
from calib_planner.errors import FileFormatError


def brief(item: Any) -> str:
    """At most 80 characters, whatever comes: a few lines of YAML aliases can stand for gigabytes of text."""
    return reprlib.repr(item)[:80]


class YamlReader:
    """Checks of the values of one document; holds the path for the errors, nothing else."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def document(self) -> Any:
        """What the file holds, as plain values.

        Raises:
            FileFormatError: Not a text file, or not YAML.
        """
        try:
            return yaml.safe_load(self.path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
            raise self.error("file", " ".join(str(error).split()), "readable YAML") from None

    def error(self, where: str, got: object, expected: str, advice: str = "") -> FileFormatError:
        return FileFormatError(self.path, where, got, expected, advice)

    def mapping(self, where: str, item: Any, keys: Sequence[str], required: Sequence[str] = ()) -> dict[str, Any]:
        if not isinstance(item, Mapping):
            raise self.error(where, type(item).__name__, f"a mapping with keys {', '.join(keys)}")
        for key in item:
            if key not in keys:
                raise self.error(where, f"unknown key {brief(key)}", f"only: {', '.join(keys)}")
        for key in required:
            if key not in item:
                raise self.error(where, f"no key {key!r}", f"{key!r} to be given")
        return dict(item)

    def sequence(self, where: str, item: Any) -> list[Any]:
        if not isinstance(item, list) or not item:
            raise self.error(where, brief(item), "a list with at least one entry")
        return item

    def number(self, where: str, item: Any) -> float:
        if isinstance(item, bool) or not isinstance(item, (int, float)) or not abs(item) <= np.finfo(float).max:
            advice = ""
            if isinstance(item, str) and _is_number(item):
                advice = "YAML takes that for text: write 1.0e-3 instead of 1e-3, and no quotes"
            raise self.error(where, brief(item), "a finite number", advice)
        return float(item)

    def vector(self, where: str, item: Any) -> FloatArray:
        if not isinstance(item, list) or len(item) != 3:
            raise self.error(where, brief(item), "three numbers")
        return np.array([self.number(f"{where}[{i}]", v) for i, v in enumerate(item)])

    def text(self, where: str, item: Any) -> str:
        """A name; whole numbers are taken as written."""
        if isinstance(item, bool) or not isinstance(item, (str, int)):
            raise self.error(where, brief(item), "a name")
        return str(item)

    def choice(self, where: str, item: Any, valid: Collection[str]) -> str:
        if not isinstance(item, str) or item not in valid:
            raise self.error(where, brief(item), f"one of: {', '.join(valid)}")
        return item

    def names(self, where: str, item: Any, known: Collection[str]) -> tuple[str, ...]:
        """A list of different names, all of them known."""
        if not isinstance(item, list):
            raise self.error(where, brief(item), "a list of parameter names")
        for name in item:
            if not isinstance(name, str) or name not in known:
                raise self.error(where, brief(name), f"only: {', '.join(sorted(known))}")
            if item.count(name) > 1:
                raise self.error(where, f"{name!r} twice", "each name once")
        return tuple(item)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
