# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The real thing: planner, identifier and simulator as processes, DDS between them, truth hidden in one."""

from __future__ import annotations

import math
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from calib_planner_msgs.msg import CalibrationEstimate, PlanRequest
from calib_planner_msgs.srv import PlanCalibration
from poses import poses
from robots import repeats
from warm_processes import Warm

from calib_planner import Robot
from calib_planner.ros import demo
from calib_planner.ros.demo import DemoClient
from calib_planner.ros.messages import estimate_from_message
from calib_planner.ros.processes import Nodes, ProcessFailed, own_domain
from calib_planner.simulation import random_deviations

SEED = 11


def test_plan_measure_identify_agree_with_the_truth(warm: Warm, tmp_path: Path) -> None:
    with own_domain() as domain, Nodes(tmp_path, domain, warm.popen) as nodes:
        nodes.start("planner_node", {"starts": 16})
        nodes.start("identifier_node", {"save_folder": f"'{tmp_path}'"})
        exact = {"error_model": "paper"}  # nothing but parameters and noise, which the estimate is held to
        nodes.start("simulator_node", {"seed": SEED, "joint_speed": 12.0, "dwell": 0.7} | exact)
        client = DemoClient(domain, nodes.check)
        try:
            request = PlanRequest(
                robot="kuka_kr270",
                parameters=["lengths+offsets"],
                test_poses=poses(np.radians([0, -60, 90, 0, 45, 0])),
                configurations=6,
                sigma=3e-5 / math.sqrt(20),
                seed=SEED,
            )
            plan = client.request_plan(PlanCalibration.Request(request=request))
            client.wait(lambda: client.identifier_has(plan.plan_id), 60.0, "estimate")
            client.execute(plan, 120.0)
            final = client.estimate
            assert final is not None
            assert client.save().startswith("saved ")
        finally:
            client.close()
        assert nodes.end(signal.SIGINT) == dict.fromkeys(nodes.processes, 0), nodes.logs()
        for name, text in nodes.logs().items():
            assert "Traceback" not in text, (name, text)
    assert final.status == CalibrationEstimate.STATUS_OK and final.complete
    found = estimate_from_message(final)
    robot = Robot.load("kuka_kr270").with_parameters("lengths+offsets")
    truth = random_deviations(robot, SEED)
    off = found.deviations - [truth[n] for n in found.parameters]
    assert found.parameters == robot.parameter_names
    assert (np.abs(off) < 4 * found.std).all(), off / found.std
    assert len(list(tmp_path.glob("measurements_*.csv"))) == 1


@pytest.mark.parametrize("number", repeats([signal.SIGTERM], [signal.SIGINT, signal.SIGTERM]))
def test_a_planner_that_is_planning_ends_with_status_0(
    warm: Warm, tmp_path: Path, number: signal.Signals
) -> None:
    with own_domain() as domain, Nodes(tmp_path, domain, warm.popen) as nodes:
        nodes.start("planner_node", {"starts": 5000})
        client = DemoClient(domain, nodes.check)
        try:
            client.wait(client._plan.service_is_ready, 60.0, "service")
            pose = poses([0.0, -1.0, 1.5, 0.0, 0.8, 0.0])
            wanted = PlanRequest(test_poses=pose, configurations=150, parameters=["full"])
            long = PlanCalibration.Request(request=wanted)
            busy = PlanCalibration.Request(request=PlanRequest(test_poses=pose, configurations=3))

            def planning() -> bool:
                client._plan.call_async(long)
                future = client._plan.call_async(busy)
                client.wait(future.done, 3.0)
                return future.done() and future.result().status == PlanCalibration.Response.BUSY

            client.wait(planning, 60.0, "refusal")
        finally:
            client.close()
        assert nodes.end(number) == {"planner_node": 0}, nodes.logs()
        assert "Traceback" not in nodes.logs()["planner_node"]


def test_a_node_that_fails_is_reported(warm: Warm, tmp_path: Path) -> None:
    with own_domain() as domain, Nodes(tmp_path, domain, warm.popen) as nodes:
        nodes.start("planner_node", {"robt": "planar_2r"})
        client = DemoClient(domain, nodes.check)
        try:
            with pytest.raises(ProcessFailed, match="planner_node ended with status 1") as caught:
                client.wait(lambda: False, 60.0)
        finally:
            client.close()
    assert "did you mean 'robot'" in str(caught.value) and "Traceback" not in str(caught.value)


@pytest.mark.parametrize("option", [["--configurations", "0"], ["--seed", "-1"], ["--none"], ["--seed", "a"]])
def test_wrong_use_of_the_demo(option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        demo.main(option)
    assert caught.value.code == 2 and capsys.readouterr().err


def test_a_demo_that_cannot_be_done(
    warm: Warm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(demo, "Nodes", partial(Nodes, popen=warm.popen))
    monkeypatch.setattr(demo, "LEVEL", "no_such_level")  # the planner refuses the request
    assert demo.main(["--configurations", "3", "--json", "--output", str(tmp_path)]) == 1
    shown = capsys.readouterr()
    assert shown.out == "" and "no_such_level" in shown.err and "Traceback" not in shown.err


def running_with(text: str) -> list[str]:
    """Command lines of processes that name ``text``."""
    lines = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            lines.append(path.read_bytes().replace(b"\0", b" ").decode(errors="replace"))
        except OSError:
            continue
    return [line for line in lines if text in line]


@pytest.mark.parametrize("number", repeats([signal.SIGINT], [signal.SIGINT, signal.SIGTERM]))
def test_an_interrupted_demo_leaves_nothing_behind(tmp_path: Path, number: signal.Signals) -> None:
    command = [sys.executable, "-m", "calib_planner.ros.demo", "--output", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as demo_process:
        deadline = time.monotonic() + 60.0
        while "ready to identify" not in "".join(p.read_text() for p in tmp_path.glob("log/identifier*")):
            assert time.monotonic() < deadline and demo_process.poll() is None
            time.sleep(0.05)
        demo_process.send_signal(number)
        out, err = demo_process.communicate(timeout=60.0)
    assert demo_process.returncode == 130, err
    assert out == "" and "interrupted" in err and "Traceback" not in err
    assert not running_with(str(tmp_path))
