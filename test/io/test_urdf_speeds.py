# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Speed limits of a URDF: by joint name, none rather than half of them, flaws named."""

from __future__ import annotations

from pathlib import Path

import pytest
from robots import MIXED_URDF

from calib_planner.errors import FileFormatError
from calib_planner.io import read_speed_limits

TEXT = """<robot name="r"><joint name="b" type="revolute"><limit velocity="2.5" lower="0" upper="1"/></joint>
<joint name="a" type="prismatic"><limit velocity="{}" lower="0" upper="1"/></joint>
<joint name="fixed" type="fixed"/></robot>"""


def written(folder: Path, text: str) -> Path:
    path = folder / "r.urdf"
    path.write_text(text)
    return path


def test_limits_in_the_order_asked_for(tmp_path: Path) -> None:
    path = written(tmp_path, TEXT.format("0.25"))
    limits = read_speed_limits(path, ("a", "b"))
    assert limits is not None and limits.tolist() == [0.25, 2.5]


def test_none_unless_every_joint_has_one(tmp_path: Path) -> None:
    assert read_speed_limits(written(tmp_path, TEXT.format("0")), ("a", "b")) is None
    assert read_speed_limits(written(tmp_path, TEXT.format("1")), ("a", "b", "fixed")) is None
    assert read_speed_limits(written(tmp_path, MIXED_URDF), ("turn", "spin")) is None  # spin is continuous


@pytest.mark.parametrize("word", ["fast", "nan", "inf", ""])
def test_words_are_refused(word: str, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="joint 'a' limit velocity"):
        read_speed_limits(written(tmp_path, TEXT.format(word)), ("a", "b"))


def test_other_files_are_refused(tmp_path: Path) -> None:
    for text, told in (("<robot", "XML"), ("<!DOCTYPE robot []><robot/>", "document type"), ("", "XML")):
        with pytest.raises(FileFormatError, match=told):
            read_speed_limits(written(tmp_path, text), ("a",))
