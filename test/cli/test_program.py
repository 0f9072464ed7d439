# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``program`` as a user runs it: to a file, to stdout, as JSON, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from robots import plan_of, random_configurations

from calib_planner import Robot
from calib_planner.cli import main
from calib_planner.io import write_plan


@pytest.fixture
def plan_file(tmp_path: Path) -> str:
    robot = Robot.load("kuka_kr270")
    path = tmp_path / "plan.yaml"
    write_plan(path, plan_of(robot, random_configurations(robot, 4, 3), 2))
    return str(path)


def call(capsys: Any, *argv: str) -> tuple[int, str, str]:
    status = main(("program", *argv))
    return status, *capsys.readouterr()


def test_file_stdout_and_json_hold_the_same_program(plan_file: str, tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "visits.src"
    status, out, err = call(capsys, plan_file, "--for", "krl", "--output", str(path))
    assert status == 0 and not err and "8 measurements" in out and "jog one joint" in out and "A1" not in out
    status, text, err = call(capsys, plan_file, "--for", "krl")
    assert status == 0 and not err and path.read_bytes().decode() == text and text.count("PTP {") == 4 + 2 * 4
    status, out, _ = call(capsys, plan_file, "--for", "krl", "--json")
    assert status == 0 and json.loads(out)["program"] == text


def test_axes_in_degrees_and_the_users_template(plan_file: str, tmp_path: Path, capsys: Any) -> None:
    turned = ("--signs", "-1 1 1 1 1 1", "--zeros", "90 0 0 0 0 0", "--degrees", "--coupling", "0", "--json")
    found = json.loads(call(capsys, plan_file, "--for", "fanuc", *turned)[1])
    q = random_configurations(Robot.load("kuka_kr270"), 4, 3)
    np.testing.assert_allclose(np.array(found["axes"])[:, 0], np.pi / 2 - q[:, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.array(found["axes"])[:, 1:], q[:, 1:], rtol=0, atol=1e-12)
    mine = tmp_path / "mine.j2"
    mine.write_text(
        "{#---\ntitle: M\nsuffix: .m\nname_length: 9\nready: 1\ndone: 1\n---#}\n{{ name }} {{ ready }}\n"
    )
    assert call(capsys, plan_file, "--template", str(mine), "--ready", "4", "--name", "Go")[1] == "Go 4\n"


@pytest.mark.parametrize(
    ("options", "status", "words"),
    [
        ((), 2, ["--for --template"]),
        (("--for", "rapidd"), 2, ["rapidd", "did you mean 'rapid'"]),
        (("--template", "none.j2"), 2, ["none.j2", "an existing file"]),
        (("--for", "krl", "--signs", "1 1"), 2, ["--signs", "2 numbers", "joint_a6"]),
        (("--for", "krl", "--ready", "x"), 2, ["ready", "a whole number"]),
        (("--for", "krl", "--handshake", "shout"), 2, ["--handshake", "pause"]),
        (("--for", "krl", "--output", "no/such/folder.src"), 2, ["--output", "make the folder first"]),
        (("--for", "krl", "--constraints", "wall.yaml"), 1, ["visit 1", "no program goes there"]),
    ],
)
def test_what_cannot_be_is_one_line(
    options: tuple[str, ...],
    status: int,
    words: list[str],
    plan_file: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: Any,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wall.yaml").write_text("joint_range: {joint_a1: [-0.01, 0.01]}")
    found, out, err = call(capsys, plan_file, *options)
    assert found == status and not out and all(word in err for word in words), err
