# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
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
it says where the robot stood that day. The targets' places are taken over on request only: targets are re-seated.
What is left out of a Gaussian leaves the others' mean and covariance as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calib_planner.error_model import Prior
from calib_planner.errors import UnknownNameError
from calib_planner.io.estimate import parse_estimate
from calib_planner.io.yaml import Node, read_yaml
from calib_planner.robot import BASE, BASE_PARAMETERS, TARGET, Parameter, Robot, role_of, target_parameters
from calib_planner.units import listed

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
    top = read_yaml(path, WHAT)
    if top.get("format").value == "calib_planner/estimate":
        return _from_estimate(top, robot, targets)
    if targets:
        raise top.get("format").error("prior knowledge", "an estimate, to take the targets' places from")
    whole = "parameters" in top
    entries = top.mapping(("parameters", "source"))["parameters"].mapping() if whole else top
    if not entries.value:
        raise top.get("parameters").error("nothing", "names of parameters, with a standard deviation each")
    nominal = {p.name: p for p in robot.parameters}
    placed = _placed_by_data(robot)
    known = {name: _expected(entry, name, nominal, placed) for name, entry in entries.entries()}
    values, std = np.array(list(known.values())).T
    source = top["source"].text() if "source" in top else str(path)
    return PriorFile(top.build(lambda: Prior(tuple(known), values, std, source)), ())


def _expected(entry: Node, name: str, nominal: Mapping[str, Parameter], placed: set[str]) -> tuple[float, float]:
    if name not in nominal:
        advice = UnknownNameError("", name, list(nominal)).advice
        raise entry.error("no parameter to be identified", f"one of: {listed(nominal)}", advice)
    parameter = nominal[name]
    one = entry if isinstance(entry.value, Mapping) else Node(entry.path, entry.where, {"std": entry.value})
    one.mapping(("value", "deviation", "std", "unit"), ("std",))
    factor = _factor(one, parameter)
    std = factor * one["std"].number()
    if not STD[0] <= std <= STD[1]:
        raise one["std"].refused(f"a standard deviation from {STD[0]:g} to {STD[1]:g} {parameter.unit}")
    if "value" in one and "deviation" in one:
        raise one["deviation"].error("beside value", "one of the two")
    if name in placed:
        return _place(one, name, factor), std
    value = factor * one["value"].number() if "value" in one else None
    deviation = factor * one.get("deviation", 0.0).number() if value is None else value - parameter.nominal
    if abs(deviation) > FARTHEST:
        got = f"{deviation:.4g} {parameter.unit} from the nominal {parameter.nominal:.6g}"
        expected = f"at most {FARTHEST:g} {parameter.unit} from it: is the unit right?"
        raise one.get("value").error(got, expected)
    return parameter.nominal + deviation if value is None else value, std


def _factor(one: Node, parameter: Parameter) -> float:
    """What turns the numbers of an entry into m or rad."""
    valid = [u for u, (of, _) in UNITS.items() if of == parameter.unit]
    return UNITS[one.get("unit", parameter.unit).choice(valid)][1]


def _place(one: Node, name: str, factor: float) -> float:
    """The expected value of a base or target coordinate, which has no nominal one."""
    value = one.get("value")
    if name.startswith("base.r"):
        raise value.error("the base's orientation", "no such prior: the data alone place an unknown base")
    if "value" not in one:
        raise value.error("nothing", "its value: what is unknown altogether has no nominal one")
    return factor * value.number()


def _placed_by_data(robot: Robot) -> set[str]:
    """Active parameters whose start is a closed form of the data, whatever the robot's own values."""
    active = set(robot.parameter_names)
    groups = (BASE_PARAMETERS, target_parameters(len(robot.targets)))
    return {name for group in groups if active.issuperset(group) for name in group}


def _from_estimate(top: Node, robot: Robot, targets: bool) -> PriorFile:
    saved = parse_estimate(top)
    top.build(lambda: saved.check_robot(robot))
    known = [n for n, s in zip(saved.parameters, saved.std, strict=True) if not np.isnan(s)]
    if not known:
        raise top["parameters"].error("no standard deviations", "an estimate that knows how sure it is")
    wanted = set(robot.parameter_names)
    unwanted = (BASE,) if targets else (BASE, TARGET)
    taken = [n for n in known if n in wanted and role_of(n) not in unwanted]
    if not taken:
        expected = f"some of: {', '.join(robot.parameter_names)}"
        raise top["parameters"].error("no parameter that is to be identified", expected)
    at = [saved.parameters.index(n) for n in taken]
    covariance = saved.covariance[at][:, at]
    prior = top.build(lambda: Prior(tuple(taken), saved.values[at], covariance, f"estimate {top.path}"))
    return PriorFile(prior, tuple(n for n in known if n not in taken))
