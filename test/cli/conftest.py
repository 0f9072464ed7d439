# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``run`` identifies; ``points`` are measurements for it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from identify_runs import Run, small_data

from calib_planner.cli import main
from calib_planner.io import write_measurements


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Identify; the JSON, or (stdout, stderr) with ``shown=True``."""

    def call(*argv: object, shown: bool = False) -> Any:
        words = ["identify", *map(str, argv), *(() if shown else ("--json",))]
        assert main(words) == 0, capsys.readouterr().err
        out, err = capsys.readouterr()
        return (out, err) if shown else json.loads(out)

    return call


@pytest.fixture
def points(tmp_path: Path) -> Path:
    path = tmp_path / "points.csv"
    write_measurements(path, small_data())
    return path
