# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""No link runs into another: with Pinocchio and Coal, from the collision geometry of a URDF.

Pairs that always touch say nothing: geometries of one body (links joined by fixed joints are one) and of bodies
that share a joint are left out. Everything else may not intersect. Pinocchio is imported on first use.
"""

from __future__ import annotations

import threading
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib_planner.arrays import FloatArray
from calib_planner.errors import FileFormatError, InputError, MissingExtraError
from calib_planner.robot import Robot


@dataclass(frozen=True, eq=False)
class SelfCollision:
    """Allowed are configurations in which no two links, other than neighbours, touch.

    Joints are matched by name; joints of the URDF that the robot does not have (a gripper's) stand at zero.

    Attributes:
        urdf_path: A URDF with <collision> geometry.
        package_folder: Where its ``package://`` meshes are, if it has any.
    """

    urdf_path: str | Path
    package_folder: str | Path | None = None
    name: str = "self-collision"

    def __getstate__(self) -> dict[str, Any]:
        """The state without Pinocchio's models: a process that receives a copy builds its own."""
        return {k: v for k, v in self.__dict__.items() if k not in ("_models", "_own")}

    @cached_property
    def _own(self) -> threading.local:
        """What each thread works with: Pinocchio's data, made once."""
        return threading.local()

    @cached_property
    def _models(self) -> tuple[Any, Any]:
        """Pinocchio's model, and its geometry model with the pairs that count."""
        pin = import_pinocchio()
        path = Path(self.urdf_path).expanduser()
        if not path.is_file():
            raise FileFormatError(path, "file", "no such file", "a URDF with collision geometry")
        folders, kind = [str(self.package_folder or path.parent)], pin.GeometryType.COLLISION
        try:
            model = pin.buildModelFromUrdf(str(path))
            geometry = pin.buildGeomFromUrdf(model, str(path), kind, package_dirs=folders)
        except (ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())
            raise FileFormatError(path, "URDF", reason, "a URDF with collision geometry") from None
        bodies = [int(g.parentJoint) for g in geometry.geometryObjects]
        for i, first in enumerate(bodies):
            for j, second in enumerate(bodies[:i]):
                neighbours = first in (second, model.parents[second]) or model.parents[first] == second
                if not neighbours:
                    geometry.addCollisionPair(pin.CollisionPair(j, i))
        if not len(geometry.collisionPairs):
            got = f"{len(bodies)} shapes"
            raise FileFormatError(path, "collision geometry", got, "shapes on links that are not neighbours")
        return model, geometry

    def allowed(self, robot: Robot, q: FloatArray) -> NDArray[np.bool_]:
        """(N, joints) → (N,). Pinocchio takes one configuration at a time.

        Raises:
            MissingExtraError: Pinocchio is not installed.
            FileFormatError: The URDF cannot be read, or has nothing that can collide.
            InputError: The URDF lacks a joint of the robot.
        """
        pin = import_pinocchio()
        model, geometry = self._models
        full = self._coordinates(model, robot, q)
        if not hasattr(self._own, "data"):
            self._own.data = model.createData(), geometry.createData()
            _start_afresh(self._own.data[1])
        data, shapes = self._own.data
        hits = [pin.computeCollisions(model, data, geometry, shapes, row, True) for row in full]
        return ~np.array(hits, dtype=bool)

    def _coordinates(self, model: Any, robot: Robot, q: FloatArray) -> FloatArray:
        """(N, nq) Pinocchio's coordinates: joints without limits are (cos, sin) pairs there."""
        full = np.zeros((len(q), model.nq))
        for joint in model.joints[1:]:
            if joint.nq == 2:
                full[:, joint.idx_q] = 1.0
        names = list(model.names)
        for name, column in zip(robot.joint_names, robot.motions(q).T, strict=True):
            if name not in names:
                valid = f"one of its joints: {', '.join(names[1:])}"
                raise InputError(f"joint {name}", f"not in {self.urdf_path}", valid)
            joint = model.joints[names.index(name)]
            if joint.nq == 2:
                full[:, joint.idx_q], full[:, joint.idx_q + 1] = np.cos(column), np.sin(column)
            else:
                full[:, joint.idx_q] = column
        return full


def _start_afresh(shapes: Any) -> None:
    """Let every search for a collision start from the shapes, not from where the last one ended.

    Coal remembers that place for every pair, and once it is next to zero it misses every collision of the pair
    from there on: 649 of 1 360 among 20 000 configurations of an arm of cylinders. The switch is deprecated, but
    ``gjk_initial_guess``, which is to replace it, does not end the remembering (Coal 3.0.3).
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        for request in shapes.collisionRequests:
            request.enable_cached_gjk_guess = False


def import_pinocchio() -> Any:
    """The module ``pinocchio`` with collision checking.

    Raises:
        MissingExtraError: Not installed.
    """
    try:
        import pinocchio
    except ImportError:
        raise MissingExtraError("collision", "Pinocchio with Coal", "self-collision") from None
    if not hasattr(pinocchio, "computeCollisions"):
        raise MissingExtraError("collision", "Pinocchio with Coal", "self-collision")
    return pinocchio
