"""Where every part of the robot is, for many configurations at once."""

from __future__ import annotations

from dataclasses import dataclass

from calib_planner._arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Posture:
    """Frames of the chain for N configurations, T targets.

    All in the frame of ``Robot.positions``: the base frame, or the tracker's once the base pose is set.

    Attributes:
        joint_origins: (N, joints, 3) a point on each joint's axis, moved along by a sliding joint [m].
        joint_axes: (N, joints, 3) unit direction in which each joint's coordinate grows: turning
            right-handed about it, or sliding along it.
        tip_origin: (N, 3) origin of the tip's frame [m].
        tip_rotation: (N, 3, 3) the tip's axes as columns: ``tip_rotation @ v_tip = v_base``.
        targets: (N, T, 3) the targets [m].
    """

    joint_origins: FloatArray
    joint_axes: FloatArray
    tip_origin: FloatArray
    tip_rotation: FloatArray
    targets: FloatArray

    def __len__(self) -> int:
        return len(self.tip_origin)

    def rows(self, which: IntArray) -> Posture:
        """The postures with these numbers."""
        return Posture(
            self.joint_origins[which],
            self.joint_axes[which],
            self.tip_origin[which],
            self.tip_rotation[which],
            self.targets[which],
        )
