"""The command line ``calib-planner``: arguments in, one library call, result out. No ROS.

``main`` runs a command. The other names are for commands of other packages, such as the paper's; they are
imported when they are first used, so that ``--help`` does not pay for them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from calib_planner.cli.main import main

if TYPE_CHECKING:
    from calib_planner.cli.arguments import Commands, add_command, add_seed
    from calib_planner.cli.terminal import Terminal

__all__ = ["Commands", "Terminal", "add_command", "add_seed", "main"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{'terminal' if name == 'Terminal' else 'arguments'}"), name)
