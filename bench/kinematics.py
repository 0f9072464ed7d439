# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Positions + identification Jacobian of the KR-270, poses per second beside Pinocchio's from Python.

Pinocchio: forwardKinematics + computeJointKinematicRegressor per configuration, called in a Python loop on the
same core. Ours: Robot.positions_and_jacobian, one call per batch. Ratios are of medians within this run; the two
take turns, so that what else the machine does falls on both.
"""

from __future__ import annotations

import json
import statistics
import sys
import time

import numpy as np
import pinocchio as pin

from calib_planner import Robot

ROUNDS = 9


def pinocchio_model(robot: Robot) -> tuple[pin.Model, pin.SE3]:
    """The same chain as a Pinocchio model; the pose of the target behind the last joint."""
    model, parent, placement = pin.Model(), 0, pin.SE3.Identity()
    axes = {"Rx": pin.JointModelRX, "Ry": pin.JointModelRY, "Rz": pin.JointModelRZ}
    for element in robot.elements:
        if element.joint is None:
            shift = np.zeros(3)
            assert element.kind[0] == "T" or element.value == 0.0
            if element.kind[0] == "T":
                shift[element.axis] = element.sign * element.value
            placement = placement * pin.SE3(np.eye(3), shift)
        else:
            name = robot.joint_names[element.joint]
            parent = model.addJoint(parent, axes[element.kind](), placement, name)
            placement = pin.SE3.Identity()
    return model, placement


def loop(model: pin.Model, target: pin.SE3, rows: np.ndarray) -> float:
    """Seconds per pose of Pinocchio."""
    data, joint = model.createData(), model.njoints - 1
    frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    forward, regressor = pin.forwardKinematics, pin.computeJointKinematicRegressor
    began = time.perf_counter()
    for q in rows:
        forward(model, data, q)
        regressor(model, data, joint, frame, target)
    return (time.perf_counter() - began) / len(rows)


def main() -> None:
    robot = Robot.load("kuka_kr270")
    low, high = robot.joint_limits.T
    rng = np.random.default_rng(0)
    model, target = pinocchio_model(robot)
    check = rng.uniform(low, high, (5, 6))
    for q in check:
        data = model.createData()
        pin.forwardKinematics(model, data, q)
        assert np.allclose((data.oMi[model.njoints - 1] * target).translation, robot.positions(q)[0, 0])
    result = []
    for count in (1_000, 100_000):
        q = rng.uniform(low, high, (count, 6))
        ours, theirs = [], []
        repeats = max(20_000 // count, 1)
        robot.positions_and_jacobian(q)
        for _ in range(ROUNDS):
            began = time.perf_counter()
            for _ in range(repeats):
                robot.positions_and_jacobian(q)
            ours.append((time.perf_counter() - began) / (repeats * count))
            theirs.append(loop(model, target, q[:5_000]))
        mine, other = statistics.median(ours), statistics.median(theirs)
        result.append({"batch": count, "ours_ns": 1e9 * mine, "pinocchio_ns": 1e9 * other, "ratio": other / mine})
    for row in result:
        print(
            f"batch {row['batch']:>7}: {row['ours_ns']:7.1f} ns/pose, Pinocchio {row['pinocchio_ns']:7.1f} "
            f"ns/pose, ratio {row['ratio']:.1f}",
            file=sys.stderr,
        )
    print(json.dumps(result))


if __name__ == "__main__":
    main()
