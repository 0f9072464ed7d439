"""An estimate that starts at the last one is that of the same measurements at once, whatever came and went."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from operator import attrgetter
from typing import Any

import numpy as np
import pytest

from calib_planner import IdentificationProblem, Measurements, Robot, identify
from calib_planner.errors import InputError, NotEnoughDataError
from calib_planner.identification import UPDATE, Estimate, typical_prior
from calib_planner.robot.elements import rotation
from calib_planner.simulation import SimulatedCell, random_deviations

SIGMA = 3e-5
TOLERANCE = 1e-9
"""Of values and standard deviations [m | rad], residuals [m], covariances [m² | m·rad | rad²]; absolute."""
TARGETS = np.array([[0.05, 0.02, 0.12], [-0.06, 0.04, 0.10]])


def cell(
    count: int, seed: int = 0, *, level: str = "full", unknown: tuple[str, ...] = (), targets: int = 1
) -> tuple[Robot, Measurements]:
    """What a user states of a KR-270, and measurements of one that differs by usual errors."""
    robot = Robot.load("kuka_kr270").with_targets(TARGETS[:targets])
    rng = np.random.default_rng(seed)
    real = robot.with_parameters(level)
    if "base" in unknown:
        real = real.with_base(rotation(2, 0.7) @ rotation(1, -0.2), [2.0, -1.0, 0.4])
    low, high = robot.joint_limits.T
    q = rng.uniform(low, high, (count, len(low)))
    data = SimulatedCell(real, random_deviations(real, seed, 5e-4, 1e-3), SIGMA).measure(q, 1, seed)
    stated = robot.with_targets(np.zeros((targets, 3))) if "tool" in unknown else robot
    return stated.with_parameters(level, unknown), replace(data, std=None)


def with_gross_errors(data: Measurements, seed: int = 0) -> Measurements:
    """Every seventh row is millimetres or more off."""
    p = data.p.copy()
    p[3::7] += np.random.default_rng(seed).normal(0.0, 4e-3, p[3::7].shape)
    return replace(data, points=p)


def with_gaps(data: Measurements, seed: int = 0) -> Measurements:
    """A third of the points not seen, one row of them entirely; the standard deviation of each coordinate."""
    rng = np.random.default_rng(seed)
    p = data.p.copy()
    p[rng.random(p.shape[:2]) < 0.33] = np.nan
    p[5] = np.nan
    return replace(data, points=p, std=np.where(np.isnan(p), np.nan, SIGMA * rng.uniform(0.7, 1.5, p.shape)))


def repeated(data: Measurements, seed: int = 0) -> Measurements:
    """Each configuration three times, in random order."""
    rows = np.random.default_rng(seed).permutation(np.repeat(np.arange(len(data)), 3))
    again = data.select(rows)
    noise = np.random.default_rng(seed + 1).normal(0.0, SIGMA, again.p.shape)
    return replace(again, points=again.p + noise)


def with_gross_robust() -> tuple[Robot, Measurements, dict[str, Any]]:
    robot, data = cell(28, 3, level="lengths+offsets")
    return robot, with_gross_errors(data), {"sigma": SIGMA, "loss": "robust"}


def with_prior() -> tuple[Robot, Measurements, dict[str, Any]]:
    robot, data = cell(16, 4, unknown=("base", "tool"))
    return robot, data, {"sigma": SIGMA, "prior": typical_prior(robot)}


def robust_unknown_base() -> tuple[Robot, Measurements, dict[str, Any]]:
    robot, data = cell(24, 5, level="lengths+offsets", unknown=("base",))
    return robot, with_gross_errors(data), {"sigma": SIGMA, "loss": "robust"}


def two_targets() -> tuple[Robot, Measurements, dict[str, Any]]:
    robot, data = cell(24, 6, targets=2, unknown=("base", "tool"))
    return robot, with_gaps(data), {"test_poses": [data.q[0]]}


def joint_by_joint() -> tuple[Robot, Measurements, dict[str, Any]]:
    """At first only two joints move, then three, … : full rank comes late."""
    robot = Robot.load("kuka_kr270").with_parameters("lengths+offsets")
    rng = np.random.default_rng(10)
    low, high = robot.joint_limits.T
    q = rng.uniform(low, high, (24, len(low)))
    for rows, still in ((6, 2), (10, 3), (14, 4)):
        q[:rows, still:] = q[0, still:]
    data = SimulatedCell(robot, random_deviations(robot, 10, 5e-4, 1e-3), SIGMA).measure(q, 1, 10)
    return robot, replace(data, std=None), {"sigma": SIGMA}


def repetitions() -> tuple[Robot, Measurements, dict[str, Any]]:
    robot, data = cell(12, 7, level="lengths+offsets")
    return robot, repeated(data), {}


def elastic() -> tuple[Robot, Measurements, dict[str, Any]]:
    """More than the stated noise is left: a discrepancy is estimated."""
    robot, data = cell(30, 8, level="lengths+offsets")
    return robot, data, {"sigma": SIGMA / 5}


CASES: dict[str, Callable[[], tuple[Robot, Measurements, dict[str, Any]]]] = {
    "all errors": lambda: (*cell(24, 0), {"sigma": SIGMA}),
    "noise unknown": lambda: (*cell(24, 1), {}),
    "base and tool unknown": lambda: (*cell(26, 2, unknown=("base", "tool")), {"sigma": SIGMA}),
    "robust": with_gross_robust,
    "prior": with_prior,
    "robust, base unknown": robust_unknown_base,
    "two targets, gaps, own std": two_targets,
    "repetitions": repetitions,
    "rank grows": joint_by_joint,
    "discrepancy": elastic,
    "other starts": lambda: (*cell(10, 9, level="lengths+offsets"), {"sigma": SIGMA, "starts": 2}),
}


def at_once(problem: IdentificationProblem) -> Estimate | None:
    try:
        return identify(problem)
    except NotEnoughDataError:
        return None


SAME = (
    "fit.parameters",
    "fit.status",
    "observability.fixed",
    "observability.rank",
    "observability.unidentifiable",
    "points.used",
    "points.measured",
    "diagnostics.starts",
)


def rejected(estimate: Estimate) -> list[tuple[int, int]]:
    return [(r.row, r.target) for r in estimate.points.rejected]


def assert_same(one: Estimate | None, other: Estimate | None) -> None:
    """Nothing but the time and the number of iterations may differ."""
    assert (one is None) == (other is None)
    if one is None or other is None:
        return
    assert rejected(one) == rejected(other)
    for name in SAME:
        assert attrgetter(name)(one) == attrgetter(name)(other), name
    for name in ("fit.values", "fit.std", "fit.covariance", "residuals.vectors", "accuracy.predicted"):
        a, b = attrgetter(name)(one), attrgetter(name)(other)
        np.testing.assert_allclose(a, b, rtol=0, atol=TOLERANCE, err_msg=name)
    np.testing.assert_allclose(one.residuals.normalised, other.residuals.normalised, rtol=1e-5, atol=1e-5)
    for name in ("rms", "max"):
        a, b = (getattr(e.residuals.before, name) for e in (one, other))
        assert a == pytest.approx(b, abs=TOLERANCE, nan_ok=True)
    assert one.noise.source == other.noise.source
    assert one.noise.discrepancy == pytest.approx(other.noise.discrepancy, abs=TOLERANCE)
    assert (one.verdict.level, [r.code for r in one.verdict.reasons]) == (
        other.verdict.level,
        [r.code for r in other.verdict.reasons],
    )


def updated(problem: IdentificationProblem, last: Estimate | None) -> Estimate | None:
    """The next estimate as the identifier node makes it: from the last one, once that can only be near."""
    near = (
        last is not None
        and last.fit.status != "not_converged"
        and 3 * last.points.used >= 2 * len(last.fit.parameters)
    )
    try:
        return identify(problem, last if near else None)
    except NotEnoughDataError:
        return None


def streamed(robot: Robot, data: Measurements, settings: dict[str, Any]) -> list[Estimate | None]:
    """The estimate before any configuration, and after each."""
    estimates: list[Estimate | None] = [None]
    for count in range(1, len(data) + 1):
        problem = IdentificationProblem(robot, data.select(np.arange(count)), **{**UPDATE, **settings})
        estimates.append(updated(problem, estimates[-1]))
    return estimates


@pytest.mark.parametrize("name", CASES)
def test_the_same_as_all_at_once(name: str) -> None:
    robot, data, settings = CASES[name]()
    settings = {**UPDATE, **settings}
    estimates = streamed(robot, data, settings)
    for count in (*range(1, 9), *range(9, len(data), 3), len(data)):
        problem = IdentificationProblem(robot, data.select(np.arange(count)), **settings)
        assert_same(estimates[count], at_once(problem))
    newest = estimates[-1]
    assert newest is not None and newest.fit.status != "not_converged"
    # Undo, in an order of its own, down to too few.
    rows = list(range(len(data)))
    for number in np.random.default_rng(1).permutation(len(data)).tolist()[:-1]:
        rows.remove(number)
        problem = IdentificationProblem(robot, data.select(np.array(rows)), **settings)
        newest = updated(problem, newest)
        if len(rows) % 4 == 0:
            assert_same(newest, at_once(problem))
    assert newest is None


def test_the_cases_are_what_they_are_called() -> None:
    """Gross errors are rejected, a discrepancy is found, repetitions are seen, rank grows on the way."""
    cases = {name: case() for name, case in CASES.items()}
    estimates = {name: identify(IdentificationProblem(r, d, **s)) for name, (r, d, s) in cases.items()}
    assert {row for row, _ in rejected(estimates["robust"])} >= {3, 10, 17, 24}
    assert rejected(estimates["robust, base unknown"])
    assert estimates["discrepancy"].noise.discrepancy > SIGMA / 2
    assert estimates["repetitions"].noise.repeat_freedom == 12 * 2 * 3
    ranks = [e.observability.rank for e in streamed(*cases["rank grows"]) if e is not None]
    assert ranks[0] < ranks[-1] == len(cases["rank grows"][0].parameter_names)


def test_the_order_of_coming_does_not_matter() -> None:
    robot, data = cell(20, 11, unknown=("base", "tool"))
    order = np.random.default_rng(2).permutation(20)
    one = streamed(robot, data, {"sigma": SIGMA})[-1]
    other = streamed(robot, data.select(order), {"sigma": SIGMA})[-1]
    assert one is not None and other is not None
    rows = np.argsort(order)
    vectors, normalised = other.residuals.vectors[rows], other.residuals.normalised[rows]
    back = replace(other, residuals=replace(other.residuals, vectors=vectors, normalised=normalised))
    assert_same(one, back)


def test_a_wrong_measurement_undone_leaves_no_trace() -> None:
    robot, data = cell(20, 12)
    before = streamed(robot, data, {"sigma": SIGMA})[-1]
    assert before is not None
    problem = IdentificationProblem(robot, data, SIGMA, **UPDATE)
    more = Measurements(
        data.joint_names, np.vstack([data.q, data.q[:1] + 0.3]), np.concatenate([data.p, data.p[5:6] + 0.4])
    )
    wrong = identify(replace(problem, data=more), before)
    assert np.abs(wrong.fit.values - before.fit.values).max() > 1e-3
    assert_same(identify(problem, wrong), before)


def test_joints_of_a_file_in_another_order() -> None:
    robot, data = cell(16, 16, level="lengths+offsets")
    turned = Measurements(data.joint_names[::-1], data.q[:, ::-1], data.p)
    update = identify(IdentificationProblem(robot, turned, SIGMA, **UPDATE))
    assert_same(update, identify(IdentificationProblem(robot, data, SIGMA, **UPDATE)))


def test_millimetres_are_refused_not_swallowed() -> None:
    robot, data = cell(8, 18, level="offsets")
    with pytest.raises(InputError, match="millimetres"):
        identify(IdentificationProblem(robot, replace(data, points=1e3 * data.p), **UPDATE))


def test_predicts_where_the_robot_really_is() -> None:
    """The oracle is the simulated robot itself: other poses, within what the covariance promises."""
    robot, data = cell(40, 19)
    low, high = robot.joint_limits.T
    q = np.random.default_rng(3).uniform(low, high, (50, len(low)))
    real = robot.with_parameters("full")
    truth = real.with_deviations(random_deviations(real, 19, 5e-4, 1e-3)).positions(q)
    estimate = streamed(robot, data, {"sigma": SIGMA, "test_poses": q})[-1]
    assert estimate is not None
    error = np.linalg.norm(estimate.calibrated.positions(q) - truth, axis=2)
    assert np.sqrt(np.mean(error**2)) < 2 * estimate.accuracy.overall < 1e-3


def test_what_is_left_to_the_end_changes_no_parameter() -> None:
    robot, data, settings = elastic()
    problem = IdentificationProblem(robot, data, **{**UPDATE, **settings})
    update = identify(problem)
    final = identify(replace(problem, starts=2, joint_corrections="auto"), update)
    assert (update.diagnostics.starts, final.diagnostics.starts, final.diagnostics.agreeing_starts) == (0, 2, 2)
    np.testing.assert_allclose(update.fit.values, final.fit.values, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(update.fit.std, final.fit.std, rtol=0, atol=TOLERANCE)
