# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Writing: the whole file or the old one, the permissions kept, and the option named when it fails."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from calib_planner import FileFormatError, InputError
from calib_planner.io import check_writable, fresh_folder, write_text
from calib_planner.io.text import decode_any


def test_replaces_and_keeps_permissions(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    path.chmod(0o640)
    write_text(path, "new\n")
    assert path.read_text() == "new\n"
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_follows_links(tmp_path: Path) -> None:
    (tmp_path / "real").write_text("old")
    (tmp_path / "link").symlink_to("real")
    write_text(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real").read_text() == "new"


def test_a_failure_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left"):
        write_text(path, "new")
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("name", [".", "missing/a.txt", "file/a.txt"])
def test_unwritable_paths_name_the_option(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError) as caught:
        write_text(tmp_path / name, "x", "--output")
    assert caught.value.field == "--output" and "choose another path" in str(caught.value)


def test_devices_are_written_to(tmp_path: Path) -> None:
    check_writable(os.devnull)
    write_text(os.devnull, "x")
    assert not Path(os.devnull).is_file()


def test_a_fresh_folder_never_holds_earlier_results(tmp_path: Path) -> None:
    first = fresh_folder(tmp_path / "new" / "demo")
    assert first == tmp_path / "new" / "demo" and fresh_folder(first) == first  # still empty
    (first / "a").write_text("")
    second = fresh_folder(first)
    (second / "b").write_text("")
    assert second.name == "demo-2" and fresh_folder(first).name == "demo-3"
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="out"):
        fresh_folder(tmp_path / "file", "out")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_nul_is_no_character_of_a_text(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "points.csv"
    path.write_bytes("q1,q2,x,y,z\n1,2,\0,4,5\n".encode(encoding))
    with pytest.raises(FileFormatError, match="line 2: expected a table, got a NUL character; save it as text"):
        decode_any(path, "a table", path.read_bytes())
