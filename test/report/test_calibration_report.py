# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The report of a calibration: its numbers are the estimate's, its drawings true, nothing is from elsewhere."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_cases import BASE, CASES, Case, clean, hostile, kuka, outliers
from robots import SHARED_DATA, random_configurations

from calib_planner import IdentificationProblem, Measurements, Robot, identify
from calib_planner.error_model import MEANINGS, ErrorModel
from calib_planner.errors import FileFormatError, InputError
from calib_planner.io import read_data
from calib_planner.report import provenance, write_report
from calib_planner.report.calibration import calibration_report, sha256_of
from calib_planner.report.charts import MOST_DOTS, drawn_points, joint_residuals
from calib_planner.report.page import report_page
from calib_planner.report.scene import MOST_ROBOTS, REJECTED, thinned
from calib_planner.simulation import random_deviations

VOID = {"meta", "link", "col", "br", "input", "img", "path", "rect", "circle", "polyline"}


@pytest.fixture(scope="module", params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]()


class Page(HTMLParser):
    """Elements, ids, attributes, the numbers with their keys, text by section, and the embedded JSON."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[tuple[str, dict[str, str]]] = []
        self.ids: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.numbers: list[tuple[dict[str, str], str]] = []
        self.text: dict[str, str] = {}
        self.json: dict[str, Any] = {}
        self.section = ""
        self.feed(text)
        self.close()
        assert not self.open and len(set(self.ids)) == len(self.ids)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.attributes += [(tag, name, value) for name, value in values.items()]
        self.ids += [values["id"]] if "id" in values else []
        if tag == "section":
            self.section = values["id"]
        if tag not in VOID:
            self.open.append((tag, values))

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop()[0] == tag

    def handle_data(self, data: str) -> None:
        tag, values = self.open[-1] if self.open else ("", {})
        if tag == "data":
            self.numbers.append((values, data))
        if values.get("id") == "report-data":
            self.json = json.loads(data)
        elif tag not in ("script", "style"):
            self.text[self.section] = self.text.get(self.section, "") + data


def at(found: Any, key: str) -> Any:
    """What a JSON document holds under ``a.0.b``."""
    for part in key.split("."):
        found = found[int(part)] if isinstance(found, list) else found[part]
    return found


def as_number(text: str, style: str) -> tuple[float, float]:
    """The value that a person reads, in SI units, and half a unit of its last digit."""
    if text == "< 1 nm":
        return 0.0, 1e-9
    word, _, unit = text.replace("−", "-").partition(" ")
    factor = {"µm": 1e-6, "mm": 1e-3, "%": 1e-2}.get(unit, 1e-3 if style in ("milli", "change") else 1.0)
    mantissa, _, exponent = word.lower().partition("e")
    digits = len(mantissa.partition(".")[2])
    if style in ("length", "short", "mm", "µm"):  # three or four significant digits, zeros at the end left out
        return factor * float(word), 0.6e-2 * abs(factor * float(word)) + 1e-300
    return factor * float(word), 0.5000001 * factor * 10.0 ** (int(exponent or 0) - digits)


# ── numbers ──────────────────────────────────────────────────────────────────────────────────────────


def test_the_numbers_are_those_of_the_estimate(case: Case) -> None:
    problem, estimate = case
    page = Page(report_page(calibration_report(problem, estimate)))
    assert page.json["estimate"] == json.loads(json.dumps(estimate.to_dict(), allow_nan=False))
    assert len(page.numbers) > 5 * len(estimate.fit.parameters) - 5 * len(estimate.observability.fixed)
    for values, text in page.numbers:
        exact = at(page.json, values["data-key"])
        assert float(values["value"]) == exact, values
        read, half = as_number(text, values["data-style"])
        assert abs(read - exact) <= half, (values, text)


def test_the_most_important_numbers_are_there(case: Case) -> None:
    problem, estimate = case
    page = Page(report_page(calibration_report(problem, estimate)))
    keys = {values["data-key"] for values, _ in page.numbers}
    wanted = {"estimate.residual_before.mean", "estimate.residual_after.mean", "estimate.rank", "estimate.used"}
    for i, name in enumerate(estimate.fit.parameters):
        if name not in estimate.observability.fixed and np.isfinite(estimate.fit.std[i]):
            wanted |= {f"estimate.parameters.{i}.{k}" for k in ("nominal", "value", "deviation", "std")}
    wanted |= {f"estimate.rejected.{i}.residual" for i in range(len(estimate.points.rejected))}
    sets = {"left_out": ("count", "mean", "rms", "max", "predicted_rms")} if estimate.left_out.count else {}
    if estimate.validation is not None:
        sets["validation"] = ("before_mean", "mean", "rms", "max", "predicted_rms", "within_95")
    wanted |= {f"estimate.{name}.{k}" for name, keys in sets.items() for k in keys}
    if len(estimate.knowledge.model.systematic) > 1:
        alone = [
            "placement_alone.residual_after.",
            *(["placement_alone.left_out."] if "left_out" in sets else []),
        ]
        alone += ["validation.placement_"] if "validation" in sets else []
        wanted |= {f"estimate.{name}{k}" for name in alone for k in ("mean", "rms")}
    wanted |= {f"estimate.error_model.terms.{i}.size" for i, t in enumerate(estimate.terms) if t.used}
    kinds = ("predicted", "parameter") if np.isfinite(estimate.accuracy.predicted).all() else ()
    wanted |= {
        f"estimate.{k}_accuracy_per_test_pose.{i}" for k in kinds for i in range(len(estimate.accuracy.predicted))
    }
    assert wanted <= keys
    if estimate.accuracy.required > 0:
        assert "required_accuracy" in keys


def test_distances_before_are_those_of_the_estimate(case: Case) -> None:
    problem, estimate = case
    report = calibration_report(problem, estimate)
    used = problem.data.seen.copy()
    for point in estimate.points.rejected:
        used[point.row, point.target - 1] = False
    before = np.linalg.norm(report.before, axis=2)[used]
    np.testing.assert_allclose(before.mean(), estimate.residuals.before.mean, rtol=1e-6)
    np.testing.assert_allclose(before.max(), estimate.residuals.before.max, rtol=1e-6)


def test_the_verdict_comes_first_with_every_reason_the_first_three_at_once(case: Case) -> None:
    problem, estimate = case
    text = report_page(calibration_report(problem, estimate))
    page = Page(text)
    assert page.ids[0] == "verdict"
    assert estimate.verdict.level in page.text["verdict"]
    said = " ".join(page.text["verdict"].split()).lower()
    for reason in estimate.verdict.reasons:
        assert reason.text.lower() in said and reason.advice.lower() in said
    reasons = len(estimate.verdict.reasons)
    assert text.count('<span class="said">') == reasons and len(estimate.verdict.foremost) == min(reasons, 3)
    shown = text[: text.index("<details>")] if reasons > 3 else text
    assert shown.count('<span class="said">') == min(reasons, 3) and ("further remark" in said) == (reasons > 3)
    assert ("should not be used" in page.text["apply"]) == (estimate.verdict.level == "FAIL")


def test_what_was_rejected_is_listed_with_its_reason() -> None:
    problem, estimate = outliers()
    assert {p.row for p in estimate.points.rejected} == {0, 3, 6}
    page = Page(report_page(calibration_report(problem, estimate)))
    for point in estimate.points.rejected:
        assert point.reason in page.text["rejected"]
    assert "Nothing: all 32 points" in " ".join(
        Page(report_page(calibration_report(*clean()))).text["rejected"].split()
    )


def test_fixed_parameters_and_correlated_pairs_are_named() -> None:
    problem, estimate = kuka(12, unknown=("base",), share=0.1, error_model=ErrorModel.paper())
    assert estimate.observability.fixed and estimate.fit.correlations
    text = " ".join(Page(report_page(calibration_report(problem, estimate))).text["parameters"].split())
    for name, combination in zip(
        estimate.observability.fixed, estimate.observability.unidentifiable, strict=True
    ):
        assert f"{name} " in text and f"the data cannot show it: {combination}" in text
    for a, b, _ in estimate.fit.correlations:
        assert f"{a}, {b}" in text


# ── the page ─────────────────────────────────────────────────────────────────────────────────────────


def test_the_page_needs_nothing_from_elsewhere(case: Case) -> None:
    text = report_page(calibration_report(*case))
    page = Page(text)
    assert not [a for a in page.attributes if a[1] in ("src", "href", "xlink:href", "srcset", "action")]
    assert "@import" not in text and "url(" not in text and "http:" not in text and "https:" not in text
    assert (
        "{{" not in text
        and "{%" not in text
        and ">nan" not in text.lower()
        and "None" not in page.text["accuracy"]
    )
    policy = next(v for tag, name, v in page.attributes if tag == "meta" and "default-src" in v)
    assert policy.startswith("default-src 'none'")


def test_names_are_text_whatever_they_hold() -> None:
    (problem, estimate), made = hostile()
    text = report_page(calibration_report(problem, estimate, made))
    page = Page(text)
    assert "<img src=x" not in text and not [a for a in page.attributes if a[1] == "onerror"]
    assert page.json["estimate"]["robot"] == problem.robot.name
    assert text.lower().count("</script>") == text.count("<script")
    assert page.json["provenance"]["command"] == made.command and made.command in page.text["provenance"]


def test_two_hundred_configurations_stay_below_a_megabyte() -> None:
    problem, estimate = kuka(200, unknown=("base", "tool"))
    assert len(report_page(calibration_report(problem, estimate)).encode()) < 1_000_000


def test_many_rows_thin_the_drawing_and_say_so_but_never_the_numbers() -> None:
    problem, estimate = kuka(1500, gross=4, loss="robust", error_model=ErrorModel.paper())
    report = calibration_report(problem, estimate)
    page = Page(report_page(report))
    assert len(page.json["distances_after"]) == len(page.json["scene"]["points"]) == 1500
    assert len(page.json["scene"]["robot_rows"]) <= MOST_ROBOTS and len(drawn_points(report).rows) <= MOST_DOTS
    assert {p.row for p in estimate.points.rejected} <= set(page.json["scene"]["robot_rows"])
    assert {p.row for p in estimate.points.rejected} <= set(drawn_points(report).rows.tolist())
    assert f"draw {MOST_DOTS} of 1500 points" in page.text["residuals"]
    assert f"robot at {MOST_ROBOTS} of 1500 rows" in page.text["view"]


@pytest.mark.parametrize(("count", "most"), [(5, 10), (10, 10), (1000, 100), (7, 3)])
def test_thinning_keeps_the_largest_and_spreads_the_rest(count: int, most: int) -> None:
    importance = np.random.default_rng(0).uniform(size=count)
    kept = thinned(importance, most)
    assert len(kept) == min(count, most) and (np.diff(kept) > 0).all()
    assert set(np.argsort(-importance)[: most // 3]) <= set(kept)
    assert count < 1000 or np.diff(kept).max() < 5 * count / most


def test_an_estimate_of_other_data_is_refused(tmp_path: Path) -> None:
    problem, estimate = kuka(12)
    with pytest.raises(InputError, match=r"12 rows .* the problem that the estimate answers"):
        calibration_report(replace(problem, data=problem.data.select([0, 1, 2, 3, 4])), estimate)
    with pytest.raises(InputError, match="--report"):
        write_report(tmp_path / "no" / "folder.html", problem, estimate, field="--report")
    write_report(tmp_path / "report.html", problem, estimate)
    assert Page((tmp_path / "report.html").read_text(encoding="utf-8")).json["estimate"]["used"] == 12


# ── drawings ─────────────────────────────────────────────────────────────────────────────────────────


def test_the_scene_is_in_the_axes_of_the_base() -> None:
    problem, estimate = outliers()
    scene = calibration_report(problem, estimate).scene
    # The truth: points of the same robot that stands at the origin, and the tracker seen from the base.
    turn, place = BASE
    nominal = Robot.load("kuka_kr270")
    good = scene.states != REJECTED
    here = nominal.with_deviations(random_deviations(nominal, 1)).positions(problem.data.q[scene.rows])[:, 0]
    apart = scene.points - here  # q1 and base.rz look alike: only a turn about z and a small shift are free
    assert np.linalg.norm(apart[good], axis=1).max() < 0.02
    assert scene.tracker == pytest.approx(turn.T @ -place, abs=0.02)
    lengths = np.linalg.norm(estimate.residuals.vectors[problem.data.seen], axis=1)
    np.testing.assert_allclose(np.linalg.norm(scene.after, axis=1), lengths, rtol=1e-9)
    # Model and skeleton end in the same place, and measured = model + residual.
    ends = scene.robots[:, -1]
    index = [int(np.flatnonzero(scene.rows == row)[0]) for row in scene.robot_rows]
    np.testing.assert_allclose(ends, (scene.points - scene.after)[index], atol=1e-9)
    assert set(scene.rows[scene.states == REJECTED].tolist()) == {0, 3, 6}


def test_where_the_tracker_stood_is_not_invented() -> None:
    problem, estimate = clean()
    report = calibration_report(problem, estimate)
    assert report.scene.tracker is None and "not known" in Page(report_page(report)).text["view"]


def test_residuals_by_joint_are_seen_in_the_joints_axes() -> None:
    robot = Robot.load("planar_2r").with_parameters("lengths")
    q = random_configurations(robot, 30, 7)
    points = robot.positions(q)
    # A push along the motion of joint 2, that is across the forearm, and one out of the plane.
    along = robot.joint_jacobian(q).reshape(30, 1, 3, 2)[..., 1]
    along = along / np.linalg.norm(along, axis=2, keepdims=True)
    pushed = points + 1e-3 * along + [0, 0, 2e-3]
    problem = IdentificationProblem(
        robot, Measurements(robot.joint_names, q, pushed), error_model=ErrorModel.paper()
    )
    estimate = identify(problem)
    estimate = replace(estimate, residuals=replace(estimate.residuals, vectors=pushed - points))
    found = joint_residuals(calibration_report(problem, estimate))[1]
    levers = robot.joint_jacobian(q).reshape(30, 3, 2)[..., 1]
    assert np.linalg.norm(levers, axis=1).min() > 0.5
    np.testing.assert_allclose(found[:, 0, 0], 1e-3, rtol=2e-2)
    np.testing.assert_allclose(found[:, 0, 1], 2e-3, rtol=1e-9)
    np.testing.assert_allclose(found[:, 0, 2], 0.0, atol=2e-5)


@pytest.mark.skipif(not (SHARED_DATA / "irb120_tracker").is_dir(), reason="no measured data here")
def test_a_measured_robot() -> None:
    folder = SHARED_DATA / "irb120_tracker"
    robot = (
        Robot.load(folder / "irb120.urdf")
        .with_targets(np.zeros((3, 3)))
        .with_parameters("full", ("base", "tool"))
    )
    problem = IdentificationProblem(robot, read_data(folder / "calibration.csv", robot).data)
    estimate = identify(problem)
    made = provenance([("robot", folder / "irb120.urdf"), ("data", folder / "calibration.csv")])
    page = Page(report_page(calibration_report(problem, estimate, made)))
    assert page.json["estimate"]["residual_after"]["mean"] < 0.3e-3
    apply = page.text["apply"]
    assert "calib-planner export" in apply and "--urdf calibrated.urdf" in apply
    assert "--targets path.csv corrected.csv" in apply and len(page.json["scene"]["points"]) == 108
    assert "It holds placement alone: gravity and joint functions are not in it" in apply
    terms = page.text["accuracy"]
    assert all(t.name in terms and MEANINGS[t.name] in terms for t in estimate.terms)
    kept = {t.name: t.used for t in estimate.terms}
    assert kept["gravity"] and terms.count("left out", terms.index("What moves")) == 1 + [*kept.values()].count(
        False
    )
    words = "What each joint turns beyond its reading"
    assert words in page.text["residuals"] and "by gravity" in page.text["residuals"]


# ── provenance ───────────────────────────────────────────────────────────────────────────────────────


def test_provenance_names_files_with_their_hashes(tmp_path: Path) -> None:
    data = tmp_path / "my points.csv"
    data.write_bytes(b"q1,x1\n1,2\n")
    made = provenance([("robot", "kuka_kr270"), ("data", data)], command="c", seed=3, estimate="my e.yaml")
    assert made.inputs[1].sha256 == hashlib.sha256(data.read_bytes()).hexdigest()
    shipped = Path(Robot.load("kuka_kr270").source)
    assert made.inputs[0].sha256 == hashlib.sha256(shipped.read_bytes()).hexdigest()
    assert (
        set(made.versions) >= {"calib_planner", "Python", "numpy", "scipy"}
        and made.versions["numpy"] == np.__version__
    )
    problem, estimate = kuka(12)
    page = Page(report_page(calibration_report(problem, estimate, made)))
    text = page.text["provenance"]
    assert all(i.name in text and i.sha256 in text for i in made.inputs) and made.written in text
    assert "calib-planner export 'my e.yaml'" in page.text["apply"]


def test_a_folder_has_a_hash_that_sees_names_and_contents(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("1")
    (tmp_path / "b").write_text("2")
    first = sha256_of(tmp_path)
    (tmp_path / "b").write_text("3")
    second = sha256_of(tmp_path)
    (tmp_path / "b").rename(tmp_path / "c")
    assert len({first, second, sha256_of(tmp_path)}) == 3
    with pytest.raises(FileFormatError, match=r"none\.csv"):
        provenance([("data", tmp_path / "none.csv")])


def test_names_in_charts_are_text() -> None:
    (problem, estimate), _ = hostile()
    charts = re.findall(r"<svg.*?</svg>", report_page(calibration_report(problem, estimate)), re.DOTALL)
    assert len(charts) > 5 and not [c for c in charts if "<img" in c]
