# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""--payload, --mounting and --vertical: what hangs on the joints, and which way is down."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.cli.arguments import Group, numbers, option, quantity_in
from calib_planner.error_model import LINKS, ErrorModel, Gravity, Payload, gravity_of
from calib_planner.errors import InputError
from calib_planner.io import read_error_model, read_vertical
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot

MOUNTING = 'floor|ceiling|"x y z"'
MOUNTED = ("on the floor", "under a ceiling", "on a wall", "tilted")
STEEP = 0.94
"""Cosine of 20°: what is nearer than this to a floor, a ceiling or a wall is called so."""


def add_payload(group: Group, otherwise: str) -> None:
    """--payload; ``otherwise`` says what is taken without it."""
    text = "what the robot carries: mass [kg], centre of gravity in the frame of the last link [m]; or mass alone"
    option(group, "--payload", '"MASS X Y Z"', f"{text} ({otherwise})", kind=_masses)


def _masses(text: str) -> list[float]:
    """A mass [kg] and lengths [m], each with or without its unit: ``2.5kg 0 0 50mm``."""
    mass, *place = text.replace(",", " ").split() or [""]
    return [quantity_in("kg")(mass), *map(quantity_in("m"), place)]


def add_gravity(parser: argparse.ArgumentParser, *, measured: bool = True) -> None:
    """--payload and --mounting; --vertical and a column of payloads for what is ``measured`` by the user."""
    group = parser.add_argument_group("what gravity does to the robot")
    column = "; a column payload [kg] of the measurements says what each visit carried" if measured else ""
    add_payload(group, f"not known{column}")
    text = "floor, ceiling, or the direction downwards in the frame of the robot's base, as for a robot on a wall"
    option(group, "--mounting", MOUNTING, f"{text} (floor{', or as --vertical says' if measured else ''})")
    parser.set_defaults(vertical=None)
    if not measured:
        return
    text = "the direction upwards in the frame of the points: with the identified base it says how it is mounted"
    option(group, "--vertical", '"x y z"', f"{text} (up of --instrument, if its file says it)", kind=numbers)


def payload_of(args: argparse.Namespace) -> tuple[float, tuple[float, float, float]] | None:
    """Mass [kg] and centre of gravity [m] of --payload, or ``None`` without the option.

    Raises:
        InputError: Not one or four finite numbers, or a mass below zero.
    """
    given = args.payload
    if given is None:
        return None
    if len(given) not in (1, 4) or not np.isfinite(given).all():
        raise InputError(
            "--payload", f"{len(given)} numbers", "MASS X Y Z: 4 finite numbers, kg and m, or MASS alone"
        )
    if given[0] < 0.0:
        raise InputError("--payload", f"{given[0]:g} kg", "a mass of 0 kg or more")
    x, y, z = given[1:] or (0.0, 0.0, 0.0)
    return given[0], (x, y, z)


def error_model_of(
    args: argparse.Namespace, source: str, robot: Robot, data: Measurements | None = None
) -> ErrorModel:
    """The error model of a name or file, its gravity as the robot's file and the options of ``add_gravity`` say.

    Raises:
        InputError, FileFormatError: As ``with_gravity_of`` and ``read_error_model``.
    """
    model = read_error_model(source)
    if model.gravity is not None and model.name == source:
        model = replace(model, gravity=gravity_of(robot))
    return with_gravity_of(args, model, data)


def with_gravity_of(args: argparse.Namespace, model: ErrorModel, data: Measurements | None = None) -> ErrorModel:
    """The error model with what the options of ``add_gravity`` say of gravity; ``data``: the user's, if any.

    Raises:
        InputError: An option that contradicts another, or that the error model has no use for.
    """
    given = [name for name in ("payload", "mounting", "vertical") if getattr(args, name) is not None]
    if model.gravity is None:
        if given:
            got, advice = f"the error model {model.name}, without gravity", "give --error-model typical"
            raise InputError(f"--{given[0]}", got, "an error model with gravity", advice)
        return model
    return replace(model, gravity=_mounted(args, _loaded(args, model.gravity, data), data))


def gravity_note(gravity: Gravity | None, stated: Gravity, robot: Robot) -> str:
    """What was taken for gravity in the end, for the user; ``stated``: before the measurements had a say."""
    if gravity is None:
        way = f"of a robot that is mounted {mounted(stated.down)}"
        way = way if stated.vertical is None else "with the vertical of the points"
        return f"Gravity: the measurements show none {way}; if that is not so, give --mounting"
    known = any(mass.name == LINKS for mass in gravity.masses)
    if gravity.masses:
        masses = "the links weigh what the robot's file says" if known else "masses as the error model says"
    else:
        names = [m.name for m in replace(gravity, payload=None).masses_of(robot)]
        masses = f"unit masses at {' and '.join([', '.join(names[:-1]), names[-1]] if names[1:] else names)}"
        masses += f" ({robot.mass_fault})" if robot.mass_fault else ""
    payload = "" if gravity.payload is None else f", a payload of {gravity.payload.mass:g} kg"
    x, y, z = (gravity.down + 0.0).tolist()
    down = f"down is {x:.3g} {y:.3g} {z:.3g} in the frame of its base"
    return f"Gravity: {masses}{payload}; mounted {mounted(gravity.down)}: {down}"


def mounted(down: FloatArray) -> str:
    """The word for a direction downwards (3,) in the frame of the robot's base."""
    level = float(np.hypot(down[0], down[1]))
    cases = (-down[2], down[2], level)
    return next((word for word, share in zip(MOUNTED, cases, strict=False) if share > STEEP), MOUNTED[-1])


def _loaded(args: argparse.Namespace, gravity: Gravity, data: Measurements | None) -> Gravity:
    """With the payload that is stated; where its mass is in the measurements alone, the heaviest."""
    stated = payload_of(args)
    if stated is None:
        return gravity
    mass, place = stated
    if not mass and data is not None and data.payload is not None:
        mass = float(np.asarray(data.payload).max())
    return gravity.with_payload(Payload(mass, place) if mass else None)


def _mounted(args: argparse.Namespace, gravity: Gravity, data: Measurements | None) -> Gravity:
    """With the mounting that is stated, or the vertical from which it follows."""
    if args.mounting is not None:
        if args.vertical is not None:
            raise InputError(
                "--vertical", "a direction", "no --mounting beside it", "each says which way is down"
            )
        return replace(gravity, mounting=_mounting(args.mounting), vertical=None)
    vertical = args.vertical
    if vertical is None and data is not None and args.instrument is not None:
        vertical = read_vertical(args.instrument)
    if vertical is None:
        return gravity
    if len(vertical) != 3 or not np.isfinite(vertical).all() or not np.any(vertical):
        raise InputError("--vertical", f"{len(vertical)} numbers", "a direction: 3 finite numbers x y z")
    return replace(gravity, vertical=tuple(vertical))


def _mounting(text: str) -> str | tuple[float, float, float]:
    if text in ("floor", "ceiling"):
        return text
    advice = 'a robot on a wall: which way is down in the frame of its base, such as "1 0 0"'
    valid = 'floor, ceiling or a direction "x y z"'
    try:
        direction = numbers(text)
    except argparse.ArgumentTypeError:
        raise InputError("--mounting", text, valid, advice) from None
    if len(direction) != 3 or not np.isfinite(direction).all() or not np.any(direction):
        raise InputError("--mounting", text, valid, advice)
    x, y, z = direction
    return x, y, z
