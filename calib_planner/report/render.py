# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The one template engine of all pages, and drawings as data for it.

A page is a template and values. A drawing is a list of shapes, which the macro ``svg`` of ``macros.html`` writes.
The engine escapes every text: names of robots, joints and files may hold anything. No other file writes markup.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

TEMPLATES = Path(__file__).parent / "templates"


class Shape(NamedTuple):
    """An element of a drawing: tag, attributes in drawing units (y downwards), and the words of a text."""

    tag: str
    attributes: dict[str, str]
    words: str = ""


class Drawing(NamedTuple):
    """An ``<svg>``: shapes within ``size``, "width height" in drawing units.

    Its colours come from the page's style sheet, by the classes of ``kind`` and of the shapes; ``title`` is for
    readers who cannot see it.
    """

    kind: str
    size: str
    title: str
    shapes: list[Shape]
    style: str = ""


def shape(tag: str, words: str = "", **attributes: str) -> Shape:
    """A shape; ``class_`` stands for the attribute ``class``, ``text_anchor`` for ``text-anchor``."""
    return Shape(tag, {name.rstrip("_").replace("_", "-"): value for name, value in attributes.items()}, words)


def render(template: Path, **values: Any) -> str:
    """The page of a template, which may import ``macros.html`` and include other files of ``templates/``."""
    return _environment(template.parent).get_template(template.name).render(values)


def svg(drawing: Drawing) -> str:
    """The drawing alone."""
    macros: Any = _environment(TEMPLATES).get_template("macros.html").module
    return str(macros.svg(drawing))


def embedded(name: str) -> Markup:
    """A style sheet or script of ``templates/``, to be put into a page as it is."""
    return Markup((TEMPLATES / name).read_text(encoding="utf-8"))


def _environment(folder: Path) -> Environment:
    return Environment(
        loader=FileSystemLoader([folder, TEMPLATES]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
