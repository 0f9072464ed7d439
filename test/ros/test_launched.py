# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""A campaign in two cells at once by the launch file, from start to verdict, with nodes as processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from bench import Bench
from calib_planner_msgs.msg import CampaignStatus
from robots import PROVE
from std_srvs.srv import Trigger

from calib_planner.io import config_folder
from calib_planner.ros.parameters import LATCHED

pytest.importorskip("launch_ros", reason="launch is not among the PyPI wheels")
if not PROVE:
    pytest.skip("make prove: two launches, twelve processes", allow_module_level=True)

FILE = config_folder().parent / "launch" / "campaign.launch.py"
RUN = """
import sys
from launch import LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

path, *words = sys.argv[1:]
service = LaunchService()
arguments = [tuple(word.split(":=")) for word in words]
source = PythonLaunchDescriptionSource(path)
service.include_launch_description(IncludeLaunchDescription(source, launch_arguments=arguments))
sys.exit(service.run())
"""
"""What ``ros2 launch`` does with a file."""
CELL = """robot: planar_2r
targets: [[0, 0, 0], [50mm, 0, 20mm]]
unknown: base,tool
sigma: 20um
required-accuracy: 2mm
test-pose: [[30, 60], [45, 90]]
units: deg
speed: 3
settle: 100ms
dwell: 800ms
budget: 16
validation: 2
store-folder: store
"""


@pytest.fixture
def cells(bench: Bench, tmp_path: Path) -> Any:
    """Namespace → launch, running until the test ends."""
    environment = os.environ | {"ROS_DOMAIN_ID": str(bench.domain), "PYTHONUNBUFFERED": "1"}
    launches = {}
    try:
        for name in ("left", "right"):
            folder = tmp_path / name
            folder.mkdir()
            (folder / "cell.yaml").write_text(CELL)
            words = [f"cell:={folder / 'cell.yaml'}", "simulate:=true", f"namespace:={name}", "port:=0"]
            with (folder / "log").open("wb") as log:
                launches[name] = subprocess.Popen(
                    [sys.executable, "-c", RUN, str(FILE), *words],
                    env=environment,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                )
        yield launches
    finally:
        for launch in launches.values():
            if launch.poll() is None:
                launch.send_signal(signal.SIGINT)
                launch.wait(60)


@pytest.mark.timeout(600)
def test_two_cells_from_start_to_verdict(bench: Bench, tmp_path: Path, cells: Any) -> None:
    heard = {n: bench.hear(CampaignStatus, f"/{n}/calibration_campaign/status", LATCHED) for n in cells}

    def logs() -> str:
        return "\n".join((tmp_path / name / "log").read_text() for name in cells)

    for name, told in heard.items():
        bench.wait(lambda told=told: told, 120.0)
        answer = bench.call(Trigger, f"/{name}/calibration_campaign/start", Trigger.Request())
        assert answer.success, answer.message
    for told in heard.values():
        bench.wait(lambda told=told: told[-1].state == CampaignStatus.DONE, 240.0)
        assert told[-1].outcome == CampaignStatus.OUTCOME_REACHED, logs()
        assert told[-1].validated == 2 and told[-1].robot == "planar_2r"
    for name in cells:
        assert list((tmp_path / name / "store").glob("estimate_*.yaml")), logs()
    for launch in cells.values():
        os.killpg(launch.pid, signal.SIGINT)  # as a terminal: the nodes hear it, and from the launch once more
    assert [launch.wait(60) for launch in cells.values()] == [0, 0], logs()
    assert "Traceback" not in logs() and "has died" not in logs(), logs()
