"""YAML documents of this package: a format name, then plain values. No objects, no aliases are read."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray
from calib_planner.errors import FileFormatError, InputError
from calib_planner.io.text import read_text, write_text

UNICODE_BREAKS = ("\x85", "\u2028", "\u2029")
"""Line breaks beyond ASCII's, which YAML reads as white space inside a text."""


class _Loader(yaml.SafeLoader):
    """The safe loader, without aliases: a few lines of them can stand for gigabytes."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias (*name), which is not allowed here")
        return super().compose_node(parent, index)


def write_document(path: str | Path, kind: str, content: Mapping[str, Any], field: str = "output") -> None:
    """Write ``content`` below a line that says what it is; floats are exact to the bit."""
    plain = {"format": f"calib_planner/{kind}", **{k: _plain(v) for k, v in content.items()}}
    text = yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, width=100)
    if any(mark in text for mark in UNICODE_BREAKS):
        text = yaml.safe_dump(plain, sort_keys=False, width=100)  # escaped: YAML folds these into spaces
    write_text(path, text, field)


def read_mapping(path: str | Path, what: str) -> dict[str, Any]:
    """The mapping that a YAML file holds, whatever its keys; ``what`` says in errors what it should be.

    Raises:
        FileFormatError: Not YAML, or something else than a mapping.
    """
    text = read_text(path, what)
    try:
        document = yaml.load(text, Loader=_Loader)  # a SafeLoader
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise FileFormatError(path, "YAML", reason, what) from None
    if not isinstance(document, dict):
        raise FileFormatError(path, "document", type(document).__name__, what)
    return document


def read_document(path: str | Path, kind: str) -> dict[str, Any]:
    """The mapping of a document of this kind, without its format line.

    Raises:
        FileFormatError: Not YAML, or not such a document.
    """
    what = f"a YAML file of calib_planner/{kind}"
    document = read_mapping(path, what)
    if document.get("format") != f"calib_planner/{kind}":
        got = repr(document.get("format"))[:60]
        advice = f"give a file that calib-planner {kind.replace('estimate', 'identify')} --output wrote"
        raise FileFormatError(path, "format", got, f"calib_planner/{kind}", advice)
    return {str(k): v for k, v in document.items() if k != "format"}


def check_keys(
    path: str | Path, where: str, item: Any, required: Sequence[str], optional: Sequence[str] = ()
) -> Mapping[str, Any]:
    """``item`` as a mapping with all the required keys and none that is unknown."""
    if not isinstance(item, Mapping):
        wanted = f"a mapping with keys {', '.join(required)}"
        raise FileFormatError(path, where, type(item).__name__, wanted)
    for key in required:
        if key not in item:
            raise FileFormatError(path, where, f"no key {key!r}", f"the keys {', '.join(required)}")
    for key in item:
        if key not in required and key not in optional:
            wanted = f"only {', '.join([*required, *optional])}"
            advice = "was it written by another version?"
            raise FileFormatError(path, where, f"unknown key {key!r}", wanted, advice)
    return item


def read_value(path: str | Path, key: str, kind: str, value: Any) -> Any:
    """``value`` as the dataclass field annotated ``kind``: str, int, float, an array or names.

    Raises:
        FileFormatError: Of another kind.
    """
    reader, expected = _READERS[kind]
    try:
        return reader(value)
    except (TypeError, ValueError, OverflowError):
        raise FileFormatError(path, key, repr(value)[:60], expected) from None


def _plain(value: Any) -> Any:
    """Arrays and tuples to lists, NumPy numbers to Python's; non-finite floats stay."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return value


def _exactly(*kinds: type) -> Any:
    def check(value: Any) -> Any:
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            raise TypeError
        return kinds[0](value)

    return check


def _names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise TypeError
    return tuple(value)


def _array(value: ArrayLike) -> np.ndarray:
    array = np.asarray(value)
    if array.size and array.dtype.kind not in "iuf":
        raise TypeError
    return array.astype(np.float64)


def _whole_array(value: ArrayLike) -> np.ndarray:
    array = np.asarray(value)
    if array.size and array.dtype.kind not in "iu":
        raise TypeError
    return array.astype(np.int64)


_READERS: dict[str, tuple[Any, str]] = {
    "str": (_exactly(str), "text"),
    "int": (_exactly(int), "a whole number"),
    "float": (_exactly(float, int), "a number"),
    "tuple[str, ...]": (_names, "a list of names"),
    "FloatArray": (_array, "a list of numbers, or of rows of numbers of one length"),
    "IntArray": (_whole_array, "a list of whole numbers"),
}


# ── Sections of YAML files that users write: known keys only, plain numbers, errors that name the key ───────

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


# ── The border of robot files in YAML: every value comes out checked, or as an error that names its place ───


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
