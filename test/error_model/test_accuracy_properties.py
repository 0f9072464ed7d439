# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the accuracy at test poses must not depend on, in both frames: where the tracker stands, orders, units.

Hypothesis draws chains, poses to measure at and test poses. All terms of the error model are there unless said
otherwise; gravity acts in the frame of the base and the tracker has a place, so that both move with the base.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from robots import random_chain, random_configurations, repeats

from calib_planner import InputError, Robot
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, JointFunctions, Knowledge, typical
from calib_planner.robot.elements import rotation
from calib_planner.tracker import Isotropic, LaserTracker

HEAD = Robot.load("planar_2r").elements[:9]
QUICK = settings(max_examples=repeats(12, 300), deadline=None, derandomize=True)
LOOSE = 1e-6
"""Relative: M is inverted, and its eigenvalues differ by up to ten digits (microradians beside flat lengths)."""
NOTHING = 1e-9
"""Of σ: an accuracy below it is none, as where a rigid motion explains all that is uncertain."""
SIGMA = 3e-5
seeds = st.integers(0, 100_000)
angle = st.floats(-3.0, 3.0)
motions = st.tuples(angle, angle, angle, st.lists(st.floats(-5.0, 5.0), min_size=3, max_size=3).map(np.array))


def chain_of(seed: int) -> Robot:
    robot = random_chain(seed)
    return replace(robot, elements=(*HEAD, *robot.elements))


def whole(station: FloatArray, up: FloatArray) -> ErrorModel:
    """All terms, few harmonics: fast."""
    model = typical(LaserTracker(station=station, up=up))
    return replace(model, joint_functions=JointFunctions(("smooth",), 3))


def accuracies(
    robot: Robot, model: ErrorModel, q: FloatArray, poses: FloatArray, **options: object
) -> FloatArray:
    """(2, 1 + K) accuracy in the frames ``world`` and ``robot`` [m]: the mean, then of each test pose."""
    known = Knowledge.of_plan(robot, model, q)
    try:
        told = [known.accuracy(poses, kind, **options) for kind in ("world", "robot")]  # type: ignore[arg-type]
    except InputError:  # a chain that moves its target in a plane only has no accuracy up to a rigid motion
        assume(False)
    return np.array([[one.value, *one.per_pose] for one in told])


@QUICK
@given(seeds, motions, st.booleans())
def test_it_does_not_matter_where_the_tracker_stands(seed, motion, paper):
    turn = rotation(2, motion[0]) @ rotation(1, motion[1]) @ rotation(0, motion[2])
    robot = chain_of(seed)
    moved = robot.with_base(turn, motion[3])
    q, poses = random_configurations(robot, 12, seed), random_configurations(robot, 5, seed + 1)
    station, up = np.array([4.0, 1.0, 0.5]), np.array([0.0, 0.0, 1.0])
    models = whole(station, up), whole(turn @ station + motion[3], turn @ up)
    if paper:
        models = tuple(ErrorModel.paper(m.points.noise) for m in models)
    one, other = (accuracies(r, m, q, poses) for r, m in zip((robot, moved), models, strict=True))
    assert np.isfinite(one).any()
    np.testing.assert_allclose(other, one, rtol=LOOSE, atol=NOTHING * SIGMA)


@QUICK
@given(seeds, st.sampled_from([1e-3, 0.0254, 10.0, 1e3]))
def test_an_accuracy_has_the_unit_of_lengths(seed, unit):
    """Lengths and σ in another unit: so is the accuracy. The paper's model has no other scale of length."""
    robot = chain_of(seed)

    def scaled(elements):
        return tuple(e if e.is_rotation else replace(e, value=e.value * unit) for e in elements)

    other = replace(robot, elements=scaled(robot.elements), targets=tuple(map(scaled, robot.targets)))
    q, poses = random_configurations(robot, 12, seed), random_configurations(robot, 5, seed + 1)
    factor = np.where(robot.joint_is_revolute, 1.0, unit)
    one = accuracies(robot, ErrorModel.paper(SIGMA), q, poses)
    two = accuracies(other, ErrorModel.paper(SIGMA * unit), q * factor, poses * factor)
    assert np.isfinite(one).any()
    np.testing.assert_allclose(two, one * unit, rtol=LOOSE, atol=NOTHING * SIGMA * unit)


@QUICK
@given(seeds, st.randoms(use_true_random=False), st.floats(1e-3, 1e3))
def test_orders_and_the_size_of_weights_do_not_matter(seed, chance, size):
    """Of joints, parameters, configurations and test poses; only the ratios of weights count."""
    robot, rng = chain_of(seed), np.random.default_rng(seed)
    q, poses = random_configurations(robot, 12, seed), random_configurations(robot, 5, seed + 1)
    weights = rng.uniform(0.0, 1.0, 5)
    joints, names, rows, tests = ([*range(n)] for n in (q.shape[1], len(robot.parameter_names), 12, 5))
    for order in (joints, names, rows, tests):
        chance.shuffle(order)
    place = np.argsort(joints)
    elements = (e if e.joint is None else replace(e, joint=int(place[e.joint])) for e in robot.elements)
    other = replace(
        robot,
        elements=tuple(elements),
        joint_names=tuple(robot.joint_names[k] for k in joints),
        joint_limits=robot.joint_limits[joints],
        parameter_names=tuple(robot.parameter_names[k] for k in names),
    )
    model = replace(whole(np.array([4.0, 1.0, 0.5]), np.array([0.0, 0.0, 1.0])), gravity=None)
    one = accuracies(robot, model, q, poses, weights=weights)
    two = accuracies(other, model, q[rows][:, joints], poses[tests][:, joints], weights=size * weights[tests])
    np.testing.assert_allclose(two[:, 0], one[:, 0], rtol=LOOSE, atol=NOTHING * SIGMA)
    np.testing.assert_allclose(two[:, 1:], one[:, 1:][:, tests], rtol=LOOSE, atol=NOTHING * SIGMA)


@QUICK
@given(seeds)
@example(743)  # a gantry: what is uncertain of it is a rigid motion, which once counted as felt without limit
def test_without_a_rigid_motion_there_is_less_and_the_mean_is_the_mean(seed):
    """``robot`` is ``world`` less a projection; both means are quadratic; a quarter of σ² halves the paper's."""
    robot = chain_of(seed)
    q, poses = random_configurations(robot, 12, seed), random_configurations(robot, 5, seed + 1)
    one = accuracies(robot, ErrorModel.paper(Isotropic(SIGMA)), q, poses)
    np.testing.assert_allclose(one[:, 0] ** 2, np.mean(one[:, 1:] ** 2, axis=1), rtol=1e-12)
    assert one[1, 0] <= one[0, 0] * (1 + 1e-12)
    half = accuracies(robot, ErrorModel.paper(Isotropic(SIGMA / 2.0)), q, poses)
    np.testing.assert_allclose(half, one / 2.0, rtol=LOOSE, atol=NOTHING * SIGMA)
    again = Knowledge.of_plan(robot, ErrorModel.paper(Isotropic(SIGMA)), np.repeat(q, 4, axis=0)).accuracy(poses)
    if np.isfinite(one[0, 0]):
        assert again.value == pytest.approx(half[0, 0], rel=LOOSE)
