# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What a campaign has to reach is in its record: the parameters with it, and what differs, in words."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from calib_planner.errors import InputError
from calib_planner.ros.campaign import goals_of, with_goals
from calib_planner.ros.settings import CampaignParameters

BEGUN = CampaignParameters(test_poses="0.2 0.9; 1 2", budget=40, required_accuracy=2e-5, batch=3)


def record(settings: CampaignParameters) -> dict[str, object]:
    """As it is read from a file."""
    goals: dict[str, object] = json.loads(json.dumps(goals_of(settings)))
    return goals


def test_the_record_counts_and_what_differs_is_said() -> None:
    assert with_goals(BEGUN, record(BEGUN)) == (BEGUN, [])
    now = replace(BEGUN, budget=50, test_poses="", patience=3.0)
    settings, differing = with_goals(now, record(BEGUN))
    assert settings == replace(BEGUN, patience=3.0)
    assert differing == [
        "test_poses is '0.2 0.9; 1 2' in the record, '' here",
        "budget is '40' in the record, '50' here",
    ]


def test_records_of_earlier_versions_are_read() -> None:
    """They held numbers of the problem, and poses as lists."""
    old = {
        "test_poses": [[0.2, 0.9], [1.0, 2.0]],
        "budget": 40,
        "required_accuracy": 1,
        "robot": "x",
        "exclusion": 0.1,
    }
    settings, differing = with_goals(CampaignParameters(), old)
    assert settings.test_pose_rows == BEGUN.test_pose_rows and settings.exclusion == 0.1 and len(differing) == 4
    assert type(settings.required_accuracy) is float
    assert with_goals(BEGUN, {}) == (BEGUN, [])


@pytest.mark.parametrize("wrong", [{"budget": "x"}, {"budget": 1.5}, {"parameters": 3}, {"sigma": True}])
def test_a_value_that_is_none_is_refused_by_name(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError, match=rf"{next(iter(wrong))}.*another store_folder"):
        with_goals(BEGUN, record(BEGUN) | wrong)


def test_a_file_that_changed_is_named(tmp_path: Path) -> None:
    for name in ("floor.yaml", "model.yaml"):
        (tmp_path / name).write_text("one")
    files = {
        "constraints": "floor.yaml",
        "constraints_folder": str(tmp_path),
        "error_model": str(tmp_path / "model.yaml"),
    }
    begun = replace(BEGUN, **files)
    goals = record(begun)
    assert with_goals(begun, goals) == (begun, [])
    (tmp_path / "model.yaml").write_text("two")
    (tmp_path / "floor.yaml").unlink()
    said = with_goals(begun, goals)[1]
    assert [text.split()[3] for text in said] == ["error_model", "constraints"] and "changed" in said[0]
