"""Numbers as people read them."""

from __future__ import annotations

import numpy as np


def length(metres: float) -> str:
    """A length with a unit that suits it."""
    if not np.isfinite(metres):
        return "unlimited"
    if abs(metres) < 1e-3:
        return f"{1e6 * metres:.3g} µm"
    return f"{1e3 * metres:.4g} mm"


def duration(seconds: float) -> str:
    """A time to the precision that a person plans with."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"


def signed(value: float, digits: int) -> str:
    """A number with a true minus sign, without one for what rounds to zero."""
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if float(text) == 0 else text.replace("-", "−")
