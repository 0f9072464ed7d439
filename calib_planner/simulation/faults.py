"""What goes wrong on a shop floor, as numbers: every fault off by default, each with unit and range.

A fault belongs to the robot (what it does differs from what it reports), to the tracker (what it sees differs
from where the target is) or to the messages (what arrives differs from what was sent). ``world`` does the first
two, ``streams`` the third; what each parameter means exactly stands here. An *arrival* is the beginning of a
standstill that is meant for measuring; arrivals are counted from 0 since the start of the simulation. Directions
and signs that no parameter gives are drawn from the seed.
"""

from __future__ import annotations

from dataclasses import dataclass

from calib_planner.arrays import check_ranges, ranged
from calib_planner.errors import InputError

NEVER = -1


@dataclass(frozen=True)
class Faults:
    """All of them; ``fields(Faults)`` carry description, unit and range as metadata.

    *Robot*

    ``transmission_error``: root mean square of φ(q), what a joint turns beyond its reading; a function of its own
    reading with ``transmission_harmonics`` waves per turn (half a turn over the range if sliding), the n-th of
    amplitude ∝ 1/n, no constant part.
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
