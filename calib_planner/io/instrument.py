"""The instrument as YAML: what its coordinates are worth. See ``instrument.noise`` and config/instruments/.

type: isotropic                     type: laser_tracker
sigma: 3.0e-5                       range_sigma: 5.0e-6         # [m]
                                    range_per_metre: 1.5e-7     # [m/m]
                                    azimuth: 5.5e-6             # [rad]
                                    elevation: 5.5e-6           # [rad]
                                    station: [4.0, 1.5, 1.2]    # frame of positions [m]
                                    up: [0, 0, 1]
"""

from __future__ import annotations

from pathlib import Path

from calib_planner.io.yaml import Section, read_mapping
from calib_planner.tracker import Isotropic, LaserTracker, Noise

TRACKER_NUMBERS = ("range_sigma", "range_per_metre", "azimuth", "elevation")
KEYS = {"isotropic": ("sigma",), "laser_tracker": (*TRACKER_NUMBERS, "station", "up")}


def read_instrument(path: str | Path) -> Noise:
    """Read a noise model; keys left out have the values of its class.

    Raises:
        FileFormatError: Names the key at fault, what it holds and what is valid.
    """
    top = Section(Path(path), "", read_mapping(path, "a YAML file of an instrument"))
    kind = top.text("type")
    if kind not in KEYS:
        raise top.error("type", repr(kind)[:60], f"one of: {', '.join(KEYS)}")
    required = ("sigma",) if kind == "isotropic" else ("station",)
    top.only(("type", *KEYS[kind]), required)
    if kind == "isotropic":
        return top.made(lambda: Isotropic(top.number("sigma")))
    nominal, station = LaserTracker(), top.numbers("station", 3)
    along, growth, azimuth, elevation = (top.number(k, getattr(nominal, k)) for k in TRACKER_NUMBERS)
    up = top.numbers("up", 3) if "up" in top.values else nominal.up
    return top.made(lambda: LaserTracker(along, growth, azimuth, elevation, station, up))
