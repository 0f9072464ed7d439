# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m calib_planner`` is ``calib-planner``."""

import sys

from calib_planner.cli import main

if __name__ == "__main__":
    sys.exit(main())
