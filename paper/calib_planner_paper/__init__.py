# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The paper's tables and figures, computed again: settings → ``reproduce`` → numbers → ``publish`` → files.

The package uses calib_planner through its doors only; ``calib-planner reproduce`` is its command.
"""
