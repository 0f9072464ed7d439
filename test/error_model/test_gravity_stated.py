# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Payloads and mountings that are stated: with the right ones, a robot with gravity is predicted to the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fits import NOTHING, unknown, ur10e
from robots import random_configurations

from calib_planner import InputError, Robot
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, Gravity, Knowledge, Payload, Truth, typical
from calib_planner.identification import fit_error_model
from calib_planner.measurements import Measurements
from calib_planner.robot import rotation

SIGMA = 2e-5
ON_A_WALL = rotation(2, 0.4) @ rotation(0, np.pi / 2 - 0.03) @ rotation(2, 0.7)


def truth_of(robot: Robot, gravity: Gravity, seed: int) -> Truth:
    """A robot that errs by gravity and a little geometry."""
    scales = NOTHING | {"gravity": 4e-3, "floor": SIGMA, "placement.length": 1e-4, "placement.angle": 2e-4}
    model = typical(gravity=gravity).with_values(scales)
    return Truth.draw(robot, model, np.random.default_rng(seed))


def measured(truth: Truth, count: int, seed: int, payload: FloatArray | None = None) -> Measurements:
    q = random_configurations(truth.robot, count, seed) / 3.0
    points = truth.measure(q, np.random.default_rng(seed + 1), payload)
    return Measurements(truth.robot.joint_names, q, points, payload=payload)


def fresh(known: Knowledge, truth: Truth, payload: float | None = None) -> tuple[float, float]:
    """Root mean square error of the mean at fresh configurations [m], and what was predicted of it."""
    q = random_configurations(truth.robot, 300, 99) / 3.0
    told = known.predict(q, payload)
    error = np.sum((told.mean - truth.positions(q, payload=payload)) ** 2, axis=2).mean()
    return float(np.sqrt(error)), float(np.sqrt(np.trace(told.position, axis1=2, axis2=3).mean()))


def slim(gravity: Gravity) -> ErrorModel:
    """Without joint functions, which could take over a part of the gravity that is wrong."""
    return typical(gravity=gravity).without("joint_functions")


@pytest.fixture(scope="module")
def on_a_wall() -> tuple[Truth, Measurements]:
    """A robot on a wall that is not quite upright; the frame of the points is."""
    robot = ur10e().with_base(ON_A_WALL, [1.0, 2.0, 3.0])
    x, y, z = -ON_A_WALL.T @ [0.0, 0.0, 1.0]
    truth = truth_of(robot, Gravity(mounting=(x, y, z)), 4)
    return truth, measured(truth, 45, 10)


def test_the_mounting_follows_from_the_base_that_is_found(on_a_wall: tuple[Truth, Measurements]) -> None:
    truth, data = on_a_wall
    robot = unknown(ur10e())
    found = fit_error_model(robot, data, slim(Gravity(vertical=(0.0, 0.0, 2.0))))
    gravity = found.knowledge.model.gravity
    assert gravity is not None and gravity.vertical is None
    # The base turns about the first joint's axis, its own z, as that joint's zero does: what gravity turns this
    # joint by on average may stand in either. The tilt of that axis is certain.
    off = gravity.down - truth.model.gravity.down  # type: ignore[union-attr]
    assert abs(off[2]) < 2e-3 and np.abs(off).max() < 0.1
    achieved, told = fresh(found.knowledge, truth)
    assert achieved < 2.0 * SIGMA and 0.6 < told / achieved < 1.6
    down = rotation(2, -0.7) @ [0.0, -1.0, 0.0]
    stated = fit_error_model(robot, data, slim(Gravity(mounting=tuple(down))))
    wrong = fit_error_model(robot, data, slim(Gravity()))
    assert fresh(wrong.knowledge, truth)[0] > 5.0 * achieved
    # A direction in the frame of the base turns with what stands in the base instead of the joint's zero.
    assert achieved < fresh(stated.knowledge, truth)[0] < 0.5 * fresh(wrong.knowledge, truth)[0]
    assert found.left_out.score > wrong.left_out.score + 50.0


def test_a_base_that_is_known_says_the_mounting_too(on_a_wall: tuple[Truth, Measurements]) -> None:
    truth, data = on_a_wall
    robot = ur10e().with_base(ON_A_WALL, [1.0, 2.0, 3.0])
    found = fit_error_model(robot, data, slim(Gravity(vertical=(0.0, 0.0, 1.0))))
    np.testing.assert_allclose(found.knowledge.model.gravity.down, truth.model.gravity.down, atol=1e-12)  # type: ignore[union-attr]


CARRIED = Payload(8.0, (0.05, 0.0, 0.15))


@pytest.fixture(scope="module")
def loaded() -> tuple[Truth, Measurements]:
    """Visits with 0, 3 and 8 kg, in turn."""
    truth = truth_of(ur10e(), Gravity(payload=CARRIED), 7)
    return truth, measured(truth, 60, 20, np.array([0.0, 3.0, 8.0])[np.arange(60) % 3])


def test_a_payload_for_each_visit_is_learnt_and_predicted(loaded: tuple[Truth, Measurements]) -> None:
    truth, data = loaded
    found = fit_error_model(unknown(ur10e()), data, slim(Gravity(payload=CARRIED)))
    for mass in (0.0, 5.0, 8.0):
        achieved, told = fresh(found.knowledge, truth, mass)
        assert achieved < 2.0 * SIGMA and 0.6 < told / achieved < 1.6
    unaware = fit_error_model(unknown(ur10e()), replace(data, payload=None), slim(Gravity()))
    assert found.left_out.score > unaware.left_out.score + 50.0
    assert found.knowledge.model.gravity.payload == CARRIED  # type: ignore[union-attr]


def test_where_nobody_states_a_payload_the_heaviest_visit_is_at_the_tip(
    loaded: tuple[Truth, Measurements],
) -> None:
    _, data = loaded
    found = fit_error_model(unknown(ur10e()), data, slim(Gravity()))
    assert found.knowledge.model.gravity.payload == Payload(8.0)  # type: ignore[union-attr]
    known = found.knowledge
    np.testing.assert_array_equal(known.predict(data.q).mean, known.predict(data.q, 8.0).mean)
    empty = replace(data, payload=np.zeros(len(data)))
    nothing = fit_error_model(unknown(ur10e()), empty, slim(Gravity()), choose=False).knowledge
    assert nothing.model.gravity.payload is None  # type: ignore[union-attr]
    np.testing.assert_array_equal(nothing.predict(data.q, 0.0).mean, nothing.predict(data.q).mean)
    with pytest.raises(InputError, match="knows no payload"):
        nothing.predict(data.q, 2.0)
    with pytest.raises(InputError, match="0 kg or more"):
        known.predict(data.q, -1.0)
    with pytest.raises(InputError, match="payload"):
        known.predict(data.q, [1.0, 2.0])


def test_a_robot_that_carries_something_else(loaded: tuple[Truth, Measurements]) -> None:
    truth, data = loaded
    known = fit_error_model(unknown(ur10e()), data, slim(Gravity(payload=CARRIED))).knowledge
    q = random_configurations(truth.robot, 20, 3) / 3.0
    lighter = known.carrying(replace(CARRIED, mass=3.0))
    for other, mass in ((lighter, 3.0), (known.carrying(None), 0.0), (known.carrying(CARRIED), 8.0)):
        ours, theirs = other.predict(q), known.predict(q, mass)
        np.testing.assert_allclose(ours.mean, theirs.mean, atol=1e-14)
        np.testing.assert_allclose(ours.total, theirs.total, atol=1e-18)
    np.testing.assert_allclose(lighter.predict(q, 6.0).mean, known.predict(q, 6.0).mean, atol=1e-14)
    # Another centre of gravity: the same compliance, other moments.
    place = Payload(5.0, (-0.2, 0.1, 0.3))
    true = replace(truth, model=replace(truth.model, gravity=Gravity(payload=replace(place, mass=8.0))))
    error = known.carrying(place).predict(q).mean - true.positions(q, payload=5.0)
    apart = known.carrying(place).predict(q).mean - known.predict(q, 5.0).mean
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.sqrt(np.mean(apart**2))
    with pytest.raises(InputError, match="payload"):
        known.carrying(None).carrying(place)
