"""Writes what a campaign measured and identified into the folder that the user chose."""

from __future__ import annotations

import re
from pathlib import Path

from calib_planner.errors import InputError, NotEnoughDataError
from calib_planner.files.estimate_yaml import write_estimate
from calib_planner.files.measurements_csv import write_measurements
from calib_planner.identification.estimate import Estimate
from calib_planner.ros.campaign import Campaign, Matching


def save(folder: str, campaign: Campaign, how: Matching) -> list[Path]:
    """Write ``measurements_PLAN.csv`` and, if there is one, ``estimate_PLAN.yaml``; returns the paths.

    Raises:
        InputError: No folder was chosen, or it cannot be written to.
        NotEnoughDataError: Nothing was measured.
    """
    if not folder:
        advice = "start the node with --ros-args -p save_folder:=FOLDER"
        raise InputError("save_folder", "an empty name", "a folder", advice)
    data = campaign.measurements(how)
    if data is None:
        raise NotEnoughDataError(0, 1, "nothing was measured yet, so there is nothing to save")
    target = Path(folder).expanduser()
    target.mkdir(parents=True, exist_ok=True)
    # The plan's name comes over the wire: only letters, digits, - and _ may become part of a file's name.
    name = re.sub(r"[^A-Za-z0-9_-]", "", campaign.plan_id)[:40] or "unplanned"
    paths = [target / f"measurements_{name}.csv"]
    write_measurements(paths[0], data, "save_folder")
    estimate = campaign.estimate(how)
    if isinstance(estimate, Estimate):
        paths.append(target / f"estimate_{name}.yaml")
        write_estimate(paths[1], estimate, "save_folder")
    return paths
