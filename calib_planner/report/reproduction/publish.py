"""The files of a reproduction: ``tables.json``, figures as PNG and SVG, and the page ``index.html``."""

from __future__ import annotations

import json
from pathlib import Path

from calib_planner.errors import InputError
from calib_planner.files.text import write_text
from calib_planner.report.reproduction.drawing import draw_figure_5, draw_two_link_figure, png, svg
from calib_planner.report.reproduction.page import page
from calib_planner.report.reproduction.run import Reproduction


def make_folder(folder: str | Path) -> Path:
    """The folder, made if need be.

    Raises:
        InputError: It cannot be made.
    """
    path = Path(folder).expanduser()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _refused(path, error) from None
    return path


def publish(result: Reproduction, folder: str | Path) -> None:
    """Write all files to ``folder``, made if need be. Same result, same bytes.

    Raises:
        InputError: The folder cannot be made or written.
    """
    target = make_folder(folder)
    pairs = {
        "figure_2": [draw_two_link_figure(result.figure_2, narrow=n) for n in (False, True)],
        "figure_3": [draw_two_link_figure(result.figure_3, narrow=n) for n in (False, True)],
        "figure_5": [draw_figure_5(result.figure_5, narrow=n) for n in (False, True)],
    }
    pictures = {}
    for name, (wide, narrow) in pairs.items():
        pictures[name] = svg(wide), svg(narrow)
        try:
            (target / f"{name}.svg").write_bytes(pictures[name][0])
            (target / f"{name}.png").write_bytes(png(wide))
        except OSError as error:
            raise _refused(target, error) from None
    text = json.dumps(result.to_dict(), indent=1, ensure_ascii=False, allow_nan=False)
    write_text(target / "tables.json", text + "\n")
    write_text(target / "index.html", page(result, pictures))


def _refused(folder: Path, error: OSError) -> InputError:
    reason = f"{folder} ({error.strerror or error})"
    return InputError("output", reason, "a folder that can be made and written", "choose another")
