# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Robot calibration with a laser tracker: where to measure, and what the measurements say.

``Robot`` → ``PlanProblem`` → ``plan`` → ``Plan``;
``Measurements`` → ``IdentificationProblem`` → ``identify`` → ``Estimate``.

Nothing here needs ROS; the nodes live in ``calib_planner.ros``. A name is imported from its room when it is first
used, so that a program pays only for what it needs.

The words of this package are explained in docs/glossary.md.
"""

from typing import TYPE_CHECKING

from calib_planner.doors import lazy_door

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
    from calib_planner.planning import (
        Candidates,
        Plan,
        PlanProblem,
        PlanQuality,
        Progress,
        Search,
        plan,
    )
else:
    __getattr__, __dir__, __all__ = lazy_door(
        __name__,
        {
            "errors": "CalibPlannerError FileFormatError InfeasibleError InputError NotEnoughDataError "
            "UnknownNameError",
            "identification": "Estimate IdentificationProblem identify validate",
            "io": "Robot",  # ``Robot.load`` reads files, which is what ``io`` teaches it
            "measurements": "Measurements",
            "planning": "Candidates Plan PlanProblem PlanQuality Progress Search plan",
        },
    )

__version__ = "1.0.0"
