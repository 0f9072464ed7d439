# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Robots that the tests share: the shipped ones and a URDF with every kind of joint."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from calib_planner import Plan, Robot
from calib_planner.io import parse_urdf
from calib_planner.robot import Element

T = TypeVar("T")
PROVE = os.environ.get("CALIB_PLANNER_PROVE") == "1"
"""``make prove``: every test with all its seeds; ``make test`` takes a sample of them."""

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"

MIXED_URDF = """<?xml version="1.0"?>
<robot name="mixed">
  <link name="base"/><link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="tip"/>
  <joint name="turn" type="revolute"><origin xyz="0.1 -0.2 0.3" rpy="0.3 -0.4 0.5"/>
    <parent link="base"/><child link="a"/><axis xyz="0.6 -0.48 0.64"/>
    <limit lower="-2" upper="2.5" effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic"><origin xyz="0.2 0 0.4" rpy="0 0.7 0"/>
    <parent link="a"/><child link="b"/><axis xyz="0 -1 0"/>
    <limit lower="-0.3" upper="0.8" effort="1" velocity="1"/></joint>
  <joint name="bracket" type="fixed"><origin xyz="0 0.3 0" rpy="1.5707963267948966 0 0"/>
    <parent link="b"/><child link="c"/></joint>
  <joint name="spin" type="continuous"><origin xyz="0 0 0.5"/>
    <parent link="c"/><child link="d"/><axis xyz="0 0 -1"/></joint>
  <joint name="nod" type="revolute"><origin xyz="0.3 0 0" rpy="0 0 1"/>
    <parent link="d"/><child link="tip"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>
"""


def repeats(sample: T, every: T) -> T:
    """The seeds, turns or examples of a test: a sample, or with ``make prove`` every one."""
    return every if PROVE else sample


def read_yaml(path: Path) -> Any:
    """What a YAML file says, by libyaml where that is there: Python takes seconds for a large one."""
    return yaml.load(path.read_text(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))


def mixed() -> Robot:
    """A chain with revolute, prismatic, continuous and fixed joints and an oblique axis; two targets."""
    return parse_urdf(MIXED_URDF, "mixed.urdf").with_targets([[0.1, 0.02, 0.3], [-0.05, 0.2, 0.1]])


def random_chain(seed: int) -> Robot:
    """A chain of 2 to 4 joints, turning and sliding about and along any axis, every amount with a parameter."""
    rng = np.random.default_rng(seed)
    joints = int(rng.integers(2, 5))
    elements, limits = [], []
    for k in range(joints):
        slides = rng.random() < 0.3
        kind = ("T" if slides else "R") + "xyz"[rng.integers(3)]
        low = rng.uniform(-0.8, 0.0) if slides else rng.uniform(-4.0, 0.0)
        limits.append([low, low + (rng.uniform(0.2, 1.0) if slides else rng.uniform(0.5, 7.0))])
        sign = float(rng.choice([-1.0, 1.0]))
        elements.append(Element(kind, float(rng.normal()), k, sign, f"joint{k}"))
        link = "T" + "xyz"[rng.integers(3)]
        elements.append(Element(link, float(rng.uniform(0.2, 1.5)), parameter=f"link{k}"))
        if rng.random() < 0.5:
            elements.append(Element("R" + "xyz"[rng.integers(3)], float(rng.normal()), parameter=f"turn{k}"))
    names = [e.parameter for e in elements if e.parameter]
    active = tuple(
        sorted(rng.choice(names, int(rng.integers(2, len(names) + 1)), replace=False), key=names.index)
    )
    plain = Robot(f"random{seed}", tuple(elements), (), tuple(f"j{k}" for k in range(joints)), np.array(limits))
    return replace(plain.with_targets(rng.normal(0.0, 0.3, (1, 3))), parameter_names=active)


def random_configurations(robot: Robot, count: int, seed: int = 0) -> np.ndarray:
    """(count, joints) uniform within the joint limits."""
    low, high = robot.joint_limits.T
    return np.random.default_rng(seed).uniform(low, high, (count, len(low)))


def plan_of(robot: Robot, configurations: np.ndarray, repetitions: int = 1, **changes: object) -> Plan:
    """A plan of these configurations (m, joints) with made-up promises; no search."""
    count, parameters = len(configurations), robot.parameter_names
    values: dict[str, object] = {
        "robot": robot.name,
        "criterion": "test_pose",
        "parameters": parameters,
        "joint_names": robot.joint_names,
        "configurations": configurations,
        "repetitions": np.full(count, repetitions),
        "test_poses": configurations[:1],
        "weights": np.ones(1),
        "sigma": 3e-5,
        "predicted_accuracy": 2e-5,
        "predicted_accuracy_per_test_pose": np.full(1, 2e-5),
        "parameter_std": np.full(len(parameters), 1e-4),
        "unidentifiable": (),
        "general_accuracy": 5e-5,
        "value": 2e-5,
        "value_bound": 1.5e-5,
        "lower_bound": 1.5e-5,
        "efficiency": 0.75,
        "bound": "numerical",
        "status": "ok",
        "message": "The plan is complete.",
        "seconds": 1.0,
        "seed": 0,
        "starts": 1,
        "evaluations": 1,
    }
    return Plan.from_values({**values, **changes})


def changed(plan: Plan, **changes: object) -> Plan:
    """The plan with other values of its own or of its quality."""
    return Plan.from_values({**plan.values(), **changes})


CASES = {
    "planar_2r": lambda: Robot.load("planar_2r"),
    "kuka_kr270": lambda: Robot.load("kuka_kr270"),
    "kuka_kr270 full": lambda: Robot.load("kuka_kr270").with_parameters("full", ("base", "tool")),
    "mixed lengths+offsets": mixed,
    "mixed offsets": lambda: mixed().with_parameters("offsets"),
    "mixed full": lambda: mixed().with_parameters("full", ("base", "tool")),
}


def cylinder_urdf(robot: Robot, radii: list[float], share: float = 0.7) -> str:
    """A URDF of the same joints whose links are cylinders, about the middle ``share`` of the segments of the body
    that ``calib_planner.robot.Capsules`` has; segments without length have no shape."""
    posture = robot.posture(np.zeros(len(robot.joint_names)))
    nodes = np.concatenate([[robot.base_pose[1]], posture.joint_origins[0], posture.tip_origin])

    def link(k: int) -> str:
        x, y, z = v = nodes[k + 1] - nodes[k]
        length = float(np.linalg.norm(v))
        if length < 1e-9:
            return f'<link name="l{k}"/>'
        turn = f"0 {np.arctan2(np.hypot(x, y), z)} {np.arctan2(y, x)}"
        return (
            f'<link name="l{k}"><collision><origin xyz="{x / 2} {y / 2} {z / 2}" rpy="{turn}"/><geometry>'
            f'<cylinder radius="{radii[k]}" length="{share * length}"/></geometry></collision></link>'
        )

    def joint(k: int) -> str:
        x, y, z = nodes[k + 1] - nodes[k]
        axis, (low, high) = posture.joint_axes[0, k], robot.joint_limits[k]
        return (
            f'<joint name="{robot.joint_names[k]}" type="revolute"><origin xyz="{x} {y} {z}"/>'
            f'<parent link="l{k}"/><child link="l{k + 1}"/><axis xyz="{axis[0]} {axis[1]} {axis[2]}"/>'
            f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/></joint>'
        )

    count = len(robot.joint_names)
    parts = [link(k) for k in range(count + 1)] + [joint(k) for k in range(count)]
    return f'<robot name="{robot.name}">{"".join(parts)}</robot>'
