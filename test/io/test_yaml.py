# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Plans and estimates as YAML: exact round trips, and every flaw is named by its key."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from robots import mixed, random_configurations, repeats

from calib_planner import (
    Estimate,
    FileFormatError,
    IdentificationProblem,
    InputError,
    Plan,
    PlanProblem,
    Robot,
    identify,
    plan,
)
from calib_planner.error_model import ErrorModel, Prior
from calib_planner.identification import validate
from calib_planner.io import read_estimate, read_plan, write_estimate, write_plan
from calib_planner.io.plan import FINITE as FINITE_ARRAYS
from calib_planner.io.plan import SHAPES
from calib_planner.measurements import Measurements
from calib_planner.planning import KINDS, Search
from calib_planner.simulation import SimulatedCell

ANY = st.floats(allow_nan=True, allow_infinity=True, width=64)
FINITE = st.floats(allow_nan=False, allow_infinity=False, width=64)
TEXT = st.text(max_size=20)
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Any plan at all: fields by their annotation, arrays of fitting shapes; there need be no test poses."""
    count = {k: draw(st.integers(1, 4)) for k in ("configurations", "joint_names", "parameters")}
    count["weights"] = draw(st.integers(0, 4))
    drawn: dict[str, Any] = {}
    for name, kind in KINDS.items():
        shape = tuple(count[a] for a in SHAPES.get(name, ()))
        names = st.lists(TEXT, min_size=count.get(name, 0), max_size=count.get(name, 3))
        floats = hnp.arrays(float, shape, elements=FINITE if name in FINITE_ARRAYS else ANY)
        kinds: dict[str, st.SearchStrategy[Any]] = {
            "str": TEXT,
            "int": st.integers(0, 2**63 - 1),
            "float": ANY,
            "tuple[str, ...]": names.map(tuple),
            "FloatArray": floats,
            "IntArray": hnp.arrays(np.int64, shape, elements=st.integers(1, 10**9)),
        }
        drawn[name] = draw(kinds[kind])
    return Plan.from_values(drawn)


@settings(max_examples=repeats(30, 60), deadline=None)
@given(written=plans())
def test_plans_come_back_to_the_bit(written: Plan) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan.yaml"
        write_plan(path, written)
        read = read_plan(path)
    for name, want in written.values().items():
        have = read.values()[name]
        assert type(want) is type(have)
        if isinstance(want, np.ndarray):
            assert want.dtype == have.dtype
            np.testing.assert_array_equal(want, have)
            np.testing.assert_array_equal(np.signbit(want[want == 0]), np.signbit(have[have == 0]))
        else:
            assert repr(want) == repr(have)


@pytest.fixture(scope="module")
def small_plan() -> Plan:
    return plan(PlanProblem(Robot.load("planar_2r"), [[0.2, 0.4]], 3, search=Search(starts=4)))


def change(path: Path, **changes: Any) -> Path:
    document = yaml.load(path.read_text(), LOADER)
    for key, value in changes.items():
        if value is None:
            del document[key]
        else:
            document[key] = value
    path.write_text(yaml.dump(document, Dumper=DUMPER))
    return path


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "key missing": ({"joint_names": None}, "no key 'joint_names'"),
    "key unknown": ({"colour": "red"}, "unknown key 'colour'"),
    "other kind": ({"format": "calib_planner/estimate"}, "expected calib_planner/plan"),
    "words for numbers": ({"configurations": [["a", "b"]]}, "configurations: expected a list of numbers"),
    "ragged": ({"configurations": [[1.0], [1.0, 2.0]]}, "configurations: expected a list of numbers"),
    "joints do not fit": ({"configurations": [[1.0], [2.0], [3.0]]}, r"configurations.*shape \(3, 2\)"),
    "not finite": (
        {"configurations": [[0.0, 1.0], [0.0, float("nan")], [0.0, 1.0]]},
        "configurations: expected finite",
    ),
    "repetitions": ({"repetitions": [1, 1]}, "repetitions: expected an array"),
    "repetitions of zero": ({"repetitions": [1, 0, 1]}, "repetitions: expected whole numbers >= 1"),
    "half repetitions": ({"repetitions": [1, 1.5, 1]}, "repetitions: expected a list of whole numbers"),
    "name is a number": ({"robot": 3}, "robot: expected text"),
    "flag for a number": ({"sigma": True}, "sigma: expected a number"),
    "names": ({"joint_names": "q1"}, "joint_names: expected a list of names"),
}


@pytest.mark.parametrize("case", BAD)
def test_flawed_plans_are_refused(tmp_path: Path, small_plan: Plan, case: str) -> None:
    changes, message = BAD[case]
    path = tmp_path / "plan.yaml"
    write_plan(path, small_plan)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_plan(change(path, **changes))
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "just words",
        "[1, 2]",
        "a: [1",
        "a: &x [1]\nb: *x",
        "!!python/object/apply:os.getcwd []",
        "[" * 5000,
    ],
    ids=["empty", "scalar", "list", "syntax", "alias", "object", "deep"],
)
def test_what_is_no_document_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    with pytest.raises(FileFormatError, match="calib_planner/plan"):
        read_plan(path)


# ── estimates ────────────────────────────────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def placed() -> Estimate:
    """Base and targets unknown, a parameter that cannot be told apart, test poses, held-out data, a prior."""
    nominal = mixed()
    cell = SimulatedCell(
        nominal, {"turn.offset": 0.02, "slide.x": 1e-3, "base.x": 2.0, "base.rz": 2.5, "target_1.z": 0.1}
    )
    data = cell.measure(random_configurations(nominal, 40), 1, 2)
    robot = nominal.with_parameters("full", ["base", "tool"])
    test = cell.measure(random_configurations(nominal, 8, 3), 1, 4)
    prior = Prior(("spin.z",), [0.5], [1e-3])
    model = ErrorModel.paper()
    problem = IdentificationProblem(robot, data, None, model, prior=prior, test_poses=[[0.1, 0.2, 0.3, 0.4]])
    return validate(problem, identify(problem), [test])


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory, placed: Estimate) -> str:
    """The file of ``placed``."""
    path = tmp_path_factory.mktemp("estimate") / "estimate.yaml"
    write_estimate(path, placed)
    return path.read_text()


def numbers(value: Any) -> Any:
    """NaN as null, arrays as lists, infinities as they are: what a YAML document of it holds."""
    if isinstance(value, np.ndarray):
        return numbers(value.tolist())
    if isinstance(value, (list, tuple)):
        return [numbers(v) for v in value]
    if isinstance(value, dict):
        return {k: numbers(v) for k, v in value.items()}
    return None if isinstance(value, float) and np.isnan(value) else value


def test_estimates_come_back_to_the_bit(tmp_path: Path, placed: Estimate) -> None:
    path, again = tmp_path / "estimate.yaml", tmp_path / "again.yaml"
    write_estimate(path, placed)
    read = read_estimate(path)
    for name in ("nominal", "values", "deviations", "std", "covariance"):
        assert getattr(read, name).tobytes() == getattr(placed.fit, name).tobytes(), name
        assert not getattr(read, name).flags.writeable
    assert np.isnan(read.std).sum() == len(placed.observability.fixed) > 0 and read.status == "rank_deficient"
    assert (read.parameters, read.units, read.sigma) == (
        placed.fit.parameters,
        placed.fit.units,
        placed.noise.sigma,
    )
    assert read.predicted_accuracy_per_test_pose.tobytes() == placed.accuracy.predicted.tobytes()
    assert repr(read.noise) == repr(placed.noise) and repr(read.chi_square) == repr(placed.residuals.chi_square)
    assert read.verdict == placed.verdict
    said = placed.to_dict()
    written = {k: v for k, v in read.document.items() if k in said}
    learnt = written["error_model"]
    assert written | {"error_model": {k: learnt[k] for k in said["error_model"]}} == said
    write_estimate(again, read)
    assert again.read_bytes() == path.read_bytes()


def test_a_read_estimate_is_the_robot_again(tmp_path: Path, placed: Estimate) -> None:
    """In the tracker's frame, base and targets included, from the nominal robot as its file gives it."""
    path = tmp_path / "estimate.yaml"
    write_estimate(path, placed)
    q = random_configurations(mixed(), 20, 7)
    for nominal in (mixed(), mixed().with_targets([[0, 0, 0]])):
        again = read_estimate(path).calibrated(nominal)
        assert again.positions(q).tobytes() == placed.calibrated.positions(q).tobytes()
        assert again.jacobian(q).tobytes() == placed.calibrated.jacobian(q).tobytes()
        known = read_estimate(path).knowledge(nominal)
        assert known.poses(q).points.tobytes() == placed.positions(q).tobytes()
        assert known.predict(q).total.tobytes() == placed.knowledge.predict(q).total.tobytes()
    far = np.linalg.norm(again.positions(q) - mixed().positions(q), axis=2)
    assert far.min() > 0.1  # base and targets do matter
    with pytest.raises(InputError, match="joints turn, slide"):
        read_estimate(path).calibrated(Robot.load("planar_2r"))
    with pytest.raises(InputError, match="identify again"):
        read_estimate(change(path, base=None)).calibrated(mixed())


def test_all_terms_come_back(tmp_path: Path, small: Estimate) -> None:
    """Gravity, joint functions and visits beside a placement that is not the calibrated robot's."""
    path, q = tmp_path / "estimate.yaml", random_configurations(small.calibrated, 10, 8)
    write_estimate(path, small)
    nominal, read = Robot.load("planar_2r"), read_estimate(path)
    known = read.knowledge(nominal)
    assert known.model == small.knowledge.model and len(known.model.systematic) > 1
    assert known.poses(q).points.tobytes() == small.positions(q).tobytes()
    assert known.predict(q).total.tobytes() == small.knowledge.predict(q).total.tobytes()
    assert known.predict(q).mean.tobytes() != read.calibrated(nominal).positions(q).tobytes()
    assert read.calibrated(nominal).positions(q).tobytes() == small.calibrated.positions(q).tobytes()
    names = [t["name"] for t in read.document["error_model"]["terms"]]
    assert names == ["placement", "gravity", "smooth", "short", "visits", "points"]
    assert set(read.document["left_out"]) >= {"count", "mean", "rms", "max", "predicted_rms"}
    assert read.document["accuracy_frame"] == "world" and read.document["placement_alone"]["left_out"]


def test_what_cannot_be_predicted_stays_infinite(tmp_path: Path) -> None:
    """Data that never turn q2 leave a pose that does unpredictable; JSON has no word for it, YAML has."""
    robot = Robot.load("planar_2r").with_parameters(["l1", "dq1", "dq2"])
    q = [[a, 0.0] for a in np.linspace(-2, 2, 12)]
    data = SimulatedCell(robot, {"l1": 1e-3}).measure(q, 1, 2)
    poses = [[0.1, 1.5], [0.2, 0.0]]
    estimate = identify(IdentificationProblem(robot, data, None, ErrorModel.paper(), test_poses=poses))
    assert np.isinf(estimate.accuracy.overall) and estimate.to_dict()["predicted_accuracy"] is None
    path = tmp_path / "estimate.yaml"
    write_estimate(path, estimate)
    read = read_estimate(path)
    assert read.predicted_accuracy_per_test_pose.tobytes() == estimate.accuracy.predicted.tobytes()
    assert read.document["predicted_accuracy"] == np.inf and "predicted_accuracy: .inf" in path.read_text()
    write_estimate(tmp_path / "again.yaml", read)
    assert (tmp_path / "again.yaml").read_bytes() == path.read_bytes()


def test_an_estimate_without_redundancy_has_no_left_out_error(tmp_path: Path) -> None:
    """As many equations as parameters: nothing is left to judge by, and the file says so."""
    robot = Robot.load("planar_2r").with_targets([[0.1, 0.2, 0.3]]).with_parameters(["l1", "dq1", "target_1.z"])
    q = np.array([[0.3, 0.5]])
    data = Measurements(robot.joint_names, q, robot.positions(q) + 1e-4)
    estimate = identify(IdentificationProblem(robot, data, None, ErrorModel.paper()))
    assert estimate.left_out.count == 0 and estimate.verdict.level != "PASS"
    write_estimate(tmp_path / "estimate.yaml", estimate)
    read = read_estimate(tmp_path / "estimate.yaml")
    assert read.document["left_out"]["rms"] is None and read.document["left_out"]["count"] == 0
    np.testing.assert_array_equal(read.std, estimate.fit.std)
    np.testing.assert_array_equal(read.covariance, estimate.fit.covariance)
    assert read.deviations.tobytes() == estimate.fit.deviations.tobytes()


@pytest.fixture(scope="module")
def small() -> Estimate:
    """All terms, of a robot whose joints err as no geometry does."""
    robot = Robot.load("planar_2r")
    q = random_configurations(robot, 30, 5)
    points = robot.with_deviations({"l1": 1e-3}).positions(q + 2e-3 * np.sin(2.0 * q))
    points = points + 1e-5 * np.random.default_rng(2).standard_normal(points.shape)
    data = Measurements(robot.joint_names, q, points)
    return identify(IdentificationProblem(robot, data, 1e-5, test_poses=[[0.1, 0.2]]))


@settings(max_examples=repeats(20, 40), deadline=None)
@given(data=st.data())
def test_any_numbers_come_back(small: Estimate, data: st.DataObject) -> None:
    """Whatever stands in an estimate: extreme, denormal, −0, infinite where that can be, any text."""
    p = len(small.fit.parameters)
    finite = {n: data.draw(hnp.arrays(float, (p,), elements=FINITE)) for n in ("nominal", "deviations", "std")}
    per = data.draw(hnp.arrays(float, (1,), elements=st.floats(0, np.inf) | st.just(np.nan)))
    texts = {n: data.draw(TEXT) for n in ("robot", "prior")}
    with np.errstate(over="ignore", invalid="ignore"):
        written = replace(
            small,
            calibrated=replace(small.calibrated, name=texts["robot"]),
            fit=replace(small.fit, **finite),
            observability=replace(small.observability, prior=texts["prior"]),
            accuracy=replace(small.accuracy, placement=per),
        )
        assume(np.isfinite(written.fit.values).all())
        with tempfile.TemporaryDirectory() as folder:
            path, again = Path(folder) / "estimate.yaml", Path(folder) / "again.yaml"
            write_estimate(path, written)
            read = read_estimate(path)
            write_estimate(again, read)
            assert again.read_bytes() == path.read_bytes()
        expected = numbers(written.accuracy.predicted)
    for name in finite:
        assert getattr(read, name).tobytes() == getattr(written.fit, name).tobytes()
    assert numbers(read.predicted_accuracy_per_test_pose) == expected
    assert {n: read.document[n] for n in texts} == texts


def test_older_files_lack_what_has_a_default(tmp_path: Path, placed: Estimate) -> None:
    path = tmp_path / "estimate.yaml"
    write_estimate(path, placed)
    noise = {"repeatability": 1e-5, "measurement": 2e-5, "discrepancy": 0.0, "source": "residuals"}
    older = dict.fromkeys(("base", "targets", "verdict", "chi_square", "error_model"))
    read = read_estimate(change(path, noise=noise, **older))
    assert (read.base, read.targets, read.verdict, read.chi_square) == (None, None, None, None)
    assert read.noise is None and read.learnt is None
    with pytest.raises(InputError, match=r"no error model.*identify again"):
        read.knowledge(mixed())


BAD_ESTIMATES: dict[str, tuple[dict[str, Any], str]] = {
    "covariance": ({"covariance": [[1.0]]}, "covariance: expected numbers"),
    "ragged": ({"covariance": [[1.0], [1.0, 2.0]]}, "covariance: expected a list of numbers"),
    "key": ({"parameters": [{"name": "l1"}]}, r"parameters\[0\].*no key 'unit'"),
    "no parameters": ({"parameters": []}, "parameters: expected a list with at least one entry"),
    "words": ({"sigma": "small"}, "sigma: expected a number"),
    "base": ({"base": {"x": 0.0}}, r"base\.y: .*no key 'y'"),
    "targets": ({"targets": [[0.0, 0.0]]}, "targets: expected numbers, any × 3"),
    "targets of nothing": ({"targets": [[0.0, 0.0, float("nan")]]}, "targets: expected finite numbers"),
    "noise": ({"noise": {"sigma": 1.0}}, r"noise\.source: .*no key 'source'"),
    "noise of words": ({"noise": 3}, "noise: .*got int"),
    "verdict": (
        {"verdict": {"level": "PASS", "reasons": [{"level": "PASS"}]}},
        r"reasons\[0\]\.code: .*no key",
    ),
    "reasons of words": (
        {"verdict": {"level": "PASS", "reasons": "none"}},
        r"verdict\.reasons: .*a list of reasons",
    ),
    "verdict of words": ({"verdict": "PASS"}, "verdict: .*got str"),
    "error model": ({"error_model": {"terms": []}}, r"error_model\.model: .*no key"),
    "kind": ({"format": "calib_planner/plan"}, "expected calib_planner/estimate"),
}


@pytest.mark.parametrize("case", BAD_ESTIMATES)
def test_flawed_estimates_are_refused(tmp_path: Path, written: str, case: str) -> None:
    changes, message = BAD_ESTIMATES[case]
    path = tmp_path / "estimate.yaml"
    path.write_text(written)
    with pytest.raises(FileFormatError, match=message) as caught:
        read_estimate(change(path, **changes))
    assert str(path) in str(caught.value)


def test_an_estimate_of_the_same_parameter_twice_is_refused(tmp_path: Path, written: str) -> None:
    path = tmp_path / "estimate.yaml"
    path.write_text(written)
    rows = yaml.load(written, LOADER)["parameters"]
    rows[2]["name"] = rows[1]["name"]
    with pytest.raises(FileFormatError, match="parameters: expected each name once, got a name twice"):
        read_estimate(change(path, parameters=rows))


@pytest.mark.parametrize("column", ["nominal", "value", "deviation"])
def test_a_parameter_without_a_number_is_refused(tmp_path: Path, written: str, column: str) -> None:
    path = tmp_path / "estimate.yaml"
    path.write_text(written)
    rows = yaml.load(written, LOADER)["parameters"]
    rows[2][column] = None
    with pytest.raises(FileFormatError, match=rf"parameters\[\]\.{column}: expected finite numbers"):
        read_estimate(change(path, parameters=rows))
