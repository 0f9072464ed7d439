# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Whoever does the work: same seed, same plan."""

from __future__ import annotations

import multiprocessing
import pickle
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from robots import CASES, mixed, repeats

from calib_planner import Plan, PlanProblem, Robot, plan
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, typical
from calib_planner.planning import Candidates, Search, compare
from calib_planner.planning.parallel import PART
from calib_planner.planning.search.multistart import CHUNKS, parts
from calib_planner.tracker import Isotropic


def problem() -> PlanProblem:
    return PlanProblem(Robot.load("planar_2r"), [0.2, 0.9], 4, search=Search(starts=8, seed=5))


@contextmanager
def processes(_: Path) -> Iterator[Executor]:
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


@contextmanager
def threads(_: Path) -> Iterator[Executor]:
    with ThreadPoolExecutor(2) as pool:
        yield pool


@contextmanager
def cluster(folder: Path) -> Iterator[Executor]:
    """A dask scheduler and two worker processes on this machine, talking TCP; docs/scaling.md has one, too."""
    dask = pytest.importorskip("dask")
    distributed = pytest.importorskip("distributed")
    with (
        dask.config.set({"temporary_directory": str(folder), "distributed.worker.daemon": True}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
        ) as local,
        distributed.Client(local) as client,
    ):
        client.wait_for_workers(2, timeout=60)
        yield client.get_executor()


def among(model: ErrorModel | None) -> PlanProblem:
    """Of more candidates than one part of the work holds, so that there are two."""
    robot = Robot.load("planar_2r")
    rows = np.random.default_rng(7).uniform(*robot.joint_limits.T, (PART + 60, 2))
    return PlanProblem(robot, [0.2, 0.9], 4, candidates=Candidates(rows), error_model=model)


def everything(executor: Executor | None) -> tuple[list[Plan], FloatArray]:
    """Plans of free configurations, among candidates by either model, and random baselines in several batches."""
    requests = [problem(), among(None), among(typical(Isotropic(3e-5)))]
    column = compare(problem(), [(4, 1)], 12_000, executor)[0]
    return [*(plan(p, executor=executor) for p in requests), column.proposed], column.random


@pytest.fixture(scope="module")
def alone() -> tuple[list[Plan], FloatArray]:
    return everything(None)


@pytest.mark.parametrize("workers", repeats([threads, processes], [threads, processes, cluster]))
def test_same_seed_same_plan_whatever_the_executor(workers, alone, tmp_path):
    with workers(tmp_path) as executor:
        plans, random = everything(executor)
    for found, known in zip(plans, alone[0], strict=True):
        np.testing.assert_array_equal(found.configurations, known.configurations)
        assert found.quality.predicted_accuracy == known.quality.predicted_accuracy
        assert found.quality.lower_bound == known.quality.lower_bound
        assert (found.quality.starts, found.quality.evaluations) == (
            known.quality.starts,
            known.quality.evaluations,
        )
    np.testing.assert_array_equal(random, alone[1])


class Backwards(Executor):
    """Does the work when first asked for a result, the last part first."""

    def __init__(self) -> None:
        self.waiting: list[tuple[Future, object, tuple]] = []

    def submit(self, fn, /, *args, **kwargs):
        executor, future = self, Future()

        class Lazy(Future):
            def result(self, timeout=None):
                while executor.waiting:
                    inner, function, values = executor.waiting.pop()
                    inner.set_result(function(*values))
                return future.result(timeout)

        self.waiting.append((future, fn, args))
        return Lazy()


def test_order_of_completion_does_not_matter(alone):
    plans, random = everything(Backwards())
    for found, known in zip(plans, alone[0], strict=True):
        np.testing.assert_array_equal(found.configurations, known.configurations)
    np.testing.assert_array_equal(random, alone[1])


def test_cancelling_with_an_executor_returns_a_valid_plan():
    with ThreadPoolExecutor(2) as pool:
        found = plan(problem(), lambda progress: progress.starts_done > 0, executor=pool)
    assert found.quality.status == "cancelled"
    assert found.configurations.shape == (4, 2)
    assert found.quality.lower_bound <= found.quality.predicted_accuracy


def test_many_starts_are_cut_into_more_parts():
    """The parts depend on the problem only, never on the executor."""
    assert len(parts(48)) == len(parts(1)) == CHUNKS
    assert len(parts(1000)) > 16
    for starts in (1, 3, 48, 64, 1000, 12345):
        assert sum(parts(starts)) == starts


@pytest.mark.parametrize("name", CASES)
def test_robots_and_problems_survive_pickling(name):
    robot = CASES[name]()
    q = np.zeros((2, len(robot.joint_names)))
    expected = robot.jacobian(q)  # caches filled
    copy = pickle.loads(pickle.dumps(robot))
    np.testing.assert_array_equal(copy.jacobian(q), expected)
    assert copy.joint_names == robot.joint_names
    again = pickle.loads(pickle.dumps(PlanProblem(robot, q, 40)))
    assert again.robot.parameter_names == robot.parameter_names


def test_plans_survive_pickling():
    found = plan(PlanProblem(mixed().with_parameters("offsets"), np.zeros(4), 3, search=Search(starts=4)))
    copy = pickle.loads(pickle.dumps(found))
    np.testing.assert_array_equal(copy.configurations, found.configurations)
    assert copy.to_dict() == found.to_dict()
