"""YAML documents of this package: a format name, then plain values. No objects, no aliases are read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike

from calib_planner.errors import FileFormatError
from calib_planner.files.text import read_text, write_text

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
