# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot drawn from its error model: what a simulation measures, and what an estimate should find.

With everything known, (M1) says where the targets are. The joints that read q stand at q + δ(q; u) + h_i, with
the deflection δ of gravity and joint functions and the repeatability h_i of the visit, so that

    y_it = g(q_i + δ(q_i; u) + h_i; Π, base, target_t) + s_i + ε_it .

Drawn again and again at the same configurations, y has to first order the covariance that plan and identification
reckon with, J⁺ M₀⁻¹ J⁺ᵀ + blockdiag(R_i): a test compares them.

What is drawn once is a ``Truth``: the robot as it is made and the coefficients u. What is new at each visit is a
``VisitErrors``: h_i, and s_i with the floor of each point. What is new at each sample that a tracker takes is its
noise: ``Truth.noise``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import FloatArray, check_configurations
from calib_planner.error_model.joint_functions import JointFunctions
from calib_planner.error_model.model import ErrorModel, Scale
from calib_planner.error_model.placement import Placement, is_placement
from calib_planner.error_model.poses import Poses, joint_units
from calib_planner.error_model.visits import Visits
from calib_planner.robot import Robot


@dataclass(frozen=True, eq=False)
class VisitErrors:
    """What is new at each of N visits.

    Attributes:
        joints: (N, joints) h_i, in units of ``joint_units``.
        points: (N, targets, 3) s_i and the floor of each point, together [m].
    """

    joints: FloatArray
    points: FloatArray


@dataclass(frozen=True, eq=False)
class Truth:
    """One robot, with all that a model can say of it.

    Attributes:
        robot: As it is made: its parameters, base and targets are the true ones.
        model: How it errs; its scales are the true ones.
        coefficients: (coefficients,) β: what its active parameters are off their nominal values, which is in
            ``robot`` already, then the coefficients u of gravity and joint functions [unit].
    """

    robot: Robot
    model: ErrorModel
    coefficients: FloatArray

    @staticmethod
    def draw(
        nominal: Robot,
        model: ErrorModel,
        rng: np.random.Generator,
        deviations: Mapping[str, float] | None = None,
    ) -> Truth:
        """A robot whose coefficients are drawn from their priors at the scales in force.

        Args:
            nominal: What the controller believes.
            model: How it errs. Give ``model.with_drawn_scales(rng)`` to draw the scales, too.
            rng: The same generator, the same robot.
            deviations: What parameters are off [m | rad], instead of a draw; those not named are as nominal. By
                default they are drawn, and parameters of flat prior, base and targets among them, are as nominal.
        """
        if deviations is not None:
            more = [n for n in deviations if n not in nominal.parameter_names]
            nominal = nominal.with_parameters([*nominal.parameter_names, *more]) if more else nominal
            flat = replace(model, placement=replace(model.placement, prior="flat", stated=None))
            coefficients = flat.draw_coefficients(nominal, rng)
            names = nominal.parameter_names
            coefficients[: len(names)] = [deviations.get(n, 0.0) for n in names]
        else:
            coefficients = model.draw_coefficients(nominal, rng)
        off = dict(zip(nominal.parameter_names, coefficients.tolist(), strict=False))
        return Truth(nominal.with_deviations(off), model, coefficients)

    # ── what is where ────────────────────────────────────────────────────────────────────────────────

    def actual(
        self, q: ArrayLike, visits: VisitErrors | None = None, payload: ArrayLike | None = None
    ) -> FloatArray:
        """(N, joints) where the joints stand when they read ``q`` (N, joints) [rad | m].

        Args:
            visits: Errors of the N visits; default: where they stand on average.
            payload: Mass of the payload, one or (N,) [kg]; default: what the elastic term states.
        """
        clean = check_configurations("configurations", q, self.robot.joint_names)
        readings = Poses(self.robot, clean, self.model.payloads(payload, len(clean)))
        poses = self.model.deflected(readings, self.coefficients)
        if visits is None:
            return poses.actual
        return np.asarray(poses.actual + visits.joints * joint_units(self.robot))

    def positions(
        self, q: ArrayLike, visits: VisitErrors | None = None, payload: ArrayLike | None = None
    ) -> FloatArray:
        """(N, targets, 3) where the targets are when the joints read ``q`` (N, joints) [m]; see ``actual``."""
        points = self.robot.positions(self.actual(q, visits, payload))
        return points if visits is None else points + visits.points

    # ── what is measured ─────────────────────────────────────────────────────────────────────────────

    def draw_visits(self, count: int, rng: np.random.Generator) -> VisitErrors:
        """Errors of ``count`` visits."""
        values, term = self.model.values, self.model.visits
        joints, shifts = (Visits(False, False) if term is None else term).draw(self.robot, values, count, rng)
        floor = self.model.points.floor_of(values, rng.standard_normal(shifts.shape))
        return VisitErrors(joints, shifts + floor)

    def noise(self, points: FloatArray, standard: FloatArray) -> FloatArray:
        """(…, 3) errors of the instrument at ``points`` (…, 3) [m].

        Args:
            standard: (…, 3) independent errors of variance one, such as ``rng.standard_normal(points.shape)``.
        """
        return self.model.points.noise_of(points, self.model.values, standard)

    def measure(self, q: ArrayLike, rng: np.random.Generator, payload: ArrayLike | None = None) -> FloatArray:
        """(N, targets, 3) points measured at N visits ``q`` (N, joints), each once [m]."""
        points = self.positions(q, self.draw_visits(len(np.asarray(q)), rng), payload)
        return points + self.noise(points, rng.standard_normal(points.shape))

    # ── another truth ────────────────────────────────────────────────────────────────────────────────

    def with_targets(self, xyz: ArrayLike) -> Truth:
        """The same robot with its targets at ``xyz`` (targets, 3) of the tip's frame [m]."""
        robot = self.robot.with_targets(xyz)
        left = [self.robot.parameter_names.index(n) for n in robot.parameter_names]
        rest = self.coefficients[len(self.robot.parameter_names) :]
        return replace(self, robot=robot, coefficients=np.concatenate([self.coefficients[left], rest]))

    def with_joint_functions(self, series: FloatArray, size: float) -> Truth:
        """The same robot whose joints err by a Fourier series more than they do.

        Args:
            series: (joints, 2, harmonics) cosines and sines of each joint's series, the first harmonic first
                [rad | m].
            size: Its root mean square [rad], the scale of a model that had no joint functions.
        """
        model, joints = self.model, len(self.robot.joint_names)
        old = model.joint_functions
        count = max(series.shape[2], 0 if old is None else old.harmonics)
        total = np.zeros((joints, 2, count))
        total[:, :, : series.shape[2]] = series / joint_units(self.robot)[:, None, None]
        names, where = self.robot.parameter_names, model.slices(self.robot)
        if old is not None:
            own = self.coefficients[where["joint_functions"]].reshape(joints, 2, old.harmonics)
            total[:, :, : old.harmonics] += own
            components, scales = old.components, model.scales
        else:
            components = ("smooth",)
            new = (Scale("smooth.size", size, size, 1.0, "rad"), Scale("smooth.length", 1.0, 1.0, 1.0, "rad"))
            scales = (*model.scales, *new)
        before = self.coefficients[: where.get("gravity", slice(0, len(names))).stop]
        functions = JointFunctions(components, count)
        return replace(
            self,
            model=replace(model, joint_functions=functions, scales=scales),
            coefficients=np.concatenate([before, total.ravel()]),
        )

    # ── how large it is ──────────────────────────────────────────────────────────────────────────────

    def sizes(self, q: ArrayLike) -> dict[str, float]:
        """Term or component → root mean square of what it moves the targets by at ``q`` (N, joints) [m].

        The names are those of ``identify``. Visits and points count by their variance, the others by their
        coefficients, base and targets not among them: where these stand is no error of the robot.
        """
        clean = check_configurations("configurations", q, self.robot.joint_names)
        model, robot = self.model, self.robot
        poses = model.deflected(Poses(robot, clean), self.coefficients)
        where = model.slices(robot)
        squares: dict[str, float] = {}
        for term in model.systematic:
            columns, own = term.columns(poses), self.coefficients[where[term.name]]
            if isinstance(term, Placement):
                own = np.where(is_placement(robot.parameter_names), own, 0.0)
            parts: dict[str, FloatArray] = {term.name: np.ones(len(own))}
            if isinstance(term, JointFunctions):
                parts = term.shares(robot, model.values)
            squares |= {name: float(np.sum((columns @ (share * own)) ** 2)) for name, share in parts.items()}
        scatter = model.visit_parts(poses)
        for name, names in (("visits", ("repeatability", "shared")), ("points", ("instrument", "floor"))):
            if name == "points" or model.visits is not None:
                squares[name] = sum(float(np.einsum("nii->", scatter[n])) for n in names if n in scatter)
        points = len(poses) * len(robot.targets)
        return {name: float(np.sqrt(square / points)) for name, square in squares.items()}
