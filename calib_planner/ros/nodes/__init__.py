# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The nodes, one file each.

Until a node listens to signals (``rclpy_ext.run``), SIGINT ends its process at once and without a word, as
SIGTERM does: where the imports of a program were interrupted interests nobody. That begins here, since this file
is imported before any node and imports nothing slow; it leaves other programs and their handlers alone.
"""

import signal
import sys
import threading
from pathlib import Path


def end_quietly() -> None:
    """SIGINT ends this process at once, unless the program has a handler of its own."""
    main = threading.current_thread() is threading.main_thread()
    if main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def _is_node(program: str) -> bool:
    """Whether a program (``sys.argv[0]``) is a node; ``-m`` while ``python -m`` imports its folder."""
    name = Path(program).name
    file = Path(__file__).parent / f"{name.removesuffix('_node')}.py"
    return program == "-m" or (name.endswith("_node") and file.is_file())


if _is_node(sys.argv[0]):
    end_quietly()
