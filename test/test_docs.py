"""The examples in docs/ run as they stand, and those of one page agree with each other."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
BLOCK = re.compile(r"<!-- run -->\n```python\n(.*?)```", re.DOTALL)


def pages() -> list[str]:
    return sorted(p.name for p in DOCS.glob("*.md") if BLOCK.search(p.read_text()))


def test_scaling_is_among_the_pages_with_examples():
    assert "scaling.md" in pages()


@pytest.mark.parametrize("page", pages())
def test_examples_run_and_agree(page, tmp_path):
    if page == "scaling.md":
        pytest.importorskip("distributed")
    answers = set()
    for number, code in enumerate(BLOCK.findall((DOCS / page).read_text())):
        script = tmp_path / f"example{number}.py"
        script.write_text(code)
        done = subprocess.run(
            [sys.executable, str(script)],
            cwd=tmp_path,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        answers.add(done.stdout)
    assert len(answers) == 1


README = (DOCS.parent / "README.md").read_text()


def test_readme_library_example_runs(tmp_path):
    code = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(code) == 1
    done = subprocess.run(
        [sys.executable, "-c", code[0]], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert "efficiency 0.99" in done.stdout


def test_readme_commands_run(tmp_path):
    """Every calib-planner command of the README, in its order, in an empty folder."""
    blocks = re.findall(r"```bash\n(.*?)```", README, re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    commands = [line for line in lines if line.startswith("calib-planner ")]
    assert len(commands) >= 7
    for command in commands:
        words = command.replace("calib-planner", f"{sys.executable} -m calib_planner", 1)
        done = subprocess.run(words, shell=True, cwd=tmp_path, capture_output=True, text=True, timeout=180)
        assert done.returncode == 0, f"{command}\n{done.stderr}"
