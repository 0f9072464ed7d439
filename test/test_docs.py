# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Every example of README and docs/ runs as it stands and prints what it promises; references are current."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from docs_examples import ROOT, blocks, environment, examples, expectations, run, said
from robots import PROVE, repeats
from warm_commands import warm_commands

from calib_planner.cli import main
from calib_planner.identification import RULES

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "paper" / "README.md", *sorted(DOCS.rglob("*.md"))]
KINDS = {"bash run", "python", "text output", "text", "yaml", "{toctree}", "{eval-rst}"}
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


def record_bag(folder: Path) -> None:
    """The recording that docs/real-robot-data.md reads: the UR10e of the examples before a tracker."""
    pytest.importorskip("rosbags")
    sys.path.insert(0, str(ROOT / "test" / "io"))
    from bags import campaign, write_bag

    from calib_planner import Robot
    from calib_planner.io import read_data
    from calib_planner.simulation import SimulatedCell, random_deviations

    robot = Robot.load(DOCS / "examples" / "ur10e.urdf").with_targets([[0.06, 0.0, 0.03]])
    robot = robot.with_base(np.eye(3), [2.0, -1.0, 0.5])
    cell = SimulatedCell(robot, random_deviations(robot, 1))
    stops = read_data(DOCS / "examples" / "measured.csv", robot).data.q[:14]
    write_bag(folder / "monday_1", campaign(cell, stops), ("/joint_states", "/leica/point"))


LONG = ("how-many.md", "scaling.md")
"""Pages whose commands other pages or tests have, too, and whose examples take long: ``make prove`` runs them."""
PREPARED: dict[str, Callable[[Path], None]] = {"docs/real-robot-data.md": record_bag}


@pytest.fixture(scope="module")
def programs() -> Iterator[Path]:
    """``calib-planner`` and ``python``; the imports that all pages' commands share are made once."""
    with tempfile.TemporaryDirectory() as folder, warm_commands(Path(folder), environment()) as made:
        yield made


@pytest.mark.parametrize("shell", repeats(("bash",), ("bash", "zsh")))
@pytest.mark.parametrize("page", [p for p in PAGES if examples(p) and (PROVE or p.name not in LONG)], ids=named)
def test_examples_run_and_print_what_the_page_says(
    page: Path, shell: str, tmp_path: Path, programs: Path
) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    if page.name == "scaling.md":
        pytest.importorskip("distributed")
    PREPARED.get(named(page), lambda _: None)(tmp_path)
    done = run(page, tmp_path, programs=programs, shell=shell)
    shown = examples(page)
    assert done.status == 0, f"{page.name}, line {shown[len(done.printed) - 1].line}:\n{done.errors}"
    for number, line in expectations(page):
        assert said(line, done.printed[number]), (
            f"{page.name} promises:\n{line}\nbut got:\n{done.printed[number]}"
        )
    if page.name == "scaling.md":
        assert len(set(done.printed)) == 1, "the same seed, the same plan, whatever the executor"


def test_the_pages_that_users_follow_have_examples() -> None:
    for name in ("README.md", "docs/quick-start.md", "docs/tutorial.md", "docs/how-many.md", "docs/applying.md"):
        assert len(examples(ROOT / name)) >= 2, name
    assert expectations(DOCS / "tutorial.md")


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_what_looks_like_an_example_is_one(page: Path) -> None:
    """No commands or Python outside the blocks that run: indented, or in a block of a kind that hides them."""
    assert {b.kind for b in blocks(page)} <= KINDS
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    assert not re.findall(r"^    (?:calib-planner|from calib_planner|import |ros2 |pip ).*$", text, re.MULTILINE)


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page: Path) -> None:
    targets = [t for t in LINK.findall(page.read_text(encoding="utf-8")) if "://" not in t]
    assert not [t for t in targets if not (page.parent / t).exists()]


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_files_that_are_named_exist(page: Path) -> None:
    """Every ``folder/file.py`` and ``folder/`` in backticks is in the repository, by the end of its path."""
    text = page.read_text(encoding="utf-8")
    folders = ("calib_planner", "paper", "test", "bench", "tools", "config", "docs", "launch", "msg_defs")
    here = [p.relative_to(ROOT).as_posix() for f in folders for p in (ROOT / f).rglob("*")] + [
        "setup.py",
        *folders,
    ]
    readers = re.findall(r"<!-- file: ([^ >]+) -->", text)  # files for the reader's own cell
    named_files = set(re.findall(r"`((?:\w+/)*\w+\.py|(?:\w+/)+)`", text)) - set(readers)
    assert not [n for n in named_files if not any(f"/{p}".endswith(f"/{n.rstrip('/')}") for p in here)]


def test_the_runner_sees_failures_and_wrong_output(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "```bash run\necho one   two\n```\n```text output\none … two\n```\n```python\nraise SystemExit(3)\n```\n"
    )
    folder = tmp_path / "folder"
    folder.mkdir()
    done = run(page, folder)
    assert done.status == 3 and len(done.printed) == 2
    assert expectations(page) == [(0, "one … two")]
    assert said("one … two", done.printed[0]) and not said("two one", done.printed[0])
    hidden = "<!-- not run: no robot here -->\n```python\nraise SystemExit(3)\n```\n"
    page.write_text(hidden)
    assert blocks(page) == []


def test_forked_commands_and_scripts_are_like_processes_of_their_own(programs: Path, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text("import sys\nprint(sys.argv, __name__)\nraise SystemExit(3)\n")
    calls = (
        ("calib-planner", "robots", "show", "planar_2r", "--json"),
        ("calib-planner", "robots", "show", "nothing"),
        ("python", str(script), "a b"),
    )
    for name, *words in calls:
        first, *others = (
            subprocess.run(
                [path / name, *words], cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=60
            )
            for path in (Path(sys.executable).parent, programs, programs)
        )
        for done in others:
            assert (done.returncode, done.stdout, done.stderr) == (first.returncode, first.stdout, first.stderr)
    script.write_text("1 / 0\n")
    done = subprocess.run([programs / "python", script], capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and done.stderr.endswith("\nZeroDivisionError: division by zero\n")


# ---- reference pages -----------------------------------------------------------------------------
def test_reference_pages_are_what_the_code_says(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "tools" / "reference"), str(tmp_path)]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    made = sorted(tmp_path.iterdir())
    assert {"codes.md", "command-line.md"} <= {p.name for p in made}
    stale = [p.name for p in made if p.read_text() != (DOCS / "reference" / p.name).read_text()]
    assert not stale, f"write them again: python tools/reference ({', '.join(stale)})"


def test_command_line_page_has_every_option_of_help(capsys: pytest.CaptureFixture[str]) -> None:
    page = (DOCS / "reference" / "command-line.md").read_text()
    sections = dict(re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", page, re.DOTALL | re.MULTILINE))
    main(["--help"])
    commands = re.findall(r"^    (\w+)(?: |$)", capsys.readouterr().out, re.MULTILINE)
    assert len(commands) >= 9 and sorted(commands) == sorted(sections)
    for name in commands:
        main([name, "--help"])
        options = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", capsys.readouterr().out.split("\noptions:")[0]))
        assert not [o for o in options if f"`{o}" not in sections[name]], name


def test_codes_page_has_every_reason_of_the_verdict() -> None:
    page = (DOCS / "reference" / "codes.md").read_text()
    written = {rule.code for rule in RULES.values()}
    verdict = page.split("## Verdict")[1].split("\n## ")[0]
    assert len(written) > 15
    shown = set(re.findall(r"^\| `(\w+)` \| (?:PASS|WARN|FAIL)", verdict, re.MULTILINE))
    assert written == shown


def test_interfaces_page_has_every_field_and_constant() -> None:
    messages = pytest.importorskip("calib_planner_msgs.msg", reason="needs ROS 2 (source env.sh)")
    page = (DOCS / "reference" / "interfaces.md").read_text()
    for name in ("Plan", "Measurement", "CalibrationEstimate"):
        kind = getattr(messages, name)
        part = page.split(f"### {name}\n")[1].split("\n### ")[0]
        for field in kind.get_fields_and_field_types():
            assert f"| `{field}` |" in part, f"{name}.{field}"
        constants = re.findall(r"^\| `([A-Z_]+)` \| `(\d+)` \|", part, re.MULTILINE)
        assert constants and all(getattr(kind, key) == int(value) for key, value in constants)


def test_parameters_page_has_every_parameter_of_the_shipped_files() -> None:
    page = (DOCS / "reference" / "parameters.md").read_text()
    for name in ("planner", "identifier", "simulator"):
        keys = re.findall(r"^    (\w+): ", (ROOT / "config" / f"{name}.yaml").read_text(), re.MULTILINE)
        part = page.split(f"`{name}_node`.")[1].split("\n## ")[0]
        assert keys and keys == re.findall(r"^\| `(\w+)` \|", part, re.MULTILINE)


def test_example_urdf_is_the_shipped_ur10e() -> None:
    from calib_planner import Robot

    shipped = Robot.load("ur10e")
    ours = Robot.load(DOCS / "examples" / "ur10e.urdf").with_targets(shipped.target_offsets)
    q = np.random.default_rng(0).uniform(-3, 3, (20, 6))
    assert ours.joint_names == shipped.joint_names
    np.testing.assert_allclose(ours.positions(q), shipped.positions(q), atol=1e-12)
    np.testing.assert_allclose(ours.joint_limits, shipped.joint_limits, atol=1e-12)
