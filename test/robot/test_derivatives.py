"""Every derivative of the chain against an oracle that shares no code with it.

Complex step: Im f(x + ih)/h is exact to rounding for the analytic functions here. Central differences: the
error is O(h²), so the tolerance is looser.
"""

from __future__ import annotations

import numpy as np
import pytest
from robots import CASES, random_configurations

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
    got = robot.linearise(q, deviations).jacobian_joint_derivatives()
    np.testing.assert_allclose(got, expected, atol=5e-14)


def test_pull_back_is_the_contraction_of_the_second_derivatives(robot, deviations):
    q = random_configurations(robot, 6)
    lin = robot.linearise(q, deviations)
    weights = np.random.default_rng(1).normal(size=lin.columns.shape)
    flat = weights.reshape(len(weights), -1, len(q))
    expected = np.einsum("pxn,nxpk->nk", flat, lin.jacobian_joint_derivatives())
    np.testing.assert_allclose(lin.pull_back(weights), expected, atol=1e-12)


def test_blocks_do_not_show(robot):
    """More configurations than fit one block give the same as one at a time."""
    q = random_configurations(robot, 2500)
    points, jacobian = robot.positions_and_jacobian(q)
    for i in (0, 1023, 1024, 2499):
        np.testing.assert_array_equal(points[i], robot.positions(q[i])[0])
        np.testing.assert_array_equal(jacobian[i], robot.jacobian(q[i])[0])
