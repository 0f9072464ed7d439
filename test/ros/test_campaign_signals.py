# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The campaign node as a process that is told to end: the robot stops, a restart goes on with the campaign."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from bench import Bench
from calib_planner_msgs.action import ExecutePlan
from desk import ASKED, Desk, S
from fake_cell import FakeCell
from robots import plan_of, random_configurations, repeats
from warm_processes import Warm

from calib_planner import Robot
from calib_planner.io import open_campaign
from calib_planner.ros.executor import PlanExecution
from calib_planner.ros.lifecycle import LifecycleParameters, ManagedNode
from calib_planner.ros.messages import plan_to_message
from calib_planner.ros.processes import Nodes

NODE = "campaign_node"


class Client(ManagedNode[LifecycleParameters]):
    def __init__(self, **options: Any) -> None:
        super().__init__("execution_client", LifecycleParameters(), **options)


class Restarts:
    """The node, again and again, over one store; each time it ends with status 0 and no traceback."""

    def __init__(self, bench: Bench, folder: Path, warm: Warm) -> None:
        self.bench, self.folder, self.number, self.warm = bench, folder, 0, warm
        self.nodes: Nodes | None = None

    def start(self, **parameters: object) -> None:
        self.number += 1
        self.nodes = Nodes(self.folder / str(self.number), self.bench.domain, self.warm.popen)
        self.nodes.start(NODE, ASKED | {"store_folder": str(self.folder / "store")} | parameters)
        self.bench.wait(lambda: "call ~/" in self.log, 60.0)

    @property
    def log(self) -> str:
        return (self.folder / str(self.number) / f"{NODE}.log").read_text()

    def end(self, number: signal.Signals) -> None:
        assert self.nodes is not None
        assert self.nodes.end(number) == {NODE: 0}, self.nodes.logs()
        assert "Traceback" not in self.log and "Error" not in self.log, self.log

    def measured(self) -> list[int]:
        """Numbers of the measurements in the store, which is whole and which no process holds any more."""
        stored = open_campaign(self.folder / "store", Robot.load("planar_2r"))
        assert stored is not None
        stored.store.close()
        return [number for number, *_ in stored.rows]


@pytest.fixture
def runs(bench: Bench, tmp_path: Path, warm: Warm) -> Iterator[Restarts]:
    made = Restarts(bench, tmp_path, warm)
    yield made
    if made.nodes is not None:
        made.nodes.end(signal.SIGKILL)


@pytest.mark.parametrize(
    "number", repeats([signal.SIGINT], [signal.SIGINT, signal.SIGTERM]), ids=lambda n: n.name
)
def test_told_to_end_the_robot_stops_and_a_restart_goes_on(
    bench: Bench, runs: Restarts, number: signal.Signals
) -> None:
    cell = bench.start(FakeCell)
    cell.answer = lambda q: "hang" if len(cell.visited) == 5 else "ok"
    desk = Desk(bench, elsewhere=True)
    runs.start()
    desk.meet()
    assert desk.call("start")[0]
    told = desk.until(S.MEASURING, 60.0, measured=4)
    bench.wait(lambda: len(cell.visited) == 5)
    runs.end(number)
    assert cell.cancels, "the node ended before the robot's had heard that it is to stop"
    bench.wait(lambda: cell.stopped == 1)
    assert runs.measured() == [1, 2, 3, 4]

    long = number == signal.SIGTERM
    runs.start(**({"starts": 100_000, "time_limit": 600.0} if long else {}))
    again = desk.until(S.PAUSED, 60.0, measured=4)
    assert again.campaign_id == told.campaign_id and "resume" in again.reason and len(cell.visited) == 5
    assert desk.call("pause")[0] and desk.call("resume")[0]
    if long:  # it plans
        desk.until(S.PLANNING, 60.0, measured=4)
        runs.end(number)
        assert runs.measured() == [1, 2, 3, 4]
        runs.start()
        assert desk.call("pause")[0] and desk.call("resume")[0]
    done = desk.until(S.DONE, 60.0)
    assert done.outcome == S.OUTCOME_REACHED and done.campaign_id == told.campaign_id
    runs.end(number)
    assert len(runs.measured()) == done.measured + done.validated


def test_a_request_to_stop_that_is_lost_is_sent_again(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = bench.start(FakeCell)
    cell.answer = lambda q: "hang"
    client = Client(context=bench.context)
    bench.nodes.append(client)  # which nobody spins: as where a node ends
    execution = PlanExecution(client, "tracker_simulator/execute_plan")
    bench.wait(lambda: execution.ready)
    robot = Robot.load("planar_2r")
    plan = plan_to_message(plan_of(robot, random_configurations(robot, 1)), "p", 0, "")
    execution.send(ExecutePlan.Goal(plan=plan))
    bench.wait(lambda: cell.visited)
    with monkeypatch.context() as lost:
        lost.setattr(execution, "_cancel", lambda name: None)
        execution.cancel()
    execution.insist(60.0)
    assert cell.cancels
    bench.wait(lambda: cell.stopped == 1)
    execution.insist(60.0)  # it was answered
