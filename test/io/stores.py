# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Stores for tests, and records whose numbers only exact writing brings back."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np

from calib_planner import Plan
from calib_planner.acquisition import Rejection, Standstill
from calib_planner.io import Record, SessionStore, StoredModel, open_store

MODEL = StoredModel("arm", ("q1", "q2"), 2, "links: [1, 0.7]  # Länge")


def opened(folder: Path | str, model: StoredModel = MODEL, **settings: object) -> SessionStore:
    return open_store(str(folder), model, settings, "1.2.3")


def standstill(seed: int, *, seen: tuple[bool, bool] = (True, True)) -> Standstill:
    """Numbers that only exact writing brings back."""
    rng = np.random.default_rng(seed)
    unseen = ~np.array(seen)
    points, std = rng.standard_normal((2, 3)) * 10.0 ** rng.integers(-300, 300, (2, 3)), rng.random(2)
    points[unseen], std[unseen] = np.nan, np.nan
    start = 1_700_000_000_000_000_000 + seed
    return Standstill(start, start + 7, rng.standard_normal(2), points, std, rng.integers(1, 99, 2))


def decision(found: Standstill | Rejection, status: str = "accepted", **others: object) -> Record:
    return replace(Record(found, status, "", 1, 0, frame="läser"), **others)  # type: ignore[arg-type]


def begun(store: SessionStore, plan_id: str = "p", planned: Plan | None = None) -> int:
    return store.begin(plan_id, planned).number


def assert_same(a: Record, b: Record) -> None:
    for f in fields(Record):
        if f.name != "acquired":
            assert getattr(a, f.name) == getattr(b, f.name), f.name
    assert type(a.acquired) is type(b.acquired)
    for f in fields(a.acquired):
        x, y = getattr(a.acquired, f.name), getattr(b.acquired, f.name)
        assert np.array_equal(x, y, equal_nan=True) if isinstance(x, np.ndarray) else x == y, f.name
