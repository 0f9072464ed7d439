"""Planning for real robots: the error that no geometric model holds, as part of the problem.

What a full geometric fit leaves on a real robot is far above the instrument's noise. On the measured UR10
it is, to a log likelihood ratio of 1 800 over 1 500 coordinates, an error of each joint's transmission: a
function of that joint's angle alone, of a few tenths of a milliradian, with a correlation length of some degrees.
With c_l(q) = ∂p/∂q_l, independent f_l of unit variance and correlation ρ, and a white part,

    e(q) = Σ_l σ_l c_l(q) f_l(q_l) + white,     ρ(q_l, q'_l) = exp(−(2 sin((q_l − q'_l)/2))² / 2ℓ²),          (1)
    Σ(q) = Σ_l σ_l² c_l c_lᵀ + s² I + instrument.                                                         (2)

Two things follow for a plan: a configuration tells less the longer the joints' levers are — just the stretched
ones that plain optimal plans run to — and two configurations that share a joint angle share its error.

The estimator is the ordinary one, regularised: Gaussian priors P on the parameters and weights W = Σ(q)⁻¹ per
configuration, ignoring correlation between configurations (it cannot be trusted that far): with X = W^½ J,

    Π̂ = B Xᵀ W^½ y,     B = (P⁻¹ + XᵀX)⁻¹.

For y = JΠ + e, Π ~ N(0, P), the expected squared prediction error at a test pose * is closed:

    E‖J*(Π̂ − Π) − e*‖² = tr J* B (P⁻¹ + S) B J*ᵀ − 2 tr(B Xᵀ W^½ K_{X*} J*) + tr Σ*,                     (3)

S = XᵀW^½ K W^½X with the true covariance K of the chosen rows: I in the diagonal blocks (whitened), (1) between.
With a_il = X_iᵀ W_i^½ c_l(q_i) σ_l all of it is sums of outer products of p-vectors:

    S = XᵀX + Σ_{i≠j} Σ_l ρ_l(i, j) a_il a_jlᵀ,   X_iᵀ W_i^½ K_{i*} J* = Σ_l ρ_l(i, *) a_il (J*ᵀ c*_l σ_l)ᵀ.   (4)

The choice of candidates is greedy, then exchange. The error (3) is evaluated for all candidates at once; adding
candidate c changes XᵀX by X_cᵀX_c and

    S ← S + X_cᵀX_c + D_c + D_cᵀ,     D_c = Σ_l a_cl (Σ_i ρ_l(c, i) a_il)ᵀ.

Parameters are scaled by their prior standard deviation and rotated onto what candidates and test poses can see,
so P is I and nothing is singular: this choice needs no identifiability analysis. Cost is linear in the
candidates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from calib_planner.arrays import FloatArray, IntArray, check_number
from calib_planner.errors import InfeasibleError
from calib_planner.planning.search.exchange import Choice
from calib_planner.robot import Robot, is_nuisance
from calib_planner.tracker import Noise

FLAT_PRIOR = 1.0
"""Prior standard deviation of base and target parameters [m | rad]: next to nothing is known of them."""
PASSES = 2
"""Exchange passes after the greedy choice; more moves the held-out error by less than its scatter."""
BLOCK = 512
"""Candidates evaluated at a time."""


@dataclass(frozen=True)
class ModelDiscrepancy:
    """How far the real robot is expected from any geometric model.

    Attributes:
        joint_sigma: Transmission error of one turning joint, standard deviation [rad].
        joint_length: Its correlation length ℓ in joint angle [rad].
        slide_sigma: The same for sliding joints [m].
        slide_length: The same for sliding joints [m].
        point_sigma: s, white part of one coordinate [m].
        length_std: Prior standard deviation of every length parameter [m].
        angle_std: Prior standard deviation of every angle parameter [rad].
    """

    joint_sigma: float = 3.5e-4
    joint_length: float = 0.07
    slide_sigma: float = 5e-5
    slide_length: float = 0.02
    point_sigma: float = 1.2e-4
    length_std: float = 5e-4
    angle_std: float = 1e-3

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            may_be_zero = name in ("joint_sigma", "slide_sigma", "point_sigma")
            value = check_number(
                f"discrepancy.{name}", getattr(self, name), low=0, low_open=not may_be_zero, high=10
            )
            object.__setattr__(self, name, value)

    def joint_columns(self, robot: Robot, q: FloatArray) -> FloatArray:
        """σ_l c_l(q): (N, 3·targets, joints) [m]."""
        sigma = np.where(robot.joint_is_revolute, self.joint_sigma, self.slide_sigma)
        return np.ascontiguousarray(robot.joint_jacobian(q)) * sigma

    def covariance(self, robot: Robot, q: FloatArray, noise: Noise, repetitions: int = 1) -> FloatArray:
        """Σ(q) of eq. (2), (N, 3·targets, 3·targets) [m²]; its inverse is the estimator's weight."""
        columns = self.joint_columns(robot, q)
        result = columns @ np.swapaxes(columns, 1, 2)
        instrument = noise.covariance(robot.positions(q)) / repetitions
        for t in range(len(robot.targets)):
            part = slice(3 * t, 3 * t + 3)
            result[:, part, part] += instrument[:, t] + self.point_sigma**2 * np.eye(3)
        return result

    def correlation(self, robot: Robot, q: FloatArray, other: FloatArray) -> FloatArray:
        """ρ_l of every pair: (N, joints), (M, joints) → (joints, N, M)."""
        turns = robot.joint_is_revolute[:, None, None]
        difference = q.T[:, :, None] - other.T[:, None, :]
        apart = np.where(turns, 2.0 * np.sin(difference / 2.0), difference)
        length = np.where(turns, self.joint_length, self.slide_length)
        return np.exp(-((apart / length) ** 2) / 2.0)

    def prior_std(self, robot: Robot) -> FloatArray:
        """(P,) prior standard deviation of each active parameter [m | rad]."""
        std = [self.length_std if p.unit == "m" else self.angle_std for p in robot.parameters]
        return np.where([is_nuisance(n) for n in robot.parameter_names], FLAT_PRIOR, std)


# ── the choice of candidates ─────────────────────────────────────────────────────────────────────────


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


def choose_for_prediction(
    problem: PredictionProblem, cancel: Callable[[], bool] = lambda: False, passes: int = PASSES
) -> Choice:
    """Rows of the candidates, and −log of the expected squared error as the value.

    Raises:
        InfeasibleError: Fewer candidates than rows.
    """
    count = len(problem.candidates)
    if count < problem.size:
        raise InfeasibleError("candidates", f"{count} feasible rows, {problem.size} different ones are needed")
    model = PredictionModel(problem)
    fixed = list(range(count, count + len(problem.measured)))
    rows: list[int] = []
    tried = 0

    def errors(others: list[int]) -> FloatArray:
        nonlocal tried
        values = model.errors(others + fixed)[:count]
        tried += count
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
