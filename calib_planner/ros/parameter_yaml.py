"""The files ``config/*.yaml`` of the nodes: written from the dataclasses, so that both say the same.

    python -m calib_planner.ros.parameter_yaml

writes them again after a parameter was added; a test compares.
"""

from __future__ import annotations

from dataclasses import Field, fields
from typing import Any

from calib_planner.io import config_folder
from calib_planner.ros.parameters import constraints_text
from calib_planner.ros.settings import (
    CampaignParameters,
    IdentifierParameters,
    PlannerParameters,
    SimulatorParameters,
)

NODES: dict[str, tuple[type[Any], str]] = {
    "planner": (PlannerParameters, "calibration_planner"),
    "identifier": (IdentifierParameters, "calibration_identifier"),
    "simulator": (SimulatorParameters, "tracker_simulator"),
    "campaign": (CampaignParameters, "calibration_campaign"),
}
"""Name of the file → the parameters and the node's name."""


def yaml_text(name: str) -> str:
    """The text of ``config/NAME.yaml``: every parameter at its default, with its description."""
    kind, node = NODES[name]
    lines = [
        f"# Parameters of the node {node} ({name}_node): every one there is, at its default.",
        f"# Use: python -m calib_planner.ros.{name}_node --ros-args --params-file config/{name}.yaml",
        "/**:",
        "  ros__parameters:",
    ]
    for item in fields(kind):
        lines += [f"    # {_comment(item)}", f"    {item.name}: {_value(item.default)}"]
    return "\n".join(lines) + "\n"


def _comment(item: Field[Any]) -> str:
    unit = f" [{item.metadata['unit']}]" if item.metadata["unit"] else ""
    limits = constraints_text(item)
    return item.metadata["description"] + unit + (f"; {limits}" if limits else "")


def _value(value: Any) -> str:
    """As YAML that ROS reads with the right type: 3e-05 would be a text."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return "[" + ", ".join(value) + "]"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, float):
        text = f"{value:.12f}".rstrip("0")
        return text + "0" if text.endswith(".") else text
    return str(value)


def main() -> int:
    """Write the files."""
    for name in NODES:
        (config_folder() / f"{name}.yaml").write_text(yaml_text(name), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
