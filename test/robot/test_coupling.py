# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Joints that a controller shows against others: motions, derivatives, moments, limits, and every command."""

from __future__ import annotations

import json

import numpy as np
import pytest
from robots import MIXED_URDF, mixed, random_configurations

from calib_planner import InputError, Robot, UnknownNameError
from calib_planner.cli import main
from calib_planner.error_model import Gravity, Mass, Poses
from calib_planner.io import parse_urdf, read_estimate
from calib_planner.planning.feasibility import Feasibility
from calib_planner.robot import Coupling, goals_of, parse_coupling, solve

ARM = (Coupling("nod", "spin", -1.0), Coupling("turn", "slide", 0.5))


def shown(robot, motions):
    """Motions as the controller shows them, by the definition."""
    q = np.array(motions)
    names = robot.joint_names
    for one in robot.couplings:
        q[:, names.index(one.joint)] += one.factor * motions[:, names.index(one.beside)]
    return q


def test_positions_and_posture_are_those_of_the_motions():
    plain, robot = mixed(), mixed().with_couplings(ARM)
    motions = random_configurations(plain, 20)
    q = shown(robot, motions)
    np.testing.assert_allclose(robot.motions(q), motions, atol=1e-14)
    np.testing.assert_allclose(robot.positions(q), plain.positions(motions), atol=1e-14)
    np.testing.assert_allclose(robot.posture(q).joint_axes, plain.posture(motions).joint_axes, atol=1e-14)
    np.testing.assert_allclose(robot.jacobian(q), plain.jacobian(motions), atol=1e-14)
    again = robot.with_couplings(())
    np.testing.assert_array_equal(again.joint_limits, plain.joint_limits)
    np.testing.assert_array_equal(again.positions(motions), plain.positions(motions))


def test_joint_columns_by_complex_steps():
    robot = mixed().with_couplings(ARM)
    q = random_configurations(robot, 6)
    columns = robot.joint_jacobian(q)
    lin = robot.linearise(q)
    flat = lin.joint_columns.reshape(len(robot.joint_names), -1, len(q)).transpose(2, 1, 0)
    np.testing.assert_allclose(flat, columns, atol=1e-13)
    for k in range(len(robot.joint_names)):
        step = np.zeros(len(robot.joint_names), complex)
        step[k] = 1e-30j
        moved = robot._run(q + step, None, columns=False).imag / 1e-30
        np.testing.assert_allclose(columns[:, :, k], moved[: columns.shape[1]].T, atol=1e-12)


def test_gradients_in_the_joints_by_central_differences():
    """Of weighted sums of the identification Jacobian and of the joints' levers."""
    robot = mixed().with_parameters("full").with_couplings(ARM)
    q, rng, step = random_configurations(robot, 3), np.random.default_rng(1), 1e-6
    lin = robot.linearise(q)
    weights, pushes = rng.normal(size=lin.jacobian().shape), rng.normal(size=robot.joint_jacobian(q).shape)
    levers = lin.layout.__class__(
        lin.layout.joint_elements, lin.layout.joint_rotates, lin.layout.joint_elements, lin.layout.joint_rotates
    )
    own, through = lin.pull_back(weights), lin.pull_back_levers(pushes, levers)
    for k in range(len(robot.joint_names)):
        sums = []
        for side in (step, -step):
            there = q + side * np.eye(len(robot.joint_names))[k]
            pairs = (weights, robot.jacobian(there)), (pushes, robot.joint_jacobian(there))
            sums.append([(weight * columns).sum(axis=(1, 2)) for weight, columns in pairs])
        numeric = (np.array(sums[0]) - np.array(sums[1])) / (2 * step)
        np.testing.assert_allclose(np.stack([own[:, k], through[:, k]]), numeric, atol=2e-8)


def test_moments_are_the_work_of_the_masses():
    """τ = ∂(height downwards)/∂q of every mass, whichever joints carry it; its derivative likewise."""
    robot = mixed().with_couplings((Coupling("nod", "spin", -1.0), Coupling("turn", "spin", 0.25)))
    gravity = Gravity((Mass("elbow", 2, (0.1, 0.2, 0.3)), Mass("tip")))
    q, step = random_configurations(robot, 4), 1e-5
    moments, slopes = gravity.moments(Poses(robot, q)), gravity.moment_gradients(Poses(robot, q))
    names, joints = gravity.names(robot), robot.joint_names
    assert "gravity.elbow.nod" not in names

    def heights(q):
        """(N,) how far the mass at the elbow, and that at the tip, are down."""
        plain = robot.with_couplings(())
        text = parse_urdf(MIXED_URDF, "r.urdf", tip_link="d").with_targets([[0.1, 0.2, 0.3]])
        m = robot.motions(q)
        return -text.positions(m[:, :3])[:, 0, 2], -plain.posture(m).tip_origin[:, 2]

    for column, name in enumerate(names):
        _, mass, joint = name.split(".")
        e = np.eye(len(joints))[joints.index(joint)] * step
        at = ("elbow", "tip").index(mass)
        numeric = (heights(q + e)[at] - heights(q - e)[at]) / (2 * step)
        np.testing.assert_allclose(moments[:, column], numeric, atol=1e-9, err_msg=name)
    for k in range(len(joints)):
        e = np.eye(len(joints))[k] * step
        numeric = (gravity.moments(Poses(robot, q + e)) - gravity.moments(Poses(robot, q - e))) / (2 * step)
        np.testing.assert_allclose(slopes[:, :, k], numeric, atol=1e-8)


def test_inverse_kinematics_answers_in_what_is_shown():
    robot = mixed().with_couplings(ARM)
    q = Feasibility(robot).sample(np.random.default_rng(3), 12)
    goals = goals_of(robot, q, np.zeros(3), True, 0.3)
    reached = solve(robot, goals, q + 0.02, *(np.tile(side, (12, 1)) for side in robot.joint_limits.T))
    np.testing.assert_allclose(robot.posture(reached).tip_origin, robot.posture(q).tip_origin, atol=1e-9)


def test_limits_are_those_of_the_motions():
    plain = mixed()
    robot = plain.with_couplings((Coupling("nod", "turn"),))
    low, high = plain.joint_limits.T
    np.testing.assert_allclose(robot.joint_limits[3], [low[3] + low[0], high[3] + high[0]])
    q = Feasibility(robot).sample(np.random.default_rng(0), 500)
    motions = robot.motions(q)
    assert (motions >= low).all() and (motions <= high).all()
    assert np.ptp(q[:, 3]) > np.ptp(motions[:, 3])
    outside = shown(robot, high[None] + np.eye(4)[3:] * 0.1)
    with pytest.raises(InputError, match="joint nod: expected a value within the joint limits"):
        robot.check_within_limits("q", outside)


@pytest.mark.parametrize(
    ("text", "joint", "beside", "factor"),
    [
        ("j3+=j2", "j3", "j2", 1.0),
        ("j3 -= j2", "j3", "j2", -1.0),
        ("a-b+=0.5*c+d", "a-b", "c+d", 0.5),
        ("joint 6-=1.25e-2 * joint 5", "joint 6", "joint 5", -0.0125),
    ],
)
def test_couplings_are_read_and_written(text, joint, beside, factor):
    one = parse_coupling(text)
    assert one == Coupling(joint, beside, factor)
    assert parse_coupling(str(one)) == one


@pytest.mark.parametrize(
    ("texts", "needle"),
    [
        (["nod=spin"], "expected JOINT\\+=JOINT"),
        (["nod+=nod"], "two different joints"),
        (["nod+=spin", "nod-=spin"], "each pair of joints once"),
        (["nod+=0*spin"], "other than zero"),
        (["nod+=spin", "spin+=nod"], "couplings from which every joint's motion follows"),
    ],
)
def test_couplings_that_say_nothing_are_refused(texts, needle):
    with pytest.raises(InputError, match=needle):
        mixed().with_couplings([parse_coupling(text) for text in texts])
    with pytest.raises(UnknownNameError, match="wrist"):
        mixed().with_couplings([Coupling("nod", "wrist")])


# ── from data to corrected targets ───────────────────────────────────────────────────────────────────

JOINTS = (
    ("0 0 0.4", "0 0 1"),
    ("0.1 0 0.1", "0 1 0"),
    ("0 0 0.6", "0 1 0"),
    ("0.5 0 0.1", "1 0 0"),
    ("0.1 0 0", "0 1 0"),
)
URDF = '<robot name="arm">' + "".join(f'<link name="l{i}"/>' for i in range(6)) + "".join(
    f'<joint name="j{i}" type="revolute"><origin xyz="{xyz}"/><axis xyz="{axis}"/><parent link="l{i - 1}"/>'
    f'<child link="l{i}"/><limit lower="-2" upper="2"/></joint>'
    for i, (xyz, axis) in enumerate(JOINTS, 1)
) + "</robot>"  # fmt: skip


@pytest.fixture
def work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.urdf").write_text(URDF)
    return tmp_path


def run(capsys, *argv, code=0):
    capsys.readouterr()
    assert main([*argv, "--json"]) == code, capsys.readouterr().err
    return json.loads(capsys.readouterr().out)


def test_the_advice_is_the_option_and_the_option_mends_the_fit(work, capsys):
    """Data of a controller that shows joint 3 plus joint 2, made by the kinematics of the arm alone."""
    robot = Robot.load("arm.urdf").with_targets([[0.06, 0, 0.03]])
    q = random_configurations(robot, 24, 5)
    truth = robot.with_deviations({"j2.offset": 1e-3, "j3.offset": 2e-3})
    points = truth.positions(q)[:, 0] + 1e-5 * np.random.default_rng(0).normal(size=(24, 3))
    q[:, 2] += q[:, 1]
    rows = [",".join(map(repr, row)) for row in np.hstack([q, points]).tolist()]
    (work / "data.csv").write_text("\n".join(["j1,j2,j3,j4,j5,x1,y1,z1", *rows]) + "\n")
    asked = (
        "--robot",
        "arm.urdf",
        "--targets",
        "0.06 0 0.03",
        "--parameters",
        "offsets",
        "--error-model",
        "paper",
    )
    asked = (*asked, "--unknown", "none", "--data", "data.csv")
    wrong = run(capsys, "identify", *asked, code=1)
    (told,) = (a for a in wrong["alternatives"] if a["code"] == "couple")
    assert "add --couple j3+=j2 if" in told["advice"] and told["text"].startswith("j3 is coupled to j2")
    mended = run(capsys, "identify", *asked, "--couple", "j3+=j2", "--output", "estimate.yaml")
    assert mended["residual_after"]["rms"] < 5e-5
    assert not [a for a in mended["alternatives"] if a["code"] == "couple"]
    saved = read_estimate("estimate.yaml")
    assert saved.couple == ("j3+=j2",)
    with pytest.raises(InputError, match=r"expected j3\+=j2, as the data of the estimate were shown"):
        saved.calibrated(robot)


def test_a_robot_yaml_says_it_and_plans_and_targets_are_what_is_shown(work, capsys):
    """From the plan to the corrected target, the data being simulated."""
    rows = "\n".join(
        f"    - {{joint: q{i}, d: {d}, a: {a}, alpha: {alpha}}}"
        for i, (d, a, alpha) in enumerate([(0.4, 0.1, 1.57079632679), (0, 0.6, 0), (0, 0.5, 0)], 1)
    )
    joints = "\n".join(f"  - {{name: q{i}, lower: -100, upper: 100, unit: deg}}" for i in (1, 2, 3))
    text = f"joints:\n{joints}\ndh:\n  rows:\n{rows}\ntargets: [[0.06, 0, 0.03]]\n"
    (work / "r.yaml").write_text(text + "couple: [q3+=q2]\n")
    (work / "plain.yaml").write_text(text)
    robot = Robot.load("r.yaml")
    assert robot.couplings == (Coupling("q3", "q2"),)
    asked, simple = ("--robot", "r.yaml", "--parameters", "offsets"), ("--error-model", "paper")
    test = ("--test-pose", "0.3 0.5 0.2")
    run(capsys, "plan", *asked, *test, "--configurations", "6", "--starts", "1", "--output", "plan.csv", *simple)
    plan = np.loadtxt("plan.csv", delimiter=",", skiprows=1)[:, :3]
    assert not robot.beyond_limits(plan).any()
    run(capsys, "simulate", *asked, "--plan", "plan.csv", "--output", "data.csv", *simple)
    estimate = run(
        capsys, "identify", *asked, "--data", "data.csv", "--unknown", "none", "--output", "e.yaml", *simple
    )
    assert estimate["residual_after"]["rms"] < 1e-4
    (work / "task.csv").write_text("q1,q2,q3\n0.3,0.5,0.2\n")
    asked = ("--estimate", "e.yaml", "--targets", "task.csv", "--output", "c.csv")
    run(capsys, "compensate", "--robot", "r.yaml", *asked, "--geometry-only", "--position-only")
    corrected = np.loadtxt("c.csv", delimiter=",", skiprows=1, usecols=(0, 1, 2))
    calibrated = read_estimate("e.yaml").calibrated(robot)
    np.testing.assert_allclose(
        calibrated.positions(corrected), robot.positions(np.array([0.3, 0.5, 0.2])), atol=1e-8
    )
    refused = run(capsys, "compensate", "--robot", "plain.yaml", *asked, code=2)
    assert "couple" in refused["error"]["advice"]


@pytest.mark.parametrize("joint", range(6))
def test_a_mass_loads_the_joints_that_move_it(joint: int) -> None:
    """Those in front of it, and those coupled to them with any factor: whatever changes where the mass is."""
    robot = Robot.load("ur10e")
    names = robot.joint_names
    robot = robot.with_couplings(
        [parse_coupling(f"{names[1]}+=0.5*{names[3]}"), parse_coupling(f"{names[5]}-={names[4]}")]
    )
    q = random_configurations(robot, 3)
    at = robot.link_points(q, joint, (0.1, 0.2, 0.3))
    moves = [
        np.abs(robot.link_points(q + 1e-3 * unit, joint, (0.1, 0.2, 0.3)) - at).max() > 1e-6 for unit in np.eye(6)
    ]
    term = Gravity((Mass("load", joint, (0.1, 0.2, 0.3)),))
    loaded = [name.removeprefix("gravity.load.") for name in term.names(robot)]
    assert loaded == [name for name, moved in zip(names, moves, strict=True) if moved]
