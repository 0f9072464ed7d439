# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What asking the planner node costs beside planning: the service's answer against the library's call.

    python bench/plan_service.py [--requests 30]

The node runs in a process of its own. The same request goes to its service and, by turns, to the library in this
process, warmed up. *beside* is the time from the call to the answer less the time that the node's library call
took (``search_time`` of the plan): conversion, validation, middleware both ways, publication. *difference* is the
median of service less library, pair by pair, which a busy machine blurs. Milliseconds of the clock; JSON on
stdout.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import rclpy
from calib_planner_msgs.msg import JointConfiguration, PlanRequest
from calib_planner_msgs.srv import PlanCalibration
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from calib_planner import PlanProblem, Robot, plan
from calib_planner.io import planned_error_model
from calib_planner.planning import Search
from calib_planner.ros.messages import seconds_of
from calib_planner.ros.processes import Nodes, own_domain

ROBOT = "kuka_kr270"
POSE = np.radians([0.0, -60.0, 90.0, 0.0, 45.0, 0.0])
SIGMA = 3e-5
CASES = {"paper, 4": ("paper", 4), "paper, 12": ("paper", 12), "typical, 12": ("typical", 12)}
"""Error model and number of configurations."""
LONGEST = 60.0
"""Time for one answer [s]."""


class Client:
    """Asks the planner."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        rclpy.init(args=[], context=self.context, domain_id=domain)
        self.node = Node("plan_service_bench", context=self.context)
        self.client = self.node.create_client(PlanCalibration, "calibration_planner/request_plan")
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        if not self.client.wait_for_service(LONGEST):
            raise SystemExit("no planner")

    def ask(self, request: PlanRequest) -> tuple[float, PlanCalibration.Response]:
        """Time to the answer [s], and the answer."""
        began = time.perf_counter()
        future = self.client.call_async(PlanCalibration.Request(request=request))
        self.executor.spin_until_future_complete(future, LONGEST)
        if not future.done():
            raise SystemExit("the planner does not answer")
        return time.perf_counter() - began, future.result()

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)


def measure(client: Client, model: str, configurations: int, requests: int) -> dict[str, Any]:
    """One line of the table; the first request of each kind warms up."""
    poses = [JointConfiguration(positions=POSE.tolist())]
    request = PlanRequest(test_poses=poses, configurations=configurations, error_model=model, sigma=SIGMA)
    robot = Robot.load(ROBOT).with_parameters("lengths+offsets")
    expected = planned_error_model(model, robot, SIGMA)
    problem = PlanProblem(robot, POSE, configurations, error_model=expected, search=Search())
    beside, difference, library = [], [], []
    for turn in range(requests + 1):
        began = time.perf_counter()
        plan(problem)
        own = time.perf_counter() - began
        whole, answer = client.ask(request)
        if answer.status != answer.SUCCESS:
            raise SystemExit(answer.message)
        if turn:
            library.append(own)
            beside.append(whole - seconds_of(answer.plan.search_time))
            difference.append(whole - own)
    return {
        "library": round(1e3 * median(library), 1),
        "beside": round(1e3 * median(beside), 1),
        "beside_95": round(1e3 * float(np.quantile(beside, 0.95)), 1),
        "difference": round(1e3 * median(difference), 1),
    }


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--requests", type=int, default=30)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, own_domain() as domain, Nodes(Path(name), domain) as nodes:
        nodes.start("planner_node", {"robot": ROBOT, "sigma": SIGMA})
        client = Client(domain)
        try:
            result = {case: measure(client, *asked, args.requests) for case, asked in CASES.items()}
        finally:
            client.close()
    print(json.dumps(result, indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
