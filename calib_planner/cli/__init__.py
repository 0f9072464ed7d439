# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line ``calib-planner``: arguments in, one library call, result out. No ROS.

``main`` runs a command, ``parser`` is the parser of all commands. The other names are for commands of other
packages, such as the paper's; they are imported when they are first used, so that ``--help`` does not pay for
them.

docs/glossary.md explains the words.
"""

from typing import TYPE_CHECKING

from calib_planner.cli.main import (
    CLOSED_PIPE,
    DONE,
    EPILOG,
    FAILED,
    INTERRUPTED,
    WRONG_USAGE,
    main,
    parser,
)
from calib_planner.doors import lazy_door

if TYPE_CHECKING:
    from calib_planner.cli.arguments import Commands, add_command, add_seed
    from calib_planner.cli.terminal import Terminal
else:
    __getattr__, __dir__, __all__ = lazy_door(
        __name__,
        {"arguments": "Commands add_command add_seed", "terminal": "Terminal"},
        *("CLOSED_PIPE", "DONE", "EPILOG", "FAILED", "INTERRUPTED", "WRONG_USAGE", "main", "parser"),
    )
