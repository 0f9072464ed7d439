# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A simulated robot and tracker with faults: where the targets really are, and what the tracker sees of them.

``World`` is a pure function of where the robot is told to be: whatever happens at an arrival, what the error
model calls a visit among it, is drawn from the seed and the arrival's number. ``Sight`` looks at it: a station
that turned by R about its place c and moved by v sees a point p at R(p − c) + c + v; beam breaks, outliers and
noise come on top. ``simulated`` measures one configuration at a time, as a campaign wants it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_planner.arrays import FloatArray, check_count
from calib_planner.campaign import (
    CampaignProblem,
    CampaignResult,
    CampaignState,
    Instrument,
    Measure,
    Unreachable,
    run_campaign,
)
from calib_planner.error_model import ErrorModel, Truth
from calib_planner.robot import Robot
from calib_planner.simulation.cell import (
    NEVER,
    Faults,
    Purpose,
    SimulatedCell,
    directions,
    draws,
    independent_seeds,
    random_deviations,
    visit_errors,
)
from calib_planner.simulation.motion import Stand
from calib_planner.tracker import LaserTracker, Noise

SETTLED = 1e9
"""Time since an arrival after which no arm moves any more [s]."""


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
    def truth(self) -> Truth:
        """The cell's robot, its joints erring by the transmission error as well."""
        size, n = self.faults.transmission_error, self.faults.transmission_harmonics
        if size == 0.0:
            return self.cell.truth
        count = len(self.robot.joint_names)
        raw = draws(self.seed, Purpose.TRANSMISSION).standard_normal((2, count, n)) / np.arange(1, n + 1)
        # The mean square of a wave is half of its amplitude's square.
        raw *= size / np.sqrt(0.5 * np.sum(raw**2, axis=(0, 2)))[:, None]
        return self.cell.truth.with_joint_functions(raw.transpose(1, 0, 2), size)

    def reported(self, joints: FloatArray) -> FloatArray:
        """(n, joints) what the encoders say [rad | m]."""
        step = self.faults.encoder_resolution
        return np.rint(joints / step) * step if step > 0 else joints

    def targets(self, stand: Stand) -> FloatArray:
        """(n, targets, 3) where the targets are, in the frame of an undisturbed station [m].

        While it stands at an arrival, the robot errs as it does at that visit; else as it does on average.
        """
        still = np.isfinite(stand.since)
        visits = visit_errors(self.truth, self.seed, np.where(still, stand.arrival, NEVER))
        points = self.truth.positions(stand.joints, visits)
        if self.faults.reseat_at != NEVER:
            elsewhere = self._reseated.positions(stand.joints, visits)
            moved = stand.arrival >= self.faults.reseat_at
            points = np.where(moved[:, None, None], elsewhere, points)
        return points + self._swing(stand)[:, None, :]

    def errors(self, predicted: Callable[[FloatArray], FloatArray], poses: FloatArray) -> FloatArray:
        """(K,) rms distance over the targets [m] between ``predicted`` points and the true ones.

        Args:
            predicted: Points (K, targets, 3) [m] at configurations, such as ``Estimate.positions``.
            poses: (K, joints) configurations [rad | m], at which the robot stands as it does on average.
        """
        stand = Stand(poses, np.arange(len(poses)), np.full(len(poses), np.inf))
        off = predicted(poses) - self.targets(stand)
        return np.asarray(np.sqrt(np.mean(np.sum(off**2, axis=2), axis=1)))

    def struck(
        self, stand: Stand, purpose: Purpose, share: float, *which: int
    ) -> Iterator[tuple[NDArray[np.bool_], np.random.Generator]]:
        """Of the arrivals in ``stand`` the ``share`` that a fault strikes: rows (n,), and the arrival's draws."""
        still = np.isfinite(stand.since) & (stand.arrival >= 0)
        for k in np.unique(stand.arrival[still]) if share > 0 else ():
            rng = draws(self.seed, purpose, int(k), *which)
            if rng.random() < share:
                yield still & (stand.arrival == k), rng

    @cached_property
    def _reseated(self) -> Truth:
        robot = self.truth.robot
        shift = self.faults.reseat_by * directions(draws(self.seed, Purpose.RESEAT), len(robot.targets))
        return self.truth.with_targets(robot.target_offsets + shift)

    def _swing(self, stand: Stand) -> FloatArray:
        """(n, 3) what an arm that has not settled adds [m]."""
        f, result = self.faults, np.zeros((len(stand.since), 3))
        for rows, rng in self.struck(stand, Purpose.UNSETTLED, f.unsettled_probability):
            t, (one, two) = stand.since[rows], directions(rng, 2)
            swing = np.exp(-t / f.oscillation_decay) * np.cos(2 * np.pi * f.oscillation_frequency * t)
            result[rows] = f.oscillation * np.outer(swing, one) + f.creep * np.outer(
                np.exp(-t / f.creep_time), two
            )
        return result


class Sight:
    """A tracker in a ``World``; noise and outliers are drawn in the order of the looks, stream by stream."""

    def __init__(self, world: World) -> None:
        self.world = world
        cell, seed = world.cell, world.seed
        targets = range(len(cell.nominal.targets))
        self._noise = [draws(seed, Purpose.NOISE, t) for t in targets]
        self._odd = [draws(seed, Purpose.OUTLIER, t) for t in targets]
        self._odd_size = [draws(seed, Purpose.OUTLIER_SIZE, t) for t in targets]
        self._breaks, self._losses = BeamBreaks(world), BeamLosses(world)
        instrument = cell.instrument
        self._station = np.asarray(instrument.station if isinstance(instrument, LaserTracker) else np.zeros(3))

    def look(self, target: int, stand: Stand, seconds: FloatArray) -> FloatArray:
        """(n, 3) points of one target [m], NaN where it is not seen.

        Args:
            target: From 0.
            stand: Where the robot is.
            seconds: (n,) time since the start of the simulation, ascending from look to look.
        """
        points = self._from_station(self.world.targets(stand)[:, target], stand, seconds)
        broken, wrong = self._breaks.at(seconds)
        beam = points - self._station
        points = points + wrong[:, None] * beam / np.maximum(np.linalg.norm(beam, axis=1), 1e-9)[:, None]
        points = points + self.world.cell.noise(points, self._noise[target])
        points = points + self._outliers(target, len(points)) + self._far_standstills(target, stand)
        points[broken | self._losses.at(stand, seconds)] = np.nan
        return points

    def locked(self, stand: Stand, seconds: float) -> bool:
        """Whether the tracker holds its targets at that time [s], the robot at ``stand`` (one row)."""
        at = np.array([seconds])
        return not (self._breaks.at(at)[0] | self._losses.at(stand, at))[0]

    def lost(self, stand: Stand, seconds: float) -> bool:
        """Whether they are lost until somebody, or time, brings them back; a break is not that."""
        return bool(self._losses.at(stand, np.array([seconds]))[0])

    def restore(self, seconds: float) -> bool:
        """Bring the beam back; whether it was lost."""
        return self._losses.restore(seconds)

    def _from_station(self, points: FloatArray, stand: Stand, seconds: FloatArray) -> FloatArray:
        f, seed = self.world.faults, self.world.seed
        if f.drift_translation or f.drift_rotation:
            along, axis = directions(draws(seed, Purpose.DRIFT), 2)
            points = self._moved(points, seconds, f.drift_translation * along, f.drift_rotation * axis)
        if f.bump_at != NEVER:
            along, axis = directions(draws(seed, Purpose.BUMP), 2)
            after = (stand.arrival >= f.bump_at).astype(float)
            points = self._moved(points, after, f.bump_translation * along, f.bump_rotation * axis)
        return points

    def _moved(self, points: FloatArray, amount: FloatArray, move: FloatArray, turn: FloatArray) -> FloatArray:
        turned = Rotation.from_rotvec(np.outer(amount, turn)).apply(points - self._station)
        return np.asarray(turned + self._station + np.outer(amount, move))

    def _outliers(self, target: int, count: int) -> FloatArray:
        f, result = self.world.faults, np.zeros((count, 3))
        if f.outlier_probability > 0:
            odd = np.flatnonzero(self._odd[target].random(count) < f.outlier_probability)
            for i in odd:
                result[i] = self._far(self._odd_size[target])
        return result

    def _far_standstills(self, target: int, stand: Stand) -> FloatArray:
        share, result = self.world.faults.outlier_standstills, np.zeros((len(stand.since), 3))
        for rows, rng in self.world.struck(stand, Purpose.OUTLIER_STANDSTILL, share, target):
            result[rows] = self._far(rng)
        return result

    def _far(self, rng: np.random.Generator) -> FloatArray:
        f = self.world.faults
        return np.asarray(rng.uniform(f.outlier_smallest, f.outlier_largest) * directions(rng, 1)[0])


class BeamBreaks:
    """When the beam is broken, and how wrong distances are after each break; the list grows as it is read."""

    def __init__(self, world: World) -> None:
        self._faults = world.faults
        self._rng = draws(world.seed, Purpose.BEAM_BREAK)
        self._begin: list[float] = []
        self._wrong: list[float] = [0.0]

    def at(self, seconds: FloatArray) -> tuple[NDArray[np.bool_], FloatArray]:
        """(n,) whether it is broken, and (n,) the error of the distance [m], at ``seconds`` (n,)."""
        f = self._faults
        if f.beam_break_interval == 0.0 or not len(seconds):
            return np.zeros(len(seconds), bool), np.zeros(len(seconds))
        while not self._begin or self._begin[-1] <= seconds.max():
            last = self._begin[-1] + f.beam_break_duration if self._begin else 0.0
            self._begin.append(last + max(float(self._rng.exponential(f.beam_break_interval)), 1e-3))
            self._wrong.append(float(f.relock_error * self._rng.standard_normal()))
        begin = np.array(self._begin)
        count = np.searchsorted(begin, seconds, side="right")
        latest = begin[np.maximum(count - 1, 0)]
        broken = (count > 0) & (seconds < latest + f.beam_break_duration)
        return broken, np.array(self._wrong)[count]


class BeamLosses:
    """When targets are lost at an arrival or a departure, and until when; the list grows as it is read.

    A departure is seen by joints that differ from those of the look before.
    """

    def __init__(self, world: World) -> None:
        self._faults, self._seed = world.faults, world.seed
        self._known: set[tuple[bool, int]] = set()
        self._lost: list[tuple[float, float]] = []
        self._before: FloatArray | None = None

    def at(self, stand: Stand, seconds: FloatArray) -> NDArray[np.bool_]:
        """(n,) whether they are lost at ``seconds`` (n,), the robot at ``stand``."""
        f, result = self._faults, np.zeros(len(seconds), bool)
        if not (f.beam_lost_standing or f.beam_lost_moving) or not len(seconds):
            return result
        still = np.isfinite(stand.since)
        before = stand.joints[:1] if self._before is None else self._before
        moved = np.any(np.diff(np.vstack([before, stand.joints]), axis=0) != 0.0, axis=1) & ~still
        self._before = stand.joints[-1:]
        for rows, moving, share in ((still, False, f.beam_lost_standing), (moved, True, f.beam_lost_moving)):
            for k in np.unique(stand.arrival[rows]):
                key = (moving, int(k))
                if key not in self._known:
                    self._known.add(key)
                    first = float(seconds[rows & (stand.arrival == k)][0])
                    rng = draws(self._seed, Purpose.BEAM_LOST, moving, int(k) + 1)
                    if rng.random() < share:
                        self._lost.append((first, first + (f.beam_lost_duration or np.inf)))
        for begin, end in self._lost:
            result |= (seconds >= begin) & (seconds < end)
        return result

    def restore(self, seconds: float) -> bool:
        """Bring them back at that time [s]; whether they were lost."""
        lost = any(begin <= seconds < end for begin, end in self._lost)
        self._lost = [(begin, min(end, seconds)) for begin, end in self._lost]
        return lost


def simulated(world: World, seed: int, reaches: Callable[[FloatArray], bool] = lambda q: True) -> Instrument:
    """Measures in ``world``.

    Args:
        seed: Of the tracker's noise.
        reaches: Whether the robot gets to a configuration (joints,).
    """
    rng = np.random.default_rng([seed, 2])  # a stream of its own: the true errors may have the same seed
    arrivals = 0

    def measure(action: Measure) -> FloatArray:
        nonlocal arrivals
        if not reaches(action.q):
            raise Unreachable("the robot does not get there")
        stand = Stand(action.q[None], np.array([arrivals]), np.array([SETTLED]))
        arrivals += 1
        points = world.targets(stand)
        return np.asarray((points + world.cell.noise(points, rng))[0])

    return measure


def simulate_campaign(
    problem: CampaignProblem,
    seed: int,
    sigma: float,
    noise: Noise | None = None,
    transmission: float = 0.0,
    watch: Callable[[CampaignState], None] = lambda state: None,
    error_model: ErrorModel | None = None,
) -> tuple[CampaignResult, World, dict[str, float]]:
    """Run a campaign with a simulated robot of hidden errors.

    Args:
        seed: Of the true errors and of the tracker's noise.
        sigma: True standard deviation of one coordinate [m].
        noise: The tracker's true noise, in place of ``sigma``.
        transmission: Rms error of the joints' transmissions [rad].
        watch: Called with every state.
        error_model: How the robot errs besides its parameters; ``None``: not at all.

    Returns:
        The result, the world that was measured, and the true deviations by parameter [m | rad].
    """
    truth_seed, noise_seed = independent_seeds(seed, 2)
    errors = random_deviations(problem.robot, truth_seed)
    cell = SimulatedCell(problem.robot, errors, sigma, noise, error_model, truth_seed)
    world = World(cell, Faults(transmission_error=transmission), truth_seed)
    return run_campaign(problem, simulated(world, noise_seed), watch), world, errors
