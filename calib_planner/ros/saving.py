"""Writes what a campaign measured and identified into the folder that the user chose, and nowhere else.

File names are made of the plan's name, which comes over the wire: only letters, digits, ``-`` and ``_`` of it
become part of them, with a hash where something was left out, so that two plans never share a file. A file name
that is a symbolic link already is refused: what it points at is not in the folder.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from calib_planner.errors import InputError, NotEnoughDataError
from calib_planner.identification import Estimate
from calib_planner.io import calibrated_urdf, write_estimate, write_measurements, write_text
from calib_planner.report import InputFile, Provenance, write_report
from calib_planner.ros.campaign import Campaign, Matching

FIELD = "save_folder"
LONGEST_NAME = 40


def save(folder: str, campaign: Campaign, how: Matching, urdf: str = "") -> list[Path]:
    """Write ``measurements_PLAN.csv`` and, if there is one, ``estimate_PLAN.yaml``; returns the paths.

    Args:
        urdf: The robot's nominal URDF, if it has one: then ``calibrated_PLAN.urdf`` is written, too.

    Raises:
        InputError: No folder was chosen, or it cannot be written to.
        NotEnoughDataError: Nothing was measured.
    """
    data = campaign.measurements(how)
    if data is None:
        _chosen(folder)
        raise NotEnoughDataError(0, 1, "nothing was measured yet, so there is nothing to save")
    name = plan_name(campaign.plan_id)
    paths = [confined(folder, f"measurements_{name}.csv")]
    write_measurements(paths[0], data, FIELD)
    estimate = campaign.newest or campaign.estimate(how)
    if isinstance(estimate, Estimate):
        paths.append(confined(folder, f"estimate_{name}.yaml"))
        write_estimate(paths[-1], estimate, FIELD)
        if urdf:
            paths.append(confined(folder, f"calibrated_{name}.urdf"))
            write_text(paths[-1], calibrated_urdf(urdf, estimate.calibrated)[0], FIELD)
    return paths


def report(folder: str, campaign: Campaign, how: Matching) -> Path:
    """Write ``report_PLAN.html``; returns its path.

    Raises:
        InputError: No folder was chosen, or it cannot be written to.
        NotEnoughDataError: There is no estimate yet.
    """
    path = confined(folder, f"report_{plan_name(campaign.plan_id)}.html")
    estimate = campaign.newest or campaign.estimate(how)
    if not isinstance(estimate, Estimate):
        raise NotEnoughDataError(0, 1, f"there is no estimate to report yet: {estimate.message}")
    model = campaign.store.model
    inputs = (InputFile("robot", model.origin or model.name, model.sha256),)
    write_report(path, campaign.problem(how), estimate, Provenance(inputs), FIELD)
    return path


def plan_name(plan_id: str) -> str:
    """The part of a file name that stands for a plan."""
    name = re.sub(r"[^A-Za-z0-9_-]", "", plan_id)[:LONGEST_NAME]
    if name == plan_id:
        return name or "unplanned"
    return f"{name}-{hashlib.sha256(plan_id.encode('utf-8', 'surrogatepass')).hexdigest()[:8]}"


def confined(folder: str, name: str) -> Path:
    """The path of a file in ``folder``, which is made if it is not there.

    Raises:
        InputError: No folder, or none that can be made; a name that leaves it, or is a link.
    """
    target = _chosen(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        got = f"{folder} ({error.strerror or error})"
        raise InputError(FIELD, got, "a folder that can be written to", "choose another folder") from None
    path = target / name
    if Path(name).name != name or name in ("", ".", "..") or "\0" in name or path.is_symlink():
        raise InputError(FIELD, ascii(str(path))[:200], "a file in this folder itself", "move the link away")
    return path


def _chosen(folder: str) -> Path:
    if not folder:
        advice = "start the node with --ros-args -p save_folder:=FOLDER"
        raise InputError(FIELD, "an empty name", "a folder", advice)
    return Path(folder).expanduser()
