# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Times as people write them, and what plan says of the minutes that it takes."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calib_planner.cli.arguments import seconds
from calib_planner.cli.main import main

PLANAR = ("plan", "--robot", "planar_2r", "--test-pose", "0.3 0.8", "--starts", "2")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2h", 7200),
        ("90min", 5400),
        ("1h30", 5400),
        ("1h30min", 5400),
        ("1H 30 min 5 s", 5405),
        ("7200s", 7200),
        ("7200", 7200),
        ("1.5h", 5400),
        ("0.5", 0.5),
    ],
)
def test_times_as_people_write_them(text: str, expected: float) -> None:
    assert seconds(text) == expected


@pytest.mark.parametrize("text", ["", "2d", "h", "-5", "5m", "30 1h", "min", "nan", "1h30x"])
def test_other_words_are_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="2h, 90min, 1h30 or 7200s"):
        seconds(text)


def answer(capsys: Any, *options: str) -> dict[str, Any]:
    assert main([*PLANAR, *options, "--json"]) == 0
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


def test_the_sheet_has_the_times_of_the_plan(capsys: Any, tmp_path: Path) -> None:
    written = str(tmp_path / "plan.yaml")
    pace = ("--speed", "0.2", "--settle", "1", "--dwell", "30s", "--start", "0 0")
    made = answer(capsys, "--time-budget", "5min", *pace, "--output", written)
    assert made["minutes"] <= 5.0 and (made["settle"], made["dwell"]) == (1.0, 30.0)
    assert made["minutes"] in [row["minutes"] for row in made["tried"]]
    assert sum(made["repetitions"]) > len(made["configurations"])
    for count, row in zip(made["repetitions"], made["stops"], strict=True):
        assert (row["settle"], row["measure"]) == (count, 30.0 * count)
    assert main(["sheet", "--plan", written, *pace, "--json"]) == 0
    sheet = json.loads(capsys.readouterr().out)
    assert sheet["minutes"] == made["minutes"]
    for own, told in zip(sheet["stops"], made["stops"], strict=True):
        assert {k: own[k] for k in told} == told


def test_an_accuracy_is_reached_in_least_time_if_a_pace_is_stated(capsys: Any) -> None:
    fewest, quickest = (
        answer(capsys, "--accuracy", "2e-5"),
        answer(capsys, "--accuracy", "2e-5", "--speed", "0.05"),
    )
    assert fewest["minutes"] > 0 and "minutes" not in fewest["tried"][0]
    assert quickest["minutes"] == min(row["minutes"] for row in quickest["tried"])
    assert max(fewest["predicted_accuracy"], quickest["predicted_accuracy"]) <= 2e-5
    np.testing.assert_allclose(quickest["stops"][-1]["leave"], 60 * quickest["minutes"])


def test_what_cannot_be_is_said(capsys: Any) -> None:
    for options, status, words in (
        (("--time-budget", "soon"), 2, "7200s"),
        (("--time-budget", "5s"), 1, "too short"),
        (("--time-budget", "0"), 2, "time_budget"),
        (("--time-budget", "1h", "--repetitions", "2"), 2, "--configurations"),
        (("--time-budget", "1h", "--configurations", "2"), 2, "one of the two"),
    ):
        try:
            got = main([*PLANAR, *options])
        except SystemExit as end:
            got = int(str(end.code))
        assert got == status and words in capsys.readouterr().err, options
