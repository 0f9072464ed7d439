# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``robots show``: what was understood of a file, what was ignored, and a picture of the chain."""

from __future__ import annotations

import json

import numpy as np
import pytest

from calib_planner.cli import main

LIMIT = '<limit lower="-180" upper="180" effort="1" velocity="1"/>'
URDF = f"""<robot name="arm">
  <link name="world"/><link name="base"/><link name="flange"/><link name="camera"/><link name="tool0"/>
  <link name="l1"><inertial><mass value="4"/><origin xyz="0 0 0.1"/></inertial></link>
  <link name="l2"><inertial><mass value="2.5"/></inertial></link>
  <joint name="stand" type="fixed"><origin xyz="0 0 0.5"/><parent link="world"/><child link="base"/></joint>
  <joint name="swing" type="revolute"><origin xyz="0 0 0.2"/><axis xyz="0 0 1"/>
    <parent link="base"/><child link="l1"/>{LIMIT}</joint>
  <joint name="reach" type="prismatic"><origin xyz="0.1 0 0" rpy="0 1.5707963267948966 0"/><axis xyz="0 0 2"/>
    <parent link="l1"/><child link="l2"/><limit lower="0" upper="0.4" effort="1" velocity="1"/></joint>
  <joint name="hand" type="fixed"><origin xyz="0 0 0.05"/><parent link="l2"/><child link="tool0"/></joint>
  <joint name="cover" type="fixed"><parent link="l2"/><child link="flange"/></joint>
  <joint name="eye" type="fixed"><parent link="l1"/><child link="camera"/></joint>
  <gazebo/><gazebo/><transmission name="t"/>
</robot>
"""


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    return str(path)


def test_what_was_understood_is_said(arm, capsys):
    assert main(["robots", "show", arm, "--couple", "swing+=2*reach"]) == 0
    out = capsys.readouterr().out
    for words in (
        "arm: 2 joints, from world to tool0",
        "│ swing │ revolute  │ 0 0 1 │ °    │ -180.00 │ 180.00 │    0 0 200 │",
        "│ reach │ prismatic │ 0 0 1 │ mm   │    0.00 │ 400.00 │    100 0 0 │             0 90 0 │",
        "Tip with all joints at zero: 150 0 700 mm, roll pitch yaw 0 90 0°",
        "Inertial data: masses of the links behind swing, reach, 6.5 kg altogether",
        "Coupled: swing+=2*reach;",
        "Note: the chain ends at tool0; further ends of the file are flange (--tip-link)",
        "Note: limits of swing are -180 and 180 rad: they are read as degrees",
        "Ignored: joints beside the chain: cover, eye",
        "Ignored: elements of other programs: 2 × gazebo, 1 × transmission",
    ):
        assert words in out


def test_the_same_in_si_units(arm, capsys):
    assert main(["robots", "show", arm, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["base_link"] == "world" and told["tip_link"] == "tool0"
    assert [j["type"] for j in told["joints"]] == ["revolute", "prismatic"]
    np.testing.assert_allclose(told["joints"][0]["limits"], [-np.pi, np.pi])
    np.testing.assert_allclose(told["tip_at_zero"]["xyz"], [0.15, 0, 0.7], atol=1e-15)
    assert told["masses"] == {"joints": ["swing", "reach"], "total": 6.5, "fault": ""}
    assert len(told["remarks"]) == 2 and len(told["ignored"]) == 2


@pytest.mark.parametrize("suffix", ["svg", "png"])
def test_the_chain_is_drawn(arm, tmp_path, capsys, suffix):
    path = tmp_path / f"arm.{suffix}"
    assert main(["robots", "show", arm, "--drawing", str(path)]) == 0
    assert f"Drawing written to {path}" in capsys.readouterr().err
    data = path.read_bytes()
    assert data.startswith(b"\x89PNG" if suffix == "png" else b"<?xml")
    if suffix == "svg":
        assert all(f"<!-- {name} -->".encode() in data for name in ("swing", "reach", "all joints at zero"))


@pytest.mark.parametrize(
    ("name", "needle"), [("arm.pdf", "ends in .svg or .png"), ("no/arm.svg", "can be written")]
)
def test_a_drawing_that_cannot_be_written_is_refused(arm, tmp_path, capsys, name, needle):
    assert main(["robots", "show", arm, "--drawing", str(tmp_path / name)]) == 2
    assert needle in capsys.readouterr().err
