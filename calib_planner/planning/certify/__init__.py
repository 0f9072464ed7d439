# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Proving bounds: the sensitivity as a polynomial, its Bernstein form, branch and bound."""
