# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The text of a URDF, expanded by xacro where it has to be.

xacro is the macro language in which most descriptions of robots are written. The Python package of that name
(PyPI, extra ``xacro``, or ROS) expands it. Arguments of the file follow its name, as on xacro's own command line:

    ur.urdf.xacro ur_type:=ur10e name:=ur

``$(find PACKAGE)`` means a package of ROS. Where ROS does not know the package, it is looked for as a folder with
a ``package.xml`` around the file: beside it, beside the folders above it, and one level below those; there also
within other folders, as repositories of one workspace have it, if it has the package's name.

A file with leftovers of xacro beside its chain is a URDF like any other and is read as it stands. Expanding runs
the expressions of the file. xacro allows them no built-in functions of Python, but a file from a stranger is best
expanded elsewhere.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from calib_planner.errors import FileFormatError
from calib_planner.io.text import read_text, user_path
from calib_planner.io.urdf_tree import EXPRESSION, chain_of, has_macros, root_of

SUFFIX = ".xacro"
WITH_ARGUMENTS = re.compile(r"(?P<path>.*\.xacro)(?P<arguments>(?:\s+\w+:=\S*)+)\s*", re.DOTALL | re.IGNORECASE)
ADVICE = "pip install 'calib_planner[xacro]', or expand it first: xacro FILE.urdf.xacro > robot.urdf"
LEVELS = 4
"""Folders above a file around which packages are looked for."""


def split_arguments(source: str | Path) -> tuple[Path, dict[str, str]]:
    """A robot's file, and the arguments that follow its name, ``name:=value``."""
    split = WITH_ARGUMENTS.fullmatch(str(source))
    if split is None:
        return user_path(source), {}
    return user_path(split["path"]), dict(word.split(":=", 1) for word in split["arguments"].split())


def read_urdf_text(source: str | Path) -> str:
    """The text of a URDF; of a xacro file, and of a URDF whose chain is sound only with its macros, expanded.

    Raises:
        FileFormatError: Not readable, no XML, or xacro is not installed or finds a fault.
    """
    path, arguments = split_arguments(source)
    text = read_text(path, "readable URDF text")
    if "xacro:" not in text and EXPRESSION.search(text) is None:
        return text
    root = root_of(text, str(path))
    if path.suffix.lower() == SUFFIX:
        return expanded(path, arguments) if any(map(_is_macro, root.iter())) else text
    if _stands_alone(root, str(path)):
        return text
    try:
        return expanded(path, arguments)
    except FileFormatError:  # a URDF by its name: what is wrong with it as it stands is said then
        return text


def _stands_alone(root: ElementTree.Element, source: str) -> bool:
    """Whether the chain of a URDF, to whichever tip, needs no macro."""
    if not has_macros(root):
        return True
    try:
        chain_of(root, source)
    except FileFormatError as error:
        return "possible tips" in error.got and not error.got.startswith("0")
    return not any(str(item.tag) == "xacro:include" for item in root)


def expanded(path: Path, arguments: dict[str, str]) -> str:
    """The URDF that xacro makes of a file.

    Raises:
        FileFormatError: xacro is not installed, or finds a fault.
    """
    try:
        import xacro
        from xacro import substitution_args
    except ImportError:
        raise FileFormatError(path, "document", "a xacro file", "plain URDF", ADVICE) from None
    known, words = substitution_args._eval_find, getattr(substitution_args, "_eval_dict", {})

    def find(package: str) -> str:
        """What ``$(find PACKAGE)`` stands for; xacro itself asks ROS alone."""
        try:
            return str(known(package))
        except Exception:  # ROS is not there (ImportError), or has no such package (its own KeyError)
            folder = next((f for f in _around(path, package) if _package(f) == package), None)
            if folder is None:
                where, advice = f"$(find {package})", "put the folder of this package beside that of the file"
                raise FileFormatError(path, where, "no such package", "a package", advice) from None
            return str(folder)

    substitution_args._eval_find = words["find"] = find
    try:
        document = xacro.process_file(str(path), mappings=dict(arguments))
        return str(document.toxml())
    except FileFormatError:
        raise
    except Exception as error:  # xacro lets through whatever the file's own expressions raise
        inner = getattr(error, "exc", None)
        if isinstance(inner, FileFormatError):  # of ``find``, in an included file
            raise inner from None
        reason = " ".join(str(error).split()) or type(error).__name__
        advice = f"arguments follow the file's name: '{path.name} name:=value'" if "arg" in reason else ""
        raise FileFormatError(path, "xacro", reason[:300], "a file that xacro can expand", advice) from None
    finally:
        substitution_args._eval_find = words["find"] = known


def _is_macro(item: ElementTree.Element) -> bool:
    return str(item.tag).startswith("xacro:") or any(EXPRESSION.search(v) for v in item.attrib.values())


def _around(path: Path, package: str) -> Iterator[Path]:
    """Folders around a file that may be packages, the nearest first."""
    for above in list(path.resolve().parents)[:LEVELS]:
        yield above
        try:
            inside = sorted(folder for folder in above.iterdir() if folder.is_dir())
        except OSError:
            continue
        yield from inside
        yield from (folder / package for folder in inside)


def _package(folder: Path) -> str:
    """The name of the package in a folder; empty if there is none."""
    try:
        name: Any = ElementTree.parse(folder / "package.xml").getroot().findtext("name")
    except (OSError, ElementTree.ParseError):
        return ""
    return str(name or "").strip()
