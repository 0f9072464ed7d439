# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Robots written in xacro: what is expanded, where packages are looked for, and what is said without xacro."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from calib_planner import FileFormatError, Robot
from calib_planner.cli import main
from calib_planner.io import write_calibrated_urdf

LIMIT = '<limit lower="-2" upper="2" effort="1" velocity="1.5"/>'
MACRO = f"""<?xml version="1.0"?>
<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:property name="height" value="0.4"/>
  <xacro:macro name="arm" params="prefix length">
    <link name="${{prefix}}base"/><link name="${{prefix}}l1"/><link name="${{prefix}}l2"/>
    <joint name="${{prefix}}j1" type="revolute"><origin xyz="0 0 ${{height}}"/><axis xyz="0 0 1"/>
      <parent link="${{prefix}}base"/><child link="${{prefix}}l1"/>{LIMIT}</joint>
    <joint name="${{prefix}}j2" type="revolute"><origin xyz="${{length}} 0 0"/><axis xyz="0 1 0"/>
      <parent link="${{prefix}}l1"/><child link="${{prefix}}l2"/>{LIMIT}</joint>
  </xacro:macro>
</robot>
"""
TOP = """<?xml version="1.0"?>
<robot name="cell" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:include filename="$(find my_arm)/urdf/arm_macro.xacro"/>
  <xacro:arg name="length" default="0.5"/>
  <xacro:arm prefix="left_" length="$(arg length)"/>
</robot>
"""


@pytest.fixture
def cell(tmp_path):
    """A file that includes the macro of a package two folders away."""
    for name, file, text in (("my_arm", "arm_macro.xacro", MACRO), ("my_cell", "cell.urdf.xacro", TOP)):
        folder = tmp_path / "src" / name / "urdf"
        folder.mkdir(parents=True)
        (folder / file).write_text(text)
        (folder.parent / "package.xml").write_text(f"<package><name>{name}</name></package>")
    return folder / file


def test_a_file_that_includes_another_package_is_expanded(cell):
    pytest.importorskip("xacro")
    robot = Robot.load(cell)
    assert robot.joint_names == ("left_j1", "left_j2")
    np.testing.assert_allclose(robot.positions(np.zeros(2))[0, 0], [0.5, 0, 0.4], atol=1e-15)


def test_packages_of_another_repository_of_the_workspace(cell, tmp_path):
    pytest.importorskip("xacro")
    for name, repository in (("my_arm", "arms"), ("my_cell", "cells")):
        (tmp_path / "src" / repository).mkdir()
        (tmp_path / "src" / name).rename(tmp_path / "src" / repository / name)
    path = tmp_path / "src" / "cells" / "my_cell" / "urdf" / cell.name
    assert Robot.load(path).joint_names == ("left_j1", "left_j2")


def test_arguments_follow_the_name_and_go_into_the_calibrated_urdf(cell, tmp_path, capsys):
    pytest.importorskip("xacro")
    name = f"{cell} length:=0.75"
    robot = Robot.load(name)
    np.testing.assert_allclose(robot.positions(np.zeros(2))[0, 0], [0.75, 0, 0.4], atol=1e-15)
    calibrated = robot.with_deviations({"left_j2.x": 1e-3, "left_j1.offset": 2e-3})
    changes = write_calibrated_urdf(tmp_path / "out.urdf", calibrated)
    assert changes.joints == ("left_j1", "left_j2")
    q = np.random.default_rng(0).uniform(-2, 2, (6, 2))
    again = Robot.load(tmp_path / "out.urdf")
    np.testing.assert_allclose(again.positions(q), calibrated.positions(q), atol=1e-15)
    assert main(["robots", "show", name]) == 0
    assert "left_j2" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("old", "new", "needle"),
    [
        ("my_arm", "no_arm", r"\$\(find no_arm\): expected a package, got no such package; put the folder"),
        ('<xacro:arg name="length" default="0.5"/>', "", "xacro: .*length.*arguments follow the file's name"),
        ("xacro:arm ", "xacro:leg ", "unknown macro name: xacro:leg"),
        ("arm_macro", "leg_macro", "No such file"),
        (
            "my_arm)/urdf/arm",
            "my_cell)/urdf/more",
            r"\$\(find elsewhere\): expected a package, got no such package",
        ),
    ],
)
def test_what_xacro_refuses_is_said(cell, old, new, needle):
    pytest.importorskip("xacro")
    cell.write_text(TOP.replace(old, new))
    more = '<robot xmlns:xacro="x"><xacro:include filename="$(find elsewhere)/x.xacro"/></robot>'
    (cell.parent / "more_macro.xacro").write_text(more)
    with pytest.raises(FileFormatError, match=needle):
        Robot.load(cell)


def test_without_xacro_the_extra_is_named(cell, monkeypatch):
    monkeypatch.setitem(sys.modules, "xacro", None)
    with pytest.raises(FileFormatError, match=r"a xacro file; pip install 'calib_planner\[xacro\]', or expand"):
        Robot.load(cell)
