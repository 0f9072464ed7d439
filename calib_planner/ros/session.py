"""What was measured of a plan, and the estimate from it: the identifier without ROS, and the files that it saves.

A session belongs to one plan (or to none). A plan with another name begins a new session, and a plan that comes
back is met with what was measured of it. Everything is in the store before it counts here, so that a session made
from the same store is the same session.

Which points to believe is decided by all measurements together, every time one comes or goes (each against where
the others put it): later measurements may show that a point was no outlier. What changes is published and stored,
nothing is deleted.

A full fit depends on the measurements in use and on nothing else, so that it is the same after a restart. It is
made of few measurements, once a plan is complete, and for files. In between, while a long plan is being measured,
the estimate before is brought up to date (``identify`` with a start), in milliseconds and with the sizes of the
errors that the last full fit gave; when there are twice as many visits as it had, a full fit is made anew. What
is published then may differ from the full fit, which a restart makes, by a fraction of its standard deviations;
the residuals before calibration are those of the last full fit.

Files are saved in the folder that the user chose and nowhere else. Their names are made of the plan's name, which
comes over the wire: only letters, digits, ``-`` and ``_`` of it become part of a file name, with a hash where
something was left out, so that two plans never share a file. A name that is a symbolic link is refused, since
what it points at is not in the folder.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib_planner.acquisition import Rejection, Standstill, mean_std
from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel
from calib_planner.errors import CalibPlannerError, InputError, NotEnoughDataError, StoreError, UnknownNameError
from calib_planner.identification import Estimate, IdentificationProblem, identify
from calib_planner.io import (
    ACCEPTED,
    KEPT,
    NOT_IN_PLAN,
    NOT_STORED,
    OUTLIER,
    UNDONE,
    Record,
    SessionStore,
    StoredSession,
    calibrated_urdf,
    make_folder,
    write_estimate,
    write_measurements,
    write_text,
)
from calib_planner.measurements import Measurements, configuration_labels
from calib_planner.planning import Plan
from calib_planner.robot import Robot
from calib_planner.units import brief, cut, listed

UPDATED_FROM = 40
"""Measurements from which on an estimate is brought up to date: a full fit of fewer takes some 0.1 s."""
MOST_REJECTIONS = 10_000
"""Rejected standstills of a session that are stored; more are only counted, so that nobody fills the disk."""


@dataclass(frozen=True)
class Matching:
    """How standstills are matched and weighted.

    Attributes:
        tolerance: Largest joint difference to a planned configuration [rad | m].
        accept_unplanned: Whether standstills at configurations of no plan are accepted.
        sigma: Standard deviation of one coordinate of one sample [m]; 0: from the scatter of the samples.
        repeatability: Standard deviation that averaging does not reduce [m].
        most: Largest number of measurements in use.
        error_model: How robot and measurement err; ``None``: all terms at typical sizes.
        accuracy_frame: Of the accuracy at the plan's test poses: ``world`` or ``robot``.
    """

    tolerance: float = 0.01
    accept_unplanned: bool = False
    sigma: float = 3e-5
    repeatability: float = 0.0
    most: int = 5000
    error_model: ErrorModel | None = None
    accuracy_frame: str = "world"


@dataclass(frozen=True)
class TooFew:
    """There is no estimate: ``missing`` more configurations are needed at least; 0 if identification failed."""

    missing: int
    message: str


class Session:
    """Measurements of one plan by one robot.

    Args:
        nominal: The robot; its free parameters are those that the identifier chooses without a plan.
        follow: Chooses the robot's free parameters for a plan.
        store: Holds everything; the session in it goes on.

    Attributes:
        plan_id, plan: The plan, if any.
        robot: The robot whose parameters are identified now.
        records: The measurements in use, in the order of measuring: accepted, or an outlier at present.
        newest: The estimate from ``records``; ``None`` if it has to be made anew.
        settled: Whether ``newest`` is a full fit.

    Raises:
        CalibPlannerError: What the store holds does not fit the robot.
    """

    def __init__(self, nominal: Robot, follow: Callable[[Plan], Robot], store: SessionStore) -> None:
        self.nominal, self.robot, self.follow, self.store = nominal, nominal, follow, store
        self.records: list[Record] = []
        self.newest: Estimate | TooFew | None = None
        self.settled = False
        self._start: Estimate | None = None
        self._unsaved: dict[int, Record] = {}
        self._others: Counter[str] = Counter()
        self._enter(store.current() or StoredSession(0, "", None, ()))

    def begin(self, plan_id: str, plan: Plan, tolerance: float, *, keep: bool = False) -> bool:
        """Take a plan; ``False`` if it is the current one.

        A plan that cannot be stored now is taken all the same, and stored before the first measurement.

        Args:
            plan_id: Name of the plan.
            plan: The plan.
            tolerance: See ``Matching``.
            keep: Whether a plan that is new begins with the measurements of the plan before.

        Raises:
            InputError: The plan is for another robot, or another plan has its name.
        """
        if plan.robot != self.nominal.name:
            raise UnknownNameError("plan.robot", cut(plan.robot, 100), [self.nominal.name])
        if plan.joint_names != self.nominal.joint_names:
            got = listed(plan.joint_names)
            raise InputError("plan.joint_names", got, ", ".join(self.nominal.joint_names))
        self.follow(plan)
        known = self.store.find(plan_id, plan)
        if self.plan is not None and self.plan_id == plan_id:
            return False
        carried = _matched_anew(self.records, plan, tolerance) if keep and known is None else ()
        try:
            self._enter(self.store.begin(plan_id, plan, carried))
        except StoreError:
            self._enter(replace(known or StoredSession(0, plan_id, plan, carried), number=0))
        return True

    def _enter(self, stored: StoredSession) -> None:
        robot = self.nominal if stored.plan is None else self.follow(stored.plan)
        self.number, self.plan_id, self.plan, self.robot = stored.number, stored.plan_id, stored.plan, robot
        self.records = [r for r in stored.records if r.status in KEPT]
        self._others = Counter(r.status for r in stored.records if r.status not in KEPT)
        self.newest, self.settled, self._start, self._unsaved = None, False, None, {}

    def _ensure_begun(self) -> int:
        """Number of the session, which is in the store from now on."""
        if self.number == 0:
            self.number = self.store.begin(self.plan_id, self.plan, self.records).number
        return self.number

    def reset(self) -> int:
        """Begin again without measurements; returns how many were in use.

        Raises:
            StoreError: That cannot be stored; nothing was changed.
        """
        count = len(self.records)
        self._enter(self.store.restart(self.plan_id, self.plan))
        return count

    def take(
        self, standstill: Standstill, how: Matching, frame: str = "", objection: tuple[str, str] | None = None
    ) -> Record:
        """Accept a standstill if it fits and can be stored; returns what became of it.

        Args:
            standstill: The standstill.
            how: How it is matched.
            frame: Frame of its points.
            objection: Status and reason of a rejection that was decided elsewhere.
        """
        index, reason = self._match(standstill.joints, how)
        if objection is not None:
            return self._reject(Record(standstill, *objection, index, 0, frame=frame))
        if reason and not how.accept_unplanned:
            return self._reject(Record(standstill, NOT_IN_PLAN, reason, None, 0, frame=frame))
        if len(self.records) >= how.most:
            reason = f"no more than {how.most} measurements are used: raise most_measurements or call ~/reset"
            return self._reject(Record(standstill, NOT_IN_PLAN, reason, index, 0, frame=frame))
        record = Record(standstill, ACCEPTED, "", index, self.done()[index], frame=frame)
        try:
            record = replace(record, number=self.store.record(self._ensure_begun(), record))
        except StoreError as error:
            self._others[NOT_STORED] += 1
            return record.now(NOT_STORED, f"not stored: {error}")
        self.records.append(record)
        self.newest = None
        return record

    def refuse(self, rejection: Rejection, frame: str = "") -> Record:
        """Note a standstill that gave no measurement."""
        return self._reject(Record(rejection, rejection.reason.value, rejection.message, None, 0, frame=frame))

    def _reject(self, record: Record) -> Record:
        """Count it, and store it if that is possible: a rejection need not survive a restart."""
        self._others[record.status] += 1
        if self._others.total() > MOST_REJECTIONS:
            return record
        try:
            return replace(record, number=self.store.record(self._ensure_begun(), record))
        except StoreError:
            return record

    def undo(self, number: int = 0) -> Record | None:
        """Withdraw the measurement ``number``, 0 for the newest; ``None`` if no such measurement is in use.

        Raises:
            StoreError: That cannot be stored; nothing was changed.
        """
        last = next((r for r in reversed(self.records) if number in (0, r.number)), None)
        return None if last is None else self.withdraw(last, UNDONE, "withdrawn on request")

    def withdraw(self, record: Record, status: str, reason: str) -> Record:
        """Use one of ``records`` no more, under this plan or under another that it was measured for.

        Raises:
            StoreError: That cannot be stored; nothing was changed.
        """
        gone = record.now(status, reason)
        self._ensure_begun()
        self.store.withdraw(gone)
        self.records.remove(record)
        self._unsaved.pop(record.number, None)
        self._others[status] += 1
        self.newest = None
        return gone

    @property
    def frame(self) -> str:
        """Frame of the points in use; empty if there are none, or none was named."""
        return next((r.frame for r in self.records if r.frame), "")

    @property
    def accepted(self) -> list[Record]:
        """The accepted measurements, in the order of measuring."""
        return [r for r in self.records if r.status == ACCEPTED]

    @property
    def rejections(self) -> Counter[str]:
        """Standstills that are not used, by status."""
        return self._others + Counter(r.status for r in self.records if r.status != ACCEPTED)

    def done(self) -> Counter[int | None]:
        """Accepted measurements per row of the plan."""
        return Counter(r.index for r in self.accepted)

    @property
    def configurations(self) -> int:
        """Number of different configurations of the accepted measurements, those of no plan included."""
        unplanned = [r.standstill.joints for r in self.accepted if r.index is None]
        planned = len({r.index for r in self.accepted} - {None})
        return planned + (len(np.unique(configuration_labels(np.array(unplanned)))) if unplanned else 0)

    def missing(self) -> list[int]:
        """Rows of the plan that were not measured as often as planned, in its order."""
        if self.plan is None:
            return []
        done = self.done()
        return [i for i, r in enumerate(self.plan.repetitions.tolist()) if done[i] < r]

    @property
    def complete(self) -> bool:
        """Whether every planned configuration was measured as often as planned."""
        return self.plan is not None and not self.missing()

    def _match(self, joints: FloatArray, how: Matching) -> tuple[int | None, str]:
        """Row of the plan and, if there is none, the reason."""
        plan = self.plan
        if plan is None:
            return None, "there is no plan: request one, or set accept_unplanned"
        distance = np.abs(plan.configurations - joints).max(axis=1)
        best = _nearest_row(plan, distance, self.done(), how.tolerance)
        if best is None:
            i = int(np.argmin(distance))
            text = f"the nearest planned configuration, {i}, is {distance[i]:.4f} rad away"
            return None, f"{text}, plan_tolerance is {how.tolerance:g}: check the pose"
        return best, ""

    def measurements(self, how: Matching) -> Measurements | None:
        """The records, with outliers, as the library's value; ``None`` if there are none."""
        if not self.records:
            return None
        standstills = [r.standstill for r in self.records]
        points = np.array([s.points for s in standstills])
        std = mean_std(standstills, how.sigma, how.repeatability)
        return Measurements(self.robot.joint_names, np.array([s.joints for s in standstills]), points, std)

    def problem(self, how: Matching) -> IdentificationProblem:
        """The problem that ``estimate`` solves.

        Raises:
            NotEnoughDataError: Nothing was measured yet.
        """
        data = self.measurements(how)
        poses = self.plan.test_poses if self.plan is not None and len(self.plan.test_poses) else None
        if data is None:
            raise NotEnoughDataError(0, len(self.robot.parameter_names), "nothing was measured yet")
        frame = "world" if poses is None else how.accuracy_frame
        return IdentificationProblem(
            self.robot, data, error_model=how.error_model, test_poses=poses, accuracy_frame=frame
        )

    def estimate(self, how: Matching, *, settled: bool = False) -> Estimate | TooFew:
        """Identify with the measurements in use: in full if ``settled``, from few, and for a complete plan."""
        full = settled or self.complete or len(self.records) < UPDATED_FROM
        start = None if full else self._start
        try:
            self.newest = self._start = identify(self.problem(how), start)
            self.settled = start is None
        except NotEnoughDataError as error:
            each = 3 * len(self.robot.targets)
            missing = max(-(-(error.need - error.have) // each), 0)
            text = f"{missing} more configurations needed at least: {error}" if missing else str(error)
            self.newest = TooFew(missing, text)
        except (CalibPlannerError, ArithmeticError, ValueError) as error:
            self.newest = TooFew(0, f"identification failed: {error}")
        return self.newest

    def settle(self, how: Matching) -> Estimate | TooFew:
        """The full fit of the measurements in use."""
        if self.newest is not None and (self.settled or isinstance(self.newest, TooFew)):
            return self.newest
        return self.estimate(how, settled=True)

    def judge(self) -> list[Record]:
        """Apply to ``records`` which points the newest estimate rejects; returns the records that changed.

        What cannot be stored now is stored with the next change: the measurements from which it follows are
        stored.
        """
        rejected = defaultdict(list)
        for point in self.newest.points.rejected if isinstance(self.newest, Estimate) else ():
            rejected[point.row].append(point)
        changed = []
        for row, before in enumerate(self.records):
            own = rejected[row]
            if not own and before.status == ACCEPTED and not before.unused:
                continue
            unused = tuple(sorted(r.target - 1 for r in own))
            seen = int((before.standstill.samples > 0).sum())
            status = OUTLIER if own and len(own) == seen else ACCEPTED
            if (status, unused) != (before.status, before.unused):
                reason = "; ".join(f"target {r.target}: {r.reason}" for r in own)
                self.records[row] = before.now(status, reason, unused)
                changed.append(self.records[row])
        self._unsaved |= {r.number: r for r in changed}
        if self._unsaved:
            try:
                self.store.decide(self._ensure_begun(), list(self._unsaved.values()))
                self._unsaved = {}
            except StoreError:
                pass
        return changed


def condition_of(estimate: Estimate) -> float:
    """Condition number of the identified parameters, each in units of its own standard deviation; NaN if unknown.

    It is the square root of the condition number of their correlations; as for a Jacobian, 1 is best.
    """
    variances = np.diag(estimate.fit.covariance)
    known = np.isfinite(variances) & (variances > 0)
    if not known.any():
        return float("nan")
    scale = np.sqrt(variances[known])
    values = np.linalg.eigvalsh(estimate.fit.covariance[np.ix_(known, known)] / np.outer(scale, scale))
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 0 else float("inf")


def _nearest_row(plan: Plan, distance: FloatArray, done: Counter[int | None], tolerance: float) -> int | None:
    """Row of a plan within ``tolerance``: the nearest of the unfinished rows, or else the nearest of all."""
    near = np.flatnonzero(distance <= tolerance)
    return min((int(i) for i in near), key=lambda i: (done[i] >= plan.repetitions[i], distance[i]), default=None)


def _matched_anew(records: Iterable[Record], plan: Plan, tolerance: float) -> tuple[Record, ...]:
    """Measurements of another plan, at the rows of this one; those near no row stay in use, unplanned."""
    done: Counter[int | None] = Counter()
    carried = []
    for record in records:
        distance = np.abs(plan.configurations - record.standstill.joints).max(axis=1)
        index = _nearest_row(plan, distance, done, tolerance)
        carried.append(replace(record, index=index, repetition=done[index]))
        done[index] += 1
    return tuple(carried)


FIELD = "save_folder"
LONGEST_NAME = 40


def save(folder: str, session: Session, how: Matching, urdf: str = "") -> list[Path]:
    """Write ``measurements_PLAN.csv`` and, if there is one, ``estimate_PLAN.yaml``; returns the paths.

    Args:
        folder: The folder that the user chose.
        session: What to save.
        how: How standstills are weighted.
        urdf: The robot's nominal URDF; unless it is empty, ``calibrated_PLAN.urdf`` is written, too.

    Raises:
        InputError: No folder was chosen, or it cannot be written to.
        NotEnoughDataError: Nothing was measured.
    """
    data = session.measurements(how)
    if data is None:
        _chosen(folder)
        raise NotEnoughDataError(0, 1, "nothing was measured yet, so there is nothing to save")
    name = plan_name(session.plan_id)
    paths = [confined(folder, f"measurements_{name}.csv")]
    write_measurements(paths[0], data, FIELD)
    estimate = session.settle(how)
    if isinstance(estimate, Estimate):
        paths.append(confined(folder, f"estimate_{name}.yaml"))
        write_estimate(paths[-1], estimate, FIELD, session.problem(how))
        if urdf:
            paths.append(confined(folder, f"calibrated_{name}.urdf"))
            write_text(paths[-1], calibrated_urdf(urdf, estimate.calibrated)[0], FIELD)
    return paths


def report(folder: str, session: Session, how: Matching) -> Path:
    """Write ``report_PLAN.html``; returns its path.

    Raises:
        InputError: No folder was chosen, or it cannot be written to.
        NotEnoughDataError: There is no estimate yet.
    """
    from calib_planner.report import InputFile, Provenance, write_report  # templates: a node starts without them

    path = confined(folder, f"report_{plan_name(session.plan_id)}.html")
    estimate = session.settle(how)
    if not isinstance(estimate, Estimate):
        raise NotEnoughDataError(0, 1, f"there is no estimate to report yet: {estimate.message}")
    model = session.store.model
    inputs = (InputFile("robot", model.origin or model.name, model.sha256),)
    write_report(path, session.problem(how), estimate, Provenance(inputs), FIELD)
    return path


def plan_name(plan_id: str) -> str:
    """The part of a file name that stands for a plan."""
    name = re.sub(r"[^A-Za-z0-9_-]", "", plan_id)[:LONGEST_NAME]
    if name == plan_id:
        return name or "unplanned"
    return f"{name}-{hashlib.sha256(plan_id.encode('utf-8', 'surrogatepass')).hexdigest()[:8]}"


def confined(folder: str, name: str) -> Path:
    """The path of a file in ``folder``, which is made if it does not exist.

    Raises:
        InputError: No folder, or none that can be made; a name that leaves it, or is a link.
    """
    _chosen(folder)
    path = make_folder(folder, FIELD) / name
    if Path(name).name != name or name in ("", ".", "..") or "\0" in name or path.is_symlink():
        raise InputError(FIELD, brief(str(path), 200), "a file in this folder itself", "move the link away")
    return path


def _chosen(folder: str) -> None:
    if not folder:
        advice = "start the node with --ros-args -p save_folder:=FOLDER"
        raise InputError(FIELD, "an empty name", "a folder", advice)
