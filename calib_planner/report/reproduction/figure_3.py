"""Fig. 3: lengths and joint offsets of the two-link arm from three measurements.

The paper's hypothesis is that (18)–(20) hold for all four parameters. They do, with twice the variance, for plans
with Σ sin q2i = 0 such as its three. Among other plans there are better ones: m measurements at the test pose
itself leave 2σ²/m there, and the bound says that nothing is below.
"""

from __future__ import annotations

from calib_planner.report.reproduction import printed
from calib_planner.report.reproduction.two_link import ALL_FOUR
from calib_planner.report.reproduction.two_link_figure import FigureSettings

FIGURE_3 = FigureSettings(
    number=3,
    parameters=ALL_FOUR,
    angles=((-10.0, 0.0, 10.0), (-120.0, 0.0, 120.0), (-57.0, 0.0, 57.0)),
    printed_gains=printed.FIGURE_3_GAINS,
)
