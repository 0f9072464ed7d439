"""Does one single change to what was assumed explain the measurements far better? One table of such changes.

An *alternative* is a change of one assumption: the tracker stood still, the points are in metres, joint 4 counts in
its usual direction. Each is tried, the one that explains the data best is named with its evidence, what it does to
predictions at the test poses, and what to do. There are two regimes.

*Fine*: the error model fits, and an alternative adds a few columns C to its linear problem (``likelihood``). With
its P and y the amounts a of these columns, their evidence and the linear problem with them are

    G = CᵀPC ,   b = CᵀPy ,   â = G⁻¹ b ,   S = bᵀ G⁻¹ b ,                                                     (1)
    F = (S/d) / ((yᵀPy − S)/(ν − d)) ~ F(d, ν − d)   if nothing is wrong,                                      (2)

d being the rank of G and ν the measured coordinates less the rank of the flat columns. The F ratio needs no level of
noise, so that a noise stated too small is no drift. For all cuts k (columns that are zero before visit k) G and b
are sums over the visits k, k + 1, …, had at once. The scales of the error model were estimated without C and may
have grown to hold what C explains: S is also tried with every scale no larger than a robot of the usual kind has.
What looks suspicious is then fitted in full: the columns enter as flat ones, the scales are estimated anew, and the
left-out score must rise (M4). Points that have lost their weight get it back if the columns explain them.

*Gross*: what is assumed is so wrong that the fit fails or leaves far more than an industrial robot errs by. Base and
targets are placed in closed form (``registration``) for every change, robustly, the zeros of the joints are fitted
with them for the best few, and what is left decides.

Wherever several alternatives explain the same thing the one with the best score is named. *Materiality* is how far
the predictions at the test poses move if the alternative becomes part of the model, in metres and in predicted
standard deviations: what moves nothing is a note, whatever its evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import chdtri, fdtrc

from calib_planner.arrays import FloatArray, IntArray
from calib_planner.error_model import Poses, without_rigid_motion
from calib_planner.error_model.placement import ZERO, is_placement
from calib_planner.error_model.poses import joint_units
from calib_planner.errors import InputError, NotEnoughDataError
from calib_planner.identification.doubt import FEW, FEWEST, gate_of, impossible, part_of, shifted_run
from calib_planner.identification.estimation import ENOUGH, ModelEstimate
from calib_planner.identification.left_out import left_out
from calib_planner.identification.likelihood import (
    CoefficientSolution,
    DenseSolution,
    UNBOUNDED,
    LinearProblem,
    Solution,
    maximise,
    solve,
)
from calib_planner.identification.registration import place, tip_poses
from calib_planner.measurements import Measurements
from calib_planner.robot import BASE_PARAMETERS, Robot, target_parameters
from calib_planner.units import counted, length, listed, milliradians

BoolArray = NDArray[np.bool_]

SIGNIFICANT = 1e-4
"""Probability that any one of all questions is answered yes by chance, after counting them."""
SUSPICIOUS = 1e-2
"""The same from which on an alternative is fitted in full."""
MATERIAL = 1.0
"""Predicted standard deviations: a prediction that moves by less errs no more than was promised."""
MOST_CUTS = 120
"""Cuts between visits that are tried at once; of more visits the neighbourhood of the best is tried anew."""
MOST_FITS = 8
"""Suspicious alternatives that are fitted in full, the most suspicious ones."""
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
MOST_POSES = 60
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
            "mount them as before and measure these rows again, or identify with the larger part of the rows alone",
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
            "replace the column {joint} of the data by {joint} {size} {beside}",
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
    told = {k: v for k, v in more.items() if k in ("row", "target", "joint", "beside")} | words
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

    def at(self, row: int) -> _Question:
        """With the visit before which it began."""
        columns = self.columns * (np.arange(len(self.columns)) >= row)[:, None, None]
        return replace(self, columns=columns, row=row, cut=False)


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
    return _WidenedProblem(problem.robot, problem.model, problem.y, both, problem.parts, problem.seen)


def find_alternatives(
    robot: Robot,
    data: Measurements,
    fitted: ModelEstimate,
    test_poses: FloatArray | None = None,
    accuracy_frame: str = "world",
) -> tuple[Alternative, ...]:
    """The alternatives that explain the measurements better than the error model alone, the best first.

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
        self.here = self._thin(known.poses(data.q), names)
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
        here, there, n = self.here, self.there, len(self.data)
        targets = len(here.robot.targets)
        station = [_station(p.points, self.centre) for p in (here, there)]
        yield _Question("push", station[0], _split(station[1], targets), cut=True)
        order = np.linspace(0.0, 1.0, n)[:, None, None]
        yield _Question("drift", station[0] * order, _split(station[1], targets))
        yield from self._runs(solution, station)
        tips = [tip_poses(p.robot, p.actual, at_base=False) for p in (here, there)]
        for t in range(targets):
            pair = [_at_target(r, t, targets) for r, _ in tips]
            yield _Question("reseat", pair[0], _split(pair[1], targets), cut=True, target=t)
        if targets > 1:
            pair = [_tool(p.points, *tip) for p, tip in zip((here, there), tips, strict=True)]
            yield _Question("tool", pair[0], _split(pair[1], targets), cut=True)
        radial = here.points.reshape(n, -1, 1)
        yield _Question("scale", radial, np.zeros((len(there), targets, 3, 1)))
        yield from self._joints(here, there, targets)
        yield from self._priors(solution)

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

    def _runs(self, solution: Solution, station: list[FloatArray]) -> Iterator[_Question]:
        """The most suspicious run of visits."""
        run = shifted_run(solution)
        if run is None:
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
        far = random[(beyond > 3.0 * std) & is_placement([names[i] for i in random])]
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
        base = _Base(self.problem, self.fitted.doubt, self.fitted.solution.coefficients, self.fitted.left_out.score)
        for _ in range(MOST_FINDINGS):
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
        usual = _usual(base.problem)
        problems = [base.problem] if usual is base.problem else [base.problem, usual]
        chosen: dict[tuple[Any, ...], tuple[_Answer, FloatArray]] = {}
        for doubt in doubts:
            for problem in problems:
                for answer in self._answers(self._solved(problem, doubt)):
                    answer = replace(answer, count=answer.count * len(doubts) * len(problems))
                    q = answer.question
                    key = (q.code, q.target, q.joint, q.beside, q.code == "prior" and len(q.rows))
                    if answer.counted < SUSPICIOUS and (key not in chosen or _order(answer) < _order(chosen[key][0])):
                        chosen[key] = (answer, doubt)
        return sorted(chosen.values(), key=lambda a: _order(a[0]))[:MOST_FITS]

    def _solved(self, problem: LinearProblem, doubt: FloatArray) -> Solution:
        """The solution with these doubts; the one at hand if nothing differs."""
        if problem is self.problem and (doubt == self.fitted.doubt).all():
            return self.fitted.solution
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
                tried += float(len(self.problem.robot.parameter_names)) ** len(question.rows)
            if question.code == "block":  # chosen from so many runs
                tried += n * n / 2.0
            yield _answer(solution, question, statistic, tried)
        some = cuts if len(cuts) <= MOST_CUTS else np.unique(np.linspace(cuts[0], cuts[-1], MOST_CUTS).astype(int))
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

    def _fitted_in_full(self, answer: _Answer, doubt: FloatArray, base: _Base) -> tuple[Alternative, _Base] | None:
        """The alternative, and the linear problem with it; ``None``: it explains nothing."""
        question, count = answer.question, base.problem.columns.shape[2]
        solution, doubt = self._settled(_widened(self._with(base.problem, doubt), question.columns), doubt)
        null = solve(self._with(base.problem.at(solution.problem.model), doubt))
        again = _answer(null, question, _statistics(null, [question.columns])[0], answer.count)
        score = left_out(solution).score
        if not (again.counted < SIGNIFICANT and score > base.score):
            return None
        amounts, poses = solution.coefficients[count:], self.columns_there.shape[2]
        change = self.columns_there @ (solution.coefficients - np.append(base.coefficients, 0.0 * amounts))[:poses]
        change = change.reshape(question.there.shape[:3]) + question.there @ amounts
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
        return told, _Base(solution.problem, doubt, solution.coefficients, score)

    def _settled(self, problem: LinearProblem, doubt: FloatArray) -> tuple[Solution, FloatArray]:
        """The solution with new scales; points that are possible now count, and those that are not do not."""
        papers, many = problem.model.is_papers, problem.y.size > ENOUGH
        for _ in range(1 if papers else DOUBT_ROUNDS):
            solution = solve(problem) if many else maximise(problem, SCALE_ROUNDS)
            new = doubt if papers else impossible(solution, doubt)
            if ((new > 0) == (doubt > 0)).all():
                break
            doubt, problem = new, self._with(solution.problem, new)
        return solution, doubt

    @cached_property
    def columns_there(self) -> FloatArray:
        """(K, 3·targets, coefficients) J⁺ at the test poses."""
        return self.problem.model.columns(self.there)

    def _moved(self, change: FloatArray) -> tuple[float, float]:
        """Largest distance of ``change`` (K, targets, 3) [m], and the largest in predicted standard deviations."""
        frame = self.frame
        if frame == "robot":
            try:
                change = without_rigid_motion(self.there.points, change.reshape(-1, 1)).reshape(change.shape)
            except InputError:  # measured configurations that lie in a plane
                frame = "world"
        distances = np.sqrt(np.mean(np.sum(change**2, axis=2), axis=1))
        promised = self.fitted.knowledge.accuracy(self.poses, frame).per_pose
        shares = np.divide(distances, promised, out=np.zeros(len(distances)), where=promised > 0.0)
        return float(distances.max()), float(shares.max())

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
            words = f"{words} and {milliradians(turn)}"
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
class _Base:
    """What an alternative is compared with: linear problem, doubts (N, targets), coefficients, left-out score."""

    problem: LinearProblem
    doubt: FloatArray
    coefficients: FloatArray
    score: float


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
    high = {s.name: s.median * np.sqrt(s.factor) for s in problem.model.scales if not s.known and s.factor < UNBOUNDED}
    values = problem.model.values
    swollen = {n: limit for n, limit in high.items() if values[n] > SWOLLEN * limit}
    return problem.at(problem.model.with_values(swollen)) if swollen else problem


def _station(points: FloatArray, centre: FloatArray) -> FloatArray:
    """(N, 3·targets, 6) columns of a motion of the station: translation, then rotation about ``centre``."""
    turn = np.stack([np.cross(unit, points - centre) for unit in np.eye(3)], axis=-1)
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
