# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The person at a campaign: calls its services, hears its status."""

from __future__ import annotations

from typing import Any

from bench import Bench
from calib_planner_msgs.msg import CampaignStatus
from std_srvs.srv import Trigger

from calib_planner.ros.nodes.campaign import CampaignNode
from calib_planner.ros.parameters import LATCHED

NAME = "calibration_campaign"
ASKED = {
    "error_model": "paper",  # the simulated robots err in their parameters alone
    "robot": "planar_2r",
    "test_poses": "0.17 0.87",
    "required_accuracy": 5e-6,
    "starts": 4,
    "validation": 3,
    "budget": 40,
}
S = CampaignStatus
IDENTIFIER = {
    "robot": "planar_2r",
    "plan_topic": f"{NAME}/plan",
    "settle": 0.05,
    "duration": 0.1,
    "samples": 5,
    "sigma": 1.5e-5,
}
"""With ``SIMULATOR``, a visit is as exact as one of 20 points of 30 µm, and takes a third of the time."""
SIMULATOR = {
    "robot": "planar_2r",
    "error_model": "paper",
    "joint_speed": 100.0,
    "dwell": 0.25,
    "sigma": 1.5e-5,
    "seed": 3,
}


class Desk:
    """Starts the node with these parameters, in this process, unless it is ``elsewhere``."""

    def __init__(self, bench: Bench, *, elsewhere: bool = False, **parameters: Any) -> None:
        self.bench = bench
        self.heard = bench.hear(S, f"{NAME}/status", LATCHED)
        create = bench.client.create_client
        self.clients = {name: create(Trigger, f"{NAME}/{name}") for name in ("start", "pause", "resume", "skip")}
        if not elsewhere:
            self.node = bench.start(CampaignNode, **(ASKED | parameters))
            bench.wait(lambda: self.heard)
            self.meet()

    def meet(self) -> None:
        """Have a node without a campaign refuse what can be asked twice.

        Discovery is through then: ``start``, which cannot, is answered at its first call.
        """
        for name in ("pause", "resume", "skip"):
            assert not self.call(name)[0]

    def call(self, name: str) -> tuple[bool, str]:
        """A first call may be answered before discovery has matched its reader: then it is repeated."""
        client = self.clients[name]
        self.bench.wait(client.service_is_ready)
        for _ in range(6):
            future = client.call_async(Trigger.Request())
            try:
                response = self.bench.future(future, 5.0)
            except AssertionError:
                client.remove_pending_request(future)
                continue
            return response.success, response.message
        raise AssertionError(f"{name} is not answered")

    def transitions(self, *labels: str) -> None:
        """Have the node make transitions, in its own thread: what it makes anew there is heard at once."""
        for label in labels:
            assert self.bench.change_state(NAME, 0, label), label

    def restart(self) -> None:
        """As after a crash: nothing is left of the node but its store."""
        self.transitions("deactivate", "cleanup", "configure", "activate")
        self.until(S.PAUSED)

    @property
    def now(self) -> CampaignStatus:
        return self.heard[-1]

    def until(self, state: int, seconds: float = 60.0, said: str = "", **counts: int) -> CampaignStatus:
        """The first status from the newest one on in that state, with these words and at least these counts."""
        begin, found = len(self.heard) - 1, list[CampaignStatus]()

        def there() -> bool:
            enough = (m for m in self.heard[begin:] if all(getattr(m, k) >= v for k, v in counts.items()))
            found.extend(m for m in enough if m.state == state and said in m.reason)
            return bool(found)

        try:
            self.bench.wait(there, seconds)
        except AssertionError:
            raise AssertionError(f"not in state {state} within {seconds} s: {said} {self.now}") from None
        return found[0]
