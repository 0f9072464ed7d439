# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Denavit–Hartenberg tables against the textbooks' 4×4 matrices, published tables and the chain's other forms."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from robots import SHARED_DATA, random_configurations

from calib_planner import FileFormatError, IdentificationProblem, Robot, identify
from calib_planner.error_model import ErrorModel
from calib_planner.simulation import SimulatedCell

STEP = 1e-30
QUANTITIES = ("theta", "d", "a", "alpha")
TARGETS = [[0.1, 0.02, 0.3], [-0.05, 0.2, 0.1]]


def standard(theta, d, a, alpha):
    """Row to matrix as printed in Spong's and Siciliano's books; works for complex numbers."""
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])


def modified(theta, d, a, alpha):
    """Row to matrix as printed in Craig's book, eq. (3.6)."""
    c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    return np.array([[c, -s, 0, a], [s * ca, c * ca, -sa, -sa * d], [s * sa, c * sa, ca, ca * d], [0, 0, 0, 1]])


MATRICES = {"dh": standard, "modified_dh": modified}


def by_matrices(key, rows, joints, q, targets, deltas=None):
    """(N, 3·targets) positions by products of the textbook matrices."""
    deltas = deltas or {}
    points = []
    for values in q:
        pose = np.eye(4)
        for row in rows:
            amounts = {k: row.get(k, 0.0) + deltas.get(f"{row['joint']}.{k}", 0.0) for k in QUANTITIES}
            kind = row.get("type", "revolute")
            if kind != "fixed":
                coordinate = row.get("sign", 1) * values[joints.index(row["joint"])]
                amounts["d" if kind == "prismatic" else "theta"] += coordinate
            pose = pose @ MATRICES[key](*(amounts[k] for k in QUANTITIES))
        points.append(np.concatenate([(pose @ np.append(t, 1.0))[:3] for t in targets]))
    return np.array(points)


def write(folder: Path, key, rows, *, joints=None, **more) -> Path:
    moving = [row["joint"] for row in rows if row.get("type") != "fixed"]
    limits = {"lower": -2.5, "upper": 2.0}
    table = {"rows": rows, **more.pop("units", {})}
    content = {"joints": [{"name": n, **limits} for n in joints or moving], key: table, **more}
    path = folder / "robot.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def random_rows(seed):
    """Seven rows: five turning and one sliding joint with either sign, one fixed; general numbers."""
    rng = np.random.default_rng(seed)
    types = rng.permutation(["revolute"] * 4 + ["prismatic", "revolute", "fixed"])
    rows = [{"joint": f"r{i}", "type": str(t)} for i, t in enumerate(types)]
    for row in rows:
        row |= {k: float(v) for k, v in zip(QUANTITIES, rng.normal(0, [1.0, 0.4, 0.4, 1.0]), strict=True)}
        if row["type"] != "fixed":
            row["sign"] = int(rng.choice([-1, 1]))
    return rows


@pytest.fixture(params=sorted(MATRICES))
def key(request):
    return request.param


@pytest.mark.parametrize("seed", range(4))
def test_positions_are_those_of_the_textbook_matrices(tmp_path, key, seed):
    rows = random_rows(seed)
    joints = [r["joint"] for r in reversed(rows) if r["type"] != "fixed"]  # the file's order of joints counts
    robot = Robot.load(write(tmp_path, key, rows, joints=joints, targets=TARGETS))
    assert robot.joint_names == tuple(joints)
    q = random_configurations(robot, 20, seed)
    expected = by_matrices(key, rows, joints, q, TARGETS)
    np.testing.assert_allclose(robot.positions(q).reshape(20, -1), expected, atol=1e-13)


@pytest.mark.parametrize("seed", range(2))
def test_every_quantity_moves_the_target_as_the_matrices_say(tmp_path, key, seed):
    """Jacobians by the complex step through the textbook matrices, at deviations that are not zero."""
    rows = random_rows(seed)
    robot = Robot.load(write(tmp_path, key, rows, targets=TARGETS)).with_parameters("dh")
    joints = list(robot.joint_names)
    q = random_configurations(robot, 5, seed)
    names = robot.parameter_names
    assert sorted(names) == sorted(f"{row['joint']}.{k}" for row in rows for k in QUANTITIES)
    values = dict(zip(names, np.random.default_rng(seed).normal(0, 0.02, len(names)), strict=True))
    deltas = list(values.values())

    def column(name):
        return by_matrices(key, rows, joints, q, TARGETS, values | {name: values[name] + 1j * STEP}).imag / STEP

    expected = np.stack([column(name) for name in names], axis=-1)
    np.testing.assert_allclose(robot.jacobian(q, deltas), expected, atol=1e-13)
    steps = 1j * STEP * np.eye(len(joints))
    expected = np.stack([by_matrices(key, rows, joints, q + s, TARGETS, values).imag / STEP for s in steps], -1)
    np.testing.assert_allclose(robot.joint_jacobian(q, deltas), expected, atol=1e-13)


def test_identified_values_are_the_tables_whatever_the_sign(tmp_path, key):
    """nominal is the table's number; nominal + deviation, written into the table, is the deviated robot."""
    rows = random_rows(5)
    robot = Robot.load(write(tmp_path, key, rows)).with_parameters("dh")
    rng = np.random.default_rng(0)
    deviations = {name: float(v) for name, v in zip(robot.parameter_names, rng.normal(0, 0.01, 28), strict=True)}
    for p in robot.parameters:
        row = next(r for r in rows if r["joint"] == p.name.split(".")[0])
        quantity = p.name.split(".")[1]
        assert p.nominal == row[quantity] and p.unit == ("m" if quantity in "ad" else "rad")
        row[quantity] += deviations[p.name]
    again = Robot.load(write(tmp_path, key, rows))
    q = random_configurations(robot, 9)
    np.testing.assert_allclose(robot.with_deviations(deviations).positions(q), again.positions(q), atol=1e-14)


def test_standard_table_is_the_modified_one_shifted_by_a_row(tmp_path):
    rows = random_rows(8)
    shifted, before = [], {"a": 0.0, "alpha": 0.0}
    for row in rows:
        shifted.append(row | before)
        before = {"a": row["a"], "alpha": row["alpha"]}
    shifted.append({"joint": "flange", "type": "fixed", **before})
    a = Robot.load(write(tmp_path, "dh", rows, targets=TARGETS))
    b = Robot.load(write(tmp_path, "modified_dh", shifted, targets=TARGETS))
    q = random_configurations(a, 10)
    np.testing.assert_allclose(a.positions(q), b.positions(q), atol=1e-13)
    np.testing.assert_allclose(a.posture(q).tip_rotation, b.posture(q).tip_rotation, atol=1e-13)


# ── published tables, θ d a α in degrees and mm ──────────────────────────────────────────────────────

UR10 = [  # Universal Robots' page of kinematic parameters
    (0, 127.3, 0, 90), (0, 0, -612, 0), (0, 0, -572.3, 0),
    (0, 163.941, 0, 90), (0, 115.7, 0, -90), (0, 92.2, 0, 0),
]  # fmt: skip
IRB120 = [  # as in lecture notes and theses on this robot, from the data sheet's lengths
    (0, 290, 0, -90), (-90, 0, 270, 0), (0, 0, 70, -90), (0, 302, 0, 90), (0, 0, 0, -90), (180, 72, 0, 0),
]  # fmt: skip
Z_TO_X = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
PUBLISHED = {
    "ur10": (UR10, SHARED_DATA / "ur10_tracker" / "ur10.urdf", np.eye(3)),
    "irb120": (IRB120, SHARED_DATA / "irb120_tracker" / "irb120.urdf", Z_TO_X),  # tool axis: z here, x there
}
MM_DEG = {"length_unit": "mm", "angle_unit": "deg"}


def published(folder, key, table):
    rows, before = [], (0, 0)
    for i, (theta, d, a, alpha) in enumerate(table):
        own = (a, alpha) if key == "dh" else before
        rows.append({"joint": f"j{i + 1}", "theta": theta, "d": d, "a": own[0], "alpha": own[1]})
        before = (a, alpha)
    return Robot.load(write(folder, key, rows, units=MM_DEG))


@pytest.mark.parametrize("name", sorted(PUBLISHED))
def test_published_tables_agree_with_urdfs(tmp_path, key, name):
    table, urdf, tip = PUBLISHED[name]
    if not urdf.exists():
        pytest.skip("measured data not present")
    robot, other = published(tmp_path, key, table), Robot.load(urdf)
    q = random_configurations(other, 200)
    tool = np.array([0.03, -0.07, 0.11])  # seen in either tip's frame: agreement of whole frames
    in_dh = robot.with_targets([tool]).positions(q)
    in_urdf = other.with_targets([tip @ tool]).positions(q)
    np.testing.assert_allclose(in_dh, in_urdf, atol=1e-9)


# ── levels ───────────────────────────────────────────────────────────────────────────────────────────


def test_levels(tmp_path, key):
    robot = published(tmp_path, key, UR10)
    lengths = {"j1.d", "j2.a", "j3.a", "j4.d", "j5.d", "j6.d"}
    if key == "modified_dh":
        lengths = lengths - {"j2.a", "j3.a"} | {"j3.a", "j4.a"}
    offsets = tuple(f"j{i}.theta" for i in range(1, 7))
    assert set(robot.levels["lengths"]) == lengths and robot.levels["offsets"] == offsets
    assert robot.parameter_names == robot.levels["lengths+offsets"] == robot.levels["lengths"] + offsets
    errors = ("x", "y", "z", "rx", "ry", "rz")
    assert robot.levels["full"] == tuple(f"j{i}.{e}" for i in range(1, 7) for e in errors)
    assert len(robot.levels["dh"]) == 24 and set(robot.levels["lengths+offsets"]) < set(robot.levels["dh"])


def test_a_sliding_joints_zero_is_its_d(tmp_path, key):
    rows = [
        {"joint": "turn", "a": 0.5},
        {"joint": "slide", "type": "prismatic", "d": 0.2, "a": 0.1, "theta": 0.3},
    ]
    robot = Robot.load(write(tmp_path, key, rows, joints=["slide", "turn"]))
    assert robot.levels["offsets"] == ("turn.theta", "slide.d")
    assert set(robot.levels["lengths"]) == {"turn.a", "slide.a"}
    assert list(robot.joint_is_revolute) == [False, True]
    assert [p.unit for p in robot.with_parameters("offsets").parameters] == ["rad", "m"]


def test_named_lists_take_the_place_of_the_tables_and_add_levels(tmp_path, key):
    levels = {"wrist": ["r5.theta", "r6.rx"]}
    rows = [{"joint": f"r{i}", "a": 0.1 * i} for i in range(1, 7)]
    robot = Robot.load(write(tmp_path, key, rows, lengths=["r2.a"], offsets=[], levels=levels))
    assert robot.parameter_names == ("r2.a",) and "offsets" not in robot.levels
    assert robot.with_parameters("wrist,r1.d").parameter_names == ("r5.theta", "r6.rx", "r1.d")


def test_full_explains_all_that_the_table_does(tmp_path, key):
    """Six placement errors per joint with base and tool span the table's columns, but not the other way."""
    robot = Robot.load(write(tmp_path, key, random_rows(3), targets=TARGETS))
    q = random_configurations(robot, 60)
    full, table, both = (
        robot.with_parameters(names, ("base", "tool")).jacobian(q).reshape(len(q) * 6, -1)
        for names in ("full", "dh", "full,dh")
    )
    rank = np.linalg.matrix_rank(full, 1e-8)
    assert np.linalg.matrix_rank(both, 1e-8) == rank
    assert np.linalg.matrix_rank(table, 1e-8) <= rank


def test_parallel_axes_hide_their_d_and_the_twist_between_them(tmp_path):
    """The UR10's axes 2, 3, 4: three d for one sum, and a tilt that no α and θ describe but ``full`` does."""
    robot = published(tmp_path, "dh", UR10).with_targets(TARGETS)
    q = random_configurations(robot, 40)
    columns = robot.with_parameters("j2.d,j3.d,j4.d").jacobian(q)
    np.testing.assert_allclose(columns[..., 0], columns[..., 1], atol=1e-14)
    np.testing.assert_allclose(columns[..., 0], columns[..., 2], atol=1e-14)
    tilt = robot.with_parameters("j3.ry").jacobian(q).reshape(-1)
    table = robot.with_parameters("dh", ("base", "tool")).jacobian(q).reshape(len(tilt), -1)
    left = tilt - table @ np.linalg.lstsq(table, tilt, rcond=1e-10)[0]
    assert np.linalg.norm(left) > 0.05 * np.linalg.norm(tilt)

    cell = SimulatedCell(robot, {"j2.d": 1e-3, "j3.d": 5e-4, "j2.a": 1e-3}, 1e-5)
    asked = robot.with_parameters("j2.d,j3.d,j2.a")
    found = identify(IdentificationProblem(asked, cell.measure(q, 1, 0), 1e-5, ErrorModel.paper()))
    assert len(found.observability.fixed) == 1 and "j3.d" in str(found.observability.fixed) + str(
        found.to_dict()["unidentifiable"]
    )
    values = dict(zip(found.fit.parameters, found.fit.deviations, strict=True))
    assert values["j2.d"] + values["j3.d"] == pytest.approx(1.5e-3, abs=2e-5)


def nearly_parallel(tilt):
    """An arm of six joints whose axes 2, 3 and 4 are parallel to ``tilt`` rad, as in tables of calibrated arms.

    The common normals lead 40 mm aside, for which a d of 0.04 m / ``tilt`` is needed.
    """
    far = float(0.04 / np.tan(tilt))
    return [
        {"joint": "j1", "d": 0.4, "alpha": 1.5707},
        {"joint": "j2", "theta": 0.1, "d": far, "a": 0.6, "alpha": tilt},
        {
            "joint": "j3",
            "theta": -0.2,
            "d": float(-far / np.cos(tilt)) + 0.02,
            "a": 0.55,
            "alpha": -tilt,
            "sign": -1,
        },
        {"joint": "j4", "d": 0.1, "alpha": -1.571},
        {"joint": "j5", "d": 0.12, "alpha": 1.57},
        {"joint": "j6", "d": 0.09, "alpha": -1.57},
    ]


TILTS = (1e-6, 1e-5, 1e-4, 1e-3, np.pi - 1e-4)


@pytest.mark.parametrize("tilt", TILTS)
def test_nearly_parallel_axes_are_re_placed(tmp_path, key, tilt):
    """The same robot, without rows of hundreds of metres, and with the tilt that the table lacks."""
    rows, joints = nearly_parallel(tilt), [f"j{i}" for i in range(1, 7)]
    masses = [{"joint": f"j{i}", "mass": 1.0, "xyz": [0.01, 0.02, 0.03]} for i in (1, 2, 3, 4)]
    robot = Robot.load(write(tmp_path, key, rows, targets=TARGETS, masses=masses))
    q = random_configurations(robot, 12)
    expected = by_matrices(key, rows, joints, q, TARGETS)
    np.testing.assert_allclose(
        robot.positions(q).reshape(12, -1), expected, atol=1e-15 * 0.4 / np.sin(tilt) + 1e-13
    )
    pairs = (("j2", "j3"), ("j3", "j4")) if key == "dh" else (("j1", "j2"), ("j2", "j3"))
    assert [
        all(f"axes of {a} and {b} are" in r for a, b in [pair])
        for pair, r in zip(pairs, robot.remarks, strict=True)
    ]
    assert np.abs(robot.posture(q).joint_origins).max() < 2.5, "no frame is far from the arm"
    full, table = (
        robot.with_parameters(names, ("base", "tool")).jacobian(random_configurations(robot, 60)).reshape(360, -1)
        for names in ("full", "dh")
    )
    left = full - table @ np.linalg.lstsq(table, full, rcond=1e-10)[0]
    assert np.abs(left).max() < 1e-6, "the rows describe every error of the arm"
    for part in robot.link_masses:  # in the frame of its row, which is behind row part.joint for either form
        own = by_matrices(
            key, rows[: part.joint + 1], joints[: part.joint + 1], q[:, : part.joint + 1], [[0.01, 0.02, 0.03]]
        )
        np.testing.assert_allclose(
            robot.link_points(q, part.joint, part.xyz), own, atol=1e-14 / np.sin(tilt) + 1e-12
        )


@pytest.mark.parametrize("tilt", TILTS[:4])
def test_a_fit_of_nearly_parallel_axes_succeeds(tmp_path, key, tilt):
    """The truth tilts the axes by a milliradian: common normals leap, and the fit does not care."""
    robot = Robot.load(write(tmp_path, key, nearly_parallel(tilt), targets=TARGETS))
    q = random_configurations(robot, 70, 5)
    errors = {"j2.rx": 1e-3, "j3.ry": -1e-3, "j3.rx": 7e-4, "j4.ry": 5e-4, "j2.x": 5e-4, "j4.rx": -8e-4}
    cell = SimulatedCell(robot.with_parameters("full"), errors, 1e-6, error_model=ErrorModel.paper())
    asked = robot.with_parameters("dh", ("base", "tool"))
    estimate = identify(IdentificationProblem(asked, cell.measure(q[:40], 1, 0), 1e-6, ErrorModel.paper()))
    assert estimate.fit.status != "not_converged"
    fresh = estimate.calibrated.positions(q[40:]) - robot.with_deviations(errors).positions(q[40:])
    assert np.linalg.norm(fresh, axis=2).max() < 2e-5


def test_the_example_of_the_conventions_page(tmp_path):
    page = (Path(__file__).resolve().parents[2] / "docs" / "conventions.md").read_text()
    (text,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "robot.yaml").write_text(text)
    robot = Robot.load(tmp_path / "robot.yaml")
    # By hand: up by 0.29, against x by 0.12 − 0.1 (the joint counts backwards), and the flange points up.
    np.testing.assert_allclose(robot.positions([0.0, 0.1])[0, 0], [-0.02, 0.0, 0.29 + 0.072], atol=1e-15)
    assert robot.levels["lengths"] == ("j1.d", "flange.d") and robot.levels["offsets"] == ("j1.theta", "j2.d")


# ── what is refused ──────────────────────────────────────────────────────────────────────────────────

HEAD = "joints: [{name: q1, lower: -1, upper: 1}]\n"
DH = HEAD + "dh: {rows: [{joint: q1, a: 1}]}\n"
REFUSED = {
    "two chains": (DH + "elements: [{type: Rz, joint: q1}]\n", "exactly one of: elements, dh, modified_dh"),
    "both tables": (DH + DH.splitlines()[1].replace("dh", "modified_dh", 1), "dh and modified_dh"),
    "no chain": (HEAD, "exactly one of: elements, dh, modified_dh, got no chain"),
    "a list": (HEAD + "dh: [{joint: q1}]", "a mapping with keys rows, length_unit, angle_unit"),
    "no rows": (HEAD + "dh: {rows: []}", "at least one entry"),
    "no joint": (HEAD + "dh: {rows: [{a: 1}]}", "dh.rows[0].joint: expected this key"),
    "unknown joint": (DH.replace("joint: q1", "joint: q7"), "dh.rows[0].joint: expected one of: q1"),
    "joint without row": (DH.replace("joint: q1", "joint: q7, type: fixed"), "one row for every joint"),
    "twice": (DH.replace("[{joint: q1, a: 1}]", "[{joint: q1}, {joint: q1}]"), "this name twice"),
    "unknown key": (DH.replace("a: 1", "length: 1"), "dh.rows[0].length: expected only: joint, type"),
    "unknown type": (DH.replace("a: 1", "type: helical"), "one of: revolute, prismatic, fixed"),
    "unknown unit": (DH.replace("{rows", "{angle_unit: grad, rows"), "dh.angle_unit: expected one of: rad, deg"),
    "wrong kind of unit": (DH.replace("{rows", "{length_unit: deg, rows"), "one of: m, mm"),
    "not a number": (DH.replace("a: 1", "alpha: pi/2"), "dh.rows[0].alpha: expected a finite number"),
    "a number in quotes": (DH.replace("a: 1", "a: '1e-3'"), "in quotes is text"),
    "sign": (DH.replace("a: 1", "sign: 2"), "dh.rows[0].sign: expected +1 or -1"),
    "sign of a fixed row": (DH.replace("a: 1}", "a: 1}, {joint: f, type: fixed, sign: -1}"), "type is fixed"),
    "fixed row of a joint": (DH.replace("a: 1", "type: fixed"), "neither, in a row whose type is fixed"),
    "limits of another kind": (HEAD.replace("1}", "1, unit: mm}") + DH.splitlines()[1], "as the joint turns"),
    "reserved name": (DH.replace("q1", "base"), "joint 'base'"),
    "reserved name of a target": (DH.replace("q1", "target_2"), "joint 'target_2'"),
    "level that is one": (DH + "levels: {dh: [q1.a]}", "no other level or parameter has"),
    "level that is a parameter": (DH + "levels: {q1.a: [q1.d]}", "no other level or parameter has"),
    "level of unknown names": (DH + "levels: {mine: [q1.b]}", "levels.mine: expected only: base.rx"),
    "levels as a list": (DH + "levels: [q1.a]", "levels: expected a mapping"),
    "name twice in a list": (DH + "lengths: [q1.a, q1.a]", "each name once"),
}


def test_numbers_are_those_of_yaml_1_2(tmp_path):
    for text in ("1e-3", "+1.e-3", ".1e-2", "1E-3", "1.0e-3", "0.001"):
        (tmp_path / "robot.yaml").write_text(DH.replace("a: 1", f"a: {text}"))
        robot = Robot.load(tmp_path / "robot.yaml")
        assert {p.name: p.nominal for p in robot.with_parameters(["q1.a"]).parameters} == {"q1.a": 1e-3}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_name_the_place_and_what_is_valid(tmp_path, case):
    text, needle = REFUSED[case]
    path = tmp_path / "robot.yaml"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        Robot.load(path)
    assert str(path) in str(caught.value) and needle in str(caught.value)


def test_a_small_file_cannot_make_a_huge_error(tmp_path):
    """Nested aliases stand for 10^12 entries; they are neither expanded nor quoted."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12)]
    path = tmp_path / "robot.yaml"
    path.write_text("\n".join(lines))
    with pytest.raises(FileFormatError, match="alias"):
        Robot.load(path)
    nested = "\n  ".join(lines)
    path.write_text(f"description:\n  {nested}\n{HEAD}dh: {{rows: [{{joint: q1, type: *a11}}]}}\n")
    with pytest.raises(FileFormatError) as caught:
        Robot.load(path)
    assert len(str(caught.value)) < 500
