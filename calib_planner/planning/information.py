# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What a set of configurations tells about the parameters: the information matrix of eqs. (10) and (11).

Measuring configuration q r times gives, with the point covariance Σ(p) of the instrument and an error of the
configuration itself that repetition does not average away (standard deviation σ_c),

    I(q) = J(q)ᵀ W(q) J(q),      W = (Σ(p(q))/r + σ_c² I)⁻¹  per target,
    M = M_0 + Σ_i I(q_i),        cov(Π̂) = M⁻¹,

M_0 being what is known beforehand (prior standard deviations, earlier measurements). For Σ = σ² I, σ_c = 0 and
M_0 = 0 this is eq. (11). All matrices are in physical units, 1/(parameter unit)².

Gradient. For ψ(M) with gradient G, dψ = Σ_i tr(G dI(q_i)) and

    tr(G dI) = 2 tr(G Jᵀ W dJ) − tr(K dΣ)/r,     K = W J G Jᵀ W  per target:

the first term goes back to the joints by ``Linearisation.pull_back``, the second by ∂Σ/∂p and ∂p/∂q.

``plan_space`` makes a plan problem ready for numbers: parameters that no configuration can tell apart are taken
out first (see ``robot.analyse``), so that every matrix is invertible for some plan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.error_model import FELT, accuracy_rows
from calib_planner.errors import InfeasibleError
from calib_planner.planning.criteria import (
    POSE_CRITERIA,
    Accuracy,
    Criterion,
    Eliminating,
    accuracy_weights,
    make_criterion,
)
from calib_planner.planning.extended import ExtendedModel
from calib_planner.planning.feasibility import Feasibility
from calib_planner.planning.problem import PlanProblem
from calib_planner.robot import Identifiability, Linearisation, Robot, analyse, is_nuisance
from calib_planner.tracker import Isotropic, Noise, covariance_gradient


@dataclass(frozen=True, eq=False)
class InformationModel:
    """How configurations turn into information.

    Attributes:
        robot: Its active parameters are the order of all matrices.
        noise: Covariance of one measured point.
        configuration_sigma: σ_c [m].
        repetitions: r, measurements at each configuration; or (N,), for exactly the N configurations of a plan.
    """

    robot: Robot
    noise: Noise
    configuration_sigma: float = 0.0
    repetitions: int | IntArray = 1

    def at(self, q: FloatArray) -> FloatArray:
        """I(q) of each configuration: (N, joints) → (N, p, p)."""
        points, jacobian = self.robot.positions_and_jacobian(q)
        jacobian = np.ascontiguousarray(jacobian)
        return np.swapaxes(jacobian, 1, 2) @ self._weigh(points, jacobian)

    def columns(self, q: FloatArray) -> FloatArray:
        """J (N, 3·targets, p) at ``q`` (N, joints)."""
        return self.robot.jacobian(q)

    def totals(self, q: FloatArray, size: int) -> FloatArray:
        """Σ I of each run of ``size`` configurations of ``q`` (N, joints): (N/size, p, p)."""
        each = self.at(q)
        return each.reshape(-1, size, *each.shape[1:]).sum(axis=1)

    def whitened(self, q: FloatArray) -> FloatArray:
        """Rows W^½ J with I(q) = rowsᵀ rows: (N, joints) → (N, 3·targets, p)."""
        points, jacobian = self.robot.positions_and_jacobian(q)
        jacobian = np.ascontiguousarray(jacobian)
        if isinstance(self.noise, Isotropic):
            return jacobian / np.sqrt(self._variance)
        whitener = np.linalg.inv(np.linalg.cholesky(self._covariance(points)))
        return (whitener @ jacobian.reshape(*points.shape, -1)).reshape(jacobian.shape)

    def linearised(self, q: FloatArray) -> LinearisedInformation:
        """The same with what its gradient needs."""
        lin = self.robot._linearise(q, None)
        jacobian = lin.jacobian()
        weighted = self._weigh(lin.points.transpose(2, 0, 1), jacobian)
        return LinearisedInformation(self, lin, jacobian, weighted)

    def _weigh(self, points: FloatArray, jacobian: FloatArray) -> FloatArray:
        """W J, (N, 3·targets, p)."""
        if isinstance(self.noise, Isotropic):
            return jacobian / self._variance
        blocks = jacobian.reshape(*points.shape, -1)
        return (np.linalg.inv(self._covariance(points)) @ blocks).reshape(jacobian.shape)

    @cached_property
    def _variance(self) -> FloatArray:
        """(1, 1, 1) or (N, 1, 1) Σ/r + σ_c² of isotropic noise [m²]."""
        assert isinstance(self.noise, Isotropic)
        return self.noise.sigma**2 / self._times(3) + self.configuration_sigma**2

    def _covariance(self, points: FloatArray) -> FloatArray:
        common = self.configuration_sigma**2 * np.eye(3)
        return self.noise.covariance(points) / self._times(points.ndim + 1) + common

    def _times(self, axes: int) -> FloatArray:
        """r with the configurations along the first of ``axes`` axes."""
        return np.reshape(self.repetitions, (-1,) + (1,) * (axes - 1)).astype(float)


Model = InformationModel | ExtendedModel
"""How configurations turn into information: by the paper, or by a whole error model."""


@dataclass(frozen=True, eq=False)
class LinearisedInformation:
    """I(q) at a batch of configurations, ready to be differentiated.

    Attributes:
        model: Where it comes from.
        lin: The chain's linearisation.
        jacobian: (N, 3·targets, p) J.
        weighted: (N, 3·targets, p) W J.
    """

    model: InformationModel
    lin: Linearisation
    jacobian: FloatArray
    weighted: FloatArray

    def sums(self, size: int) -> FloatArray:
        """Σ I over each run of ``size`` configurations: (N/size, p, p)."""
        rows, p = size * self.jacobian.shape[1], self.jacobian.shape[2]
        left = self.jacobian.reshape(-1, rows, p)
        return np.swapaxes(left, 1, 2) @ self.weighted.reshape(-1, rows, p)

    def gradient(self, gradients: FloatArray) -> FloatArray:
        """∂ψ/∂q (N, joints) for gradients G: (N/size, p, p), each serving a run of ``size`` configurations."""
        n, rows, p = self.jacobian.shape
        targets = rows // 3
        size = n // len(gradients)
        pull = (self.weighted.reshape(len(gradients), size * rows, p) @ gradients).reshape(n, rows, p)
        gradient = self.lin.pull_back(2.0 * pull)
        noise = self.model.noise
        if isinstance(noise, Isotropic):
            return gradient
        points = self.lin.points.transpose(2, 0, 1)
        blocks = pull.reshape(n, targets, 3, p) @ np.swapaxes(self.weighted.reshape(n, targets, 3, p), -1, -2)
        by_point = covariance_gradient(noise, points) / self.model._times(points.ndim + 2)
        force = -np.einsum("ntij,ntijx->ntx", blocks, by_point)
        return gradient + np.einsum("ntx,jtxn->nj", force, self.lin.joint_columns)


# ── the plan problem in numbers ──────────────────────────────────────────────────────────────────────────

SAMPLE = 512
"""Random configurations that stand for the whole workspace."""


@dataclass(frozen=True, eq=False)
class PlanSpace:
    """The problem in the coefficients that some plan can tell apart: p of them, q of interest.

    With an error model, those of gravity and of joint functions follow the parameters.

    Attributes:
        problem: The request.
        robot: Active in the identifiable parameters only.
        identifiability: Which of the problem's parameters those are.
        interest: Indices (among p) of the parameters that are not nuisance.
        model: Information of one configuration, repeated as wanted.
        single: Information of one measurement.
        prior: (p, p) M_0.
        stated: (P, P) the part of M_0 that somebody states of the P parameters.
        feasibility: The constraints.
        test_jacobians: (K, 3·targets, p) rows of (M3) at the test poses, base and target columns included.
        test_floor: (K,) part of ρ0² at a test pose that no coefficient holds [m²]; 0 for few test poses.
        blind: (K,) whether a test pose feels what no configuration shows.
        general: (p, p) mean accuracy weight over the workspace, of the same rows.
        general_floor: Mean of what no coefficient holds over the workspace [m²].
    """

    problem: PlanProblem
    robot: Robot
    identifiability: Identifiability
    interest: tuple[int, ...]
    model: Model
    single: Model
    prior: FloatArray
    stated: FloatArray
    feasibility: Feasibility
    test_jacobians: FloatArray
    test_floor: FloatArray
    blind: NDArray[np.bool_]
    general: FloatArray
    general_floor: float

    def criterion(self, name: str) -> Criterion:
        """The criterion of that name over the p parameters.

        Accuracies are of (M3), the same for every equivalent choice of parameters. Criteria of the parameters
        are about those of interest, base and targets eliminated: they hold for the choice of free parameters
        (the gauge) in which the others stay at their nominal values.
        """
        if name in POSE_CRITERIA:
            tests = accuracy_weights(self.test_jacobians)
            return make_criterion(name, len(self.prior), tests, self.problem.weight_array)
        made = make_criterion(name, len(self.interest), np.empty(0), np.ones(1))
        if not self.nuisance:
            return made
        return Eliminating(made, self.interest, self.nuisance)

    @property
    def nuisance(self) -> tuple[int, ...]:
        """Indices of the coefficients that are not of interest: of base, targets and the other terms."""
        return tuple(i for i in range(len(self.prior)) if i not in self.interest)

    @property
    def measurements(self) -> int:
        """Number of measurements in a plan of the problem's size."""
        return int(np.broadcast_to(self.model.repetitions, (self.problem.configurations,)).sum())

    def repeated(self, repetitions: int | IntArray) -> PlanSpace:
        """The same with so many visits to each configuration, one number or (m,)."""
        return replace(self, model=replace(self.model, repetitions=repetitions))

    def search_criterion(self) -> Criterion:
        """What the search maximises: the criterion wanted, with a share for accuracy elsewhere."""
        share = self.problem.general_weight
        plain = self.criterion(self.problem.criterion)
        if self.problem.criterion != "test_pose" or not isinstance(plain, Accuracy) or share == 0:
            return plain
        return Accuracy((1.0 - share) * plain.weight + share * self.general)


SPREAD = 4.0
"""Factor by which the robot's errors may differ from typical ones: one standard deviation of their scales."""


def spread_spaces(space: PlanSpace) -> tuple[PlanSpace, ...]:
    """The problem for a robot that errs less, and for one that errs more, than the typical one.

    A sum of concave criteria is concave: the search for a plan that is good in the mean of them is as before.
    Nothing for other models: their scales are taught or stated.
    """
    model = space.problem.whole_model
    if model is None or model.name != "typical":
        return ()
    return tuple(_scaled(space, factor) for factor in (1.0 / SPREAD, SPREAD))


def _scaled(space: PlanSpace, factor: float) -> PlanSpace:
    """The same for a robot whose joints err ``factor`` times as much; see ``ExtendedModel.scaled``."""
    assert isinstance(space.model, ExtendedModel) and isinstance(space.single, ExtendedModel)
    single, scales = space.single.scaled(factor), space.single.column_scales(factor)
    prior = (
        space.prior if space.problem.measured is None else _with_other_terms(space.problem, single, space.stated)
    )
    return replace(
        space,
        model=space.model.scaled(factor),
        single=single,
        prior=prior,
        test_jacobians=space.test_jacobians * scales,
        test_floor=space.test_floor * factor**2,
        general=space.general * scales[:, None] * scales,
        general_floor=space.general_floor * factor**2,
    )


def plan_space(problem: PlanProblem) -> PlanSpace:
    """Prepare a problem.

    Raises:
        InfeasibleError: The constraints leave nothing, no parameter can be identified, the number of
            configurations cannot identify them whichever they are, or the accuracy at the test poses depends on
            none of them.
    """
    names = problem.robot.parameter_names
    feasibility = Feasibility(problem.robot, problem.constraints)
    q = _representative(problem, feasibility)
    jacobians = np.ascontiguousarray(problem.robot.jacobian(q))
    stated_rows, measured_rows = _stated_rows(problem), _measured_rows(problem)
    prior_rows = np.concatenate([stated_rows, measured_rows])
    stacked = np.concatenate([jacobians.reshape(-1, len(names)), prior_rows * problem.instrument.typical])
    identifiable = analyse(stacked, names)
    free = sorted(identifiable.free)
    if not free:
        raise InfeasibleError(
            "parameters",
            f"no measurement of these targets depends on {', '.join(names)}; choose other parameters, or "
            "give the tool a target off the last axis",
        )
    prior = prior_rows.T @ prior_rows
    _check_enough(problem, jacobians[:, :, free], prior[np.ix_(free, free)])
    free_names = tuple(names[i] for i in free)
    robot = replace(problem.robot, joint_limits=feasibility.limits, parameter_names=free_names)
    interest = tuple(i for i, n in enumerate(robot.parameter_names) if not is_nuisance(n)) or tuple(
        range(len(free))
    )
    model = _model(problem, robot)
    single = replace(model, repetitions=1)
    known, stated = prior[np.ix_(free, free)], (stated_rows.T @ stated_rows)[np.ix_(free, free)]
    if isinstance(single, ExtendedModel):
        known = _with_other_terms(problem, single, stated)
    poses, frame = problem.test_pose_array, problem.accuracy_frame
    tests: FloatArray = np.empty((0, 3 * len(robot.targets), len(known)))
    blind = np.zeros(len(poses), bool)
    floor: FloatArray = np.zeros(len(poses))
    general_floor = 0.0
    columns, at_tests = jacobians[:, :, free], robot.positions_and_jacobian(poses)
    if isinstance(single, ExtendedModel):
        everywhere, there = single.linearised(q), single.linearised(poses)
        columns, at_tests = everywhere.jacobian, (robot.positions(poses), there.jacobian)
        floor, general_floor = there.floor, float(everywhere.floor.mean())
    if len(poses):
        tests = accuracy_rows(*at_tests, frame)
        felt = accuracy_rows(*problem.robot.positions_and_jacobian(poses), frame)
        unseen = np.abs(felt @ identifiable.directions.T).max(axis=(1, 2), initial=0.0)
        blind = unseen > FELT * np.abs(felt).max()
        _check_felt(problem, tests)
    general_rows = accuracy_rows(problem.robot.positions(q), columns, frame)
    return PlanSpace(
        problem=problem,
        robot=robot,
        identifiability=identifiable,
        interest=interest,
        model=model,
        single=single,
        prior=known,
        stated=stated,
        feasibility=feasibility,
        test_jacobians=tests,
        test_floor=floor,
        blind=blind,
        general=accuracy_weights(general_rows).mean(axis=0),
        general_floor=general_floor,
    )


def _model(problem: PlanProblem, robot: Robot) -> Model:
    model, sigma = problem.whole_model, problem.configuration_sigma
    if model is None:
        return InformationModel(robot, problem.instrument, sigma, problem.repetitions)
    return ExtendedModel.of(robot, model, problem.test_pose_array, problem.repetitions, sigma)


MEASURED_TOGETHER = 60
"""Visits measured already that share the joints' errors here: beyond that they are taken run by run."""


def _with_other_terms(problem: PlanProblem, model: ExtendedModel, known: FloatArray) -> FloatArray:
    """M₀ (p, p) from that of the parameters (P, P): the other terms, and what is measured already.

    The joint functions that are eliminated (see ``extended``) are shared among what is measured already, but not
    by that and the plan.
    """
    result = np.eye(model.size)
    result[: len(known), : len(known)] = known
    data = problem.measured
    if data is None:
        return result
    for first in range(0, len(data.q), MEASURED_TOGETHER):
        part = slice(first, first + MEASURED_TOGETHER)
        info, use = model.linearised(data.q[part]), np.repeat(data.seen[part], 3, axis=1).ravel()
        size = len(info.poses)
        rows, v = info.stacked(size)[0][use], info.covariance(size)[0][np.ix_(use, use)]
        result += rows.T @ np.linalg.solve(v, rows)
    return result


def _representative(problem: PlanProblem, feasibility: Feasibility) -> FloatArray:
    """Configurations that stand for all a plan may use; the same for every seed."""
    rng = np.random.default_rng(0)
    q = problem.candidate_array
    if q is None:
        return feasibility.sample(rng, SAMPLE)
    feasibility.check_candidates(q, problem.configurations if problem.once_each else 1)
    return q if len(q) <= SAMPLE else q[rng.choice(len(q), SAMPLE, replace=False)]


def _stated_rows(problem: PlanProblem) -> FloatArray:
    """(rows, P) whitened equations that somebody states of the parameters."""
    names = problem.robot.parameter_names
    placement, stated = problem.model.placement, problem.model.placement.stated
    variances = placement.variances(problem.robot, problem.model.values)
    rows: FloatArray = np.zeros((0, len(names)))
    if stated is not None:
        rows = stated.rows(names)
        variances[stated.places(names)] = np.inf
    known = np.isfinite(variances)
    return np.concatenate([rows, np.diag(1.0 / np.sqrt(variances))[known]])


def _measured_rows(problem: PlanProblem) -> FloatArray:
    """(rows, P) whitened equations of what is measured already, the points' own noise alone."""
    names, data = problem.robot.parameter_names, problem.measured
    if data is None:
        return np.zeros((0, len(names)))
    points, jacobian = problem.robot.positions_and_jacobian(data.q)
    noise = problem.instrument.covariance(points) + problem.configuration_sigma**2 * np.eye(3)
    whitener = np.linalg.inv(np.linalg.cholesky(noise))
    whitened = whitener @ jacobian.reshape(*points.shape, -1)
    return np.asarray(whitened[data.seen].reshape(-1, len(names)))


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


def _check_felt(problem: PlanProblem, tests: FloatArray) -> None:
    """Refuse a criterion of an accuracy that no parameter changes; ``tests``: (K, 3·targets, p) rows of (M3)."""
    wanted = any(name in POSE_CRITERIA for name in (problem.criterion, *problem.compound))
    if wanted and not tests[problem.weight_array > 0].any():
        raise InfeasibleError(
            "test_poses",
            f"no parameter that can be identified changes the accuracy {problem.accuracy_frame!r} at the test "
            "poses; choose other test poses, another accuracy or a criterion of the parameters",
        )


def _needed(jacobians: FloatArray, prior: FloatArray) -> tuple[int, int, int]:
    """Configurations needed, equations that each gives, parameters that are not known beforehand."""
    known = int(np.linalg.matrix_rank(prior)) if prior.any() else 0
    unknown = jacobians.shape[2] - known
    per_row = int(np.linalg.matrix_rank(jacobians[:8]).max())
    return -(-unknown // per_row), per_row, unknown


def smallest_size(problem: PlanProblem) -> int:
    """The smallest number of configurations that could identify the problem's parameters, at least 1.

    With a whole error model the tolerances of the chain do not count as known: a plan that relies on them shows
    the test poses alone.
    """
    space = plan_space(replace(problem, configurations=len(problem.robot.parameter_names)))
    q, count = _representative(problem, space.feasibility)[:8], len(space.robot.parameter_names)
    known = np.zeros((count, count)) if problem.whole_model else space.prior
    return max(_needed(np.ascontiguousarray(space.robot.jacobian(q)), known)[0], 1)
