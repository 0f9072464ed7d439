"""Robot calibration with a laser tracker: where to measure, and what the measurements say.

``Robot`` → ``PlanProblem`` → ``plan`` → ``Plan``;
``Measurements`` → ``IdentificationProblem`` → ``identify`` → ``Estimate``.

Nothing here needs ROS; the nodes live in ``calib_planner.ros``. A name is imported from its room when it is first
used, so that a program pays only for what it needs.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib_planner.errors import (
        CalibPlannerError,
        FileFormatError,
        InfeasibleError,
        InputError,
        NotEnoughDataError,
        UnknownNameError,
    )
    from calib_planner.identification import Estimate, IdentificationProblem, identify, validate
    from calib_planner.io import Robot
    from calib_planner.measurements import Measurements
    from calib_planner.planning import Plan, PlanProblem, Progress, plan

__version__ = "0.1.0"

_ROOMS = {
    "errors": "CalibPlannerError FileFormatError InfeasibleError InputError NotEnoughDataError UnknownNameError",
    "identification": "Estimate IdentificationProblem identify validate",
    "io": "Robot",  # ``Robot.load`` reads files, which is what ``io`` teaches it
    "measurements": "Measurements",
    "planning": "Plan PlanProblem Progress plan",
}
_ROOM_OF = {name: room for room, names in _ROOMS.items() for name in names.split()}

__all__ = [*_ROOM_OF]


def __getattr__(name: str) -> Any:
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value = getattr(import_module(f"{__name__}.{_ROOM_OF[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
