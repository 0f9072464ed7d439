# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What a set of configurations tells when the robot errs as an error model says: (M1), (M2).

Measuring configuration q gives, with c_l = ∂p/∂q_l and the moments τ of gravity,

    y = J ΔΠ + Σ_g c_g τ_g u_g + Σ_l c_l φ_l(q_l) + visit and points,      φ_l(q_l) = Φ_l(q_l) a_l ,

Φ_l the Fourier series of joint l scaled so that its coefficients a_l (F of them) have variance one. Six
joints have 768 of them, far more than a plan has points. So each a_l is split by an orthonormal basis U_l (F, b):
U_lᵀa_l, which slow waves and what the test poses feel make up, stays a coefficient; the rest is eliminated. It
leaves

    κ_l(q, q') = Φ_l(q) (I − U_l U_lᵀ) Φ_l(q')ᵀ ,   V_ij = δ_ij R_i + Σ_l c_l(q_i) κ_l(q_il, q_jl) c_l(q_j)ᵀ ,
    X(q) = [J, c_g τ_g σ_g, c_l Φ_l U_l] ,           M = M₀ + Xᵀ V⁻¹ X ,                                     (1)

the information on the p coefficients that stay: the Schur complement of the information (M2) on all of them. The
latter is additive in the configurations, the complement is concave in it, and a criterion grows with M: Ψ(M) is
concave in the design as before, so search, bound and proof stay. Two configurations with equal joint angles share
κ_l, which makes the second one tell less: plans spread by themselves.

*Gradient.* With G = ∂Ψ/∂M, Z = V⁻¹X G, K = Z Xᵀ V⁻¹: dΨ = 2 tr(Zᵀ dX) − tr(K dV). What X and V depend on are J
and c_l, which ``Linearisation.pull_back`` takes to the joints, τ and Φ.

*Other sizes.* Where gravity, joint functions and repeatability are f times as large (``scaled``), X turns into
X D_f, D_f being 1 for the robot's parameters and f for the rest, and V = N + S into N + f² S, S being what the
errors of the joints make of it and N the rest. So X, N and S are computed once for all f, and the gradients of
several f go back to the joints as one sum: 2 Σ_f (V_f⁻¹X) D_f G_f D_f is ∂Ψ/∂X, and −Σ_f K_f and −Σ_f f² K_f are
∂Ψ/∂N and ∂Ψ/∂S.

*Bound.* A gradient G of Ψ at M has the gradient L G Lᵀ on all coefficients, L = [I; −Θ] being the elimination at
the design ξ: Θ_l = Σ_j (I − U_lU_lᵀ) Φ_l(q_j)ᵀ c_l(q_j)ᵀ (V_ξ⁻¹X)_j. So (B) of ``criteria`` reads

    Ψ(M*) ≤ tr G (M₀ + Σ_l Θ_lᵀΘ_l) + n max_q tr(G X̃(q)ᵀ R(q)⁻¹ X̃(q)) ,                                      (2)
    X̃(q) = X(q) − Σ_l c_l(q) Φ_l(q) Θ_l ,

which is a model of the same kind without V's coupling, ``LinearisedExtension.seen_from``. In a design with
weights w_j, R_j / (n w_j) stands for n w_j measurements. At the design itself both sides of (2) are equal if all
heights are. A design may divide n measurements among any number of configurations, of which each has its own κ_l;
n real ones cannot, so that the best plan stays below the bound by as much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.error_model import ErrorModel, JointFunctions, Poses, joint_units
from calib_planner.robot import Layout, Robot
from calib_planner.tracker import Isotropic, Noise, covariance_gradient

try:
    import calib_planner.planning._kernel as _kernel
except ImportError:  # not built: NumPy does the same, more slowly
    _kernel = None

SLOW = 3
"""Waves per turn that stay coefficients whatever the test poses: what the rest of the workspace feels most."""
FELT_WAVES = 12
"""Further functions of each joint's angle that stay: those that the test poses feel."""
UNCERTAIN = ("gravity", "smooth.size", "short.size", "repeatability")
"""Scales of the errors of the joints: a plan does not trust them until an estimate has taught them."""
SMALL = 24
"""Up to so many equations a run, NumPy factors all runs in one call faster than LAPACK each of them."""


@dataclass(frozen=True, eq=False)
class ExtendedModel:
    """How configurations turn into information on the p coefficients, in the place of ``InformationModel``.

    Attributes:
        robot: Its active parameters come first among the coefficients, then gravity and joint functions.
        model: How it errs.
        repetitions: r, visits to each configuration; or (N,), for exactly the N configurations of a plan.
        configuration_sigma: σ_c, error of a configuration that repetition does not average away [m].
        basis: (joints, F, b) U_l.
        maps: (joints, F, p) how Φ_l enters the columns: U_l in its place, or less Θ_l.
        coupled: Whether configurations share κ_l; not so in (2).
        factor: f, by which the errors of the joints are larger than in the model that this one was scaled from.
    """

    robot: Robot
    model: ErrorModel
    repetitions: int | IntArray
    configuration_sigma: float
    basis: FloatArray
    maps: FloatArray
    coupled: bool = True
    factor: float = 1.0

    @staticmethod
    def of(
        robot: Robot, model: ErrorModel, felt: FloatArray, repetitions: int = 1, configuration_sigma: float = 0.0
    ) -> ExtendedModel:
        """The model of a robot whose accuracy matters at the configurations ``felt`` (K, joints); K may be 0."""
        basis = _basis(robot, model, felt)
        joints, waves, b = basis.shape
        start = len(robot.parameter_names) + (0 if model.gravity is None else model.gravity.size(robot))
        maps = np.zeros((joints, waves, start + joints * b))
        for joint in range(joints):
            maps[joint, :, start + joint * b : start + (joint + 1) * b] = basis[joint]
        return ExtendedModel(robot, model, repetitions, configuration_sigma, basis, maps)

    def scaled(self, factor: float) -> ExtendedModel:
        """The same robot with errors of its joints that are ``factor`` times as large."""
        values = {name: value * factor for name, value in self.model.values.items() if name in UNCERTAIN}
        model = self.model.with_values(values, name="scaled")
        return replace(self, model=model, factor=self.factor * factor)

    def column_scales(self, factor: float) -> FloatArray:
        """(p,) diagonal of D_f: what ``scaled`` makes of the columns X."""
        return np.where(np.arange(self.size) < len(self.robot.parameter_names), 1.0, factor)

    @property
    def noise(self) -> Noise:
        """The instrument, with the floor where that is all there is."""
        noise = self.model.points.noise
        return Isotropic(self.model.values["floor"]) if noise is None else noise

    @property
    def even(self) -> bool:
        """Whether a point's noise is the same wherever it is measured."""
        return self.model.points.noise is None or isinstance(self.model.points.noise, Isotropic)

    def points_at(self, poses: Poses) -> FloatArray:
        """(N, 3·targets, 3·targets) what is new at each visit and point, without the joints' part [m²]."""
        r = self.still.visit_covariance(poses) / self.times
        return np.asarray(r + self.configuration_sigma**2 * np.eye(r.shape[-1]))

    @cached_property
    def even_points(self) -> FloatArray:
        """``points_at`` anywhere, where noise is ``even``: (1, 3·targets, …); with (N,) repetitions (N, …)."""
        return self.points_at(Poses(self.robot, np.zeros((1, len(self.robot.joint_names)))))

    @property
    def size(self) -> int:
        """p."""
        return int(self.maps.shape[2])

    @property
    def first(self) -> int:
        """Place of the first joint's functions among the coefficients."""
        joints, _, b = self.basis.shape
        return self.size - joints * b

    @cached_property
    def layout(self) -> Layout:
        """That of the chain with the joints in the place of the parameters, to pull levers back."""
        chain = self.robot.linearise(np.zeros((1, len(self.robot.joint_names)))).layout
        return replace(chain, parameter_elements=chain.joint_elements, parameter_rotates=chain.joint_rotates)

    @cached_property
    def wave_scales(self) -> FloatArray:
        """(F,) standard deviation of each wave of a joint function [rad]."""
        functions = self.model.joint_functions
        if functions is None:
            return np.zeros(0)
        return np.sqrt(functions.variances(self.robot, self.model.values)[: 2 * functions.harmonics])

    @cached_property
    def visit_variance(self) -> FloatArray:
        """() or (N,) variance of what each joint errs anew at each configuration, repeated as wanted [rad²]."""
        visits = self.model.visits
        there = visits is not None and visits.joints
        return (self.model.values["repeatability"] ** 2 if there else 0.0) / np.asarray(self.repetitions, float)

    @property
    def times(self) -> FloatArray:
        """(1, 1, 1) or (N, 1, 1) r."""
        return np.reshape(self.repetitions, (-1, 1, 1)).astype(float)

    @cached_property
    def still(self) -> ErrorModel:
        """The error model without what the joints err anew at each visit."""
        visits = self.model.visits
        return self.model if visits is None else replace(self.model, visits=replace(visits, joints=False))

    @cached_property
    def gravity_joints(self) -> FloatArray:
        """(K, joints) 1 where a coefficient of gravity acts at a joint, else 0."""
        gravity, joints = self.model.gravity, len(self.robot.joint_names)
        return np.zeros((0, joints)) if gravity is None else np.eye(joints)[gravity.joints(self.robot)]

    def linearised(self, q: FloatArray) -> LinearisedExtension:
        """The columns at ``q`` (N, joints) with what their gradient needs."""
        return LinearisedExtension(self, Poses(self.robot, q))

    def columns(self, q: FloatArray) -> FloatArray:
        """X (N, 3·targets, p)."""
        return self.linearised(q).jacobian

    def at(self, q: FloatArray) -> FloatArray:
        """What each configuration of ``q`` (N, joints) tells alone: (N, p, p)."""
        return self.linearised(q).sums(1)

    def totals(self, q: FloatArray, size: int) -> FloatArray:
        """XᵀV⁻¹X of each run of ``size`` configurations of ``q`` (N, joints): (N/size, p, p)."""
        return self.linearised(q).sums(size)

    def whitened(self, q: FloatArray) -> FloatArray:
        """(N, 3·targets, p) rows of each configuration alone, rowsᵀ rows = ``at``."""
        return self.linearised(q).whitened

    def floor(self, q: FloatArray) -> FloatArray:
        """(N,) mean square distance that the eliminated functions move the targets at ``q`` (N, joints) [m²]."""
        return self.linearised(q).floor


@dataclass(frozen=True, eq=False)
class LinearisedExtension:
    """X and V at a batch of N configurations, ready to be differentiated."""

    model: ExtendedModel
    poses: Poses
    _runs: dict[tuple[int, float], tuple[FloatArray, FloatArray]] = field(default_factory=dict)

    @cached_property
    def levers(self) -> FloatArray:
        """(N, 3·targets, joints) c_l."""
        return self.poses.levers

    @cached_property
    def features(self) -> tuple[FloatArray, FloatArray]:
        """Φ_l and dΦ_l/dq_l, (N, joints, F) each."""
        return joint_features(self.model, self.poses)

    @cached_property
    def explicit(self) -> tuple[FloatArray, FloatArray]:
        """Φ_l U_l and its derivative, (N, joints, b) each."""
        values, rates = (_through(part, self.model.basis) for part in self.features)
        return values, rates

    @cached_property
    def _mapped(self) -> tuple[FloatArray, FloatArray]:
        """Φ_l times the maps, and its derivative, (N, joints, p) each."""
        values, rates = (_through(part, self.model.maps) for part in self.features)
        return values, rates

    @cached_property
    def rest(self) -> FloatArray:
        """(N, joints, F) Φ_l (I − U_l U_lᵀ)."""
        return self.features[0] - _through(self.explicit[0], np.swapaxes(self.model.basis, 1, 2))

    @property
    def floor(self) -> FloatArray:
        """(N,) mean square distance that the eliminated functions move the targets [m²]."""
        own = np.sum(self.rest**2, axis=2)
        return np.asarray(np.einsum("nrl,nl->n", self.levers**2, own) / len(self.model.robot.targets))

    @cached_property
    def jacobian(self) -> FloatArray:
        """(N, 3·targets, p) X."""
        count, gravity = len(self.model.robot.parameter_names), self.model.model.gravity
        if self.model.coupled:
            result: FloatArray = np.empty((*self.levers.shape[:2], self.model.size))
            n, rows, _ = result.shape
            result[:, :, :count] = self.poses.jacobian
            if gravity is not None:
                np.multiply(
                    self._gravity_levers, self.moments[:, None], out=result[:, :, count : self.model.first]
                )
            joints = result[:, :, self.model.first :].reshape(n, rows, len(self.model.basis), -1)
            np.multiply(self.levers[..., None], self.explicit[0][:, None], out=joints)
            return result
        result = self.levers @ self._mapped[0]
        result[:, :, :count] += self.poses.jacobian
        if gravity is not None:
            pushes = self._gravity_levers * self.moments[:, None]
            result[:, :, count : count + pushes.shape[2]] += pushes
        return np.asarray(result)

    @cached_property
    def moments(self) -> FloatArray:
        """(N, K) τ σ_g of the coefficients of gravity."""
        gravity, values = self.model.model.gravity, self.model.model.values
        assert gravity is not None
        return gravity.moments(self.poses) * values["gravity"]

    @cached_property
    def _gravity_levers(self) -> FloatArray:
        """(N, 3·targets, K) the lever of each coefficient of gravity."""
        gravity = self.model.model.gravity
        assert gravity is not None
        return self.levers[:, :, gravity.joints(self.model.robot)]

    @cached_property
    def points(self) -> FloatArray:
        """(N, 3·targets, 3·targets) what is new at each visit and point, without the joints' part [m²]."""
        own = self.model.even_points if self.model.even else self.model.points_at(self.poses)
        return np.broadcast_to(own, (len(self.poses), *own.shape[1:]))

    def kernels(self, size: int, counts: FloatArray | None = None) -> FloatArray:
        """(joints, N/size, size, size) what the errors of a joint have in common within each run.

        That is κ_l, and for a configuration with itself the variance of what is new at a visit, divided by
        ``counts`` (N,) if given.
        """
        n, joints = self.poses.q.shape
        every, own = np.arange(size), np.full(n, self.model.visit_variance)
        if self.model.coupled:
            runs = _by_joint(self.rest, size)
            result = runs @ np.swapaxes(runs, 2, 3)
        else:
            result = np.zeros((joints, n // size, size, size))
        result[:, :, every, every] += (own if counts is None else own / counts).reshape(-1, size)
        return np.asarray(result)

    def stacked(self, size: int) -> FloatArray:
        """(N/size, 3·targets·size, p) X of each run."""
        n, rows, p = self.jacobian.shape
        return self.jacobian.reshape(n // size, size * rows, p)

    def covariance(self, size: int, counts: FloatArray | None = None, factor: float = 1.0) -> FloatArray:
        """(N/size, 3·targets·size, …) V of each run.

        Args:
            size: Configurations in a run.
            counts: (N,) measurements at each configuration, which divide what is new at each of them.
            factor: f.
        """
        n, rows, _ = self.points.shape
        points = self.points if counts is None else self.points / counts[:, None, None]
        result = self._coupling(size) if counts is None else couple(self.levers, self.kernels(size, counts))
        result = result * factor**2
        blocks = result.reshape(n // size, size, rows, size, rows)
        every = np.arange(size)
        blocks[:, every, :, every, :] += np.moveaxis(points.reshape(n // size, size, rows, rows), 1, 0)
        return result

    @cached_property
    def _couplings(self) -> dict[int, tuple[FloatArray, FloatArray]]:
        return {}

    def _coupling(self, size: int) -> FloatArray:
        """(N/size, 3·targets·size, …) S of each run."""
        if size not in self._couplings:
            kernels = self.kernels(size)
            self._couplings[size] = kernels, couple(self.levers, kernels)
        return self._couplings[size][1]

    def _solved(self, size: int, factor: float) -> tuple[FloatArray, FloatArray]:
        """(N/size, 3·targets·size, p) L⁻¹X and V⁻¹X of each run, V = L Lᵀ at f = ``factor``."""
        key = size, factor
        if key not in self._runs:
            self._runs[key] = _solve(self.covariance(size, factor=factor), self.stacked(size))
        return self._runs[key]

    def solved(self, size: int) -> FloatArray:
        """(N/size, 3·targets·size, p) V⁻¹X of each run."""
        return self._solved(size, 1.0)[1]

    def sums(self, size: int, factor: float = 1.0) -> FloatArray:
        """(N/size, p, p) XᵀV⁻¹X of each run of ``size`` configurations, of the model ``scaled`` by ``factor``."""
        white = self._solved(size, factor)[0]
        result = (
            np.stack([run.T @ run for run in white]) if len(white) < SMALL else np.swapaxes(white, 1, 2) @ white
        )
        if factor != 1.0:
            scales = self.model.column_scales(factor)
            result *= scales[:, None] * scales
        return np.asarray(result)

    def rows(self, chosen: IntArray) -> LinearisedExtension:
        """The configurations with these numbers (m,)."""
        part = LinearisedExtension(self.model, Poses(self.model.robot, self.poses.q[chosen]))
        for name in ("levers", "points", "jacobian", "rest"):
            part.__dict__[name] = getattr(self, name)[chosen]
        part.__dict__["features"] = tuple(each[chosen] for each in self.features)
        return part

    def given(self, others: LinearisedExtension) -> FloatArray:
        """What each of these configurations adds once the m ``others`` are measured.

        Returns:
            (N, 3·targets, p) rows with M(others and q_i) = M(others) + rowsᵀ rows.
        """
        alone, left = self.covariance(1), self.jacobian
        m = len(others.points)
        if m:
            n, r, _ = self.levers.shape
            kernels = self.rest.transpose(1, 0, 2) @ others.rest.transpose(1, 2, 0)
            cross = np.einsum("nrl,lnm,msl->nrms", self.levers, kernels, others.levers, optimize=True)
            cross = cross.reshape(n * r, m * r)
            weights: FloatArray = np.linalg.solve(others.covariance(m)[0], cross.T).T
            left = left - (weights @ others.stacked(m)[0]).reshape(left.shape)
            alone = alone - weights.reshape(n, r, -1) @ np.swapaxes(cross.reshape(n, r, -1), 1, 2)
        return np.asarray(np.linalg.solve(np.linalg.cholesky(alone), left))

    def seen_from(self, counts: FloatArray) -> tuple[LinearisedExtension, FloatArray]:
        """The same configurations in the model of (2), and Σ_l Θ_lᵀΘ_l (p, p); (N,) measurements at each."""
        solved = np.linalg.solve(self.covariance(len(counts), counts)[0], self.stacked(len(counts))[0])
        pulled = np.einsum("krl,krp->lkp", self.levers, solved.reshape(self.jacobian.shape), optimize=True)
        theta = np.swapaxes(self.rest.transpose(1, 0, 2), 1, 2) @ pulled
        extra = np.tensordot(theta, theta, axes=([0, 1], [0, 1]))
        seen = replace(self.model, maps=self.model.maps - theta, coupled=False)
        return self.as_seen_by(seen), extra

    def as_seen_by(self, model: ExtendedModel) -> LinearisedExtension:
        """The same configurations in a model that differs in ``maps`` and coupling."""
        seen = LinearisedExtension(model, self.poses)
        for name in ("levers", "features", "points"):
            seen.__dict__[name] = getattr(self, name)
        return seen

    @cached_property
    def whitened(self) -> FloatArray:
        """(N, 3·targets, p) rows of each configuration alone, rowsᵀ rows = ``sums(1)``."""
        return self._solved(1, 1.0)[0]

    @property
    def weighted(self) -> FloatArray:
        """(N, 3·targets, p) V⁻¹X of each configuration alone."""
        return self.solved(1)

    def gradient(self, gradients: FloatArray) -> FloatArray:
        """∂Ψ/∂q (N, joints) for G (N/size, p, p), each serving a run of ``size`` configurations."""
        return self.gradient_of_sum([(1.0, gradients)])

    def gradient_of_sum(self, parts: Sequence[tuple[float, FloatArray]]) -> FloatArray:
        """∂/∂q (N, joints) of a sum of Ψ_f: (f, ∂Ψ_f/∂M (N/size, p, p)), M being of the model ``scaled`` by f."""
        n, rows, p = self.jacobian.shape
        size, robot, model = n // len(parts[0][1]), self.model.robot, self.model.model
        force: FloatArray = np.zeros((len(parts[0][1]), size * rows, p))
        on_points, on_joints = (np.zeros((len(force), size * rows, size * rows)) for _ in range(2))
        for factor, by_matrix in parts:
            solved, scales = self._solved(size, factor)[1], self.model.column_scales(factor)
            z = solved @ (by_matrix if factor == 1.0 else by_matrix * scales[:, None] * scales)
            k = z @ np.swapaxes(solved, 1, 2)
            force += z
            if not self.model.even:
                on_points += k
            k *= factor**2
            on_joints += k
        force *= 2.0  # ∂Ψ/∂X
        force = force.reshape(n, rows, p)
        by_lever, by_joint = self._by_functions(force)
        count = len(robot.parameter_names)
        if model.gravity is not None:
            own = force[:, :, count : count + self.moments.shape[1]]
            by_lever += (own * self.moments[:, None]) @ self.model.gravity_joints
            rates = model.gravity.moment_gradients(self.poses) * model.values["gravity"]
            by_joint += (np.sum(own * self._gravity_levers, axis=1)[:, None] @ rates)[:, 0]
        self._add_kernels(on_joints, size, by_lever, by_joint)
        if not self.model.even:
            self._add_noise(on_points, size, by_joint)
        return by_joint + self._pulled(force, by_lever)

    def _by_functions(self, force: FloatArray) -> tuple[FloatArray, FloatArray]:
        """∂Ψ/∂c_l (N, 3·targets, joints) and ∂Ψ/∂q (N, joints) through Φ_l in X."""
        if self.model.coupled:
            values, rates = self.explicit
            n, rows, joints = self.levers.shape
            own = force[:, :, self.model.first :].reshape(n, rows, joints, -1)
            pushed = np.sum(own * self.levers[..., None], axis=1)
            return np.sum(own * values[:, None], axis=3), np.sum(pushed * rates, axis=2)
        values, rates = self._mapped
        by_lever = force @ np.swapaxes(values, 1, 2)
        pushed = np.swapaxes(self.levers, 1, 2) @ force
        return np.asarray(by_lever), np.sum(pushed * rates, axis=2)

    def _add_kernels(self, k: FloatArray, size: int, by_lever: FloatArray, by_joint: FloatArray) -> None:
        """−tr(K dS) through κ_l and the levers beside it, added in place."""
        self._coupling(size)
        kernels = self._couplings[size][0]
        changes = np.zeros(kernels.shape)
        if self.model.coupled:
            np.matmul(
                _by_joint(self.features[1], size), np.swapaxes(_by_joint(self.rest, size), 2, 3), out=changes
            )
        couple_back(self.levers, kernels, changes, k, by_lever, by_joint)

    def _add_noise(self, k: FloatArray, size: int, by_joint: FloatArray) -> None:
        """−tr(K dN) through the instrument's covariance, which depends on the point; added in place."""
        points = self.model.model.points
        assert points.noise is not None
        blocks = _diagonal(k, size, self.jacobian.shape[1])
        n, targets = len(blocks), len(self.model.robot.targets)
        own = blocks.reshape(n, targets, 3, targets, 3)[:, np.arange(targets), :, np.arange(targets), :]
        scale = self.model.model.values.get("instrument", 1.0) ** 2 / self.model.times[..., None, None]
        by_point = covariance_gradient(points.noise, self.poses.points) * scale
        push = -np.einsum("tnij,ntijx->ntx", own, by_point)
        by_joint += np.einsum("ntx,jtxn->nj", push, self.poses.linearisation.joint_columns)

    def _pulled(self, by_jacobian: FloatArray, by_lever: FloatArray) -> FloatArray:
        """(N, joints) ∂Ψ/∂q through J and c_l."""
        lin = self.poses.linearisation
        result = lin.pull_back_levers(by_lever * joint_units(self.model.robot), self.model.layout)
        return result + lin.pull_back(by_jacobian) if len(lin.columns) else result


# ── runs of configurations ───────────────────────────────────────────────────────────────────────────


def _solve(matrices: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """L⁻¹B and V⁻¹B (S, n, p) for V = L Lᵀ (S, n, n) and B (S, n, p)."""
    roots = np.linalg.cholesky(matrices)
    if roots.shape[1] <= SMALL:
        inverse = np.linalg.inv(roots)
        half = inverse @ right
        return half, np.swapaxes(inverse, 1, 2) @ half
    from scipy.linalg.blas import dtrsm  # the transposes of C-ordered arrays are what BLAS takes without a copy

    half, solved = np.empty(right.shape), np.empty(right.shape)
    for root, given, first, second in zip(roots, right, half, solved, strict=True):
        first[:] = dtrsm(1.0, root.T, given.T, side=1).T
        second[:] = dtrsm(1.0, root.T, first.T, side=1, trans_a=1).T
    return half, solved


def couple(levers: FloatArray, kernels: FloatArray) -> FloatArray:
    """Σ_l c_l(q_i) κ_l(i, j) c_l(q_j)ᵀ of each run of m configurations.

    Args:
        levers: (N, rows, joints), N = S·m.
        kernels: (joints, S, m, m), symmetric in the last two.

    Returns:
        (S, m·rows, m·rows).
    """
    if _kernel is None or not levers.flags.c_contiguous:
        return couple_numpy(levers, kernels)
    _, runs, size, _ = kernels.shape
    out = np.empty((runs, size * levers.shape[1], size * levers.shape[1]))
    _kernel.couple(levers, np.ascontiguousarray(kernels), out)
    return out


def couple_numpy(levers: FloatArray, kernels: FloatArray) -> FloatArray:
    """``couple`` without the compiled kernel."""
    _, rows, joints = levers.shape
    _, runs, size, _ = kernels.shape
    result: FloatArray = np.zeros((runs, size * rows, size * rows))
    for lever, kernel in zip(levers.reshape(runs, size * rows, joints).transpose(2, 0, 1), kernels, strict=True):
        result += lever[:, :, None] * lever[:, None, :] * _spread(kernel, rows)
    return result


def couple_back(
    levers: FloatArray,
    kernels: FloatArray,
    changes: FloatArray,
    weights: FloatArray,
    by_lever: FloatArray,
    by_joint: FloatArray,
) -> None:
    """−tr(K dS) with S of ``couple``, added in place.

    Args:
        levers: As in ``couple``.
        kernels: As in ``couple``.
        changes: (joints, S, m, m) derivative of κ_l(i, j) by joint l of configuration i.
        weights: (S, m·rows, m·rows) K, symmetric.
        by_lever: (N, rows, joints) ∂/∂c_l.
        by_joint: (N, joints) ∂/∂q_l.
    """
    if _kernel is None or not (levers.flags.c_contiguous and by_lever.flags.c_contiguous):
        couple_back_numpy(levers, kernels, changes, weights, by_lever, by_joint)
        return
    kernels, changes, weights = (np.ascontiguousarray(a) for a in (kernels, changes, weights))
    _kernel.couple_back(levers, kernels, changes, weights, by_lever, by_joint)


def couple_back_numpy(
    levers: FloatArray,
    kernels: FloatArray,
    changes: FloatArray,
    weights: FloatArray,
    by_lever: FloatArray,
    by_joint: FloatArray,
) -> None:
    """``couple_back`` without the compiled kernel."""
    n, rows, joints = levers.shape
    _, runs, size, _ = kernels.shape
    for joint, lever in enumerate(levers.reshape(runs, size * rows, joints).transpose(2, 0, 1)):
        pulled = (weights * _spread(kernels[joint], rows)) @ lever[:, :, None]
        by_lever[:, :, joint] -= 2.0 * pulled.reshape(n, rows)
        met = (
            (weights * lever[:, :, None] * lever[:, None, :])
            .reshape(runs, size, rows, size, rows)
            .sum(axis=(2, 4))
        )
        by_joint[:, joint] -= 2.0 * np.sum(met * changes[joint], axis=2).reshape(n)


# ── joint functions ──────────────────────────────────────────────────────────────────────────────────


def joint_features(model: ExtendedModel, poses: Poses) -> tuple[FloatArray, FloatArray]:
    """Φ_l(q_l) and dΦ_l/dq_l (N, joints, F), F = 0 where the model has no joint functions."""
    functions, robot = model.model.joint_functions, model.robot
    if functions is None:
        nothing = np.zeros((*poses.q.shape, 0))
        return nothing, nothing
    half, scales = functions.harmonics, model.wave_scales
    values = functions.waves(poses)
    values *= scales
    # The derivative of cos n x is −n sin n x, that of sin n x is n cos n x; both have the same scale.
    orders, rates = np.arange(1, half + 1), np.empty(values.shape)
    np.multiply(values[..., half:], -orders, out=rates[..., :half])
    np.multiply(values[..., :half], orders, out=rates[..., half:])
    if not robot.joint_is_revolute.all():
        low, high = robot.joint_limits.T
        rates *= np.where(robot.joint_is_revolute, 1.0, np.pi / (high - low))[:, None]
    return values, rates


def _basis(robot: Robot, model: ErrorModel, felt: FloatArray) -> FloatArray:
    """(joints, F, b) U_l: slow waves, and what the configurations ``felt`` (K, joints) feel beside them."""
    joints, functions = len(robot.joint_names), model.joint_functions
    if functions is None:
        return np.zeros((joints, 0, 0))
    half = functions.harmonics
    assert isinstance(functions, JointFunctions)
    slow = np.eye(2 * half)[:, [*range(min(SLOW, half)), *range(half, half + min(SLOW, half))]]
    scales = np.sqrt(functions.variances(robot, model.values)[: 2 * half])
    rest = (functions.waves(Poses(robot, felt)) * scales).transpose(1, 0, 2)
    rest = rest - (rest @ slow) @ slow.T
    count = min(len(felt), FELT_WAVES, 2 * half - slow.shape[1])
    right = np.linalg.svd(rest, full_matrices=True)[2][:, :count] if count else np.zeros((joints, 0, 2 * half))
    both = np.concatenate([np.broadcast_to(slow, (joints, *slow.shape)), np.swapaxes(right, 1, 2)], axis=2)
    return np.asarray(np.linalg.qr(both)[0])


def _through(features: FloatArray, maps: FloatArray) -> FloatArray:
    """Each joint's row times its matrix: (N, joints, F), (joints, F, p) → (N, joints, p)."""
    return np.ascontiguousarray((features.transpose(1, 0, 2) @ maps).transpose(1, 0, 2))


def _by_joint(features: FloatArray, size: int) -> FloatArray:
    """(N, joints, F) → (joints, N/size, size, F): each joint's rows of each run."""
    n, joints, waves = features.shape
    return features.reshape(n // size, size, joints, waves).transpose(2, 0, 1, 3)


def _spread(kernel: FloatArray, rows: int) -> FloatArray:
    """(S, m, m) → (S, m·rows, m·rows), each number repeated."""
    return np.repeat(np.repeat(kernel, rows, axis=1), rows, axis=2)


def _diagonal(matrix: FloatArray, size: int, rows: int) -> FloatArray:
    """(S, size·rows, size·rows) → its diagonal blocks (S·size, rows, rows)."""
    every = np.arange(size)
    blocks = matrix.reshape(len(matrix), size, rows, size, rows)[:, every, :, every, :]
    return np.asarray(np.moveaxis(blocks, 0, 1).reshape(-1, rows, rows))
