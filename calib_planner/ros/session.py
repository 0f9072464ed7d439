"""What has been measured of a plan, and the estimate it gives: the identifier without ROS.

A campaign belongs to one plan (or to none); a plan with another name begins a new one, and a plan that comes back
finds what was measured of it. Everything is in the store before it is in force here, so that a campaign made from
the same store is this campaign again.

Which points to believe is decided by all measurements together, from the beginning, every time one comes or goes
(χ² against the estimate of the others, ``identification.robust``): an outlier of today may be vindicated by
tomorrow's measurements. What changes is told and written, nothing is deleted. The estimate depends on which
measurements there are and on nothing else, which makes it the same after a restart.
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
from calib_planner.errors import CalibPlannerError, InputError, NotEnoughDataError, StoreError, UnknownNameError
from calib_planner.identification import UPDATE, Estimate, IdentificationProblem, identify
from calib_planner.io import (
    ACCEPTED,
    KEPT,
    OUTLIER,
    UNDONE,
    CampaignStore,
    Decision,
    StoredCampaign,
    calibrated_urdf,
    write_estimate,
    write_measurements,
    write_text,
)
from calib_planner.measurements import Measurements, RejectedPoint
from calib_planner.planning import Plan
from calib_planner.report import InputFile, Provenance, write_report
from calib_planner.robot import Robot
from calib_planner.units import brief, cut, listed

MOST_REJECTIONS = 10_000
"""Rejected standstills of a campaign that are written; more are only counted: nobody shall fill the disk."""
NOT_STORED = "not_stored"


@dataclass(frozen=True)
class Matching:
    """How standstills are matched and weighted.

    Attributes:
        tolerance: Largest joint difference to a planned configuration [rad | m].
        accept_unplanned: Use standstills in no plan.
        sigma: Standard deviation of one coordinate of one sample [m]; 0: from the samples' scatter.
        repeatability: Standard deviation that averaging does not reduce [m].
        most: Measurements kept at most.
    """

    tolerance: float = 0.01
    accept_unplanned: bool = False
    sigma: float = 3e-5
    repeatability: float = 0.0
    most: int = 5000


@dataclass(frozen=True)
class TooFew:
    """No estimate yet: ``missing`` is how many configurations at least are still needed; 0: it failed."""

    missing: int
    message: str


class Campaign:
    """Measurements of one plan by one robot.

    Args:
        nominal: The robot, its active parameters being the identifier's own choice.
        follow: Chooses the robot's active parameters for a plan.
        store: Where everything is kept; the campaign in it goes on.

    Attributes:
        plan_id, plan: The plan, if any.
        robot: The robot whose parameters are identified now.
        kept: What the identification is given, in the order of measuring: accepted, or an outlier for now.
        newest: The last estimate, of what is in ``kept``; ``None`` if it has to be made anew.

    Raises:
        CalibPlannerError: What the store holds does not fit the robot.
    """

    def __init__(self, nominal: Robot, follow: Callable[[Plan], Robot], store: CampaignStore) -> None:
        self.nominal, self.robot, self.follow, self.store = nominal, nominal, follow, store
        self.kept: list[Decision] = []
        self.newest: Estimate | TooFew | None = None
        self._unsaved: dict[int, Decision] = {}
        self._others: Counter[str] = Counter()
        self._enter(store.current() or StoredCampaign(0, "", None, ()))

    # ── plans ────────────────────────────────────────────────────────────────────────────────────────

    def begin(self, plan_id: str, plan: Plan, tolerance: float, *, keep: bool = False) -> bool:
        """Take a plan; ``False`` if it is the current one.

        A plan that cannot be written now is taken all the same, and written before the first measurement.

        Args:
            tolerance: See ``Matching``.
            keep: A plan that is new goes on with the measurements of the one before.

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
        carried = _matched_anew(self.kept, plan, tolerance) if keep and known is None else ()
        try:
            self._enter(self.store.begin(plan_id, plan, carried))
        except StoreError:
            self._enter(replace(known or StoredCampaign(0, plan_id, plan, carried), number=0))
        return True

    def _enter(self, stored: StoredCampaign) -> None:
        robot = self.nominal if stored.plan is None else self.follow(stored.plan)
        self.number, self.plan_id, self.plan, self.robot = stored.number, stored.plan_id, stored.plan, robot
        self.kept = [d for d in stored.decisions if d.status in KEPT]
        self._others = Counter(d.status for d in stored.decisions if d.status not in KEPT)
        self.newest, self._unsaved = None, {}

    def _ensure_begun(self) -> int:
        """Number of the campaign, which is in the store from now on."""
        if self.number == 0:
            self.number = self.store.begin(self.plan_id, self.plan, self.kept).number
        return self.number

    def reset(self) -> int:
        """Leave all measurements behind; returns how many.

        Raises:
            StoreError: That cannot be written; nothing was changed.
        """
        count = len(self.kept)
        self._enter(self.store.restart(self.plan_id, self.plan))
        return count

    # ── measurements come and go ─────────────────────────────────────────────────────────────────────

    def take(
        self, found: Standstill, how: Matching, frame: str = "", objection: tuple[str, str] | None = None
    ) -> Decision:
        """Decide on a standstill, and keep it if it is accepted and written.

        Args:
            frame: Frame of its points.
            objection: Status and reason of a rejection that was decided elsewhere.
        """
        index, reason = self._match(found.joints, how)
        if objection is not None:
            return self._reject(Decision(found, *objection, index, 0, frame=frame))
        if reason and not how.accept_unplanned:
            return self._reject(Decision(found, "not_in_plan", reason, None, 0, frame=frame))
        if len(self.kept) >= how.most:
            reason = f"{how.most} measurements are kept at most: raise most_measurements or call ~/reset"
            return self._reject(Decision(found, "not_in_plan", reason, index, 0, frame=frame))
        decision = Decision(found, ACCEPTED, "", index, self.done()[index], frame=frame)
        try:
            decision = replace(decision, number=self.store.record(self._ensure_begun(), decision))
        except StoreError as error:
            self._others[NOT_STORED] += 1
            return decision.now(NOT_STORED, f"not stored: {error}")
        self.kept.append(decision)
        self.newest = None
        return decision

    def refuse(self, found: Rejection, frame: str = "") -> Decision:
        """Note a standstill that was none."""
        return self._reject(Decision(found, found.reason.value, found.message, None, 0, frame=frame))

    def _reject(self, decision: Decision) -> Decision:
        """Count it, and write it if that is possible: it was not promised to anybody."""
        self._others[decision.status] += 1
        if self._others.total() > MOST_REJECTIONS:
            return decision
        try:
            return replace(decision, number=self.store.record(self._ensure_begun(), decision))
        except StoreError:
            return decision

    def undo(self, number: int = 0) -> Decision | None:
        """Withdraw a measurement, 0 for the newest; ``None`` if there is no such measurement in use.

        Raises:
            StoreError: That cannot be written; nothing was changed.
        """
        last = next((d for d in reversed(self.kept) if number in (0, d.number)), None)
        if last is None:
            return None
        return self.withdraw(last, UNDONE, "withdrawn on request")

    def withdraw(self, kept: Decision, status: str, reason: str) -> Decision:
        """Use one of ``kept`` no more.

        Raises:
            StoreError: That cannot be written; nothing was changed.
        """
        gone = kept.now(status, reason)
        self.store.decide(self._ensure_begun(), [gone])
        self.kept.remove(kept)
        self._unsaved.pop(kept.number, None)
        self._others[status] += 1
        self.newest = None
        return gone

    # ── what there is ────────────────────────────────────────────────────────────────────────────────

    @property
    def frame(self) -> str:
        """Frame of the points that are kept; empty if none is, or none was named."""
        return next((d.frame for d in self.kept if d.frame), "")

    @property
    def accepted(self) -> list[Decision]:
        """What is used, in the order of measuring."""
        return [d for d in self.kept if d.status == ACCEPTED]

    @property
    def rejections(self) -> Counter[str]:
        """Standstills that are not used, by status."""
        return self._others + Counter(d.status for d in self.kept if d.status != ACCEPTED)

    def done(self) -> Counter[int | None]:
        """Accepted measurements per row of the plan."""
        return Counter(d.index for d in self.accepted)

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
        """Row of the plan and, if there is none, why. Unfinished rows come first, then the nearest."""
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

    # ── the estimate ─────────────────────────────────────────────────────────────────────────────────

    def measurements(self, how: Matching) -> Measurements | None:
        """What is kept, outliers and all, as the library's value; ``None`` if there is nothing."""
        if not self.kept:
            return None
        found = [d.standstill for d in self.kept]
        points = np.array([f.points for f in found])
        std = mean_std(found, how.sigma, how.repeatability)
        q = np.array([f.joints for f in found])
        return Measurements(self.robot.joint_names, q, points, std)

    def problem(self, how: Matching) -> IdentificationProblem:
        """What is asked of the identification.

        Raises:
            NotEnoughDataError: Nothing was measured yet.
        """
        data = self.measurements(how)
        poses = self.plan.test_poses if self.plan is not None and len(self.plan.test_poses) else None
        if data is None:
            raise NotEnoughDataError(0, len(self.robot.parameter_names), "nothing was measured yet")
        # At every standstill: what takes long is left to the finished campaign, or to its analysis.
        quick = dict(UPDATE) | ({"order_check": "auto"} if self.complete else {})
        return IdentificationProblem(self.robot, data, loss="robust", test_poses=poses, **quick)

    def estimate(self, how: Matching) -> Estimate | TooFew:
        """Identify with what there is."""
        try:
            self.newest = identify(self.problem(how))
        except NotEnoughDataError as error:
            each = 3 * len(self.robot.targets)
            missing = max(-(-(error.need - error.have) // each), 0)
            text = f"{missing} more configurations needed at least: {error}" if missing else str(error)
            self.newest = TooFew(missing, text)
        except (CalibPlannerError, ArithmeticError, ValueError) as error:
            self.newest = TooFew(0, f"identification failed: {error}")
        return self.newest

    def judge(self) -> list[Decision]:
        """Those of ``kept`` about which the newest estimate thinks otherwise than before.

        What cannot be written now is written with the next: the data it follows from are there.
        """
        rejected = defaultdict(list)
        for point in self.newest.points.rejected if isinstance(self.newest, Estimate) else ():
            rejected[point.row].append(point)
        changed = []
        for row, before in enumerate(self.kept):
            own = rejected[row]
            if not own and before.status == ACCEPTED and not before.unused:
                continue
            unused = tuple(sorted(r.target - 1 for r in own))
            seen = int((before.standstill.samples > 0).sum())
            status = OUTLIER if own and len(own) == seen else ACCEPTED
            if (status, unused) != (before.status, before.unused):
                self.kept[row] = before.now(status, _reasons(own), unused)
                changed.append(self.kept[row])
        self._unsaved |= {d.number: d for d in changed}
        if self._unsaved:
            try:
                self.store.decide(self._ensure_begun(), list(self._unsaved.values()))
                self._unsaved = {}
            except StoreError:
                return changed
        return changed


def condition_of(estimate: Estimate) -> float:
    """Condition number of the identified parameters, each in units of its own standard deviation; NaN if unknown.

    The square root of that of their correlations: as for a Jacobian, 1 is best.
    """
    variances = np.diag(estimate.fit.covariance)
    found = np.isfinite(variances) & (variances > 0)
    if not found.any():
        return float("nan")
    scale = np.sqrt(variances[found])
    values = np.linalg.eigvalsh(estimate.fit.covariance[np.ix_(found, found)] / np.outer(scale, scale))
    return float(np.sqrt(values[-1] / values[0])) if values[0] > 0 else float("inf")


def _reasons(rejected: Iterable[RejectedPoint]) -> str:
    """Why points are not used, in words."""
    return "; ".join(f"target {r.target}: {r.reason}" for r in rejected)


def _nearest_row(plan: Plan, distance: FloatArray, done: Counter[int | None], tolerance: float) -> int | None:
    """Row of a plan within ``tolerance``: one that is not finished if there is one, then the nearest."""
    near = np.flatnonzero(distance <= tolerance)
    return min((int(i) for i in near), key=lambda i: (done[i] >= plan.repetitions[i], distance[i]), default=None)


def _matched_anew(kept: Iterable[Decision], plan: Plan, tolerance: float) -> tuple[Decision, ...]:
    """Measurements of another plan, at the rows of this one; those of none stay in use, unplanned."""
    done: Counter[int | None] = Counter()
    carried = []
    for decision in kept:
        distance = np.abs(plan.configurations - decision.standstill.joints).max(axis=1)
        index = _nearest_row(plan, distance, done, tolerance)
        carried.append(replace(decision, index=index, repetition=done[index]))
        done[index] += 1
    return tuple(carried)


# ── Writes what a campaign measured and identified into the folder that the user chose, and nowhere else ────
# File names are made of the plan's name, which comes over the wire: only letters, digits, ``-`` and ``_`` of it
# become part of them, with a hash where something was left out, so that two plans never share a file. A file name
# that is a symbolic link already is refused: what it points at is not in the folder.

FIELD = "save_folder"
LONGEST_NAME = 40


def save(folder: str, campaign: Campaign, how: Matching, urdf: str = "") -> list[Path]:
    """Write ``measurements_PLAN.csv`` and, if there is one, ``estimate_PLAN.yaml``; returns the paths.

    Args:
        urdf: The robot's nominal URDF, if it has one: then ``calibrated_PLAN.urdf`` is written, too.

    Raises:
        InputError: No folder was chosen, or it cannot be written to.
        NotEnoughDataError: Nothing was measured.
    """
    data = campaign.measurements(how)
    if data is None:
        _chosen(folder)
        raise NotEnoughDataError(0, 1, "nothing was measured yet, so there is nothing to save")
    name = plan_name(campaign.plan_id)
    paths = [confined(folder, f"measurements_{name}.csv")]
    write_measurements(paths[0], data, FIELD)
    estimate = campaign.newest or campaign.estimate(how)
    if isinstance(estimate, Estimate):
        paths.append(confined(folder, f"estimate_{name}.yaml"))
        write_estimate(paths[-1], estimate, FIELD)
        if urdf:
            paths.append(confined(folder, f"calibrated_{name}.urdf"))
            write_text(paths[-1], calibrated_urdf(urdf, estimate.calibrated)[0], FIELD)
    return paths


def report(folder: str, campaign: Campaign, how: Matching) -> Path:
    """Write ``report_PLAN.html``; returns its path.

    Raises:
        InputError: No folder was chosen, or it cannot be written to.
        NotEnoughDataError: There is no estimate yet.
    """
    path = confined(folder, f"report_{plan_name(campaign.plan_id)}.html")
    estimate = campaign.newest or campaign.estimate(how)
    if not isinstance(estimate, Estimate):
        raise NotEnoughDataError(0, 1, f"there is no estimate to report yet: {estimate.message}")
    model = campaign.store.model
    inputs = (InputFile("robot", model.origin or model.name, model.sha256),)
    write_report(path, campaign.problem(how), estimate, Provenance(inputs), FIELD)
    return path


def plan_name(plan_id: str) -> str:
    """The part of a file name that stands for a plan."""
    name = re.sub(r"[^A-Za-z0-9_-]", "", plan_id)[:LONGEST_NAME]
    if name == plan_id:
        return name or "unplanned"
    return f"{name}-{hashlib.sha256(plan_id.encode('utf-8', 'surrogatepass')).hexdigest()[:8]}"


def confined(folder: str, name: str) -> Path:
    """The path of a file in ``folder``, which is made if it is not there.

    Raises:
        InputError: No folder, or none that can be made; a name that leaves it, or is a link.
    """
    target = _chosen(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        got = f"{folder} ({error.strerror or error})"
        raise InputError(FIELD, got, "a folder that can be written to", "choose another folder") from None
    path = target / name
    if Path(name).name != name or name in ("", ".", "..") or "\0" in name or path.is_symlink():
        raise InputError(FIELD, brief(str(path), 200), "a file in this folder itself", "move the link away")
    return path


def _chosen(folder: str) -> Path:
    if not folder:
        advice = "start the node with --ros-args -p save_folder:=FOLDER"
        raise InputError(FIELD, "an empty name", "a folder", advice)
    return Path(folder).expanduser()
