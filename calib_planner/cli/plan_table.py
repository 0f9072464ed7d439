"""A plan for people: what it promises first, then the configurations."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.table import Table

from calib_planner.design.budget import Split
from calib_planner.design.plan import Plan
from calib_planner.design.problem import POSE_CRITERIA
from calib_planner.report.quantities import length
from calib_planner.robot.chain import Robot


def show_plan(plan: Plan, robot: Robot, console: Console) -> None:
    """Print a plan of ``robot``."""
    console.print(f"{plan.status}: {plan.message}", style="green" if plan.status == "ok" else "yellow")
    if len(plan.test_poses):
        console.print(
            f"Predicted accuracy ρ0 {length(plan.predicted_accuracy)} at the test pose"
            f"{'s (rms)' if len(plan.test_poses) > 1 else ''}, from {plan.measurements} measurements "
            f"with σ = {length(plan.sigma)}."
        )
    console.print(_bound(plan))
    console.print(_configurations(plan, robot))
    if len(plan.test_poses) > 1:
        per = ", ".join(length(v) for v in plan.predicted_accuracy_per_test_pose)
        console.print(f"ρ0 per test pose: {per}")
    unseen = [n for n, s in zip(plan.parameters, plan.parameter_std, strict=True) if np.isinf(s)]
    if unseen:
        console.print(f"Not seen by this plan: {', '.join(unseen)}", style="yellow")
    for combination in plan.unidentifiable:
        console.print(f"No plan can tell apart: {combination}", soft_wrap=True)
    console.print(
        f"{plan.starts} starts, {plan.evaluations} plans evaluated, {plan.seconds:.1f} s, seed {plan.seed}"
    )


def _bound(plan: Plan) -> str:
    everywhere = f"Over all joint limits {length(plan.general_accuracy)} (rms)."
    metric = plan.criterion in POSE_CRITERIA
    value = length(plan.value) if metric else f"{plan.value:.5g}"
    told = "" if plan.criterion == "test_pose" else f"Criterion {plan.criterion}: {value}. "
    if plan.bound == "none":
        return f"{told}This criterion has no bound. {everywhere}"
    limit = length(plan.value_bound) if metric else f"{plan.value_bound:.5g}"
    return (
        f"{told}No plan of {plan.measurements} measurements is better than {limit} "
        f"({plan.bound} bound): efficiency {100 * plan.efficiency:.1f} %. {everywhere}"
    )


def show_tried(split: Split, console: Console) -> None:
    """Print the sizes that were tried for an accuracy or a budget."""
    table = Table(title="sizes tried")
    for heading in ("configurations", "each", "measurements", "ρ0"):
        table.add_column(heading, justify="right")
    for p in split.tried:
        k, r = len(p.configurations), int(p.repetitions[0])
        table.add_row(
            str(k), f"{r}×", str(p.measurements), length(p.value), style="bold" if p is split.plan else ""
        )
    console.print(table)
    if split.fewest:
        console.print(f"No plan of fewer than {split.fewest} measurements can reach it.")


def _configurations(plan: Plan, robot: Robot) -> Table:
    table = Table(title="configurations, in the order of measuring")
    table.add_column("#", justify="right")
    for name, turns in zip(plan.joint_names, robot.joint_is_revolute, strict=True):
        table.add_column(f"{name}\n[{'°' if turns else 'mm'}]", justify="right")
    table.add_column("measure", justify="right")
    factors = np.where(robot.joint_is_revolute, 180.0 / np.pi, 1e3)
    for i, (row, times) in enumerate(zip(plan.configurations * factors, plan.repetitions, strict=True), 1):
        table.add_row(str(i), *(f"{v:.2f}" for v in row), f"{times}×")
    return table
