"""A plan problem made ready for numbers: identifiable parameters, prior information, the criterion.

Parameters that no configuration can tell apart are taken out first (see ``identifiability``), so that every
matrix below is invertible for some plan. What is known beforehand enters as M_0.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calib_planner._arrays import FloatArray
from calib_planner.design.criteria import (
    Accuracy,
    Criterion,
    Eliminating,
    accuracy_weights,
    make_criterion,
)
from calib_planner.design.feasibility import Feasibility
from calib_planner.design.identifiability import Identifiability, analyse
from calib_planner.design.information import InformationModel
from calib_planner.design.problem import PlanProblem
from calib_planner.errors import InfeasibleError
from calib_planner.robot.chain import Robot

SAMPLE = 512
"""Random configurations that stand for the whole workspace."""


@dataclass(frozen=True, eq=False)
class PlanSpace:
    """The problem in parameters that some plan can tell apart; p of them, q of interest.

    Attributes:
        problem: What was asked.
        robot: Active in the identifiable parameters only.
        identifiability: Which of the problem's parameters those are.
        interest: Indices (among p) of the parameters that are not nuisance.
        model: Information of one configuration, repeated as asked.
        single: Information of one measurement.
        prior: (p, p) M_0.
        feasibility: The constraints.
        test_jacobians: (K, 3·targets, p) at the test poses, nuisance columns zero.
        general: (p, p) mean accuracy weight over the workspace, nuisance zero.
        sample: (p, p) mean information of one measurement over the workspace.
    """

    problem: PlanProblem
    robot: Robot
    identifiability: Identifiability
    interest: tuple[int, ...]
    model: InformationModel
    single: InformationModel
    prior: FloatArray
    feasibility: Feasibility
    test_jacobians: FloatArray
    general: FloatArray
    sample: FloatArray

    def criterion(self, name: str) -> Criterion:
        """The criterion of that name over the p parameters, nuisance eliminated."""
        p, inner = len(self.robot.parameter_names), list(self.interest)
        tests = accuracy_weights(self.test_jacobians[:, :, inner])
        made = make_criterion(name, len(inner), tests, self.problem.weight_array)
        if len(inner) == p:
            return made
        return Eliminating(made, self.interest, tuple(i for i in range(p) if i not in self.interest))

    def search_criterion(self) -> Criterion:
        """What the search maximises: the criterion asked for, kept from going blind elsewhere."""
        share = self.problem.general_weight
        plain = self.criterion(self.problem.criterion)
        inner = plain.inner if isinstance(plain, Eliminating) else plain
        if self.problem.criterion != "test_pose" or not isinstance(inner, Accuracy) or share == 0:
            return plain
        keep = np.ix_(self.interest, self.interest)
        mixed = Accuracy((1.0 - share) * inner.weight + share * self.general[keep])
        if isinstance(plain, Eliminating):
            return Eliminating(mixed, plain.interest, plain.nuisance)
        return mixed


def plan_space(problem: PlanProblem) -> PlanSpace:
    """Prepare a problem.

    Raises:
        InfeasibleError: The constraints leave nothing, no parameter can be identified, or the number of
            configurations cannot identify them whichever they are.
    """
    names = problem.robot.parameter_names
    feasibility = Feasibility(problem.robot, problem.constraints)
    q = _representative(problem, feasibility)
    jacobians = np.ascontiguousarray(problem.robot.jacobian(q))
    prior_rows = _prior_rows(problem)
    stacked = np.concatenate([jacobians.reshape(-1, len(names)), prior_rows * problem.instrument.typical])
    found = analyse(stacked, names)
    kept = sorted(found.kept)
    if not kept:
        raise InfeasibleError(
            "parameters",
            f"no measurement of these targets depends on {', '.join(names)}; choose other parameters, or "
            "give the tool a target off the last axis",
        )
    prior = prior_rows.T @ prior_rows
    _check_enough(problem, jacobians[:, :, kept], prior[np.ix_(kept, kept)])
    robot = replace(problem.robot, joint_limits=feasibility.limits).with_parameters([names[i] for i in kept])
    interest = tuple(
        i for i, n in enumerate(robot.parameter_names) if not n.startswith(("base.", "target_"))
    ) or tuple(range(len(kept)))
    mask = np.isin(np.arange(len(kept)), interest)
    tests: FloatArray = np.empty((0, 3 * len(robot.targets), len(kept)))
    if len(problem.test_pose_array):
        tests = robot.jacobian(problem.test_pose_array) * mask
    single = InformationModel(robot, problem.instrument, problem.configuration_sigma)
    return PlanSpace(
        problem=problem,
        robot=robot,
        identifiability=found,
        interest=interest,
        model=InformationModel(robot, problem.instrument, problem.configuration_sigma, problem.repetitions),
        single=single,
        prior=prior[np.ix_(kept, kept)],
        feasibility=feasibility,
        test_jacobians=tests,
        general=accuracy_weights(jacobians[:, :, kept] * mask).mean(axis=0),
        sample=single.at(q).mean(axis=0),
    )


def _representative(problem: PlanProblem, feasibility: Feasibility) -> FloatArray:
    """Configurations that stand for all a plan may use; the same for every seed."""
    rng = np.random.default_rng(0)
    if problem.candidates is None:
        return feasibility.sample(rng, SAMPLE)
    pool = np.asarray(problem.candidates)
    feasibility.check_pool(pool, 1 if problem.repeat_candidates else problem.configurations)
    return pool if len(pool) <= SAMPLE else pool[rng.choice(len(pool), SAMPLE, replace=False)]


def _prior_rows(problem: PlanProblem) -> FloatArray:
    """(rows, P) whitened equations known beforehand: M_0 = rowsᵀ rows."""
    names = problem.robot.parameter_names
    rows: list[FloatArray] = [np.zeros((0, len(names)))]
    for name, std in problem.prior_std.items():
        rows.append((np.arange(len(names)) == names.index(name))[None] / std)
    if problem.measured is not None:
        data = problem.measured
        points, jacobian = problem.robot.positions_and_jacobian(data.q)
        noise = problem.instrument.covariance(points) + problem.configuration_sigma**2 * np.eye(3)
        whitener = np.linalg.inv(np.linalg.cholesky(noise))
        whitened = whitener @ jacobian.reshape(*points.shape, -1)
        rows.append(whitened[data.seen].reshape(-1, len(names)))
    return np.concatenate(rows)


def _check_enough(problem: PlanProblem, jacobians: FloatArray, prior: FloatArray) -> None:
    """Refuse what so few configurations cannot identify, whichever they are."""
    needed, per_row, unknown = _needed(jacobians, prior)
    if problem.configurations < needed:
        raise InfeasibleError(
            "configurations",
            f"{problem.configurations} configurations give at most "
            f"{problem.configurations * per_row} equations for {unknown} identifiable parameters; ask for "
            f"at least {needed}, or for fewer parameters",
        )


def _needed(jacobians: FloatArray, prior: FloatArray) -> tuple[int, int, int]:
    """Configurations needed, equations that each gives, parameters that are not known beforehand."""
    known = int(np.linalg.matrix_rank(prior)) if prior.any() else 0
    unknown = jacobians.shape[2] - known
    per_row = max(int(np.linalg.matrix_rank(j)) for j in jacobians[:8])
    return -(-unknown // per_row), per_row, unknown


def smallest_size(problem: PlanProblem) -> int:
    """The smallest number of configurations that could identify the problem's parameters, at least 1."""
    space = plan_space(replace(problem, configurations=len(problem.robot.parameter_names)))
    q = _representative(problem, space.feasibility)[:8]
    return max(_needed(np.ascontiguousarray(space.robot.jacobian(q)), space.prior)[0], 1)
