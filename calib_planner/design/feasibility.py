"""Which configurations may be measured at all.

A constraint has a name and says, for a batch of configurations, which of them it allows. The joint limits are
not among the constraints: every search keeps to them by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib_planner._arrays import FloatArray
from calib_planner.errors import InfeasibleError
from calib_planner.robot.chain import Robot

PATIENCE = 200_000
"""Random configurations tried before a set of constraints is called empty."""


class Constraint(Protocol):
    """One condition on configurations."""

    @property
    def name(self) -> str:
        """How messages call it."""
        ...

    def allowed(self, robot: Robot, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) → (N,)."""
        ...


@dataclass(frozen=True, eq=False)
class Feasibility:
    """All constraints of a problem together.

    Attributes:
        robot: The robot they are about.
        constraints: The constraints; none means the joint limits alone.
    """

    robot: Robot
    constraints: tuple[Constraint, ...] = ()

    def mask(self, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) → (N,): allowed by every constraint."""
        ok = np.ones(len(q), bool)
        for constraint in self.constraints:
            left = np.flatnonzero(ok)
            if not left.size:
                break
            ok[left] = constraint.allowed(self.robot, q[left])
        return ok

    def sample(self, rng: np.random.Generator, count: int) -> FloatArray:
        """(count, joints) random feasible configurations.

        Raises:
            InfeasibleError: None was found; names the constraint, or the combination, that empties the set.
        """
        low, high = self.robot.joint_limits.T
        if not self.constraints:
            return rng.uniform(low, high, (count, len(low)))
        found: list[FloatArray] = []
        have, tried, batch = 0, 0, max(4 * count, 1024)
        while have < count:
            q = rng.uniform(low, high, (min(batch, 20_000), len(low)))
            good = q[self.mask(q)]
            found.append(good)
            have, tried = have + len(good), tried + len(q)
            if have == 0 and tried >= PATIENCE:
                raise self._empty(rng)
        return np.concatenate(found)[:count]

    def _empty(self, rng: np.random.Generator) -> InfeasibleError:
        low, high = self.robot.joint_limits.T
        q = rng.uniform(low, high, (20_000, len(low)))
        shares = {c.name: float(c.allowed(self.robot, q).mean()) for c in self.constraints}
        alone = [name for name, share in shares.items() if share == 0.0]
        table = ", ".join(f"{name} allows {100 * share:.2g} %" for name, share in shares.items())
        if alone:
            return InfeasibleError(alone[0], f"no configuration within the joint limits satisfies it ({table})")
        names = " and ".join(shares)
        return InfeasibleError(names, f"each allows some configurations, all together none ({table}); relax one")
