# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What the data cannot see is named exactly, fixed in a stated order, and never hidden behind a number."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest
from cells import SIGMA, bare
from robots import CASES, mixed, random_configurations, repeats

from calib_planner import IdentificationProblem, Measurements, Robot, identify
from calib_planner.error_model import ErrorModel, Prior, typical_prior
from calib_planner.errors import CalibPlannerError
from calib_planner.robot import analyse, describe, is_nuisance
from calib_planner.simulation import SimulatedCell, random_deviations

UNKNOWN = {"": (), " base": ("base",), " base tool": ("base", "tool")}
ROBOTS = dict(CASES) | {
    f"{name} {level}{words}": lambda name=name, level=level, unknown=unknown: Robot.load(name).with_parameters(
        level, unknown
    )
    for name in ("kuka_kr270", "planar_2r", "ur10e")
    for level in ("offsets", "lengths", "lengths+offsets", "full")
    for words, unknown in UNKNOWN.items()
}


def stacked(robot: Robot, count: int = 40, seed: int = 1) -> np.ndarray:
    """(equations, P) Jacobian at random configurations."""
    q = random_configurations(robot, count, seed)
    return np.ascontiguousarray(robot.jacobian(q)).reshape(-1, len(robot.parameter_names))


@pytest.mark.parametrize("name", ROBOTS)
def test_directions_are_the_null_space(name):
    """Against the singular value decomposition of unit columns."""
    robot = ROBOTS[name]()
    jacobian = stacked(robot)
    found = analyse(jacobian, robot.parameter_names)
    norms = np.linalg.norm(jacobian, axis=0)
    scale = np.where(norms > 1e-9, norms, 1.0)
    _, values, vt = np.linalg.svd(jacobian / scale)
    rank = int(np.sum(values > 1e-6))
    assert found.rank == rank == len(robot.parameter_names) - len(found.fixed)
    assert values[rank - 1] > 1e-4  # nothing here is a matter of opinion
    np.testing.assert_allclose(jacobian @ found.directions.T, 0.0, atol=1e-12)
    null = vt[rank:] / scale
    stack = np.vstack([null, found.directions]) * scale
    stack /= np.linalg.norm(stack, axis=1)[:, None]
    if len(null):
        assert np.linalg.matrix_rank(stack, tol=1e-6) == len(null)
    assert np.linalg.matrix_rank((jacobian / scale)[:, list(found.free)], tol=1e-6) == rank
    for i, direction, words in zip(found.fixed, found.directions, found.combinations, strict=True):
        assert direction[i] == 1.0
        others = [robot.parameter_names[k] for k in np.flatnonzero(direction) if k != i]
        assert set(others) <= {robot.parameter_names[k] for k in found.free}
        assert words.startswith(robot.parameter_names[i] if not others else f"1·{robot.parameter_names[i]}")


@pytest.mark.parametrize("name", ROBOTS)
def test_priority_is_base_and_targets_then_the_request(name):
    """Each parameter is kept if and only if those before it leave something of its column."""
    robot = ROBOTS[name]()
    jacobian, names = stacked(robot), robot.parameter_names
    placed = [i for i, n in enumerate(names) if is_nuisance(n)]
    order = placed + [i for i in range(len(names)) if i not in placed]
    norms = np.linalg.norm(jacobian, axis=0)
    unit = jacobian / np.where(norms > 1e-9, norms, np.inf)
    kept: list[int] = []
    for i in order:
        if np.linalg.matrix_rank(unit[:, [*kept, i]], tol=1e-6) > len(kept):
            kept.append(i)
    assert analyse(jacobian, names).free == tuple(kept)


def test_the_request_decides_between_two_that_are_one():
    """q1 and base.rz turn the same; without the base, the one asked for first is kept."""
    robot = Robot.load("planar_2r").with_parameters("full")
    first, second = robot.parameter_names, robot.parameter_names[::-1]
    fixed = [set(np.array(names)[list(analyse(stacked(robot.with_parameters(names)), names).fixed)])
            for names in (first, second)]  # fmt: skip
    assert fixed[0] != fixed[1] and len(fixed[0]) == len(fixed[1]) == 2


def test_small_shares_are_left_out_of_the_words_only():
    jacobian = np.vstack([np.eye(3), np.zeros((2, 3))])
    jacobian[:, 2] = jacobian[:, 0] * 2.0 + jacobian[:, 1] * 1e-5
    found = analyse(jacobian, ("a", "b", "c"))
    assert found.combinations == ("1·c - 2·a",)
    np.testing.assert_allclose(jacobian @ found.directions[0], 0.0, atol=1e-15)
    assert describe(np.array([0.0, -0.5, 1.0]), ("a", "b", "c"), 2) == "1·c - 0.5·b"


def test_fewer_equations_than_parameters_keep_no_more_than_there_are():
    found = analyse(np.random.default_rng(0).standard_normal((3, 5)), tuple("abcde"))
    assert found.free == (0, 1, 2) and found.fixed == (3, 4)


# ── hidden by noise ──────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(("lever", "seen"), [(0.0, False), (1e-12, False), (0.05, True), (0.2, True)])
def test_what_no_point_shows_is_fixed_named_and_left_to_the_prior(lever, seen):
    """q6 turns a reflector that is ``lever`` off its axis [m]; of the paper's parameters nothing is known."""
    robot = Robot.load("kuka_kr270").with_targets(np.vstack([np.zeros(3), np.eye(3)])).with_parameters("q6")
    q = random_configurations(robot, 12, 3)
    moves = robot.jacobian(q[:1]).reshape(4, 3)  # ω × (origin + R t), linear in t
    on_axis = np.linalg.svd((moves[1:] - moves[0]).T)[2][2]
    off = np.cross(on_axis, [0.3, 0.5, 0.7])
    offset = 0.1 * on_axis + lever * off / np.linalg.norm(off)
    robot = robot.with_targets(offset[None]).with_parameters("d2,q2,q6")
    cell = SimulatedCell(robot, {"d2": 1e-3, "q2": 1e-3, "q6": 1e-3}, SIGMA)
    data = bare(cell.measure(q, 1, 3))
    paper = ErrorModel.paper()
    estimate = identify(IdentificationProblem(robot, data, SIGMA, paper, test_poses=q[:3]))
    assert estimate.observability.fixed == (() if seen else ("q6",))
    assert estimate.fit.status == ("ok" if seen else "rank_deficient")
    if seen:
        assert abs(estimate.fit.deviations[2] - 1e-3) < 4.5 * estimate.fit.std[2] < 4.5e-3
        return
    assert estimate.observability.unidentifiable[0].startswith(("q6", "1·q6"))
    assert estimate.fit.deviations[2] == 0.0 and np.isnan(estimate.fit.std[2])
    assert np.isfinite(estimate.accuracy.predicted).all()
    prior = Prior(("q6",), [0.02], [1e-3])
    told = identify(IdentificationProblem(robot, data, SIGMA, paper, prior=prior))
    assert told.observability.fixed == () and len(told.observability.resolved_by_prior) == 1
    assert told.fit.values[2] == pytest.approx(0.02, rel=1e-3)
    assert told.fit.std[2] == pytest.approx(1e-3, rel=1e-3)


@pytest.mark.parametrize("lever", [1e-5, 1e-4])
def test_what_noise_hides_is_as_uncertain_as_it_is(lever):
    """Seen by a column of 10 µm a radian: no value is invented, and a known tolerance decides."""
    robot = Robot.load("kuka_kr270").with_targets(np.vstack([np.zeros(3), np.eye(3)])).with_parameters("q6")
    q = random_configurations(robot, 12, 3)
    moves = robot.jacobian(q[:1]).reshape(4, 3)
    on_axis = np.linalg.svd((moves[1:] - moves[0]).T)[2][2]
    off = np.cross(on_axis, [0.3, 0.5, 0.7])
    offset = 0.1 * on_axis + lever * off / np.linalg.norm(off)
    robot = robot.with_targets(offset[None]).with_parameters("d2,q2,q6")
    cell = SimulatedCell(robot, {"d2": 1e-3, "q2": 1e-3, "q6": 1e-3}, SIGMA)
    estimate = identify(IdentificationProblem(robot, bare(cell.measure(q, 1, 3)), SIGMA, test_poses=q[:3]))
    assert estimate.fit.status == "ok"
    assert abs(estimate.fit.deviations[2] - 1e-3) < 4.5 * estimate.fit.std[2] < 0.1
    assert (estimate.accuracy.predicted < 3 * SIGMA).all()


def test_poses_that_rest_on_what_was_not_seen_are_blind():
    """Only joint 1 moved: other poses need what was not measured; those on the same circle do not."""
    robot = Robot.load("kuka_kr270")
    q = np.repeat(random_configurations(robot, 1, 5), 15, axis=0)
    q[:, 0] = np.linspace(-1, 1, 15)
    cell = SimulatedCell(robot, random_deviations(robot, 5), SIGMA)
    poses = np.vstack([q[7], random_configurations(robot, 2, 6)])
    poses[0, 0] = 0.33
    data = bare(cell.measure(q, 1, 5))
    estimate = identify(IdentificationProblem(robot, data, SIGMA, ErrorModel.paper(), test_poses=poses))
    per = estimate.accuracy.predicted
    assert per[0] < SIGMA and np.isinf(per[1:]).all()
    assert estimate.verdict.level == "FAIL"
    (reason,) = [r for r in estimate.verdict.reasons if r.code == "blind_test_pose"]
    assert reason.text.startswith("the error at 2 of 3 test poses") and reason.advice
    document = json.loads(json.dumps(estimate.to_dict(), allow_nan=False))
    assert document["predicted_accuracy_per_test_pose"][1:] == [None, None]
    assert document["predicted_accuracy"] is None
    told = identify(IdentificationProblem(robot, data, sigma=SIGMA, test_poses=poses))
    assert np.isfinite(told.accuracy.predicted).all()
    assert told.accuracy.predicted[1] > 1e-3  # nothing but the tolerances of the error model knows


# ── degenerate sets ──────────────────────────────────────────────────────────────────────────────────


def measured(robot: Robot, q: np.ndarray, sigma: float = SIGMA) -> Measurements:
    return bare(SimulatedCell(robot, random_deviations(robot, 1), sigma).measure(q, 1, 1))


def sweep(robot: Robot, joint: int, low: float, high: float) -> np.ndarray:
    q = np.repeat(random_configurations(robot, 1, 5), 15, axis=0)
    q[:, joint] = np.linspace(low, high, 15)
    return q


def kuka() -> Robot:
    return Robot.load("kuka_kr270")


def everything(robot: Robot) -> Robot:
    return robot.with_parameters("full", ("base", "tool"))


def blanked() -> Measurements:
    data = measured(kuka(), random_configurations(kuka(), 15, 1))
    points = np.full(data.p.shape, np.nan)
    points[0] = data.p[0]
    return bare(data, points)


def replaced(points) -> Measurements:
    data = measured(kuka(), random_configurations(kuka(), 15, 1))
    return bare(data, np.broadcast_to(points, data.p.shape))


FLANGE = kuka().with_targets(np.zeros((1, 3)))
DEGENERATE = {
    # name: robot, data; None: an estimate comes out, else words of the typed error (of the paper's model)
    "one configuration": (
        kuka,
        lambda: measured(kuka(), np.repeat(random_configurations(kuka(), 1, 3), 12, 0)),
        None,
    ),
    "exactly determined": (kuka, lambda: measured(kuka(), random_configurations(kuka(), 3, 1)), None),
    "underdetermined": (kuka, lambda: measured(kuka(), random_configurations(kuka(), 2, 1)), "at least 3"),
    "one spare configuration": (kuka, lambda: measured(kuka(), random_configurations(kuka(), 4, 1)), None),
    "no noise": (kuka, lambda: measured(kuka(), random_configurations(kuka(), 20, 1), 0.0), None),
    "flange centre": (
        lambda: everything(FLANGE),
        lambda: measured(FLANGE, random_configurations(kuka(), 40, 1)),
        None,
    ),
    "planar": (
        lambda: everything(Robot.load("planar_2r")),
        lambda: measured(Robot.load("planar_2r"), random_configurations(Robot.load("planar_2r"), 30, 1)),
        None,
    ),
    "points on a circle": (kuka, lambda: measured(kuka(), sweep(kuka(), 0, -1, 1)), None),
    "points on a circle, placement unknown": (
        lambda: everything(kuka()),
        lambda: measured(kuka(), sweep(kuka(), 0, -1, 1)),
        "differ in several joints",
    ),
    "points on a line": (mixed, lambda: measured(mixed(), sweep(mixed(), 1, -0.2, 0.6)), None),
    "points on a line, placement unknown": (
        lambda: everything(mixed()),
        lambda: measured(mixed(), sweep(mixed(), 1, -0.2, 0.6)),
        "differ in several joints",
    ),
    "one point": (kuka, blanked, "at least 3"),
    "always the same point": (kuka, lambda: replaced([1.0, 2.0, 3.0]), None),
    "anything": (kuka, lambda: replaced(np.random.default_rng(0).uniform(-2, 2, (15, 1, 3))), None),
}
REFUSED = dict.fromkeys(("always the same point", "anything"), ("points agree with one another",))
"""Sets that a robust fit may refuse instead of calling them FAIL."""
MAY_BE_NULL = {
    "chi_square.probability", "chi_square.value", "covariance", "error_model.terms.gain", "error_model.terms.std",
    "left_out.max", "left_out.mean", "left_out.noise_rms", "left_out.predicted_rms", "left_out.rms",
    "moved_since", "noise.sigma", "normalised_residuals", "parameter_accuracy_per_test_pose", "parameters.std",
    "placement_accuracy_per_test_pose", "placement_alone.left_out.max", "placement_alone.left_out.mean",
    "placement_alone.left_out.noise_rms", "placement_alone.left_out.predicted_rms",
    "placement_alone.left_out.rms", "predicted_accuracy", "predicted_accuracy_per_test_pose",
    "required_accuracy", "residuals", "sigma", "sigma_estimate",
}  # fmt: skip
"""Keys of an estimate that may hold nothing; each says when in its documentation."""


def nulls(value, path: str = "") -> set[str]:
    """Where a document holds nothing."""
    if isinstance(value, dict):
        return set().union(*(nulls(v, f"{path}.{k}".strip(".")) for k, v in value.items()))
    if isinstance(value, list):
        return set().union(*(nulls(v, path) for v in value))
    return {path} if value is None else set()


@pytest.mark.parametrize(
    ("model", "sigma"),
    repeats(
        [("paper", SIGMA), ("typical", None), ("prior", SIGMA)],
        [(m, s) for m in ("paper", "typical", "prior") for s in (SIGMA, None)],
    ),
    ids=lambda v: v if isinstance(v, str) else "unknown" if v is None else "known",
)
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_sets_give_a_verdict_or_a_typed_error(name, sigma, model):
    make, data, words = DEGENERATE[name]
    robot = make()
    options = {
        "paper": {"error_model": ErrorModel.paper()},
        "typical": {},
        "prior": {"error_model": ErrorModel.paper(), "prior": typical_prior(robot)},
    }[model]
    poses = random_configurations(robot, 2, 8)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem = IdentificationProblem(robot, data(), sigma=sigma, test_poses=poses, **options)
        try:
            estimate = identify(problem)
        except CalibPlannerError as error:
            assert any(w in str(error) for w in (words, *REFUSED.get(name, ())) if w), error
            return
        document = json.loads(json.dumps(estimate.to_dict(), allow_nan=False))
    document["error_model"].pop("model")  # a term that is not in it is null
    assert words is None or model != "paper"
    assert nulls(document) <= MAY_BE_NULL
    assert estimate.fit.status in ("ok", "rank_deficient") or name in REFUSED
    assert np.isfinite(estimate.fit.deviations).all()
    assert np.isfinite(estimate.fit.covariance).all()
    per = estimate.accuracy.predicted
    assert not np.isnan(per).any()
    assert not np.isinf(per).any() or estimate.verdict.level == "FAIL"
    for reason in estimate.verdict.reasons:
        assert reason.level == "PASS" or reason.advice
    if name in ("always the same point", "anything"):
        assert estimate.verdict.level == "FAIL"
    if estimate.left_out.freedom < 3.0:
        assert estimate.verdict.level != "PASS"
