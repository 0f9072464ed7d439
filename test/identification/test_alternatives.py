# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Every row of the table of alternatives is named where it is true, and nothing where nothing is wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache

import numpy as np
import pytest
from robots import SHARED_DATA, repeats

from calib_planner import Measurements, Robot
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, Knowledge, Placement, Prior, typical
from calib_planner.identification.alternatives import (
    SIGNIFICANT,
    TABLE,
    Alternative,
    _Fine,
    _scan,
    _statistics,
    _widened,
    explain_gross,
    find_alternatives,
)
from calib_planner.identification.estimation import ModelEstimate, fit_error_model
from calib_planner.identification.likelihood import by_coefficients, dense, solve
from calib_planner.robot.elements import rotation

TARGETS = np.array([[0.06, 0.02, 0.12], [-0.05, 0.04, 0.10], [0.01, -0.07, 0.14]])
KUKA = "kuka_kr270"


class Cell:
    """A robot drawn from the typical error model, somewhere before the tracker, and what it shows."""

    def __init__(self, name: str, seed: int, targets: int, count: int, level: str = "full") -> None:
        rng = np.random.default_rng([seed, 7])
        plain = Robot.load(name)
        plain = plain.with_targets(TARGETS[:targets]) if len(plain.joint_names) > 2 else plain
        yaw, pitch, roll = rng.uniform([-np.pi, -0.05, -0.05], [np.pi, 0.05, 0.05])
        place = rotation(2, yaw) @ rotation(1, pitch) @ rotation(0, roll)
        real = plain.with_base(place, rng.uniform(-3.0, 3.0, 3)).with_parameters(level)
        model = typical()
        spread = {s.name: s.median * s.factor ** (0.5 * rng.standard_normal()) for s in model.scales}
        model = model.with_values({n: v for n, v in spread.items() if n in model.values})
        variances = model.variances(real)
        beta = np.sqrt(np.where(np.isfinite(variances), variances, 0.0)) * rng.standard_normal(len(variances))
        none = np.zeros((len(beta), 0))
        self.truth = Knowledge(real, model, beta, np.zeros((len(beta),) * 2), none)
        low, high = np.clip(real.joint_limits.T, -np.pi, np.pi)
        middle, half = 0.5 * (low + high), 0.45 * (high - low)
        self.q = rng.uniform(middle - half, middle + half, (count, len(low)))
        self.poses = rng.uniform(middle - half, middle + half, (6, len(low)))
        self.asked = plain.with_targets(np.zeros((targets, 3))).with_parameters(level, ("base", "tool"))
        values, count_of_targets = model.values, len(real.targets)
        noise = np.einsum(
            "nij,nj->ni",
            self.truth.poses(self.q).levers,
            values["repeatability"] * rng.standard_normal(self.q.shape),
        )
        noise = noise + np.tile(values["shared"] * rng.standard_normal((count, 3)), count_of_targets)
        noise = noise + values["floor"] * rng.standard_normal(noise.shape)
        self.noise = noise.reshape(count, count_of_targets, 3)
        self.rng = rng

    def points(self, q: FloatArray | None = None, offsets: FloatArray | None = None) -> FloatArray:
        """(N, targets, 3) without noise, at other joint values or with other offsets of the targets."""
        known = self.truth
        if offsets is not None:
            known = replace(known, robot=known.robot.with_targets(offsets))
        return known.poses(self.q if q is None else q).points

    def data(self, points: FloatArray | None = None, q: FloatArray | None = None) -> Measurements:
        """With noise."""
        shown = self.q if q is None else q
        return Measurements(
            self.asked.joint_names, shown, (self.points() if points is None else points) + self.noise
        )


@cache
def cell(seed: int, targets: int = 1, count: int = 45, name: str = KUKA, level: str = "full") -> Cell:
    return Cell(name, seed, targets, count, level)


def fitted(one: Cell, data: Measurements, model: ErrorModel | None = None) -> ModelEstimate:
    return fit_error_model(one.asked, data, model or typical())


def findings(one: Cell, data: Measurements) -> tuple[Alternative, ...]:
    return find_alternatives(one.asked, data, fitted(one, data), one.poses)


# ── the table ────────────────────────────────────────────────────────────────────────────────────────


def test_every_row_says_what_happened_and_what_to_do() -> None:
    words = dict.fromkeys(("size", "row", "rows", "target", "joint", "beside", "where", "them"), "x")
    words |= dict.fromkeys(("parameter", "option", "advice", "first"), "x")
    for code, row in TABLE.items():
        assert code == row.code and row.kind in ("fine", "gross", "both") and row.tried
        for text in (row.text.format(**words), row.advice.format(**words)):
            assert text and not text.endswith(".") and "{" not in text


def test_an_alternative_is_json() -> None:
    one = cell(0, name="planar_2r", level="lengths+offsets", count=20)
    told = explain_gross(one.asked, one.data(1e3 * one.points()))
    assert told is not None
    again = json.loads(json.dumps(asdict(told)))
    assert again["code"] == "units" and again["row"] is None and again["material"] is True


# ── the algebra ──────────────────────────────────────────────────────────────────────────────────────


@cache
def plain_fit(targets: int = 2, count: int = 14) -> tuple[Cell, ModelEstimate]:
    one = cell(1, targets, count)
    return one, fitted(one, one.data())


@pytest.mark.parametrize("form", [dense, by_coefficients])
def test_a_scan_of_all_cuts_is_one_test_per_cut(form) -> None:
    """Cumulative sums against each cut on its own; (1) against the fall of yᵀPy with the columns in the model."""
    one, fit = plain_fit()
    solution = form(fit.solution.problem)
    fine = _Fine(one.data(), fit, one.poses, "world")
    question = next(q for q in fine.questions(solution) if q.code == "push")
    cuts = np.arange(3, 12)
    values, ranks = _scan(solution, question.columns, cuts)
    left = float(np.sum(solution.problem.y * solution.weighted))
    for k, value, rank in zip(cuts, values, ranks, strict=True):
        columns = question.at(int(k)).columns
        assert _statistics(solution, [columns])[0] == (pytest.approx(value, rel=1e-5, abs=1e-6), rank)
        wide = solve(_widened(solution.problem, columns))
        assert left - float(np.sum(wide.problem.y * wide.weighted)) == pytest.approx(value, rel=1e-4, abs=1e-4)


def test_columns_that_the_model_holds_explain_nothing() -> None:
    """A step from the first visit on is the base's own motion, which is free."""
    one, fit = plain_fit()
    fine = _Fine(one.data(), fit, one.poses, "world")
    question = next(q for q in fine.questions(fit.solution) if q.code == "push")
    assert _statistics(fit.solution, [question.at(0).columns])[0] == (0.0, 0)


def test_the_columns_are_what_the_faults_do() -> None:
    """Every row's columns against differences of the points of the robot as estimated."""
    one, fit = plain_fit()
    fine = _Fine(one.data(), fit, one.poses, "world")
    known, step = fit.knowledge, 1e-6
    here = known.poses(one.q)

    def moved(q: FloatArray) -> FloatArray:
        return (replace(here, deflection=here.deflection + (q - one.q)).points - here.points) / step

    for question in fine.questions(fit.solution):
        columns = question.columns.reshape(len(one.q), len(TARGETS[:2]), 3, -1)
        if question.code == "ratio":
            q = np.array(one.q)
            q[:, question.joint] *= 1.0 + step
            np.testing.assert_allclose(columns[..., 0], moved(q), atol=1e-5)
        elif question.code == "couple":
            q = np.array(one.q)
            q[:, question.joint] += step * one.q[:, question.beside]
            np.testing.assert_allclose(columns[..., 0], moved(q), atol=1e-5)
        elif question.code == "joint_step":
            q = np.array(one.q)
            q[:, question.joint] += step
            np.testing.assert_allclose(columns[..., 0], moved(q), atol=1e-5)
        elif question.code == "reseat":
            for axis in range(3):
                offsets = np.array(here.robot.target_offsets)
                offsets[question.target, axis] += step
                other = replace(here, robot=here.robot.with_targets(offsets)).points
                np.testing.assert_allclose(columns[..., axis], (other - here.points) / step, atol=1e-5)


# ── fine ─────────────────────────────────────────────────────────────────────────────────────────────


Fault = Callable[[Cell], tuple[Measurements, dict[str, object]]]


def late(one: Cell, row: int) -> FloatArray:
    return (np.arange(len(one.q)) >= row)[:, None, None]


def pushed(one: Cell) -> tuple[Measurements, dict[str, object]]:
    return one.data(one.points() + late(one, 25) * [1e-3, -5e-4, 8e-4]), {"code": "push", "row": 25}


def drifting(one: Cell) -> tuple[Measurements, dict[str, object]]:
    time = np.linspace(0.0, 1.0, len(one.q))[:, None, None]
    points = one.points()
    return one.data(points + time * (np.cross([4e-4, 0, 3e-4], points) + np.array([1e-3, 6e-4, -6e-4]))), {
        "code": "drift"
    }


def reseated(one: Cell) -> tuple[Measurements, dict[str, object]]:
    offsets = np.array(TARGETS[: one.noise.shape[1]])
    offsets[-1] += [6e-4, -6e-4, 4e-4]
    points = np.where(late(one, 33), one.points(offsets=offsets), one.points())
    return one.data(points), {"code": "reseat", "row": 33, "target": len(offsets)}


def slipped(one: Cell) -> tuple[Measurements, dict[str, object]]:
    q = one.q + late(one, 22)[:, :, 0] * np.eye(6)[3] * 5e-3
    return one.data(one.points(q)), {"code": "joint_step", "row": 22, "joint": "joint_a4"}


def coupled(one: Cell) -> tuple[Measurements, dict[str, object]]:
    q = np.array(one.q)
    q[:, 4] += 4e-3 * q[:, 2]
    return one.data(one.points(q)), {"code": "couple", "joint": "joint_a5", "beside": "joint_a3"}


def geared(one: Cell) -> tuple[Measurements, dict[str, object]]:
    q = np.array(one.q)
    q[:, 0] *= 1.02
    return one.data(one.points(q)), {"code": "ratio", "joint": "joint_a1"}


def block(one: Cell) -> tuple[Measurements, dict[str, object]]:
    inside = ((np.arange(len(one.q)) >= 20) & (np.arange(len(one.q)) < 32))[:, None, None]
    return one.data(one.points() + inside * [2e-3, -1e-3, 1.5e-3]), {
        "code": "block",
        "rows": tuple(range(20, 32)),
    }


FINE = (pushed, drifting, reseated, slipped, coupled, geared, block)


@pytest.mark.parametrize("fault", FINE, ids=lambda f: f.__name__)
@pytest.mark.parametrize("seed", repeats([0], range(6)))
def test_a_fault_is_named(fault: Fault, seed: int) -> None:
    one = cell(seed, 1 + (seed + FINE.index(fault)) % 2)
    data, expected = fault(one)
    told = findings(one, data)
    assert told, "nothing is named"
    best = told[0]
    row = expected.pop("row", best.row)
    assert {k: getattr(best, k) for k in expected} == expected, best
    # A visit whose own errors are as large as the push may stand on either side of it.
    assert best.row == row or (best.row is not None and abs(best.row - int(str(row))) <= 1)
    assert best.gain > 0.0 and best.probability < SIGNIFICANT and best.moved > 0.0


@pytest.mark.parametrize("seed", repeats(range(3), range(30)))
def test_nothing_is_named_where_nothing_is_wrong(seed: int) -> None:
    one = cell(seed, 1 + seed % 3, 40)
    assert findings(one, one.data()) == ()
    assert explain_gross(one.asked, one.data()) is None


def test_materiality_is_what_predictions_move_by() -> None:
    """Against the same fit of data without the fault; the frame is that of the last visits."""
    one = cell(0)
    (best, *_) = findings(one, pushed(one)[0])
    clean = fitted(one, one.data(one.points() + np.array([1e-3, -5e-4, 8e-4])))
    spoilt = fitted(one, pushed(one)[0])
    off = clean.knowledge.predict(one.poses).mean - spoilt.knowledge.predict(one.poses).mean
    distances = np.sqrt(np.mean(np.sum(off**2, axis=2), axis=1))
    assert best.moved == pytest.approx(distances.max(), rel=0.4)
    assert best.material == (best.deviations > 1.0)


def test_the_accuracy_of_the_robot_alone_minds_no_common_motion() -> None:
    one = cell(0)
    data = pushed(one)[0]
    fit = fitted(one, data)
    world, robot = (find_alternatives(one.asked, data, fit, one.poses, frame)[0] for frame in ("world", "robot"))
    assert robot.code == world.code and robot.moved < world.moved


# ── gross ────────────────────────────────────────────────────────────────────────────────────────────


def turned(q: FloatArray, joint: int, values: FloatArray) -> FloatArray:
    result = np.array(q)
    result[:, joint] = values
    return result


GROSS = {
    "millimetres": (lambda q, p: (q, 1e3 * p), {"code": "units", "text": "the points are in millimetres"}),
    "centimetres": (lambda q, p: (q, 1e2 * p), {"code": "units", "text": "the points are in centimetres"}),
    "inches": (lambda q, p: (q, p / 0.0254), {"code": "units", "text": "the points are in inches"}),
    "degrees": (lambda q, p: (np.rad2deg(q), p), {"code": "units", "advice": "add --degrees"}),
    "both": (
        lambda q, p: (np.rad2deg(q), 1e3 * p),
        {"code": "units", "advice": "add --millimetres, and add --degrees"},
    ),
    "sign": (lambda q, p: (turned(q, 1, -q[:, 1]), p), {"code": "sign", "joint": 1}),
    "signs": (lambda q, p: (-q, p), {"code": "signs"}),
    "zero": (lambda q, p: (turned(q, 1, q[:, 1] - np.pi / 2), p), {"code": "zero", "joint": 1, "size": 90.0}),
    "couple": (
        lambda q, p: (turned(q, 1, q[:, 1] + q[:, 0]), p),
        {"code": "couple", "joint": 1, "beside": 0, "size": -1.0},
    ),
    "columns": (
        lambda q, p: (q[:, [1, 0, *range(2, q.shape[1])]], p),
        {"code": "columns", "joint": 0, "beside": 1},
    ),
    "ratio": (lambda q, p: (turned(q, 1, q[:, 1] / 1.06), p), {"code": "ratio", "joint": 1}),
    "scale": (lambda q, p: (q, 1.05 * p), {"code": "scale"}),
    "next": (lambda q, p: (q, np.roll(p, 1, axis=0)), {"code": "rows", "size": 1.0}),
    "reverse": (lambda q, p: (q, p[::-1]), {"code": "rows"}),
}


@pytest.mark.parametrize("name", [KUKA, "planar_2r"])
@pytest.mark.parametrize("mistake", GROSS)
def test_a_gross_mistake_is_named(mistake: str, name: str) -> None:
    level = "full" if name == KUKA else "lengths+offsets"
    one = cell(2, 1, 24, name, level)
    robot = one.asked if name == KUKA else one.asked.with_base(*one.truth.robot.base_pose).with_parameters(level)
    change, expected = GROSS[mistake]
    q, p = change(one.q, one.points() + one.noise)
    told = explain_gross(robot, Measurements(robot.joint_names, q, p))
    assert told is not None
    names = robot.joint_names
    wanted = {k: names[v] if k in ("joint", "beside") else v for k, v in expected.items()}
    assert {k: getattr(told, k) for k in wanted} == wanted, told.text
    assert told.material and told.probability < SIGNIFICANT
    json.dumps(asdict(told), allow_nan=False)


@pytest.mark.parametrize("order", [(1, 0, 2), (0, 2, 1)])
def test_points_of_a_left_handed_frame_are_named(order: tuple[int, int, int]) -> None:
    one = cell(2, 1, 24)
    told = explain_gross(one.asked, one.data((one.points() + one.noise)[..., order]))
    assert told is not None and told.code == "mirror" and "left-handed" in told.text


def test_exchanged_targets_are_named_where_their_places_are_known() -> None:
    one = cell(0, 3, 20)
    robot = one.asked.with_targets(TARGETS).with_parameters("full", ("base",))
    told = explain_gross(robot, one.data(one.points()[:, [1, 0, 2]]))
    assert told is not None and told.code == "targets" and "1, 2" in told.text


def test_a_base_that_nobody_said_is_unknown_is_named() -> None:
    one = cell(0, 2, 20)
    robot = one.asked.with_targets(TARGETS[:2]).with_parameters("full")
    told = explain_gross(robot, one.data())
    assert told is not None and told.code == "setup" and told.advice == "add --unknown base"


def test_gross_points_do_not_hide_a_gross_mistake() -> None:
    one = cell(0, 2, 30)
    points = one.points()
    bad = np.random.default_rng(0).random(points.shape[:2]) < 0.2
    points[bad] += 0.1
    told = explain_gross(one.asked, one.data(points, turned(one.q, 2, -one.q[:, 2])))
    assert told is not None and told.code == "sign" and told.joint == "joint_a3"


def test_what_no_change_explains_is_not_explained() -> None:
    one = cell(0, 1, 30)
    shuffled = np.random.default_rng(0).permutation(30)
    assert explain_gross(one.asked, one.data(one.points()[shuffled])) is None


def test_too_few_points_tell_nothing() -> None:
    one = cell(0, 1, 40)
    few = one.data().select(np.arange(2))
    assert explain_gross(one.asked, few) is None


# ── points that belong elsewhere ─────────────────────────────────────────────────────────────────────


def test_two_exchanged_rows_are_named() -> None:
    one = cell(0, 1, 40)
    data = one.data()
    points = np.array(data.p)
    points[[4, 17]] = points[[17, 4]]
    spoilt = Measurements(data.joint_names, data.q, points)
    assert explain_gross(one.asked, spoilt) is None  # the fit copes with two
    (told, *others) = findings(one, spoilt)
    assert told.code == "rows" and told.rows == (4, 17) and "exchanged" in told.text and not others
    assert told.gain > 0.0 and not told.material


def test_targets_exchanged_in_some_rows_are_named() -> None:
    one = cell(0, 2, 40)
    data = one.data()
    points = np.array(data.p)
    points[[5, 6, 30]] = points[[5, 6, 30]][:, ::-1]
    (told, *others) = findings(one, Measurements(data.joint_names, data.q, points))
    assert told.code == "targets" and told.rows == (5, 6, 30) and not others


def test_a_quarter_of_the_rows_one_row_off_is_named() -> None:
    one = cell(0, 1, 40)
    data = one.data()
    points = np.array(data.p)
    points[10:19], points[19] = data.p[11:20], data.p[10]
    told = explain_gross(one.asked, Measurements(data.joint_names, data.q, points))
    assert told is not None and told.code == "rows" and told.rows == tuple(range(10, 20))
    assert "1 row further down" in told.text and not told.material


def test_a_prior_that_is_too_narrow_is_named() -> None:
    one = cell(0, 1, 40)
    chain = [p for p in one.asked.parameters if not p.name.startswith(("base.", "target_"))]
    stated = Prior(tuple(p.name for p in chain), np.array([p.nominal for p in chain]), np.full(len(chain), 5e-5))
    data = one.data()
    fit = fitted(one, data, typical(placement=Placement(stated=stated)))
    told = find_alternatives(one.asked, data, fit, one.poses)
    (first,) = [t for t in told if t.code == "prior"][:1]
    assert (
        "widen the prior" in first.advice and first.parameter in one.asked.parameter_names and first.size >= 1.0
    )


# ── measured robots ──────────────────────────────────────────────────────────────────────────────────


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the measured robots are not here")
def test_a_measured_robot_has_no_gross_mistake_until_it_is_made() -> None:
    from calib_planner.io import read_data

    folder = SHARED_DATA / "irb120_tracker"
    robot = Robot.load(str(folder / "irb120.urdf")).with_targets(np.zeros((3, 3)))
    robot = robot.with_parameters("full", ("base", "tool"))
    data = read_data(folder / "calibration.csv", robot).data
    assert explain_gross(robot, data) is None
    for mistake in ("both", "sign", "couple", "next"):
        change, expected = GROSS[mistake]
        q, p = change(data.q, data.p)
        told = explain_gross(robot, Measurements(robot.joint_names, q, p))
        assert told is not None and told.code == expected["code"], mistake
