# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What was measured of a campaign or a plan, and the estimate from it: the identifier without ROS, its files.

A session belongs to one campaign, whose plans share their measurements, or to one plan that is part of no
campaign, or to none. A plan of another campaign, or with another name, begins a new session; one that comes back
is met with what was measured of it. Everything is in the store before it counts here, so that a session made
from the same store is the same session.

What was measured for a validation takes no part in the fit: it is held out, and tells the error of the estimate
beside it. It joins the fit when a plan for the fit, of the same campaign, wants its configuration measured and
has no other measurement of it: so a campaign says that a validation contradicted the estimate.

A recording that is played twice, or two that overlap, count once: the robot cannot stand still twice at the same
time. A standstill whose stamps overlap those of a measurement at the same place *is* that measurement, also after
a restart; one that was withdrawn stays withdrawn.

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
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib_planner.acquisition import Rejection, Standstill, mean_std
from calib_planner.arrays import FloatArray
from calib_planner.campaign import FIT, VALIDATION
from calib_planner.error_model import ErrorModel
from calib_planner.errors import CalibPlannerError, InputError, NotEnoughDataError, StoreError, UnknownNameError
from calib_planner.identification import Estimate, IdentificationProblem, identify, validate
from calib_planner.io import (
    ACCEPTED,
    KEPT,
    NOT_IN_PLAN,
    NOT_STORED,
    OUTLIER,
    UNDONE,
    NamedPlan,
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

    def fits_like(self, other: Matching) -> bool:
        """Whether the same measurements give the same estimate."""
        names = ("sigma", "repeatability", "accuracy_frame")
        same = all(getattr(self, n) == getattr(other, n) for n in names)
        return same and self.error_model is other.error_model


@dataclass(frozen=True)
class TooFew:
    """There is no estimate: ``missing`` more configurations are needed at least; 0 if identification failed."""

    missing: int
    message: str


class Session:
    """Measurements of one campaign or one plan by one robot.

    Args:
        nominal: The robot; its free parameters are those that the identifier chooses without a plan.
        follow: Chooses the robot's free parameters for a plan.
        store: Holds everything; the session in it goes on.

    Attributes:
        campaign_id: The campaign; empty: none.
        plans: The newest plan of each role, the one that is measured now last; empty without a plan.
        robot: The robot whose parameters are identified now.
        records: The measurements in use, in the order of measuring: accepted, or an outlier at present. Those for
            validation are held out.
        newest: The estimate from ``records``; ``None`` if it has to be made anew.
        settled: Whether ``newest`` is a full fit.

    Raises:
        CalibPlannerError: What the store holds does not fit the robot.
    """

    def __init__(self, nominal: Robot, follow: Callable[[Plan], Robot], store: SessionStore) -> None:
        self.nominal, self.robot, self.follow, self.store = nominal, nominal, follow, store
        self._enter(store.current() or StoredSession(0))

    def _enter(self, stored: StoredSession, *, begun: bool = True) -> None:
        """Go on with a session; ``begun``: the store knows its plan."""
        in_use = [r for r in stored.records if r.status in KEPT]
        others = [r for r in stored.records if r.status not in KEPT]
        self.number, self.campaign_id, self.plans = stored.number, stored.campaign_id, stored.plans
        self._begun, self._undecided = begun and stored.number > 0, list[Record]()
        self.records, self._others = in_use, Counter(r.status for r in others)
        self._withdrawn = [r for r in others if r.status == UNDONE]
        self._refused = {_marks(r): r.number for r in others}
        self._unsaved: dict[int, Record] = {}
        self._changed()

    def _changed(self) -> None:
        """Forget the estimate: measurements of the fit or their plan are others now."""
        plan = self._plan_of(FIT) or self.plan
        self.robot = self.nominal if plan is None else self.follow(plan)
        self.newest: Estimate | TooFew | None = None
        self.settled = False
        self._fit: tuple[Matching, Estimate | TooFew] | None = None
        self._start: Estimate | None = None

    def begin(
        self,
        plan_id: str,
        plan: Plan,
        tolerance: float,
        *,
        campaign_id: str = "",
        role: str = FIT,
        keep: bool = False,
    ) -> bool:
        """Take a plan; ``False`` if it is the current one.

        A plan that cannot be stored now is taken all the same, and stored before the first measurement.

        Args:
            plan_id: Name of the plan.
            plan: The plan.
            tolerance: See ``Matching``.
            campaign_id: The campaign that the plan is part of; empty: none.
            role: What is measured by it, ``fit`` or ``validation``.
            keep: Whether a new plan that is part of no campaign begins with the measurements of the plan before,
                if that is part of none either.

        Raises:
            InputError: The plan is for another robot, or another plan has its name.
        """
        if plan.robot != self.nominal.name:
            raise UnknownNameError("plan.robot", cut(plan.robot, 100), [self.nominal.name])
        if plan.joint_names != self.nominal.joint_names:
            got = listed(plan.joint_names)
            raise InputError("plan.joint_names", got, ", ".join(self.nominal.joint_names))
        self.follow(plan)
        known = self.store.find(plan_id, plan, campaign_id, role)
        new = NamedPlan(plan_id, plan, role)
        if self.plan is not None and (self.campaign_id, self.plan_id) == (campaign_id, plan_id):
            return False
        if campaign_id and self.campaign_id == campaign_id:
            self._take_plan(new, tolerance)
            return True
        carried = tuple(self.records) if keep and not campaign_id and not self.campaign_id else ()
        self._enter(known or StoredSession(0, (), carried, campaign_id), begun=False)
        self._undecided = [] if known is not None else list(carried)
        self._take_plan(new, tolerance)
        return True

    def _take_plan(self, new: NamedPlan, tolerance: float) -> None:
        """Measure a plan of this session from now on; measurements near its rows belong to them."""
        before = next((p for p in self.plans if p.role == new.role), None)
        self.plans = (*(p for p in self.plans if p.role != new.role), new)
        if before is None or before.plan_id != new.plan_id:
            matched = matched_anew(self.records, new, tolerance)
            pairs = zip(self.records, matched, strict=True)
            changed = {r.number for old, r in pairs if old is not r} | {r.number for r in self._undecided}
            changed |= self._unsaved.keys()
            self.records, self._undecided = matched, [r for r in matched if r.number in changed]
            self._unsaved = {}
        self._begun = False
        self._changed()
        with suppress(StoreError):
            self._ensure_begun()

    def _ensure_begun(self) -> int:
        """Number of the session, which is in the store with its plan from now on."""
        if not self._begun:
            role = self.plans[-1].role if self.plans else FIT
            stored = self.store.begin(self.plan_id, self.plan, self._undecided, self.campaign_id, role)
            self.number, self._undecided, self._begun = stored.number, [], True
        return self.number

    def reset(self) -> int:
        """Begin again without measurements; returns how many were in use.

        Raises:
            StoreError: That cannot be stored; nothing was changed.
        """
        count, role = len(self.records), self.plans[-1].role if self.plans else FIT
        self._enter(self.store.restart(self.plan_id, self.plan, self.campaign_id, role))
        return count

    def take(
        self, standstill: Standstill, how: Matching, frame: str = "", objection: tuple[str, str] | None = None
    ) -> Record:
        """Accept a standstill if it fits and can be stored; returns what became of it.

        One that is a measurement already, see the top of the file, returns that and changes nothing.

        Args:
            standstill: The standstill.
            how: How it is matched.
            frame: Frame of its points.
            objection: Status and reason of a rejection that was decided elsewhere.
        """
        again = self._measured_before(standstill, how.tolerance)
        if again is not None:
            return again
        index, reason = self._match(standstill.joints, how)
        if objection is not None:
            return self._reject(Record(standstill, *objection, index, 0, frame=frame))
        if reason and not how.accept_unplanned:
            return self._reject(Record(standstill, NOT_IN_PLAN, reason, None, 0, frame=frame))
        if len(self.records) >= how.most:
            reason = f"no more than {how.most} measurements are used: raise most_measurements or call ~/reset"
            return self._reject(Record(standstill, NOT_IN_PLAN, reason, index, 0, frame=frame))
        role = self.plans[-1].role if self.plans else FIT
        record = Record(standstill, ACCEPTED, "", index, self.done()[index], frame=frame, role=role)
        try:
            record = replace(record, number=self.store.record(self._ensure_begun(), record))
        except StoreError as error:
            self._others[NOT_STORED] += 1
            return record.now(NOT_STORED, f"not stored: {error}")
        self.records.append(record)
        self._forget(record)
        return record

    def _measured_before(self, standstill: Standstill, tolerance: float) -> Record | None:
        """The measurement that a standstill is: at the same time and place."""
        taken = (*self.records, *self._withdrawn)
        return next((r for r in taken if standstill.is_again(r.standstill, tolerance)), None)

    def _forget(self, record: Record) -> None:
        """Make the estimate anew: a record came or goes; one that is held out leaves the fit as it is."""
        self.newest = None
        if record.role == FIT:
            self._fit = None

    def refuse(self, rejection: Rejection, frame: str = "") -> Record:
        """Note a standstill that gave no measurement."""
        return self._reject(Record(rejection, rejection.reason.value, rejection.message, None, 0, frame=frame))

    def _reject(self, record: Record) -> Record:
        """Count it once, and store it if that is possible: a rejection need not survive a restart."""
        marks = _marks(record)
        if marks in self._refused:
            return replace(record, number=self._refused[marks])
        self._others[record.status] += 1
        if self._others.total() > MOST_REJECTIONS:
            return record
        with suppress(StoreError):
            record = replace(record, number=self.store.record(self._ensure_begun(), record))
        self._refused[marks] = record.number
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
        if status == UNDONE:
            self._withdrawn.append(gone)
        self._forget(record)
        return gone

    @property
    def plan_id(self) -> str:
        """Name of the plan that is measured now; empty without a plan."""
        return self.plans[-1].plan_id if self.plans else ""

    @property
    def plan(self) -> Plan | None:
        """The plan that is measured now."""
        return self.plans[-1].plan if self.plans else None

    def _plan_of(self, role: str) -> Plan | None:
        return next((p.plan for p in self.plans if p.role == role), None)

    def plan_id_of(self, record: Record) -> str:
        """Name of the plan whose row a measurement belongs to; empty: none."""
        names = [p.plan_id for p in self.plans if p.role == record.role]
        return names[0] if names and record.index is not None else ""

    @property
    def name(self) -> str:
        """What files of the session are named by: the plan of the fit, if there is one."""
        return next((p.plan_id for p in self.plans if p.role == FIT), self.plan_id)

    def of(self, role: str) -> list[Record]:
        """The measurements in use for the fit, or those that are held out, in the order of measuring."""
        return [r for r in self.records if r.role == role]

    @property
    def frame(self) -> str:
        """Frame of the points in use; empty if there are none, or none was named."""
        return next((r.frame for r in self.records if r.frame), "")

    @property
    def told(self) -> list[Record]:
        """What whoever missed something has to hear: the measurements in use, and those withdrawn on request."""
        return sorted((*self.records, *self._withdrawn), key=lambda r: r.number)

    @property
    def accepted(self) -> list[Record]:
        """The accepted measurements, in the order of measuring."""
        return [r for r in self.records if r.status == ACCEPTED]

    @property
    def rejections(self) -> Counter[str]:
        """Standstills that are not used, by status."""
        return self._others + Counter(r.status for r in self.records if r.status != ACCEPTED)

    def done(self) -> Counter[int | None]:
        """Accepted measurements per row of the plan that is measured now."""
        role = self.plans[-1].role if self.plans else FIT
        return Counter(r.index for r in self.accepted if r.role == role)

    @property
    def configurations(self) -> int:
        """Number of different configurations accepted for the fit, those of no plan included."""
        accepted = [r for r in self.accepted if r.role == FIT]
        unplanned = [r.standstill.joints for r in accepted if r.index is None]
        planned = len({r.index for r in accepted} - {None})
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

    def measurements(self, how: Matching, role: str = FIT) -> Measurements | None:
        """The records of a role, with outliers, as the library's value; ``None`` if there are none."""
        standstills = [r.standstill for r in self.of(role)]
        if not standstills:
            return None
        points = np.array([s.points for s in standstills])
        std = mean_std(standstills, how.sigma, how.repeatability)
        return Measurements(self.robot.joint_names, np.array([s.joints for s in standstills]), points, std)

    def problem(self, how: Matching) -> IdentificationProblem:
        """The problem that ``estimate`` solves.

        Raises:
            NotEnoughDataError: Nothing was measured yet.
        """
        data = self.measurements(how)
        plan = self._plan_of(FIT) or self.plan
        poses = plan.test_poses if plan is not None and len(plan.test_poses) else None
        if data is None:
            raise NotEnoughDataError(0, len(self.robot.parameter_names), "nothing was measured yet")
        frame = "world" if poses is None else how.accuracy_frame
        return IdentificationProblem(
            self.robot, data, error_model=how.error_model, test_poses=poses, accuracy_frame=frame
        )

    def estimate(self, how: Matching, *, settled: bool = False) -> Estimate | TooFew:
        """Identify with the measurements for the fit: in full if ``settled``, from few, and for a complete plan.

        What is held out tells the error beside it (``Estimate.validation``); while only that comes, the fit is
        not made anew.
        """
        known = self._fit
        if known is None or not how.fits_like(known[0]) or (settled and not self.settled):
            known = self._fit = (how, self._identified(how, settled=settled))
        self.newest = self._validated(known[1], how)
        return self.newest

    def _identified(self, how: Matching, *, settled: bool) -> Estimate | TooFew:
        full = settled or self.complete or len(self.of(FIT)) < UPDATED_FROM
        start = None if full else self._start
        try:
            self._start = identify(self.problem(how), start)
            self.settled = start is None
            return self._start
        except NotEnoughDataError as error:
            each = 3 * len(self.robot.targets)
            missing = max(-(-(error.need - error.have) // each), 0)
            text = f"{missing} more configurations needed at least: {error}" if missing else str(error)
            return TooFew(missing, text)
        except (CalibPlannerError, ArithmeticError, ValueError) as error:
            return TooFew(0, f"identification failed: {error}")

    def _validated(self, estimate: Estimate | TooFew, how: Matching) -> Estimate | TooFew:
        held_out = self.measurements(how, VALIDATION)
        if held_out is None or not isinstance(estimate, Estimate):
            return estimate
        try:
            return validate(self.problem(how), estimate, [held_out])
        except (CalibPlannerError, ArithmeticError, ValueError) as error:
            return TooFew(0, f"validation failed: {error}")

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
        fitted = [k for k, r in enumerate(self.records) if r.role == FIT]
        for row, place in enumerate(fitted):
            before, own = self.records[place], rejected[row]
            if not own and before.status == ACCEPTED and not before.unused:
                continue
            unused = tuple(sorted(r.target - 1 for r in own))
            seen = int((before.standstill.samples > 0).sum())
            status = OUTLIER if own and len(own) == seen else ACCEPTED
            if (status, unused) != (before.status, before.unused):
                reason = "; ".join(f"target {r.target}: {r.reason}" for r in own)
                self.records[place] = before.now(status, reason, unused)
                changed.append(self.records[place])
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


def matched_anew(records: Sequence[Record], new: NamedPlan, tolerance: float) -> list[Record]:
    """The records, those of a plan's role at its rows; those near no row are in use without one.

    What was held out joins the fit where a plan for the fit has a row that nothing else was measured for.
    """
    done: Counter[int | None] = Counter()
    result = list(records)
    for k, record in enumerate(records):
        if record.role == new.role:
            distance = np.abs(new.plan.configurations - record.standstill.joints).max(axis=1)
            index = _nearest_row(new.plan, distance, done, tolerance)
            repetition = done[index]
            done[index] += record.status == ACCEPTED
            if (index, repetition) != (record.index, record.repetition):
                result[k] = replace(record, index=index, repetition=repetition)
    for k, record in enumerate(records):
        if record.role == VALIDATION and new.role == FIT:
            distance = np.abs(new.plan.configurations - record.standstill.joints).max(axis=1)
            index = _nearest_row(new.plan, distance, done, tolerance)
            if index is not None and done[index] < new.plan.repetitions[index]:
                result[k] = replace(record, role=FIT, index=index, repetition=done[index])
                done[index] += 1
    return result


def _marks(record: Record) -> tuple[int, int, str]:
    """What tells a standstill that is not used from others: when it was, and why."""
    return record.acquired.start, record.acquired.end, record.status


FIELD = "save_folder"
LONGEST_NAME = 40


def save(folder: str, session: Session, how: Matching, urdf: str = "") -> list[Path]:
    """Write what was measured, and the estimate, as far as there are any; returns the paths.

    ``measurements_PLAN.csv`` holds what is fitted, ``validation_PLAN.csv`` what is held out, and
    ``estimate_PLAN.yaml`` the estimate with its error on what is held out. PLAN is the plan for the fit.

    Args:
        folder: The folder that the user chose.
        session: What to save.
        how: How standstills are weighted.
        urdf: The robot's nominal URDF; unless it is empty, ``calibrated_PLAN.urdf`` is written, too.

    Raises:
        InputError: No folder was chosen, or it cannot be written to.
        NotEnoughDataError: Nothing was measured.
    """
    measured = {"measurements": session.measurements(how), "validation": session.measurements(how, VALIDATION)}
    if not session.records:
        _chosen(folder)
        raise NotEnoughDataError(0, 1, "nothing was measured yet, so there is nothing to save")
    name, paths = plan_name(session.name), list[Path]()
    for kind, data in measured.items():
        if data is not None:
            paths.append(confined(folder, f"{kind}_{name}.csv"))
            write_measurements(paths[-1], data, FIELD)
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

    path = confined(folder, f"report_{plan_name(session.name)}.html")
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
