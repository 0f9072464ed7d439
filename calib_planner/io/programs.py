# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Robot programs that visit a plan: the text that a maker's controller loads, from a template.

A template is one file, ``config/programs/NAME.j2`` or the user's own, in the language Jinja2. It begins with a
comment that says what the controller takes, as YAML between ``{#---`` and ``---#}``:

    title: KUKA robot language   # shown to people
    suffix: .src                 # of the program's file
    joints: 6                    # number of joints that it can write; left out: any number
    name_length: 24              # characters of a program's name
    newline: crlf                # or lf, the default
    ready: 1                     # output that says "at rest"; a number or, as text, a name
    done: 1                      # input that says "measured"; likewise
    tool: 0                      # number or name of the tool; left out: the program names none
    coupling: -1                 # see below; left out: 0

What follows is the program. It may use

    name, robot, plan            names of program and robot, identity of the plan
    visits                       of each visit: number, repetitions, radians, degrees (one value per axis), aside
                                 (radians, degrees), near
    measurements                 sum of all repetitions
    handshake                    "pause": a person confirms each measurement; "io": signals do
    ready, done, tool            as above, or what the user gave in place of them
    settle                       standstill before a measurement [s]
    share, percent               speed as a share of the largest, 0 … 1, and as a whole number of percent
    joints, unchecked            names of the joints; what nobody has checked
    value|fixed(9)               a number with nine decimals
    text|clipped(24)             at most so many characters of a text

*Repetitions.* Each is a standstill of its own: before a further one the robot moves to ``aside`` and comes back,
as in the timetable (``planning.tour``); where a visit is ``near`` the one before, also before the first one.

Every text that a template gets is made of ASCII letters, digits and harmless signs alone, so that no name can end
a comment or a string. Templates run in Jinja2's sandbox.

*The axes of a controller* need not be the joints of a URDF. With sign s, zero z and coupling c,

    axis = s · joint + z,    then    axis 3 ← axis 3 + c · axis 2.

The coupling is −1 where a controller counts axis 3 from the horizontal, because the forearm keeps its inclination
while axis 2 moves (FANUC). A robot with couplings of its own (``--couple``) is planned in the controller's
coordinates; for it the template's coupling is not used. Values of sliding joints are in m under ``radians`` and
in mm under ``degrees``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import StrictUndefined, TemplateError, TemplateSyntaxError
from jinja2.sandbox import SandboxedEnvironment, SecurityError
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_array, check_number
from calib_planner.errors import FileFormatError, InputError, UnknownNameError
from calib_planner.io.plan import require_reachable
from calib_planner.io.robots import config_folder
from calib_planner.io.text import read_text, write_text
from calib_planner.io.yaml import Node, parse_yaml
from calib_planner.planning import (
    LineOfSight,
    PlanSheet,
    ReflectorAcceptance,
    TrackerElevation,
    TrackerRange,
    person_factors,
)

HANDSHAKES = ("pause", "io")
"""How the robot learns that it was measured: a person confirms it, or signals do."""
SPEED_SHARE = 0.1
"""Usual share of the largest speed: the moves between the visits were not checked."""
SETTLE = 1.0
"""Usual standstill before a measurement, for vibrations to die away [s]."""
KEYS = ("title", "suffix", "joints", "name_length", "newline", "ready", "done", "tool", "coupling")
NEWLINES = {"lf": "\n", "crlf": "\r\n"}
HEAD = re.compile(r"\{#---\n(.*?)---#\}\n?", re.DOTALL)
_VIEWS = {c.name for c in (TrackerRange, TrackerElevation, ReflectorAcceptance, LineOfSight)}
"""What a robot that moves does not run into."""
IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True)
class ProgramFormat:
    """A template and what its controller takes; the attributes are the keys of its head.

    Attributes:
        name: Of the shipped template, or the path of the user's.
        path: The file.
        body: The template behind its head.
        title: For people.
        suffix: Of the program's file, with its dot.
        joints: Number of joints that it writes; ``None`` for any.
        name_length: Characters of a program's name, at most.
        newline: End of a line.
        ready, done, tool: Usual signals and tool; ``None``: the program has none.
        coupling: See the top of this file.
    """

    name: str
    path: Path
    body: str
    title: str
    suffix: str
    joints: int | None
    name_length: int
    newline: str
    ready: str | int
    done: str | int
    tool: str | int | None
    coupling: float


@dataclass(frozen=True, eq=False)
class ProgramSettings:
    """What a user chooses; ``None`` stands for what the template says.

    Attributes:
        name: Of the program; empty: ``cal_`` and four digits of the plan's identity.
        handshake: One of ``HANDSHAKES``.
        ready, done: Output and input of the handshake by signals.
        tool: Number or name of the tool.
        speed_share: Share of the largest speed, above 0 and at most 1.
        settle: Standstill before a measurement [s].
        signs: (joints,) each 1 or −1.
        zeros: (joints,) what the controller shows where the joint is at 0 [rad | m].
        coupling: What axis 3 has of axis 2.
    """

    name: str = ""
    handshake: str = "pause"
    ready: str | None = None
    done: str | None = None
    tool: str | None = None
    speed_share: float = SPEED_SHARE
    settle: float = SETTLE
    signs: ArrayLike | None = None
    zeros: ArrayLike | None = None
    coupling: float | None = None


def program_formats() -> Sequence[str]:
    """Names of the shipped templates, sorted."""
    return sorted(p.stem for p in (config_folder() / "programs").glob("*.j2"))


def read_program_format(name: str) -> ProgramFormat:
    """A shipped template by its name, or any template by its path, which ends in ``.j2``.

    Raises:
        UnknownNameError: Neither a shipped name nor an existing file.
        FileFormatError: The head is not as the top of this file says; names the key.
    """
    shipped = name in program_formats()
    path = config_folder() / "programs" / f"{name}.j2" if shipped else Path(name).expanduser()
    if not shipped and not (path.suffix == ".j2" and path.is_file()):
        raise UnknownNameError("program format", name, [*program_formats(), "PATH.j2 (an existing file)"])
    text = read_text(path, "a template of robot programs")
    head = HEAD.match(text)
    if head is None:
        raise FileFormatError(
            path, "head", "none", "a first line {#--- and YAML up to ---#}", "copy a shipped one"
        )
    top = parse_yaml(head[1], path, "YAML in the head").mapping(
        KEYS, ("title", "suffix", "name_length", "ready", "done")
    )
    return ProgramFormat(
        name=name,
        path=path,
        body="\n" * head[0].count("\n") + text[head.end() :],  # so that errors name the file's own lines
        title=top["title"].text(),
        suffix=top["suffix"].text(),
        joints=int(top["joints"].number()) if "joints" in top else None,
        name_length=int(top["name_length"].number()),
        newline=NEWLINES[top.get("newline", "lf").choice(NEWLINES)],
        ready=_signal(top["ready"]),
        done=_signal(top["done"]),
        tool=_signal(top["tool"]) if "tool" in top else None,
        coupling=top.get("coupling", 0.0).number(),
    )


def _signal(node: Node) -> str | int:
    """A number or a name of the controller."""
    if isinstance(node.value, int) and not isinstance(node.value, bool) and node.value >= 0:
        return node.value
    if not (isinstance(node.value, str) and IDENTIFIER.fullmatch(node.value)):
        raise node.refused("a whole number, or a name of letters, digits and _")
    return node.value


def write_program(
    path: str | Path, sheet: PlanSheet, form: ProgramFormat, settings: ProgramSettings, field: str = "output"
) -> None:
    """Write ``program_text`` to a file; errors about the path name ``field``."""
    write_text(path, program_text(sheet, form, settings), field)


def program_text(sheet: PlanSheet, form: ProgramFormat, settings: ProgramSettings | None = None) -> str:
    """The program that visits a plan.

    Raises:
        InfeasibleError: A configuration is not reachable: no program goes there.
        InputError: The robot or a setting does not fit the format.
        FileFormatError: The template has a mistake; names its line.
    """
    settings = ProgramSettings() if settings is None else settings
    require_reachable(sheet, "no program goes there")
    axes = controller_axes(sheet, form, settings)
    times = sheet.timetable
    beside = controller_axes(sheet, form, settings, times.aside)
    first = np.cumsum(times.repetitions) - times.repetitions
    near = np.isfinite(times.ways_back[first]).tolist()
    visits = [
        {"number": i, "repetitions": k, "near": n} | _values(q, sheet) | {"aside": _values(a, sheet)}
        for i, (k, n, q, a) in enumerate(zip(times.repetitions.tolist(), near, axes, beside, strict=True), 1)
    ]
    share = check_number("speed_share", settings.speed_share, low=0, low_open=True, high=1.0)
    values = {
        "name": program_name(sheet, form, settings),
        "robot": harmless(sheet.robot.name),
        "plan": sheet.identity,
        "visits": visits,
        "measurements": sheet.plan.measurements,
        "handshake": _handshake(settings.handshake),
        "ready": _chosen("ready", settings.ready, form.ready),
        "done": _chosen("done", settings.done, form.done),
        "tool": _chosen("tool", settings.tool, form.tool),
        "settle": check_number("settle", settings.settle, low=0, high=3600, unit="s"),
        "share": share,
        "percent": max(1, round(100 * share)),
        "joints": [harmless(n) for n in sheet.plan.joint_names],
        "unchecked": harmless(", ".join(reversed([n for n in sheet.checks.unchecked if n not in _VIEWS]))),
    }
    return _rendered(form, values).replace("\n", form.newline)


def _values(axes: FloatArray, sheet: PlanSheet) -> dict[str, list[float]]:
    """Of one place, axes (joints,) [rad | m]: as they are, and as people type them."""
    return {"radians": axes.tolist(), "degrees": (axes * person_factors(sheet.robot)).tolist()}


def controller_axes(
    sheet: PlanSheet, form: ProgramFormat, settings: ProgramSettings, places: FloatArray | None = None
) -> FloatArray:
    """(m, joints) places in the controller's axes [rad | m], see the top of this file; ``None``: the visits.

    Raises:
        InputError: Another number of joints, or a sign, zero or coupling that cannot be.
    """
    q, count = sheet.plan.configurations if places is None else places, len(sheet.plan.joint_names)
    if form.joints not in (None, count):
        raise InputError(
            "robot", f"{count} joints", f"{form.joints} joints for {form.title}", "write a template of your own"
        )
    signs = check_array("signs", np.ones(count) if settings.signs is None else settings.signs, (count,))
    zeros = check_array("zeros", np.zeros(count) if settings.zeros is None else settings.zeros, (count,))
    if not (np.abs(signs) == 1.0).all():
        raise InputError("signs", signs.tolist(), "1 or -1 for every joint")
    usual = 0.0 if sheet.robot.couplings else form.coupling  # its coordinates are the controller's already
    coupling = usual if settings.coupling is None else check_number("coupling", settings.coupling)
    axes = np.array(signs * q + zeros)
    if coupling and count < 3:
        raise InputError("coupling", coupling, f"0 for a robot of {count} joints")
    if coupling:
        axes[:, 2] += coupling * axes[:, 1]
    return axes


def program_name(sheet: PlanSheet, form: ProgramFormat, settings: ProgramSettings) -> str:
    """The program's name.

    Raises:
        InputError: One that the controller cannot hold.
    """
    name = settings.name or f"cal_{sheet.identity[:4]}"
    if not IDENTIFIER.fullmatch(name) or len(name) > form.name_length:
        expected = f"a letter, then letters, digits and _, at most {form.name_length} characters"
        raise InputError("name", repr(name), expected)
    return name


def harmless(text: str) -> str:
    """A text of printable ASCII without quotes, brackets and signs that end comments or strings."""
    return re.sub(r"[^A-Za-z0-9 _.,:/+-]", "_", text)[:200]


def _handshake(name: str) -> str:
    if name not in HANDSHAKES:
        raise UnknownNameError("handshake", name, HANDSHAKES)
    return name


def _chosen(field: str, given: str | None, usual: str | int | None) -> str:
    """A signal or tool of the user, of the same kind as the template's."""
    if given is None:
        return "" if usual is None else str(usual)
    if usual is None:
        raise InputError(field, repr(given), "nothing: the template names none", "choose it on the controller")
    if isinstance(usual, int) and not given.isdecimal():
        raise InputError(field, repr(given), f"a whole number, such as {usual}")
    if isinstance(usual, str) and not IDENTIFIER.fullmatch(given):
        raise InputError(field, repr(given), f"a name of letters, digits and _, such as {usual}")
    return given


def _rendered(form: ProgramFormat, values: dict[str, Any]) -> str:
    environment = SandboxedEnvironment(
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        extensions=["jinja2.ext.do"],
    )
    environment.filters["fixed"] = lambda value, digits: f"{round(value, digits) + 0.0:.{digits}f}"
    environment.filters["clipped"] = lambda text, most: str(text)[:most]
    line = 0
    try:
        template = environment.from_string(form.body)
        return template.render(values).lstrip("\n")
    except TemplateSyntaxError as error:
        line, reason = error.lineno, error.message or ""
    except (
        TemplateError,
        SecurityError,
        TypeError,
        ValueError,
        ArithmeticError,
        LookupError,
        AttributeError,
    ) as error:
        steps, reason = error.__traceback__, str(error)
        while steps is not None:
            line = steps.tb_lineno if steps.tb_frame.f_code.co_filename == "<template>" else line
            steps = steps.tb_next
    raise FileFormatError(form.path, f"line {line}", reason, "a template that can be written out")
