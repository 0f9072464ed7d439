# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Mutation testing of the formulas: change one operator or number at a time, and see whether a test fails.

    python tools/mutation [--sample N] [--seed S] [--report FILE] [--write] [FILE …]
    make mutation MUTATION='--sample 40 calib_planner/planning/criteria.py'

The mutants are cosmic-ray's, from an environment of its own, since its requirements contradict those of the
pages. ``formulas.py`` says which of them change a formula; the others are left out by that rule. ``runner.py``
tests them in forks of a warm process, in a copy of the checkout without the compiled kernels, so that NumPy's
formulas run.

``test/mutants.yaml`` lists mutants that no test can catch, each with the reason: they give the same values, or
another, equally good way to the same end. The tool demands that each entry still is a mutant of its file.
``same_by_rule`` in ``formulas.py`` lists one frequent kind without an entry.

Where an entry of the report says ``few_tests``, it was made with a few test files only; the page marks it.

``--sample`` draws that many of each file, with a seed; the share of a sample of n has a standard error of at
most 0.5/√n. ``--write`` puts the figures of the report, all files together, into ``docs/proof.md``.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import subprocess
import sys
import tempfile
import venv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

sys.path.insert(0, str(Path(__file__).parent))
from formulas import Formulas, changes_formula, same_by_rule

ROOT = Path(__file__).resolve().parents[2]
COSMIC_RAY = "cosmic-ray==8.7.0"
ENVIRONMENT = ROOT / "build" / "mutation"
LIST = ROOT / "test" / "mutants.yaml"
PAGE = ROOT / "docs" / "proof.md"
BEGIN, END = "<!-- mutants: written by tools/mutation --write -->", "<!-- end of mutants -->"
ROOMS = ("robot", "error_model", "planning", "identification")
BESIDE = ("test/test_compensation.py",)
"""Tests of formulas outside the folders of the rooms: what compensation makes of inverse kinematics."""
FILES = {
    "robot": "kinematics elements linearisation coupling chain capsules identifiability inverse limits masses "
    "origins parameters",
    "error_model": "gravity joint_functions placement visits points knowledge model poses prior truth typical",
    "planning": "criteria information extended bound budget feasibility planner random_plans tour trajectory "
    "search/apart search/descent search/enumeration search/exchange search/interior search/multistart "
    "search/rounding search/swaps certify/bernstein certify/branch_and_bound certify/polynomial certify/prove "
    "constraints/room constraints/tracker constraints/self_collision",
    "identification": "registration likelihood left_out estimation solver doubt alternatives rejection term_gain "
    "validation verdict estimate",
}
"""Files with formulas, by room."""


def formula_files() -> list[str]:
    return [f"calib_planner/{room}/{name}.py" for room, names in FILES.items() for name in names.split()]


class CosmicRay:
    """cosmic-ray, working on one file in its own environment; installed if it is not there."""

    def __init__(self, file: str) -> None:
        python = ENVIRONMENT / "bin" / "python"
        if not (ENVIRONMENT / "bin" / "cosmic-ray").exists():
            venv.create(ENVIRONMENT, with_pip=True)
            pip = [str(python), "-m", "pip", "install", "-q", "--disable-pip-version-check"]
            subprocess.run([*pip, COSMIC_RAY], check=True)
        command = [str(python), str(Path(__file__).parent / "cosmic.py"), str(ROOT / file)]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, encoding="utf-8")
        self.specifications: list[list[Any]] = self.answer()

    def answer(self) -> Any:
        assert self.process.stdout
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError("cosmic-ray ended early")
        return json.loads(line)

    def mutated(self, operator: str, occurrence: int) -> str:
        """The source of a mutant."""
        assert self.process.stdin
        print(json.dumps([operator, occurrence]), file=self.process.stdin, flush=True)
        return str(self.answer())

    def close(self) -> None:
        assert self.process.stdin
        self.process.stdin.close()
        self.process.wait()


def copied(folder: Path) -> None:
    """The files of the checkout, as they are, without what is built."""
    command = ["git", "ls-files", "-co", "--exclude-standard", "-z"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)


def change(source: list[str], mutated: list[str], line: int) -> tuple[str, str]:
    """The lines that differ, before and after, without indentation, joined by a blank."""
    first = next((i for i, (a, b) in enumerate(zip(source, mutated, strict=False)) if a != b), line - 1)
    tail = 0
    while tail < min(len(source), len(mutated)) - first - 1 and source[-1 - tail] == mutated[-1 - tail]:
        tail += 1
    old, new = (" ".join(x.strip() for x in text[first : len(text) - tail]) for text in (source, mutated))
    return old, new


def mutants(file: str, sample: int, seed: int, known: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """First {"mutants": how many there are}; then each one that is drawn, with its text.

    Those that are listed get their ``reason`` instead; every entry of the list has to be a mutant.
    """
    source = (ROOT / file).read_text(encoding="utf-8")
    lines, formulas = source.splitlines(), Formulas(source)
    cosmic = CosmicRay(file)
    jobs = [
        (operator, occurrence, line, function)
        for operator, occurrence, line, column, function in cosmic.specifications
        if changes_formula(operator) and (line, column) in formulas
    ]
    yield {"mutants": len(jobs)}
    chosen = jobs if sample <= 0 or sample >= len(jobs) else sorted(random.Random(seed).sample(jobs, sample))
    entries = {(e["line"], m): e["reason"] for e in known for m in listed(e["mutant"])}
    missing = set(entries)
    for job in jobs:
        first, last = formulas.statements.get(job[2], (job[2], job[2]))
        statement = " ".join(x.strip() for x in lines[first - 1 : last])
        wanted = job in chosen
        if not wanted and not any(old in statement or statement in old for old, _ in missing):
            continue
        text = cosmic.mutated(*job[:2])
        old, new = change(lines, text.splitlines(), job[2])
        reason = entries.get((old, new)) or same_by_rule(old, new)
        missing.discard((old, new))
        if wanted:
            told = {"line": first, "last": last, "at": job[2], "function": job[3], "old": old, "new": new}
            yield told | ({"reason": reason} if reason else {"text": text})
    cosmic.close()
    if missing:
        raise SystemExit(f"{LIST.relative_to(ROOT)}: no mutants of {file}: {sorted(missing)}")


def listed(entry: str | list[str]) -> list[str]:
    return [entry] if isinstance(entry, str) else entry


def run(files: list[str], sample: int, seed: int, target: Path) -> None:
    """Test the mutants of these files and write what came out into the report, beside what it holds."""
    known = yaml.safe_load(LIST.read_text(encoding="utf-8")) if LIST.exists() else []
    report = json.loads(target.read_text(encoding="utf-8")) if target.exists() else {}
    with tempfile.TemporaryDirectory(prefix="mutation") as name:
        folder, work = Path(name) / "copy", Path(name)
        copied(folder)
        for file in files:
            made = mutants(file, sample, seed, [e for e in known or [] if e["file"] == file])
            report[file] = {
                **next(made),
                "seed": seed,
                "tried": 0,
                "caught": 0,
                "seconds": 0.0,
                "listed": [],
                "survivors": [],
            }
            with (work / Path(file).with_suffix("").as_posix().replace("/", ".")).open(
                "w", encoding="utf-8"
            ) as out:
                for mutant in made:
                    report[file]["tried"] += 1
                    if "reason" in mutant:
                        report[file]["listed"].append(mutant)
                    else:
                        print(json.dumps(mutant), file=out)
        job = {
            "files": files,
            "mutants": {f: str(work / Path(f).with_suffix("").as_posix().replace("/", ".")) for f in files},
            "tests": [*(f"test/{room}" for room in ROOMS), *BESIDE],
            "map": str(ENVIRONMENT / "map"),
            "out": str(work / "out"),
        }
        (work / "job").write_text(json.dumps(job), encoding="utf-8")
        command = [sys.executable, str(Path(__file__).with_name("runner.py")), str(work / "job")]
        (work / "out").touch()
        with (
            subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL) as process,
            (work / "out").open() as out,
        ):
            while True:
                ended = process.poll() is not None
                for line in out:
                    take(report, json.loads(line), target)
                if ended:
                    break
                try:
                    process.wait(2.0)
                except subprocess.TimeoutExpired:
                    continue
        if process.returncode:
            raise SystemExit(f"the tests ended with status {process.returncode}")
    target.write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    for file in files:
        print(told(file, report[file]), flush=True)


def take(report: dict[str, Any], mutant: dict[str, Any], target: Path) -> None:
    """One result into the report."""
    of = report[mutant.pop("file")]
    of["seconds"] = round(of["seconds"] + mutant["seconds"], 2)
    if mutant["by"]:
        of["caught"] += 1
    else:
        of["survivors"].append(mutant)
        print(f"{mutant['function']}:{mutant['at']}\n  - {mutant['old']}\n  + {mutant['new']}", flush=True)
    target.write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def told(file: str, of: dict[str, Any]) -> str:
    left = of["tried"] - len(of["listed"])
    counts = f"{of['caught']} of {left} caught, {len(of['listed'])} listed ({of['mutants']} in all)"
    return f"{file}: {counts}, {of['seconds']:.0f} s"


def page(report: dict[str, Any]) -> str:
    """The section of the page, between its marks."""
    rows = ["| file | mutants | tried | listed | caught | of those not listed |", "|---|---|---|---|---|---|"]
    for room in ROOMS:
        here = {f: of for f, of in report.items() if f.startswith(f"calib_planner/{room}/")}
        together = [0, 0, 0, 0]
        for file in (f for f in formula_files() if f in here):
            of = here[file]
            numbers = [of["mutants"], of["tried"], len(of["listed"]), of["caught"]]
            together = [a + b for a, b in zip(together, numbers, strict=True)]
            mark = " *" if of.get("few_tests") else ""
            rows.append(row(f"`{file.removeprefix('calib_planner/')}`{mark}", numbers))
        if together[1]:
            rows.append(row(f"**{room}**", together))
    alive = [(f, m) for f in formula_files() if f in report for m in report[f]["survivors"]]
    lines = [
        f"* `{f.removeprefix('calib_planner/')}`, {m['function']}: `{m['old']}` → `{m['new']}`" for f, m in alive
    ]
    return "\n".join([BEGIN, "", *rows, "", "Not caught and not listed:", "", *(lines or ["none"]), "", END])


def row(name: str, numbers: list[int]) -> str:
    _, tried, known, caught = numbers
    share = 100.0 * caught / max(tried - known, 1)
    return f"| {name} | " + " | ".join(map(str, numbers)) + f" | {share:.0f} % |"


def main() -> int:
    """Run, print a line a file, write the report."""
    parser = argparse.ArgumentParser(prog="tools/mutation", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("files", nargs="*", metavar="FILE", help="files of the table; all if none is named")
    parser.add_argument("--sample", type=int, default=0, help="mutants of each file; 0: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--report", default="results/mutation.json", help="JSON with the survivors")
    parser.add_argument("--write", action="store_true", help="only write the report into docs/proof.md")
    options = parser.parse_args()
    target = ROOT / options.report
    target.parent.mkdir(exist_ok=True)
    if options.write:
        text = PAGE.read_text(encoding="utf-8")
        before, rest = text.split(BEGIN)
        section = page(json.loads(target.read_text(encoding="utf-8")))
        PAGE.write_text(before + section + rest.split(END)[1], encoding="utf-8")
        return 0
    files = options.files or formula_files()
    if unknown := [f for f in files if f not in formula_files()]:
        parser.error(f"{unknown[0]} has no row in FILES")
    run(files, options.sample, options.seed, target)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
