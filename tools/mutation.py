# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Mutation testing of the formulas: change one operator or number at a time, and see whether a test fails.

    python tools/mutation.py [--sample N] [--seed S] [--report FILE] [FILE …]
    make mutation MUTATION='--sample 40 calib_planner/planning/criteria.py'

The mutants are cosmic-ray's, in an environment of its own, since its requirements contradict those of the pages.
They are made in a copy of the checkout without the compiled kernels, so that NumPy's formulas run. A mutant
is *caught* if the tests of its row in ``FILES`` fail or take too long. Left out are mutants of annotations and
decorators, which change no formula.

All of them take a day: ten seconds a mutant, some thousands. ``--sample`` draws that many of each file, with a
seed; the share of a sample of n has a standard error of at most 0.5/√n.
"""

from __future__ import annotations

import argparse
import ast
import json
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
COSMIC_RAY = "cosmic-ray==8.7.0"
ENVIRONMENT = ROOT / "build" / "mutation"
FILES = {
    "calib_planner/robot/kinematics.py": "test/robot/test_derivatives.py test/robot/test_robot.py",
    "calib_planner/robot/elements.py": "test/robot/test_derivatives.py test/robot/test_robot.py "
    "test/robot/test_dh.py",
    "calib_planner/robot/linearisation.py": "test/robot/test_derivatives.py",
    "calib_planner/robot/coupling.py": "test/robot/test_coupling.py",
    "calib_planner/error_model/gravity.py": "test/error_model/test_terms.py test/error_model/test_link_masses.py "
    "test/robot/test_coupling.py",
    "calib_planner/error_model/joint_functions.py": "test/error_model/test_terms.py",
    "calib_planner/error_model/placement.py": "test/error_model/test_terms.py",
    "calib_planner/error_model/visits.py": "test/error_model/test_terms.py test/error_model/test_truth.py",
    "calib_planner/error_model/points.py": "test/error_model/test_terms.py test/error_model/test_truth.py",
    "calib_planner/error_model/knowledge.py": "test/error_model/test_knowledge.py",
    "calib_planner/planning/criteria.py": "test/planning/test_criteria.py",
    "calib_planner/planning/information.py": "test/planning/test_criteria.py test/planning/test_two_link.py",
    "calib_planner/planning/extended.py": "test/planning/test_extended.py",
    "calib_planner/identification/registration.py": "test/identification/test_registration.py "
    "test/identification/test_properties.py",
    "calib_planner/identification/likelihood.py": "test/error_model/test_likelihood.py "
    "test/identification/test_properties.py",
    "calib_planner/identification/left_out.py": "test/error_model/test_likelihood.py "
    "test/identification/test_properties.py",
}
"""File with formulas → the quick tests that know its answers."""
LEAST, TIMES = 30.0, 5.0
"""A mutant may take as many times as long as the tests do without it, and this many seconds at least."""


def cosmic_ray() -> Path:
    """The program, installed if it is not there."""
    program = ENVIRONMENT / "bin" / "cosmic-ray"
    if not program.exists():
        venv.create(ENVIRONMENT, with_pip=True)
        pip = [str(ENVIRONMENT / "bin" / "python"), "-m", "pip", "install", "-q", "--disable-pip-version-check"]
        subprocess.run([*pip, COSMIC_RAY], check=True)
    return program


def copied(folder: Path) -> None:
    """The files of the checkout, as they are, without what is built."""
    command = ["git", "ls-files", "-co", "--exclude-standard", "-z"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)


def idle_ranges(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Where annotations and decorators stand: (line, column) of their beginning and end."""
    nodes: list[ast.expr] = []
    for node in ast.walk(ast.parse(source)):
        for name in ("annotation", "returns"):
            if isinstance(part := getattr(node, name, None), ast.expr):
                nodes.append(part)
        nodes += getattr(node, "decorator_list", [])
    return [((n.lineno, n.col_offset), (n.end_lineno or 0, n.end_col_offset or 0)) for n in nodes]


def run(file: str, sample: int, seed: int, folder: Path) -> dict[str, object]:
    """Mutants of one file: how many there are, were tried and were caught, and those that were not."""
    tests = f"{sys.executable} -m pytest -x -q -p no:cacheprovider -p no:randomly {FILES[file]}"
    began = time.monotonic()
    subprocess.run(tests.split(), cwd=folder, check=True, capture_output=True)
    limit = max(LEAST, TIMES * (time.monotonic() - began))
    config, session = folder / "mutation.toml", folder / "mutation.sqlite"
    session.unlink(missing_ok=True)
    config.write_text(
        f'[cosmic-ray]\nmodule-path = "{file}"\ntimeout = {limit:.0f}\nexcluded-modules = []\n'
        f'test-command = "{tests}"\n[cosmic-ray.distributor]\nname = "local"\n'
    )
    program = str(cosmic_ray())
    subprocess.run([program, "init", str(config), str(session)], cwd=folder, check=True, capture_output=True)
    idle = idle_ranges((ROOT / file).read_text(encoding="utf-8"))
    with sqlite3.connect(session) as database:
        rows = database.execute("select job_id, start_pos_row, start_pos_col from mutation_specs").fetchall()
        jobs = sorted(j for j, line, column in rows if not any(a <= (line, column) < b for a, b in idle))
        chosen = jobs if sample <= 0 or sample >= len(jobs) else random.Random(seed).sample(jobs, sample)
        for table in ("mutation_specs", "work_items"):
            marks = ",".join("?" * len(chosen))
            database.execute(f"delete from {table} where job_id not in ({marks})", chosen)
    subprocess.run([program, "exec", str(config), str(session)], cwd=folder, check=True, capture_output=True)
    with sqlite3.connect(session) as database:
        done = database.execute("select job_id, test_outcome, diff from work_results").fetchall()
    alive = [diff for _, outcome, diff in done if "SURVIVED" in str(outcome).upper()]
    survivors = [
        "\n".join(x for x in (d or "").splitlines() if x[:1] in "+-@" and x[:3] not in ("+++", "---"))
        for d in alive
    ]
    return {
        "mutants": len(jobs),
        "tried": len(done),
        "caught": len(done) - len(alive),
        "survivors": sorted(survivors),
    }


def main() -> int:
    """Run, print a line a file, write the report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("files", nargs="*", metavar="FILE", help="files of the table; all if none is named")
    parser.add_argument("--sample", type=int, default=0, help="mutants of each file; 0: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--report", default="results/mutation.json", help="JSON with the survivors")
    options = parser.parse_args()
    files = options.files or list(FILES)
    if unknown := [f for f in files if f not in FILES]:
        parser.error(f"{unknown[0]} has no row in FILES")
    report: dict[str, dict[str, object]] = {}
    target = ROOT / options.report
    target.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="mutation") as name:
        copied(Path(name))
        for file in files:
            report[file] = run(file, options.sample, options.seed, Path(name))
            of = report[file]
            print(f"{file}: {of['caught']} of {of['tried']} caught ({of['mutants']} in all)", flush=True)
            target.write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    tried, caught = (sum(int(str(of[k])) for of in report.values()) for k in ("tried", "caught"))
    print(f"caught {caught} of {tried}: {100 * caught / max(tried, 1):.0f} %")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
