"""A proof of the bound: a rigorous upper bound on the largest sensitivity, by branch and bound.

By (B) of ``criteria`` a bound on every plan of n measurements follows from any slope G = S Sᵀ once an upper bound
on max_q d(q) is certain, d(q) = tr(G I_1(q)). With isotropic noise d is a polynomial (see ``sensitivity``), and
``branch_and_bound`` on its Bernstein form finds its largest value, with an allowance for rounding. What G may
lack in being a slope of Ψ is allowed for as well, where the largest c with c Ψ(M) ≤ tr(G M) for all M has a
closed form:

    accuracy       tr(G M) tr(A M⁻¹) ≥ ‖A^½ S‖²_*  (nuclear norm; Cauchy and Schwarz),    c = ‖A^½ S‖²_*
    determinant    tr(G M) ≥ p det(G M)^(1/p),                                           c = p det(G)^(1/p)
    smallest eigenvalue                                                                 c = tr G

For the other criteria G is taken as the slope that it is up to rounding. Constraints only shrink the set of
plans: a bound over the joint limits holds for them too. With a laser tracker's noise d is no polynomial: its
bound stays numerical.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.planning.bound import RelaxedDesign, RelaxedProblem, relaxed_design
from calib_planner.planning.certify.branch_and_bound import maximise
from calib_planner.planning.certify.polynomial import polynomial, sensitivity, square_root
from calib_planner.planning.criteria import Accuracy, Criterion, Determinant, Eliminating, PowerMean
from calib_planner.planning.information import InformationModel
from calib_planner.tracker import Isotropic

TOLERANCE = 1e-4
"""Relative, of d; half of it for ρ0."""
TIME_LIMIT = 20.0
LARGEST_GRID = 5**8
ROUNDS = 4
MISSED = 5e-4
"""A maximum this much above what search had found, relative, is worth another relaxed design."""

PROOF_STATUS = {
    "proven": "The bound is proven",
    "time_limit": "The bound is proven, less closely than asked because time was up",
    "noise": "The bound stays numerical: only isotropic noise makes the sensitivity a polynomial",
    "joints": "The bound stays numerical: too many joints for a proof",
    "pool": "The bound is proven: every candidate was looked at",
}
"""Every status a proof can have."""


@dataclass(frozen=True, eq=False)
class Proof:
    """What is certain about max_q d(q) over the joint limits.

    Attributes:
        maximum_upper: d is nowhere larger; infinite if nothing is proven.
        maximum_found: Largest value of d that was met.
        where: (joints,) configuration where d is ``maximum_found`` [rad | m].
        slope: (p, p) G = S Sᵀ as used.
        scale: c of the table above: c Ψ(M) ≤ tr(G M) for all M.
        boxes: Boxes bounded.
        active: Indices of the joints on which d depends.
        seconds: Time spent.
        status: A key of ``PROOF_STATUS``.
    """

    maximum_upper: float
    maximum_found: float
    where: FloatArray
    slope: FloatArray
    scale: float
    boxes: int
    active: tuple[int, ...]
    seconds: float
    status: str

    @property
    def holds(self) -> bool:
        """Whether anything is proven."""
        return bool(np.isfinite(self.maximum_upper))

    @property
    def tolerance(self) -> float:
        """How far ``maximum_upper`` is above ``maximum_found``, relative."""
        return self.maximum_upper / self.maximum_found - 1.0 if self.maximum_found > 0 else float("inf")

    def ceiling(self, prior: FloatArray, measurements: int) -> float:
        """Upper bound on Ψ of any plan of so many measurements, M_0 = ``prior`` (p, p)."""
        known = float(np.sum(self.slope * prior)) * (1.0 + 1e-12)
        return (known + measurements * self.maximum_upper) / self.scale

    @property
    def text(self) -> str:
        """One sentence for people."""
        close = f" to {self.tolerance:.1g} of the sensitivity" if self.holds and self.status != "pool" else ""
        return f"{PROOF_STATUS[self.status]}{close}."


def prove_bound(
    problem: RelaxedProblem,
    relaxed: RelaxedDesign,
    rng: np.random.Generator,
    *,
    tolerance: float = TOLERANCE,
    time_limit: float = TIME_LIMIT,
    stop: Callable[[], bool] = lambda: False,
) -> tuple[RelaxedDesign, Proof]:
    """Turn the bound of ``relaxed`` into a proven one.

    A maximum of d that search had missed joins the support of the next relaxed design, so that a bound once
    refuted comes back almost as good. Constraints are put aside: the proof is over the joint limits.

    Returns:
        The design with the smallest proven bound, and its proof; the design unchanged if nothing is proven.
    """
    if problem.pool is not None:
        return relaxed, _prove_pool(problem, problem.pool, relaxed.slope)
    deadline = time.perf_counter() + time_limit
    free = replace(problem, feasibility=replace(problem.feasibility, constraints=()))
    bounded, tried = bool(problem.feasibility.constraints), relaxed
    if bounded and not _obstacle(problem.model):
        tried = relaxed_design(free, relaxed.support, rng, stop)
    best: tuple[float, Proof] | None = None
    for _ in range(ROUNDS):
        proof = prove_maximum(
            problem.model,
            problem.criterion,
            tried.slope,
            tried.support,
            tolerance=tolerance,
            time_limit=max(deadline - time.perf_counter(), 1e-3),
            stop=stop,
        )
        if not proof.holds:
            return relaxed, proof
        ceiling = proof.ceiling(problem.prior, problem.measurements)
        if best is None or ceiling < best[0]:
            best = ceiling, proof
        if tried.worth > relaxed.worth and not bounded:
            relaxed = tried
        missed = ceiling > (1.0 + MISSED + proof.tolerance) * tried.bound
        if not missed or stop() or time.perf_counter() > deadline:
            break
        strong = tried.support[tried.weights > 1e-3]
        tried = relaxed_design(free, np.concatenate([strong, proof.where[None]]), rng, stop)
    assert best is not None
    return replace(relaxed, bound=best[0], slope=best[1].slope), best[1]


def prove_maximum(
    model: InformationModel,
    criterion: Criterion,
    slope: FloatArray,
    known: FloatArray,
    *,
    tolerance: float = TOLERANCE,
    time_limit: float = TIME_LIMIT,
    stop: Callable[[], bool] = lambda: False,
) -> Proof:
    """Bound d(q) = tr(``slope`` I(q)) over the joint limits.

    Args:
        model: Information of one measurement.
        criterion: What ``slope`` is a slope of.
        slope: (p, p) G, positive semi-definite.
        known: (K, joints) configurations within the limits where d is large, K ≥ 1.
        tolerance: How close maximum_upper shall come to maximum_found, relative.
        time_limit: Seconds; what has been proven by then is returned.
        stop: Asked now and then; ``True`` ends the work as the time limit does.
    """
    began = time.perf_counter()
    root = square_root(slope)
    reason = _obstacle(model)
    if reason:
        return Proof(np.inf, np.nan, known[0], root @ root.T, 1.0, 0, (), 0.0, reason)
    values, _ = sensitivity(model, root, known)
    d = polynomial(model, root)
    found = maximise(d.axes, d.tensor, float(values.max()), tolerance=tolerance, time_limit=time_limit, stop=stop)
    where = known[int(np.argmax(values))].copy()
    if found.where is not None:
        where[list(d.active)] = found.where
    return Proof(
        maximum_upper=found.upper + d.allowance,
        maximum_found=found.found,
        where=where,
        slope=root @ root.T,
        scale=_scale(criterion, root),
        boxes=found.boxes,
        active=d.active,
        seconds=time.perf_counter() - began,
        status="time_limit" if found.late else "proven",
    )


def _prove_pool(problem: RelaxedProblem, pool: FloatArray, slope: FloatArray) -> Proof:
    """Over a finite pool (C, joints) with any noise: every d is computed, the bound is exact already."""
    q = pool[problem.feasibility.mask(pool)]
    d = np.einsum("nab,ab->n", problem.model.at(q), slope)
    best = int(np.argmax(d))
    return Proof(float(d[best]), float(d[best]), q[best], slope, 1.0, len(q), (), 0.0, "pool")


def _obstacle(model: InformationModel) -> str:
    """Why nothing can be proven, or empty."""
    if not isinstance(model.noise, Isotropic):
        return "noise"
    turns = model.robot.joint_is_revolute
    return "joints" if 5.0 ** turns.sum() * 3.0 ** (~turns).sum() > LARGEST_GRID else ""


def _scale(criterion: Criterion, root: FloatArray) -> float:
    """c of the table at the top, less its own rounding; 1 where there is no closed form."""
    inner, interest = criterion, list(range(len(root)))
    if isinstance(criterion, Eliminating):
        inner, interest = criterion.inner, list(criterion.interest)
    if isinstance(inner, Accuracy):  # with nuisance: A is zero elsewhere, [M⁻¹]_ii is the inverse of M reduced
        half = square_root(inner.weight).T @ root[interest]
        return float(np.linalg.svd(half, compute_uv=False).sum()) ** 2 * (1.0 - 1e-12)
    if inner is not criterion:
        return 1.0
    if isinstance(inner, Determinant) and root.shape[0] == root.shape[1]:
        size = len(root)
        return size * float(np.exp(np.linalg.slogdet(root)[1] * 2.0 / size)) * (1.0 - 1e-12)
    if isinstance(inner, PowerMean) and inner.smallest:
        return float(np.sum(root * root)) * (1.0 - 1e-12)
    return 1.0
