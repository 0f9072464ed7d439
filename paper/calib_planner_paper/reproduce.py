"""All tables and figures in one run: settings → ``reproduce`` → numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from calib_planner.arrays import check_count, plain
from calib_planner_paper import printed
from calib_planner_paper.kuka import ROBOT, SIGMA, TEST_POSES, WORKSPACE, Figure5, Table2, figure_5, table_2
from calib_planner_paper.two_link import FIGURE_2, FIGURE_3, Table1, TwoLinkFigure, table_1, two_link_figure

Update = Callable[[float, str], None]


@dataclass(frozen=True)
class ReproductionSettings:
    """How much is computed.

    Attributes:
        random_plans: Random plans per column of Table 2; the paper's 20 000.
        calibrations: Simulated calibrations per plan of Figs 2, 3 and 5; the paper's 100.
        seed: Same seed, same numbers.
    """

    random_plans: int = 20_000
    calibrations: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("random", self.random_plans, low=100, high=1_000_000)
        check_count("calibrations", self.calibrations, low=10, high=100_000)
        check_count("seed", self.seed, low=0, high=2**63 - 1)


@dataclass(frozen=True, eq=False)
class Reproduction:
    """The paper's tables and figures as numbers.

    Attributes:
        settings: How much was computed.
        table_1: The two-link arm.
        figure_2, figure_3: Simulated calibrations of it.
        table_2: The KUKA KR 270, one table per test pose; the first is the one to compare.
        figure_5: Simulated calibrations of it at the first test pose.
    """

    settings: ReproductionSettings
    table_1: Table1
    figure_2: TwoLinkFigure
    figure_3: TwoLinkFigure
    table_2: tuple[Table2, ...]
    figure_5: Figure5

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and numbers, SI units and radians: the content of ``tables.json``."""
        return {
            "seed": self.settings.seed,
            "random_plans": self.settings.random_plans,
            "calibrations": self.settings.calibrations,
            "table_1": self.table_1.to_dict(),
            "figure_2": self.figure_2.to_dict(),
            "figure_3": self.figure_3.to_dict(),
            "table_2": {
                "robot": ROBOT,
                "sigma": SIGMA,
                "workspace": plain({"low": WORKSPACE.low, "high": WORKSPACE.high}),
                "columns": [{"configurations": m, "repetitions": r} for m, r in printed.SIZES],
                "printed": {row: list(values) for row, values in printed.TABLE_2.items()},
                "printed_contradictions": [vars(d) for d in printed.contradictions()],
                "test_poses": {t.pose.name: t.to_dict() for t in self.table_2},
            },
            "figure_5": self.figure_5.to_dict(),
        }


def reproduce(settings: ReproductionSettings, update: Update = lambda share, text: None) -> Reproduction:
    """Compute everything.

    Args:
        update: Told of the share done (0 … 1) and what comes next.
    """
    count, seed = settings.calibrations, settings.seed
    update(0.0, "Table 1")
    first = table_1(seed)
    update(0.05, "Fig. 2")
    second = two_link_figure(FIGURE_2, count, seed)
    update(0.15, "Fig. 3")
    third = two_link_figure(FIGURE_3, count, seed)
    tables = []
    for k, pose in enumerate(TEST_POSES):
        update(0.25 + 0.2 * k, f"Table 2, test pose {pose.name}")
        tables.append(table_2(pose, settings.random_plans, seed))
    update(0.85, "Fig. 5")
    last = figure_5(tables[0], count, seed)
    return Reproduction(settings, first, second, third, tuple(tables), last)
