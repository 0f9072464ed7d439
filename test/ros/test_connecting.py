# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""The driver of docs/connecting.md as it stands there, and the parameters that the page names."""

from __future__ import annotations

import importlib.util
import math
import re
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from bench import Bench
from geometry_msgs.msg import PointStamped

from calib_planner.acquisition import NANO
from calib_planner.io import CELL_KEYS, config_folder
from calib_planner.ros.messages import nanoseconds
from calib_planner.ros.parameters import STREAM_IN
from calib_planner.ros.settings import ExecutorParameters, IdentifierParameters, SimulatorParameters

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "connecting.md").read_text()
FILES = dict(re.findall(r"<!-- file: (\w+\.py) -->\n```python\n(.*?)```", PAGE, re.DOTALL))


def module_of(name: str, folder: Path) -> Any:
    path = folder / name
    path.write_text(FILES[name])
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_driver_is_there_and_compiles() -> None:
    assert sorted(FILES) == ["tracker_driver.py"]
    compile(FILES["tracker_driver.py"], "tracker_driver.py", "exec")


def test_the_executor_has_the_parameters_that_the_page_names() -> None:
    section = PAGE[PAGE.index("## The robot: plan_executor") : PAGE.index("## The tracker: a driver")]
    known = {item.name for item in fields(ExecutorParameters)}
    first_column = " ".join(re.findall(r"^\| (.*?) \|", section, re.MULTILINE))
    table = set(re.findall(r"`(\w+)`", first_column))
    assert len(table) > 8 and table <= known | {"robot_description"}
    watched = {"tracking_tolerance", "silence", "beam_patience", "beam_silence", "confirm_patience"}
    assert watched | {"arrival_tolerance"} <= known & set(re.findall(r"`(\w+)`", section))


def test_the_rehearsal_uses_parameters_that_exist() -> None:
    blocks = [yaml.safe_load(b) for b in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)]
    (values,) = [b["/**"]["ros__parameters"] for b in blocks if "/**" in b]
    assert SimulatorParameters(**values).outlier_probability == 0.001
    known = yaml.safe_load((config_folder() / "simulator.yaml").read_text())["/**"]["ros__parameters"]
    assert {k: type(v) for k, v in values.items()} == {k: type(known[k]) for k in values}
    others = {name for b in blocks if not {"/**", "required-accuracy"} & b.keys() for name in b}
    assert others <= {item.name for item in fields(IdentifierParameters)}


def test_the_cell_has_keys_that_exist() -> None:
    section = PAGE[PAGE.index("## One file, one launch") :]
    (cell,) = re.findall(r"```yaml\n(.*?)```", section, re.DOTALL)[:1]
    keys = yaml.safe_load(cell).keys()
    assert len(keys) > 10 and keys <= CELL_KEYS.keys()


# ── the tracker ──────────────────────────────────────────────────────────────────────────────────────


def test_stamps_of_a_clock_of_its_own(tmp_path: Path) -> None:
    keep = module_of("tracker_driver.py", tmp_path).StampFilter(remembered=10.0)
    rng = np.random.default_rng(0)
    errors = []
    for k in range(4000):
        true = 1000.0 + 0.02 * k
        own = 5.0 + true * (1 + 2e-5)  # its zero and its rate
        late = 0.003 + rng.exponential(0.01)
        errors.append(keep.stamp(own, true + late) - true)
    # Never earlier than measured, late by the shortest way, whatever the delay of the sample.
    settled = np.array(errors[500:])
    assert settled.min() > 0.0029 and settled.max() < 0.005


def test_the_driver_publishes_metres_and_stamps(bench: Bench, tmp_path: Path) -> None:
    driver = module_of("tracker_driver.py", tmp_path)
    waiting = [(100.0, 1000.0, -2000.0, 500.0), (100.02, math.nan, math.nan, math.nan)]
    heard = bench.hear(PointStamped, "tracker/point", STREAM_IN)

    def read() -> list[tuple[float, ...]]:
        if not bench.client.count_publishers("tracker/point"):
            return []
        time.sleep(0.02)
        return [waiting.pop(0)] if waiting else [(101.0, 0.0, 0.0, 0.0)]

    before = time.time()
    node = driver.TrackerDriver(read, context=bench.context)
    bench.nodes.append(node)
    bench._spin(node, 1)
    bench.wait(lambda: len(heard) > 3)
    first = next((m for m in heard if m.point.x == 1.0), None)
    if first is not None:  # a message before discovery is lost
        assert (first.point.y, first.point.z, first.header.frame_id) == (-2.0, 0.5, "tracker")
    assert all(before - 5 < nanoseconds(m.header.stamp) / NANO < time.time() + 5 for m in heard)
    assert heard[-1].point.x == 0.0
