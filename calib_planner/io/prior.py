"""What is known of the parameters beforehand, as YAML that a user writes or as an estimate from before.

    source: last year's calibration        # in words; may be left out
    parameters:
      joint_2.offset: {value: 0.12, std: 0.02, unit: deg}    # expected value ± standard deviation
      joint_3.z: {deviation: 0.3, std: 0.1, unit: mm}        # expected value − nominal
      joint_4.z: {std: 0.5, unit: mm}                        # nominal ± standard deviation
      joint_5.z: 5.0e-4                                      # the same [m | rad]

Without ``unit`` numbers are in m or rad. A file of the last form alone, without ``parameters``, is that of
``plan``.

An estimate file gives the values and the covariance of what it identified. The base's pose is never taken over:
it says where the robot stood that day. The targets' places are only if asked for: they are re-seated otherwise.
What is left out of a Gaussian leaves the others' mean and covariance as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.errors import FileFormatError, UnknownNameError
from calib_planner.identification import Prior
from calib_planner.io.csv import shown
from calib_planner.io.estimate import parse_estimate
from calib_planner.io.yaml import Section, read_mapping
from calib_planner.robot import Parameter, Robot

WHAT = "a YAML of prior knowledge, or an estimate"
UNITS = {
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "rad": ("rad", 1.0),
    "mrad": ("rad", 1e-3),
    "deg": ("rad", np.pi / 180),
}
"""Unit in a file → unit of the parameter, factor."""
STD = (1e-9, 1e3)
"""Standard deviations between certainty and no knowledge at all [m | rad]."""
FARTHEST = 1.0
"""No part of a robot is expected farther from its data sheet than this [m | rad]: the unit is another."""


@dataclass(frozen=True, eq=False)
class PriorFile:
    """A prior and the names of what the file knows beyond it."""

    prior: Prior
    left_out: tuple[str, ...]


def read_prior(path: str | Path, robot: Robot, *, targets: bool = False) -> PriorFile:
    """Read prior knowledge of the active parameters of ``robot``.

    Args:
        path: The file.
        robot: The nominal robot; base and targets that are to be identified have no nominal value.
        targets: Take over the targets' places from an estimate too.

    Raises:
        FileFormatError: Names the key at fault, what it holds and what is valid.
    """
    document = read_mapping(path, WHAT)
    if document.get("format") == "calib_planner/estimate":
        return _from_estimate(path, document, robot, targets)
    top = Section(Path(path), "", document)
    if targets:
        raise top.error("format", "prior knowledge", "an estimate, to take the targets' places from")
    if "parameters" in document:
        top.only(("parameters", "source"))
        entries = top.section("parameters")
    else:
        entries = top
    if not entries.values:
        raise top.error("parameters", "nothing", "names of parameters, with a standard deviation each")
    nominal = {p.name: p for p in robot.parameters}
    placed = _placed_by_data(robot)
    found = {str(name): _expected(entries, str(name), v, nominal, placed) for name, v in entries.values.items()}
    values, std = np.array(list(found.values())).T
    source = top.text("source") if "source" in document else str(path)
    return PriorFile(top.made(lambda: Prior(tuple(found), values, std, source)), ())


def _expected(
    entries: Section, name: str, given: Any, nominal: Mapping[str, Parameter], placed: set[str]
) -> tuple[float, float]:
    """Expected value and standard deviation of one parameter [m | rad]."""
    if name not in nominal:
        advice = UnknownNameError("", name, list(nominal)).advice
        where = f"{entries.where}{name[:40]}"
        raise FileFormatError(entries.path, where, "not asked for", f"one of: {shown(list(nominal))}", advice)
    parameter = nominal[name]
    keys = ("value", "deviation", "std", "unit")
    one = Section(
        entries.path, f"{entries.where}{name}.", given if isinstance(given, Mapping) else {"std": given}
    )
    one.only(keys, ("std",))
    factor = _factor(one, parameter)
    std = factor * one.number("std")
    if not STD[0] <= std <= STD[1]:
        wanted = f"a standard deviation from {STD[0]:g} to {STD[1]:g} {parameter.unit}"
        raise one.error("std", repr(one.values["std"])[:60], wanted)
    if "value" in one.values and "deviation" in one.values:
        raise one.error("deviation", "beside value", "one of the two")
    if name in placed:
        return _place(one, name, factor), std
    value = factor * one.number("value") if "value" in one.values else None
    deviation = factor * one.number("deviation", 0.0) if value is None else value - parameter.nominal
    if abs(deviation) > FARTHEST:
        got = f"{deviation:.4g} {parameter.unit} from the nominal {parameter.nominal:.6g}"
        raise one.error("value", got, f"at most {FARTHEST:g} {parameter.unit} from it: is the unit right?")
    return parameter.nominal + deviation if value is None else value, std


def _factor(one: Section, parameter: Parameter) -> float:
    """What turns the numbers of an entry into m or rad."""
    unit = one.text("unit") if "unit" in one.values else parameter.unit
    valid = [u for u, (of, _) in UNITS.items() if of == parameter.unit]
    if unit not in valid:
        raise one.error("unit", repr(unit)[:60], f"one of: {', '.join(valid)}")
    return UNITS[unit][1]


def _place(one: Section, name: str, factor: float) -> float:
    """The expected value of what has no nominal one."""
    if name.startswith("base.r"):
        raise one.error("value", "the base's orientation", "no such prior: the data alone place an unknown base")
    if "value" not in one.values:
        raise one.error("value", "nothing", "its value: what is unknown altogether has no nominal one")
    return factor * one.number("value")


def _placed_by_data(robot: Robot) -> set[str]:
    """Active parameters whose start is a closed form of the data, whatever the robot's own values."""
    active = set(robot.parameter_names)
    base = {f"base.{a}" for a in ("x", "y", "z", "rx", "ry", "rz")}
    targets = {f"target_{t + 1}.{a}" for t in range(len(robot.targets)) for a in "xyz"}
    return {name for group in (base, targets) if group <= active for name in group}


def _from_estimate(path: str | Path, document: dict[str, Any], robot: Robot, targets: bool) -> PriorFile:
    content = {k: v for k, v in document.items() if k != "format"}
    top, saved = Section(Path(path), "", content), parse_estimate(path, content)
    top.made(lambda: saved.check_robot(robot))
    known = [n for n, s in zip(saved.parameters, saved.std, strict=True) if not np.isnan(s)]
    if not known:
        raise top.error("parameters", "no standard deviations", "an estimate that knows how sure it is")
    asked = set(robot.parameter_names)
    unwanted = ("base.",) if targets else ("base.", "target_")
    taken = [n for n in known if n in asked and not n.startswith(unwanted)]
    if not taken:
        raise top.error("parameters", "none of what is asked for", f"some of: {', '.join(robot.parameter_names)}")
    at = [saved.parameters.index(n) for n in taken]
    covariance = saved.covariance[at][:, at]
    prior = top.made(lambda: Prior(tuple(taken), saved.values[at], covariance, f"estimate {path}"))
    return PriorFile(prior, tuple(n for n in known if n not in taken))
