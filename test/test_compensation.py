# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Compensation: the true robot, told the corrected targets, has its tool where the nominal one says.

The oracle is the product of 4×4 matrices, element by element, not the code under test.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import mixed, random_configurations
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib_planner import Robot
from calib_planner.compensation import STATUS, Compensation, compensate
from calib_planner.error_model import Gravity, JointFunctions, Knowledge, Mass, typical
from calib_planner.errors import InputError
from calib_planner.io import parse_urdf
from calib_planner.robot.elements import rotation


def pose(robot: Robot, q: np.ndarray) -> np.ndarray:
    """(..., 4, 4) of the tip in the robot's own base frame; ``q`` (..., joints)."""
    out = np.eye(4)
    for e in robot.elements[9:]:
        amount = e.sign * (e.value + (0 if e.joint is None else q[..., e.joint]))
        step = np.zeros((*np.shape(amount), 4, 4)) + np.eye(4)
        if e.is_rotation:
            a, b = (e.axis + 1) % 3, (e.axis + 2) % 3
            step[..., a, a] = step[..., b, b] = np.cos(amount)
            step[..., b, a] = np.sin(amount)
            step[..., a, b] = -np.sin(amount)
        else:
            step[..., e.axis, 3] = amount
        out = out @ step
    return out


def pose_errors(nominal: Robot, true: Robot, targets: np.ndarray, told: np.ndarray) -> np.ndarray:
    """(N, 2) distance [m] and angle [rad] between the nominal tip and the true one."""
    apart = (pose(nominal, targets) - pose(true, told))[:, :3]
    # |R - 1| of a rotation by θ is 2√2 sin(θ/2)
    turned = np.linalg.norm(apart[:, :, :3], axis=(1, 2)) / np.sqrt(8)
    return np.stack([np.linalg.norm(apart[:, :, 3], axis=1), 2 * np.arcsin(np.minimum(turned, 1.0))], axis=1)


def deviated(robot: Robot, seed: int = 0, size: float = 1e-3) -> Robot:
    names = [n for n in robot.available_parameters if not n.startswith("target_")]
    drawn = size * np.random.default_rng(seed).standard_normal(len(names))
    return robot.with_deviations(dict(zip(names, drawn, strict=True)))


def random_arm(seed: int, joints: int = 6) -> Robot:
    """A URDF arm with joints at random poses and axes, one of which slides in every third."""
    rng = np.random.default_rng(seed)
    lines = ['<robot name="arm">', *(f'<link name="l{i}"/>' for i in range(joints + 1))]
    for i in range(joints):
        xyz, rpy, axis = (" ".join(map(repr, rng.uniform(-s, s, 3).tolist())) for s in (0.5, 3, 1))
        kind = "prismatic" if seed % 3 == 0 and i == 2 else "revolute"
        lines.append(
            f'<joint name="j{i}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
            f'<limit lower="-2" upper="2"/><parent link="l{i}"/><child link="l{i + 1}"/></joint>'
        )
    return parse_urdf("\n".join([*lines, "</robot>"]), "arm.urdf")


def assert_reports_are_true(nominal: Robot, true: Robot, found: Compensation) -> np.ndarray:
    """What the result says of its errors is what the oracle finds; returns the oracle's."""
    errors = pose_errors(nominal, true, found.targets, found.corrected)
    np.testing.assert_allclose(found.position_error, errors[:, 0], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.rotation_error, errors[:, 1], rtol=1e-6, atol=1e-12)
    before = pose_errors(nominal, true, found.targets, found.targets)
    np.testing.assert_allclose(found.position_error_before, before[:, 0], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.rotation_error_before, before[:, 1], rtol=1e-6, atol=1e-12)
    assert np.isfinite(found.corrected).all()
    assert set(found.status) <= set(STATUS)
    return errors


@pytest.mark.parametrize("seed", range(12))
def test_random_arms_with_six_joints(seed: int) -> None:
    nominal = random_arm(seed)
    true = deviated(nominal, seed)
    q = random_configurations(nominal, 60, seed) * 0.95
    found = compensate(nominal, true, q)
    errors = assert_reports_are_true(nominal, true, found)
    # Generic postures are reached; the few beside a singular one or a limit say so.
    assert found.reached.mean() > 0.85
    assert errors[found.reached].max() < 1e-9
    assert found.position_error_before.min() > 1e-5  # there was something to do
    assert np.median(np.abs(found.corrected - q)) < 2e-2
    for ok, status in zip(found.reached, found.status, strict=True):
        assert ok == (status in ("reached", "far"))


def test_kuka_and_its_base_in_a_tracker() -> None:
    """The tracker's pose changes nothing: it is not the robot's."""
    nominal = Robot.load("kuka_kr270")
    true = deviated(nominal)
    q = random_configurations(nominal, 300, 3)
    q[:, 2], q[:, 4] = np.linspace(0.3, 2.0, 300), np.linspace(0.3, 1.9, 300)  # elbow and wrist bent
    q = q * 0.9
    found = compensate(nominal, true, q)
    errors = assert_reports_are_true(nominal, true, found)
    assert found.reached.all() and errors.max() < 1e-9
    assert found.position_error_before.mean() > 2e-3
    placed = true.with_base(rotation(2, 1.0) @ rotation(0, 0.4), [3.0, -2.0, 1.0])
    moved = compensate(nominal, placed, q)
    np.testing.assert_allclose(moved.corrected, found.corrected, rtol=0, atol=1e-12)


def test_the_right_correction_by_hand() -> None:
    """Joint offsets alone: the correction is to tell the joint the opposite, whatever its direction."""
    nominal = Robot.load("kuka_kr270")
    offsets = {"q1": 1e-3, "q2": -2e-3, "q3": 3e-3, "q4": -1e-3, "q5": 2e-3, "q6": 5e-3}
    q = np.array([[0.1, -1.0, 1.5, 0.2, 0.8, -0.3], [1.0, -0.5, 0.9, -1.2, -0.9, 2.0]])
    found = compensate(nominal, nominal.with_deviations(offsets), q)
    np.testing.assert_allclose(found.corrected, q - list(offsets.values()), rtol=0, atol=1e-11)
    assert found.status == ("reached", "reached")


def test_no_error_no_correction() -> None:
    robot = mixed()
    q = random_configurations(robot, 50)
    found = compensate(robot, robot, q)
    np.testing.assert_allclose(found.corrected, q, rtol=0, atol=1e-12)
    assert set(found.status) == {"reached"}


def test_seven_joints_move_as_little_as_needed() -> None:
    """Redundancy: of the many answers one of (nearly) least length is returned."""
    nominal = random_arm(5, joints=7)
    true = deviated(nominal)
    q = random_configurations(nominal, 40, 1) * 0.9
    found = compensate(nominal, true, q, limits=False)
    errors = assert_reports_are_true(nominal, true, found)
    assert found.reached.mean() > 0.9 and errors[found.reached].max() < 1e-9
    for i in np.flatnonzero(found.reached)[:10]:

        def r(d: np.ndarray, i: int = i) -> np.ndarray:
            gap = pose(true, q[i] + d) - pose(nominal, q[i])
            return np.concatenate([1e4 * gap[:3].ravel(), d])  # errors weigh far more than motion

        least = least_squares(r, found.corrected[i] - q[i], xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert np.linalg.norm(found.corrected[i] - q[i]) < 1.05 * np.linalg.norm(least.x) + 1e-9


# ── position only ────────────────────────────────────────────────────────────────────────────────────


def test_position_only_brings_the_identified_target_where_the_nominal_one_should_be() -> None:
    nominal = mixed()
    true = deviated(nominal).with_deviations({"target_2.x": 1e-3, "target_2.z": -2e-3})
    q = random_configurations(nominal, 100, 4) * 0.9
    found = compensate(nominal, true, q, position_only=True, target=1)
    here = np.append(nominal.target_offsets[1], 1)
    there = np.append(true.target_offsets[1], 1)
    assert np.abs(here - there).max() > 1e-3
    gaps = [pose(nominal, a) @ here - pose(true, b) @ there for a, b in zip(q, found.corrected, strict=True)]
    assert np.linalg.norm(gaps, axis=1).max() < 1e-9
    assert found.reached.all() and np.isnan(found.rotation_error).all()
    assert found.to_dict()["rotation_error"] == [None] * 100


@pytest.mark.parametrize("longer", [1e-3, -1e-3])
def test_a_stretched_arm(longer: float) -> None:
    """Too long an upper arm must bend from the stretched, stationary posture; too short a one cannot reach."""
    nominal = Robot.load("planar_2r")
    true = nominal.with_deviations({"l1": longer})
    found = compensate(nominal, true, [[0.3, 0.0]], position_only=True)
    l1, l2, r = 1.0 + longer, nominal.with_parameters("l2").parameters[0].nominal, 0.0
    r = 1.0 + l2
    if longer > 0:
        bend = np.arccos((r**2 - l1**2 - l2**2) / (2 * l1 * l2))  # law of cosines
        assert abs(found.corrected[0, 1]) == pytest.approx(bend, abs=1e-9)
        assert found.reached.all()
    else:
        assert found.status == ("closest",)
        assert found.position_error[0] == pytest.approx(1e-3, rel=1e-9)  # stretched towards it
        np.testing.assert_allclose(found.corrected, [[0.3, 0.0]], rtol=0, atol=1e-6)


def test_two_joints_cannot_make_a_pose() -> None:
    """Under-actuated: the closest, and what remains; as good as an independent optimiser's."""
    nominal = Robot.load("planar_2r")
    true = nominal.with_deviations({"l1": 1e-3, "dq1": 2e-3} if "dq1" in nominal.available_parameters else {})
    q = np.array([[0.2, 0.9], [-1.0, -1.5], [2.0, 0.4]])
    found = compensate(nominal, true, q)
    assert_reports_are_true(nominal, true, found)
    assert set(found.status) == {"closest"}
    ours = np.hypot(found.position_error, 0.5 * found.rotation_error)
    for i in range(3):

        def r(x: np.ndarray, i: int = i) -> np.ndarray:
            a, b = pose(nominal, q[i]), pose(true, x)
            return np.append(a[:2, 3] - b[:2, 3], 0.5 * ((q[i] - x).sum() - 2e-3))

        best = np.sqrt(2 * least_squares(r, q[i], xtol=1e-15, ftol=1e-15, gtol=1e-15).cost)
        assert ours[i] == pytest.approx(best, rel=1e-6)
        assert best > 1e-5


# ── singular postures and limits ─────────────────────────────────────────────────────────────────────


def test_wrist_singularity() -> None:
    """Wrist axes aligned: finite, honest, and where not reached no better by another optimiser.

    Axes that are not quite perpendicular leave a hole around the aligned posture, so not all can be reached.
    """
    nominal = Robot.load("kuka_kr270")
    true = deviated(nominal)
    q = random_configurations(nominal, 100, 7)
    q[:, 2] = np.linspace(0.5, 2.0, 100)
    for bend in (0.0, 1e-7, 1e-3):
        q[:, 4] = bend
        found = compensate(nominal, true, q, limits=False)
        errors = assert_reports_are_true(nominal, true, found)
        assert found.reached.mean() > 0.5 and errors[found.reached].max() < 1e-9
        assert found.status.count("far") > 50
        after = np.hypot(found.position_error, 0.5 * found.rotation_error)
        before = np.hypot(found.position_error_before, 0.5 * found.rotation_error_before)
        assert (after <= before).all()
        assert np.abs(found.corrected - q).max() <= np.pi + 1e-9  # no whole turns on the way
        for i in np.flatnonzero(~found.reached)[:5]:
            assert after[i] < (1 + 1e-3) * best_nearby(nominal, true, q[i], found.corrected[i])


def best_nearby(nominal: Robot, true: Robot, q: np.ndarray, start: np.ndarray) -> float:
    """Remaining error [m], half a metre of lever, after scipy has tried to improve on ``start``."""
    goal = pose(nominal, q)

    def r(x: np.ndarray) -> np.ndarray:
        there = pose(true, x)
        turn = Rotation.from_matrix(goal[:3, :3] @ there[:3, :3].T).as_rotvec()
        return np.append(goal[:3, 3] - there[:3, 3], 0.5 * turn)

    return float(np.sqrt(2 * least_squares(r, start, xtol=1e-15, ftol=1e-15, gtol=1e-15).cost))


def test_limits_hold() -> None:
    nominal = Robot.load("kuka_kr270")
    true = nominal.with_deviations({"q1": 2e-3, "q2": -1e-3})
    low, high = nominal.joint_limits.T
    q = np.array([[0.0, -1.0, 1.5, 0.2, 0.8, 0.1]] * 3)
    q[0, 0], q[1, 1], q[2, 0] = low[0], high[1], low[0] - 0.01
    found = compensate(nominal, true, q)
    assert_reports_are_true(nominal, true, found)
    assert found.status == ("at_limit", "at_limit", "outside_limits")
    assert (found.corrected[:2] >= low).all() and (found.corrected[:2] <= high).all()
    assert found.corrected[2, 0] == q[2, 0]
    assert 1e-5 < found.position_error[0] < found.position_error_before[0]
    free = compensate(nominal, true, q, limits=False)
    assert set(free.status) == {"reached"}
    np.testing.assert_allclose(free.corrected[:, 0], q[:, 0] - 2e-3, rtol=0, atol=1e-10)


def test_continuous_joints_have_no_limits() -> None:
    nominal = mixed()
    true = nominal.with_deviations({"spin.offset": 5e-3})
    q = np.array([[0.1, 0.2, -np.pi, 0.3], [0.1, 0.2, 7.0, 0.3]])
    found = compensate(nominal, true, q)
    np.testing.assert_allclose(found.corrected[:, 2], q[:, 2] - 5e-3, rtol=0, atol=1e-11)
    assert set(found.status) == {"reached"}


# ── the border ───────────────────────────────────────────────────────────────────────────────────────


def test_rows_do_not_know_each_other() -> None:
    """Batched: each row is what it is alone; more rows than a block."""
    nominal = Robot.load("planar_2r")
    true = nominal.with_deviations({"l1": 1e-3, "l2": -1e-3})
    q = random_configurations(nominal, 20_100, 2)
    found = compensate(nominal, true, q, position_only=True)
    for i in (0, 19_999, 20_000, 20_099):
        alone = compensate(nominal, true, q[i], position_only=True)
        np.testing.assert_allclose(alone.corrected[0], found.corrected[i], rtol=0, atol=1e-9)
        assert alone.status[0] == found.status[i]


def test_wrong_input_and_immutable_results() -> None:
    robot = mixed()
    with pytest.raises(InputError, match="joints"):
        compensate(robot, Robot.load("planar_2r"), np.zeros((1, 4)))
    with pytest.raises(InputError, match="targets"):
        compensate(robot, robot, np.zeros((2, 3)))
    with pytest.raises(InputError, match="targets"):
        compensate(robot, robot, [[0, 0, np.nan, 0]])
    with pytest.raises(InputError, match="lever"):
        compensate(robot, robot, np.zeros((1, 4)), lever=0.0)
    with pytest.raises(InputError, match="from 0 to 1"):
        compensate(robot, robot, np.zeros((1, 4)), position_only=True, target=2)
    found = compensate(robot, robot, np.zeros(4))
    for array in (found.targets, found.corrected, found.position_error):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


# ── gravity and joint functions ──────────────────────────────────────────────────────────────────────

WAVES = 5


def moments(robot: Robot, q: np.ndarray) -> np.ndarray:
    """(N, joints) moment of a unit mass at the tip about each joint: how its height falls, by differences."""
    columns = []
    for step in 1e-6 * np.eye(q.shape[1]):
        columns.append((pose(robot, q - step) - pose(robot, q + step))[:, 2, 3] / 2e-6)
    return np.stack(columns, axis=1)


def test_joints_that_turn_beyond_their_reading() -> None:
    """Told the corrected readings q, the real joints, at q + φ(q) + δ(q), put the tool where the nominal is."""
    rng = np.random.default_rng(7)
    nominal = Robot.load("kuka_kr270")
    deviations = {"d2": 1e-3, "q3": -2e-3}
    waves, give = rng.normal(0.0, 3e-4, (2, 6, WAVES)), rng.normal(0.0, 5e-4, 6)
    model = replace(
        typical(),
        gravity=Gravity((Mass("tip"),)),
        joint_functions=JointFunctions(("smooth",), WAVES),
        scales=tuple(s for s in typical().scales if not s.name.startswith("short")),
    )
    robot = nominal.with_parameters(list(deviations))
    beta = np.concatenate([[*deviations.values()], give, np.concatenate(waves, axis=1).ravel()])
    nothing = np.zeros((len(beta), len(beta)))
    known = Knowledge(robot, model, beta, nothing, nothing[:, :0])
    q = np.radians([0.0, -60.0, 90.0, 20.0, 45.0, 10.0]) + rng.normal(0.0, 0.2, (50, 6))
    found = compensate(nominal, known.placed, q, corrections=known)
    assert set(found.status) == {"reached"}
    true, told = nominal.with_deviations(deviations), found.corrected
    errors = pose_errors(nominal, true, q, told + phi_of(waves, told) + give * moments(true, told))
    assert errors.max() < 2e-9
    assert (
        pose_errors(nominal, true, q, told)[:, 0].min() > 1e-4
    )  # what the joints do beyond their reading counts
    before = pose_errors(nominal, true, q, q + phi_of(waves, q) + give * moments(true, q))
    np.testing.assert_allclose(found.position_error_before, before[:, 0], rtol=0, atol=2e-9)


def phi_of(waves: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(N, joints) Fourier series of each joint."""
    x = q[..., None] * np.arange(1, WAVES + 1)
    return np.asarray(np.sum(waves[0] * np.cos(x) + waves[1] * np.sin(x), axis=2))
