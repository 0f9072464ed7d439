"""Every row of the table of alternatives is named where it is true, and nothing is named where nothing is wrong."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import cache

import numpy as np
import pytest
from robots import SHARED_DATA, repeats

from calib_planner import Measurements, Robot
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, Knowledge
from calib_planner.error_model.typical import typical
from calib_planner.identification.alternatives import (
    SIGNIFICANT,
    TABLE,
    Alternative,
    _explained,
    _Fine,
    _own_squares,
    _scan,
    _statistics,
    _widened,
    explain_gross,
    find_alternatives,
)
from calib_planner.identification.estimation import ModelEstimate, fit_error_model
from calib_planner.identification.left_out import left_out
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
def cell(seed: int, targets: int = 1, count: int = 60, name: str = KUKA, level: str = "full") -> Cell:
    return Cell(name, seed, targets, count, level)


def fitted(one: Cell, data: Measurements, model: ErrorModel | None = None) -> ModelEstimate:
    return fit_error_model(one.asked, data, model or typical())


def findings(one: Cell, data: Measurements) -> tuple[Alternative, ...]:
    return find_alternatives(one.asked, data, fitted(one, data), one.poses)
