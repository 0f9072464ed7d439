"""What an estimate file says, and the calibrated robot rebuilt from it.

The nominal values of base and targets are the closed form's, not the robot's: they are places, not errors. So a
file holds both as they were found. A chain begins with the base's pose,

    T(x, y, z) Rz(yaw) Ry(pitch) Rx(roll) Rx(rx) Ry(ry) Rz(rz),

roll, pitch and yaw being the closed form's orientation, and rx, ry and rz what was identified beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from calib_planner._arrays import FloatArray
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.identification.estimate import ChiSquare
from calib_planner.identification.noise_levels import NoiseLevels
from calib_planner.identification.verdict import Verdict
from calib_planner.robot.chain import Robot
from calib_planner.robot.elements import Element
from calib_planner.robot.joint_corrections import JointCorrections

BASE = ("x", "y", "z", "yaw", "pitch", "roll", "rx", "ry", "rz")
"""The numbers of a base pose, in the order of the chain's first elements."""
SAME = 1e-9
"""Nominal values may differ by this much between the estimate and the robot [m | rad]."""


@dataclass(frozen=True, eq=False)
class SavedCorrections:
    """The complete model: joint corrections and the geometry that belongs with them.

    Attributes:
        corrections: φ of every joint.
        parameters: P names.
        values: (P,) their values beside the corrections, not those of the geometry alone [m | rad].
    """

    corrections: JointCorrections
    parameters: tuple[str, ...]
    values: FloatArray


@dataclass(frozen=True, eq=False)
class SavedEstimate:
    """What an estimate file says.

    Attributes:
        robot: Name of the robot.
        joint_names: Order of joint arrays.
        parameters: P names, the order of all parameter arrays.
        units: ``m`` or ``rad``.
        nominal: (P,) values before; for base and targets the closed-form start [unit].
        values: (P,) identified [unit].
        deviations: (P,) identified value − nominal [unit]; 0 where held.
        std: (P,) standard deviations [unit], NaN where held.
        covariance: (P, P), eq. (11); zero where held.
        sigma: Standard deviation of one coordinate that the covariance rests on [m].
        status: A key of ``identification.estimate.STATUS``.
        base: (9,) the base's pose, see ``BASE`` [m, rad]; ``None`` if the file does not say.
        targets: (targets, 3) in the tip's frame [m]; ``None`` if the file does not say.
        noise: The parts of the scatter, or ``None``.
        chi_square: Whether measurement noise alone explains the residuals, or ``None``.
        verdict: Whether the calibration is good, or ``None``.
        predicted_accuracy_per_test_pose: (K,) [m]; infinite where it rests on what the data cannot see.
        joint_corrections: Errors of the joints' transmissions with their geometry, or ``None``.
        document: Everything that the file holds, as plain values.
    """

    robot: str
    joint_names: tuple[str, ...]
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    nominal: FloatArray
    values: FloatArray
    deviations: FloatArray
    std: FloatArray
    covariance: FloatArray
    sigma: float
    status: str
    base: FloatArray | None
    targets: FloatArray | None
    noise: NoiseLevels | None
    chi_square: ChiSquare | None
    verdict: Verdict | None
    predicted_accuracy_per_test_pose: FloatArray
    joint_corrections: SavedCorrections | None
    document: dict[str, Any]

    def calibrated(self, robot: Robot) -> Robot:
        """The nominal ``robot`` with all parameters found, base and targets too: ``Estimate.calibrated`` again.

        Raises:
            InputError: The estimate is of another robot or version of it, or the file lacks base and targets.
            UnknownNameError: The robot has no parameter of that name.
        """
        moved = self.corrected(robot)
        if self.base is None or self.targets is None:
            raise InputError("estimate", "no base or targets", "a file that holds them", "identify again")
        count = len(BASE)
        head = (replace(e, value=float(v)) for e, v in zip(moved.elements[:count], self.base, strict=True))
        placed = replace(moved, elements=(*head, *moved.elements[count:])).with_targets(self.targets)
        return replace(placed, parameter_names=self.parameters)

    def complete(self, robot: Robot) -> Robot:
        """The geometry that belongs with ``joint_corrections``, right at their ``actual``; base and targets too.

        Without corrections it is ``calibrated``.

        Raises:
            InputError, UnknownNameError: As ``calibrated``.
        """
        placed, found = self.calibrated(robot), self.joint_corrections
        if found is None:
            return placed
        values = dict(zip(found.parameters, found.values.tolist(), strict=True))

        def moved(e: Element) -> Element:
            return replace(e, value=values.get(e.parameter or "", e.value))

        branches = tuple(tuple(map(moved, branch)) for branch in placed.targets)
        return replace(placed, elements=tuple(map(moved, placed.elements)), targets=branches)

    def corrected(self, robot: Robot) -> Robot:
        """The nominal ``robot`` with the errors of its own chain; base and targets stay.

        Raises:
            InputError, UnknownNameError: As ``calibrated``.
        """
        self.check_robot(robot)
        names = self.chain_parameters
        found = dict(zip(self.parameters, self.deviations.tolist(), strict=True))
        return robot.with_deviations({n: found[n] for n in names})

    def check_robot(self, robot: Robot) -> None:
        """Refuse a robot that is not the nominal one of this estimate.

        Raises:
            InputError, UnknownNameError: As ``calibrated``.
        """
        if set(self.joint_names) != set(robot.joint_names):
            wanted = f"the robot's joints {', '.join(robot.joint_names)}"
            raise InputError(
                "estimate", f"joints {', '.join(self.joint_names)}", wanted, "give the robot it is of"
            )
        nominal = {p.name: p.nominal for p in robot.with_parameters(robot.available_parameters).parameters}
        starts = dict(zip(self.parameters, self.nominal.tolist(), strict=True))
        for name in self.chain_parameters:
            if name not in nominal:
                raise UnknownNameError("estimate", name, list(nominal))
            if not abs(starts[name] - nominal[name]) <= SAME:
                got, wanted = f"nominal {starts[name]!r}", f"{nominal[name]!r}, the robot's"
                advice = "give the robot that the estimate was made with"
                raise InputError(f"estimate: {name}", got, wanted, advice)

    @property
    def chain_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that are neither the base's nor the targets'."""
        return tuple(n for n in self.parameters if not n.startswith(("base.", "target_")))
