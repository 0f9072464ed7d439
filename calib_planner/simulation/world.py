"""Where the targets really are: a robot whose joints turn beyond their readings and whose arm swings on.

A pure function of where the robot is told to be: nothing here draws as it goes, whatever happens at an arrival is
drawn from the seed and the arrival's number.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from calib_planner._arrays import FloatArray, check_count
from calib_planner.robot.chain import Robot
from calib_planner.robot.joint_corrections import JointCorrections, phases
from calib_planner.simulation.cell import SimulatedCell
from calib_planner.simulation.draws import Purpose, directions, draws
from calib_planner.simulation.faults import NEVER, Faults
from calib_planner.simulation.motion import Stand


@dataclass(frozen=True, eq=False)
class World:
    """A cell and what is wrong in it.

    Attributes:
        cell: The robot with its true parameters, and the tracker.
        faults: What goes wrong.
        seed: Of everything drawn.
    """

    cell: SimulatedCell
    faults: Faults = field(default_factory=Faults)
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("seed", self.seed, low=0, high=2**63 - 1)

    @property
    def robot(self) -> Robot:
        """What the controller believes."""
        return self.cell.nominal

    @cached_property
    def transmission(self) -> JointCorrections:
        """φ of every joint: the robot is where its geometry puts it at q + φ(q)."""
        robot, faults = self.robot, self.faults
        count, n = len(robot.joint_names), faults.transmission_harmonics
        raw = draws(self.seed, Purpose.TRANSMISSION).standard_normal((2, count, n)) / np.arange(1, n + 1)
        # The mean square of a wave is half of its amplitude's square.
        raw *= faults.transmission_error / np.sqrt(0.5 * np.sum(raw**2, axis=(0, 2)))[:, None]
        return JointCorrections(robot.joint_names, *phases(robot), *raw)

    def reported(self, joints: FloatArray) -> FloatArray:
        """(n, joints) what the encoders say [rad | m]."""
        step = self.faults.encoder_resolution
        return np.rint(joints / step) * step if step > 0 else joints

    def targets(self, stand: Stand) -> FloatArray:
        """(n, targets, 3) where the targets are, in the frame of an undisturbed station [m]."""
        q = self.transmission.actual(stand.joints) if self.faults.transmission_error > 0 else stand.joints
        points = self.cell.truth.positions(q)
        if self.faults.reseat_at != NEVER:
            elsewhere = self._reseated.positions(q)
            moved = stand.arrival >= self.faults.reseat_at
            points = np.where(moved[:, None, None], elsewhere, points)
        return points + self._swing(stand)[:, None, :]

    @cached_property
    def _reseated(self) -> Robot:
        truth = self.cell.truth
        shift = self.faults.reseat_by * directions(draws(self.seed, Purpose.RESEAT), len(truth.targets))
        return truth.with_targets(truth.target_offsets + shift)

    def _swing(self, stand: Stand) -> FloatArray:
        """(n, 3) what an arm that has not settled adds [m]."""
        f, result = self.faults, np.zeros((len(stand.since), 3))
        if f.unsettled_probability == 0.0:
            return result
        still = np.isfinite(stand.since) & (stand.arrival >= 0)
        for k in np.unique(stand.arrival[still]):
            rng = draws(self.seed, Purpose.UNSETTLED, int(k))
            if rng.random() >= f.unsettled_probability:
                continue
            rows = still & (stand.arrival == k)
            t, (one, two) = stand.since[rows], directions(rng, 2)
            swing = np.exp(-t / f.oscillation_decay) * np.cos(2 * np.pi * f.oscillation_frequency * t)
            result[rows] = f.oscillation * np.outer(swing, one) + f.creep * np.outer(
                np.exp(-t / f.creep_time), two
            )
        return result
