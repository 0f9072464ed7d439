"""The end of a campaign: as message, and as files in the folder that the user chose."""

from __future__ import annotations

from calib_planner_msgs.msg import CalibrationEstimate

from calib_planner.campaign import CampaignResult
from calib_planner.identification import Verdict
from calib_planner.io import write_estimate, write_measurements
from calib_planner.ros.conversions import estimate_to_message
from calib_planner.ros.saving import confined

FIELD = "store_folder"


def reasons_of(verdict: Verdict) -> list[str]:
    """Reasons as lines, each with what to do."""
    return [f"{r.level}: {r.text}{'; ' * bool(r.advice)}{r.advice}" for r in verdict.reasons]


def result_message(result: CampaignResult, campaign_id: str) -> CalibrationEstimate | None:
    """The estimate of the fit with the campaign's verdict, without stamp; ``None`` if there is none."""
    if result.estimate is None or result.fit is None:
        return None
    others = {"verdict": result.verdict.level, "reasons": reasons_of(result.verdict), "plan_id": campaign_id}
    return estimate_to_message(result.estimate, complete=result.outcome == "reached", **others)


def write_result(folder: str, result: CampaignResult, campaign_id: str) -> None:
    """``measurements_ID.csv``, ``validation_ID.csv``, ``estimate_ID.yaml``.

    Raises:
        CalibPlannerError: They cannot be written.
    """
    for name, data in (("measurements", result.fit), ("validation", result.validation)):
        if data is not None:
            write_measurements(confined(folder, f"{name}_{campaign_id}.csv"), data, FIELD)
    if result.estimate is not None:
        write_estimate(confined(folder, f"estimate_{campaign_id}.yaml"), result.estimate, FIELD)
