# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Searching plans: one algorithm a file."""
