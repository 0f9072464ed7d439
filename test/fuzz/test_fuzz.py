# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Every input that was kept, and some edits of each, ends in a value or in an error of ours; without atheris."""

from __future__ import annotations

import base64
import gzip
from pathlib import Path

import fuzz
import numpy as np
import pytest
from robots import repeats
from targets import FILES, LONGEST, MESSAGES, TARGETS

CORPUS = Path(__file__).parent / "corpus"
EDITS = repeats(6, 2000)


def edited(data: bytes, rng: np.random.Generator) -> bytes:
    """Some bytes changed, taken out, doubled or cut off."""
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(0, len(changed) + 1))
        way, length = int(rng.integers(0, 4)), int(rng.integers(1, 9))
        if way == 0 and at < len(changed):
            changed[at] = int(rng.integers(0, 256))
        elif way == 1:
            del changed[at : at + length]
        elif way == 2:
            changed[at:at] = changed[at : at + length] or b"9"
        elif rng.random() < 0.2:
            del changed[at:]
    return bytes(changed[:LONGEST])


def inputs(name: str) -> list[bytes]:
    return [p.read_bytes() for p in sorted((CORPUS / name).glob("*"))]


def test_every_target_has_a_corpus_and_nothing_else_has() -> None:
    assert {p.name for p in CORPUS.iterdir()} == set(FILES)
    assert all(inputs(name) for name in FILES)
    assert sum(p.stat().st_size for p in CORPUS.rglob("*") if p.is_file()) < 500_000


@pytest.mark.parametrize("name", FILES)
def test_files(name: str) -> None:
    rng = np.random.default_rng(0)
    for data in inputs(name):
        TARGETS[name](data)
        for _ in range(EDITS):
            TARGETS[name](edited(data, rng))


@pytest.mark.ros
@pytest.mark.parametrize("name", MESSAGES)
def test_messages(name: str) -> None:
    pytest.importorskip("calib_planner_msgs", reason="needs ROS 2 (source env.sh)")
    rng = np.random.default_rng(0)
    for _ in range(repeats(60, 20_000)):
        TARGETS[name](rng.bytes(int(rng.integers(0, 200))))


def test_what_failed_can_be_run_again_from_what_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = b"\x00\xffl1: {\n" * 3
    failed = tmp_path / "failed-prior-crash-1"
    failed.write_bytes(data)
    text = fuzz.repeat(failed, "prior")
    again = tmp_path / "again"
    again.write_bytes(gzip.decompress(base64.b64decode(text.split("echo ")[1].split(" | ")[0])))
    assert again.read_bytes() == data and text.endswith("prior")

    seen: list[bytes] = []
    monkeypatch.setitem(TARGETS, "prior", seen.append)
    monkeypatch.setattr("sys.argv", ["fuzz.py", "--input", str(again), "prior"])
    assert fuzz.main() == 0 and seen == [data]
