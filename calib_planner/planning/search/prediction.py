"""The choice of candidates that predicts best on a robot with model discrepancy: greedy, then exchange.

The expected squared prediction error of eq. (3) of ``discrepancy`` is evaluated for all candidates at once; with
V = P⁻¹ + S of the rows chosen, adding candidate c changes XᵀX by X_cᵀX_c and

    S ← S + X_cᵀX_c + D_c + D_cᵀ,     D_c = Σ_l a_cl (Σ_i ρ_l(c, i) a_il)ᵀ.

Parameters are scaled by their prior standard deviation and rotated onto what candidates and test poses can see,
so P is I and nothing is singular: this choice needs no identifiability analysis. Cost is linear in the
candidates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.errors import InfeasibleError
from calib_planner.planning.discrepancy import ModelDiscrepancy
from calib_planner.planning.problem import PlanProblem
from calib_planner.planning.search.exchange import Choice
from calib_planner.robot import Robot
from calib_planner.tracker import Noise

PASSES = 2
"""Exchange passes after the greedy choice; more moves the held-out error by less than its scatter."""
BLOCK = 512
"""Candidates evaluated at a time."""


@dataclass(frozen=True, eq=False)
class PredictionProblem:
    """Choose ``size`` rows of ``candidates`` after which the test poses are predicted best.

    Attributes:
        robot: Nominal, with the parameters to be identified.
        candidates: (C, joints) candidates.
        test_poses: (K, joints) where the error counts.
        shares: (K,) weights, summing to one.
        size: Number of rows.
        discrepancy: What the real robot has beyond the model.
        noise: The instrument.
        repetitions: Measurements at each configuration.
        prior_std: (P,) of the parameters [m | rad].
        measured: (F, joints) configurations measured already.
        repeat: Whether a row may be chosen more than once.
    """

    robot: Robot
    candidates: FloatArray
    test_poses: FloatArray
    shares: FloatArray
    size: int
    discrepancy: ModelDiscrepancy
    noise: Noise
    repetitions: int
    prior_std: FloatArray
    measured: FloatArray
    repeat: bool = False


def prediction_problem(problem: PlanProblem, candidates: FloatArray) -> PredictionProblem:
    """The choice that a plan problem with ``discrepancy`` asks for, from the rows of ``candidates``."""
    assert problem.discrepancy is not None
    robot = problem.robot
    std = problem.discrepancy.prior_std(robot)
    for name, value in problem.prior.std.items():
        std[robot.parameter_names.index(name)] = value
    nothing = np.empty((0, len(robot.joint_names)))
    return PredictionProblem(
        robot=robot,
        candidates=candidates,
        test_poses=problem.test_pose_array,
        shares=problem.weight_array / problem.weight_array.sum(),
        size=problem.configurations,
        discrepancy=problem.discrepancy,
        noise=problem.instrument,
        repetitions=problem.repetitions,
        prior_std=std,
        measured=nothing if problem.prior.measured is None else problem.prior.measured.q,
        repeat=not problem.once_each,
    )


def choose_for_prediction(
    problem: PredictionProblem, cancel: Callable[[], bool] = lambda: False, passes: int = PASSES
) -> Choice:
    """Rows of the candidates, and −log of the expected squared error as the value.

    Raises:
        InfeasibleError: Fewer candidates than rows.
    """
    count = len(problem.candidates)
    if not count or (count < problem.size and not problem.repeat):
        raise InfeasibleError("candidates", f"{count} feasible rows, {problem.size} different ones are needed")
    model = PredictionModel(problem)
    fixed = list(range(count, count + len(problem.measured)))
    rows: list[int] = []
    tried = 0

    def errors(others: list[int]) -> FloatArray:
        nonlocal tried
        values = model.errors(others + fixed)[:count]
        tried += count
        if not problem.repeat:
            values[others] = np.inf
        return values

    while len(rows) < problem.size:
        rows.append(int(np.argmin(errors(rows))))
    for _ in range(passes):
        changed = False
        for position in range(problem.size):
            if cancel():
                break
            values = errors(rows[:position] + rows[position + 1 :])
            new = int(np.argmin(values))
            if values[new] < values[rows[position]] * (1.0 - 1e-9):
                rows[position], changed = new, True
        if not changed:
            break
    return Choice(np.array(rows, np.int64), -float(np.log(model.error(rows + fixed))), tried)


class PredictionModel:
    """Eq. (3) for any choice of rows: the candidates first, then what is measured already.

    Attributes:
        size: p, parameters that candidates or test poses can see.
    """

    def __init__(self, problem: PredictionProblem) -> None:
        robot, process = problem.robot, problem.discrepancy
        q = np.concatenate([problem.candidates, problem.measured])
        covariance = process.covariance(robot, q, problem.noise, problem.repetitions)
        whitener = np.linalg.inv(np.linalg.cholesky(covariance))
        jacobian, tests = self._seen(problem, q)
        self.rows = whitener @ jacobian
        self.size = self.rows.shape[2]
        self.joint = np.swapaxes(whitener @ process.joint_columns(robot, q), 1, 2) @ self.rows  # a_il (C, l, p)
        self.q, self.robot, self.process = q, robot, process
        share = problem.shares
        self.weight = np.einsum("k,kai,kaj->ij", share, tests, tests, optimize=True)
        pull = (
            np.swapaxes(process.joint_columns(robot, problem.test_poses), 1, 2) @ tests
        )  # J*ᵀ c*_l σ_l (K, l, p)
        rho = process.correlation(robot, q, problem.test_poses)
        meet = np.stack([rho[j] @ (share[:, None] * pull[:, j]) for j in range(len(rho))], axis=1)
        self.link = np.swapaxes(self.joint, 1, 2) @ meet
        self.unit = np.swapaxes(self.rows, 1, 2) @ self.rows
        own = process.covariance(robot, problem.test_poses, problem.noise)
        self.floor = float(share @ np.einsum("kaa->k", own))
        self.targets = len(robot.targets)

    @staticmethod
    def _seen(problem: PredictionProblem, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """J P^½ at ``q`` and at the test poses, in an orthonormal basis of what they can see."""
        both = np.concatenate([q, problem.test_poses])
        jacobian = np.ascontiguousarray(problem.robot.jacobian(both)) * problem.prior_std
        flat = jacobian.reshape(-1, jacobian.shape[2])
        values, vectors = np.linalg.eigh(flat.T @ flat)
        seen = vectors[:, values > 1e-14 * values[-1]]
        turned = jacobian @ seen
        return turned[: len(q)], turned[len(q) :]

    def error(self, rows: list[int]) -> float:
        """Expected squared distance at the test poses after measuring ``rows`` [m²], mean over targets."""
        if not rows:
            return (float(np.trace(self.weight)) + self.floor) / self.targets
        last = np.array(rows[-1:])
        return float(self._errors(rows[:-1], last)[0])

    def errors(self, rows: list[int]) -> FloatArray:
        """(C,) the same after one more row, for every candidate."""
        parts = [
            self._errors(rows, np.arange(i, min(i + BLOCK, len(self.rows))))
            for i in range(0, len(self.rows), BLOCK)
        ]
        return np.concatenate(parts)

    def _met(self, at: IntArray, chosen: IntArray) -> FloatArray:
        """Σ_i ρ_l(c, i) a_il over the rows chosen: (len(at), l, p)."""
        rho = self.process.correlation(self.robot, self.q[at], self.q[chosen])
        return np.stack([r @ self.joint[chosen, j] for j, r in enumerate(rho)], axis=1)

    def _errors(self, rows: list[int], new: IntArray) -> FloatArray:
        eye = np.eye(self.size)
        information, link, spread = eye + self.unit[rows].sum(axis=0), self.link[rows].sum(axis=0), 0.0 * eye
        both = self.unit[new]
        if rows:
            chosen = np.array(rows)
            met, own = self._met(new, chosen), self._met(chosen, chosen)
            shared = np.swapaxes(self.joint[new], 1, 2) @ met
            both = both + shared + np.swapaxes(shared, 1, 2)
            # ρ = 1 of a row with itself is in XᵀX already
            spread = (np.swapaxes(self.joint[rows], 1, 2) @ (own - self.joint[rows])).sum(axis=0)
        gain = np.linalg.inv(information + self.unit[new])
        folded = gain @ self.weight @ gain
        risk = np.einsum("cij,cij->c", folded, information + spread + both)
        help_ = np.einsum("cij,cji->c", gain, link + self.link[new])
        return (risk - 2.0 * help_ + self.floor) / self.targets
