# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Makes ``import golden`` and ``import cases`` work for the tests of this folder; says how they compared."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    from golden import same_arithmetic

    if not same_arithmetic():
        words = "test/golden: the last digits of this machine are not those of expected/: compared coarsely"
        terminalreporter.write_line(words, yellow=True)
