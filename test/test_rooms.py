# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The house: which room may use which, doors between them, no cycles, ROS in one room, one word for one thing.

docs/architecture.md describes the rooms and their direction, docs/glossary.md the words. Imports inside functions
and under ``TYPE_CHECKING`` count like any other, and so do texts that are names of modules (``import_module``).
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

import calib_planner

PACKAGE = Path(calib_planner.__file__).resolve().parent
ROOT = Path(__file__).resolve().parents[1]
PAPER = ROOT / "paper" / "calib_planner_paper"

# ── the rooms ────────────────────────────────────────────────────────────────────────────────────────

GROUND = ("doors", "errors", "arrays", "units", "measurements")
"""Single files that every room may use; each uses only those before it."""
ROOMS: dict[str, str] = {
    "robot": "",
    "tracker": "robot",
    "error_model": "robot tracker",
    "acquisition": "robot tracker",
    "planning": "robot tracker error_model",
    "identification": "robot tracker error_model",
    "compensation": "robot error_model identification",
    "campaign": "robot tracker error_model acquisition planning identification",
    "simulation": "robot tracker error_model acquisition planning identification campaign",
    "io": "robot tracker error_model acquisition planning identification compensation campaign",
    "report": "robot tracker error_model planning identification io",
    "demo": "robot tracker error_model planning identification simulation io report",
    "cli": "robot tracker error_model acquisition planning identification compensation campaign simulation io "
    "report demo",
    "ros": "robot tracker error_model acquisition planning identification campaign simulation io report demo",
}
"""Room → the rooms that it may use besides ``GROUND``, in the order of the house: each only rooms above it."""
FRONT = {"": "doors errors measurements planning identification io", "__main__": "cli"}
"""The package's own door, which resolves names when they are first used, and ``python -m calib_planner``."""
PAPER_USES = "robot tracker error_model planning identification simulation io report cli"
WITHOUT_A_DOOR = ("ros",)
"""A node that starts pays only for what it needs: other programs import the files of this room one by one."""


class Import(NamedTuple):
    """A module that a file uses, the name that it takes from there (may be empty), and the line."""

    module: str
    name: str
    line: int


class Contents(NamedTuple):
    """What the tests ask of a file; the tree itself, of many thousand objects, is not kept."""

    imports: tuple[Import, ...]  # wherever they stand, and texts that name a module of ours
    offered: frozenset[str]  # names that another file can import from it
    names: tuple[str, ...]  # given to functions, classes, arguments, variables and attributes
    texts: tuple[str, ...]  # with a blank in them: what people read


def module_of(path: Path) -> str:
    """The dotted name of a file of the package or of the paper."""
    base = PAPER if path.is_relative_to(PAPER) else PACKAGE
    return ".".join((base.name, *path.relative_to(base).with_suffix("").parts)).removesuffix(".__init__")


FILES = {module_of(p): p for p in sorted(PACKAGE.rglob("*.py"))}
PAPER_FILES = {module_of(p): p for p in sorted(PAPER.rglob("*.py"))}
EVERY = FILES | PAPER_FILES
PLACES = [*GROUND, *ROOMS, *FRONT, "paper"]


def contents(text: str) -> Contents:
    """Of a Python text."""
    tree = ast.parse(text)
    used, offered, names, texts = list[Import](), set[str](), list[str](), list[str]()
    for node in ast.walk(tree):
        match node:
            case ast.Import():
                used += [Import(alias.name, "", node.lineno) for alias in node.names]
                offered |= {alias.asname or alias.name for alias in node.names}
            case ast.ImportFrom():
                assert not node.level, "imports are absolute"
                used += [Import(node.module or "", alias.name, node.lineno) for alias in node.names]
                offered |= {alias.asname or alias.name for alias in node.names}
            case ast.Constant(value=str(value)):
                if "." in value and value in EVERY:
                    used.append(Import(value, "", node.lineno))
                if " " in value:
                    texts.append(value)
            case ast.FunctionDef() | ast.ClassDef():
                names.append(node.name)
            case ast.arg():
                names.append(node.arg)
            case ast.Name(ctx=ast.Store()):
                names.append(node.id)
            case ast.Attribute(ctx=ast.Store()):
                names.append(node.attr)
            case ast.ExceptHandler(name=str(name)):
                names.append(name)
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            offered.add(node.name)
        for target in getattr(node, "targets", [getattr(node, "target", None)]):
            offered |= {target.id} if isinstance(target, ast.Name) else set()
    return Contents(tuple(used), frozenset(offered), tuple(names), tuple(texts))


@cache
def contents_of(module: str) -> Contents:
    return contents(EVERY[module].read_text(encoding="utf-8"))


def room_of(module: str) -> str:
    """``calib_planner.robot.chain`` → ``robot``; the package itself → the empty text."""
    return (*module.split("."), "")[1]


def place_of(module: str) -> str:
    return "paper" if module in PAPER_FILES else room_of(module)


def files_of(place: str) -> list[str]:
    return [m for m in EVERY if place_of(m) == place]


def target_of(used: Import) -> str:
    """The file that an import means: ``from room import file`` is the file unless the door has that name."""
    below = f"{used.module}.{used.name}"
    is_file = below in EVERY and used.module in EVERY and used.name not in contents_of(used.module).offered
    return below if is_file else used.module


def ours(file: Contents) -> list[tuple[str, Import]]:
    """(file, import) of what is imported from the package."""
    pairs = [(target_of(i), i) for i in file.imports]
    return [(t, i) for t, i in pairs if t.split(".")[0] == "calib_planner"]


def test_every_file_belongs_to_a_room_and_every_room_is_there() -> None:
    known = {*GROUND, *ROOMS, *FRONT}
    assert {room_of(m) for m in FILES} == known
    assert len(FILES) > 90 and len(PAPER_FILES) > 5


def test_each_room_uses_only_rooms_above_it() -> None:
    order = list(ROOMS)
    for room, uses in ROOMS.items():
        assert set(uses.split()) <= set(order[: order.index(room)]), room


def allowed_in(place: str) -> set[str]:
    """The rooms that a room may use, itself among them."""
    if place == "paper":
        return {*GROUND, *PAPER_USES.split()}
    if place in GROUND:
        return {*GROUND[: GROUND.index(place) + 1]}
    return {*FRONT[place].split()} if place in FRONT else {place, *GROUND, *ROOMS[place].split()}


@pytest.mark.parametrize("place", PLACES)
def test_direction_of_imports(place: str) -> None:
    wrong = [
        (module, i)
        for module in files_of(place)
        for t, i in ours(contents_of(module))
        if room_of(t) not in allowed_in(place) and (t, i.name) != ("calib_planner", "__version__")
    ]
    assert not wrong


def other_room(module: str, target: str) -> bool:
    return module not in FILES or room_of(module) != room_of(target)


def not_by_the_door(module: str, file: Contents) -> list[Import]:
    """Imports from another room that reach past its door."""
    found = [i for t, i in ours(file) if other_room(module, t) and t.count(".") > 1]
    return [i for i in found if not (room_of(i.module) in WITHOUT_A_DOOR and module not in FILES)]


@pytest.mark.parametrize("place", PLACES)
def test_rooms_are_entered_by_their_doors(place: str) -> None:
    assert not [(m, i) for m in files_of(place) for i in not_by_the_door(m, contents_of(m))]


def test_the_paper_is_used_by_its_command_only() -> None:
    used = {(m, i.module) for m in FILES for i in contents_of(m).imports if "_paper" in i.module}
    assert used == {("calib_planner.cli.main", "calib_planner_paper.reproduce")}


def examples_and_benches() -> Iterator[tuple[str, str]]:
    """(where, Python text) of the benches, of the tools and of every example of README and docs."""
    for path in sorted([*(ROOT / "bench").glob("*.py"), *(ROOT / "tools").rglob("*.py")]):
        yield path.name, path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        for number, text in enumerate(re.findall(r"^```python\n(.*?)^```$", path.read_text(), re.DOTALL | re.M)):
            yield f"{path.name}-{number}", text


@pytest.mark.parametrize(("where", "text"), [pytest.param(*p, id=p[0]) for p in examples_and_benches()])
def test_users_import_from_doors_only(where: str, text: str) -> None:
    assert not not_by_the_door("", contents(text)), where


def test_the_python_page_shows_what_doors_offer() -> None:
    page = (ROOT / "docs" / "reference" / "python.md").read_text(encoding="utf-8")
    shown = re.findall(r"^\.\. auto\w+:: (calib_planner\.\S+)$", page, re.MULTILINE)
    assert len(shown) > 10
    assert not [name for name in shown if name.count(".") > 2]


def test_no_cycle_of_files() -> None:
    doors = {m for m, p in EVERY.items() if p.name == "__init__.py"}
    graph = {m: {t for t, _ in ours(contents_of(m)) if t in EVERY and t != m} for m in EVERY}
    assert sum(map(len, graph.values())) > 200 and len(doors) > 10
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" → ".join(error.args[1]))


def test_the_walk_sees_what_is_hidden() -> None:
    text = """
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    from calib_planner.robot.chain import Robot
def late():
    from calib_planner.robot import chain, Robot
    import_module("calib_planner.cli.plan")
"""
    seen = [t for t, _ in ours(contents(text))]
    chain = "calib_planner.robot.chain"
    assert seen == [chain, chain, "calib_planner.robot", "calib_planner.cli.plan"]
    assert len(not_by_the_door("calib_planner.io.csv", contents(text))) == 3
    assert not not_by_the_door("calib_planner.io.csv", contents("from calib_planner.planning import plan"))


# ── ROS ──────────────────────────────────────────────────────────────────────────────────────────────

OUTSIDE = [m for m in EVERY if room_of(m) != "ros"]


def is_ros(module: str) -> bool:
    root = module.split(".")[0]
    return (
        root.startswith(("rclpy", "rcl_", "rosidl", "ament_", "launch", "tf2"))
        or root.endswith(("_msgs", "_srvs", "_interfaces", "_interfaces_py"))
        or module.startswith("calib_planner.ros")
    )


def test_no_ros_outside_the_ros_room() -> None:
    used = [(m, i) for m in OUTSIDE for i in contents_of(m).imports]
    assert not [(m, i) for m, i in used if is_ros(i.module) or is_ros(f"{i.module}.{i.name}")]


def test_the_walk_sees_modules_and_knows_ros() -> None:
    assert len(OUTSIDE) > 30
    assert is_ros("rclpy.node") and is_ros("sensor_msgs.msg") and is_ros("calib_planner_msgs.srv")
    assert is_ros("calib_planner.ros.demo") and not is_ros("calib_planner.robot") and not is_ros("rosbags")
    inside = {i.module for m in FILES if room_of(m) == "ros" for i in contents_of(m).imports}
    assert "rclpy" in inside and "calib_planner_msgs.srv" in inside


@pytest.mark.parametrize("name", ["session", "execution"])
def test_pure_parts_of_the_ros_room_are_pure(name: str) -> None:
    used = [i.module for i in contents_of(f"calib_planner.ros.{name}").imports]
    assert used and not [m for m in used if not m.startswith("calib_planner.ros") and is_ros(m)]


def test_everything_outside_imports_with_ros_blocked() -> None:
    names = [m for m in OUTSIDE if not m.endswith("__main__")]
    script = f"""
import importlib, sys
class Block:
    def find_spec(self, name, path=None, target=None):
        root = name.split(".")[0]
        if root == "rclpy" or root.endswith(("_msgs", "_srvs", "_interfaces")):
            raise ImportError(f"{{name}} is blocked")
sys.meta_path.insert(0, Block())
for name in {names!r}:
    importlib.import_module(name)
assert "rclpy" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


# ── words ────────────────────────────────────────────────────────────────────────────────────────────

OLD_NAMES = {
    **dict.fromkeys(("worth",), "value"),
    **dict.fromkeys(("slope", "slopes"), "gradient"),
    **dict.fromkeys(("relax", "relaxed", "relaxation"), "approximate design"),
    **dict.fromkeys(("pool", "pools"), "candidates"),
    **dict.fromkeys(("held",), "fixed"),
    **dict.fromkeys(("kept",), "free, or what it is"),
    **dict.fromkeys(("stop", "stops"), "visit"),
    **dict.fromkeys(("found", "asked"), "estimate, maximum, solution, problem, request, wanted …: what it is"),
}
"""Words that no function, class, argument, variable or attribute of ours is made of, and the word instead."""
OLD_TEXT = {
    r"worth": "value",
    r"slopes?": "gradient",
    r"relaxed|relaxation": "approximate design",  # limits may be relaxed, designs are approximate
    r"pools?": "candidates",
    r"asked": "problem, request, wanted",
    r"(?<!not )found": "identified, estimated, computed …",
    r"(?:a|the|each|every|this|last|first|next|another|of|\d) stops?|stops? \d": "visit",
}
"""The same for messages, help, docstrings and docs: patterns of whole words."""
ALLOWED_NAMES = {
    "held_out",  # held-out points are the usual word of statistics
    "ThreadPoolExecutor",
    "ProcessPoolExecutor",
    "Pool",
}
ALLOWED_TEXT = re.compile(r"ThreadPool|ProcessPool|threadpool|held.out|hand on the stop", re.IGNORECASE)


def old_names(file: Contents) -> list[str]:
    names = (n for n in file.names if n.strip("_") not in ALLOWED_NAMES)
    return [
        n for n in names if OLD_NAMES.keys() & set(re.findall("[a-z]+", re.sub("([A-Z])", r"_\1", n).lower()))
    ]


OLD_PATTERN = re.compile(rf"\b(?:{'|'.join(OLD_TEXT)})\b", re.IGNORECASE)


def old_words(text: str) -> list[str]:
    return [str(m) for m in OLD_PATTERN.findall(ALLOWED_TEXT.sub("", text))]


def texts_by_place() -> Iterator[tuple[str, str]]:
    """(room or folder, text) of all that people read: texts with a blank in them, pages, comments of messages."""
    for module in EVERY:
        yield from ((place_of(module), text) for text in contents_of(module).texts)
    folders = {
        "docs": "*.md",
        "msg_defs": "*.*",
        "config": "*.yaml",
        "calib_planner/report": "*.html",
        "paper": "*.*",
    }
    for folder, pattern in folders.items():
        for path in sorted((ROOT / folder).rglob(pattern)):
            if path.suffix in (".md", ".html", ".yaml", ".msg", ".srv", ".action") and path.name != "glossary.md":
                text = re.sub(r"<style>.*?</style>", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
                yield folder.rpartition("/")[2], re.sub(r"`[^`\n]*`", "", text)
    yield "docs", re.sub(r"`[^`\n]*`", "", (ROOT / "README.md").read_text(encoding="utf-8"))


WITH_WORDS = [*PLACES, "docs", "msg_defs", "config"]


@pytest.mark.parametrize("place", WITH_WORDS)
def test_no_name_is_made_of_old_words(place: str) -> None:
    left = [f"{m}: {n}" for m in files_of(place) for n in old_names(contents_of(m))]
    assert not left


@pytest.fixture(scope="module")
def words() -> dict[str, Counter[str]]:
    counted: dict[str, Counter[str]] = {}
    for place, text in texts_by_place():
        counted.setdefault(place, Counter()).update(old_words(text))
    return counted


@pytest.mark.parametrize("place", WITH_WORDS)
def test_no_text_speaks_in_old_words(place: str, words: dict[str, Counter[str]]) -> None:
    assert not words.get(place)


def test_the_words_are_seen_where_they_are() -> None:
    text = "class PoolProblem: pass\ndef worth_of(asked, held_out): self.slope = found = 1"
    assert sorted(old_names(contents(text))) == ["PoolProblem", "asked", "found", "slope", "worth_of"]
    assert old_words("The pool's slope; not found. Found: 3. Stop 2 of 5, hand on the stop. ThreadPool") == [
        "pool",
        "slope",
        "Found",
        "Stop 2",
    ]
    page = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
    assert all(word in page for word in ("worth", "slope", "relaxed", "pool", "held", "stop"))
