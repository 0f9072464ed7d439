# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What a release needs: one version everywhere, and the header of every source file."""

from __future__ import annotations

import shutil
from datetime import date
from pathlib import Path

import headers
import room_picture
import version
from test_rooms import ROOMS

ROOT = Path(__file__).parents[1]


def test_versions_agree() -> None:
    stated = version.versions()
    assert len(stated) > 4 and len(set(stated.values())) == 1 and all(stated.values()), stated


def test_a_release_writes_every_version(tmp_path: Path) -> None:
    for name in (*version.PLACES, version.CHANGELOG):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    changelog = tmp_path / version.CHANGELOG
    if version.UNRELEASED not in changelog.read_text(encoding="utf-8"):
        changelog.write_text(version.UNRELEASED, encoding="utf-8")
    version.write("7.8.9", date(2030, 1, 2), tmp_path)
    assert version.versions(tmp_path) == dict.fromkeys((*version.PLACES, version.CHANGELOG), "7.8.9")
    assert "## 7.8.9 (2030-01-02)" in changelog.read_text(encoding="utf-8")
    (tmp_path / "package.xml").write_text("<version>7.8</version>", encoding="utf-8")
    assert version.versions(tmp_path)["package.xml"] == ""


def test_headers_go_behind_what_must_be_first() -> None:
    first, second = (f"# {line}" for line in headers.LINES)
    script = headers.with_header(Path("a.sh"), "#!/bin/sh\nx\n")
    assert script.splitlines() == ["#!/bin/sh", first, second, "x"]
    for name in ("a.sh", "a.py"):
        assert headers.with_header(Path(name), script) == script
    assert headers.with_header(Path("a.c"), "int x;\n").startswith("/* Copyright ")


def test_the_picture_of_the_rooms_is_what_the_page_and_the_test_say() -> None:
    page = room_picture.rooms(room_picture.PAGE.read_text(encoding="utf-8"))
    assert page == {room: set(uses.split()) for room, uses in ROOMS.items()}
    assert room_picture.drawn(page) == room_picture.PICTURE.read_text(encoding="utf-8"), "tools/room_picture.py"
    assert room_picture.nearest({"a": set(), "b": {"a"}, "c": {"a", "b"}})["c"] == {"b"}


def test_every_source_file_has_the_header() -> None:
    assert not [p for p in headers.sources() if headers.with_header(p, p.read_text()) != p.read_text()]
