# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""FIGAROH's geometric calibration, in an interpreter that has it.

    python figaroh_identification.py ROBOT.urdf FOLDER

``FOLDER`` holds ``fit.csv`` and ``held_out.csv``: joint columns, then ``x1,y1,z1`` and so on per marker. FIGAROH
1.0.2 (``figaroh.calibration``, ``BaseCalibration``) is run as its documentation says: a task file, a subclass
with a cost function, ``initialize()`` (reads the file, chooses the parameters) and ``solve()`` (closed-form
frames, Levenberg–Marquardt with numeric derivatives, quality report). All six errors of each joint
(``full_params``), base frame and markers unknown, positions measured, everything else as it comes. Four ways:

* Which parameters it keeps: ``structural``, its default, whose six names for the base replace the first six base
  parameters whatever those are; on the UR10 one of them is not of the first joint, and is lost. ``excitation``
  keeps all that the measured configurations tell apart.
* The cost function: ``documented``, the pose residual by logarithm that its documentation and its UR10 example
  use; ``lean``, the difference of positions that it comes to here, without a loop over samples.

Prints JSON, per way ``{"initialize": s, "solve": s, "fit": s, "cpu_seconds": s, "parameters": n, "held_out":
[[x, y, z], …]}``, markers within configurations; ``fit`` is the part of ``solve`` spent in the optimiser,
``cpu_seconds`` the processor's time of initialize and solve.
"""

from __future__ import annotations

import json
import logging
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml


def task(folder: Path, rows: int, markers: int, method: str) -> dict[str, Any]:
    """FIGAROH's configuration of the calibration."""
    measured = {"measurable_dof": [True, True, True, False, False, False]}
    calibration = {
        "enabled": True,
        "type": "kinematic_calibration",
        "kinematics": {"base_frame": "universe", "tool_frame": "flange"},
        "parameters": {"calibration_level": "full_params", "estimation": {"method": method}},
        "measurements": {"markers": [measured] * markers, "poses": {"base_pose": None, "tool_pose": None}},
        "data": {"source_file": str(folder / "fit.csv"), "number_of_samples": rows},
    }
    return {"robot": {"name": "ur10"}, "tasks": {"calibration": calibration}}


def calibrate(urdf: str, folder: Path, method: str, cost: str) -> dict[str, Any]:
    """Time one calibration and predict the held-out configurations."""
    from figaroh.calibration.base_calibration import BaseCalibration
    from figaroh.calibration.calibration_tools import calc_updated_fkm
    from figaroh.data.observations import PoseObservations
    from figaroh.tools.load_robot import load_robot

    class Calibration(BaseCalibration):  # type: ignore[misc]
        spent = 0.0

        def cost_function(self, var: Any) -> Any:
            estimated = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
            if cost == "lean":
                return 1e3 * (estimated - self.PEE_measured)
            residuals = self._compute_logmap_residuals(self.PEE_measured, estimated)
            return self.apply_measurement_weighting(residuals, pos_weight=1000.0, orient_weight=100.0)

        def solve_optimisation(self, *args: Any, **options: Any) -> Any:
            began = time.perf_counter()
            found = super().solve_optimisation(*args, **options)
            self.spent = time.perf_counter() - began
            return found

    header = (folder / "fit.csv").read_text(encoding="utf-8").splitlines()
    markers = sum(name.startswith("x") for name in header[0].split(","))
    with tempfile.NamedTemporaryFile("w", suffix=".yaml", encoding="utf-8") as file:
        yaml.safe_dump(task(folder, len(header) - 1, markers, method), file)
        file.flush()
        calibration = Calibration(load_robot(urdf), file.name)
        # Its examples state here what is unknown; the task file has no word for it.
        calibration.calib_config.update(known_baseframe=False, known_tipframe=False)
        began, cpu = time.perf_counter(), time.process_time()
        calibration.initialize()
        ready = time.perf_counter()
        calibration.solve(enable_logging=False)
        done, cpu = time.perf_counter(), time.process_time() - cpu
    config = calibration.calib_config
    other = PoseObservations.from_csv(str(folder / "held_out.csv"), calibration.model, config)
    _, q = other.to_legacy(calibration.model, config)
    flat = calc_updated_fkm(
        calibration.model, calibration.data, calibration.var_, q, dict(config, NbSample=len(q))
    )
    points = np.asarray(flat).reshape(markers, 3, len(q)).transpose(2, 0, 1).reshape(-1, 3)
    result = {"initialize": ready - began, "solve": done - ready, "fit": calibration.spent, "cpu_seconds": cpu}
    return result | {"parameters": len(calibration.var_), "held_out": points.tolist()}


def main(urdf: str, folder: Path) -> None:
    """Calibrate in all four ways."""
    logging.disable(logging.WARNING)
    ways = [(method, cost) for method in ("structural", "excitation") for cost in ("documented", "lean")]
    answer = {f"{method}, {cost}": calibrate(urdf, folder, method, cost) for method, cost in ways}
    print(json.dumps(answer))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
