"""Plans and estimates as YAML: exact round trips, and every flaw is named by its key."""

from __future__ import annotations

import tempfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from calib_planner import FileFormatError, IdentificationProblem, Plan, PlanProblem, Robot, identify, plan
from calib_planner.files.estimate_yaml import read_estimate, write_estimate
from calib_planner.files.plan_yaml import FINITE as FINITE_ARRAYS
from calib_planner.files.plan_yaml import SHAPES, read_plan, write_plan
from calib_planner.simulation import SimulatedCell

ANY = st.floats(allow_nan=True, allow_infinity=True, width=64)
FINITE = st.floats(allow_nan=False, allow_infinity=False, width=64)
TEXT = st.text(max_size=20)


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    """Any plan at all: fields by their annotation, arrays of fitting shapes."""
    count = {k: draw(st.integers(1, 4)) for k in ("configurations", "joint_names", "weights", "parameters")}
    drawn: dict[str, Any] = {}
    for f in fields(Plan):
        shape = tuple(count[a] for a in SHAPES.get(f.name, ()))
        names = st.lists(TEXT, min_size=count.get(f.name, 0), max_size=count.get(f.name, 3))
        floats = hnp.arrays(float, shape, elements=FINITE if f.name in FINITE_ARRAYS else ANY)
        kinds: dict[str, st.SearchStrategy[Any]] = {
            "str": TEXT,
            "int": st.integers(0, 2**63 - 1),
            "float": ANY,
            "tuple[str, ...]": names.map(tuple),
            "FloatArray": floats,
            "IntArray": hnp.arrays(np.int64, shape, elements=st.integers(1, 10**9)),
        }
        drawn[f.name] = draw(kinds[str(f.type)])
    return Plan(**drawn)


@settings(max_examples=60, deadline=None)
@given(written=plans())
def test_plans_come_back_to_the_bit(written: Plan) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan.yaml"
        write_plan(path, written)
        read = read_plan(path)
    for f in fields(Plan):
        want, have = getattr(written, f.name), getattr(read, f.name)
        assert type(want) is type(have)
        if isinstance(want, np.ndarray):
            assert want.dtype == have.dtype
            np.testing.assert_array_equal(want, have)
            np.testing.assert_array_equal(np.signbit(want[want == 0]), np.signbit(have[have == 0]))
        else:
            assert repr(want) == repr(have)


@pytest.fixture(scope="module")
def small_plan() -> Plan:
    return plan(PlanProblem(Robot.load("planar_2r"), [[0.2, 0.4]], 3, starts=4))


def change(path: Path, **changes: Any) -> Path:
    document = yaml.safe_load(path.read_text())
    for key, value in changes.items():
        if value is None:
            del document[key]
        else:
            document[key] = value
    path.write_text(yaml.safe_dump(document))
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


def test_estimates_come_back(tmp_path: Path) -> None:
    robot = Robot.load("planar_2r").with_parameters(["l1", "q1.x", "l2", "dq1"])
    cell = SimulatedCell(robot, {"l1": 1e-3, "dq1": -2e-3})
    data = cell.measure(np.random.default_rng(1).uniform(-2, 2, (8, 2)), 1, 2)
    written = identify(IdentificationProblem(robot.with_parameters("full"), data))
    path = tmp_path / "estimate.yaml"
    write_estimate(path, written)
    read = read_estimate(path)
    assert read.parameters == written.parameters and read.status == written.status == "rank_deficient"
    assert read.deviations.tobytes() == written.deviations.tobytes()
    assert read.covariance.tobytes() == written.covariance.tobytes()
    np.testing.assert_array_equal(read.std, written.std)
    assert np.isnan(read.std).sum() == len(written.held) > 0
    with pytest.raises(ValueError):
        read.std[0] = 0
    with pytest.raises(FileFormatError, match="covariance: expected a square matrix"):
        read_estimate(change(path, covariance=[[1.0]]))
    with pytest.raises(FileFormatError, match=r"parameters\[0\].*no key 'unit'"):
        read_estimate(change(path, parameters=[{"name": "l1"}]))
