# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Error models as files: what is expected of a robot that nobody has measured, and what an estimate has learnt.

A model is saved alone (``write_error_model``); its mapping is the same inside an estimate.
``config/error_models/typical.yaml`` is ``error_model.typical`` as a file to begin from.
"""

from __future__ import annotations

from pathlib import Path

from calib_planner.error_model import ErrorModel, from_mapping, to_mapping, typical
from calib_planner.io.yaml import Node, read_document, read_yaml, write_document
from calib_planner.tracker import Noise

KIND = "error_model"


def write_error_model(path: str | Path, model: ErrorModel, field: str = "output") -> None:
    """Write a model alone.

    Raises:
        InputError: The path cannot be written; names ``field``.
    """
    write_document(path, KIND, {"error_model": to_mapping(model)}, field)


def read_error_model(source: str | Path, noise: Noise | None = None) -> ErrorModel:
    """A model by name or from a file.

    Args:
        source: ``paper``, ``typical``, or the path of a file: an error model alone (``write_error_model``), or an
            estimate that holds one.
        noise: The instrument, for the models with a name; a file holds its own.

    Raises:
        FileFormatError: The file is not readable, or holds what a model cannot hold; names the key.
    """
    if source == "paper":
        return ErrorModel.paper(noise)
    if source == "typical":
        return typical(noise)
    part = _saved(source)
    return part.build(lambda: from_mapping(part.mapping().value))


def _saved(path: str | Path) -> Node:
    """The mapping of a model in a file of its own or in an estimate."""
    if read_yaml(path, "a YAML file with an error model").value.get("format") != "calib_planner/estimate":
        return read_document(path, KIND).mapping(None, ("error_model",))["error_model"]
    part = read_document(path, "estimate").get("error_model")
    if part.value is None:
        advice = "it is of an older version: identify again"
        raise part.error("nothing", "the error model of the estimate", advice)
    return part.mapping(None, ("model",))["model"]
