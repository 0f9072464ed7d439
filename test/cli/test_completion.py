# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The completion script, as bash reads it."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from calib_planner.cli import main

COMPLETED = """
source /dev/stdin <<< "$1"; shift
for line in "$@"; do
    read -ra COMP_WORDS <<< "$line"
    [[ $line == *" " ]] && COMP_WORDS+=("")
    COMP_CWORD=$(( ${#COMP_WORDS[@]} - 1 ))
    COMPREPLY=()
    $(complete -p calib-planner | sed 's/.*-F \\([^ ]*\\).*/\\1/')
    echo "${COMPREPLY[*]}"
done
"""
"""What bash does when the tab key is pressed behind each of some lines; the script comes first."""


def test_bash_completes_commands_options_and_choices(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("shtab")
    assert main(["completion", "bash", "--json"]) == 0
    script = json.loads(capsys.readouterr().out)["script"]
    lines = [
        "calib-planner ide",
        "calib-planner identify --dat",
        "calib-planner identify --loss ",
        "calib-planner x",
    ]
    done = subprocess.run(
        ["bash", "-c", COMPLETED, "bash", script, *lines], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert [sorted(line.split()) for line in done.stdout.splitlines()] == [
        ["identify"],
        ["--data"],
        ["auto", "linear", "robust"],
        [],
    ]


def test_zsh_gets_all_commands(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("shtab")
    assert main(["completion", "zsh"]) == 0
    script = capsys.readouterr().out
    assert all(name in script for name in ("identify", "compensate", "--required-accuracy", "robust"))


def test_without_shtab_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert main(["completion", "bash"]) == 1
    assert "pip install 'calib_planner[completion]'" in capsys.readouterr().err
