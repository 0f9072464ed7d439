# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Prior knowledge as YAML: units, the three ways to say it, estimates from before, and every flaw by its key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from robots import mixed, random_configurations

from calib_planner import FileFormatError, IdentificationProblem, Robot, identify
from calib_planner.io import read_prior, write_estimate
from calib_planner.simulation import SimulatedCell

NAMES = ["turn.x", "turn.ry", "slide.z", "spin.offset", "nod.rx"]


@pytest.fixture
def robot() -> Robot:
    return mixed().with_parameters(NAMES)


def write(folder: Path, text: str) -> Path:
    path = folder / "prior.yaml"
    path.write_text(text)
    return path


def test_values_deviations_and_units(tmp_path: Path, robot: Robot) -> None:
    """turn.x is nominally 0.1 m, slide.z 0.4 m (see ``robots.MIXED_URDF``), the rest zero."""
    text = """
    source: last year
    parameters:
      turn.x: {value: 100.5, std: 0.2, unit: mm}
      slide.z: {deviation: -2.0e-3, std: 3e-4}
      turn.ry: {deviation: 2, std: 0.5, unit: mrad}
      spin.offset: {value: 90, std: 1, unit: deg}
      nod.rx: 5.0e-4
    """
    with pytest.raises(FileFormatError, match=r"spin\.offset\.value: expected at most 1 rad from it"):
        read_prior(write(tmp_path, text), robot)
    found = read_prior(write(tmp_path, text.replace("90", "45")), robot)
    assert found.prior.source == "last year" and found.left_out == ()
    said = dict(zip(found.prior.names, np.asarray(found.prior.values), strict=True))
    expected = {"turn.x": 0.1005, "slide.z": 0.398, "turn.ry": 2e-3, "spin.offset": np.pi / 4, "nod.rx": 0.0}
    assert said == pytest.approx(expected, rel=1e-15, abs=0)
    std = np.sqrt(np.diag(np.asarray(found.prior.covariance)))
    given = {"turn.x": 2e-4, "slide.z": 3e-4, "turn.ry": 5e-4, "spin.offset": np.pi / 180, "nod.rx": 5e-4}
    assert dict(zip(found.prior.names, std, strict=True)) == pytest.approx(given, rel=1e-12)


def test_the_planner_s_form(tmp_path: Path, robot: Robot) -> None:
    found = read_prior(write(tmp_path, "slide.z: 1.0e-4\nturn.ry: 2e-4\n"), robot).prior
    assert found.names == ("slide.z", "turn.ry") and found.source.endswith("prior.yaml")
    np.testing.assert_array_equal(found.values, [0.4, 0.0])
    np.testing.assert_allclose(np.diag(np.asarray(found.covariance)), [1e-8, 4e-8], rtol=1e-12)


BAD: dict[str, tuple[str, str]] = {
    "zero": ("parameters: {turn.x: {std: 0}}", r"parameters\.turn\.x\.std: .*from 1e-09.* m, got 0"),
    "negative": ("parameters: {turn.x: -1}", r"turn\.x\.std: .*got -1"),
    "nan": ("parameters: {turn.x: {std: .nan}}", r"turn\.x\.std: expected a finite number"),
    "infinite": ("parameters: {turn.x: {value: .inf, std: 1}}", r"turn\.x\.value: expected a finite number"),
    "huge": ("parameters: {turn.x: 1.0e+300}", r"turn\.x\.std"),
    "tiny": ("parameters: {turn.x: 1.0e-300}", r"turn\.x\.std"),
    "no std": ("parameters: {turn.x: {value: 0.1}}", r"turn\.x\.std: expected this key"),
    "null": ("parameters: {turn.x: }", r"turn\.x\.std: expected a finite number, got None"),
    "truth": (
        "parameters: {turn.x: {value: yes, std: 1}}",
        r"turn\.x\.value: expected a finite number, got True",
    ),
    "both": ("parameters: {turn.x: {value: 0, deviation: 0, std: 1}}", "one of the two"),
    "key": ("parameters: {turn.x: {std: 1, colour: red}}", r"turn\.x\.colour: expected only: value, deviation"),
    "top key": ("parameters: {turn.x: 1}\ncolour: red", "colour: expected only: parameters, source"),
    "name": ("parameters: {turn.xx: 1}", r"turn\.xx: expected one of: turn\.x, .*did you mean 'turn\.x'"),
    "not active": ("parameters: {turn.y: 1}", r"turn\.y: .*no parameter to be identified"),
    "unit": ("parameters: {turn.x: {std: 1, unit: inch}}", r"turn\.x\.unit: expected one of: m, mm"),
    "unit of another": ("parameters: {turn.x: {std: 1, unit: deg}}", r"turn\.x\.unit: expected one of: m, mm"),
    "metres": ("parameters: {turn.x: {value: 100, std: 1}}", r"turn\.x\.value: .*is the unit right"),
    "empty": ("parameters: {}", "names of parameters"),
    "list": ("parameters: [1]", "a mapping of keys to values"),
    "nothing": ("", "document: expected a YAML of prior knowledge"),
    "words": ("no prior at all", "document: expected a YAML of prior knowledge"),
    "syntax": ("parameters: {", "YAML: expected a YAML of prior knowledge"),
    "tag": ("parameters: {turn.x: !!python/object/apply:os.getcwd []}", "YAML: expected a YAML"),
    "alias": ("parameters: {turn.x: &a 1.0, turn.ry: *a}", "alias"),
    "key of a list": ("? [turn.x]\n: 1", "YAML: expected a YAML"),
}


@pytest.mark.parametrize("case", BAD)
def test_flaws_are_named(tmp_path: Path, robot: Robot, case: str) -> None:
    text, message = BAD[case]
    with pytest.raises(FileFormatError, match=message) as caught:
        read_prior(write(tmp_path, text), robot)
    assert str(caught.value).startswith(f"{tmp_path}")


def test_what_the_data_place_has_no_nominal_value(tmp_path: Path) -> None:
    robot = mixed().with_parameters(["turn.x"], ["base", "tool"])
    text = "parameters: {base.x: {value: 2, std: 1, unit: mm}, target_2.z: {value: 0.1, std: 1.0e-3}}"
    found = read_prior(write(tmp_path, text), robot).prior
    assert found.names == ("base.x", "target_2.z")
    np.testing.assert_array_equal(found.values, [2e-3, 0.1])
    for entry in ("base.x: {deviation: 0, std: 1}", "target_1.x: 1.0e-3"):
        with pytest.raises(FileFormatError, match="what is unknown altogether"):
            read_prior(write(tmp_path, f"parameters: {{{entry}}}"), robot)
    with pytest.raises(FileFormatError, match="base's orientation"):
        read_prior(write(tmp_path, "parameters: {base.rz: {value: 0, std: 1}}"), robot)
    part = mixed().with_parameters(["turn.x", "base.x", "target_1.z"])  # their nominal values are the robot's
    found = read_prior(write(tmp_path, "parameters: {base.x: 1.0e-3, target_1.z: 1.0e-3}"), part).prior
    np.testing.assert_array_equal(found.values, [0.0, 0.3])


# ── an estimate from before ──────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    nominal = mixed().with_parameters(["turn.x", "slide.x", "nod.offset", "turn.offset"], ["base", "tool"])
    cell = SimulatedCell(nominal, {"nod.offset": 2e-3, "base.x": 0.5, "base.rz": 0.3}, sigma=1e-5)
    data = cell.measure(random_configurations(nominal, 30), 1, 4)
    estimate = identify(IdentificationProblem(nominal, data, sigma=1e-5))
    path = tmp_path_factory.mktemp("before") / "estimate.yaml"
    write_estimate(path, estimate)
    return path, estimate


def test_an_estimate_gives_values_and_covariance(before: tuple[Path, Any]) -> None:
    """Without base and targets, without what was held or is not asked for, and never in silence."""
    path, estimate = before
    robot = mixed().with_parameters(["nod.offset", "slide.x", "slide.z"], ["base"])
    found = read_prior(path, robot)
    assert set(found.prior.names) == {"nod.offset", "slide.x"} - set(estimate.observability.fixed)
    at = [estimate.fit.parameters.index(n) for n in found.prior.names]
    np.testing.assert_array_equal(found.prior.values, estimate.fit.values[at])
    np.testing.assert_array_equal(found.prior.covariance, estimate.fit.covariance[np.ix_(at, at)])
    assert {"base.x", "target_1.x", "target_2.z"} <= set(found.left_out)
    assert not set(found.left_out) & {*found.prior.names, *estimate.observability.fixed}
    assert str(path) in found.prior.source


def test_targets_are_taken_over_if_asked_for(before: tuple[Path, Any]) -> None:
    path, estimate = before
    robot = mixed().with_parameters(["nod.offset"], ["base", "tool"])
    found = read_prior(path, robot, targets=True)
    targets = [
        n for n in estimate.fit.parameters if n.startswith("target_") and n not in estimate.observability.fixed
    ]
    assert set(found.prior.names) >= set(targets) and "base.x" in found.left_out
    assert not any(n.startswith("base.") for n in found.prior.names)


def test_estimates_that_do_not_fit(before: tuple[Path, Any], tmp_path: Path) -> None:
    path, _ = before
    with pytest.raises(FileFormatError, match="expected the robot's joints q1, q2"):
        read_prior(path, Robot.load("planar_2r"))
    moved = mixed().with_deviations({"turn.x": 1e-3}).with_parameters(["turn.x"])
    with pytest.raises(FileFormatError, match=r"estimate: turn\.x: .*nominal 0\.1"):
        read_prior(path, moved)
    with pytest.raises(FileFormatError, match="no parameter that is to be identified"):
        read_prior(path, mixed().with_parameters(["slide.z"]))
    with pytest.raises(FileFormatError, match="format: expected an estimate"):
        read_prior(write(tmp_path, "turn.x: 1.0e-3"), mixed().with_parameters(["turn.x"]), targets=True)
    text = path.read_text().splitlines()
    with pytest.raises(FileFormatError, match=r"robot: expected .*no key 'robot'"):
        read_prior(write(tmp_path, text[0]), mixed().with_parameters(["turn.x"]))
    document = yaml.safe_load(path.read_text())
    for row in document["parameters"]:
        row["std"] = None
    with pytest.raises(FileFormatError, match="an estimate that knows how sure it is"):
        read_prior(write(tmp_path, yaml.safe_dump(document)), mixed().with_parameters(["turn.x"]))
