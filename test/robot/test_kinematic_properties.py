# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What kinematics of any chain must not depend on, and differences that derivatives explain without remainder.

Hypothesis draws random chains with a base pose and two targets. The differences have no truncation error: a point
turned about a parameter's axis by θ is p(θ) = c + u cos θ + v sin θ, so that p(θ) − p(θ + π) = 2 p′(θ − π/2), and
along a translation p(d + h) − p(d) = h p′(d). No code of the library is used as its own oracle.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from robots import random_chain, random_configurations, repeats

from calib_planner import Robot
from calib_planner.arrays import FloatArray
from calib_planner.robot.elements import rotation

HEAD = Robot.load("planar_2r").elements[:9]
"""The elements that place a base, as the readers put them in front of every chain."""
QUICK = settings(max_examples=repeats(25, 400), deadline=None, derandomize=True)
seeds = st.integers(0, 100_000)
angle = st.floats(-3.0, 3.0)
motions = st.tuples(angle, angle, angle, st.lists(st.floats(-5.0, 5.0), min_size=3, max_size=3).map(np.array))
scales = st.sampled_from([1e-3, 0.0254, 0.3048, 10.0, 1e3])


def chain_of(seed: int) -> Robot:
    """A random chain placed somewhere, two targets, parameters of base and targets among the active ones."""
    robot, rng = random_chain(seed), np.random.default_rng(seed)
    robot = replace(robot, elements=(*HEAD, *robot.elements)).with_targets(rng.normal(0.0, 0.3, (2, 3)))
    names = tuple(rng.permutation(["base.x", "base.ry", *robot.parameter_names, "target_2.y"]).tolist())
    return replace(robot, parameter_names=names)


def matrix_of(motion: tuple[float, float, float, FloatArray]) -> FloatArray:
    return rotation(2, motion[0]) @ rotation(1, motion[1]) @ rotation(0, motion[2])


def turned(columns: FloatArray, matrix: FloatArray) -> FloatArray:
    """(N, 3·targets, P) columns with every vector turned by ``matrix`` (3, 3)."""
    n, rows, p = columns.shape
    return np.einsum("ij,ntjp->ntip", matrix, columns.reshape(n, rows // 3, 3, p)).reshape(n, rows, p)


@QUICK
@given(seeds, motions, motions)
def test_everything_moves_with_the_base(seed, first, then):
    """Points, axes and columns of the chain turn with the base, whatever its pose was before."""
    motion, shift = matrix_of(then), then[3]
    one = chain_of(seed).with_base(matrix_of(first), first[3])
    other = one.with_base(motion @ matrix_of(first), motion @ first[3] + shift)
    q = random_configurations(one, 3, seed)
    np.testing.assert_allclose(other.positions(q), one.positions(q) @ motion.T + shift, atol=1e-12)
    np.testing.assert_allclose(other.joint_jacobian(q), turned(one.joint_jacobian(q), motion), atol=1e-12)
    chain = [i for i, n in enumerate(one.parameter_names) if not n.startswith("base.")]
    np.testing.assert_allclose(
        other.jacobian(q)[:, :, chain], turned(one.jacobian(q)[:, :, chain], motion), atol=1e-12
    )
    before, after = one.posture(q), other.posture(q)
    np.testing.assert_allclose(after.joint_axes, before.joint_axes @ motion.T, atol=1e-12)
    np.testing.assert_allclose(after.joint_origins, before.joint_origins @ motion.T + shift, atol=1e-12)
    np.testing.assert_allclose(after.tip_rotation, motion @ before.tip_rotation, atol=1e-12)


@QUICK
@given(seeds, st.randoms(use_true_random=False))
def test_order_of_joints_parameters_and_targets_only_orders(seed, chance):
    """Joints numbered, parameters and targets listed in another order: the same numbers in that order."""
    one = chain_of(seed)
    joints, names, swap = [*range(len(one.joint_names))], [*range(len(one.parameter_names))], [1, 0]
    chance.shuffle(joints)
    chance.shuffle(names)
    place = np.argsort(joints)
    other = replace(
        one,
        elements=tuple(e if e.joint is None else replace(e, joint=int(place[e.joint])) for e in one.elements),
        joint_names=tuple(one.joint_names[k] for k in joints),
        joint_limits=one.joint_limits[joints],
        parameter_names=tuple(one.parameter_names[k] for k in names),
        targets=one.targets[::-1],  # each with its parameters' names
    )
    q = random_configurations(one, 3, seed)
    rows = np.arange(6).reshape(2, 3)[swap].ravel()
    np.testing.assert_allclose(other.positions(q[:, joints]), one.positions(q)[:, swap], atol=1e-13)
    columns = one.jacobian(q)[:, rows][:, :, names]
    np.testing.assert_allclose(other.jacobian(q[:, joints]), columns, atol=1e-13)
    columns = one.joint_jacobian(q)[:, rows][:, :, joints]
    np.testing.assert_allclose(other.joint_jacobian(q[:, joints]), columns, atol=1e-13)


@QUICK
@given(seeds, scales)
def test_lengths_in_another_unit_scale_what_has_a_length(seed, unit):
    """Points, and columns of angles, are lengths; columns of lengths are lengths per length."""
    one = chain_of(seed)

    def scaled(elements):
        return tuple(e if e.is_rotation else replace(e, value=e.value * unit) for e in elements)

    other = replace(one, elements=scaled(one.elements), targets=tuple(map(scaled, one.targets)))
    q = random_configurations(one, 3, seed)
    there = np.where(one.joint_is_revolute, q, q * unit)
    per_parameter = np.array([unit if p.unit == "rad" else 1.0 for p in one.parameters])
    per_joint = np.where(one.joint_is_revolute, unit, 1.0)
    atol = 1e-12 * max(unit, 1.0)
    np.testing.assert_allclose(other.positions(there), one.positions(q) * unit, rtol=1e-12, atol=1e-13 * unit)
    np.testing.assert_allclose(other.jacobian(there), one.jacobian(q) * per_parameter, rtol=1e-11, atol=atol)
    np.testing.assert_allclose(
        other.joint_jacobian(there), one.joint_jacobian(q) * per_joint, rtol=1e-11, atol=atol
    )


@QUICK
@given(seeds, st.floats(-2.0, 2.0))
def test_differences_are_what_the_columns_say(seed, step):
    """Half a turn, or a step, of every parameter and every joint; see the top. Other parameters are off, too."""
    robot = chain_of(seed)
    q, count = random_configurations(robot, 2, seed), len(robot.parameter_names)
    wrong = np.random.default_rng(seed).normal(0.0, 0.2, count)

    def points(at, deviations):
        return robot.positions(at, deviations).reshape(len(at), -1)

    for k, parameter in enumerate(robot.parameters):
        e = np.eye(count)[k]
        if parameter.unit == "rad":
            gap = points(q, wrong) - points(q, wrong + np.pi * e)
            told = 2.0 * robot.jacobian(q, wrong - 0.5 * np.pi * e)[:, :, k]
        else:
            gap = points(q, wrong + step * e) - points(q, wrong)
            told = step * robot.jacobian(q, wrong)[:, :, k]
        np.testing.assert_allclose(told, gap, atol=2e-13, err_msg=parameter.name)
    for k, turns in enumerate(robot.joint_is_revolute):
        e = np.eye(q.shape[1])[k]
        if turns:
            gap = points(q, wrong) - points(q + np.pi * e, wrong)
            told = 2.0 * robot.joint_jacobian(q - 0.5 * np.pi * e, wrong)[:, :, k]
        else:
            gap = points(q + step * e, wrong) - points(q, wrong)
            told = step * robot.joint_jacobian(q, wrong)[:, :, k]
        np.testing.assert_allclose(told, gap, atol=2e-13, err_msg=robot.joint_names[k])
