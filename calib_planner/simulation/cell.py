# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A robot with hidden true parameters, a tracker with noise, and what goes wrong on a shop floor.

How a sound robot errs is drawn from an error model (``error_model.Truth``), the same that identifications reckon
with: what its parts are off, what its joints do under weight and as they turn, and what is new at each arrival.
``Faults`` are what goes wrong beside that.

Every random number has a seed. Each purpose has a stream of random numbers of its own, so that switching a fault
on changes no other draw.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from calib_planner.arrays import (
    FloatArray,
    IntArray,
    check_configurations,
    check_count,
    check_number,
    check_ranges,
    ranged,
)
from calib_planner.error_model import ErrorModel, Truth, VisitErrors, typical
from calib_planner.errors import InputError
from calib_planner.measurements import Measurements
from calib_planner.robot import Robot
from calib_planner.tracker import Isotropic, Noise

NEVER = -1
LENGTH_ERROR = typical().values["placement.length"]
"""Default standard deviation of true length errors [m]."""
ANGLE_ERROR = typical().values["placement.angle"]
"""Default standard deviation of true angle errors [rad]."""
NOISELESS = 1e-30
"""What stands in the error model for the standard deviation of a tracker without noise [m]."""


def independent_seeds(seed: int, count: int) -> list[int]:
    """``count`` seeds whose random numbers have nothing to do with each other, all from one."""
    return [int(s) for s in np.random.SeedSequence(seed).generate_state(count)]


def random_deviations(
    robot: Robot, seed: int, length: float = LENGTH_ERROR, angle: float = ANGLE_ERROR
) -> dict[str, float]:
    """True errors of the active parameters, drawn from normal distributions [m | rad].

    By default lengths and angles err by the standard deviations that the typical error model expects. So do the
    zeros of the joints, of which that model expects less (``placement.ZERO``, 20 mrad): its prior has to hold for
    zeros that were set by eye, while a joint that was mastered as its maker says stands within about 1 mrad.
    """
    rng = np.random.default_rng([seed, 1])  # a stream of its own: noise may have the same seed
    draw = rng.standard_normal(len(robot.parameters))
    return {
        p.name: float(d * (length if p.unit == "m" else angle))
        for p, d in zip(robot.parameters, draw, strict=True)
    }


@dataclass(frozen=True, eq=False)
class SimulatedCell:
    """A real robot, as far as we can have one, in front of a tracker.

    Attributes:
        nominal: What the controller believes.
        deviations: True deviation of each named parameter [m | rad].
        sigma: Standard deviation of one tracker coordinate [m].
        instrument: The tracker's noise by direction, in the frame of the points; ``None``: ``sigma`` alike.
        error_model: How the robot errs besides the deviations; ``None``: as the paper's, not at all. Its noise is
            replaced by that of the tracker.
        seed: Of the coefficients that are drawn from the error model.
        truth: The robot with those deviations and coefficients.
    """

    nominal: Robot
    deviations: Mapping[str, float]
    sigma: float = 3e-5
    instrument: Noise | None = None
    error_model: ErrorModel | None = None
    seed: int = 0
    truth: Truth = field(init=False)

    def __post_init__(self) -> None:
        check_number("sigma", self.sigma, low=0, high=1, unit="m")
        check_count("seed", self.seed, low=0, high=2**63 - 1)
        object.__setattr__(self, "deviations", dict(self.deviations))
        noise = Isotropic(max(self.sigma, NOISELESS)) if self.instrument is None else self.instrument
        model = (ErrorModel.paper() if self.error_model is None else self.error_model).with_noise(noise)
        rng = draws(self.seed, Purpose.COEFFICIENTS)
        object.__setattr__(self, "truth", Truth.draw(self.nominal, model, rng, self.deviations))

    def measure(self, configurations: ArrayLike, repetitions: ArrayLike | int, seed: int) -> Measurements:
        """Measure each configuration ``repetitions`` times; each time one row and one visit."""
        q = check_configurations("configurations", configurations, self.nominal.joint_names)
        if np.ndim(repetitions) == 0:
            check_count("repetitions", repetitions)
        elif np.shape(repetitions) != (len(q),):
            raise InputError("repetitions", np.shape(repetitions), f"one number or {len(q)} numbers")
        rows = np.repeat(q, np.asarray(repetitions, np.int64), axis=0)
        rng = np.random.default_rng(seed)
        points = self.truth.positions(rows, visit_errors(self.truth, seed, np.arange(len(rows))))
        noisy = points + self.noise(points, rng)
        return Measurements(self.nominal.joint_names, rows, noisy, self._std(points))

    def noise(self, points: FloatArray, rng: np.random.Generator) -> FloatArray:
        """(…, 3) errors of one sample of each of the ``points`` (…, 3) [m]."""
        if self.instrument is None and self.sigma == 0:
            return np.zeros(points.shape)
        return self.truth.noise(points, rng.standard_normal(points.shape))

    def _std(self, points: FloatArray) -> FloatArray | None:
        """Standard deviation of each coordinate, like ``points`` [m]; ``None`` without noise."""
        if self.instrument is not None:
            covariance = self.instrument.covariance(points)
            return np.asarray(np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)))
        return np.full(points.shape, self.sigma) if self.sigma > 0 else None

    def position_errors(self, model: Robot, configurations: ArrayLike) -> FloatArray:
        """(N, targets) distances between the true robot, as it stands on average, and ``model``, eq. (4) [m]."""
        difference = self.truth.positions(configurations) - model.positions(configurations)
        return np.linalg.norm(difference, axis=2)


@dataclass(frozen=True)
class Faults:
    """What goes wrong on a shop floor, as numbers: every fault is off by default.

    ``fields(Faults)`` carry description, unit and range as metadata.

    A fault belongs to the robot (what it does differs from what it reports), to the tracker (what it sees
    differs from where the target is) or to the messages (what arrives differs from what was sent). ``world``
    does the first two, ``streams`` the third. An *arrival* is the beginning of a standstill that is meant for
    measuring; arrivals are counted from 0 since the start of the simulation. Directions and signs that no
    parameter gives are drawn from the seed.

    *Robot*

    ``transmission_error``: root mean square of a joint function φ(q), what a joint turns beyond its reading, on
    top of those of the error model; a function of its own reading with ``transmission_harmonics`` waves per turn
    (half a turn over the range if sliding), the n-th of amplitude ∝ 1/n, no constant part.
    ``encoder_resolution``: reported joints are rounded to multiples of it; the arm is where it is.
    ``unsettled_probability``: share of arrivals after which the arm still moves while its encoders rest. It
    swings by ``oscillation`` · e^(−t/``oscillation_decay``) · cos(2π ``oscillation_frequency`` t) and creeps by
    ``creep`` · e^(−t/``creep_time``), each along a direction of that arrival, t since the arrival.

    *Target and station*

    ``reseat_at``: from this arrival on the target sits elsewhere: its offset in the tip's frame differs by a
    vector of length ``reseat_by``, another direction for each target.
    ``drift_translation``, ``drift_rotation``: the station moves and turns about itself at these speeds, along and
    about fixed directions, from the start of the simulation.
    ``bump_at``: from this arrival on the station stands elsewhere: moved by ``bump_translation``, turned about
    itself by ``bump_rotation``.

    *What the tracker sees*

    ``outlier_probability``: share of single points that are off by a length uniform from ``outlier_smallest`` to
    ``outlier_largest`` in any direction. ``outlier_standstills``: share of arrivals from which on, until the
    robot moves on, all points of a target are off by one such vector.
    ``beam_break_interval``: mean time from the end of a beam break to the next one (exponential); during a break
    of ``beam_break_duration`` no target is seen. After each, distances are wrong by one number drawn from a
    normal distribution of standard deviation ``relock_error``, until the next break.
    ``beam_lost_standing``, ``beam_lost_moving``: share of arrivals, and of departures, at which the tracker loses
    the targets. It sees none until they are brought back: after ``beam_lost_duration``, or when somebody does so.

    *Messages*

    ``dropout_probability``: share of tracker points that are never sent.
    ``tracker_latency``, ``joint_latency``: messages arrive that much after their stamp, at least; on top comes an
    exponential delay of mean ``tracker_jitter``, ``joint_jitter``. Their order stays, their stamps are right.
    ``tracker_clock_offset``, ``tracker_clock_drift``: the tracker's stamps are ahead of the robot's by offset +
    drift · time since the start; the points are of the time they were taken.
    ``duplicate_probability``: share of messages of every stream that come once more.
    ``reorder_probability``: share of messages of every stream that are held back, so that later ones come first.
    Both by a time uniform up to ``shuffle_delay``.
    """

    transmission_error: float = ranged(0.0, "joints turn beyond their reading, rms", "rad or m", 0.0, 0.1)
    transmission_harmonics: int = ranged(3, "waves per turn of the transmission error", "", 1, 200)
    encoder_resolution: float = ranged(0.0, "joint readings are multiples of this", "rad or m", 0.0, 0.1)
    unsettled_probability: float = ranged(0.0, "share of arrivals not settled", "", 0.0, 1.0)
    oscillation: float = ranged(1e-3, "swing of an arm not settled, at arrival", "m", 0.0, 0.1)
    oscillation_frequency: float = ranged(8.0, "frequency of that swing", "Hz", 0.01, 1000.0)
    oscillation_decay: float = ranged(0.3, "time constant of that swing", "s", 1e-3, 3600.0)
    creep: float = ranged(0.0, "slow creep of an arm not settled, at arrival", "m", 0.0, 0.1)
    creep_time: float = ranged(5.0, "time constant of that creep", "s", 1e-3, 3600.0)
    reseat_at: int = ranged(NEVER, "first arrival with the target seated elsewhere; -1 = never", "", NEVER, 10**6)
    reseat_by: float = ranged(3e-4, "how far the target then sits elsewhere, in the tip's frame", "m", 0.0, 0.1)
    drift_translation: float = ranged(0.0, "speed at which the station moves", "m/s", 0.0, 0.01)
    drift_rotation: float = ranged(0.0, "speed at which the station turns", "rad/s", 0.0, 0.01)
    bump_at: int = ranged(NEVER, "first arrival with the station pushed; -1 = never", "", NEVER, 10**6)
    bump_translation: float = ranged(3e-4, "how far the station is then moved", "m", 0.0, 0.1)
    bump_rotation: float = ranged(1e-4, "how far the station is then turned", "rad", 0.0, 0.1)
    outlier_probability: float = ranged(0.0, "share of single points far off", "", 0.0, 1.0)
    outlier_standstills: float = ranged(0.0, "share of arrivals with all points far off", "", 0.0, 1.0)
    outlier_smallest: float = ranged(0.01, "outliers: how far off, at least", "m", 0.0, 100.0)
    outlier_largest: float = ranged(0.05, "outliers: how far off, at most", "m", 0.0, 100.0)
    beam_break_interval: float = ranged(0.0, "mean time between beam breaks; 0 = none", "s", 0.0, 1e6)
    beam_break_duration: float = ranged(1.0, "length of a beam break", "s", 0.0, 3600.0)
    relock_error: float = ranged(0.0, "error of distances after a break, std", "m", 0.0, 0.1)
    beam_lost_standing: float = ranged(0.0, "share of arrivals at which the beam is lost", "", 0.0, 1.0)
    beam_lost_moving: float = ranged(0.0, "share of departures at which the beam is lost", "", 0.0, 1.0)
    beam_lost_duration: float = ranged(
        10.0, "time until it is brought back; 0 = by ~/restore_beam only", "s", 0.0, 1e6
    )
    dropout_probability: float = ranged(0.0, "share of tracker points never sent", "", 0.0, 1.0)
    tracker_latency: float = ranged(0.0, "tracker points arrive this late", "s", 0.0, 60.0)
    tracker_jitter: float = ranged(0.0, "mean of a further delay of tracker points", "s", 0.0, 60.0)
    joint_latency: float = ranged(0.0, "joint states arrive this late", "s", 0.0, 60.0)
    joint_jitter: float = ranged(0.0, "mean of a further delay of joint states", "s", 0.0, 60.0)
    tracker_clock_offset: float = ranged(0.0, "the tracker's clock is ahead of the robot's", "s", -3600.0, 3600.0)
    tracker_clock_drift: float = ranged(0.0, "how fast that clock gains on the robot's", "s/s", -0.01, 0.01)
    duplicate_probability: float = ranged(0.0, "share of messages that come twice", "", 0.0, 1.0)
    reorder_probability: float = ranged(0.0, "share of messages that come after later ones", "", 0.0, 1.0)
    shuffle_delay: float = ranged(0.05, "messages twice or held back: latest", "s", 0.0, 60.0)

    def __post_init__(self) -> None:
        check_ranges(self, Faults)
        if self.outlier_smallest > self.outlier_largest:
            expected = f"at most outlier_largest = {self.outlier_largest:g} m"
            raise InputError("outlier_smallest", self.outlier_smallest, expected)


class Purpose(IntEnum):
    """What is drawn; part of the seed, so the numbers stay as they are."""

    NOISE = 101
    TRANSMISSION = 102
    UNSETTLED = 103
    RESEAT = 104
    DRIFT = 105
    BUMP = 106
    OUTLIER = 107
    OUTLIER_SIZE = 108
    OUTLIER_STANDSTILL = 109
    BEAM_BREAK = 110
    DROPOUT = 111
    DELAY = 112
    DUPLICATE = 113
    DUPLICATE_DELAY = 114
    REORDER = 115
    REORDER_DELAY = 116
    COEFFICIENTS = 117
    VISIT = 118
    BEAM_LOST = 119


def draws(seed: int, purpose: Purpose, *which: int) -> np.random.Generator:
    """The generator of a purpose, and of the arrival or stream ``which``."""
    return np.random.default_rng([seed, int(purpose), *which])


def directions(rng: np.random.Generator, count: int) -> FloatArray:
    """(count, 3) unit vectors, uniform on the sphere."""
    raw = rng.standard_normal((count, 3))
    return np.asarray(raw / np.linalg.norm(raw, axis=1)[:, None])


def visit_errors(truth: Truth, seed: int, arrivals: IntArray) -> VisitErrors | None:
    """What is new at each of the ``arrivals`` (n,), which tell by their numbers what is drawn.

    Nothing is new at those below 0: the robot is on its way. ``None``: nothing ever is.
    """
    model = truth.model
    if model.visits is None and not model.points.floor:
        return None
    numbers, place = np.unique(arrivals, return_inverse=True)
    drawn = [truth.draw_visits(1, draws(seed, Purpose.VISIT, max(int(k), 0))) for k in numbers]
    there = (numbers >= 0)[place, None]
    joints = np.concatenate([d.joints for d in drawn])[place] * there
    return VisitErrors(joints, np.concatenate([d.points for d in drawn])[place] * there[:, :, None])
