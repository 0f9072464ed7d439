"""What the tracker makes of it: a station that drifts or is pushed, beam breaks, outliers, noise.

A station that turned by R about its place c and moved by v sees a point at R(p − c) + c + v.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib_planner._arrays import FloatArray
from calib_planner.instrument.noise import LaserTracker
from calib_planner.simulation.draws import Purpose, directions, draws
from calib_planner.simulation.faults import NEVER
from calib_planner.simulation.motion import Stand
from calib_planner.simulation.world import World


class Sight:
    """A tracker in a ``World``; noise and outliers are drawn in the order of the looks, stream by stream."""

    def __init__(self, world: World) -> None:
        self.world = world
        cell, seed = world.cell, world.seed
        targets = range(len(cell.truth.targets))
        self._noise = [draws(seed, Purpose.NOISE, t) for t in targets]
        self._odd = [draws(seed, Purpose.OUTLIER, t) for t in targets]
        self._odd_size = [draws(seed, Purpose.OUTLIER_SIZE, t) for t in targets]
        self._breaks = BeamBreaks(world)
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
        points[broken] = np.nan
        return points

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
        f, result = self.world.faults, np.zeros((len(stand.since), 3))
        if f.outlier_standstills == 0.0:
            return result
        still = np.isfinite(stand.since) & (stand.arrival >= 0)
        for k in np.unique(stand.arrival[still]):
            rng = draws(self.world.seed, Purpose.OUTLIER_STANDSTILL, int(k), target)
            if rng.random() < f.outlier_standstills:
                result[still & (stand.arrival == k)] = self._far(rng)
        return result

    def _far(self, rng: np.random.Generator) -> FloatArray:
        f = self.world.faults
        return np.asarray(rng.uniform(f.outlier_smallest, f.outlier_largest) * directions(rng, 1)[0])


class BeamBreaks:
    """When the beam is broken, and how wrong distances are after each break; the list grows as it is asked."""

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
