"""Fig. 2: the link lengths of the two-link arm from two measurements. Plan c is (19), plan b D-optimal."""

from __future__ import annotations

from calib_planner.report.reproduction import printed
from calib_planner.report.reproduction.two_link import LENGTHS
from calib_planner.report.reproduction.two_link_figure import FigureSettings

FIGURE_2 = FigureSettings(
    number=2,
    parameters=LENGTHS,
    angles=((-10.0, 10.0), (-90.0, 90.0), (-46.0, 46.0)),
    printed_gains=printed.FIGURE_2_GAINS,
)
