# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What an identification must not depend on, and what it must: tracker, order, units, amount of data.

Each property holds for any data; the data are random, with seeds. The paper's model with a stated σ is exact, so
that nothing is left to iterations; the typical model is compared to what its own iterations resolve.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from robots import mixed, random_chain, random_configurations, repeats

from calib_planner import Estimate, IdentificationProblem, Measurements, NotEnoughDataError, Robot, identify
from calib_planner.error_model import ErrorModel
from calib_planner.robot.elements import rotation
from calib_planner.simulation import SimulatedCell, random_deviations

SIGMA = 3e-5
PAPER = ErrorModel.paper()
TURN = rotation(2, 2.1) @ rotation(0, -0.7) @ rotation(1, 0.4)
SHIFT = np.array([3.0, -1.0, 0.7])
LOOSE = {"paper": 1e-9, "typical": 2e-3}
"""How near two estimates of the same have to be, in predicted standard deviations: rounding, and for the typical
model the step at which its iterations over scales end (1 % of a logarithm, of second order in the values)."""


def placed_chain(seed: int) -> Robot:
    """A random chain with the nine elements that place its base, as the readers put them in front."""
    robot, head = random_chain(seed), Robot.load("planar_2r").elements[:9]
    return replace(robot, elements=(*head, *robot.elements)).with_base(TURN, SHIFT)


def measured(robot: Robot, count: int, seed: int) -> Measurements:
    """``count`` visits to a robot with hidden errors, one point in ten not seen."""
    data = SimulatedCell(robot, random_deviations(robot, seed), SIGMA).measure(
        random_configurations(robot, count, seed), 1, seed
    )
    points = np.array(data.p)
    points[np.random.default_rng(seed).random(points.shape[:2]) < 0.1] = np.nan
    return Measurements(data.joint_names, data.q, points)


def identified(robot: Robot, data: Measurements, model: str = "paper", **options: object) -> Estimate:
    chosen = {"error_model": PAPER, "sigma": SIGMA} if model == "paper" else {}
    return identify(IdentificationProblem(robot, data, **(chosen | options)))  # type: ignore[arg-type]


def chain_names(estimate: Estimate) -> list[int]:
    return [i for i, n in enumerate(estimate.fit.parameters) if not n.startswith("base.")]


def assert_alike(one: Estimate, other: Estimate, within: float, order: list[int] | None = None) -> None:
    """Same values, standard deviations and predictions, in the order of the names of ``one``."""
    at = [other.fit.parameters.index(n) for n in one.fit.parameters] if order is None else order
    std, there = one.fit.std, np.isfinite(one.fit.std)
    assert there.any()
    np.testing.assert_array_equal(there, np.isfinite(other.fit.std[at]))
    apart = np.abs(one.fit.deviations - other.fit.deviations[at])[there] / std[there]
    assert apart.max() <= within
    np.testing.assert_allclose(other.fit.std[at][there], std[there], rtol=max(within, 1e-7))
    assert other.residuals.after.rms == pytest.approx(one.residuals.after.rms, rel=max(within, 1e-7))


@pytest.mark.parametrize("model", LOOSE)
def test_it_does_not_matter_where_the_tracker_stands(model: str) -> None:
    """Points moved rigidly: the chain's parameters stay, and predictions move with the points."""
    robot = mixed().with_parameters("offsets", ("base",))
    data = measured(robot, 30, 1)
    moved = replace(data, points=data.p @ TURN.T + SHIFT)
    one, other = identified(robot, data, model), identified(robot, moved, model)
    chain = chain_names(one)
    std = one.fit.std[chain]
    there = np.isfinite(std)
    apart = np.abs(one.fit.deviations - other.fit.deviations)[chain][there] / std[there]
    assert there.any() and apart.max() <= 100 * LOOSE[model]
    np.testing.assert_allclose(other.fit.std[chain][there], std[there], rtol=1e-5)
    q = random_configurations(robot, 20, 2)
    expected = one.positions(q) @ TURN.T + SHIFT
    np.testing.assert_allclose(other.positions(q), expected, atol=SIGMA * 100 * LOOSE[model])


@pytest.mark.parametrize("model", LOOSE)
def test_the_order_of_rows_joints_and_targets_does_not_matter(model: str) -> None:
    robot = mixed()
    data = measured(robot, 30, 3)
    rows = np.random.default_rng(4).permutation(len(data))
    shuffled = data.select(rows).in_order_of(robot.joint_names[::-1])
    swapped = replace(shuffled, points=shuffled.p[:, ::-1])
    turned = robot.with_targets(robot.target_offsets[::-1])
    test_poses = random_configurations(robot, 3, 5)
    one = identified(robot, data, model, test_poses=test_poses)
    other = identified(turned, swapped, model, test_poses=test_poses)
    assert_alike(one, other, LOOSE[model] * 10)
    np.testing.assert_allclose(other.accuracy.predicted, one.accuracy.predicted, rtol=1e-3)
    np.testing.assert_allclose(
        other.residuals.vectors[:, ::-1][np.argsort(rows)], one.residuals.vectors, atol=SIGMA * LOOSE[model] * 30
    )


@pytest.mark.parametrize("seed", repeats(range(3), range(40)))
def test_more_data_never_make_it_less_certain(seed: int) -> None:
    """With the same model, M only grows by a row: no parameter and no prediction becomes less certain."""
    robot = placed_chain(seed)
    data, poses = measured(robot, 20, seed), random_configurations(robot, 4, seed + 1)
    try:
        sizes = [identified(robot, data.select(range(n)), test_poses=poses) for n in (12, 16, 20)]
    except NotEnoughDataError:
        pytest.fail("twelve visits are enough for any of these chains")
    for fewer, more in itertools.pairwise(sizes):
        assert more.observability.rank >= fewer.observability.rank
        before, after = fewer.accuracy.predicted, more.accuracy.predicted
        finite = np.isfinite(before)
        assert (after[finite] <= before[finite] * (1 + 1e-4)).all()  # J is taken at another estimate
        if fewer.observability.fixed == more.observability.fixed:
            known = np.isfinite(fewer.fit.std) & (fewer.fit.std < 1e-2)
            assert (more.fit.std[known] <= fewer.fit.std[known] * (1 + 1e-3)).all()


@pytest.mark.parametrize("unit", [1e-2, 1e2])
def test_lengths_in_another_unit_scale_lengths_and_leave_angles(unit: float) -> None:
    """Chain, points and σ times ``unit``: deviations that are lengths scale, angles stay."""
    robot = Robot.load("kuka_kr270")
    data = measured(robot, 25, 6)
    elements = tuple(replace(e, value=e.value * unit) if e.kind.startswith("T") else e for e in robot.elements)
    scaled = replace(robot, elements=elements).with_targets(robot.target_offsets * unit)
    scaled = scaled.with_parameters(list(robot.parameter_names))
    one = identified(robot, data)
    other = identify(
        IdentificationProblem(scaled, replace(data, points=data.p * unit), sigma=SIGMA * unit, error_model=PAPER)
    )
    factor = np.array([unit if p.unit == "m" else 1.0 for p in robot.parameters])
    assert {p.unit for p in robot.parameters} == {"m", "rad"} and np.isfinite(one.fit.std).all()
    apart = np.abs(other.fit.deviations / factor - one.fit.deviations) / one.fit.std
    assert apart.max() < 1e-5
    np.testing.assert_allclose(other.fit.std / factor, one.fit.std, rtol=1e-6)


@pytest.mark.parametrize("seed", repeats(range(2), range(20)))
def test_a_larger_sigma_scales_what_is_uncertain_and_moves_nothing(seed: int) -> None:
    robot = placed_chain(seed)
    data = measured(robot, 20, seed)
    one, other = identified(robot, data), identified(robot, data, sigma=3 * SIGMA)
    there = np.isfinite(one.fit.std)
    apart = np.abs(other.fit.deviations - one.fit.deviations)[there] / one.fit.std[there]
    assert there.any() and apart.max() < 1e-6
    np.testing.assert_allclose(other.fit.std[there], 3 * one.fit.std[there], rtol=1e-7)


@pytest.mark.parametrize("seed", repeats(range(2), range(20)))
def test_the_same_data_twice_halve_the_variances_and_move_nothing(seed: int) -> None:
    """Information is a sum over the rows: flat parameters and independent noise leave nothing else."""
    robot = placed_chain(seed)
    data, poses = measured(robot, 20, seed), random_configurations(robot, 4, seed + 1)
    twice = Measurements(data.joint_names, np.tile(data.q, (2, 1)), np.tile(data.p, (2, 1, 1)))
    one, other = (identified(robot, d, test_poses=poses, loss="linear") for d in (data, twice))
    there = np.isfinite(one.fit.std)
    apart = np.abs(other.fit.deviations - one.fit.deviations)[there] / one.fit.std[there]
    assert there.any() and apart.max() < 1e-6
    np.testing.assert_allclose(other.fit.std[there], one.fit.std[there] / np.sqrt(2.0), rtol=1e-7)
    np.testing.assert_allclose(other.accuracy.predicted, one.accuracy.predicted / np.sqrt(2.0), rtol=1e-7)
