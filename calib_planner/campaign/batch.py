"""The next batch of measurements; see ``decision``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.campaign.findings import OPEN, Finding, different, forecast, ready, round_of
from calib_planner.campaign.problem import AwayFrom, distances
from calib_planner.campaign.state import FIT, CampaignState, Decision, Stop
from calib_planner.errors import InfeasibleError
from calib_planner.identification import FEWEST_SPARE
from calib_planner.planning import (
    Candidates,
    Feasibility,
    PlanPrior,
    PlanProblem,
    Search,
    plan,
    plan_space,
    smallest_size,
    visiting_order,
)

REPEATED = 4
"""Configurations of the first batch measured twice: 12 degrees of freedom for the noise of one target."""
POOL = 500
"""Candidates for a plan with discrepancy."""


def next_batch(state: CampaignState, found: Finding | None, stopped: Callable[[], bool]) -> Decision:
    problem = state.problem
    allowed = problem.fit_budget - state.spent(FIT)
    if found is not None and found.scatter == OPEN and (again := _to_repeat(state, min(problem.batch, allowed))):
        text = "more scatter than the instrument's: measuring again tells whether it is noise or the robot"
        queue = toured(state, np.array([state.stops[i].q for i in again]), again)
        times = tuple((i, 1) for i in again)
        return Decision(FIT, text, again=times, queue=queue, round=round_of(state, found, len(again), text),
                        left=_left(state, found, allowed))  # fmt: skip
    request = plan_problem(state, found)
    size, repeated = _size(state, found, request, allowed)
    made = plan(_sized(request, size, state, found), lambda progress: stopped())
    q = made.configurations
    first = len(state.stops)
    queue = toured(state, q, tuple(range(first, first + len(q))))
    twice = _spread(queue, min(repeated, allowed - len(q)))
    stops = tuple(Stop(row, FIT, 1 + (first + k in twice)) for k, row in enumerate(q))
    left = _left(state, found, allowed)
    if found is None and np.isfinite(made.quality.predicted_accuracy):
        share = max(made.quality.predicted_accuracy / problem.required_accuracy, 0.0) ** 2
        left = max(float(np.ceil(len(q) * share)), float(len(q) + len(twice)))
    total = len(queue) + len(twice)
    text = f"{total} measurements planned"
    made_round = round_of(state, found, total, text)
    return Decision(FIT, text, stops, (), (*queue, *reversed(twice)), round=made_round, left=left)


def plan_problem(state: CampaignState, found: Finding | None) -> PlanProblem:
    """What the planner is asked, but for the number of configurations."""
    problem = state.problem
    constraints = problem.constraints
    if state.exclusions:
        constraints = (*constraints, AwayFrom(state.exclusions, state.scale))
    prior = problem.identification.get("prior")
    std = {} if prior is None else dict(zip(prior.names, np.sqrt(np.diag(prior.covariance)), strict=True))
    poses = problem.test_pose_array
    return PlanProblem(
        problem.robot if found is None else found.estimate.calibrated,
        poses,
        1,
        noise=problem.instrument if found is None else found.noise,
        criterion="test_pose" if len(poses) == 1 else "worst_pose",
        constraints=constraints,
        prior=PlanPrior(std=std, measured=None if found is None else found.used),
        search=Search(
            starts=problem.starts, seed=problem.seed + len(state.rounds), time_limit=problem.time_limit
        ),
    )


def _size(state: CampaignState, found: Finding | None, request: PlanProblem, allowed: int) -> tuple[int, int]:
    """Configurations to plan, and how many of them to measure twice.

    Raises:
        InfeasibleError: The budget does not allow what identification needs.
    """
    problem = state.problem
    if found is not None and ready(state, found):
        return int(np.clip(forecast(found, problem.required_accuracy), 1, min(problem.batch, allowed))), 0
    least = smallest_size(request)
    space = plan_space(replace(request, configurations=max(least, 1)))
    apart = None if found is None else different(found.used)
    have, seen = (0, 0) if apart is None else (len(apart), int(apart.seen.sum()))
    wanted = -(-(len(space.robot.parameter_names) + FEWEST_SPARE) // 3) - seen
    size = max(least, problem.minimum - have, -(-wanted // len(problem.robot.targets)), 1)
    if size > allowed:
        text = f"{allowed} measurements are left for the fit, {size} at least are needed to judge it: raise it"
        raise InfeasibleError("budget", text)
    return size, REPEATED if found is None else 0


def _sized(request: PlanProblem, size: int, state: CampaignState, found: Finding | None) -> PlanProblem:
    """The request for ``size`` configurations, from candidates where the robot has a discrepancy."""
    discrepancy = None if found is None else found.discrepancy
    if discrepancy is None:
        return replace(request, configurations=size)
    rng = np.random.default_rng([state.problem.seed, len(state.rounds), 3])
    pool = Feasibility(request.robot, request.constraints).sample(rng, POOL)
    return replace(
        request, configurations=size, criterion="test_pose", candidates=Candidates(pool), discrepancy=discrepancy
    )


def _to_repeat(state: CampaignState, count: int) -> tuple[int, ...]:
    """Stops to measure again: those measured fewest times, first those measured last."""
    rows = state.of_role(FIT)
    times = {i: sum(r.index == i for r in rows) for i in {r.index for r in rows} - set(state.dropped)}
    return tuple(sorted(times, key=lambda i: (times[i], -i))[:count])


def toured(state: CampaignState, q: FloatArray, numbers: tuple[int, ...]) -> tuple[int, ...]:
    """``numbers`` of the configurations ``q`` in an order of short travel, begun at the end nearer the robot."""
    tour = [numbers[k] for k in visiting_order(q, state.problem.robot)]
    if state.rows:
        here = state.rows[-1].q
        ends = [np.abs((q[numbers.index(tour[k])] - here) * state.scale).max() for k in (0, -1)]
        tour = tour if ends[0] <= ends[1] else tour[::-1]
    return tuple(tour)


def _spread(queue: tuple[int, ...], count: int) -> tuple[int, ...]:
    """``count`` of the visits, spread evenly over the tour."""
    rows = np.unique(np.linspace(0, len(queue) - 1, max(min(count, len(queue)), 0)).round().astype(int))
    return tuple(queue[k] for k in rows)


def _left(state: CampaignState, found: Finding | None, allowed: int) -> float:
    return float("nan") if found is None else forecast(found, state.problem.required_accuracy)


# ── Where to validate: at the test poses, near them, and anywhere else, apart from what was measured for the
# What the user wants to know is the error where the robot will work, so the test poses come first, as far as they
# can be measured themselves; up to half of the configurations lie near them; the others are spread over all that
# can be measured, which shows a model that holds near the test poses only. Each is as far as can be from all that
# were measured and from the other validation configurations (farthest-point selection): next to a measured one
# any model predicts well.

NEAR = 0.1
"""Half width of the neighbourhood of a test pose, as a share of each joint's range."""
APART = 0.02
"""Least distance from what was measured, as a share of the joints' ranges; a test pose keeps to it, too."""
DRAWN = 600
"""Configurations to choose from, near and anywhere."""


def validation_poses(
    allowed: Feasibility,
    test_poses: FloatArray,
    taken: FloatArray,
    scale: FloatArray,
    count: int,
    rng: np.random.Generator,
) -> FloatArray:
    """(count, joints) configurations, or fewer where there is no room for more.

    Args:
        allowed: What can be measured.
        test_poses: (K, joints) [rad | m].
        taken: (N, joints) measured before, for fit or validation.
        scale: (joints,) see ``exclusion.joint_scale``.
        count: How many.

    Raises:
        InfeasibleError: Nothing can be measured at all.
    """
    low, high = allowed.limits.T
    step = NEAR * (high - low)
    centre = test_poses[rng.integers(len(test_poses), size=DRAWN)]
    near = np.clip(centre + rng.uniform(-1.0, 1.0, centre.shape) * step, low, high)
    itself = test_poses[((low <= test_poses) & (test_poses <= high)).all(axis=1)]
    pools = [p[allowed.mask(p)] for p in (itself, near)]
    half = (count + 1) // 2
    chosen = _farthest(pools[0], taken, scale, half)
    chosen = np.vstack([chosen, _farthest(pools[1], np.vstack([taken, chosen]), scale, half - len(chosen))])
    anywhere = allowed.sample(rng, DRAWN)
    return np.vstack([chosen, _farthest(anywhere, np.vstack([taken, chosen]), scale, count - len(chosen))])


def _farthest(pool: FloatArray, taken: FloatArray, scale: FloatArray, count: int) -> FloatArray:
    """Up to ``count`` rows of ``pool``, each the farthest from ``taken`` and those before."""
    apart = np.full(len(pool), np.inf)
    for q in taken:
        apart = np.minimum(apart, distances(pool, q, scale))
    rows: list[int] = []
    while len(rows) < count and len(pool):
        best = int(np.argmax(apart))
        if apart[best] < APART:
            break
        rows.append(best)
        apart = np.minimum(apart, distances(pool, pool[best], scale))
    return pool[rows]
