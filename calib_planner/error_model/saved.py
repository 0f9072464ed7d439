# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The error model as plain data, for YAML: alone or as a part of an estimate.

``to_mapping`` gives dictionaries, lists, numbers and strings; ``from_mapping`` reads them back to an equal model
and refuses what it does not know, naming the key.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from calib_planner.error_model.gravity import Gravity, Mass, Payload
from calib_planner.error_model.joint_functions import JointFunctions
from calib_planner.error_model.model import ErrorModel, Scale
from calib_planner.error_model.placement import Placement
from calib_planner.error_model.points import Points
from calib_planner.error_model.prior import Prior
from calib_planner.error_model.visits import Visits
from calib_planner.errors import CalibPlannerError, InputError, UnknownNameError
from calib_planner.tracker import Isotropic, LaserTracker, Noise

GRAVITY = {f.name for f in fields(Gravity)}
NOISES = {"isotropic": Isotropic, "laser_tracker": LaserTracker}


def to_mapping(model: ErrorModel) -> dict[str, Any]:
    """Plain data that hold the whole model."""
    gravity, functions, visits = model.gravity, model.joint_functions, model.visits
    points: dict[str, Any] = {"estimate_scale": model.points.estimate_scale, "floor": model.points.floor}
    if model.points.noise is not None:
        points["noise"] = _noise_mapping(model.points.noise)
    return {
        "name": model.name,
        "placement": {"prior": model.placement.prior, "stated": _prior_mapping(model.placement.stated)},
        "gravity": None if gravity is None else _plain(asdict(gravity)),
        "joint_functions": None if functions is None else _plain(asdict(functions)),
        "visits": None if visits is None else asdict(visits),
        "points": points,
        "scales": {s.name: {k: v for k, v in asdict(s).items() if k != "name"} for s in model.scales},
    }


def from_mapping(data: Mapping[str, Any], field: str = "error_model") -> ErrorModel:
    """The model of ``to_mapping``.

    Args:
        data: What was read.
        field: Where it stood, for messages.

    Raises:
        InputError: A key is missing, unknown, or holds what it cannot hold; names the key.
    """
    parts = {f.name for f in fields(ErrorModel)}
    _check_keys(field, data, parts, parts)
    try:
        placement = _section(field, data, "placement", {"prior", "stated"})
        points = dict(_section(field, data, "points", {"noise", "estimate_scale", "floor"}))
        noise = None if points.get("noise") is None else _noise(f"{field}.points.noise", points["noise"])
        gravity = _optional(field, data, "gravity", GRAVITY, GRAVITY - {"payload", "vertical"})
        functions = _optional(field, data, "joint_functions", {"components", "harmonics"})
        visits = _optional(field, data, "visits", {"joints", "shared"})
        return ErrorModel(
            placement=Placement(placement["prior"], _prior(f"{field}.placement.stated", placement["stated"])),
            gravity=None if gravity is None else _gravity(f"{field}.gravity", gravity),
            joint_functions=None
            if functions is None
            else JointFunctions(tuple(functions["components"]), functions["harmonics"]),
            visits=None if visits is None else Visits(**visits),
            points=Points(noise, bool(points["estimate_scale"]), bool(points["floor"])),
            scales=tuple(Scale(name, **values) for name, values in dict(data["scales"]).items()),
            name=str(data["name"]),
        )
    except CalibPlannerError:
        raise
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        advice = "compare with config/error_models/typical.yaml or save the model anew"
        raise InputError(field, f"{type(error).__name__}: {error}", "a saved error model", advice) from None


def _prior_mapping(stated: Prior | None) -> dict[str, Any] | None:
    return None if stated is None else _plain(asdict(stated))


def _prior(field: str, data: Mapping[str, Any] | None) -> Prior | None:
    if not data:
        return None
    keys = {f.name for f in fields(Prior)}
    _check_keys(field, data, keys, keys)
    return Prior(tuple(data["names"]), data["values"], data["covariance"], str(data["source"]))


def _gravity(field: str, data: Mapping[str, Any]) -> Gravity:
    masses = []
    for k, mass in enumerate(data["masses"]):
        _check_keys(f"{field}.masses[{k}]", mass, {"name", "joint", "xyz", "weight"}, {"name"})
        masses.append(Mass(**{**mass, "xyz": tuple(mass.get("xyz", (0.0, 0.0, 0.0)))}))
    mounting, payload, vertical = data["mounting"], data.get("payload"), data.get("vertical")
    if payload is not None:
        _check_keys(f"{field}.payload", payload, {"mass", "xyz"}, {"mass", "xyz"})
        payload = Payload(payload["mass"], tuple(payload["xyz"]))
    mounting = mounting if isinstance(mounting, str) else tuple(mounting)
    return Gravity(tuple(masses), mounting, payload, None if vertical is None else tuple(vertical))


def _noise(field: str, data: Mapping[str, Any]) -> Noise:
    kind = data.get("kind")
    if kind not in NOISES:
        raise UnknownNameError(f"{field}.kind", str(kind), tuple(NOISES))
    known = {f.name for f in fields(NOISES[kind])}
    _check_keys(field, data, {"kind", *known}, {"kind"})
    return NOISES[kind](**{k: v for k, v in data.items() if k != "kind"})


def _noise_mapping(noise: Noise) -> dict[str, Any]:
    for kind, made in NOISES.items():
        if isinstance(noise, made):
            return {"kind": kind, **{f.name: _plain(getattr(noise, f.name)) for f in fields(made)}}
    raise InputError("points.noise", type(noise).__name__, f"one of {', '.join(NOISES)} to be saved")


def _section(field: str, data: Mapping[str, Any], key: str, known: set[str]) -> Mapping[str, Any]:
    _check_keys(f"{field}.{key}", data[key], known, known - {"noise"})
    return dict(data[key])


def _optional(
    field: str, data: Mapping[str, Any], key: str, known: set[str], needed: set[str] | None = None
) -> Mapping[str, Any] | None:
    if data[key] is None:
        return None
    _check_keys(f"{field}.{key}", data[key], known, known if needed is None else needed)
    return dict(data[key])


def _check_keys(field: str, data: object, known: set[str], needed: set[str]) -> None:
    if not isinstance(data, Mapping):
        raise InputError(field, type(data).__name__, f"a mapping with the keys {', '.join(sorted(known))}")
    for key in data:
        if key not in known:
            raise UnknownNameError(field, str(key), sorted(known))
    for key in sorted(needed - set(data)):
        raise InputError(f"{field}.{key}", "nothing", "a value")


def _plain(value: Any) -> Any:
    """Arrays and tuples as lists, everything else as it is."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(v) for v in value]
    return float(value) if isinstance(value, np.floating) else value
