# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Linear algebra keeps to one thread while we compute, and to what it was before and after."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from calib_planner import IdentificationProblem, Robot, arrays, identify
from calib_planner.arrays import ONE_THREAD, one_thread
from calib_planner.identification import solver
from calib_planner.simulation import SimulatedCell, random_deviations

threadpoolctl = pytest.importorskip("threadpoolctl")


def threads() -> set[int]:
    return {one["num_threads"] for one in threadpoolctl.threadpool_info() if one["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def two_threads():
    """Libraries that would use two, whatever the environment says."""
    np.linalg.solve(np.eye(2), np.ones(2))
    with threadpoolctl.threadpool_limits(2, "blas"):
        if threads() != {2}:
            pytest.skip("this machine's linear algebra has one thread only")
        yield


def test_identify_keeps_to_one(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(solver, "explain_gross", lambda *_: seen.append(threads()))
    robot = Robot.load("planar_2r")
    cell = SimulatedCell(robot, random_deviations(robot, 1))
    q = np.random.default_rng(0).uniform(-2, 2, (6, 2))
    identify(IdentificationProblem(robot, cell.measure(q, 1, 1)))
    assert seen and all(one == {1} for one in seen) and threads() == {2}


def test_an_error_puts_it_back() -> None:
    @one_thread
    def fails() -> None:
        assert threads() == {1}
        raise ValueError

    with pytest.raises(ValueError):
        fails()
    assert threads() == {2}


def test_the_last_one_out_puts_it_back() -> None:
    first_in, second_in = threading.Event(), threading.Event()

    def first() -> None:
        with ONE_THREAD:
            first_in.set()
            second_in.wait(10)

    def second() -> set[int]:
        first_in.wait(10)
        with ONE_THREAD:
            second_in.set()
            done.result(10)
            return threads()

    with ThreadPoolExecutor(2) as pool:
        done = pool.submit(first)
        assert pool.submit(second).result(10) == {1}
    assert threads() == {2}


def test_without_the_library_nothing_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrays, "ThreadpoolController", None)
    with ONE_THREAD:
        assert threads() == {2}
