# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Runs the command lines of ``cases``, reads what they leave, and says where two answers differ."""

from __future__ import annotations

import csv
import functools
import importlib
import json
import math
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

import yaml
from cases import CONFIG, DERIVED, MADE, REAL, ROOT, TEXTS, Case

EXPECTED = Path(__file__).resolve().parent / "expected"

ZEROS = {
    "position_error": "what Newton's iteration leaves",
    "rotation_error": "the same",
    "deviation": "of a parameter that these data cannot see, or that is zero by symmetry",
    "value": "the same",
    "shifts": "of joints that do not err",
    "sines": "the same",
    "cosines": "the same",
    **dict.fromkeys(
        ("x", "y", "z", "roll", "pitch", "yaw", "rx", "ry", "rz"), "a pose's part that is nominally zero"
    ),
}
"""Keys of quantities [m | rad] that can be zero but for rounding, and why."""

LEFT_OUT = {
    "seconds": "the time that the run took, except in a timetable, where it is a result",
    "written": "the date",
    "versions": "of the libraries",
}
"""Keys that are not stored, and why."""
TIMETABLE = "seconds_standing"
"""Where this key stands beside ``seconds``, both are results."""

WORDS = {
    "message": "what happened and what to do",
    "advice": "what to do",
    "note": "what was decided",
    "reason": "why a point was rejected",
    "text": "a reason of the verdict",
    "why": "a test pose of the reproduction was chosen",
    "speeds_from": "what a timetable rests on",
    "sha256": "of an input file: another last digit of a simulated measurement is another hash",
    "id": "of a plan sheet: a hash of all its numbers",
    "hash": "of a kinematics file: the same",
    **dict.fromkeys(
        ("covariance", "configurations", "points", "std", "payload"),
        "in an estimate file, numbers in base64: another last digit is another text",
    ),
    "description": "of a node's parameter",
    "additional_constraints": "of a node's parameter, in words; its choices stand beside it",
}
"""Keys of texts for people, and of hashes: they have to be there where they were, what they say may change."""

PIECES = ("combination", "unidentifiable", "resolved_by_prior", "nearly_dependent")
"""Keys of combinations of parameters, such as ``1·j1.x - 0.35·base.y``: the names are compared as text, the
coefficients as numbers of three digits, of which the last may be rounded the other way."""

PROMISES = {
    "lower_bound": 1e-3,
    "value_bound": 1e-3,
    "lower bound": 1e-3,
    "predicted_accuracy": 0.25,
    "predicted_accuracy_per_test_pose": 0.25,
    "value": 0.25,
    "efficiency": 0.25,
    "proposed": 0.25,
}
"""What a search promises, and how far apart two machines may be (relative). With other kernels of linear
algebra a descent ends some 1e-8 beside the old point, or a start falls into another minimum: that changed a
promise by up to 10 %, configurations at will and a bound by 4e-6 (OpenBLAS for Haswell against SkylakeX)."""

LONG = 150
"""A list with more numbers than this is stored as its shape and sums of its numbers."""


# ── running ──────────────────────────────────────────────────────────────────────────────────────────


def entry_points() -> dict[str, str]:
    """Name of each executable → ``module:function``, as setup.py declares them."""
    found = re.findall(r'"([\w-]+) = ([\w.]+:\w+)"', (ROOT / "setup.py").read_text())
    assert found, "setup.py declares no console_scripts"
    return dict(found)


def load(target: str) -> Callable[..., Any]:
    """The function of ``module:function``."""
    module, name = target.split(":")
    function: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return function


def call(words: Sequence[str], folder: Path) -> tuple[int, str, str]:
    """Run ``calib-planner`` in this process, in ``folder``: exit status, standard output and error."""
    main, out, err = load(entry_points()["calib-planner"]), StringIO(), StringIO()
    plain = {"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"}
    with (
        _inside(folder),
        patch.object(sys, "argv", ["calib-planner", *words]),
        patch.dict("os.environ", plain),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        status = main(list(words))
    return status, out.getvalue(), err.getvalue()


class Inputs:
    """The files that cases read; each is made once, in ``folder``."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def give(self, words: Sequence[str], folder: Path) -> None:
        """Put every file that ``words`` name into ``folder``."""
        (folder / "config").symlink_to(CONFIG)
        if REAL.is_dir():
            (folder / "real").symlink_to(REAL)
        for word in words:
            if word in {*TEXTS, *MADE, *DERIVED}:
                (folder / word).write_text(self.text(word))

    def text(self, name: str) -> str:
        """The content of one file."""
        path = self._folder / name
        if name.startswith("real/"):
            return (REAL / name.removeprefix("real/")).read_text()
        if not path.exists():
            path.write_text(self._make(name))
        return path.read_text()

    def _make(self, name: str) -> str:
        if name in TEXTS:
            return TEXTS[name]
        if name in DERIVED:
            source, change = DERIVED[name]
            return change(self.text(source))
        folder = self._folder / f"for_{name}"
        folder.mkdir()
        words = shlex.split(MADE[name])
        self.give(words, folder)
        status, _, err = call([*words, "--output", name], folder)
        assert status == 0, f"{MADE[name]}: {err}"
        return (folder / name).read_text()


def answer(case: Case, inputs: Inputs, folder: Path) -> dict[str, Any]:
    """What the case gives: exit status, the answer, and the content of the files it leaves."""
    inputs.give(case.words, folder)
    before = {p.name for p in folder.iterdir()}
    status, out, err = call(case.words, folder)
    found: dict[str, Any] = {"line": case.line, "status": status}
    if status:
        found |= {"output": out if case.tables else json.loads(out), "message": err.strip()}
    elif "--help" in case.words:
        found["options"] = dict.fromkeys(options(out), True)
    elif case.tables:
        found["numbers"] = decimals(out)
    else:
        found["answer"] = json.loads(out)
    left = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    left = [name for name in left if name.split("/")[0] not in before]
    found["files"] = left
    found["contents"] = {name: content(folder / name) for name in case.writes}
    return found


@contextmanager
def _inside(folder: Path) -> Iterator[None]:
    """The working folder for a while; ``contextlib.chdir`` is newer than Python 3.10."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


# ── reading ──────────────────────────────────────────────────────────────────────────────────────────


LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""Python takes seconds for a large file."""


def content(path: Path) -> Any:
    """What a file says, by the ending of its name."""
    if path.suffix in (".yaml", ".yml"):
        return yaml.load(path.read_text(), LOADER)
    if path.suffix == ".json":
        return json.loads(path.read_text())
    if path.suffix == ".csv":
        return table(path)
    if path.suffix == ".html":
        return page(path.read_text())
    if path.suffix == ".urdf":
        return pieces(path.read_text())
    return {"is": "a picture", "empty": not path.stat().st_size}


def table(path: Path) -> list[list[Any]]:
    """A CSV: header, then rows with numbers where cells are numbers."""
    with path.open(newline="") as file:
        return [[number(cell) for cell in row] for row in csv.reader(file)]


def number(text: str) -> Any:
    """The number a text is, else the text."""
    try:
        return int(text)
    except ValueError:
        try:
            return float(text)
        except ValueError:
            return text


NUMBER = re.compile(r"(?<![\w.])[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*\w)", re.IGNORECASE)


def numbers(text: str) -> list[Any]:
    """The numbers in a text for people, in order; what words stand between them may change."""
    return [number(found.replace("−", "-")) for found in NUMBER.findall(text)]


def decimals(text: str) -> list[Any]:
    """The numbers with a decimal point but for times that the run took; whole numbers also stand in sentences."""
    return [n for n in numbers(re.sub(r"[\d.]+ s\b", "", text)) if isinstance(n, float)]


def pieces(text: str) -> list[Any]:
    """A text in which numbers are compared as numbers and everything between them literally."""
    split = re.split(r"(?<![\w.])([-+]?\d+\.\d+(?:e[-+]?\d+)?)(?![\w.])", text)
    return [number(piece) if k % 2 else piece for k, piece in enumerate(split)]


def options(text: str) -> list[str]:
    """The options and choices that a help text's usage line names, sorted: a set, its order is for people."""
    usage = " ".join(text.split("\n\n")[0].split())
    return sorted(set(re.findall(r"(?<![\w-])--?[a-z][\w-]*(?: \{[^}]*\})?", usage)))


class _Page(HTMLParser):
    """The data that a page holds, the identifiers of its elements and the text of its tables' cells."""

    def __init__(self) -> None:
        super().__init__()
        self.data: dict[str, Any] = {}
        self.ids: list[str] = []
        self.cells: list[str] = []
        self._in: tuple[str, str] = ("", "")

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {k: v or "" for k, v in attrs}
        if "id" in given:
            self.ids.append(given["id"])
        self._in = (tag, given.get("id", "") if given.get("type") == "application/json" else "")

    def handle_endtag(self, tag: str) -> None:
        self._in = ("", "")

    def handle_data(self, data: str) -> None:
        tag, name = self._in
        if tag == "script" and name:
            self.data[name] = json.loads(data)
        elif tag in ("td", "th"):
            self.cells.append(data)


def page(text: str) -> dict[str, Any]:
    """What an HTML page says: data, identifiers, and the numbers in its tables where it holds no data."""
    found = _Page()
    found.feed(text)
    seen: dict[str, Any] = {"data": found.data, "ids": sorted(found.ids)}
    return seen if found.data else seen | {"numbers": numbers("\n".join(found.cells))}


# ── comparing ────────────────────────────────────────────────────────────────────────────────────────


def kept(value: Any) -> Any:
    """``value`` as it is stored: without ``LEFT_OUT``, infinite numbers as text."""
    if isinstance(value, dict):
        gone = set(LEFT_OUT) - ({"seconds"} if TIMETABLE in value else set())
        return {str(k): kept(v) for k, v in value.items() if k not in gone}
    if isinstance(value, (list, tuple)):
        items = [kept(v) for v in value]
        return summary(items) if len(_flat(items)) > LONG else items
    if isinstance(value, float) and not math.isfinite(value):
        return f"the number {value}"
    return value


def summary(items: list[Any]) -> dict[str, Any]:
    """Shape and sums of nested lists of numbers, or ``items`` with each long list in it as such.

    The sums are of the positive and of the negative numbers, each times a weight between 1 and 2 that depends on
    its place; so nothing cancels, and another order gives another sum.
    """
    shape, level = [len(items)], items
    while level and all(isinstance(v, list) and len(v) == len(level[0]) for v in level):
        shape.append(len(level[0]))
        level = [v for row in level for v in row]
    if not all(v is None or (isinstance(v, (int, float)) and not isinstance(v, bool)) for v in level):
        return items  # type: ignore[return-value]
    weighted = [(v, 1 + k * 0.6180339887498949 % 1) for k, v in enumerate(level) if v is not None]
    return {
        "shape": shape,
        "nulls": sum(v is None for v in level),
        "positive": math.fsum(v * w for v, w in weighted if v > 0),
        "negative": math.fsum(v * w for v, w in weighted if v < 0),
        "first": level[:6],
        "last": level[-6:],
    }


def _flat(items: Any) -> list[Any]:
    """What nested lists hold that is no list."""
    return [v for item in items for v in _flat(item)] if isinstance(items, list) else [items]


@dataclass(frozen=True)
class Tolerance:
    """How far two numbers may be apart: whatever of these is largest.

    Attributes:
        relative: In units of the number.
        of_list: In units of the largest number of the same nested list. Covariances, rotations and residuals hold
            entries that are zero but for rounding; those have no digits that could be compared.
        zero: For ``ZEROS`` [m | rad].
        by_key: If given, only numbers under these keys are compared, each with a relative tolerance of its own;
            of the others it only counts how many there are.
    """

    relative: float
    of_list: float
    zero: float
    by_key: Mapping[str, float] | None = None


EXACT = Tolerance(1e-12, 1e-14, 1e-14)
"""Where the arithmetic is that of the machine that wrote what is expected: another order of summation."""
COARSE = Tolerance(1e-3, 1e-6, 1e-9)
"""Elsewhere; measured as for ``PROMISES``: up to 4e-6."""
SEARCHED = Tolerance(0.0, 0.0, 0.0, PROMISES)
"""Elsewhere, where the answer follows from a search for plans."""


def arithmetic() -> dict[str, str]:
    """Versions, and a hash of the last digits of some linear algebra and functions: equal where those are."""
    import hashlib
    import random

    import numpy as np
    import scipy

    draw, found = random.Random(1), hashlib.sha256()
    for size in (3, 6, 9, 17, 40):
        a = np.array([[draw.uniform(-1, 1) for _ in range(size)] for _ in range(2 * size)])
        m = a.T @ a + np.eye(size)
        parts = [m, a @ a.T, a @ a[0], np.linalg.inv(m), np.linalg.cholesky(m), scipy.linalg.solve(m, a.T)]
        parts += [
            *np.linalg.qr(a),
            np.linalg.svd(a, compute_uv=False),
            np.linalg.eigvalsh(m),
            np.einsum("ij,ij->j", a, a),
        ]
        parts += [
            np.sin(3 * a),
            np.cos(3 * a),
            np.exp(a),
            np.arctan2(a, a[::-1]),
            np.sqrt(np.abs(a)),
            a.sum(axis=1),
        ]
        for part in parts:
            found.update(np.ascontiguousarray(part).tobytes())
    return {"numpy": np.__version__, "scipy": scipy.__version__, "digits": found.hexdigest()[:16]}


@functools.cache
def same_arithmetic() -> bool:
    """Whether this machine computes with the same last digits as the one that wrote what is expected."""
    return bool(arithmetic() == stored("arithmetic"))


def changes(case: Case, found: Any) -> list[str]:
    """Where what a case gave is not what is expected, as exactly as this machine can tell."""
    old, new = stored(case.name), kept(found)
    exact = list(differences(old, new))
    if not exact or same_arithmetic():
        return exact
    return list(differences(old, new, SEARCHED if case.searched else COARSE))


def differences(old: Any, new: Any, tolerance: Tolerance = EXACT) -> Iterator[str]:
    """Where ``new`` is not ``old``: path, both values."""
    yield from _differ(old, new, tolerance, "", "", 0.0)


def _differ(old: Any, new: Any, tolerance: Tolerance, path: str, key: str, scale: float) -> Iterator[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        for name in sorted({*old, *new}):
            if name not in new:
                yield f"{path}/{name}: gone, was {_shown(old[name])}"
            elif name not in old:
                yield f"{path}/{name}: new, {_shown(new[name])}"
            else:
                yield from _differ(old[name], new[name], tolerance, f"{path}/{name}", name, 0.0)
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield f"{path}: {len(old)} items before, {len(new)} now"
            return
        scale = max(scale, _largest(old), _largest(new))
        for k, (a, b) in enumerate(zip(old, new, strict=True)):
            yield from _differ(a, b, tolerance, f"{path}/{k}", key, scale)
    elif not _same(old, new, tolerance, key, scale):
        yield f"{path}: {_shown(old)} before, {_shown(new)} now"


def _same(old: Any, new: Any, tolerance: Tolerance, key: str, scale: float) -> bool:
    whole = isinstance(old, int) and isinstance(new, int)
    if _is_number(old) and _is_number(new) and not (tolerance is EXACT and whole):
        return type(old) is type(new) and _near(old, new, tolerance, key, scale)
    if isinstance(old, str) and isinstance(new, str):
        if key in WORDS:
            return bool(old.strip()) == bool(new.strip())
        if key in PIECES:
            return tolerance is not EXACT or not list(differences(pieces(old), pieces(new), ROUNDED))
    return type(old) is type(new) and bool(old == new)


ROUNDED = Tolerance(1e-2, 2e-3, 0.0)
"""For the coefficients of ``PIECES``."""


def _near(old: float, new: float, tolerance: Tolerance, key: str, scale: float) -> bool:
    relative = tolerance.relative
    if tolerance.by_key is not None:
        if key not in tolerance.by_key:
            return True
        relative = tolerance.by_key[key]
    zero = tolerance.zero if key in ZEROS else 0.0
    return abs(old - new) <= max(relative * max(abs(old), abs(new)), tolerance.of_list * scale, zero)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _largest(items: list[Any]) -> float:
    """Largest magnitude among the numbers of nested lists; 0 without any."""
    sizes = [_largest(i) if isinstance(i, list) else abs(i) for i in items if isinstance(i, (list, float))]
    return max(sizes, default=0.0)


def _shown(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 120 else f"{text[:100]} … ({len(text)} characters)"


def stored(name: str) -> Any:
    """An expected file's content."""
    return json.loads((EXPECTED / f"{name}.json").read_text())


def store(name: str, value: Any) -> None:
    """Write an expected file; short lists stay on one line."""
    EXPECTED.mkdir(exist_ok=True)
    text = json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False)
    text = re.sub(r"\[\s+([^\[\]{}]*?)\s+\]", lambda m: "[" + re.sub(r"\s*\n\s*", " ", m[1]) + "]", text)
    (EXPECTED / f"{name}.json").write_text(text + "\n")
