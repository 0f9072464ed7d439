"""Mistakes that data show by themselves: units are refused, exchanges are named, and nothing is made up."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from cells import SIGMA, TARGETS, bare, placed_cell, plain_cell
from robots import random_configurations

from calib_planner import IdentificationProblem, InputError, Robot, identify
from calib_planner.identification import check_units
from calib_planner.identification.checks import copied_rows, explain


@pytest.mark.parametrize("make", [plain_cell, placed_cell], ids=["plain", "placed"])
@pytest.mark.parametrize("factor", [1000.0, 1e-3])
def test_millimetres_are_refused_with_what_to_do(make, factor):
    """Also where nothing is known of base and tool, and with one wild point among them."""
    cell, asked = make(1)
    data = cell.measure(random_configurations(asked, 15, 1), 1, 1)
    points = np.array(data.p) * factor
    points[4] *= 30.0
    with pytest.raises(InputError) as caught:
        identify(IdentificationProblem(asked, bare(data, points), loss="robust"))
    wrong, words = ("points", "divide by 1000") if factor > 1 else ("robot", "give them in metres")
    assert caught.value.field == wrong
    assert words in str(caught.value)


def test_other_units_and_gross_errors_are_not_taken_for_millimetres():
    cell, asked = plain_cell(2)
    data = cell.measure(random_configurations(asked, 15, 2), 1, 2)
    for factor in (0.01, 0.5, 2.0, 39.37, 100.0):
        check_units(asked, bare(data, data.p * factor))
    wild = np.array(data.p)
    wild[:6] += 500.0
    check_units(asked, bare(data, wild))
    same = np.broadcast_to([1.0, 2.0, 3.0], data.p.shape)
    check_units(asked, bare(data, same))


def scene(seed: int = 3):
    """Predictions of 12 configurations of 3 targets, and perfect measurements of them."""
    robot = Robot.load("kuka_kr270").with_targets(TARGETS)
    q = random_configurations(robot, 12, seed)
    predicted = robot.positions(q)
    noise = SIGMA * np.random.default_rng(seed).standard_normal(predicted.shape)
    return predicted, bare(placed_cell(seed)[0].measure(q, 1, seed), predicted + noise)


def with_points(data, change) -> tuple:
    points = np.array(data.p)
    change(points)
    return bare(data, points), np.linalg.norm(points - data.p, axis=2) > 1e-9


def test_exchanged_targets_are_named_one_by_one():
    predicted, data = scene()
    changed, bad = with_points(data, lambda p: p.__setitem__(4, p[4, [1, 2, 0]]))
    words = explain(predicted, changed, bad, 1e-3)
    assert words == {(4, t): f"fits target {k}: targets exchanged?" for t, k in enumerate((2, 3, 1))}


def test_exchanged_rows_are_named_even_with_a_wild_point_among_them():
    predicted, data = scene()

    def change(p):
        p[[2, 7]] = p[[7, 2]]
        p[2, 1] += 0.3

    changed, bad = with_points(data, change)
    words = explain(predicted, changed, bad, 1e-3)
    for row, other in ((2, 7), (7, 2)):
        for t in range(3):
            assert words[row, t] == f"fits the configuration of row {other}: rows exchanged?"


def test_what_fits_nowhere_is_not_explained():
    predicted, data = scene()
    changed, bad = with_points(data, lambda p: p.__setitem__(5, p[5] + [0.02, 0.01, 0.0]))
    assert explain(predicted, changed, bad, 1e-3) == {}
    assert explain(predicted, data, np.zeros((12, 3), bool), 1e-3) == {}


def test_one_wrong_target_is_not_said_to_be_another():
    """A single rejected target near another's place is exchanged with nobody."""
    predicted, data = scene()
    changed, bad = with_points(data, lambda p: p.__setitem__((5, 0), p[5, 1]))
    assert explain(predicted, changed, bad, 1e-3) == {}


def test_copies_are_counted():
    _, data = scene()
    assert copied_rows(data) == 0
    twice = data.select([0, 1, 2, 1, 0, 1])
    assert copied_rows(twice) == 3
    gaps = np.array(twice.p)
    gaps[:, 1] = np.nan
    assert copied_rows(dataclasses.replace(twice, points=gaps)) == 3
    gaps[5, 0, 0] += 1e-12
    assert copied_rows(dataclasses.replace(twice, points=gaps)) == 2
