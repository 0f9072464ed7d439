# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Does one single change to what was assumed explain the measurements far better? One table of such changes.

An *alternative* is a change of one assumption: the tracker stood still, the points are in metres, joint 4
counts in its usual direction. Each is tried, the one that explains the data best is named with its evidence,
what it does to predictions at the test poses, and what to do. There are two regimes.

*Fine*: the error model fits, and an alternative adds a few columns C to its linear problem (``likelihood``).
With its P and y the amounts a of these columns, their evidence and its probability are

    G = CᵀPC ,   b = CᵀPy ,   â = G⁻¹ b ,   S = bᵀ G⁻¹ b ,                                                     (1)
    F = (S/d) / ((yᵀPy − S)/(ν − d)) ~ F(d, ν − d)   if nothing is wrong,                                      (2)

d being the rank of G and ν the measured coordinates less the rank of the flat columns. The F ratio needs no
level of noise, so that a noise stated too small is no drift. For all cuts k (columns that are zero before visit
k) G and b are sums over the visits k, k + 1, …, had at once. The scales of the error model were estimated
without C and may have grown to hold what C explains: S is also tried with every scale no larger than a robot of
the usual kind has. What looks suspicious is then fitted in full: the columns enter as flat ones, the scales are
estimated anew, and the left-out score must rise (M4). Points that have lost their weight get it back if the
columns explain them.

*Gross*: what is assumed is so wrong that the fit fails or leaves far more than an industrial robot errs by.
Base and targets are placed in closed form (``registration``) for every change, robustly, the zeros of the
joints are fitted with them for the best few, and what is left decides.

Wherever several alternatives explain the same thing the one with the best score is named. *Materiality* is how
far the predictions at the test poses move if the alternative becomes part of the model, in metres and in
predicted standard deviations: what moves nothing is a note, whatever its evidence.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.error_model import ZERO, Poses, joint_units, without_rigid_motion
from calib_planner.errors import InputError, NotEnoughDataError
from calib_planner.identification.doubt import FEWEST, impossible, part_of, shifted_run
from calib_planner.identification.estimation import ENOUGH, ModelEstimate
from calib_planner.identification.left_out import left_out
from calib_planner.identification.likelihood import (
    UNBOUNDED,
    CoefficientSolution,
    DenseSolution,
    LinearProblem,
    Solution,
    UpdatedSolution,
    maximise,
    solve,
)
from calib_planner.identification.registration import place_points, tip_poses
from calib_planner.measurements import Measurements
from calib_planner.robot import BASE_PARAMETERS, Coupling, Robot, is_nuisance, target_parameters
from calib_planner.units import SPELLINGS, counted, length, listed, milliradians

BoolArray = NDArray[np.bool_]

SIGNIFICANT = 1e-4
"""Probability that any one of all questions is answered yes by chance, after counting them."""
SUSPICIOUS = 1e-2
"""The same from which on an alternative is fitted in full."""
MATERIAL = 1.0
"""Predicted standard deviations: a prediction that moves by less errs no more than was promised."""
MOST_CUTS, FEW_CUTS = 150, 40
"""Cuts between visits that are tried at once, and the same for more than twice ``ENOUGH`` coordinates; the
neighbourhood of the best is tried anew. Of so many no run of visits is looked for, scales are those of the
estimate, and one alternative is named."""
MOST_FITS, FEW_FITS = 5, 2
"""Suspicious alternatives that are fitted in full, the most suspicious ones; and the same for so many."""
MOST_FINDINGS = 3
"""Alternatives that are named."""
ABSORBED = 1e-9
"""A combination of columns of which the model leaves less than this share of the square is the model's own."""
SWOLLEN = 1.5
"""A scale this many times its usual upper end is tried at that end too."""
SPARE = 6
"""Degrees of freedom that must be left beside an alternative."""
MOSTLY = 0.6
"""Share of doubted points among five neighbours in time from which on they are a run."""
DOUBT_ROUNDS = 3
"""Most rounds in which doubts come and go when an alternative is fitted in full."""
SCALE_ROUNDS = 6
"""Most steps of the scales in each of them."""
REACH = 5.0
"""Predicted errors within which a point belongs to another row or target."""
MOST_POSES = 20
"""Measured configurations at which predictions are compared if there is no test pose."""


# ── the table ────────────────────────────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class Row:
    """One alternative of the table.

    Attributes:
        code: Short name.
        kind: ``fine``, ``gross`` or ``both``.
        tried: What is tried, in words.
        text: What happened; the braces are filled.
        advice: What to do; the braces are filled.
    """

    code: str
    kind: str
    tried: str
    text: str
    advice: str


TABLE = {
    row.code: row
    for row in (
        Row(
            "push",
            "fine",
            "the tracker or the robot's base moved before one of the visits",
            "the tracker or the robot's base moved by {size} before row {row}",
            "measure the rows before row {row} again, or identify with the larger part of the rows alone",
        ),
        Row(
            "drift",
            "fine",
            "the tracker or the robot's base crept steadily from the first visit to the last",
            "the tracker or the robot's base crept by {size} from the first row to the last",
            "let tracker and robot warm up, fix the tripod, and measure again in a shuffled order",
        ),
        Row(
            "reseat",
            "fine",
            "a target was seated elsewhere before one of the visits",
            "target {target} sits {size} elsewhere from row {row} on",
            "seat the target as before and measure these rows again, or leave out the smaller part of them",
        ),
        Row(
            "tool",
            "fine",
            "all targets together were mounted anew before one of the visits",
            "the targets were mounted anew before row {row}: all sit about {size} elsewhere",
            "mount them as before and measure these rows again, or identify with the larger part of the rows",
        ),
        Row(
            "block",
            "fine",
            "all points of a run of visits are shifted alike",
            "the points of rows {rows} are all shifted by {size}",
            "something was moved and put back: measure these rows again",
        ),
        Row(
            "joint_step",
            "fine",
            "the zero of one joint changed before one of the visits",
            "the zero of {joint} changed by {size} before row {row}",
            "look for a slipping gear, encoder or brake of {joint}, and measure the rows before it again",
        ),
        Row(
            "scale",
            "both",
            "all distances are wrong by one factor",
            "all distances are {size} times what they should be",
            "check the tracker's compensation of the air and the scale of the points, then measure again",
        ),
        Row(
            "mirror",
            "gross",
            "the frame of the points is left-handed",
            "the points are mirrored: their frame is left-handed",
            "change the sign of one coordinate of all points, or exchange the two that were exchanged",
        ),
        Row(
            "units",
            "gross",
            "the points are in mm, cm, inches or feet; joint angles are in degrees",
            "{size}",
            "{advice}",
        ),
        Row(
            "sign",
            "gross",
            "one joint runs the other way",
            "{joint} runs the other way than in the robot model",
            "change the sign of the column {joint} in the data, or of its axis in the robot file",
        ),
        Row(
            "signs",
            "gross",
            "every joint runs the other way",
            "every joint runs the other way than in the robot model",
            "change the sign of all joint columns in the data, or of all axes in the robot file",
        ),
        Row(
            "zero",
            "gross",
            "the zero of one joint is off by a multiple of 90 degrees",
            "the zero of {joint} is {size} degrees away from that of the robot model",
            "add {size} degrees to the column {joint} in the data, or change its zero in the robot file",
        ),
        Row(
            "ratio",
            "both",
            "the gear ratio of one joint is wrong",
            "{joint} turns {size} times as far as it shows: a wrong gear ratio",
            "correct the gear ratio of {joint} in the controller, or multiply its column in the data by {size}",
        ),
        Row(
            "couple",
            "both",
            "one joint is shown, or driven, together with another one",
            "{joint} is coupled to {beside}: it stands at {joint} {size} {beside}",
            "{first}add --couple {option} if the controller shows it so; otherwise replace the column {joint} "
            "of the data by {joint} {size} {beside}",
        ),
        Row(
            "columns",
            "gross",
            "the columns of two joints are exchanged",
            "the columns of {joint} and {beside} are exchanged",
            "exchange the names of the columns {joint} and {beside} in the data",
        ),
        Row(
            "targets",
            "both",
            "the points of targets are exchanged",
            "the points of targets {size} are exchanged{where}",
            "exchange their columns in the data{where}",
        ),
        Row(
            "rows",
            "both",
            "points belong to another row",
            "{size}",
            "move the points to the rows they belong to, or leave these rows out",
        ),
        Row(
            "setup",
            "gross",
            "base or targets are not where the robot model has them",
            "the {size} not where the robot model has {them}",
            "add --unknown {option}",
        ),
        Row(
            "prior",
            "fine",
            "what is known of the parameters beforehand is too narrow",
            "{size} three prior standard deviations or more away from what was expected, {parameter} most of all",
            "widen the prior, or correct the robot model there",
        ),
    )
}


@dataclass(frozen=True)
class Alternative:
    """One change to what was assumed that explains the measurements better.

    Attributes:
        code: Its row of ``TABLE``.
        text: What happened, a sentence without its full stop.
        advice: What to do about it.
        size: How large it is [unit].
        unit: ``m``, ``rad``, ``deg`` or 1.
        row: First row that it concerns, from 0, or ``None``.
        target: Target from 1, or ``None``.
        joint: Joint, or ``None``.
        beside: The other joint of a pair, or ``None``.
        rows: Rows that it concerns where these are some of all, from 0.
        gain: By how much the left-out log score rises; gross: half of what −2 log likelihood falls by.
        statistic: F of (2); gross: by which factor the residuals fall.
        freedom: d of (2).
        probability: Of as clear a sign by chance, all that was tried being counted.
        moved: Largest distance by which a prediction at the test poses moves [m].
        deviations: The same in predicted standard deviations.
        material: Whether that is more than was promised.
        parameter: The parameter that it concerns, or ``None``.
    """

    code: str
    text: str
    advice: str
    size: float
    unit: str
    row: int | None = None
    target: int | None = None
    joint: str | None = None
    beside: str | None = None
    rows: tuple[int, ...] = ()
    gain: float = 0.0
    statistic: float = 0.0
    freedom: int = 0
    probability: float = 0.0
    moved: float = 0.0
    deviations: float = 0.0
    material: bool = False
    parameter: str | None = None


def _named(code: str, size: float, unit: str, words: dict[str, Any], **more: Any) -> Alternative:
    """An alternative in the words of its row."""
    row = TABLE[code]
    told = {k: v for k, v in more.items() if k in ("row", "target", "joint", "beside")} | {"first": ""} | words
    return Alternative(code, row.text.format(**told), row.advice.format(**told), float(size), unit, **more)


# ── fine: columns beside the error model ─────────────────────────────────────────────────────────────


@dataclass(frozen=True, eq=False)
class _Question:
    """Columns of one alternative.

    Attributes:
        code: Row of the table.
        columns: (N, m, d) what its amounts move the points by.
        there: (K, targets, 3, d) the same at the test poses, as they are after the last visit.
        cut: Whether it begins before one of the visits.
        row: That visit, once it is decided.
        target, joint, beside, parameter: What it concerns; targets and joints from 0.
        rows: Visits that it concerns where these are a run.
        whole: (N, m, d) the columns from the first visit on, once the visit is decided.
    """

    code: str
    columns: FloatArray
    there: FloatArray
    cut: bool = False
    row: int | None = None
    target: int | None = None
    joint: int | None = None
    beside: int | None = None
    parameter: str | None = None
    rows: tuple[int, ...] = ()
    whole: FloatArray | None = None

    def at(self, row: int) -> _Question:
        """With the visit before which it began."""
        whole = self.columns if self.whole is None else self.whole
        columns = whole * (np.arange(len(whole)) >= row)[:, None, None]
        return replace(self, columns=columns, whole=whole, row=row, cut=False)


@dataclass(frozen=True, eq=False)
class _Answer:
    """How suspicious a question is.

    Attributes:
        question: With the visit before which it began.
        statistic, freedom: F of (2) and d.
        probability: Of as large an F by chance, this question alone.
        count: Questions that were tried.
    """

    question: _Question
    statistic: float
    freedom: int
    probability: float
    count: float

    @property
    def counted(self) -> float:
        """The probability of one such answer among all."""
        return min(1.0, self.probability * self.count)


class _WidenedProblem(LinearProblem):
    """A linear problem whose last columns, beyond those of the model, are flat as well."""

    @cached_property
    def flat(self) -> IntArray:
        own = self.model.variances(self.robot)
        return np.append(np.flatnonzero(np.isinf(own)), np.arange(len(own), self.columns.shape[2]))


def _widened(problem: LinearProblem, columns: FloatArray) -> _WidenedProblem:
    """``problem`` with flat ``columns`` (N, m, d) more."""
    both = np.concatenate([problem.columns, columns * problem.seen[:, :, None]], axis=2)
    return _WidenedProblem(
        problem.robot, problem.model, problem.y, both, problem.parts, problem.seen, problem.poses
    )


def find_alternatives(
    robot: Robot,
    data: Measurements,
    fitted: ModelEstimate,
    test_poses: FloatArray | None = None,
    accuracy_frame: str = "world",
) -> tuple[Alternative, ...]:
    """The alternatives that explain the measurements better than the error model alone, the best first.

    None if the fit leaves more than any robot errs by: then only ``explain_gross`` may know.

    Args:
        robot: Nominal; names joints and targets.
        data: What ``fitted`` was estimated from, in the order of measuring.
        fitted: The estimate.
        test_poses: (K, joints) where predictions matter [rad | m]; ``None`` or none: the measured ones.
        accuracy_frame: ``world``, or ``robot``: a common motion of all predictions does not matter.
    """
    data = data.in_order_of(robot.joint_names)
    if len(data) < 2 * FEWEST:
        return ()
    fine = _Fine(data, fitted, test_poses, accuracy_frame)
    if fitted.left_out.rms > SOUND * _spread(fine.here.points):
        return ()
    return tuple(fine.findings())


class _Fine:
    """The questions to one estimate, and their answers."""

    def __init__(
        self, data: Measurements, fitted: ModelEstimate, test_poses: FloatArray | None, accuracy_frame: str
    ) -> None:
        self.data, self.fitted, self.frame = data, fitted, accuracy_frame
        known = fitted.knowledge
        if test_poses is None or not len(test_poses):
            chosen = np.unique(np.linspace(0, len(data) - 1, MOST_POSES).astype(int))
            test_poses = data.q[chosen]
        self.poses = np.asarray(test_poses)
        names = fitted.solution.problem.robot.parameter_names
        self.here = self._thin(known.poses(data.q, data.payload), names)
        self.there = self._thin(known.poses(self.poses), names)
        seen = data.seen
        self.centre = self.here.points[seen].mean(axis=0)
        self.problem = fitted.solution.problem

    @staticmethod
    def _thin(poses: Poses, names: tuple[str, ...]) -> Poses:
        """``poses`` with the parameters of the linear problem alone."""
        if poses.robot.parameter_names == names:
            return poses
        return replace(poses, robot=replace(poses.robot, parameter_names=names))

    # ── the questions ────────────────────────────────────────────────────────────────────────────────

    def questions(self, solution: Solution) -> Iterator[_Question]:
        """Every fine row of the table."""
        yield from self._standing
        yield from self._runs(solution)
        yield from self._priors(solution)

    @property
    def _many(self) -> bool:
        """Whether the scales of the estimate come from some of the visits alone."""
        return self.problem.y.size > 2 * ENOUGH

    @cached_property
    def _stations(self) -> list[FloatArray]:
        """Columns of a motion of the station, here and at the test poses."""
        return [_station(p.points, self.centre) for p in (self.here, self.there)]

    @cached_property
    def _standing(self) -> tuple[_Question, ...]:
        """The questions that are the same for every solution."""
        return tuple(self._motions()) + tuple(self._joints(self.here, self.there, len(self.here.robot.targets)))

    def _motions(self) -> Iterator[_Question]:
        """What moves the station, the targets, or all distances."""
        here, there, n = self.here, self.there, len(self.data)
        targets, station = len(here.robot.targets), self._stations
        yield _Question("push", station[0], _split(station[1], targets), cut=True)
        order = np.linspace(0.0, 1.0, n)[:, None, None]
        yield _Question("drift", station[0] * order, _split(station[1], targets))
        tips = [tip_poses(p.robot, p.actual, at_base=False) for p in (here, there)]
        for t in range(targets):
            pair = [_at_target(r, t, targets) for r, _ in tips]
            yield _Question("reseat", pair[0], _split(pair[1], targets), cut=True, target=t)
        if targets > 1:
            pair = [_tool(p.points, *tip) for p, tip in zip((here, there), tips, strict=True)]
            yield _Question("tool", pair[0], _split(pair[1], targets), cut=True)
        radial = here.points.reshape(n, -1, 1)
        yield _Question("scale", radial, np.zeros((len(there), targets, 3, 1)))

    def _joints(self, here: Poses, there: Poses, targets: int) -> Iterator[_Question]:
        """Steps of a joint's zero, gear ratios, couplings."""
        units = joint_units(here.robot)
        turns = here.robot.joint_is_revolute
        moving = np.ptp(here.q, axis=0) > 1e-6
        levers = [_split(p.levers, targets) for p in (here, there)]
        flat = here.levers
        for j in np.flatnonzero(moving).tolist():
            yield _Question("joint_step", flat[:, :, [j]], levers[1][..., [j]], cut=True, joint=j)
            for k in np.flatnonzero(moving).tolist():
                if k != j and turns[j] != turns[k]:
                    continue
                code = "ratio" if k == j else "couple"
                # Amounts are ratios: what joint j moves per unit of joint k.
                columns = flat[:, :, [j]] * (here.q[:, k] / units[j])[:, None, None]
                other = levers[1][..., [j]] * (there.q[:, k] / units[j])[:, None, None, None]
                yield _Question(code, columns, other, joint=j, beside=None if k == j else k)

    def _runs(self, solution: Solution) -> Iterator[_Question]:
        """The most suspicious run of visits."""
        station, run = self._stations, None if self._many else shifted_run(solution)
        if run is None:
            return
        first, last = int(run[0]), int(run[-1]) + 1
        if first == 0 or last == len(self.data):  # a push that turned nothing
            columns, row = station[0][:, :, :3], last if first == 0 else first
            there = _split(station[1], len(self.here.robot.targets))[..., :3]
            yield _Question("push", columns, there).at(row)
            return
        inside = np.zeros(len(self.data), bool)
        inside[run] = True
        columns = station[0][:, :, :3] * inside[:, None, None]
        there = np.zeros((len(self.there), len(self.here.robot.targets), 3, 3))
        yield _Question("block", columns, there, row=int(run[0]), rows=tuple(int(i) for i in run))

    def _priors(self, solution: Solution) -> Iterator[_Question]:
        """The parameters that lie three prior standard deviations away, freed one at a time and all together."""
        problem = self.problem
        names = problem.robot.parameter_names
        random = problem.random[problem.random < len(names)]
        if not random.size:
            return
        beyond = np.abs(solution.coefficients[random])
        std = np.sqrt(problem.model.variances(problem.robot)[random])
        far = random[(beyond > 3.0 * std) & [not is_nuisance(names[i]) for i in random]]
        if not far.size:
            return
        ratio = np.abs(solution.coefficients[far]) / np.sqrt(problem.model.variances(problem.robot)[far])
        far = far[np.argsort(-ratio)]
        jacobian = self.there.jacobian
        for chosen in [far[:1], far][: len(far)]:
            there = _split(jacobian[:, :, chosen], len(self.here.robot.targets))
            columns = problem.columns[:, :, chosen]
            yield _Question("prior", columns, there, parameter=names[far[0]], rows=tuple(chosen.tolist()))

    # ── the answers ──────────────────────────────────────────────────────────────────────────────────

    def findings(self) -> Iterator[Alternative]:
        """The best alternative, then the best beside it, and so on."""
        coefficients, score = self.fitted.solution.coefficients, self.fitted.left_out.score
        there = self.problem.model.columns(self.there)
        base, named = _Base(self.problem, self.fitted.doubt, coefficients, score, there), 0
        wrong = self.fitted.doubt > 0
        for exchanged in (_exchanged_targets, _exchanged_rows):
            misplaced = exchanged(self.data.p, self.here.points, wrong, self._reach)
            told = None if misplaced is None else self._put_back(misplaced, base)
            if told is not None:
                named, base = named + 1, told[1]
                yield told[0]
        for _ in range((1 if self._many else MOST_FINDINGS) - named):
            fits = [self._fitted_in_full(a, d, base) for a, d in self._suspicious(base)]
            better = [f for f in fits if f is not None]
            if not better:
                return
            alternative, base = max(better, key=lambda f: f[1].score)
            yield alternative

    def _suspicious(self, base: _Base) -> list[tuple[_Answer, FloatArray]]:
        """Answers below ``SUSPICIOUS`` with the doubt they need: the best of each kind and joint, few of them."""
        lifted = self._lifted(base.doubt)
        doubts = [base.doubt] if (lifted == base.doubt).all() else [base.doubt, lifted]
        usual = base.problem if self._many else _usual(base.problem)
        problems = [base.problem] if usual is base.problem else [base.problem, usual]
        chosen: dict[tuple[Any, ...], tuple[_Answer, FloatArray]] = {}
        for doubt in doubts:
            for problem in problems:
                for answer in self._answers(self._solved(problem, doubt)):
                    answer = replace(answer, count=answer.count * len(doubts) * len(problems))
                    q = answer.question
                    key = (q.code, q.target, q.joint, q.beside, q.columns.shape[2])
                    if answer.counted < SUSPICIOUS and (
                        key not in chosen or _order(answer) < _order(chosen[key][0])
                    ):
                        chosen[key] = (answer, doubt)
        return sorted(chosen.values(), key=lambda a: _order(a[0]))[: FEW_FITS if self._many else MOST_FITS]

    def _solved(self, problem: LinearProblem, doubt: FloatArray) -> Solution:
        """The solution with these doubts; the one at hand if nothing differs."""
        at_hand = self.fitted.solution
        if (
            problem is self.problem
            and (doubt == self.fitted.doubt).all()
            and not isinstance(at_hand, UpdatedSolution)
        ):
            return at_hand
        return solve(self._with(problem, doubt))

    @staticmethod
    def _with(problem: LinearProblem, doubt: FloatArray) -> LinearProblem:
        """``problem`` with other doubts."""
        parts = {n: p for n, p in problem.parts.items() if n != "doubt"}
        if doubt.any():
            parts["doubt"] = part_of(doubt) * (problem.seen[:, :, None] * problem.seen[:, None, :])
        return replace(problem, parts=parts)

    def _lifted(self, doubt: FloatArray) -> FloatArray:
        """Without the doubt of points most of whose neighbours in time are doubted too."""
        seen, result = self.data.seen, np.array(doubt)
        for t in range(seen.shape[1]):
            rows = np.flatnonzero(seen[:, t])
            flags = (doubt[rows, t] > 0).astype(float)
            if flags.sum() < FEWEST:
                continue
            around = np.ones(min(5, len(rows)))
            near = np.convolve(flags, around, "same") / np.convolve(np.ones(len(flags)), around, "same")
            result[rows[(near >= MOSTLY) & (flags > 0)], t] = 0.0
        return result

    def _answers(self, solution: Solution) -> Iterator[_Answer]:
        """Of all questions to one solution."""
        n, questions = len(self.data), list(self.questions(solution))
        single = [q for q in questions if not q.cut]
        cuts = np.arange(FEWEST, n - FEWEST + 1)
        count = float(len(single) + len(cuts) * (len(questions) - len(single)))
        for question, statistic in zip(single, _statistics(solution, [q.columns for q in single]), strict=True):
            tried = count
            if question.code == "prior":  # chosen from so many parameters
                tried += float(len(self.problem.robot.parameter_names)) ** min(len(question.rows), 2)
            if question.code in ("block", "push"):  # chosen from so many runs
                tried += n * n / 2.0
            yield _answer(solution, question, statistic, tried)
        some = (
            cuts if len(cuts) <= MOST_CUTS else np.unique(np.linspace(cuts[0], cuts[-1], MOST_CUTS).astype(int))
        )
        for question in questions:
            if question.cut:
                row, statistic = self._best_cut(solution, question, some)
                yield _answer(solution, question.at(row), statistic, count)

    @staticmethod
    def _best_cut(solution: Solution, question: _Question, cuts: IntArray) -> tuple[int, tuple[float, int]]:
        """The visit before which it began most probably; S and its rank there."""
        values, ranks = _scan(solution, question.columns, cuts)
        best = int(np.argmax(values))
        low, high = cuts[max(best - 1, 0)], cuts[min(best + 1, len(cuts) - 1)]
        if high - low > 2:
            cuts = np.arange(low, high + 1)
            values, ranks = _scan(solution, question.columns, cuts)
            best = int(np.argmax(values))
        return int(cuts[best]), (float(values[best]), int(ranks[best]))

    def _fitted_in_full(
        self, answer: _Answer, doubt: FloatArray, base: _Base
    ) -> tuple[Alternative, _Base] | None:
        """The alternative, and the linear problem with it; ``None``: it explains nothing."""
        question, count = answer.question, base.problem.columns.shape[2]
        for _ in range(2):
            wide = _widened(self._with(base.problem, doubt), question.columns)
            solution, after = self._settled(wide, doubt)
            null = solve(self._with(base.problem.at(solution.problem.model), after))
            if question.whole is None or self._many:
                break
            row = self._row_again(question, null, after)
            if row == question.row:
                break
            question = question.at(row)
        doubt = after
        again = _answer(null, question, _statistics(null, [question.columns])[0], answer.count)
        score = left_out(solution).score
        if not (again.counted < SIGNIFICANT and score > base.score):
            return None
        amounts = solution.coefficients[count:]
        own = question.there.reshape(len(self.poses), -1, len(amounts))
        there = np.concatenate([base.there, own], axis=2)
        change = there @ (solution.coefficients - np.append(base.coefficients, 0.0 * amounts))
        moved, deviations = self._moved(change)
        told = replace(
            self._told(question, amounts),
            gain=score - base.score,
            statistic=again.statistic,
            freedom=again.freedom,
            probability=again.counted,
            moved=moved,
            deviations=deviations,
            material=bool(deviations > MATERIAL),
        )
        return told, _Base(solution.problem, doubt, solution.coefficients, score, there)

    # ── points that belong elsewhere ─────────────────────────────────────────────────────────────────

    @cached_property
    def _reach(self) -> float:
        """A point this close to another prediction belongs there [m]."""
        left = self.fitted.left_out
        return REACH * float(np.nanmax([left.rms, left.predicted_rms, 1e-9]))

    def _put_back(self, misplaced: _Misplaced, base: _Base) -> tuple[Alternative, _Base] | None:
        """The alternative with the points where they belong; ``None``: they are no better there."""
        old = base.problem
        change = np.where(misplaced.moved[:, :, None], misplaced.points - self.data.p, 0.0).reshape(old.y.shape)
        doubt = np.where(misplaced.moved, 0.0, base.doubt)
        problem = self._with(replace(old, y=old.y + change), doubt)
        solution, doubt = self._settled(problem, doubt)
        score = left_out(solution).score
        probability = _by_chance(misplaced, self.here.points, self._reach)
        if not probability < SIGNIFICANT or (misplaced.moved.any() and not score > base.score):
            return None
        moved, deviations = self._moved(base.there @ (solution.coefficients - base.coefficients))
        rows = misplaced.rows
        told = _named(misplaced.code, len(rows), "1", misplaced.words, row=rows[0], rows=rows)
        told = replace(told, gain=score - base.score, probability=probability, moved=moved, deviations=deviations)
        return replace(told, material=deviations > MATERIAL), _Base(
            problem, doubt, solution.coefficients, score, base.there
        )

    def _row_again(self, question: _Question, null: Solution, doubt: FloatArray) -> int:
        """The visit before which it began, at scales that no longer hold what the columns explain."""
        assert question.whole is not None and question.row is not None
        near = slice(max(question.row - 2, 0), question.row + 2)
        if doubt[near].any():  # a visit on the wrong side of the cut was impossible there
            lifted = np.array(doubt)
            lifted[near] = 0.0
            null = solve(self._with(null.problem, lifted))
        cuts = np.arange(FEWEST, len(self.data) - FEWEST + 1)
        return self._best_cut(null, replace(question, columns=question.whole), cuts)[0]

    def _settled(self, problem: LinearProblem, doubt: FloatArray) -> tuple[Solution, FloatArray]:
        """The solution with new scales; points that are possible now count, and those that are not do not."""
        papers = problem.model.is_papers
        for _ in range(1 if papers else DOUBT_ROUNDS):
            solution = solve(problem) if self._many else maximise(problem, SCALE_ROUNDS)
            new = doubt if papers else impossible(solution, doubt)
            if ((new > 0) == (doubt > 0)).all():
                break
            doubt, problem = new, self._with(solution.problem, new)
        return solution, doubt

    def _moved(self, change: FloatArray) -> tuple[float, float]:
        """Largest distance of ``change`` (K, 3·targets) [m], and in predicted standard deviations."""
        change = self._framed(change.reshape(-1, 1)).reshape(len(self.poses), -1, 3)
        distances = np.sqrt(np.mean(np.sum(change**2, axis=2), axis=1))
        shares = np.divide(distances, self._promised, out=np.zeros(len(distances)), where=self._promised > 0.0)
        return float(distances.max()), float(shares.max())

    def _framed(self, rows: FloatArray) -> FloatArray:
        """Rows (3·K·targets, n) at the test poses, for ``robot`` without what a rigid motion explains."""
        if self.frame == "robot":
            with suppress(InputError):  # measured configurations that lie in a plane
                return without_rigid_motion(self.there.points, rows)
        return rows

    @cached_property
    def _promised(self) -> FloatArray:
        """(K,) predicted error at the test poses [m], (M3)."""
        known = self.fitted.knowledge
        columns = known.model.columns(known.poses(self.poses))
        rows = self._framed(columns.reshape(-1, columns.shape[2]))
        squares = np.sum((rows @ known.covariance) * rows, axis=1).reshape(len(self.poses), -1)
        return np.sqrt(squares.sum(axis=1) / len(known.robot.targets))

    # ── the words ────────────────────────────────────────────────────────────────────────────────────

    def _told(self, question: _Question, amounts: FloatArray) -> Alternative:
        """The alternative in words."""
        q, names = question, self.data.joint_names
        joint = None if q.joint is None else names[q.joint]
        beside = None if q.beside is None else names[q.beside]
        first, unit = float(amounts[0]), "m"
        size = float(np.linalg.norm(amounts[:3]))
        words = length(size)
        if q.code in ("push", "drift"):
            turn = float(np.linalg.norm(amounts[3:]))
            words = f"{words} and {milliradians(turn)}" if len(amounts) > 3 else words
        elif q.code == "joint_step":
            turns = bool(self.here.robot.joint_is_revolute[q.joint])
            size, unit = first * float(joint_units(self.here.robot)[q.joint]), "rad" if turns else "m"
            words = milliradians(size, 3) if turns else length(size)
        elif q.code in ("scale", "ratio"):
            size, unit, words = first, "1", f"{1.0 + first:.6g}"
        elif q.code == "couple":
            size, unit, words = first, "1", f"{'+' if first > 0 else '−'} {abs(first):.3g} ×"
        elif q.code == "prior":
            size, unit = float(len(q.rows)), "1"
            words = counted(len(q.rows), "parameter") + (" lies" if len(q.rows) == 1 else " lie")
        told: dict[str, Any] = {"size": words, "parameter": q.parameter, "rows": _ranges(q.rows)}
        if q.code == "couple":
            told["option"] = Coupling(str(joint), str(beside), float(f"{-first:.4g}"))
            full = self.here.robot.with_parameters("full").parameter_names
            told["first"] = "" if set(full) <= set(self.problem.robot.parameter_names) else FULL_FIRST
        return _named(
            q.code,
            size,
            unit,
            told,
            row=q.row,
            target=None if q.target is None else q.target + 1,
            joint=joint,
            beside=beside,
            parameter=q.parameter,
            rows=q.rows if q.code == "block" else (),
        )


@dataclass(frozen=True, eq=False)
class _Misplaced:
    """Points that belong elsewhere.

    Attributes:
        code, words: Row of the table and what fills its braces.
        points: (N, targets, 3) with these points where they belong [m].
        moved: (N, targets) places that have another point now.
        rows: Rows that they stand in.
    """

    code: str
    points: FloatArray
    moved: BoolArray
    rows: tuple[int, ...]
    words: dict[str, Any]


@dataclass(frozen=True, eq=False)
class _Base:
    """What an alternative is compared with.

    Attributes:
        problem, doubt: Linear problem, with the columns of the alternatives before it, and doubts (N, targets).
        coefficients: (coefficients + columns,) of it.
        score: Left-out score.
        there: (K, 3·targets, coefficients + columns) what these move the predictions at the test poses by.
    """

    problem: LinearProblem
    doubt: FloatArray
    coefficients: FloatArray
    score: float
    there: FloatArray


def _order(answer: _Answer) -> tuple[float, float]:
    """Smaller for a more suspicious answer; probabilities may be too small for a number."""
    return answer.counted, -answer.statistic * answer.freedom


def _answer(solution: Solution, question: _Question, statistic: tuple[float, int], count: float) -> _Answer:
    """F of (2) for S and its rank."""
    problem, (value, rank) = solution.problem, statistic
    left = float(np.sum(problem.y * solution.weighted))
    spare = int(problem.seen.sum()) - problem.basis.shape[1] - rank
    if rank < 1 or spare < SPARE:
        return _Answer(question, 0.0, rank, 1.0, count)
    ratio = max(value / rank / (max(left - value, 1e-12 * left) / spare), 0.0)
    return _Answer(question, ratio, rank, float(fdtrc(rank, spare, ratio)), count)


def _statistics(solution: Solution, columns: list[FloatArray]) -> list[tuple[float, int]]:
    """S of (1) and its rank for each of several columns (N, m, d)."""
    seen = solution.problem.seen
    every = np.concatenate(columns, axis=2) * seen[:, :, None]
    flat = every.reshape(seen.size, -1)
    pulled, right = solution.project(flat), flat.T @ solution.weighted.ravel()
    own = _own_squares(solution, every).sum(axis=0)
    result, start = [], 0
    for part in columns:
        here = slice(start, start + part.shape[2])
        free = flat[:, here].T @ pulled[:, here]
        values, ranks = _explained(free[None], own[None, here], right[None, here])
        result.append((float(values[0]), int(ranks[0])))
        start = here.stop
    return result


def _own_squares(solution: Solution, columns: FloatArray) -> FloatArray:
    """(N, d) squares of the columns (N, m, d) whitened by R_i."""
    lower = np.linalg.cholesky(solution.problem.covariance)
    return np.asarray(np.sum(np.linalg.solve(lower, columns) ** 2, axis=1))


def _explained(free: FloatArray, own: FloatArray, right: FloatArray) -> tuple[FloatArray, IntArray]:
    """(n,) S = bᵀ G⁺ b and the rank of G = ``free`` (n, d, d), b = ``right`` (n, d), ``own`` squares (n, d)."""
    scale = np.sqrt(np.maximum(own, 1e-300))
    values, vectors = np.linalg.eigh(free / (scale[:, :, None] * scale[:, None, :]))
    seen = values > ABSORBED
    turned = np.einsum("nij,ni->nj", vectors, right / scale)
    shares = np.where(seen, turned**2 / np.where(seen, values, 1.0), 0.0)
    return shares.sum(axis=1), seen.sum(axis=1)


def _scan(solution: Solution, columns: FloatArray, cuts: IntArray) -> tuple[FloatArray, IntArray]:
    """S of (1) and its rank for columns (N, m, d) that begin before each of the visits ``cuts`` (n,), rising."""
    problem = solution.problem
    n, m = problem.y.shape
    columns = columns * problem.seen[:, :, None]
    right = _later(np.einsum("nmd,nm->nd", columns, solution.weighted))[cuts]
    own = _later(_own_squares(solution, columns))[cuts]
    if isinstance(solution, DenseSolution):
        blocks = solution.projection.reshape(n * m, n, m).transpose(1, 0, 2)
        pulled = (blocks @ columns).reshape(n, n, m, -1)  # P_ij C_j, first j then i
        later = _later(pulled)
        every = np.arange(n)
        turned = columns.transpose(0, 2, 1)
        alone = turned @ pulled[every, every]
        beside = turned @ (later[every, every] - pulled[every, every])
        free = _later(alone + beside + beside.transpose(0, 2, 1))[cuts]
    else:
        assert isinstance(solution, CoefficientSolution)
        white = solution.inverse @ columns
        own_part = _later(white.transpose(0, 2, 1) @ white)[cuts]
        share = white.transpose(0, 2, 1) @ solution.white.reshape(n, m, -1)
        ends = np.append(cuts, n)
        sums = np.add.reduceat(share, cuts, axis=0) if ends[-2] < n else share[:0]
        common = _later(sums) @ solution.half
        free = own_part - common @ common.transpose(0, 2, 1)
    return _explained(free, own, right)


def _later(values: FloatArray) -> FloatArray:
    """(N, …) sums over this and all later visits."""
    return np.asarray(values[::-1].cumsum(axis=0)[::-1])


def _usual(problem: LinearProblem) -> LinearProblem:
    """``problem`` with no scale larger than a usual robot has; itself if none is."""
    high = {
        s.name: s.median * np.sqrt(s.factor) for s in problem.model.scales if not s.known and s.factor < UNBOUNDED
    }
    values = problem.model.values
    swollen = {n: limit for n, limit in high.items() if values[n] > SWOLLEN * limit}
    return problem.at(problem.model.with_values(swollen)) if swollen else problem


def _station(points: FloatArray, centre: FloatArray) -> FloatArray:
    """(N, 3·targets, 6) columns of a motion of the station: translation, then rotation about ``centre``."""
    arms = points - centre
    turn = np.zeros((*arms.shape, 3))
    for axis in range(3):  # the unit vector of the axis × arm
        u, v = (axis + 1) % 3, (axis + 2) % 3
        turn[..., u, axis], turn[..., v, axis] = -arms[..., v], arms[..., u]
    move = np.broadcast_to(np.eye(3), turn.shape)
    return np.concatenate([move, turn], axis=-1).reshape(len(points), -1, 6)


def _at_target(rotations: FloatArray, target: int, targets: int) -> FloatArray:
    """(N, 3·targets, 3) columns of the offset of one target, from the tip's rotations (N, 3, 3)."""
    columns = np.zeros((len(rotations), targets, 3, 3))
    columns[:, target] = rotations
    return columns.reshape(len(rotations), -1, 3)


def _tool(points: FloatArray, rotations: FloatArray, origins: FloatArray) -> FloatArray:
    """(N, 3·targets, 6) columns of a motion of all targets beside the tip, in the tip's frame."""
    beside = points - origins[:, None]
    turn = np.stack([np.cross(rotations[:, None, :, a], beside) for a in range(3)], axis=-1)
    move = np.broadcast_to(rotations[:, None], turn.shape)
    return np.concatenate([move, turn], axis=-1).reshape(len(points), -1, 6)


def _split(columns: FloatArray, targets: int) -> FloatArray:
    """(N, 3·targets, d) → (N, targets, 3, d)."""
    return columns.reshape(len(columns), targets, 3, -1)


def _ranges(rows: tuple[int, ...]) -> str:
    """``3–7, 12``: numbers in rising order, runs as ranges."""
    parts: list[list[int]] = []
    for row in rows:
        if parts and row == parts[-1][-1] + 1:
            parts[-1].append(row)
        else:
            parts.append([row])
    return listed([f"{p[0]}–{p[-1]}" if len(p) > 1 else p[0] for p in parts], 5)


# ── points that belong elsewhere ─────────────────────────────────────────────────────────────────────


def _exchanged_targets(p: FloatArray, predicted: FloatArray, wrong: BoolArray, reach: float) -> _Misplaced | None:
    """Points of rows where each of the wrong ones fits another target.

    Args:
        p, predicted: (N, targets, 3) measured, and as the others put them [m].
        wrong: (N, targets) points that are impossible where they stand.
        reach: A point this close to another prediction belongs there [m].
    """
    points, moved = np.array(p), np.zeros(wrong.shape, bool)
    for i in np.flatnonzero(wrong.sum(axis=1) > 1).tolist():
        targets = np.flatnonzero(wrong[i])
        apart = np.linalg.norm(p[i, targets][:, None] - predicted[i, targets][None], axis=2)
        to = apart.argmin(axis=1)
        if apart.min(axis=1).max() < reach and (np.sort(to) == np.arange(len(to))).all():
            points[i, targets[to]] = p[i, targets]
            moved[i, targets] = to != np.arange(len(to))
    if not moved.any():
        return None
    rows = tuple(np.flatnonzero(moved.any(axis=1)).tolist())
    which = listed([t + 1 for t in np.flatnonzero(moved.any(axis=0))], 5)
    words = {"size": which, "where": f" in {_rows(rows)}"}
    return _Misplaced("targets", points, moved, rows, words)


def _exchanged_rows(p: FloatArray, predicted: FloatArray, wrong: BoolArray, reach: float) -> _Misplaced | None:
    """Points that fit the joint values of another row; arguments as for ``_exchanged_targets``."""
    points, moved, seen = np.array(p), np.zeros(wrong.shape, bool), ~np.isnan(p[:, :, 0])
    to: dict[int, int] = {}
    for i in np.flatnonzero(wrong.any(axis=1)).tolist():
        targets = np.flatnonzero(wrong[i])
        apart = np.linalg.norm(p[i, targets] - predicted[:, targets], axis=2).max(axis=1)
        apart[i] = np.inf
        k = int(apart.argmin())
        if apart[k] < reach:
            to[i] = k
            if (seen[k] == seen[i]).all() and wrong[k, targets].all():
                points[k, targets], moved[k, targets] = p[i, targets], True
    if not to:
        return None
    rows, shifts = tuple(to), [k - i for i, k in to.items()]
    usual = max(set(shifts), key=shifts.count)
    text = f"the points of {_rows(rows)} fit the joint values of others"
    if len(rows) == 2 and to.get(to[rows[0]]) == rows[0]:
        text = f"the points of rows {rows[0]} and {rows[1]} are exchanged"
    elif shifts.count(usual) >= max(FEWEST, len(rows) - 2):
        way = f"{counted(abs(usual), 'row')} further {'down' if usual > 0 else 'up'}"
        text = f"the points of {_rows(rows)} belong to the joint values {way}"
    return _Misplaced("rows", points, moved, rows, {"size": text})


def _by_chance(misplaced: _Misplaced, predicted: FloatArray, reach: float) -> float:
    """Probability that points that are wrong anywhere come so close to others, in any row."""
    n = len(predicted)
    share = min(1.0, (reach / max(_spread(predicted), reach)) ** 3)
    others = n if misplaced.code == "rows" else predicted.shape[1]
    return min(1.0, n * min(1.0, others * share) ** len(misplaced.rows))


def _rows(rows: tuple[int, ...]) -> str:
    """``row 3`` or ``rows 3–7, 12``."""
    return f"row {rows[0]}" if len(rows) == 1 else f"rows {_ranges(rows)}"


# ── gross: what is assumed is so wrong that no fit makes sense ───────────────────────────────────────

FULL_FIRST = "free all parameters first (--parameters full), as axes that are tilted look like this; then "
"""Advice before a coupling is believed while parameters of the placement are fixed."""
GROSS = 0.01
"""Share of its extent beyond which no industrial robot errs: ten times what zeros alone left on real arms."""
SOUND = 0.02
"""The same below which a change has to bring it: gravity and tolerances, which are not fitted here, are in it."""
CLEAR = 3.0
"""Factor by which the residuals have to fall: what is left is then a ninth of the sum of squares."""
TIE = 2.0
"""Changes whose residuals differ by less than this factor explain the data equally well."""
UNITS = {"millimetres": 1e3, "centimetres": 1e2, "inches": 1.0 / 0.0254, "feet": 1.0 / 0.3048}
"""Unit → how many of it a metre has."""
NEAR = 0.03
"""Relative distance of an estimated scale from that of a unit, or from one, within which it is that."""
FAR_APART = 3.0
"""A ratio of spreads beyond which the unit of the points is wrong, whatever else is."""
WHOLE_TURNS = 4.0 * np.pi
"""Angles beyond this are degrees [rad]."""
MANY = 0.1
"""Share of rows with points that belong elsewhere below which a robust fit copes with them by itself."""
RANK_ROUNDS, FIT_ROUNDS = 3, 8
"""Rounds of weights while changes are ranked, and of a fit of the zeros."""
MOST_ROWS = 60
"""Rows that are tried, evenly spread."""
PREFERRED = ("sign", "signs", "mirror", "columns", "targets", "rows", "couple", "zero")
"""Discrete changes, the one to name first if several explain the same: a wrist bends the other way if its middle
joint changes its sign, or if the joint before it is turned by half."""
FITTED = ("scale", "ratio", "setup")
"""Changes with an amount that is fitted, or with more unknowns, in the same order."""
CANDIDATES = 8
"""Changes whose zeros are fitted, those that leave least without."""


@dataclass(frozen=True, eq=False)
class _Change:
    """One discrete change of the data or of what is unknown.

    Attributes:
        code: Row of the table.
        words: What fills its braces.
        q, p: (N, joints), (N, targets, 3) changed [rad | m], [m].
        more: Fields of the alternative, ``size`` and ``unit`` among them.
        base, tool: Whether these are unknown.
        scale: Whether a factor on all distances is fitted.
        ratio: Joint whose gear ratio is fitted, or ``None``.
        metre: How many of the data's units ``p`` takes for a metre.
    """

    code: str
    words: dict[str, Any]
    q: FloatArray
    p: FloatArray
    more: dict[str, Any]
    base: bool
    tool: bool
    metre: float = 1.0
    scale: bool = False
    ratio: int | None = None


@dataclass(frozen=True)
class _Left:
    """What a change leaves: median distance of a point [m], scale and ratio that were fitted, predictions."""

    level: float
    scale: float = 1.0
    ratio: float = 1.0
    spare: int = 0
    points: FloatArray | None = None


def explain_gross(robot: Robot, data: Measurements) -> Alternative | None:
    """The one change that makes sense of data which the robot as described does not explain at all.

    To be called when a fit fails, or at any time: data that base, targets and zeros explain as well as an
    industrial robot allows need no explanation.

    Args:
        robot: Nominal; base and targets are placed if their parameters are active.
        data: The measurements.

    Returns:
        ``None`` if nothing is grossly wrong, or if no single change explains it.
    """
    gross = _Gross(robot, data.in_order_of(robot.joint_names))
    return gross.explanation()


class _Gross:
    """The changes and what they leave."""

    def __init__(self, robot: Robot, data: Measurements) -> None:
        active = set(robot.parameter_names)
        self.base = active.issuperset(BASE_PARAMETERS)
        self.tool = active.issuperset(target_parameters(len(robot.targets)))
        rows = np.flatnonzero(data.seen.any(axis=1))
        self.robot, self.q, self.p, self.numbers = robot, data.q[rows], data.p[rows], rows
        self.turns = robot.joint_is_revolute
        origin = robot.with_base(np.eye(3), np.zeros(3))
        frame = np.vstack([np.zeros(3), np.eye(3)])
        self.tips = replace(origin, parameter_names=()).with_targets(frame)
        self.count = 0

    def explanation(self) -> Alternative | None:
        """See ``explain_gross``."""
        if len(self.q) < 2:
            return None
        plain = self._change("", self.q, self.p)
        before = self._left(plain, fit=True)
        if before.spare < SPARE:
            return None
        if before.level < GROSS * self._extent(self.q):
            every = len(self.q) <= MOST_ROWS  # then that was a fit of all rows already
            return self._elsewhere(before if every else self._fitted(plain, self.q, self.p, FIT_ROUNDS, True))
        base, after = self._units(plain, before)
        limit = SOUND * self._extent(base.q)
        # What could not be placed at all leaves as much as the points spread.
        before = replace(before, level=min(before.level, _spread(self.p)) / base.metre)
        if base is not plain and after.level < min(limit, before.level / CLEAR):
            return self._told([base], before, after)
        several, after = self._best(base, after)
        if not several:
            return None
        return self._told(
            several if base is plain else [several[0]], before, after, None if base is plain else base
        )

    def _elsewhere(self, before: _Left) -> Alternative | None:
        """Points of many rows that belong to other rows or targets, beside others that are sound.

        Whether that matters, the fit without them has to say.
        """
        assert before.points is not None
        apart = np.linalg.norm(np.where(np.isnan(self.p), 0.0, self.p - before.points), axis=2)
        reach = REACH * before.level
        wrong = apart > max(2.0 * reach, GROSS * self._extent(self.q))
        if wrong.any(axis=1).mean() < MANY:
            return None
        for exchanged in (_exchanged_targets, _exchanged_rows):
            misplaced = exchanged(self.p, before.points, wrong, reach)
            if misplaced is None:
                continue
            probability = _by_chance(misplaced, before.points, reach)
            if len(misplaced.rows) >= FEWEST and probability < SIGNIFICANT:
                rows = tuple(int(i) for i in self.numbers[list(misplaced.rows)])
                if rows != misplaced.rows:  # rows without points were left out
                    continue
                told = _named(misplaced.code, len(rows), "1", misplaced.words, row=rows[0], rows=rows)
                far = float(np.median(apart[wrong]))
                return replace(
                    told,
                    gain=-float(np.log(max(probability, 1e-300))),
                    statistic=far / max(before.level, 1e-12),
                    freedom=len(rows),
                    probability=probability,
                    moved=far,
                    deviations=far / max(before.level, 1e-12),
                )
        return None

    # ── changes ──────────────────────────────────────────────────────────────────────────────────────

    def _change(self, code: str, q: FloatArray, p: FloatArray, **more: Any) -> _Change:
        words = more.pop("words", {})
        base, tool = more.pop("base", self.base), more.pop("tool", self.tool)
        scale, ratio, metre = more.pop("scale", False), more.pop("ratio", None), more.pop("metre", 1.0)
        return _Change(code, words, q, p, more, base, tool, metre, scale, ratio)

    def _units(self, plain: _Change, before: _Left) -> tuple[_Change, _Left]:
        """The data in metres and radians, as far as that is clear, and what they leave."""
        best, least = plain, before
        spread = _spread(self.p) / max(_spread(self._tip(self.q)[1][:, None]), 1e-9)
        factors = {"radians": 1.0, "degrees": np.pi / 180.0, "too small": 180.0 / np.pi}
        for angle, factor in factors.items():
            q = np.where(self.turns, self.q * factor, self.q)
            about = max(_spread(self.p), 1e-9) / max(_spread(self._tip(q)[1][:, None]), 1e-9)
            free = self._left(self._change("", q, self.p / about, scale=True))
            for scale in self._scales(about, about * free.scale):
                change = self._in_units(angle, scale, q)
                if change is None:
                    continue
                left = self._left(change, fit=True)
                # In the units of the data: whatever makes the robot small leaves little of its metres.
                if left.level * change.metre < least.level * best.metre / CLEAR:
                    best, least = change, left
        if best is not plain:
            return best, least
        # Something else is wrong too; what cannot be otherwise is changed before that is looked for.
        turning = np.abs(self.q[:, self.turns]).max(initial=0.0)
        angle = "degrees" if turning > WHOLE_TURNS else "radians"
        q = np.where(self.turns, self.q * factors[angle], self.q)
        far = not 1.0 / FAR_APART < spread < FAR_APART
        change = self._in_units(angle, self._scales(spread, spread)[0] if far else 1.0, q)
        return (plain, before) if change is None else (change, self._left(change, fit=True))

    @staticmethod
    def _scales(*estimates: float) -> list[float]:
        """Units of the points to try: the ones next to the estimates, and metres."""
        all_of_them = np.array([1.0, *UNITS.values(), 1.0 / UNITS["millimetres"]])
        near = {float(all_of_them[np.argmin(np.abs(np.log(all_of_them / max(e, 1e-9))))]) for e in estimates}
        return [*near, 1.0] if 1.0 not in near else list(near)

    def _in_units(self, angle: str, scale: float, q: FloatArray) -> _Change | None:
        """Points with ``scale`` units to the metre, angles as named; ``None``: as they are."""
        texts, advice = [], []
        unit = next((u for u, s in UNITS.items() if s == scale), None)
        if unit is not None:
            texts.append(f"the points are in {unit}")
            advice.append("add --millimetres" if unit == "millimetres" else f"add --units {SPELLINGS[unit]}")
        elif scale < 1.0:
            texts.append("the points are a thousand times too close together")
            advice.append(
                "leave out --millimetres if the points are in metres, or give the robot's lengths in metres"
            )
        if angle == "degrees":
            texts.append("the joint angles are in degrees")
            advice.append("add --degrees")
        elif angle == "too small":
            texts.append("the joint angles are 57.3 times too small, as radians are that were read as degrees")
            advice.append("leave out --degrees")
        if not texts:
            return None
        words = {"size": " and ".join(texts), "advice": ", and ".join(advice)}
        size, name = (scale, "1") if scale != 1.0 else (180.0 / np.pi, "1")
        return self._change("units", q, self.p / scale, words=words, size=size, unit=name, metre=scale)

    def _changes(self, start: _Change) -> Iterator[_Change]:
        """Every other gross row of the table, applied to ``start``."""
        q, p, names = start.q, start.p, self.robot.joint_names
        moving = [j for j in range(len(names)) if np.ptp(q[:, j]) > 1e-6]
        for j in moving:
            yield self._change(
                "sign", _with_column(q, j, -q[:, j]), p, words={}, size=-1.0, unit="1", joint=names[j]
            )
        if len(moving) > 1:
            yield self._change("signs", -q, p, size=-1.0, unit="1")
        yield self._change("mirror", q, p * [1.0, -1.0, 1.0], size=-1.0, unit="1")
        for j in np.flatnonzero(self.turns).tolist():
            for degrees in (90, -90, 180):
                turned = _with_column(q, j, q[:, j] + np.deg2rad(degrees))
                words = {"size": f"{degrees:+d}".replace("-", "−")}
                yield self._change("zero", turned, p, words=words, size=degrees, unit="deg", joint=names[j])
        for j, k in permutations(moving, 2):
            if self.turns[j] == self.turns[k]:
                for sign, word in ((1.0, "+"), (-1.0, "−")):
                    both = _with_column(q, j, q[:, j] + sign * q[:, k])
                    pair = {"joint": names[j], "beside": names[k]}
                    words = {"size": word, "option": str(Coupling(names[j], names[k], -sign))}
                    yield self._change("couple", both, p, words=words, size=sign, unit="1", **pair)
        for j, k in combinations(range(len(names)), 2):
            if self.turns[j] == self.turns[k]:
                other = _with_column(_with_column(q, j, q[:, k]), k, q[:, j])
                yield self._change("columns", other, p, size=0.0, unit="1", joint=names[j], beside=names[k])
        targets = p.shape[1]
        if not self.tool and 1 < targets < 5:
            for order in list(permutations(range(targets)))[1:]:
                pair_of = listed([t + 1 for t in range(targets) if order[t] != t], 5)
                words = {"size": pair_of, "where": " in every row"}
                yield self._change("targets", q, p[:, order], words=words, size=0.0, unit="1")
        for shift in (1, -1, 2, -2):
            if len(q) > 2 * abs(shift):
                moved = np.full(p.shape, np.nan)
                moved[max(-shift, 0) : len(q) - max(shift, 0)] = p[max(shift, 0) : len(q) + min(shift, 0)]
                side = "below" if shift > 0 else "above"
                text = f"every point stands {counted(abs(shift), 'row')} {side} the joint values it belongs to"
                yield self._change("rows", q, moved, words={"size": text}, size=shift, unit="1")
        text = "the points are in the reverse order of the joint values"
        yield self._change("rows", q, p[::-1], words={"size": text}, size=0.0, unit="1")

    def _fitted_changes(self, start: _Change) -> Iterator[_Change]:
        """Changes with an amount that is fitted, or with more unknowns."""
        q, p, names = start.q, start.p, self.robot.joint_names
        for j in range(len(names)):
            if np.ptp(q[:, j]) > 1e-6:
                yield self._change("ratio", q, p, unit="1", joint=names[j], ratio=j)
        yield self._change("scale", q, p, unit="1", scale=True)
        for base, tool in ((True, self.tool), (self.base, True), (True, True)):
            new = [
                w for w, there, was in (("base", base, self.base), ("tool", tool, self.tool)) if there and not was
            ]
            if new:
                who = {"base": "base is", "tool": "targets are", "base,tool": "base and the targets are"}
                option = ",".join(new)
                them = "it" if option == "base" else "them"
                unknown = [w for w, there in (("base", base), ("tool", tool)) if there]
                words = {"size": who[option], "them": them, "option": ",".join(unknown)}
                yield self._change("setup", q, p, words=words, size=0.0, unit="m", base=base, tool=tool)

    def _best(self, start: _Change, left: _Left) -> tuple[list[_Change], _Left]:
        """The change that leaves least, with those that leave as little; and what it leaves."""
        changes = list(self._changes(start))
        ranked = sorted(changes, key=lambda c: self._left(c).level)[:CANDIDATES]
        some = [*ranked, *self._fitted_changes(start)]
        self.count = len(changes) + len(some) - len(ranked)
        fits = [(c, self._left(c, fit=True)) for c in some]
        # More unknowns leave less by themselves: a discrete change that explains the data goes before them.
        sound = min(SOUND * self._extent(start.q), left.level / CLEAR)
        for codes in (PREFERRED, FITTED):
            those = [f for f in fits if f[0].code in codes]
            least = min((f[1].level for f in those), default=np.inf)
            if least < sound:
                equal = [f for f in those if f[1].level < TIE * least]
                first = min(equal, key=lambda f: _simplest(f[0], f[1].level))
                same = [f[0] for f in equal if f is not first] if codes is PREFERRED else []
                return [first[0], *same], first[1]
        return [], left

    # ── what is left ─────────────────────────────────────────────────────────────────────────────────

    def _tip(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotations (N, 3, 3) and origins (N, 3) of the tip in the robot's own frame."""
        points = self.tips.positions(q)
        return (points[:, 1:] - points[:, :1]).transpose(0, 2, 1), points[:, 0]

    def _extent(self, q: FloatArray) -> float:
        """How far the tip is from where it is on the median [m]."""
        return _spread(self._tip(q)[1][:, None])

    def _left(self, change: _Change, *, fit: bool = False) -> _Left:
        """What is left with base and targets placed as far as they are unknown; ``fit``: and zeros fitted."""
        rows = np.flatnonzero(~np.isnan(change.p[:, :, 0]).all(axis=1))
        if len(rows) > MOST_ROWS:
            rows = rows[np.unique(np.linspace(0, len(rows) - 1, MOST_ROWS).astype(int))]
        try:
            return self._fitted(change, change.q[rows], change.p[rows], FIT_ROUNDS if fit else RANK_ROUNDS, fit)
        except (NotEnoughDataError, np.linalg.LinAlgError):
            return _Left(np.inf, spare=SPARE)

    def _fitted(self, change: _Change, q: FloatArray, p: FloatArray, rounds: int, fit: bool) -> _Left:
        """Rounds of placing, weighing and, with ``fit``, a step of zeros and ratio."""
        robot, seen = self.robot, ~np.isnan(p[:, :, 0])
        weights, zeros, ratio, scale = seen.astype(float), np.zeros(q.shape[1]), 1.0, 1.0
        level = np.inf
        for _ in range(rounds):
            moved = q + zeros
            if change.ratio is not None:
                moved[:, change.ratio] += (ratio - 1.0) * q[:, change.ratio]
            tips = self._tip(moved)
            measured = p / scale
            if change.base or change.tool:
                poses = tips if change.base else _carried(tips, robot.base_pose)
                put = place_points(robot, measured, poses, base=change.base, tool=change.tool, weights=weights)
                rotation = put.rotation if change.base else robot.base_pose[0]
                offsets, points = put.offsets, put.positions(poses)
            else:
                rotation, offsets = robot.base_pose[0], robot.target_offsets
                turned, origins = _carried(tips, robot.base_pose)
                points = offsets @ turned.transpose(0, 2, 1) + origins[:, None]
            apart = np.where(seen[:, :, None], measured - points, 0.0)
            lengths = np.linalg.norm(apart, axis=2)
            level = float(np.median(lengths[seen]))
            weights = np.where(seen, 1.0 / (1.0 + (lengths / max(level, 1e-9)) ** 2), 0.0)
            if change.scale and not fit:
                scale *= _stretch(measured, points, weights, free=change.base)
            if fit:
                step = self._step(
                    change, moved, q, (rotation, offsets, points), apart, (weights, max(level, 1e-6))
                )
                zeros += step[:-1]
                if change.scale:
                    scale *= 1.0 + step[-1]
                else:
                    ratio += step[-1]
        unknown = 6 * change.base + 3 * p.shape[1] * change.tool + (len(zeros) if fit else 0)
        spare = 3 * int(seen.sum()) - unknown - int(change.scale) - int(change.ratio is not None)
        if spare <= 0:
            return _Left(np.inf)
        return _Left(level * float(np.sqrt(3 * seen.sum() / spare)), scale, ratio, spare, points)

    def _step(
        self,
        change: _Change,
        moved: FloatArray,
        q: FloatArray,
        placed: tuple[FloatArray, FloatArray, FloatArray],
        apart: FloatArray,
        how: tuple[FloatArray, float],
    ) -> FloatArray:
        """(joints + 1,) step of the zeros within ``ZERO`` and of ratio or scale, base and targets beside them."""
        (rotation, offsets, points), (weights, level) = placed, how
        n, targets = points.shape[:2]
        joints = q.shape[1]
        levers = self.tips.joint_jacobian(moved).reshape(n, 4, 3, joints)
        sides = levers[:, 1:] - levers[:, :1]
        at = levers[:, :1] + np.einsum("ta,nack->ntck", offsets, sides)
        at = np.einsum("dc,ntck->ntdk", rotation, at)
        columns = [at]
        amount = change.scale or change.ratio is not None
        if change.scale:
            columns.append(points[..., None])
        elif change.ratio is not None:
            columns.append(at[..., [change.ratio]] * q[:, change.ratio][:, None, None, None])
        if change.base:
            columns.append(_split(_station(points, np.zeros(3)), targets))
        if change.tool:
            turned = rotation @ self._tip(moved)[0]
            columns += [_split(_at_target(turned, t, targets), targets) for t in range(targets)]
        root = np.sqrt(weights)[:, :, None, None] / level
        rows = (np.concatenate(columns, axis=3) * root).reshape(3 * n * targets, -1)
        prior = np.zeros((joints, rows.shape[1]))
        prior[:, :joints] = np.eye(joints) / ZERO
        right = np.append((apart[..., None] * root).ravel(), -(moved - q)[0] / ZERO)
        if change.ratio is not None:
            right[len(rows) + change.ratio] = 0.0
        solution = np.linalg.lstsq(np.vstack([rows, prior]), right, rcond=1e-9)[0]
        return np.append(solution[:joints], solution[joints] if amount else 0.0)

    # ── the words ────────────────────────────────────────────────────────────────────────────────────

    def _told(
        self, changes: list[_Change], before: _Left, after: _Left, units: _Change | None = None
    ) -> Alternative:
        """The alternative in words; of several that explain the same thing all are named."""
        first = changes[0]
        more = dict(first.more)
        words = dict(first.words)
        if first.code in ("ratio", "scale"):
            size = after.ratio if first.code == "ratio" else after.scale
            words["size"], more["size"] = f"{size:.5g}", size - 1.0
        size, unit = more.pop("size"), more.pop("unit")
        told = _named(first.code, size, unit, words, **more)
        others = [_named(c.code, 0.0, "1", c.words, **_fields(c)) for c in changes[1:]]
        text, advice = told.text, told.advice
        for other in others[:2]:
            text, advice = f"{text}, or {other.text}", f"{advice}; or {other.advice}"
        if units is not None:
            text, advice = f"{units.words['size']}, and {text}", f"{units.words['advice']}, and {advice}"
        ratio = before.level / max(after.level, 1e-12)
        nats = after.spare * float(np.log(ratio))
        return replace(
            told,
            text=text,
            advice=advice,
            gain=nats,
            statistic=ratio,
            freedom=1,
            probability=min(1.0, max(self.count, 1) * float(np.exp(-min(nats, 700.0)))),
            moved=before.level,
            deviations=ratio,
            material=True,
        )


def _fields(change: _Change) -> dict[str, Any]:
    """What of a change are fields of its alternative, without size and unit."""
    return {k: v for k, v in change.more.items() if k not in ("size", "unit")}


def _simplest(change: _Change, level: float) -> tuple[float, ...]:
    """Smaller for the change to name of several that explain the same data."""
    if change.code in PREFERRED:
        return PREFERRED.index(change.code), level
    return change.code == "setup", change.base + change.tool, level


def _with_column(q: FloatArray, joint: int, values: FloatArray) -> FloatArray:
    """``q`` (N, joints) with other values (N,) of one joint."""
    result = np.array(q)
    result[:, joint] = values
    return result


def _spread(points: FloatArray) -> float:
    """Median distance from the median point [m] of (N, targets, 3): blind to a few gross errors."""
    flat = points.reshape(-1, 3)
    flat = flat[~np.isnan(flat[:, 0])]
    return float(np.median(np.linalg.norm(flat - np.median(flat, axis=0), axis=1)))


def _carried(
    tips: tuple[FloatArray, FloatArray], base: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Rotations and origins of the tip in the frame of the points."""
    (rotations, origins), (rotation, xyz) = tips, base
    return rotation @ rotations, origins @ rotation.T + xyz


def _stretch(measured: FloatArray, predicted: FloatArray, weights: FloatArray, *, free: bool) -> float:
    """Factor of the measured points (N, targets, 3) on the predicted ones, about their centre if ``free``."""
    use = weights > 0
    p, g, w = measured[use], predicted[use], weights[use][:, None]
    if free:
        p, g = p - np.sum(w * p, axis=0) / w.sum(), g - np.sum(w * g, axis=0) / w.sum()
    return float(np.sum(w * p * g) / max(float(np.sum(w * g * g)), 1e-300))
