# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What a command may say and where: the answer on stdout, everything else on stderr."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from calib_planner.units import joint_unit, joint_value

if TYPE_CHECKING:
    from calib_planner.arrays import FloatArray
    from calib_planner.robot import Robot

PATIENCE = 1.0
"""Work shorter than this shows no progress [s]."""

WIDTH = 110
"""Columns of a table that does not go to a terminal."""


class Terminal:
    """The two streams of one run.

    Args:
        json_wanted: The answer is one JSON object; tables are not shown.

    Attributes:
        answered: Whether an answer was printed.
    """

    def __init__(self, *, json_wanted: bool) -> None:
        self.json_wanted = json_wanted
        self.answered = False
        self.out = _console(sys.stdout)
        self.err = _console(sys.stderr)

    def answer(self, result: Mapping[str, Any], show: Callable[[Console], None]) -> None:
        """Print ``result`` as JSON if that is wanted, otherwise what ``show`` prints."""
        self.answered = True
        if self.json_wanted:
            print(json.dumps(result, allow_nan=False, ensure_ascii=False))
        else:
            show(self.out)

    def note(self, text: str) -> None:
        """Say something that is not the answer."""
        self.err.print(text, soft_wrap=True)

    @contextmanager
    def progress(self, label: str) -> Iterator[Callable[[float, str], None]]:
        """A bar on stderr, if that is a terminal, once the work has taken over a second.

        Yields a function (share done 0 … 1, text) to be called as the work goes on.
        """
        bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[text]}", markup=False),
            console=self.err,
            transient=True,
        )
        task = bar.add_task(label, total=1.0, text="")
        timer = threading.Timer(PATIENCE, bar.start)
        timer.daemon = True
        if self.err.is_terminal:
            timer.start()
        try:
            yield lambda share, text: bar.update(task, completed=share, text=text)
        finally:
            timer.cancel()
            if timer.is_alive():
                timer.join()
            if bar.live.is_started:  # it would end with an empty line all the same
                bar.stop()

    @contextmanager
    def working(self, label: str) -> Iterator[None]:
        """A sign of life on stderr, if that is a terminal, for work that cannot tell how far it is."""
        status = self.err.status(label)
        timer = threading.Timer(PATIENCE, status.start)
        timer.daemon = True
        if self.err.is_terminal:
            timer.start()
        try:
            yield
        finally:
            timer.cancel()
            if timer.is_alive():
                timer.join()
            status.stop()


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """Leave it to ``main``; rich would exit on its own."""
        raise


def _console(stream: Any) -> Console:
    width = None if stream.isatty() else WIDTH
    return _Console(file=stream, width=width, markup=False, highlight=False, emoji=False)


def configurations_table(title: str, robot: Robot, q: FloatArray, times: Sequence[int]) -> Table:
    """Configurations (m, joints) [rad | m] in degrees and millimetres, and how often each is measured."""
    table = Table(title=title)
    table.add_column("#", justify="right")
    for name, turns in zip(robot.joint_names, robot.joint_is_revolute, strict=True):
        table.add_column(f"{name}\n[{joint_unit(turns)}]", justify="right")
    table.add_column("measure", justify="right")
    for i, (row, count) in enumerate(zip(q.tolist(), times, strict=True), 1):
        values = (joint_value(v, t) for v, t in zip(row, robot.joint_is_revolute, strict=True))
        table.add_row(str(i), *values, f"{count}×")
    return table
