# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The saved form gives the same model back, and refuses what it does not know."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml

from calib_planner.error_model import (
    ErrorModel,
    Gravity,
    Mass,
    Payload,
    Placement,
    Prior,
    from_mapping,
    to_mapping,
    typical,
)
from calib_planner.errors import InputError
from calib_planner.tracker import Isotropic, LaserTracker

MODELS = {
    "typical": lambda: typical(),
    "paper": lambda: ErrorModel.paper(3e-5),
    "masses": lambda: typical(
        Isotropic(1e-5),
        gravity=Gravity(
            (Mass("arm", 2, (0.1, 0.0, 0.2), 0.5), Mass("hand")),
            (0.36, 0.48, 0.8),
            Payload(2.5, (0.0, 0.01, 0.1)),
        ),
        placement=Placement(stated=Prior(("d1",), [0.5], [1e-4])),
        estimate_scale=True,
    ),
    "vertical": lambda: typical(gravity=Gravity(vertical=(0.0, -1.0, 1.0))),
    "without": lambda: typical().without("short").without("gravity").with_values({"floor": 1.5e-5}, "estimated"),
}


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
def test_yaml_and_pickle_give_it_back(make: Callable[[], ErrorModel]) -> None:
    model = make()
    assert from_mapping(yaml.safe_load(yaml.safe_dump(to_mapping(model)))) == model
    assert pickle.loads(pickle.dumps(model)) == model


def test_files_from_before_payloads_are_read() -> None:
    data = to_mapping(typical())
    del data["gravity"]["payload"], data["gravity"]["vertical"]
    assert from_mapping(data) == typical()


def test_a_tracker_comes_back_with_its_station() -> None:
    model = typical(LaserTracker(station=np.array([1.0, 2.0, 3.0])))
    back = from_mapping(yaml.safe_load(yaml.safe_dump(to_mapping(model))))
    np.testing.assert_array_equal(back.points.noise.station, [1.0, 2.0, 3.0])  # type: ignore[union-attr]


def spoil(data: dict[str, Any], path: str, value: object) -> None:
    *outer, last = path.split("/")
    for key in outer:
        data = data[key]
    if value is None:
        del data[last]
    else:
        data[last] = value


@pytest.mark.parametrize(
    ("path", "value", "named"),
    [
        ("gravitas", 1, "gravitas"),
        ("points", None, "points"),
        ("points/floor", None, "points.floor"),
        ("points/noise", {"kind": "sonar"}, "sonar"),
        ("gravity/masses", [{"name": "a", "kg": 3}], "kg"),
        ("gravity/masses", [{"name": "payload"}], "payload"),
        ("gravity/payload", {"mass": 0.0, "xyz": [0, 0, 0]}, "payload.mass"),
        ("gravity/payload", {"mass": 1.0}, "payload.xyz"),
        ("gravity/payload", 3.0, "payload"),
        ("gravity/vertical", [0, 0, 0], "vertical"),
        ("joint_functions/components", ["rough"], "rough"),
        ("scales/floor/value", -1.0, "floor"),
        ("scales/floor", 3.0, "error_model"),
        ("scales", 3.0, "error_model"),
        ("placement", "flat", "placement"),
        ("gravity/mounting", 7, "error_model"),
    ],
)
def test_what_is_wrong_is_named(path: str, value: object, named: str) -> None:
    data = to_mapping(typical())
    spoil(data, path, value)
    with pytest.raises(InputError, match=named):
        from_mapping(data)


def test_the_file_to_begin_from_is_the_typical_model() -> None:
    from calib_planner.io import read_error_model
    from calib_planner.io.robots import config_folder

    assert read_error_model(config_folder() / "error_models" / "typical.yaml") == typical()


def test_an_instrument_of_ones_own_cannot_be_saved() -> None:
    class Ruler(Isotropic):
        pass

    class Eye:
        typical = 1e-3

        def covariance(self, points: np.ndarray) -> np.ndarray:
            return 1e-6 * np.ones((*points.shape[:-1], 1, 1)) * np.eye(3)

    assert to_mapping(typical(Ruler(1e-5)))["points"]["noise"]["kind"] == "isotropic"
    with pytest.raises(InputError, match=r"points\.noise: expected one of isotropic"):
        to_mapping(typical(Eye()))  # type: ignore[arg-type]


def test_a_prior_is_equal_to_its_like_only() -> None:
    prior = Prior(("d1",), [0.5], [1e-4])
    assert prior == Prior(("d1",), [0.5], [1e-4]) and hash(prior) == hash(Prior(("d1",), [0.5], [1e-4]))
    assert prior != Prior(("d1",), [0.5], [2e-4]) and prior != ("d1",) and prior is not None
    for other in (replace(prior, names=("d2",)), replace(prior, source="other")):
        assert prior != other and other != prior
