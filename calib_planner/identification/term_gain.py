# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""What each term of the error model brings: its size at the tool, and what it gains.

A term with columns moves the measured points by B û; of the joint functions a component has the share of û that
its prior variance has of the whole. Visits and points scatter the measured points by the trace of their part of
R_i. The size is the root mean square over the measured points; what the uncertainty of û adds there is the
standard deviation of that. The gain is the left-out log score with the term
less that without it: a term that predicts gains.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from calib_planner.arrays import FloatArray
from calib_planner.error_model import ErrorModel, JointFunctions
from calib_planner.identification.likelihood import LinearProblem

ENOUGH = 200
"""Visits whose mean variance stands for that of all."""


@dataclass(frozen=True, eq=False)
class TermGain:
    """What a term brings.

    Attributes:
        name: ``placement``, ``gravity``, ``smooth``, ``short``, ``visits`` or ``points``.
        size: Root mean square of what it moves a measured point by [m]; 0 if the term went.
        gain: Left-out log score with it less that without; NaN where it was not tried.
        used: Whether it is in the model.
        std: Root mean square of the standard deviation of what it moves a measured point by [m]; NaN for visits
            and points, and if the term went.
    """

    name: str
    size: float
    gain: float
    used: bool
    std: float = float("nan")


def term_gains(
    model: ErrorModel,
    problem: LinearProblem,
    coefficients: FloatArray,
    covariance: FloatArray,
    gains: Mapping[str, float],
) -> tuple[TermGain, ...]:
    """Every term of the ``model``.

    Args:
        model: The model before terms went.
        problem: The last linear problem, with the model that is left.
        coefficients: (coefficients,) β where it ended.
        covariance: (coefficients, coefficients) of β.
        gains: Term → gain, of terms that could have gone.
    """
    squares, variances = _squares(problem, coefficients), _variances(problem, covariance)
    points = max(float(problem.seen.sum()) / 3.0, 1.0)
    names = [
        n for term in model.terms for n in (term.components if isinstance(term, JointFunctions) else (term.name,))
    ]
    nothing = float("nan")
    return tuple(
        TermGain(
            name=n,
            size=float(np.sqrt(squares.get(n, 0.0) / points)),
            gain=gains.get(n, nothing),
            used=n in squares,
            std=float(np.sqrt(max(variances[n], 0.0) / points)) if n in variances else nothing,
        )
        for n in names
    )


def _squares(problem: LinearProblem, coefficients: FloatArray) -> dict[str, float]:
    """Term of the model that is left → sum of squares of what it moves the measured points by [m²]."""
    model = problem.model
    result = {
        name: float(np.sum((problem.columns[:, :, place] @ (share * coefficients[place])) ** 2))
        for name, place, share in _columns(problem)
    }
    for scattering in (model.visits, model.points):
        if scattering is not None:
            parts = ("instrument", *scattering.scales) if scattering is model.points else scattering.scales
            traces = [np.trace(problem.parts[n], axis1=1, axis2=2).sum() for n in set(parts) & set(problem.parts)]
            result[scattering.name] = float(np.sum(traces))
    return result


def _variances(problem: LinearProblem, covariance: FloatArray) -> dict[str, float]:
    """Term with columns → sum of the variances of what it moves the measured points by [m²].

    Of many visits each so many-th stands for the others: a mean of ``ENOUGH`` of them is known to a few percent.
    """
    result, every = {}, -(-len(problem.y) // ENOUGH)
    rise = problem.seen.sum() / max(problem.seen[::every].sum(), 1.0)
    for name, place, share in _columns(problem):
        columns = problem.columns[::every, :, place] * share
        columns = columns.reshape(columns.shape[0] * columns.shape[1], -1)
        result[name] = float(rise * np.sum((columns.T @ columns) * covariance[place, place]))
    return result


def _columns(problem: LinearProblem) -> Iterator[tuple[str, slice, FloatArray]]:
    """Term or component with columns; where its coefficients are; (coefficients,) its share of them."""
    model, robot = problem.model, problem.robot
    for term in model.systematic:
        place = model.slices(robot)[term.name]
        if not isinstance(term, JointFunctions):
            yield term.name, place, np.ones(term.size(robot))
            continue
        for component, share in term.shares(robot, model.values).items():
            yield component, place, share
