# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The report of a calibration: is it good, how good, which numbers say so, how to apply it, where it comes from.

``calibration_report`` gathers a problem, its estimate and what is drawn of them; ``write_report`` makes one HTML
file of it that needs nothing else. The page also holds all of it as JSON, ``<script id="report-data">``, where
``estimate`` is ``Estimate.to_dict()`` unchanged.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from calib_planner import __version__
from calib_planner.arrays import FloatArray, plain
from calib_planner.errors import FileFormatError, InputError
from calib_planner.identification import Estimate, IdentificationProblem, place_nominal
from calib_planner.io import config_folder, shipped_robots
from calib_planner.report.scene import Scene, scene_of

# ── where a result comes from: which files, which program, when and how, so that it can be made again ────

LIBRARIES = ("numpy", "scipy")
"""Libraries whose versions can change a result."""


@dataclass(frozen=True)
class InputFile:
    """A file that went in.

    Attributes:
        role: What it was used as: ``robot``, ``data``, ``held out``, ….
        name: As the user wrote it.
        sha256: Of its content; of a folder's file names and contents.
    """

    role: str
    name: str
    sha256: str


@dataclass(frozen=True)
class Provenance:
    """Everything that is needed to make a result again.

    Attributes:
        inputs: Files that went in.
        command: The command line; empty where there was none.
        seed: Of all random numbers; ``None`` where there were none.
        estimate: Name of the file that the estimate was written to; empty if it was not.
        written: Date and time, ISO 8601 in UTC.
        versions: Program → version.
    """

    inputs: tuple[InputFile, ...] = ()
    command: str = ""
    seed: int | None = None
    estimate: str = ""
    written: str = field(default_factory=lambda: datetime.now(timezone.utc).isoformat(timespec="seconds"))
    versions: Mapping[str, str] = field(default_factory=lambda: _versions())

    def named(self, role: str) -> str:
        """Name of the first input of that role; empty without one."""
        return next((i.name for i in self.inputs if i.role == role), "")

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {**asdict(self), "inputs": [asdict(i) for i in self.inputs], "versions": dict(self.versions)}


def provenance(
    files: Iterable[tuple[str, str | Path]] = (),
    *,
    command: str = "",
    seed: int | None = None,
    estimate: str = "",
) -> Provenance:
    """Provenance with the hashes of ``files``, pairs (role, path); the other arguments as in ``Provenance``.

    The name of a robot that comes with the package stands for the path of its YAML.

    Raises:
        FileFormatError: A file cannot be read.
    """
    inputs = []
    for role, name in files:
        shipped = role == "robot" and str(name) in shipped_robots()
        path = config_folder() / "robots" / f"{name}.yaml" if shipped else name
        inputs.append(InputFile(role, _text(name), sha256_of(path)))
    return Provenance(tuple(inputs), _text(command), seed, _text(estimate))


def sha256_of(path: str | Path) -> str:
    """Hexadecimal SHA-256 of a file; of a folder: of the sorted lines ``hash name`` of the files in it.

    Raises:
        FileFormatError: It cannot be read.
    """
    path = Path(path).expanduser()
    try:
        if not path.is_dir():
            return _digest(path)
        files = sorted(p for p in path.rglob("*") if p.is_file())
        lines = "".join(f"{_digest(p)} {p.relative_to(path).as_posix()}\n" for p in files)
        return hashlib.sha256(lines.encode()).hexdigest()
    except OSError as error:
        raise FileFormatError(path, "file", error.strerror or error, "a file that can be read") from None


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _versions() -> dict[str, str]:
    """This package, Python, and the libraries that compute."""
    versions = {"calib_planner": __version__, "Python": platform.python_version()}
    for name in LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "unknown"
    return versions


def _text(path: str | Path) -> str:
    """A path as text that can be written: names of files need not be UTF-8."""
    return str(path).encode("utf-8", "replace").decode()


# ── the report ───────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class CalibrationReport:
    """An identification problem, its estimate, and what is drawn of them.

    Attributes:
        problem: The problem that was solved.
        estimate: Its estimate, with the validation if there was one.
        provenance: Where it comes from.
        before: (N, targets, 3) measured − predicted with the nominal kinematics, base and targets fitted where
            they are unknown, in the frame of the measurements [m]; NaN where not measured.
        scene: The 3-D view.
    """

    problem: IdentificationProblem
    estimate: Estimate
    provenance: Provenance
    before: FloatArray
    scene: Scene

    def to_dict(self) -> dict[str, Any]:
        """What the page holds as JSON; non-finite numbers are ``None``."""
        values: dict[str, Any] = plain(
            {
                "estimate": self.estimate.to_dict(),
                "required_accuracy": self.estimate.accuracy.required,
                "distances_before": np.linalg.norm(self.before, axis=2),
                "distances_after": np.linalg.norm(self.estimate.residuals.vectors, axis=2),
                "target_offsets": self.estimate.calibrated.target_offsets,
                "scene": self.scene.to_dict(),
                "provenance": self.provenance.to_dict(),
            }
        )
        return values


def calibration_report(
    problem: IdentificationProblem, estimate: Estimate, provenance: Provenance | None = None
) -> CalibrationReport:
    """Gather the report.

    Args:
        problem: The problem that was solved.
        estimate: ``identify(problem)``, possibly with ``validate``.
        provenance: See ``provenance.provenance``; default: versions and date alone.

    Raises:
        InputError: The estimate is of other data or another robot.
    """
    robot, data = problem.robot, problem.data
    same = estimate.fit.parameters == robot.parameter_names and estimate.calibrated.name == robot.name
    if not same or estimate.residuals.vectors.shape != data.p.shape:
        size = "{} rows and {} parameters of {}"
        got = size.format(len(estimate.residuals.vectors), len(estimate.fit.parameters), estimate.calibrated.name)
        valid = size.format(len(data), len(robot.parameter_names), robot.name)
        raise InputError("estimate", got, valid, "give the problem that the estimate answers")
    before = np.asarray(data.p - place_nominal(problem).positions(data.q))
    scene = scene_of(problem, estimate, before)
    return CalibrationReport(problem, estimate, provenance or Provenance(), before, scene)
