# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Every derivative of the chain against an oracle that shares no code with it.

Complex step: Im f(x + ih)/h is exact to rounding for the analytic functions here. Central differences: the
error is O(h²), so the tolerance is looser.
"""

from __future__ import annotations

import numpy as np
import pytest
from robots import CASES, random_chain, random_configurations, repeats

from calib_planner.robot.elements import rotation

STEP = 1e-30


@pytest.fixture(params=sorted(CASES))
def robot(request):
    return CASES[request.param]()


@pytest.fixture
def deviations(robot):
    return np.random.default_rng(7).normal(0.0, 0.01, len(robot.parameter_names))


def complex_positions(robot, q, deviations):
    rows = robot._run(np.asarray(q), np.asarray(deviations), columns=False)
    return rows.T  # (N, 3·targets)


def test_jacobian_complex_step(robot, deviations):
    q = random_configurations(robot, 5)
    expected = np.stack(
        [
            complex_positions(robot, q, deviations + 1j * STEP * unit).imag / STEP
            for unit in np.eye(len(deviations))
        ],
        axis=-1,
    )
    np.testing.assert_allclose(robot.jacobian(q, deviations), expected, atol=2e-14)


@pytest.mark.parametrize("block", repeats(range(2), range(20)))
def test_random_chains_complex_step(block):
    """Columns of parameters and of joints of ten chains: joints about and along any axis, offsets anywhere."""
    for seed in range(10 * block, 10 * block + 10):
        robot = random_chain(seed)
        q = random_configurations(robot, 3, seed)
        wrong = np.random.default_rng(seed).normal(0.0, 0.1, len(robot.parameter_names))
        for got, steps in (
            (robot.jacobian(q, wrong), [(q + 0j, wrong + 1j * STEP * u) for u in np.eye(len(wrong))]),
            (robot.joint_jacobian(q, wrong), [(q + 1j * STEP * u, wrong + 0j) for u in np.eye(q.shape[1])]),
        ):
            expected = np.stack([complex_positions(robot, *step).imag / STEP for step in steps], axis=-1)
            np.testing.assert_allclose(got, expected, atol=1e-13 * max(1.0, np.abs(expected).max()))


def test_jacobian_central_difference(robot, deviations):
    q, h = random_configurations(robot, 5), 1e-6
    expected = np.stack(
        [
            (robot.positions(q, deviations + h * u) - robot.positions(q, deviations - h * u)) / (2 * h)
            for u in np.eye(len(deviations))
        ],
        axis=-1,
    ).reshape(5, 3 * len(robot.targets), -1)
    np.testing.assert_allclose(robot.jacobian(q, deviations), expected, atol=1e-8)


def test_joint_jacobian_complex_step(robot, deviations):
    q = random_configurations(robot, 5)
    expected = np.stack(
        [complex_positions(robot, q + 1j * STEP * unit, deviations).imag / STEP for unit in np.eye(q.shape[1])],
        axis=-1,
    )
    np.testing.assert_allclose(robot.joint_jacobian(q, deviations), expected, atol=2e-14)


def joint_derivatives(lin):
    """∂J/∂q of a linearisation by its formula, (N, 3·targets, P, joints) [m / unit / rad]."""
    p, targets, _, n = lin.columns.shape
    lay = lin.layout
    out = np.zeros((p, len(lay.joint_elements), targets, 3, n))
    for a, (ea, ra) in enumerate(zip(lay.parameter_elements, lay.parameter_rotates, strict=True)):
        for k, (ek, rk) in enumerate(zip(lay.joint_elements, lay.joint_rotates, strict=True)):
            if ek <= ea and rk:
                out[a, k] = np.cross(lin.joint_axes[k], lin.columns[a], axis=-2)
            elif ea < ek and ra:
                out[a, k] = np.cross(lin.parameter_axes[a], lin.joint_columns[k], axis=-2)
    return out.reshape(*out.shape[:2], 3 * targets, n).transpose(3, 2, 0, 1)


def test_second_derivatives_complex_step(robot, deviations):
    """∂J/∂q, all of it."""
    q = random_configurations(robot, 4)
    rows = 3 * len(robot.targets)
    expected = np.stack(
        [
            robot._run(q + 1j * STEP * unit, deviations, columns=True)[rows:]
            .imag.reshape(len(deviations), rows, -1)
            .transpose(2, 1, 0)
            / STEP
            for unit in np.eye(q.shape[1])
        ],
        axis=-1,
    )
    got = joint_derivatives(robot.linearise(q, deviations))
    np.testing.assert_allclose(got, expected, atol=5e-14)


def test_pull_back_is_the_contraction_of_the_second_derivatives(robot, deviations):
    q = random_configurations(robot, 6)
    lin = robot.linearise(q, deviations)
    weights = np.random.default_rng(1).normal(size=lin.jacobian().shape)
    expected = np.einsum("nxp,nxpk->nk", weights, joint_derivatives(lin))
    np.testing.assert_allclose(lin.pull_back(weights), expected, atol=1e-12)
    np.testing.assert_allclose(lin.pull_back_numpy(weights), expected, atol=1e-12)


def test_blocks_do_not_show(robot):
    """More configurations than fit one block give the same as one at a time, to rounding."""
    q = random_configurations(robot, 5000)
    points, jacobian = robot.positions_and_jacobian(q)
    for i in (0, 2047, 2048, 4095, 4096, 4999):
        np.testing.assert_allclose(points[i], robot.positions(q[i])[0], atol=1e-14)
        np.testing.assert_allclose(jacobian[i], robot.jacobian(q[i])[0], atol=1e-14)


@pytest.mark.parametrize("turn", [np.pi, -np.pi, np.pi / 2, 0.0, 3 * np.pi, np.nextafter(np.pi, 4)])
def test_angles_where_the_tangent_of_half_has_its_pole(robot, turn):
    """Straight against a product of rotation matrices, at and beside half a turn."""
    q = np.full((1, len(robot.joint_names)), turn)
    expected = []
    for branch in robot.targets:
        pose = np.eye(4)
        for e in (*robot.elements, *branch):
            step, amount = np.eye(4), e.sign * (e.value + (0.0 if e.joint is None else turn))
            if e.is_rotation:
                step[:3, :3] = rotation(e.axis, amount)
            else:
                step[e.axis, 3] = amount
            pose = pose @ step
        expected.append(pose[:3, 3])
    np.testing.assert_allclose(robot.positions(q)[0], expected, atol=5e-15)
