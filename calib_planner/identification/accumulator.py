"""Identification one configuration at a time: the estimate after every measurement, and undo of any of them.

What is kept is the measurements, each under a number of its own, and the newest estimate. The next estimate is an
``identify`` of what is there then. Near the minimum every step of the Gauss–Newton iteration, eq. (6), divides
the distance to it by orders of magnitude; where a first fit from nominal values has not come as near, the newest
estimate is the place to go on from, and nothing else is taken over from it. All that is decided on the way (which
parameters can be told apart, which points to believe, where the scatter comes from) is decided anew by the data.
So the answer does not depend on the order in which measurements came and went: it is that of the same
measurements given at once.

That holds where there is one minimum to go to. With few data there may be several, and the way tells which is
found: so the way is the batch's, from nominal values, until there are twice as many equations as parameters, and
after an iteration that did not settle.

An information matrix that is updated by a row would be faster and another answer: every new point moves the
linearisation, the closed-form start of an unknown tracker pose, the noise and the points that are believed.

What takes longer than that and changes none of the parameters is left to the end, unless it is asked for: other
starts, which show that the minimum is the only one, and errors of the joints' transmissions.

    accumulator = Accumulator.begin(robot, sigma=3e-5)
    for q, points in measured:
        accumulator = accumulator.with_configuration(q, points)
        show(accumulator.estimate)                     # None while there are too few
    accumulator = accumulator.without(accumulator.ids[3])
    final = identify(replace(accumulator.problem, starts=2, joint_corrections="auto"), accumulator.estimate)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from calib_planner._arrays import check_array
from calib_planner.errors import InputError, NotEnoughDataError, UnknownNameError
from calib_planner.identification.estimate import Estimate
from calib_planner.identification.measurements import Measurements
from calib_planner.identification.problem import IdentificationProblem
from calib_planner.identification.solver import identify
from calib_planner.robot.chain import Robot

UPDATE: Mapping[str, Any] = MappingProxyType({"starts": 0, "joint_corrections": "off", "order_check": "off"})
"""Settings that are other than a problem's own where they are not given."""


@dataclass(frozen=True, eq=False)
class Accumulator:
    """The measurements so far and what they say; a value, made by ``begin``.

    Attributes:
        robot: The nominal robot, its active parameters being those to be identified.
        settings: What else ``IdentificationProblem`` is asked with: ``sigma``, ``loss``, ``prior``, …
        data: The measurements in the order of ``ids``, joints in the robot's order; ``None`` before the first.
        ids: (N,) number of each configuration, given in the order of coming and never again.
        newest: Number that was given last; -1 before the first.
        start: Estimate to begin from, the last one that was asked for.
    """

    robot: Robot
    settings: Mapping[str, Any]
    data: Measurements | None = None
    ids: tuple[int, ...] = ()
    newest: int = -1
    start: Estimate | None = None

    @staticmethod
    def begin(robot: Robot, **settings: Any) -> Accumulator:
        """Without any measurement.

        Args:
            robot: The nominal robot with its active parameters.
            settings: Fields of ``IdentificationProblem`` other than ``robot`` and ``data``; those not given are
                its defaults, but for ``UPDATE``.

        Raises:
            UnknownNameError: No such setting.
            InputError: A value that ``IdentificationProblem`` does not take.
        """
        names = [f.name for f in fields(IdentificationProblem) if f.name not in ("robot", "data")]
        for name in settings:
            if name not in names:
                raise UnknownNameError("settings", name, names)
        settings = {**UPDATE, **settings}
        middle = robot.joint_limits.mean(axis=1)[None]
        # A made-up measurement, to refuse wrong settings before the first real one.
        IdentificationProblem(robot, Measurements(robot.joint_names, middle, robot.positions(middle)), **settings)
        return Accumulator(robot, MappingProxyType(settings))

    def __len__(self) -> int:
        """Number of configurations."""
        return len(self.ids)

    # ── coming and going ─────────────────────────────────────────────────────────────────────────────

    def with_configuration(self, q: ArrayLike, points: ArrayLike, std: ArrayLike | None = None) -> Accumulator:
        """One more configuration; its number is the new ``newest``.

        Args:
            q: (joints,) in the robot's joint order [rad | m].
            points: (targets, 3) in the tracker's frame [m], NaN where a target was not measured; (3,) will do for
                one target.
            std: The same shape: standard deviation of each coordinate [m]; for every configuration or for none.

        Raises:
            InputError: Wrong shape, not finite, some of x, y, z only, or ``std`` for some configurations only.
        """
        targets, joints = len(self.robot.targets), self.robot.joint_names
        q = check_array("configuration", q, (len(joints),), meaning=f"{', '.join(joints)} in rad or m")
        point = _one("points", points, targets)
        return self.with_measurements(
            Measurements(joints, q[None], point, None if std is None else _one("std", std, targets))
        )

    def with_measurements(self, data: Measurements) -> Accumulator:
        """Several more at once, such as a file of earlier ones; numbered in their order.

        Raises:
            InputError: Other joints or targets than the robot's, or ``std`` for some configurations only.
        """
        new = data.in_order_of(self.robot.joint_names)
        if new.p.shape[1] != len(self.robot.targets):
            expected = f"{len(self.robot.targets)}, as the robot has"
            raise InputError("data", f"{new.p.shape[1]} targets", expected, "use robot.with_targets(...)")
        ids = (*self.ids, *range(self.newest + 1, self.newest + 1 + len(new)))
        joined = new if self.data is None else _joined(self.data, new)
        return self._after(joined, ids, self.newest + len(new))

    def without(self, number: int) -> Accumulator:
        """Undo: the same without the configuration of that number, whenever it came.

        Raises:
            InputError: There is no such configuration (any more).
        """
        if number not in self.ids:
            valid = ", ".join(map(str, self.ids)) or "nothing: there are no configurations"
            raise InputError("number", number, f"one of ids: {valid}")
        rest = [row for row, one in enumerate(self.ids) if one != number]
        assert self.data is not None
        data = self.data.select(rest) if rest else None
        return self._after(data, tuple(self.ids[row] for row in rest), self.newest)

    def _after(self, data: Measurements | None, ids: tuple[int, ...], newest: int) -> Accumulator:
        last = self.__dict__.get("_answer")
        start = last if isinstance(last, Estimate) else self.start
        return replace(self, data=data, ids=ids, newest=newest, start=start)

    # ── what they say ────────────────────────────────────────────────────────────────────────────────

    @property
    def problem(self) -> IdentificationProblem:
        """The same question asked at once.

        Raises:
            NotEnoughDataError: Nothing was measured yet.
        """
        if self.data is None:
            raise NotEnoughDataError(0, len(self.robot.parameter_names), "nothing was measured yet")
        return IdentificationProblem(self.robot, self.data, **self.settings)

    @property
    def estimate(self) -> Estimate | None:
        """What the measurements say, found when first asked for; ``None`` while ``shortfall`` tells why not.

        Raises:
            InputError: The points look like millimetres.
        """
        return self._answer if isinstance(self._answer, Estimate) else None

    @property
    def shortfall(self) -> NotEnoughDataError | None:
        """Why there is no estimate yet: equations at hand and needed, in words and numbers; else ``None``."""
        return self._answer if isinstance(self._answer, NotEnoughDataError) else None

    @cached_property
    def _answer(self) -> Estimate | NotEnoughDataError:
        try:
            start = self.start if self.start is not None and _leads(self.start) else None
            return identify(self.problem, start)
        except NotEnoughDataError as error:
            return error


def _leads(estimate: Estimate) -> bool:
    """Whether the next estimate can only be near this one."""
    return estimate.status != "not_converged" and 3 * estimate.used >= 2 * len(estimate.parameters)


def _one(field: str, value: ArrayLike, targets: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(1, targets, 3) of one configuration's (targets, 3), or (3,) where there is one target."""
    array = np.asarray(value)
    shape: tuple[int, ...] = (3,) if targets == 1 and array.ndim == 1 else (targets, 3)
    clean = check_array(field, value, shape, finite=False, meaning="(targets, xyz) in m")
    return clean.reshape(1, targets, 3)


def _joined(first: Measurements, second: Measurements) -> Measurements:
    """Both, one after the other; joints in the same order."""
    if (first.std is None) != (second.std is None):
        got = "configurations with and without"
        raise InputError("std", got, "standard deviations for every configuration or for none")
    std = None if first.std is None else np.concatenate([np.asarray(first.std), np.asarray(second.std)])
    q, p = np.concatenate([first.q, second.q]), np.concatenate([first.p, second.p])
    return Measurements(first.joint_names, q, p, std)
