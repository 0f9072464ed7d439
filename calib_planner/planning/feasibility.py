# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Which configurations may be measured at all, and how far they are from the edge of what is allowed.

A constraint has a name and says, for a batch of configurations, which of them it allows. Most of them are
inequalities m_k(q) ≥ 0 whose *margins* m_k the search can follow along the edge (``Walls``); a mere yes or no can
only reject its steps. The joint limits are not among the constraints: every search keeps to them, and to the
``JointRange``s that narrow them, by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.errors import InfeasibleError
from calib_planner.planning.constraints.room import JointRange, MotionLimits, PostureConstraint
from calib_planner.robot import Posture, Robot

PATIENCE = 200_000
"""Random configurations tried before the constraints are said to leave nothing, or hardly anything."""
RARE = 0.01
"""Share of feasible configurations from which on rejection alone supplies as many as are wanted."""
WITNESSES = 20_000
"""Random configurations that show which constraint empties the set."""
DIFFERENCE = 1e-6
"""Step of the differences that give normals [rad | m]: their error, about as much times the curvature of an edge,
is far below what one step of a search bends away from its tangent."""
CORRECTIONS = 2
"""Newton's steps back over an edge; the second one takes what bends of the first."""
RETREATS = (0.3, 0.05)
"""Shares of an infeasible step that are tried in its place."""


class Constraint(Protocol):
    """One condition on configurations."""

    @property
    def name(self) -> str:
        """Its name in messages."""
        ...

    def allowed(self, robot: Robot, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) → (N,)."""
        ...


@dataclass(frozen=True, eq=False)
class Feasibility:
    """All constraints of a problem together.

    Attributes:
        robot: The robot they are about.
        constraints: The constraints; none means the joint limits alone. Those of motions that are coupled are
            added.
    """

    robot: Robot
    constraints: tuple[Constraint, ...] = ()

    def __post_init__(self) -> None:
        if self.robot.couplings and not any(isinstance(c, MotionLimits) for c in self.constraints):
            object.__setattr__(self, "constraints", (MotionLimits(), *self.constraints))

    @cached_property
    def limits(self) -> FloatArray:
        """(joints, 2) the robot's joint limits, cut down to every ``JointRange`` [rad | m].

        Raises:
            InfeasibleError: Nothing is left of a joint's range.
        """
        limits = np.array(self.robot.joint_limits)
        for constraint in self.constraints:
            if isinstance(constraint, JointRange):
                own = constraint.limits(self.robot)
                limits = np.stack([np.maximum(limits[:, 0], own[:, 0]), np.minimum(limits[:, 1], own[:, 1])], 1)
        for name, (low, high) in zip(self.robot.joint_names, limits, strict=True):
            if not low < high:
                ranges = " and ".join(c.name for c in self.constraints if isinstance(c, JointRange))
                raise InfeasibleError(ranges, f"they leave nothing of {name}: from {low:g} to {high:g}")
        return limits

    def mask(self, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) → (N,): allowed by every constraint."""
        left: IntArray = np.arange(len(q))
        posture: Posture | None = None
        for constraint in self.constraints:
            if not isinstance(constraint, PostureConstraint):
                ok = constraint.allowed(self.robot, q[left])
            else:
                posture = self.robot.posture(q[left]) if posture is None else posture
                ok = constraint.holds(self.robot, posture)
            if ok.all():
                continue
            left = left[ok]
            if not left.size:
                break
            posture = None if posture is None else posture.rows(np.flatnonzero(ok))
        mask = np.zeros(len(q), bool)
        mask[left] = True
        return mask

    @property
    def masks(self) -> tuple[Constraint, ...]:
        """The constraints that say yes or no without a margin."""
        return tuple(c for c in self.constraints if not isinstance(c, PostureConstraint | JointRange))

    def margins(self, q: FloatArray) -> FloatArray:
        """(N, joints) → (N, K) margins of all constraints that have some."""
        seen = [c for c in self.constraints if isinstance(c, PostureConstraint)]
        if not seen:
            return np.zeros((len(q), 0))
        posture = self.robot.posture(q)
        return np.concatenate([c.margins(self.robot, posture) for c in seen], axis=1)

    def measured(self, q: FloatArray) -> tuple[NDArray[np.bool_], FloatArray]:
        """What is allowed of ``q`` (N, joints) within the limits (N,), and all margins (N, K) there are."""
        margins = self.margins(q)
        ok: NDArray[np.bool_] = np.asarray((margins >= 0).all(axis=1))
        for constraint in self.masks:
            if ok.any():
                ok[ok] = constraint.allowed(self.robot, q[ok])
        return ok, margins

    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:
        """(count, joints) random feasible configurations.

        Uniform within the limits, those that break a constraint rejected. Where nearly all are, the few
        feasible ones are multiplied by random steps from them.

        Raises:
            InfeasibleError: There is none; names the constraint, or the combination, that empties the set.
        """
        low, high = self.limits.T
        if not self.constraints:
            return rng.uniform(low, high, (count, len(low)))
        known: list[FloatArray] = []
        have, tried, batch = 0, 0, max(4 * count, 1024)
        while have < count and (tried < PATIENCE or have > RARE * tried):
            q = rng.uniform(low, high, (min(batch, 20_000), len(low)))
            good = q[self.mask(q)]
            known.append(good)
            have, tried = have + len(good), tried + len(q)
        if not have:
            raise self._empty(
                rng.uniform(low, high, (WITNESSES, len(low))), "random configurations within the joint limits"
            )
        return self._multiplied(rng, np.concatenate(known), count)[:count]

    def check_candidates(self, candidates: FloatArray, count: int) -> None:
        """Refuse candidates (C, joints) of which fewer than ``count`` configurations are feasible.

        Raises:
            InfeasibleError: Names the constraint, or the combination, that leaves none of them.
        """
        allowed = int(self.mask(candidates).sum())
        if not allowed:
            raise self._empty(candidates, "candidates")
        if allowed < count:
            text = f"{allowed} of {len(candidates)} satisfy the constraints, {count} are wanted"
            raise InfeasibleError("candidates", f"{text} ({self._table(candidates)[1]})")

    def _multiplied(self, rng: np.random.Generator, known: FloatArray, count: int) -> FloatArray:
        """At least ``count`` rows: ``known`` and feasible neighbours of it, from steps as long as they may be."""
        low, high = self.limits.T
        step = 0.1
        while len(known) < count:
            origin = known[rng.integers(len(known), size=4096)]
            q = np.clip(origin + step * (high - low) * rng.normal(size=origin.shape), low, high)
            good = q[self.mask(q)]
            known = np.concatenate([known, good])
            step = min(2 * step, 0.1) if len(good) > 400 else step / 2
        return known

    def _table(self, q: FloatArray) -> tuple[list[NDArray[np.bool_]], str]:
        """What each constraint allows of ``q`` (N, joints), as masks (N,) and as text."""
        masks = [c.allowed(self.robot, q) for c in self.constraints]
        rows = zip(self.constraints, masks, strict=True)
        return masks, ", ".join(f"{c.name} allows {100 * m.mean():.2g} %" for c, m in rows)

    def _empty(self, q: FloatArray, what: str) -> InfeasibleError:
        """The smallest combination of constraints that no row of ``q`` (N, joints) satisfies."""
        masks, table = self._table(q)
        which = range(len(masks))
        guilty = next(
            (
                chosen
                for size in range(1, len(masks) + 1)
                for chosen in combinations(which, size)
                if not np.all([masks[i] for i in chosen], axis=0).any()
            ),
            tuple(which),
        )
        names = " and ".join(self.constraints[i].name for i in guilty)
        if len(guilty) == 1:
            return InfeasibleError(
                names, f"none of {len(q)} {what} within the joint limits satisfies it ({table})"
            )
        text = f"each allows some of {len(q)} {what}, all together none ({table}); loosen one"
        return InfeasibleError(names, text)


@dataclass(frozen=True, eq=False)
class PlanWalls:
    """The constraints on plans of ``size`` configurations, rows of D = size·joints coordinates.

    They are the walls of ``search.interior``.
    """

    feasibility: Feasibility
    size: int

    @property
    def joints(self) -> int:
        """Coordinates of one configuration."""
        return len(self.feasibility.robot.joint_names)

    def margins(self, x: FloatArray) -> FloatArray:
        """(rows, D) → (rows, size, K)."""
        margins = self.feasibility.margins(x.reshape(len(x) * self.size, self.joints))
        return margins.reshape(len(x), self.size, margins.shape[1])

    def step(
        self, old: FloatArray, new: FloatArray, margins: FloatArray, normals: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """What is feasible of steps from ``old``, which is, to ``new``, and the margins there.

        A configuration that left the allowed set is brought back to it, by Newton's steps to the margins that the
        tangent promised. Where that fails it goes some share of the step, or stays.

        Args:
            old, new: (rows, D).
            margins: (rows, size, K) at ``old``.
            normals: (rows, size, K, joints) their gradients there.

        Returns:
            (rows, D) points and (rows, size, K) margins.
        """
        start, wanted = old.reshape(-1, self.joints), new.reshape(-1, self.joints)
        m = margins.reshape(len(start), margins.shape[2])
        a = normals.reshape(*m.shape, self.joints)
        q = wanted.copy()
        ok, reached = self.feasibility.measured(q)
        for share in (1.0, *RETREATS, 0.0):
            outside = np.flatnonzero(~ok)
            if not outside.size:
                break
            way = share * (wanted[outside] - start[outside])
            q[outside] = start[outside] + way
            if share < 1.0:
                ok[outside], reached[outside] = self.feasibility.measured(q[outside])
            if share:
                promised = m[outside] + (a[outside] @ way[:, :, None])[:, :, 0]
                self._bring_back(q, ok, reached, outside, promised, a[outside])
        return q.reshape(new.shape), reached.reshape(margins.shape)

    def _bring_back(
        self,
        q: FloatArray,
        ok: NDArray[np.bool_],
        margins: FloatArray,
        rows: IntArray,
        promised: FloatArray,
        normals: FloatArray,
    ) -> None:
        """Move the infeasible ones of the configurations ``rows`` back over the edges they crossed, in place."""
        low, high = self.feasibility.limits.T
        lost = np.zeros(promised.shape, bool)
        for _ in range(CORRECTIONS):
            left = np.flatnonzero(~ok[rows] & (margins[rows] < 0).any(axis=1))
            if not left.size:
                return
            which = rows[left]
            lost[left] |= margins[which] < 0
            # Least squares over the edges crossed, in the joints: as many unknowns as joints, however many edges.
            a = normals[left] * lost[left][:, :, None]
            lack = np.where(lost[left], promised[left] - margins[which], 0.0)
            square = np.swapaxes(a, 1, 2) @ a
            square += 1e-9 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(len(low))
            back = np.linalg.solve(square + 1e-300 * np.eye(len(low)), np.swapaxes(a, 1, 2) @ lack[:, :, None])
            q[which] = np.clip(q[which] + back[:, :, 0], low, high)
            ok[which], margins[which] = self.feasibility.measured(q[which])

    def normals(self, x: FloatArray) -> FloatArray:
        """(rows, D) → (rows, size, K, joints) ∂m_k/∂q of every configuration, by differences."""
        q = x.reshape(-1, self.joints)
        moved = np.concatenate([q[None], q[None] + DIFFERENCE * np.eye(self.joints)[:, None]])
        margins = self.feasibility.margins(moved.reshape(-1, self.joints))
        margins = margins.reshape(self.joints + 1, len(q), margins.shape[1])
        gradients = (margins[1:] - margins[0]) / DIFFERENCE
        return gradients.transpose(1, 2, 0).reshape(len(x), self.size, margins.shape[2], self.joints)
