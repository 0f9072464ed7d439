"""Node parameters, declared once from a frozen dataclass: type, default, description, unit, range.

A field is a parameter; ``parameter(...)`` gives it its descriptor. ``NodeParameters`` declares them, refuses
what is out of range with the reason and holds the current values as one immutable object.
"""

from __future__ import annotations

import math
from dataclasses import Field, asdict, field, fields, replace
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from calib_planner.errors import CalibPlannerError

P = TypeVar("P")


def parameter(
    default: Any,
    description: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    read_only: bool = False,
) -> Any:
    """A dataclass field that is a node parameter; ``low`` and ``high`` are both given or both left out."""
    metadata = {
        "description": description,
        "unit": unit,
        "low": low,
        "high": high,
        "read_only": read_only,
    }
    return field(default=default, metadata=metadata)


def descriptor(item: Field[Any]) -> ParameterDescriptor:
    """The ROS descriptor of a dataclass field made with ``parameter``."""
    data = item.metadata
    unit = f" [{data['unit']}]" if data["unit"] else ""
    result = ParameterDescriptor(
        name=item.name, description=data["description"] + unit, read_only=data["read_only"]
    )
    low, high = data["low"], data["high"]
    if low is not None:
        if isinstance(item.default, float):
            span = FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
            result.floating_point_range = [span]
        else:
            span = IntegerRange(from_value=int(low), to_value=int(high), step=0)
            result.integer_range = [span]
    return result


class NodeParameters(Generic[P]):
    """Declares the fields of ``defaults`` on ``node`` and follows changes.

    Attributes:
        value: The current values, an instance of the dataclass.

    Raises:
        CalibPlannerError: The values given at start do not fit together.
        rclpy.exceptions.ParameterException: One has the wrong type or is out of range.
    """

    def __init__(self, node: Node, defaults: P) -> None:
        values = {
            f.name: node.declare_parameter(f.name, getattr(defaults, f.name), descriptor(f)).value
            for f in fields(defaults)  # type: ignore[arg-type]
        }
        self.value: P = replace(defaults, **_plain(values))  # type: ignore[type-var]
        node.add_on_set_parameters_callback(self._refuse)
        node.add_post_set_parameters_callback(self._follow)

    def _refuse(self, changes: list[Parameter]) -> SetParametersResult:
        for change in changes:
            if isinstance(change.value, float) and not math.isfinite(change.value):
                reason = f"{change.name}: {change.value} is not a finite number"
                return SetParametersResult(successful=False, reason=reason)
        try:
            replace(self.value, **self._own(changes))  # type: ignore[type-var]
        except CalibPlannerError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _follow(self, changes: list[Parameter]) -> None:
        self.value = replace(self.value, **self._own(changes))  # type: ignore[type-var]

    def _own(self, changes: list[Parameter]) -> dict[str, Any]:
        names = set(asdict(self.value))  # type: ignore[call-overload]
        return _plain({c.name: c.value for c in changes if c.name in names})


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Sequences from ROS as tuples."""
    scalar = (str, int, float, bool)
    return {k: v if isinstance(v, scalar) else tuple(v) for k, v in values.items()}
