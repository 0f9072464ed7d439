# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Masses of links: what is believed of them, and one for each joint, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import mixed

from calib_planner.robot import Element, LinkMass, lumped
from calib_planner.robot.masses import fault_of

NAMES = ("a", "b", "c", "d")


def test_one_mass_for_each_joint_at_the_common_centre_of_gravity() -> None:
    rng = np.random.default_rng(0)
    joints, weights, places = [2, 0, 2, 2, 3], rng.uniform(0.1, 0.9, 5), rng.normal(size=(5, 3))
    masses = [LinkMass(j, w, tuple(xyz)) for j, w, xyz in zip(joints, weights, places, strict=True)]
    found = lumped([*masses, LinkMass(1, 0.0, (1.0, 1.0, 1.0)), LinkMass(2, 0.0, (9.0, 9.0, 9.0))])
    assert [part.joint for part in found] == [0, 2, 3]
    for part in found:
        rows = np.array(joints) == part.joint
        assert part.mass == pytest.approx(weights[rows].sum())
        np.testing.assert_allclose(part.xyz, np.average(places[rows], axis=0, weights=weights[rows]))


def masses(*parts: tuple[int, float, float]) -> list[LinkMass]:
    """Joint, mass and distance of its centre of gravity."""
    return [LinkMass(joint, mass, (0.0, -0.6 * away, 0.8 * away)) for joint, mass, away in parts]


@pytest.mark.parametrize(
    ("parts", "fault"),
    [
        (masses((0, 1, 0.1), (1, 2, 0.1)), ""),
        (masses((0, 1, 1.4999), (1, 2, 0.1)), ""),
        (masses((0, 1, 1.5001), (1, 2, 0.1)), "behind a is 1.5 m away"),
        (masses((0, 1, 0.1), (2, -1e-9, 0.1)), "behind c has a mass of -1e-09"),
        (masses((0, 1, 0.1), (2, np.inf, 0.1)), "behind c has a mass of inf"),
        (masses((0, 1, 0.1), (2, np.nan, 0.1)), "behind c has a mass of nan"),
        (masses((0, 1, np.nan), (2, 1, 0.1)), "behind a is nan"),
        ([], "no masses"),
        # Half of the joints have to carry some; a mass of zero is none, two on one joint are one joint.
        (masses((0, 1, 0.1), (1, 0, 0.1)), "1 of 4 joints"),
        (masses((0, 1, 0.1), (0, 2, 0.1)), "1 of 4 joints"),
        # All alike and more than half of them in the origins.
        (masses((0, 1, 0), (1, 1, 0), (2, 1, 0.1)), "all masses are alike"),
        (masses((0, 1, 0), (1, 1, 0.1)), ""),
        (masses((0, 1, 0), (1, 1, 0), (2, 1, 0.1), (3, 0, 0.1)), "all masses are alike"),
        (masses((0, 1, 0), (1, 2, 0), (2, 1, 0)), ""),
    ],
)
def test_what_is_not_believed(parts: list[LinkMass], fault: str) -> None:
    found = fault_of(parts, NAMES, 1.5)
    assert (fault in found) if fault else not found


def test_a_single_mass_of_a_single_joint_may_be_in_its_origin() -> None:
    assert fault_of(masses((0, 1, 0)), NAMES[:1], 1.5) == ""
    assert fault_of(masses((0, 1, 0)), NAMES[:2], 1.5) == ""


def test_no_centre_of_gravity_is_farther_away_than_the_chain_is_long() -> None:
    """Lengths of translations, whatever their sign, and what a slide may go either way; not the base's place."""
    robot = mixed().with_base(np.eye(3), [50.0, 0.0, 0.0])
    reach = 0.1 + 0.2 + 0.3 + (0.2 + 0.4) + 0.8 + 0.3 + 0.5 + 0.3
    for away, believed in ((reach - 1e-6, True), (reach + 1e-6, False)):
        parts = tuple(masses((0, 1, away), (1, 2, 0.1), (2, 1, 0.1)))
        assert (not replace(robot, link_masses=parts).mass_fault) == believed
        # A slide that starts somewhere else than at zero is longer by that.
        there = tuple(replace(e, value=-0.25) if e.joint == 1 else e for e in robot.elements)
        longer = replace(robot, elements=(*there, Element("Tz", -0.05)), link_masses=parts)
        assert not longer.mass_fault
        farther = tuple(masses((0, 1, away + 0.3), (1, 2, 0.1), (2, 1, 0.1)))
        assert (not replace(longer, link_masses=farther).mass_fault) == believed
