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

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.error_model import ErrorModel, JointFunctions, Poses, joint_units
from calib_planner.robot import Layout, Linearisation, Robot
from calib_planner.tracker import Isotropic, Noise, covariance_gradient

SLOW = 3
"""Waves per turn that stay coefficients whatever the test poses: what the rest of the workspace feels most."""
FELT_WAVES = 12
"""Further functions of each joint's angle that stay: those that the test poses feel."""


@dataclass(frozen=True, eq=False)
class ExtendedModel:
    """How configurations turn into information on the p coefficients, in the place of ``InformationModel``.

    Attributes:
        robot: Its active parameters come first among the coefficients, then gravity and joint functions.
        model: How it errs.
        repetitions: r, visits to each configuration.
        configuration_sigma: σ_c, error of a configuration that repetition does not average away [m].
        basis: (joints, F, b) U_l.
        maps: (joints, F, p) how Φ_l enters the columns: U_l in its place, or less Θ_l.
        coupled: Whether configurations share κ_l; not so in (2).
    """

    robot: Robot
    model: ErrorModel
    repetitions: int
    configuration_sigma: float
    basis: FloatArray
    maps: FloatArray
    coupled: bool = True

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

    @property
    def noise(self) -> Noise:
        """The instrument, with the floor where that is all there is."""
        noise = self.model.points.noise
        return Isotropic(self.model.values["floor"]) if noise is None else noise

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
        info = self.linearised(q)
        own = np.sum(info.rest**2, axis=2)
        return np.asarray(np.einsum("nrl,nl->n", info.levers**2, own) / len(self.robot.targets))


@dataclass(frozen=True, eq=False)
class LinearisedExtension:
    """X and V at a batch of N configurations, ready to be differentiated."""

    model: ExtendedModel
    poses: Poses

    @cached_property
    def levers(self) -> FloatArray:
        """(N, 3·targets, joints) c_l."""
        return self.poses.levers

    @cached_property
    def features(self) -> tuple[FloatArray, FloatArray]:
        """Φ_l and dΦ_l/dq_l, (N, joints, F) each."""
        return joint_features(self.model.robot, self.model.model, self.poses.q)

    @cached_property
    def explicit(self) -> tuple[FloatArray, FloatArray]:
        """Φ_l U_l and its derivative, (N, joints, b) each."""
        values, rates = (_through(part, self.model.basis) for part in self.features)
        return values, rates

    @cached_property
    def rest(self) -> FloatArray:
        """(N, joints, F) Φ_l (I − U_l U_lᵀ)."""
        return self.features[0] - _through(self.explicit[0], np.swapaxes(self.model.basis, 1, 2))

    @cached_property
    def jacobian(self) -> FloatArray:
        """(N, 3·targets, p) X."""
        robot, model = self.model.robot, self.model.model
        count = len(robot.parameter_names)
        if self.model.coupled:
            result: FloatArray = np.zeros((*self.levers.shape[:2], self.model.size))
            n, rows, _ = result.shape
            pushes = self.levers[..., None] * self.explicit[0][:, None]
            result[:, :, self.model.first :] = pushes.reshape(n, rows, -1)
        else:
            result = self.levers @ _through(self.features[0], self.model.maps)
        result[:, :, :count] += self.poses.jacobian
        if model.gravity is not None:
            pushes = self.levers[:, :, model.gravity.joints(robot)] * self.moments[:, None, :]
            result[:, :, count : count + pushes.shape[2]] += pushes
        return np.asarray(result)

    @cached_property
    def moments(self) -> FloatArray:
        """(N, K) τ σ_g of the coefficients of gravity."""
        gravity, values = self.model.model.gravity, self.model.model.values
        assert gravity is not None
        return gravity.moments(self.poses) * values["gravity"]

    @cached_property
    def own(self) -> FloatArray:
        """(N, 3·targets, 3·targets) R: what is new at each visit and point [m²]."""
        r = self.model.model.visit_covariance(self.poses) / self.model.repetitions
        return np.asarray(r + self.model.configuration_sigma**2 * np.eye(r.shape[-1]))

    def kernels(self, size: int) -> FloatArray:
        """(joints, N/size, size, size) κ_l within each run of ``size`` configurations."""
        n, joints, waves = self.rest.shape
        runs = self.rest.reshape(n // size, size, joints, waves).transpose(2, 0, 1, 3)
        return np.asarray(runs @ np.swapaxes(runs, 2, 3))

    def stacked(self, size: int) -> FloatArray:
        """(N/size, 3·targets·size, p) X of each run."""
        n, rows, p = self.jacobian.shape
        return self.jacobian.reshape(n // size, size * rows, p)

    def covariance(self, size: int, counts: FloatArray | None = None) -> FloatArray:
        """(N/size, 3·targets·size, …) V of each run; R divided by ``counts`` (N,) if given."""
        n, rows, _ = self.own.shape
        own = self.own if counts is None else self.own / counts[:, None, None]
        result = np.zeros((n // size, size, rows, size, rows))
        every = np.arange(size)
        result[:, every, :, every, :] = np.moveaxis(own.reshape(n // size, size, rows, rows), 1, 0)
        flat = result.reshape(n // size, size * rows, size * rows)
        if self.model.coupled:
            for lever, kernel in zip(self._stacked_levers(size), self.kernels(size), strict=True):
                flat += lever[:, :, None] * lever[:, None, :] * _spread(kernel, rows)
        return flat

    def _stacked_levers(self, size: int) -> FloatArray:
        """(joints, N/size, 3·targets·size)."""
        n, rows, joints = self.levers.shape
        return np.ascontiguousarray(self.levers.reshape(n // size, size * rows, joints).transpose(2, 0, 1))

    @cached_property
    def _solved(self) -> dict[int, FloatArray]:
        return {}

    def solved(self, size: int) -> FloatArray:
        """(N/size, 3·targets·size, p) V⁻¹X of each run."""
        if size not in self._solved:
            self._solved[size] = np.asarray(np.linalg.solve(self.covariance(size), self.stacked(size)), float)
        return self._solved[size]

    def sums(self, size: int) -> FloatArray:
        """(N/size, p, p) XᵀV⁻¹X of each run of ``size`` configurations."""
        return np.asarray(np.swapaxes(self.stacked(size), 1, 2) @ self.solved(size))

    def rows(self, chosen: IntArray) -> LinearisedExtension:
        """The configurations with these numbers (m,)."""
        part = LinearisedExtension(self.model, Poses(self.model.robot, self.poses.q[chosen]))
        for name in ("levers", "own", "jacobian", "rest"):
            part.__dict__[name] = getattr(self, name)[chosen]
        part.__dict__["features"] = tuple(each[chosen] for each in self.features)
        return part

    def given(self, others: LinearisedExtension) -> FloatArray:
        """What each of these configurations adds once the m ``others`` are measured.

        Returns:
            (N, 3·targets, p) rows with M(others and q_i) = M(others) + rowsᵀ rows.
        """
        alone, left = self.covariance(1), self.jacobian
        m = len(others.own)
        if m:
            n, r, joints = self.levers.shape
            cross = np.zeros((n * r, m * r))
            both = zip(self._stacked_levers(1), others._stacked_levers(m), range(joints), strict=True)
            for own, lever, joint in both:
                kernel = self.rest[:, joint] @ others.rest[:, joint].T
                cross += own.reshape(-1, 1) * lever * np.repeat(np.repeat(kernel, r, axis=0), r, axis=1)
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
        for name in ("levers", "features", "own"):
            seen.__dict__[name] = getattr(self, name)
        return seen

    @cached_property
    def whitened(self) -> FloatArray:
        """(N, 3·targets, p) rows of each configuration alone, rowsᵀ rows = ``sums(1)``."""
        return np.asarray(np.linalg.solve(np.linalg.cholesky(self.covariance(1)), self.jacobian))

    @property
    def weighted(self) -> FloatArray:
        """(N, 3·targets, p) V⁻¹X of each configuration alone."""
        return self.solved(1)

    def gradient(self, gradients: FloatArray) -> FloatArray:
        """∂Ψ/∂q (N, joints) for G (N/size, p, p), each serving a run of ``size`` configurations."""
        n, rows, p = self.jacobian.shape
        size, robot, model = n // len(gradients), self.model.robot, self.model.model
        solved = self.solved(size)
        z = solved @ gradients
        force = 2.0 * z.reshape(n, rows, p)  # ∂Ψ/∂X
        k = z @ np.swapaxes(solved, 1, 2)
        by_lever, by_joint = self._by_functions(force)
        count = len(robot.parameter_names)
        if model.gravity is not None:
            joints = model.gravity.joints(robot)
            own = force[:, :, count : count + len(joints)]
            np.add.at(by_lever.transpose(2, 0, 1), joints, (own * self.moments[:, None, :]).transpose(2, 0, 1))
            rates = model.gravity.moment_gradients(self.poses) * model.values["gravity"]
            by_joint += np.einsum("nk,nkj->nj", np.sum(own * self.levers[:, :, joints], axis=1), rates)
        if self.model.coupled:
            self._add_kernels(k, size, by_lever, by_joint)
        blocks = _diagonal(k, size, rows)
        if model.visits is not None and model.visits.joints:
            factor = -2.0 * model.values["repeatability"] ** 2 / self.model.repetitions
            by_lever += factor * (blocks @ self.levers)
        self._add_noise(blocks, by_joint)
        return by_joint + self._pulled(force[:, :, :count], by_lever)

    def _by_functions(self, force: FloatArray) -> tuple[FloatArray, FloatArray]:
        """∂Ψ/∂c_l (N, 3·targets, joints) and ∂Ψ/∂q (N, joints) through Φ_l in X."""
        if self.model.coupled:
            values, rates = self.explicit
            n, rows, joints = self.levers.shape
            own = force[:, :, self.model.first :].reshape(n, rows, joints, -1)
            pushed = np.sum(own * self.levers[..., None], axis=1)
            return np.sum(own * values[:, None], axis=3), np.sum(pushed * rates, axis=2)
        values, rates = (_through(part, self.model.maps) for part in self.features)
        by_lever = force @ np.swapaxes(values, 1, 2)
        pushed = np.swapaxes(self.levers, 1, 2) @ force
        return np.asarray(by_lever), np.sum(pushed * rates, axis=2)

    def _add_kernels(self, k: FloatArray, size: int, by_lever: FloatArray, by_joint: FloatArray) -> None:
        """−tr(K dV) through κ_l and the levers beside it, added in place."""
        n, rows, joints = self.levers.shape
        runs = n // size
        rates = self.features[1].reshape(runs, size, joints, -1).transpose(2, 0, 1, 3)
        rest = self.rest.reshape(runs, size, joints, -1).transpose(2, 0, 1, 3)
        by_angle, kernels = rates @ np.swapaxes(rest, 2, 3), self.kernels(size)
        for joint, lever in enumerate(self._stacked_levers(size)):
            pulled = (k * _spread(kernels[joint], rows)) @ lever[:, :, None]
            by_lever[:, :, joint] -= 2.0 * pulled.reshape(n, rows)
            met = (
                (k * lever[:, :, None] * lever[:, None, :]).reshape(runs, size, rows, size, rows).sum(axis=(2, 4))
            )
            by_joint[:, joint] -= 2.0 * np.sum(met * by_angle[joint], axis=2).reshape(n)

    def _add_noise(self, blocks: FloatArray, by_joint: FloatArray) -> None:
        """−tr(K dR) through the instrument's covariance, which depends on the point; added in place."""
        points = self.model.model.points
        if points.noise is None or isinstance(points.noise, Isotropic):
            return
        n, targets = len(blocks), len(self.model.robot.targets)
        own = blocks.reshape(n, targets, 3, targets, 3)[:, np.arange(targets), :, np.arange(targets), :]
        scale = self.model.model.values.get("instrument", 1.0) ** 2 / self.model.repetitions
        by_point = covariance_gradient(points.noise, self.poses.points) * scale
        push = -np.einsum("tnij,ntijx->ntx", own, by_point)
        by_joint += np.einsum("ntx,jtxn->nj", push, self.poses.linearisation.joint_columns)

    def _pulled(self, by_jacobian: FloatArray, by_lever: FloatArray) -> FloatArray:
        """(N, joints) ∂Ψ/∂q through J and c_l."""
        lin, targets = self.poses.linearisation, len(self.model.robot.targets)

        def shaped(weights: FloatArray) -> FloatArray:
            n, _, p = weights.shape
            return np.ascontiguousarray(weights.transpose(2, 1, 0)).reshape(p, targets, 3, n)

        levers = Linearisation(
            lin.points, lin.joint_columns, lin.joint_columns, lin.joint_axes, lin.joint_axes, self.model.layout
        )
        result = levers.pull_back(shaped(by_lever * joint_units(self.model.robot)))
        return result + lin.pull_back(shaped(by_jacobian)) if by_jacobian.shape[2] else result


# ── joint functions ──────────────────────────────────────────────────────────────────────────────────


def joint_features(robot: Robot, model: ErrorModel, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Φ_l(q_l) and dΦ_l/dq_l (N, joints, F), F = 0 where the model has no joint functions."""
    functions = model.joint_functions
    if functions is None:
        nothing = np.zeros((*q.shape, 0))
        return nothing, nothing
    low, high = robot.joint_limits.T
    waves = functions.waves(Poses(robot, q))
    orders = np.arange(1, functions.harmonics + 1)
    half = functions.harmonics
    rates = np.concatenate([-waves[..., half:] * orders, waves[..., :half] * orders], axis=2)
    rates *= np.where(robot.joint_is_revolute, 1.0, np.pi / (high - low))[:, None]
    scale = np.sqrt(functions.variances(robot, model.values)[: 2 * half])
    return waves * scale, rates * scale


def _basis(robot: Robot, model: ErrorModel, felt: FloatArray) -> FloatArray:
    """(joints, F, b) U_l: slow waves, and what the configurations ``felt`` (K, joints) feel beside them."""
    joints, functions = len(robot.joint_names), model.joint_functions
    if functions is None:
        return np.zeros((joints, 0, 0))
    half = functions.harmonics
    assert isinstance(functions, JointFunctions)
    slow = np.eye(2 * half)[:, [*range(min(SLOW, half)), *range(half, half + min(SLOW, half))]]
    rest = joint_features(robot, model, felt)[0].transpose(1, 0, 2)
    rest = rest - (rest @ slow) @ slow.T
    count = min(len(felt), FELT_WAVES, 2 * half - slow.shape[1])
    right = np.linalg.svd(rest, full_matrices=True)[2][:, :count] if count else np.zeros((joints, 0, 2 * half))
    both = np.concatenate([np.broadcast_to(slow, (joints, *slow.shape)), np.swapaxes(right, 1, 2)], axis=2)
    return np.asarray(np.linalg.qr(both)[0])


def _through(features: FloatArray, maps: FloatArray) -> FloatArray:
    """Each joint's row times its matrix: (N, joints, F), (joints, F, p) → (N, joints, p)."""
    return np.ascontiguousarray((features.transpose(1, 0, 2) @ maps).transpose(1, 0, 2))


def _spread(kernel: FloatArray, rows: int) -> FloatArray:
    """(S, m, m) → (S, m·rows, m·rows), each number repeated."""
    return np.repeat(np.repeat(kernel, rows, axis=1), rows, axis=2)


def _diagonal(matrix: FloatArray, size: int, rows: int) -> FloatArray:
    """(S, size·rows, size·rows) → its diagonal blocks (S·size, rows, rows)."""
    every = np.arange(size)
    blocks = matrix.reshape(len(matrix), size, rows, size, rows)[:, every, :, every, :]
    return np.asarray(np.moveaxis(blocks, 0, 1).reshape(-1, rows, rows))
