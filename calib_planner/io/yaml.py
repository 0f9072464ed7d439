# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The one reader and the one writer of this package's YAML files.

A file holds mappings, lists and plain values. A ``Node`` is one of them that knows its file and the keys that
lead to it, so that every error names the file, the key, what stands there and what is valid. Reading a file means
going from node to node: ``top["tracker"]["range"].numbers(2)``.

No objects are read, and no aliases: a few lines of those can stand for gigabytes. Numbers are written as in
YAML 1.2, so that ``3e-5`` is a number; PyYAML alone would take it for text. A number in quotes is text.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from calib_planner.arrays import FloatArray, IntArray, frozen, plain
from calib_planner.errors import FileFormatError, InputError
from calib_planner.io.text import read_text, write_text
from calib_planner.units import brief, quantity

UNICODE_BREAKS = ("\x85", "\u2028", "\u2029")
"""Line breaks beyond ASCII's, which YAML reads as white space inside a text."""
DEEPEST = 100
"""Levels of lists and mappings in a file; ours have six."""
T = TypeVar("T")


def write_document(path: str | Path, kind: str, content: Mapping[str, Any], field: str = "output") -> None:
    """Write ``content`` below a line that says what it is; floats are exact to the bit."""
    document = {"format": f"calib_planner/{kind}", **plain(dict(content), keep_infinite=True, keep_nan=True)}
    write_text(path, yaml_text(document), field)


def yaml_text(content: Mapping[str, Any]) -> str:
    """Plain values as YAML that ``read_yaml`` reads back to the bit."""
    return _dumped(dict(content), flow=False)


def yaml_line(key: str, value: Any) -> str:
    """A key and its value, a list of numbers or of rows on one line, as far as it fits."""
    return f"{key}: {_dumped(value, flow=True)}" if isinstance(value, list) else _dumped({key: value}, flow=False)


def _dumped(value: Any, *, flow: bool) -> str:
    style: dict[str, Any] = {"sort_keys": False, "width": 100, "default_flow_style": flow}
    text: str = yaml.dump(value, Dumper=_Dumper, allow_unicode=True, **style)
    if any(mark in text for mark in UNICODE_BREAKS):  # escaped: YAML folds these into spaces
        text = yaml.dump(value, Dumper=_Dumper, **style)
    return text


def read_yaml(path: str | Path, what: str) -> Node:
    """The mapping that a YAML file holds; ``what`` says in errors what the file should be.

    Raises:
        FileFormatError: Not a text file, not YAML, or something else than a mapping.
    """
    return parse_yaml(read_text(path, what), path, what)


def parse_yaml(text: str, path: str | Path, what: str) -> Node:
    """Like ``read_yaml``, from a text that stood in the file ``path``.

    Raises:
        FileFormatError: Not YAML, or something else than a mapping.
    """
    try:
        document = _loaded(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise FileFormatError(path, "YAML", " ".join(str(error).split()), what) from None
    if not isinstance(document, dict):
        raise FileFormatError(path, "document", type(document).__name__, what)
    return Node(path, "", document)


def read_document(path: str | Path, kind: str) -> Node:
    """The mapping of a file that ``write_document`` wrote, without its format line.

    Raises:
        FileFormatError: Not YAML, or not such a document.
    """
    top = read_yaml(path, f"a YAML file of calib_planner/{kind}")
    if top.value.get("format") != f"calib_planner/{kind}":
        advice = f"give a file that calib-planner {kind.replace('estimate', 'identify')} --output wrote"
        raise top.get("format").refused(f"calib_planner/{kind}", advice)
    return Node(path, "", {str(k): v for k, v in top.value.items() if k != "format"})


@dataclass(frozen=True)
class Node:
    """A value in a file.

    Attributes:
        path: The file, for errors.
        where: The keys that lead here, such as ``dh.rows[0].a``; empty for the whole document.
        value: The mapping, list or plain value.
    """

    path: str | Path
    where: str
    value: Any

    # ── errors ───────────────────────────────────────────────────────────────────────────────────────

    def error(self, got: object, expected: str, advice: str = "") -> FileFormatError:
        """The error about this value, to be raised."""
        return FileFormatError(self.path, self.where or "document", got, expected, advice)

    def refused(self, expected: str, advice: str = "") -> FileFormatError:
        """The error that shows the value itself, to be raised."""
        return self.error(brief(self.value), expected, advice)

    def build(self, make: Callable[[], T]) -> T:
        """What ``make`` returns; its errors about a value become errors about this part of the file."""
        try:
            return make()
        except FileFormatError:
            raise
        except InputError as error:
            raise self._below(error.field).error(error.got, error.expected, error.advice) from None

    # ── mappings and lists ───────────────────────────────────────────────────────────────────────────

    def mapping(
        self, keys: Collection[str] | None = None, required: Collection[str] = (), advice: str = ""
    ) -> Node:
        """Itself, once it is known to be a mapping with all required keys and, unless ``None``, only ``keys``."""
        names = ", ".join(required if keys is None else keys)
        if not isinstance(self.value, Mapping):
            expected = f"a mapping with keys {names}" if names else "a mapping of keys to values"
            raise self.error(f"{type(self.value).__name__} {brief(self.value)}", expected)
        for key in self.value:
            if keys is not None and key not in keys:
                close = get_close_matches(str(key)[:100], list(keys), n=1)
                near = f"did you mean {close[0]!r}?" if close else advice
                raise self.get(key).error(f"the unknown key {brief(key)}", f"only: {names}", near)
        for key in required:
            if key not in self.value:
                raise self.get(key).error(f"no key {key!r}", f"this key, of: {names}", advice)
        return self

    def __contains__(self, key: str) -> bool:
        return key in self.value

    def __getitem__(self, key: str) -> Node:
        """The value below a key that is there."""
        return Node(self.path, self._below(key).where, self.value[key])

    def get(self, key: str, default: Any = None) -> Node:
        """The value below a key; ``default`` where the key is not there."""
        return Node(self.path, self._below(key).where, self.value.get(key, default))

    def entries(self) -> Iterator[tuple[str, Node]]:
        """Keys and values of a mapping."""
        return ((str(key), Node(self.path, self._below(key).where, v)) for key, v in self.value.items())

    def items(self) -> list[Node]:
        """The entries of a list that has at least one."""
        if not isinstance(self.value, list) or not self.value:
            raise self.refused("a list with at least one entry")
        return [Node(self.path, f"{self.where}[{i}]", item) for i, item in enumerate(self.value)]

    def _below(self, key: object) -> Node:
        text = str(key)[:100]
        return Node(self.path, f"{self.where}.{text}" if self.where else text, None)

    # ── plain values ─────────────────────────────────────────────────────────────────────────────────

    def number(self) -> float:
        """A finite number."""
        value = self.value
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= LARGEST:
            advice = "a number in quotes is text: leave the quotes out" if _says_a_number(value) else ""
            raise self.refused("a finite number", advice)
        return float(value)

    def quantity(self, unit: str) -> float:
        """A finite number [unit], or a text that states one with its unit, such as ``20um``."""
        if not isinstance(self.value, str):
            return self.number()
        try:
            value = quantity(self.value, unit)
        except ValueError as error:
            raise self.error(brief(self.value), re.sub("^expected |, got .*", "", str(error))) from None
        return Node(self.path, self.where, value).number()

    def numbers(self, length: int | None = None) -> FloatArray:
        """(length,) a list of finite numbers; at least one if ``length`` is ``None``."""
        value = self.value
        if not isinstance(value, list) or not value or (length is not None and len(value) != length):
            raise self.refused(f"a list of {length or 'one or more'} numbers")
        return np.array([item.number() for item in self.items()])

    def directions(self) -> FloatArray:
        """(K, 3) one direction, or a list of them."""
        several = isinstance(self.value, list) and self.value and isinstance(self.value[0], list)
        return np.array([item.numbers(3) for item in (self.items() if several else [self])])

    def angles(self, key: str, length: int) -> FloatArray:
        """(length,) angles [rad], from ``key`` [rad] or ``key_deg`` [degrees]; a single one may be bare."""
        degrees = f"{key}_deg"
        if (key in self) == (degrees in self):
            got = "both" if key in self else "neither"
            raise self._below(key).error(got, f"either {key} [rad] or {degrees} [degrees]")
        given = self[key if key in self else degrees]
        bare = length == 1 and not isinstance(given.value, list)
        angles = np.array([given.number()]) if bare else given.numbers(length)
        return angles if key in self else np.radians(angles)

    def truth(self) -> bool:
        """True or false."""
        if not isinstance(self.value, bool):
            raise self.refused("true or false")
        return self.value

    def text(self) -> str:
        """Text that is not empty."""
        if not isinstance(self.value, str) or not self.value:
            raise self.refused("text")
        return self.value

    def name(self) -> str:
        """A name; a whole number is taken as it is written."""
        if isinstance(self.value, bool) or not isinstance(self.value, (str, int)):
            raise self.refused("a name")
        return str(self.value)

    def choice(self, valid: Collection[str]) -> str:
        """One of a few texts."""
        if not isinstance(self.value, str) or self.value not in valid:
            raise self.refused(f"one of: {', '.join(valid)}")
        return self.value

    def names(self, known: Collection[str]) -> tuple[str, ...]:
        """A list of different names, all of them known."""
        if not isinstance(self.value, list):
            raise self.refused("a list of parameter names")
        for name in self.value:
            if not isinstance(name, str) or name not in known:
                raise self.error(brief(name), f"only: {', '.join(sorted(known))}")
            if self.value.count(name) > 1:
                raise self.error(f"{name!r} twice", "each name once")
        return tuple(self.value)

    # ── what ``write_document`` wrote ────────────────────────────────────────────────────────────────

    def array(self, shape: Sequence[int | None], *, finite: bool = True) -> FloatArray:
        """Numbers of a shape in which ``None`` is any length; null is NaN, if they need not be finite."""
        array: FloatArray = Node(self.path, self.where, _null_as_nan(self.value)).of_kind("FloatArray")
        fits = array.ndim == len(shape) and all(w in (None, n) for w, n in zip(shape, array.shape, strict=True))
        if not fits:
            wanted = " × ".join("any" if n is None else str(n) for n in shape)
            raise self.error(f"shape {array.shape}", f"numbers, {wanted}")
        if finite and not np.isfinite(array).all():
            raise self.error("a number that is not finite", "finite numbers only")
        return frozen(array)

    def of_kind(self, kind: str) -> Any:
        """The value of a dataclass field that is annotated with ``kind``, a key of ``KINDS``."""
        read, expected = KINDS[kind]
        try:
            return read(self.value)
        except (TypeError, ValueError, OverflowError):
            raise self.refused(expected) from None


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, libyaml's where it is there (twenty times faster), with the numbers of YAML 1.2."""


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """The safe dumper that puts texts into quotes which ``_Loader`` would take for numbers."""


def _loaded(text: str) -> Any:
    """What a text holds; before anything is built of it, it is known to have no aliases and no endless nesting.

    Raises:
        yaml.YAMLError, ValueError, RecursionError: It cannot be read.
    """
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.AliasEvent):
            raise yaml.YAMLError("an alias (*name), which is not allowed here")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise yaml.YAMLError(f"lists in lists, more than {DEEPEST} deep")
    return yaml.load(text, Loader=_Loader)  # a SafeLoader


for _class in (_Loader, _Dumper):
    _class.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)[eE][-+]?[0-9]+$"),
        list("-+.0123456789"),
    )

LARGEST = np.finfo(float).max


def _says_a_number(value: object) -> bool:
    try:
        return isinstance(value, str) and bool(np.isfinite(float(value)))
    except ValueError:
        return False


def _null_as_nan(value: Any) -> Any:
    if isinstance(value, list):
        return [_null_as_nan(v) for v in value]
    return np.nan if value is None else value


def _exactly(*kinds: type) -> Callable[[Any], Any]:
    def read(value: Any) -> Any:
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            raise TypeError
        return kinds[0](value)

    return read


def _names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise TypeError
    return tuple(value)


def _numbers(kinds: str, dtype: type) -> Callable[[Any], FloatArray | IntArray]:
    def read(value: Any) -> Any:
        array = np.asarray(value)
        if array.size and array.dtype.kind not in kinds:
            raise TypeError
        return array.astype(dtype)

    return read


KINDS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "str": (_exactly(str), "text"),
    "int": (_exactly(int), "a whole number"),
    "float": (_exactly(float, int), "a number"),
    "tuple[str, ...]": (_names, "a list of names"),
    "FloatArray": (_numbers("iuf", np.float64), "a list of numbers, or of rows of numbers of one length"),
    "IntArray": (_numbers("iu", np.int64), "a list of whole numbers"),
}
"""Annotation of a field → how its value is read, and what is expected."""
