# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""How many measurements, how to split them between configurations and repetitions, and what fits into a time.

*Measurements.* With σ_c = 0 the accuracy of k configurations measured r times is ρ_k/√r, and the bound of n
measurements is c/√n: no plan of fewer than (c/ρ)² measurements reaches ρ. Good small plans repeated are nearly
as good as large ones (the paper's Table 2), so few k need to be tried. With σ_c > 0 repetition helps less, and
(with a prior) the bound is no longer a square root; both are then simply computed.

*Time.* A further configuration costs a move and a standstill, a repetition costs backing off and a standstill
(see ``tour``); the first tells more, the second is cheaper. For each of a few numbers of configurations m the
planner chooses m configurations, the tour visits them in little time, and what time is left goes to repetitions,
to the configurations where they tell most. With M(r) the information of r_i visits to configuration i, one visit
more gains, to first order,

    log Ψ(M + ΔM_i) − log Ψ(M) ≈ tr(G ΔM_i) / Ψ,        G = ∂Ψ/∂M,

and costs nearly the same everywhere, since the robot backs off by the same amount: the visit goes to the largest
gain, a few at a time while many are left. log Ψ is concave in r, so each gain falls as visits are added. The best
number m is looked for in steps of ``STEP`` while that pays, for a time from about as many as fit, for an accuracy
from the smallest upwards; then between the neighbours of the best. What is looked for rises and then
falls with m but for small irregularities of the search.

Where the error model is typical, log Ψ is the mean over the sizes of errors that the search has (see
``information``), and as there it holds a small share for the accuracy everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from calib_planner.arrays import FloatArray, IntArray, check_count, check_number
from calib_planner.errors import InfeasibleError, InputError
from calib_planner.planning.criteria import POSE_CRITERIA, Criterion, reported_value, ridged
from calib_planner.planning.extended import ExtendedModel
from calib_planner.planning.information import PlanSpace, plan_space, smallest_size, spread_spaces
from calib_planner.planning.planner import GOOD_ENOUGH, Callback, judged, plan, psi_of, value_in
from calib_planner.planning.problem import PlanProblem
from calib_planner.planning.result import Plan
from calib_planner.planning.tour import Pace, Timetable, visit_times, visiting_order

MOST_MEASUREMENTS = 10_000
TRIED = 6
"""Numbers of configurations tried one by one from the smallest; beyond them only if none of these is enough."""
MOST_CONFIGURATIONS = 60
"""Larger plans are not tried: the search for one takes longer than people wait."""
STEP = 1.5
"""Factor between the numbers of configurations that are tried for a time."""
CLOSE = 1.15
"""Numbers of configurations with a smaller quotient are not told apart: their plans differ as searches do."""
CLEAR = 0.05
"""Difference of log Ψ, or of the logarithm of the time, beyond that of two visits, that is no irregularity."""
PORTION = 20
"""A PORTION-th of the visits that are left is given away before the gains are computed again."""

Watch = Callable[[int, int], None]
"""Told how many plans are done, of how many at most."""


@dataclass(frozen=True, eq=False)
class Split:
    """Measurements divided into configurations and repetitions.

    Attributes:
        plan: The recommended plan.
        tried: All plans computed, smallest number of configurations first.
        fewest: No plan of fewer measurements can reach the wanted accuracy (0 where that is not known).
        timetable: When the robot is where; ``None`` if nothing was said about time.
        seconds: Time that each of ``tried`` takes [s]; empty if nothing was said about time.
    """

    plan: Plan
    tried: tuple[Plan, ...]
    fewest: int
    timetable: Timetable | None = None
    seconds: tuple[float, ...] = ()


def plan_for_accuracy(problem: PlanProblem, accuracy: float, watch: Watch = lambda done, total: None) -> Split:
    """The smallest number of measurements k·r that reaches ``accuracy`` [m]; of equals the smallest k.

    ``configurations`` and ``repetitions`` of the problem are not looked at.

    Raises:
        InfeasibleError: Not reached with ``MOST_MEASUREMENTS``; says what is.
    """
    _check_metric(problem)
    accuracy = check_number("accuracy", accuracy, low=0, low_open=True, unit="m")
    smallest = smallest_size(problem)
    best: Plan | None = None
    tried: list[Plan] = []
    nothing_known = problem.measured is None and problem.model.placement.stated is None
    scales_with_measurements = nothing_known and problem.configuration_sigma == 0 and problem.whole_model is None
    fewest = 0
    for k in _sizes(smallest):
        if k >= smallest + TRIED and best is not None:
            break
        # The least multiple of k not below ``fewest`` may be no fewer than the best number of measurements.
        beaten = best is not None and fewest > 0 and k * -(-fewest // k) >= best.measurements
        candidate = None if beaten else _smallest_repetition(problem, k, accuracy)
        watch(min(k - smallest + 1, TRIED), TRIED)
        if candidate is None:
            continue
        tried.append(candidate)
        if not fewest and scales_with_measurements:
            needed = candidate.measurements * (candidate.quality.value_bound / accuracy) ** 2
            fewest = int(np.ceil(needed * (1 - 1e-9)))
        if best is None or candidate.measurements < best.measurements:
            best = candidate
        if best.measurements <= max(fewest, k):
            break
    if best is None:
        raise _out_of_reach(accuracy, smallest)
    return Split(best, tuple(tried), fewest)


def _out_of_reach(accuracy: float, smallest: int) -> InfeasibleError:
    return InfeasibleError(
        "accuracy",
        f"{accuracy:g} m is not reached by {smallest} to {MOST_CONFIGURATIONS} configurations, each repeated "
        f"up to {MOST_MEASUREMENTS} measurements in all; ask for less, or lower the noise",
    )


def _sizes(smallest: int) -> Iterator[int]:
    """Numbers of configurations to try: every one at first, then ever larger ones."""
    yield from range(smallest, smallest + TRIED)
    k = smallest + TRIED
    while k <= MOST_CONFIGURATIONS:
        yield k
        k = int(np.ceil(1.25 * k))


def _smallest_repetition(problem: PlanProblem, k: int, accuracy: float) -> Plan | None:
    """The plan of k configurations with the fewest repetitions that reaches ``accuracy``."""
    single = replace(problem, configurations=k, repetitions=1)
    once = plan(single)
    if once.quality.value <= accuracy:
        return once
    space = plan_space(single)

    def value(r: int) -> float:
        return value_in(space.repeated(r), once.configurations)

    low, high = 1, MOST_MEASUREMENTS // k
    if not value(high) <= accuracy:
        return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if value(middle) <= accuracy else (middle, high)
    # Configurations chosen for that many repetitions may do with fewer, where σ_c or a prior matters.
    candidate = plan(replace(problem, configurations=k, repetitions=high))
    return candidate if candidate.quality.value <= accuracy else None


def split_budget(
    problem: PlanProblem,
    measurements: int,
    tolerance: float = 0.01,
    watch: Watch = lambda done, total: None,
) -> Split:
    """Divide ``measurements`` = k·r: the smallest k within ``tolerance`` of the best value.

    Fewer configurations mean less moving for nearly the same accuracy.
    """
    _check_metric(problem)
    check_count("measurements", measurements, high=MOST_MEASUREMENTS)
    smallest = smallest_size(problem)
    sizes = [k for k in range(smallest, measurements + 1) if measurements % k == 0]
    if not sizes:
        raise InfeasibleError(
            "measurements", f"{measurements} are too few: at least {smallest} configurations are needed"
        )
    tried = []
    for k in sizes:
        tried.append(plan(replace(problem, configurations=k, repetitions=measurements // k)))
        watch(len(tried), len(sizes))
    best = min(p.quality.value for p in tried)
    chosen = next(p for p in tried if p.quality.value <= best * (1.0 + tolerance))
    return Split(chosen, tuple(tried), 0)


def _check_metric(problem: PlanProblem) -> None:
    if problem.criterion not in POSE_CRITERIA or problem.compound:
        raise InputError("criterion", problem.criterion, "test_pose or worst_pose, the criteria in metres")
    plan_space(replace(problem, configurations=max(problem.configurations, smallest_size(problem))))


# ── time ─────────────────────────────────────────────────────────────────────────────────────────────


def plan_for_time(
    problem: PlanProblem,
    pace: Pace,
    seconds: float,
    start: FloatArray | None = None,
    watch: Watch = lambda done, total: None,
    callback: Callback | None = None,
) -> Split:
    """The best plan that ``seconds`` are enough for: configurations, visits to each, and their order.

    Args:
        problem: The request; its ``configurations`` and ``repetitions`` are not looked at.
        pace: How fast the robot moves, settles and is measured.
        seconds: From the first move to the end of the last measurement [s].
        start: (joints,) where the robot stands before [rad | m]; ``None`` if that is not known.
        watch: Told how many plans are done.
        callback: As for ``plan``, told of each plan; if it cancels, the best so far is returned.

    Raises:
        InfeasibleError: Not even the smallest plan that identifies the parameters fits; says how long it takes.
        InputError: A compound criterion: its value says nothing between plans of unequal size.
    """
    seconds = check_number("time_budget", seconds, low=0, low_open=True, unit="s")
    _check_single(problem)
    smallest = smallest_size(problem)
    shortest, cancelled = np.inf, False

    def attempt(m: int) -> _Attempt | None:
        nonlocal shortest, cancelled
        if cancelled:
            return None
        made = plan(replace(problem, configurations=m, repetitions=1), callback)
        cancelled = made.quality.status == "cancelled"
        tour = _Tour.of(problem, made, pace, start)
        shortest = min(shortest, tour.seconds(tour.once))
        if tour.seconds(tour.once) > seconds:
            return None
        return _Attempt(made, tour, tour.filled(seconds))

    largest = _largest_size(problem, smallest)
    first = _most_that_fit(problem, pace, seconds, start, (smallest, largest))
    best, tried = _best_size(attempt, (_steps(first, smallest), _steps(first, largest)), watch)
    if best is None:
        raise InfeasibleError(
            "time_budget",
            f"{seconds:g} s are too short: {smallest} configurations are needed, which take about "
            f"{shortest:.0f} s; allow more time, raise the speed, or shorten settling and measuring",
        )
    # Of plans that differ less than a search sees, the one with the fewest configurations to set up.
    best = next(each for each in tried if each.merit >= best.merit - GOOD_ENOUGH)
    return _split(problem, best, tried)


def plan_for_accuracy_in_time(
    problem: PlanProblem,
    accuracy: float,
    pace: Pace,
    start: FloatArray | None = None,
    watch: Watch = lambda done, total: None,
) -> Split:
    """The plan that reaches ``accuracy`` [m] in the least time; arguments as of ``plan_for_time``.

    Raises:
        InfeasibleError: Not reached with ``MOST_MEASUREMENTS``.
    """
    _check_metric(problem)
    accuracy = check_number("accuracy", accuracy, low=0, low_open=True, unit="m")

    def attempt(m: int) -> _Attempt | None:
        made = plan(replace(problem, configurations=m, repetitions=1))
        tour = _Tour.of(problem, made, pace, start)
        counts = tour.enough(accuracy)
        return None if counts is None else _Attempt(made, tour, counts, by_time=True)

    smallest = smallest_size(problem)
    best, tried = _best_size(attempt, (_steps(smallest, _largest_size(problem, smallest)),), watch)
    if best is None:
        raise _out_of_reach(accuracy, smallest)
    return _split(problem, best, tried)


@dataclass(frozen=True, eq=False)
class _Tour:
    """A plan's configurations in an order of little time, of which each may be visited again and again.

    Attributes:
        spaces: The problem for m configurations, and for robots that err less and more.
        configurations: (m, joints) in the order of visiting [rad | m].
        pace, start: As in ``plan_for_time``.
    """

    spaces: tuple[PlanSpace, ...]
    configurations: FloatArray
    pace: Pace
    start: FloatArray | None

    @staticmethod
    def of(problem: PlanProblem, made: Plan, pace: Pace, start: FloatArray | None) -> _Tour:
        """The tour of a plan that was made for the problem."""
        q = made.configurations
        sized = replace(problem, configurations=len(q), repetitions=1)
        order = visiting_order(q, problem.robot, pace, start)
        space = plan_space(sized)
        return _Tour((space, *spread_spaces(space)), q[order], pace, start)

    @property
    def once(self) -> IntArray:
        """(m,) ones: one visit to each configuration."""
        return np.ones(len(self.configurations), np.int64)

    def timetable(self, counts: IntArray) -> Timetable:
        """When the robot is where with ``counts`` (m,) visits."""
        robot = self.spaces[0].problem.robot
        return visit_times(robot, self.configurations, counts, self.pace, self.start)

    def seconds(self, counts: IntArray) -> float:
        """The time that it takes [s]."""
        return self.timetable(counts).seconds

    def filled(self, seconds: float) -> IntArray:
        """(m,) visits, at least one each, that are best within ``seconds``, which are enough for one each."""
        counts = self.once
        spare = seconds - self.seconds(counts)
        each = self.seconds(counts + 1) - self.seconds(counts)
        most = min(int(spare / (each / len(counts))), MOST_MEASUREMENTS)
        counts = self._given_away(counts, most)
        # The way back to a configuration at the edge of a range may be a little longer than the mean.
        while self.seconds(counts) > seconds and counts.max() > 1:
            gains = np.where(counts > 1, self._gains(np.maximum(counts - 1, 1)), np.inf)
            counts[int(np.argmin(gains))] -= 1
        return counts

    def enough(self, accuracy: float) -> IntArray | None:
        """(m,) visits, few of them, that reach ``accuracy`` [m]; ``None`` if ``MOST_MEASUREMENTS`` do not."""
        low, high = 0, MOST_MEASUREMENTS - len(self.configurations)

        def reached(extra: int) -> bool:
            return self._accuracy(self._given_away(self.once, extra)) <= accuracy

        if reached(0):
            return self.once
        if not reached(high):
            return None
        # Doubling first: the number is small more often than not, and a large one costs more to try.
        step = 1
        while step < high and not reached(step):
            low, step = step, 2 * step
        high = min(step, high)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if reached(middle) else (middle, high)
        return self._given_away(self.once, high)

    def log_value(self, counts: IntArray) -> float:
        """log Ψ of what the search maximises, the mean over ``spaces``."""
        values = [self._psi(space, space.search_criterion(), counts) for space in self.spaces]
        return float(np.mean(np.log(np.maximum(values, 1e-300))))

    def _accuracy(self, counts: IntArray) -> float:
        space = self.spaces[0]
        psi = self._psi(space, space.criterion(space.problem.criterion), counts)
        return reported_value(space.problem.criterion, psi, len(space.interest), int(counts.sum()))

    def _psi(self, space: PlanSpace, criterion: Criterion, counts: IntArray) -> float:
        """Ψ as ``plan`` reports it."""
        return psi_of(space.repeated(counts), criterion, self.configurations)

    def _given_away(self, counts: IntArray, extra: int) -> IntArray:
        """``extra`` visits more, each where it tells most."""
        counts = counts.copy()
        while extra > 0:
            best = np.argsort(-self._gains(counts), kind="stable")[
                : max(min(extra // PORTION, len(counts) // 4), 1)
            ]
            # At most as many as there are, or what looks good at first would get too many.
            more = np.clip(extra // (PORTION * len(best)), 1, counts[best])
            counts[best] += more
            extra -= int(more.sum())
        return counts

    def _gains(self, counts: IntArray) -> FloatArray:
        """(m,) rise of log Ψ by one visit more to each, to first order, the mean over ``spaces``."""
        return np.mean([_gains(s, self.configurations, counts) for s in self.spaces], axis=0)


def _gains(space: PlanSpace, q: FloatArray, counts: IntArray) -> FloatArray:
    """(m,) tr(G ΔM_i)/Ψ of one visit more to each of ``q`` (m, joints), which has ``counts`` (m,)."""
    now, then = (replace(space.model, repetitions=r) for r in (counts, counts + 1))
    total = ridged(now.totals(q, len(q)) + space.prior)
    psi, gradient = space.search_criterion().value_and_gradient(total)
    if not (isinstance(now, ExtendedModel) and isinstance(then, ExtendedModel)):
        added = then.at(q) - now.at(q)
        return np.asarray(np.einsum("ab,nab->n", gradient[0], added) / psi[0])
    # ΔM = XᵀV⁻¹ (R/r − R/(r+1)) V⁻¹X to first order.
    info = now.linearised(q)
    solved = info.solved(len(q)).reshape(len(q), -1, info.jacobian.shape[2])
    z = solved @ gradient[0] @ np.swapaxes(solved, 1, 2)
    joints = (now.visit_variance - then.visit_variance)[:, None, None]
    less = info.points - then.linearised(q).points + joints * (info.levers @ np.swapaxes(info.levers, 1, 2))
    return np.asarray(np.einsum("nij,nij->n", z, less) / psi[0])


@dataclass(frozen=True, eq=False)
class _Attempt:
    """A plan with its tour and visits; the better the larger log Ψ is or, ``by_time``, the shorter it is."""

    made: Plan
    tour: _Tour
    counts: IntArray
    by_time: bool = False

    @cached_property
    def merit(self) -> float:
        """What is to be large."""
        if self.by_time:
            return -float(np.log(self.tour.seconds(self.counts)))
        return self.tour.log_value(self.counts)


def _best_size(
    attempt: Callable[[int], _Attempt | None], ways: Sequence[list[int]], watch: Watch
) -> tuple[_Attempt | None, list[_Attempt]]:
    """The best number of configurations, and all that came to something.

    Args:
        attempt: The best with so many configurations; ``None`` if there is nothing.
        ways: What to try, in this order, until it has become worse twice, or clearly, or nothing comes of it; all
            begin with the same number, and a further one is tried only if something came of that and it is
            still the best.
        watch: Told how many are done.
    """
    known: dict[int, tuple[float, _Attempt | None]] = {}

    def merit(m: int) -> float:
        if m not in known:
            made = attempt(m)
            known[m] = (-np.inf if made is None else made.merit, made)
            watch(len(known), max(len(known) + 1, 6))
        return known[m][0]

    def clear(m: int) -> float:
        made = known[m][1]
        assert made is not None
        return CLEAR + 2.0 / float(made.counts.sum())  # only whole visits fit: one more or less may be chance

    best = first = ways[0][0]
    for number, sizes in enumerate(ways):
        worse = 0
        if number and (best != first or not np.isfinite(merit(first))):
            break
        for m in sizes:
            nothing = not np.isfinite(merit(m))
            if merit(m) > merit(best):
                best, worse = m, 0
            elif m != best and np.isfinite(merit(best)):
                worse += 2 if nothing or merit(m) < merit(best) - clear(best) else 1
            if worse >= 2:
                break
    while True:
        before, around = best, sorted(known)
        place = around.index(best)
        for low, high in pairwise(around[max(place - 1, 0) : place + 2]):
            middle = round(float(np.sqrt(low * high)))
            if high > CLOSE * low and merit(middle) > merit(best):
                best = middle
        if best == before:
            break
    tried = [made for _, (_, made) in sorted(known.items()) if made is not None]
    return known[best][1], tried


def _steps(first: int, last: int) -> list[int]:
    """Whole numbers from ``first`` to ``last``, up or down by a factor of about ``STEP``."""
    result = [first]
    while (here := result[-1]) != last:
        up = last > here
        step = max(here + 1, round(here * STEP)) if up else min(here - 1, round(here / STEP))
        result.append(min(step, last) if up else max(step, last))
    return result


def _largest_size(problem: PlanProblem, smallest: int) -> int:
    """The largest number of configurations that is tried."""
    most = MOST_CONFIGURATIONS
    if problem.candidate_array is not None and problem.once_each:
        most = min(most, len(problem.candidate_array))
    return max(most, smallest)


def _most_that_fit(
    problem: PlanProblem, pace: Pace, seconds: float, start: FloatArray | None, sizes: tuple[int, int]
) -> int:
    """About how many configurations fit, between two sizes: as many as of random ones."""
    low, high = sizes
    space, rng = plan_space(replace(problem, configurations=low)), np.random.default_rng(0)
    candidates = problem.candidate_array
    q = space.feasibility.sample(rng, high) if candidates is None else rng.choice(candidates, high)

    def fits(m: int) -> bool:
        order = visiting_order(q[:m], problem.robot, pace, start)
        return visit_times(problem.robot, q[:m][order], 1, pace, start).seconds <= seconds

    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low


def _split(problem: PlanProblem, best: _Attempt, tried: list[_Attempt]) -> Split:
    """The answer; the best plan alone gets a bound, which the others need not wait for."""
    plans = [judged(problem, a.tour.configurations, a.counts, a.made, bounded=a is best) for a in tried]
    seconds = tuple(a.tour.seconds(a.counts) for a in tried)
    return Split(plans[tried.index(best)], tuple(plans), 0, best.tour.timetable(best.counts), seconds)


def _check_single(problem: PlanProblem) -> None:
    if problem.compound:
        raise InputError(
            "compound", dict(problem.compound), "a single criterion", "give --configurations instead"
        )
