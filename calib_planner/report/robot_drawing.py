# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A picture of what was understood of a robot: its chain at zero and in the middle of its range.

The chain is drawn from the base through a point on each joint's axis to the tip; every joint has its axis, in the
direction in which its coordinate grows, and its name; the frame of the tip and the targets are at the end.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.errors import InputError
from calib_planner.io import user_path
from calib_planner.report.scene import bodies
from calib_planner.robot import Robot

FORMATS = (".svg", ".png")
AXIS = 0.09
"""Length of a drawn axis, as a share of the picture."""
VIEW = {"elev": 18.0, "azim": -58.0}
"""From where it is seen, in degrees."""
COLOURS = {"chain": "#35506b", "axis": "#c0392b", "target": "#1e8449", "frame": ("#d9534f", "#5cb85c", "#428bca")}


def draw_robot(path: str | Path, robot: Robot, field: str = "--drawing") -> None:
    """Draw the chain with all coordinates at zero, and at the middle of the joint limits.

    Args:
        path: The file, .svg or .png.
        robot: The robot.
        field: The option that named the path, for errors.

    Raises:
        InputError: Another kind of file, or it cannot be written; names ``field``.
    """
    target = user_path(path)
    if target.suffix.lower() not in FORMATS:
        raise InputError(field, str(path), "a file that ends in .svg or .png")
    from matplotlib.figure import Figure  # 0.3 s, for the one who draws

    poses = {
        "all joints at zero": np.zeros(len(robot.joint_names)),
        "middle of the range": robot.joint_limits.mean(axis=1),
    }
    points = bodies(robot, np.array(list(poses.values())))
    middle = (points.max(axis=(0, 1)) + points.min(axis=(0, 1))) / 2
    half = max(float(np.abs(points - middle).max()), 1e-3) * 1.1
    figure = Figure(figsize=(11, 5.5), layout="constrained")
    figure.suptitle(robot.name)
    for place, (title, q) in enumerate(poses.items(), 1):
        axes = figure.add_subplot(1, 2, place, projection="3d", **VIEW)
        _draw(axes, robot, q, points[place - 1], AXIS * 2 * half)
        axes.set(title=title, xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
        axes.set(**{f"{a}lim": (m - half, m + half) for a, m in zip("xyz", middle, strict=True)})
        axes.set_box_aspect((1, 1, 1))
    try:
        figure.savefig(target, dpi=130, metadata={"Date": None} if target.suffix.lower() == ".svg" else None)
    except OSError as error:
        reason = f"{path} ({error.strerror or error})"
        raise InputError(field, reason, "a file that can be written", "choose another path") from None


def _draw(axes: Any, robot: Robot, q: FloatArray, body: FloatArray, size: float) -> None:
    """One posture; ``body`` (B, 3) as of ``bodies`` and axes of length ``size`` [m]."""
    turn = robot.base_pose[0]
    posture = robot.posture(q[None])
    count = len(robot.joint_names)
    chain, targets = body[: count + 2], body[count + 2 :]
    axes.plot(*chain.T, color=COLOURS["chain"], linewidth=3, solid_capstyle="round")
    for name, at, direction in zip(
        robot.joint_names, body[1 : count + 1], posture.joint_axes[0] @ turn, strict=True
    ):
        ends = np.stack([at - size * direction / 2, at + size * direction])
        axes.plot(*ends.T, color=COLOURS["axis"], linewidth=1.2)
        axes.scatter(*ends[1:].T, color=COLOURS["axis"], marker="^", s=14)
        axes.text(*(at + 1.25 * size * direction), name, fontsize=7)
    tip = chain[-1]
    for direction, colour in zip((turn.T @ posture.tip_rotation[0]).T, COLOURS["frame"], strict=True):
        axes.plot(*np.stack([tip, tip + size * direction]).T, color=colour, linewidth=1.5)
    axes.scatter(*targets.T, color=COLOURS["target"], s=18)
