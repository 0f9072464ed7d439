# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The compiled kernel does what NumPy does: NumPy is the oracle, and complex numbers stay with it."""

from __future__ import annotations

import numpy as np
import pytest
from robots import mixed, random_configurations

from calib_planner import Robot
from calib_planner.robot import kinematics

pytestmark = pytest.mark.skipif(kinematics._kernel is None, reason="the kernel is not built here")


def programs(robot: Robot, seed: int) -> tuple[kinematics.Program, np.ndarray]:
    """Positions, columns and axes of everything, with amounts off their nominal values."""
    rng = np.random.default_rng(seed)
    nominal = robot._nominal_amounts
    amounts = nominal + 1e-3 * rng.standard_normal(len(nominal))
    wanted = robot._layout.parameter_elements + robot._layout.joint_elements
    return robot._program(amounts, wanted, wanted), amounts


@pytest.mark.parametrize("count", [0, 1, 2, 127, 128, 129, 1000])
@pytest.mark.parametrize("name", ["planar_2r", "kuka_kr270", "ur10e"])
def test_equal_to_numpy(name: str, count: int) -> None:
    robot = (
        Robot.load(name)
        .with_targets([[0.1, 0.0, 0.2], [0.0, 0.1, 0.1]])
        .with_parameters("full", ("base", "tool"))
    )
    program, amounts = programs(robot, count)
    q = np.ascontiguousarray(random_configurations(robot, max(count, 1), count)[:count].T)
    np.testing.assert_allclose(program.run(q, amounts), program.run_numpy(q, amounts), rtol=0, atol=1e-13)


@pytest.mark.parametrize("size", [1e-300, 1e-8, 1.0, 1e3, 9.99e4, 1.01e5, 1e7, 1e15])
def test_angles_of_any_size(size: float) -> None:
    robot = Robot.load("planar_2r")
    program, amounts = robot._program(robot._nominal_amounts, (), ()), robot._nominal_amounts
    q = size * np.random.default_rng(0).uniform(-1, 1, (2, 300))
    points = program.run(q, amounts).reshape(-1, 3, 300)[0]
    exact = program.run_numpy(np.ascontiguousarray(np.remainder(q, 2 * np.pi)), amounts).reshape(-1, 3, 300)[0]
    assert np.abs(points - exact).max() < 1e-13 + 4 * size * np.finfo(float).eps


def test_quarter_turns_and_their_neighbours() -> None:
    robot = Robot.load("kuka_kr270")
    program, amounts = robot._program(robot._nominal_amounts, (), ()), robot._nominal_amounts
    turns = np.repeat(np.arange(-40, 41) * (np.pi / 4), 3)
    turns[0::3] = np.nextafter(turns[0::3], -np.inf)
    turns[2::3] = np.nextafter(turns[2::3], np.inf)
    q = np.ascontiguousarray(np.tile(turns, (6, 1)))
    np.testing.assert_allclose(program.run(q, amounts), program.run_numpy(q, amounts), rtol=0, atol=2e-14)


def test_what_is_not_finite_stays_so() -> None:
    robot = Robot.load("planar_2r")
    program = robot._program(robot._nominal_amounts, (), ())
    q = np.array([[np.nan, np.inf, 0.1], [0.2, 0.3, 0.4]])
    out = program.run(q, robot._nominal_amounts)
    assert np.isnan(out[:2, :2]).all() and np.isfinite(out[:, 2]).all()


def test_wrong_arrays_are_refused() -> None:
    robot = Robot.load("planar_2r")
    program, amounts = robot._program(robot._nominal_amounts, (), ()), robot._nominal_amounts
    q, out = np.zeros((2, 4)), np.empty((program.rows, 4))
    run = kinematics._kernel.run
    for bad in (
        (program.code[:-1], amounts, q, out),
        (program.code.astype(float), amounts, q, out),
        (program.code, amounts, q[:, :3].copy(), out),
        (program.code, amounts, q, out[:, :3]),
        (program.code, amounts, q.astype(np.float32), out),
    ):
        with pytest.raises((ValueError, BufferError)):
            run(*bad)
    with pytest.raises(TypeError):
        run(program.code, amounts, q)


def test_complex_numbers_are_numpys() -> None:
    robot = Robot.load("kuka_kr270")
    program, amounts = robot._program(robot._nominal_amounts, (), ()), robot._nominal_amounts
    q = np.full((6, 1), 0.3 + 1e-30j)
    assert np.iscomplexobj(program.run(q, amounts))


@pytest.mark.parametrize("count", [0, 1, 31, 32, 33, 200])
@pytest.mark.parametrize("name", ["planar_2r", "kuka_kr270", "ur10e", "mixed"])
def test_pull_back_equal_to_numpy(name: str, count: int) -> None:
    robot = mixed() if name == "mixed" else Robot.load(name).with_targets([[0.1, 0.0, 0.2], [0.0, 0.1, 0.1]])
    lin = robot.with_parameters("full", ("base", "tool")).linearise(
        random_configurations(robot, count + 1)[:count]
    )
    rows, parameters = 3 * len(robot.targets), len(lin.columns)
    weights = np.random.default_rng(0).standard_normal((count, rows, parameters + 2))
    expected = lin.pull_back_numpy(weights)
    got = lin.pull_back(weights)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * max(1.0, np.abs(expected).max(initial=0.0)))
    if count < 2:
        return
    arrays = (lin.columns, lin.parameter_axes, lin.joint_columns, lin.joint_axes, weights, np.empty(got.shape))
    for place in range(6):
        bad = [a[:-1].copy() if k == place else a for k, a in enumerate(arrays)]
        with pytest.raises(ValueError, match="fit"):
            kinematics._kernel.pull_back(lin.layout.code, *bad)
