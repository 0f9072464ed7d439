"""From the parameters of the campaign node to a campaign's problem, and from its stops to plans on the wire."""

from __future__ import annotations

import uuid
from dataclasses import dataclass

import numpy as np

from calib_planner.campaign import CampaignProblem, CampaignState
from calib_planner.errors import InputError
from calib_planner.planning import Plan
from calib_planner.ros.model_source import Model, NotReady
from calib_planner.ros.planning import constraints_of
from calib_planner.ros.settings import CampaignParameters, unknown_words, with_topics

SAME = ("budget", "batch", "validation", "minimum", "attempts", "most_failures", "exclusion", "sigma", "starts",
        "time_limit", "seed")  # fmt: skip
"""Parameters that are fields of ``CampaignProblem``."""


def problem_of(settings: CampaignParameters, model: Model | NotReady) -> CampaignProblem:
    """What the parameters ask for.

    Raises:
        NotReady: There is no robot yet.
        InputError: A parameter is not usable for this robot.
    """
    if not isinstance(model, Model):
        raise model
    if not settings.test_pose_rows:
        names = ", ".join(model.robot.joint_names)
        raise InputError("test_poses", "none", f"joint coordinates in the order {names}", "set the parameter")
    robot = with_topics(model.robot, settings.targets or None, settings.unknown)
    robot = robot.with_parameters(settings.parameters, unknown_words(settings.unknown))
    lengths = {len(row) for row in settings.test_pose_rows}
    if lengths != {len(robot.joint_names)}:
        expected = f"{len(robot.joint_names)} numbers a pose: {', '.join(robot.joint_names)}"
        raise InputError("test_poses", f"{sorted(lengths)} numbers", expected)
    return CampaignProblem(
        robot,
        np.array(settings.test_pose_rows),
        settings.required_accuracy,
        constraints=constraints_of(settings, robot),  # type: ignore[arg-type]
        identification={"joint_corrections": settings.joint_corrections},
        **{name: getattr(settings, name) for name in SAME},
    )


@dataclass(frozen=True, eq=False)
class Announced:
    """A plan that the identifier is told.

    Attributes:
        plan_id: Its name.
        plan: The plan.
        stops: Number of the stop of each row.
        role: What they are for, ``fit`` or ``validation``.
    """

    plan_id: str
    plan: Plan
    stops: tuple[int, ...]
    role: str

    def covers(self, stop: int, state: CampaignState) -> bool:
        """Whether the stop is in it as it is now: for the same purpose, and as often."""
        if stop not in self.stops or state.stops[stop].role != self.role:
            return False
        return bool(self.plan.repetitions[self.stops.index(stop)] == state.stops[stop].times)

    def part(self, row: int) -> Plan:
        """One row, to be measured once."""
        values = {name: getattr(self.plan, name) for name in self.plan.__dataclass_fields__}
        values |= {"configurations": self.plan.configurations[row : row + 1], "repetitions": np.array([1])}
        return Plan(**values)


def announced(state: CampaignState, campaign_id: str, role: str) -> Announced:
    """All stops of ``role`` that were measured or are to be: what the identifier matches standstills to."""
    measured = {r.index for r in state.rows}
    stops = [i for i, s in enumerate(state.stops) if s.role == role and (i in measured or i in state.queue)]
    problem, last = state.problem, state.rounds[-1] if state.rounds else None
    poses = problem.test_pose_array
    accuracy = float("nan") if last is None else last.accuracy
    plan = Plan(
        robot=problem.robot.name,
        criterion="test_pose",
        parameters=problem.robot.parameter_names,
        joint_names=problem.robot.joint_names,
        configurations=np.array([state.stops[i].q for i in stops]),
        repetitions=np.array([state.stops[i].times for i in stops]),
        test_poses=poses,
        weights=np.full(len(poses), 1.0 / len(poses)),
        sigma=problem.instrument.typical,
        predicted_accuracy=accuracy,
        predicted_accuracy_per_test_pose=np.full(len(poses), accuracy),
        parameter_std=np.full(len(problem.robot.parameter_names), np.nan),
        unidentifiable=(),
        general_accuracy=float("nan"),
        value=accuracy,
        value_bound=float("nan"),
        lower_bound=float("nan"),
        efficiency=float("nan"),
        bound="none",
        status="ok",
        message=state.message,
        seconds=0.0,
        seed=problem.seed,
        starts=0,
        evaluations=0,
    )
    return Announced(f"{campaign_id}-{role}-{uuid.uuid4().hex[:8]}", plan, tuple(stops), role)
