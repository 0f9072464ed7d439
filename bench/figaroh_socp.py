# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""FIGAROH's choice from a pool, in an interpreter that has it: ``python figaroh_socp.py POOL.npz``.

``POOL.npz`` holds ``rows`` (C, 3, p), the base regressor of each candidate. FIGAROH 1.0.2 (figaroh.optimal,
``BaseOptimalCalibration.calculate_optimal_configurations``) turns it into C matrices XᵢᵀXᵢ and hands them to
``SOCPOptimizer``: max t under t ≤ det(Σ wᵢ Xᵢ)^(1/p), Σ w ≤ 1, w ≥ 0, solved by picos and cvxopt; the
configurations with w > 1e-5 are the plan. Its own class is run here, timed as there. Prints JSON.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np


def main(path: str) -> None:
    """Solve and print ``{"seconds": …, "weights": […]}``."""
    from figaroh.optimal.base_optimal_calibration import SOCPOptimizer

    rows = np.load(path)["rows"]
    began = time.perf_counter()
    information = {i: r.T @ r for i, r in enumerate(rows)}
    weights, _ = SOCPOptimizer(information, {"NbSample": len(rows)}).solve()
    seconds = time.perf_counter() - began
    print(json.dumps({"seconds": seconds, "weights": [float(w) for w in weights]}))


if __name__ == "__main__":
    main(sys.argv[1])
