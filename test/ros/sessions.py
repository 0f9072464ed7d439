# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Sessions of the identifier without ROS: a robot that errs, its plans, and what the tracker sees of it."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from pathlib import Path

import numpy as np
from robots import plan_of, random_configurations

from calib_planner import Estimate, Plan, Robot
from calib_planner.acquisition import NANO, Standstill
from calib_planner.io import SessionStore, StoredModel, open_store
from calib_planner.ros.session import Matching, Session
from calib_planner.simulation import random_deviations

HOW = Matching(sigma=3e-5)
ROBOT = Robot.load("planar_2r").with_parameters("lengths+offsets")
TRUE = ROBOT.with_deviations(random_deviations(ROBOT, 3))
LEVELS: dict[str, Callable[[Plan], Robot]] = {"same": lambda _: ROBOT}


def planned(count: int = 12, seed: int = 0) -> Plan:
    return plan_of(ROBOT, random_configurations(ROBOT, count, seed))


PLAN = planned()


def opened(folder: Path | str) -> SessionStore:
    return open_store(str(folder), StoredModel(ROBOT.name, ROBOT.joint_names, 1, "text"), {}, "")


def begun(store: SessionStore, plan: Plan | None = PLAN) -> Session:
    made = Session(ROBOT, LEVELS["same"], store)
    if plan is not None:
        made.begin("p", plan, HOW.tolerance)
    return made


def seen(row: int, error: float = 0.0, attempt: int = 0, plan: Plan = PLAN) -> Standstill:
    """What the tracker sees at a row of the plan, the same whenever it is asked; ``error`` [m] on top."""
    q = plan.configurations[row]
    rng = np.random.default_rng([row, attempt])
    point = TRUE.positions(q)[0] + 3e-5 / np.sqrt(20) * rng.standard_normal((1, 3)) + [error, 0.0, 0.0]
    start = (1000 + 2 * row + 100 * attempt) * NANO
    return Standstill(start, start + NANO, q, point, np.full(1, 3e-5 / np.sqrt(20)), np.array([20]))


def measure(campaign: Session, *founds: Standstill) -> list[str]:
    """Statuses in the order told: of the standstills, and of what is seen otherwise after each."""
    told = []
    for found in founds:
        decision = campaign.take(found, HOW, "laser")
        told.append(decision.status)
        if decision.status == "accepted":
            campaign.estimate(HOW)
            told += [f"{d.index} {d.status}" for d in campaign.judge()]
    return told


def assert_same_estimate(a: object, b: object) -> None:
    assert isinstance(a, Estimate) and isinstance(b, Estimate)
    for name in ("fit.values", "fit.deviations", "fit.covariance", "residuals.vectors"):
        assert np.allclose(attrgetter(name)(a), attrgetter(name)(b), rtol=0, atol=1e-12, equal_nan=True), name
    assert a.points.rejected == b.points.rejected and a.verdict == b.verdict
