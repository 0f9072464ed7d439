"""Disturbances that were put into the data are found with their row, kind and size; without, nothing is."""

from __future__ import annotations

import numpy as np
import pytest

from calib_planner import Measurements, Robot
from calib_planner.errors import InputError
from calib_planner.identification import NoiseLevels, configuration_labels
from calib_planner.identification.checks import (
    Disturbance,
    check_order,
    rejected_since,
    wholly_whitened,
)
from calib_planner.identification.least_squares import Equations, gauss_newton, point_whitening
from calib_planner.simulation import random_deviations

SIGMA = 1e-5


def robot(targets: int) -> Robot:
    offsets = [[0.1, 0.0, 0.2], [-0.1, 0.1, 0.2], [0.0, -0.2, 0.1]][:targets]
    return Robot.load("kuka_kr270").with_targets(offsets).with_parameters("lengths+offsets")


def measured(seed: int, count: int = 24, targets: int = 1) -> tuple[Robot, np.ndarray, np.ndarray]:
    """Robot, configurations in any order, noisy points of a robot with true errors."""
    model, rng = robot(targets), np.random.default_rng(seed)
    low, high = model.joint_limits.T
    q = rng.uniform(low, high, (count, len(low)))
    truth = model.with_deviations(random_deviations(model, seed))
    return model, q, truth.positions(q) + SIGMA * rng.standard_normal((count, targets, 3))


def asked(model: Robot, q: np.ndarray, points: np.ndarray, stated: float = SIGMA, order=None):
    """The answers, and the equations and where their fit ended."""
    data = Measurements(model.joint_names, q, points)
    whitening = point_whitening(np.broadcast_to(stated**2 * np.eye(3), (*points.shape, 3)), data.seen)
    equations = Equations(model, data, data.seen, whitening)
    kept = tuple(range(len(model.parameter_names)))
    fit = gauss_newton(equations, np.zeros(len(kept)), kept, 50)
    return check_order(equations, fit.deviations, kept, fit.covariance(), order), equations, fit


def vector(seed: int, size: float) -> np.ndarray:
    raw = np.random.default_rng([seed, 9]).standard_normal(3)
    return size * raw / np.linalg.norm(raw)


def disturbed(kind: str, model: Robot, q: np.ndarray, points: np.ndarray, row: int, by: np.ndarray) -> np.ndarray:
    after = np.arange(len(q)) >= row
    if kind == "drift":
        return points + np.linspace(0, 1, len(q))[:, None, None] * by
    if kind == "bump":
        return points + after[:, None, None] * by
    offsets = np.array(model.target_offsets)
    offsets[0] += by
    return points + after[:, None, None] * (model.with_targets(offsets).positions(q) - model.positions(q))


def test_without_a_disturbance_probabilities_are_such() -> None:
    found = [asked(*measured(seed))[0][0].probability for seed in range(60)]
    # Bonferroni counts neighbouring rows as questions of their own: no more alarms than stated, some fewer.
    assert np.mean(np.array(found) < 0.2) <= 0.35 and min(found) > 1e-4


@pytest.mark.parametrize("stated", [0.1 * SIGMA, 10 * SIGMA])
def test_the_noise_level_does_not_matter(stated: float) -> None:
    one, other = asked(*measured(3))[0], asked(*measured(3), stated)[0]
    assert [d.kind for d in one] == [d.kind for d in other]
    assert np.allclose([d.probability for d in one], [d.probability for d in other], rtol=1e-6)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("targets", [1, 3])
@pytest.mark.parametrize("kind", ["drift", "bump", "reseat"])
def test_what_happened_is_found(kind: str, targets: int, seed: int) -> None:
    model, q, points = measured(seed, targets=targets)
    row, by = 5 + 4 * seed, vector(seed, 2e-4)
    best = asked(model, q, disturbed(kind, model, q, points, row, by))[0][0]
    assert best.kind == kind and best.certain
    assert best.row == (None if kind == "drift" else row)
    assert best.target == (1 if kind == "reseat" else None)
    # The station's motion is that of the points' centre; 0.05 mm are several standard deviations of it.
    assert np.linalg.norm(best.translation - by) < 5e-5
    assert np.linalg.norm(best.rotation) < 5e-5


def test_a_station_that_turned() -> None:
    model, q, points = measured(1, targets=3)
    centre, turn = points.reshape(-1, 3).mean(axis=0), np.array([1e-4, -2e-4, 5e-5])
    moved = points + (np.arange(len(q)) >= 9)[:, None, None] * np.cross(turn, points - centre)
    best = asked(model, q, moved)[0][0]
    assert (best.kind, best.row) == ("bump", 9)
    assert np.allclose(best.rotation, turn, atol=3e-5) and np.linalg.norm(best.translation) < 5e-5


def test_the_numbers_are_those_of_the_larger_least_squares_problem() -> None:
    """Oracle: columns of the bump beside those of the parameters, solved at once."""
    model, q, points = measured(2)
    row = 11
    found, equations, fit = asked(model, q, disturbed("bump", model, q, points, row, vector(2, 1e-4)))
    best = found[0]
    assert (best.kind, best.row) == ("bump", row)
    residuals, jacobian = equations.linearise(fit.deviations)
    here = model.with_deviations(dict(zip(model.parameter_names, fit.deviations, strict=True)))
    beside = here.positions(q)[:, 0] - here.positions(q).mean(axis=(0, 1))
    columns = np.zeros((len(q), 3, 6))
    for i in range(row, len(q)):
        columns[i, :, :3] = np.eye(3)
        x, y, z = beside[i]
        columns[i, :, 3:] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
    columns = columns.reshape(-1, 6) / SIGMA
    solution = np.linalg.lstsq(np.hstack([jacobian, columns]), residuals, rcond=None)[0]
    assert np.allclose(best.translation, solution[-6:-3], atol=1e-9)
    assert np.allclose(best.rotation, solution[-3:], atol=1e-9)
    moved = np.abs(solution[:-6]) / np.sqrt(np.diag(fit.covariance()))
    assert best.shift == pytest.approx(moved.max(), rel=1e-3)
    assert best.parameter == model.parameter_names[int(np.argmax(moved))]


def test_rows_in_another_order_than_measured() -> None:
    model, q, points = measured(4)
    row = 10
    points = disturbed("bump", model, q, points, row, vector(4, 1e-4))
    shuffle = np.random.default_rng(0).permutation(len(q))
    best = asked(model, q[shuffle], points[shuffle], order=100.0 + 5.0 * shuffle)[0][0]
    assert best.kind == "bump" and best.row is not None and shuffle[best.row] == row
    blind = asked(model, q[shuffle], points[shuffle])[0][0]
    assert blind.probability > 1e3 * best.probability


def test_bad_orders_are_refused() -> None:
    for order in (np.arange(3.0), np.full(24, np.nan)):
        with pytest.raises(InputError, match="order"):
            asked(*measured(0), order=order)


@pytest.mark.parametrize(
    ("probability", "shift", "matters"),
    [(1e-9, 0.5, False), (1e-9, 1.5, True), (5e-3, 1.5, False), (5e-3, 3.5, True), (2e-2, 9.0, False)],
)
def test_what_deserves_a_warning(probability: float, shift: float, matters: bool) -> None:
    found = Disturbance("drift", None, None, probability, np.zeros(3), np.zeros(3), shift, "d1")
    assert found.certain == (probability < 1e-3) and found.matters == matters


def test_too_little_to_tell() -> None:
    model, q, points = measured(0, count=4)
    assert asked(model, q, points)[0] == ()


def test_unseen_points_are_left_out() -> None:
    model, q, points = measured(5, targets=3)
    points = disturbed("reseat", model, q, points, 12, vector(5, 2e-4))
    points[3, 1] = np.nan
    points[12, 0] = np.nan
    best = asked(model, q, points)[0][0]
    # Row 12 did not see the target: the first to show it is row 13.
    assert (best.kind, best.row, best.target) == ("reseat", 13, 1)


def test_what_a_configuration_shares_is_no_drift() -> None:
    """Repetitions one after the other share an error that no geometry holds."""
    alarms = {"point by point": 0, "wholly": 0}
    for seed in range(20):
        model, q, points = measured(seed, count=12)
        own = 1e-3 * np.random.default_rng([seed, 3]).standard_normal((12, 1, 3))
        q, points = np.repeat(q, 4, axis=0), np.repeat(points + own, 4, axis=0)
        points = points + SIGMA * np.random.default_rng([seed, 4]).standard_normal(points.shape)
        found, equations, fit = asked(model, q, points)
        alarms["point by point"] += found[0].certain
        levels = NoiseLevels(SIGMA, "sigma", point=1e-3, discrepancy=1e-3)
        instrument = np.broadcast_to(SIGMA**2 * np.eye(3), (*points.shape, 3))
        whole = wholly_whitened(equations, instrument, levels, configuration_labels(q))
        kept = tuple(range(len(model.parameter_names)))
        alarms["wholly"] += check_order(whole, fit.deviations, kept, fit.covariance())[0].certain
    assert alarms["wholly"] == 0 < alarms["point by point"]


@pytest.mark.parametrize(
    ("rejected", "row"),
    [
        ([], None),
        ([19, 20, 21, 22, 23], 19),
        ([3, 20, 21, 22, 23], None),
        ([18, 19, 20, 21, 22], None),
        ([23], None),
    ],
)
def test_rejected_from_a_row_on(rejected: list[int], row: int | None) -> None:
    seen = np.ones((24, 2), bool)
    use = seen.copy()
    use[rejected] = False
    assert rejected_since(seen, use) == row
    backwards = np.arange(24)[::-1]
    assert rejected_since(seen[::-1], use[::-1], backwards) == (None if row is None else 23 - row)
