# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Makes ``import worlds`` work."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
