# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A proof of the bound: a rigorous upper bound on the largest sensitivity, by branch and bound.

By (B) of ``criteria`` a bound on every plan of m visits follows from any gradient G = S Sᵀ once an upper
bound on max_q d(q) is certain, d(q) = tr(G I_r(q)). With isotropic noise d is a polynomial (see ``polynomial``),
and ``branch_and_bound`` on its Bernstein form finds its largest value, with an allowance for rounding. What G may
lack in being a gradient of Ψ is allowed for as well, where the largest c with c Ψ(M) ≤ tr(G M) for all M has a
closed form:

    accuracy       tr(G M) tr(A M⁻¹) ≥ ‖A^½ S‖²_*  (nuclear norm; Cauchy and Schwarz),    c = ‖A^½ S‖²_*
    determinant    tr(G M) ≥ p det(G M)^(1/p),                                           c = p det(G)^(1/p)
    smallest eigenvalue                                                                 c = tr G

For the other criteria G is taken as the gradient that it is up to rounding. Constraints only shrink the set of
plans: a bound over the joint limits holds for them too. With a laser tracker's noise d is no polynomial: its
bound stays numerical.

Every plan tries a proof, with an amount of work that is counted in coefficients and not in seconds: the same seed
gives the same answer on any machine. A proof that is required runs to its end.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.planning.bound import (
    ApproximateDesign,
    DesignProblem,
    approximate_design,
    continued,
)
from calib_planner.planning.certify.branch_and_bound import maximise
from calib_planner.planning.certify.polynomial import polynomial, sensitivity, square_root
from calib_planner.planning.criteria import Accuracy, Criterion, Determinant, Eliminating, PowerMean
from calib_planner.planning.extended import ExtendedModel
from calib_planner.planning.information import Model
from calib_planner.tracker import Isotropic

TOLERANCE = 1e-4
"""Relative, of d; half of it for ρ0."""
CLOSELY = 1e-6
"""The same where a proof is required: it costs a tenth more."""
TIME_LIMIT = 20.0
LARGEST_GRID = 5**8
USUAL_WORK = 2.5e7
"""Coefficients of boxes that a plan bounds where no proof is required: 0.1 to 0.3 s."""
USUAL_GRID = 5**6
"""Nodes that it samples d at for that, 10 to 20 ms."""
ROUNDS = 4
MISSED = 5e-4
"""A maximum this much above what search had seen, relative, justifies another approximate design."""
LOOSE = 2e-3
"""How far, relative, a bound that is proven with limited work may be above the numerical one and replace it."""

PROOF_STATUS = {
    "proven": "The bound is proven",
    "time_limit": "The bound is proven, less closely than wanted because time was up",
    "work": "The bound is numerical: the proof takes longer than a plan should, ask for it (--prove)",
    "model": "The bound stays numerical: with a whole error model the sensitivity is no polynomial of the joints",
    "coupled": "The bound stays numerical: coupled joints make the sensitivity a polynomial of higher degree",
    "noise": "The bound stays numerical: only isotropic noise makes the sensitivity a polynomial",
    "joints": "The bound stays numerical: too many joints for a proof",
    "candidates": "The bound is proven: every candidate was looked at",
}
"""Every status a proof can have."""


@dataclass(frozen=True, eq=False)
class Proof:
    """What is certain about max_q d(q) over the joint limits.

    Attributes:
        maximum_upper: d is nowhere larger; infinite if nothing is proven.
        largest_seen: Largest value of d that was met.
        where: (joints,) configuration where d is ``largest_seen`` [rad | m].
        gradient: (p, p) G = S Sᵀ as used.
        scale: c of the table above: c Ψ(M) ≤ tr(G M) for all M.
        boxes: Boxes bounded.
        active: Indices of the joints on which d depends.
        seconds: Time spent.
        status: A key of ``PROOF_STATUS``.
        work: Coefficients of all boxes.
    """

    maximum_upper: float
    largest_seen: float
    where: FloatArray
    gradient: FloatArray
    scale: float
    boxes: int
    active: tuple[int, ...]
    seconds: float
    status: str
    work: int = 0

    @property
    def holds(self) -> bool:
        """Whether anything is proven."""
        return bool(np.isfinite(self.maximum_upper))

    @property
    def tolerance(self) -> float:
        """How far ``maximum_upper`` is above ``largest_seen``, relative."""
        return self.maximum_upper / self.largest_seen - 1.0 if self.largest_seen > 0 else float("inf")

    def ceiling(self, prior: FloatArray, visits: int) -> float:
        """Upper bound on Ψ of any plan of so many visits, M_0 = ``prior`` (p, p)."""
        known = float(np.sum(self.gradient * prior)) * (1.0 + 1e-12)
        return (known + visits * self.maximum_upper) / self.scale

    @property
    def text(self) -> str:
        """One sentence for people."""
        within = self.holds and self.status != "candidates"
        close = f" to {self.tolerance:.1g} of the sensitivity" if within else ""
        return f"{PROOF_STATUS[self.status]}{close}."


def prove_bound(
    problem: DesignProblem,
    design: ApproximateDesign,
    rng: np.random.Generator,
    *,
    tolerance: float = TOLERANCE,
    time_limit: float = TIME_LIMIT,
    most_work: float = float("inf"),
    cancel: Callable[[], bool] = lambda: False,
) -> tuple[ApproximateDesign, Proof]:
    """Turn the bound of ``design`` into a proven one.

    A maximum of d that search had missed joins the support of the design, which then grows on, so that a bound
    once refuted comes back almost as good. Constraints are put aside: the proof is over the joint limits.

    Args:
        problem: What the bound is of.
        design: Where to begin.
        rng: Of random configurations.
        tolerance: How close the largest sensitivity shall be enclosed, relative.
        time_limit: Seconds; what has been proven by then is returned.
        most_work: Coefficients of boxes; where they do not suffice for a bound as close as the numerical one,
            nothing is proven.
        cancel: Called now and then; ``True`` ends the work as the time limit does.

    Returns:
        The design with the smallest proven bound, and its proof; the design unchanged if nothing is proven.
    """
    if problem.candidates is not None:
        return design, _prove_candidates(problem, design)
    deadline = time.perf_counter() + time_limit
    free = replace(problem, feasibility=replace(problem.feasibility, constraints=()))
    bounded, tried = bool(problem.feasibility.constraints), design
    if bounded and not _obstacle(problem.model):
        tried = approximate_design(free, design.support, rng, cancel)
    numerical = design.bound
    best: tuple[float, Proof, float] | None = None
    for _ in range(ROUNDS):
        proof = prove_maximum(
            problem.model,
            problem.criterion,
            tried.gradient,
            tried.support,
            tolerance=tolerance,
            time_limit=max(deadline - time.perf_counter(), 1e-3),
            most_work=most_work,
            cancel=cancel,
        )
        if not proof.holds:
            return design, proof
        ceiling = proof.ceiling(problem.prior, problem.visits)
        if best is None or ceiling < best[0]:
            best = ceiling, proof, tried.ground
        if tried.value > design.value and not bounded:
            design = tried
        most_work -= proof.work
        missed = ceiling > (1.0 + MISSED + proof.tolerance) * tried.bound
        if not missed or cancel() or time.perf_counter() > deadline or proof.status == "work":
            break
        tried = continued(free, tried, proof.where[None], rng, cancel)
    assert best is not None
    ceiling, proof, ground = best
    if proof.status == "work" and ceiling > (1.0 + LOOSE) * max(numerical, design.value):
        return design, replace(proof, maximum_upper=np.inf)
    return replace(design, bound=ceiling, gradient=proof.gradient, ground=ground), proof


def prove_maximum(
    model: Model,
    criterion: Criterion,
    gradient: FloatArray,
    known: FloatArray,
    *,
    tolerance: float = TOLERANCE,
    time_limit: float = TIME_LIMIT,
    most_work: float = float("inf"),
    cancel: Callable[[], bool] = lambda: False,
) -> Proof:
    """Bound d(q) = tr(``gradient`` I_r(q)) over the joint limits.

    Args:
        model: Information of one visit.
        criterion: What ``gradient`` is a gradient of.
        gradient: (p, p) G, positive semi-definite.
        known: (K, joints) configurations within the limits where d is large, K ≥ 1.
        tolerance: How close maximum_upper shall come to largest_seen, relative.
        time_limit: Seconds; what has been proven by then is returned.
        most_work: Coefficients of boxes after which the same happens.
        cancel: Called now and then; ``True`` ends the work as the time limit does.
    """
    began = time.perf_counter()
    root = square_root(gradient)
    reason = _obstacle(model)
    if not reason and np.isfinite(most_work) and _grid(model) > USUAL_GRID:
        reason = "work"
    if reason or isinstance(model, ExtendedModel):
        return Proof(np.inf, np.nan, known[0], root @ root.T, 1.0, 0, (), 0.0, reason)
    values, _ = sensitivity(model, root, known)
    d = polynomial(model, root)
    top = maximise(
        d.axes,
        d.tensor,
        float(values.max()),
        tolerance=tolerance,
        time_limit=time_limit,
        most_work=most_work,
        cancel=cancel,
    )
    work = top.boxes * d.tensor.size
    where = known[int(np.argmax(values))].copy()
    if top.where is not None:
        where[list(d.active)] = top.where
    return Proof(
        maximum_upper=top.upper + d.allowance,
        largest_seen=top.largest,
        where=where,
        gradient=root @ root.T,
        scale=_scale(criterion, root),
        boxes=top.boxes,
        active=d.active,
        seconds=time.perf_counter() - began,
        status="proven" if not top.late else "work" if work > most_work else "time_limit",
        work=work,
    )


def _prove_candidates(problem: DesignProblem, design: ApproximateDesign) -> Proof:
    """Over candidates, with any model: every d was computed, the bound is exact already."""
    assert problem.candidates is not None
    top = (design.bound - design.ground) / problem.visits
    where = design.support[int(np.argmax(design.weights))]
    return Proof(top, top, where, design.gradient, 1.0, len(problem.candidates), (), 0.0, "candidates")


def _obstacle(model: Model) -> str:
    """Why nothing can be proven, or empty."""
    if isinstance(model, ExtendedModel):
        return "model"
    if model.robot.couplings:
        return "coupled"
    if not isinstance(model.noise, Isotropic):
        return "noise"
    return "joints" if _grid(model) > LARGEST_GRID else ""


def _grid(model: Model) -> float:
    """Nodes at which d is sampled."""
    turns = model.robot.joint_is_revolute
    return float(5.0 ** turns.sum() * 3.0 ** (~turns).sum())


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
