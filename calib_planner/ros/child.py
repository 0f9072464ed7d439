"""``python -m calib_planner.ros.child NAME_node …``: a node that ends with the process that started it.

That process holds the other end of this process's standard input and never writes to it. When it ends, even by
``kill -9``, the system closes that end: then the node is told to end, as Ctrl-C would tell it, and a node that
does not end in time is ended. ``processes.Nodes`` starts nodes like this.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading
import time

PATIENCE = 8.0
"""Time that the node has to end by itself [s]."""


def end_with_parent() -> None:
    """Watch standard input from now on."""
    threading.Thread(target=_watch, daemon=True, name="parent").start()


def _watch() -> None:
    while os.read(0, 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(PATIENCE)
    os._exit(1)


def main() -> None:
    """Run the node of the executable ``NAME_node`` (``nodes/NAME.py``) with what follows on the command line."""
    if len(sys.argv) < 2 or not sys.argv[1].isidentifier():
        raise SystemExit("usage: python -m calib_planner.ros.child NAME_node [--ros-args …]")
    end_with_parent()
    node = sys.argv.pop(1).removesuffix("_node")
    runpy.run_module(f"calib_planner.ros.nodes.{node}", run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
