# Copyright 2026 calib_planner contributors
# SPDX-License-Identifier: Apache-2.0
"""Each term's columns, prior and gradients against an oracle of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from robots import mixed, random_configurations
from scipy.integrate import quad

from calib_planner import Robot
from calib_planner.error_model import (
    ErrorModel,
    Gravity,
    JointFunctions,
    Mass,
    Payload,
    Placement,
    Points,
    Poses,
    Prior,
    Scale,
    Visits,
    typical,
)
from calib_planner.error_model.gravity import LINKS, downwards
from calib_planner.error_model.joint_functions import spectrum
from calib_planner.error_model.placement import joint_zeros
from calib_planner.error_model.poses import joint_units
from calib_planner.error_model.typical import with_tolerances
from calib_planner.errors import InputError, UnknownNameError
from calib_planner.robot import Element
from calib_planner.tracker import Isotropic, LaserTracker

ROBOTS = {
    "kr270 full": lambda: Robot.load("kuka_kr270").with_parameters("full", ("base", "tool")),
    "ur10e": lambda: Robot.load("ur10e").with_targets([[0.0, 0.05, 0.1], [0.08, -0.03, 0.05]]),
    "mixed full": lambda: mixed().with_parameters("full", ("base", "tool")),
}


@pytest.fixture(params=ROBOTS)
def robot(request: pytest.FixtureRequest) -> Robot:
    made = ROBOTS[request.param]()
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    return made.with_base(turn, [0.3, -0.2, 0.1])


def test_every_column_moves_the_points_as_its_deflection_does(robot: Robot) -> None:
    model = typical()
    q = random_configurations(robot, 5)
    poses = Poses(robot, q)
    columns, where = model.columns(poses), model.slices(robot)
    rng = np.random.default_rng(1)
    for term in (model.gravity, model.joint_functions):
        assert term is not None
        coefficients = np.zeros(columns.shape[2])
        coefficients[where[term.name]] = rng.standard_normal(term.size(robot))
        # Complex step through the kinematics: exact to rounding, and independent of the columns.
        deflection = model.deflection(poses, coefficients) * joint_units(robot)
        moved = robot._run(q + 1e-30j * deflection, np.zeros(len(robot.parameter_names)), columns=False)
        gradient = (moved.imag / 1e-30).reshape(len(robot.targets), 3, -1).transpose(2, 0, 1).reshape(5, -1)
        np.testing.assert_allclose(columns @ coefficients, gradient, atol=1e-12 * np.abs(gradient).max())


def test_every_coefficient_has_a_name_and_a_column(robot: Robot) -> None:
    model, poses = typical(), Poses(robot, random_configurations(robot, 2))
    for term in model.systematic:
        names = term.names(robot)
        assert len(names) == len(set(names)) == term.size(robot) == term.columns(poses).shape[2]
    wave = JointFunctions(("smooth",), 3)
    joints = [n for n in wave.names(robot) if n.startswith(f"{robot.joint_names[0]}.")]
    assert [n.rpartition(".")[2] for n in joints] == ["cos1", "cos2", "cos3", "sin1", "sin2", "sin3"]


def test_placement_columns_are_the_jacobian_and_priors_go_by_kind(robot: Robot) -> None:
    poses = Poses(robot, random_configurations(robot, 3))
    placement, values = Placement(), {"placement.length": 4e-4, "placement.angle": 2e-3}
    np.testing.assert_array_equal(placement.columns(poses), robot.jacobian(poses.q))
    std = dict(zip(robot.parameter_names, np.sqrt(placement.variances(robot, values)), strict=True))
    zeros = dict(zip(robot.parameter_names, joint_zeros(robot), strict=True))
    for parameter in robot.parameters:
        if parameter.name.startswith(("base.", "target_")):
            assert np.isinf(std[parameter.name])
        elif zeros[parameter.name]:
            assert std[parameter.name] == pytest.approx(0.02)
        else:
            assert std[parameter.name] == pytest.approx(4e-4 if parameter.unit == "m" else 2e-3)
    assert np.isinf(Placement("flat").variances(robot, {})).all()
    name = robot.parameter_names[7]
    stated = Placement(stated=Prior((name,), [0.0], [3e-5])).variances(robot, values)
    assert (
        stated[7] == pytest.approx(9e-10) and np.isfinite(stated).sum() >= np.isfinite(list(std.values())).sum()
    )


def test_zeros_of_joints_are_what_acts_like_the_joint() -> None:
    robot = Robot.load("kuka_kr270").with_parameters("q1,q3,d2")
    assert joint_zeros(robot).tolist() == [True, True, False]


def test_a_zero_of_a_joint_is_told_whatever_its_sign_and_wherever_the_targets_are() -> None:
    """A parameter turns with the joint or against it; at the tip, on the last axis, nothing moves by a turn."""
    elements = (
        Element("Rz", parameter="pedestal"),  # a joint that turns backwards about the same axis
        Element("Rz", joint=0, sign=-1.0),
        Element("Tx", 0.4, parameter="upper"),
        Element("Ry", joint=1, parameter="second"),
        Element("Tx", 0.3, parameter="fore"),
        Element("Rx", joint=2, parameter="third"),
        Element("Tx", 0.1, parameter="hand"),
        Element("Rz", parameter="flange"),
    )
    limits = np.array([[-2.0, 2.5], [-1.5, 1.0], [-3.0, 3.0]])
    robot = Robot("signs", elements, (), ("a", "b", "c"), limits)
    names = ("pedestal", "upper", "second", "fore", "third", "hand", "flange")
    for target in ([0.0, 0.0, 0.0], [0.0, 0.1, 0.2], [-0.13, 0.3, 0.1], [5.0, -3.0, 2.0]):
        placed = replace(robot.with_targets([target]), parameter_names=(*names, "target_1.x"))
        told = dict(zip(placed.parameter_names, joint_zeros(placed), strict=True))
        assert {name for name, zero in told.items() if zero} == {"pedestal", "second", "third"}


def test_a_stated_prior_takes_its_parameter_from_the_scale_and_moves_its_mean() -> None:
    robot = Robot.load("kuka_kr270").with_parameters("d1,d2,q2")
    values = {"placement.length": 4e-4, "placement.angle": 2e-3}
    nominal = {p.name: p.nominal for p in robot.parameters}
    stated = Placement(stated=Prior(("d2",), [nominal["d2"] + 3e-4], [3e-5]))
    at = robot.parameter_names.index("d2")
    plain, told = (p.gradients(robot, values)["placement.length"] for p in (Placement(), stated))
    assert plain[at] == pytest.approx(2.0 * 4e-4**2) and told[at] == 0.0
    np.testing.assert_array_equal(np.delete(told, at), np.delete(plain, at))
    assert "placement.length" not in replace(stated, prior="flat").gradients(robot, values)
    np.testing.assert_allclose(stated.means(robot), np.where(np.arange(3) == at, 3e-4, 0.0), atol=1e-12)


def test_the_precision_is_of_lengths_and_angles_and_of_what_is_stated() -> None:
    """Sizes of no whole inverse, base flat, two parameters stated together."""
    robot = Robot.load("kuka_kr270").with_targets(np.zeros((1, 3))).with_parameters("d1,d2,d3,q2", ("base",))
    covariance = np.array([[4e-2, 1.2e-2], [1.2e-2, 1e-2]])  # determinant 2.56e-4
    placed = Placement(stated=Prior(("q2", "d1"), [0.1, 0.5], covariance))
    model = typical(placement=placed).placement_alone.with_values({"placement.length": 0.3})
    names = robot.parameter_names
    d1, d2, d3, q2 = (names.index(n) for n in ("d1", "d2", "d3", "q2"))
    expected = np.zeros((len(names), len(names)))
    expected[d2, d2] = expected[d3, d3] = 1.0 / 0.09
    expected[q2, q2], expected[d1, d1] = 1e-2 / 2.56e-4, 4e-2 / 2.56e-4
    expected[q2, d1] = expected[d1, q2] = -1.2e-2 / 2.56e-4
    np.testing.assert_allclose(model.precision(robot), expected, rtol=1e-12)


@pytest.mark.parametrize("term", ["placement", "gravity", "joint_functions"])
def test_slopes_of_priors_are_derivatives(term: str) -> None:
    robot, model, step = ROBOTS["kr270 full"](), typical(), 1e-6
    part = getattr(model, term)
    gradients = part.gradients(robot, model.values)
    assert set(gradients) == set(part.scales)
    for name, gradient in gradients.items():
        sides = [
            part.variances(robot, model.values | {name: model.values[name] * np.exp(s)}) for s in (step, -step)
        ]
        finite = np.isfinite(sides[0])
        numeric = (sides[0][finite] - sides[1][finite]) / (2 * step)
        np.testing.assert_allclose(gradient[finite], numeric, atol=1e-8 * np.abs(numeric).max())


# ── gravity ──────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("mounting", ["floor", "ceiling", (1.0, 0.0, 0.0)])
def test_moments_are_the_slope_of_the_potential_energy(robot: Robot, mounting: str | tuple[float, ...]) -> None:
    """τ_l = −∂E/∂q_l of a unit weight, E its height: by complex steps through a chain that ends at the mass."""
    gravity = Gravity((Mass("hand", None, (0.1, 0.2, 0.3)),), mounting)  # type: ignore[arg-type]
    q = random_configurations(robot, 4)
    hand = replace(robot, parameter_names=()).with_targets([[0.1, 0.2, 0.3]])
    down = robot.base_pose[0] @ gravity.down
    moments = gravity.moments(Poses(robot, q))
    for joint in range(len(robot.joint_names)):
        moved = hand._run(q + 1e-30j * np.eye(len(robot.joint_names))[joint], np.zeros(0), columns=False)
        np.testing.assert_allclose(moments[:, joint], (moved.imag / 1e-30).T @ down, atol=1e-12)


def test_a_mass_on_a_link_loads_only_the_joints_before_it(robot: Robot) -> None:
    gravity = Gravity((Mass("link", 1, (0.1, 0.0, 0.2)),))
    assert [n.split(".")[-1] for n in gravity.names(robot)] == list(robot.joint_names[:2])
    q = random_configurations(robot, 3)
    other = q.copy()
    other[:, 2:] += 0.3
    np.testing.assert_allclose(gravity.moments(Poses(robot, q)), gravity.moments(Poses(robot, other)), atol=1e-12)


def test_parts_of_one_mass_share_coefficients_and_the_payload_follows_the_visit(robot: Robot) -> None:
    parts = (Mass("arm", 1, (0.1, 0.0, 0.2), 0.75), Mass("arm", None, (0.0, 0.0, 0.1), 0.25))
    both, poses = Gravity(parts), Poses(robot, random_configurations(robot, 3))
    each = [Gravity((replace(p, name="one", weight=1.0),)).moments(poses) for p in parts]
    expected = 0.25 * each[1]
    expected[:, :2] += 0.75 * each[0]
    np.testing.assert_allclose(both.moments(poses), expected, atol=1e-15)
    alone = Gravity((Mass("hand", None, (0.0, 0.0, 0.1)),)).moments(poses)
    loaded, masses = Gravity(parts, payload=Payload(4.0, (0.0, 0.0, 0.1))), np.array([0.0, 2.0, 6.0])
    count = loaded.size(robot) - len(robot.joint_names)
    np.testing.assert_allclose(loaded.moments(poses)[:, count:], alone, atol=1e-15)
    moments = loaded.moments(replace(poses, payload=masses))
    np.testing.assert_allclose(moments[:, :count], both.moments(poses), atol=1e-15)
    np.testing.assert_allclose(moments[:, count:], alone * np.array([0.0, 0.5, 1.5])[:, None], atol=1e-15)


def test_masses_stand_at_elbow_wrist_and_tip() -> None:
    names = [m.name for m in Gravity().masses_of(Robot.load("ur10e"))]
    assert names == ["elbow", "wrist", "tip"]
    assert [m.name for m in Gravity().masses_of(Robot.load("planar_2r"))] == ["tip"]


def test_a_robot_of_one_joint_carries_a_mass_at_its_tip() -> None:
    elements = (Element("Rz", joint=0), Element("Tx", 0.4, parameter="arm"))
    robot = Robot("one", elements, (), ("a",), np.array([[-1.0, 1.0]])).with_targets([[0.0, 0.1, 0.2]])
    assert Gravity().masses_of(robot) == (Mass("tip"),)


def test_every_coefficient_of_gravity_acts_at_the_joint_of_its_name(robot: Robot) -> None:
    for gravity in (Gravity(), Gravity((Mass("arm", 1), Mass("hand")), payload=Payload(5.0))):
        names = gravity.names(robot)
        joints = [robot.joint_names[j] for j in gravity.joints(robot)]
        assert len(names) == len(joints) == gravity.size(robot)
        assert all(name.endswith(f".{joint}") for name, joint in zip(names, joints, strict=True))


def test_a_payload_goes_before_the_tip_of_known_links_and_before_nothing_else() -> None:
    known = Gravity((Mass(LINKS, 1), Mass("tip"), Mass("wrist", 2)))
    with_one = known.with_payload(Payload(5.0))
    assert [mass.name for mass in with_one.masses] == [LINKS, "wrist"]
    assert [mass.name for mass in with_one.with_payload(None).masses] == [LINKS, "wrist", "tip"]
    stated = Gravity((Mass("tip"), Mass("wrist", 2))).with_payload(Payload(5.0))
    assert [mass.name for mass in stated.masses] == ["tip", "wrist"]


def test_the_mounting_is_found_from_the_trackers_vertical() -> None:
    tilted = Robot.load("ur10e").with_base([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]], [1.0, 2.0, 3.0])
    gravity = Gravity(mounting=downwards(tilted, [0.0, 0.0, 2.0]))
    np.testing.assert_allclose(tilted.base_pose[0] @ gravity.down, [0.0, 0.0, -1.0], atol=1e-15)


@pytest.mark.parametrize("mounting", ["wall", (0.0, 0.0, 0.0), (1.0, 2.0)])
def test_a_mounting_is_a_word_or_a_direction(mounting: object) -> None:
    with pytest.raises(InputError, match="mounting"):
        Gravity(mounting=mounting)  # type: ignore[arg-type]


# ── joint functions ──────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(("length", "harmonics"), [(1.2, 12), (0.5, 24), (0.07, 200)])
def test_the_spectrum_is_the_fourier_series_of_the_kernel(length: float, harmonics: int) -> None:
    def kernel(x: float) -> float:
        return float(np.exp((np.cos(x) - 1.0) / length**2))

    constant = quad(kernel, 0, np.pi, limit=400)[0] / np.pi
    shares, _ = spectrum(length, harmonics)
    for n in (1, 2, 5, 10):
        wave = quad(kernel, 0, np.pi, weight="cos", wvar=n, limit=400)[0] * 2.0 / np.pi
        assert shares[n - 1] == pytest.approx(wave / (1.0 - constant), rel=1e-6, abs=1e-12)
    x = np.linspace(0.0, np.pi, 50)
    series = np.cos(np.outer(x, np.arange(1, harmonics + 1))) @ shares
    closed = (np.exp((np.cos(x) - 1.0) / length**2) - constant) / (1.0 - constant)
    np.testing.assert_allclose(series, closed, atol=1e-9)


def test_the_prior_of_a_joint_function_has_the_kernel_as_covariance() -> None:
    robot, values = Robot.load("ur10e"), {"smooth.size": 3e-4, "smooth.length": 0.8}
    term = JointFunctions(("smooth",), 40)
    q = random_configurations(robot, 6)
    waves = term.waves(Poses(robot, q))
    variances = term.variances(robot, values).reshape(6, -1)
    for joint in range(6):
        covariance = (waves[:, joint] * variances[joint]) @ waves[:, joint].T
        apart = q[:, joint, None] - q[None, :, joint]
        shares = spectrum(0.8, 40)[0]
        expected = sum(s * np.cos(n * apart) for n, s in enumerate(shares, start=1)) * 9e-8
        np.testing.assert_allclose(covariance, expected, atol=1e-18)


def test_components_are_known_and_named_once() -> None:
    for wrong in (("rough",), ("short", "short"), ()):
        with pytest.raises(UnknownNameError):
            JointFunctions(wrong)


# ── visits and points ────────────────────────────────────────────────────────────────────────────────


def test_visits_and_points_have_the_covariance_of_what_they_stand_for(robot: Robot) -> None:
    """Drawn by brute force: joint errors, a common shift, and noise by direction and floor."""
    model = typical(LaserTracker(station=np.array([3.0, 1.0, 0.5])), estimate_scale=True)
    values = {"repeatability": 4e-4, "shared": 2e-4, "instrument": 30.0, "floor": 3e-4}
    model = model.with_values(values)
    poses, rng, draws = Poses(robot, random_configurations(robot, 1)), np.random.default_rng(0), 200_000
    targets = len(robot.targets)
    joints = rng.standard_normal((draws, len(robot.joint_names))) * 4e-4
    error = joints @ poses.levers[0].T
    error += np.tile(2e-4 * rng.standard_normal((draws, 3)), targets)
    stated = model.points.noise.covariance(poses.points)[0]  # type: ignore[union-attr]
    for t in range(targets):
        noise = 30.0 * rng.standard_normal((draws, 3)) @ np.linalg.cholesky(stated[t]).T
        error[:, 3 * t : 3 * t + 3] += noise + 3e-4 * rng.standard_normal((draws, 3))
    if targets == 1:  # the common shift cannot be told from the floor, which stands for both
        model = model.with_values({"floor": float(np.hypot(3e-4, 2e-4))})
    expected = model.visit_covariance(poses)[0]
    np.testing.assert_allclose(np.cov(error.T), expected, atol=0.02 * np.abs(expected).max())


def test_a_shift_that_targets_share_needs_two_of_them() -> None:
    """Of one target nothing tells it from the noise of the point. Either is drawn as if the other were there."""
    values = {"repeatability": 1e-4, "shared": 3e-5}
    draws = {}
    for count in (1, 2):
        robot = Robot.load("ur10e").with_targets([[0.0, 0.05, 0.1], [0.08, -0.03, 0.05]][:count])
        for joints, shared in ((True, True), (False, True), (True, False)):
            term = Visits(joints, shared)
            draws[joints, shared, count] = term.draw(robot, values, 400, np.random.default_rng(0))
            parts = term.parts(Poses(robot, random_configurations(robot, 2)), values)
            assert set(parts) == ({"repeatability"} if joints else set()) | (
                {"shared"} if shared and count == 2 else set()
            )
    turned, moved = draws[True, True, 2]
    assert moved.shape == (400, 2, 3) and turned.shape == (400, 6)
    assert np.std(turned) == pytest.approx(1e-4, rel=0.1) and np.std(moved) == pytest.approx(3e-5, rel=0.1)
    np.testing.assert_array_equal(moved[:, 0], moved[:, 1])
    for joints, shared in ((False, True), (True, False)):
        other, away = draws[joints, shared, 2]
        np.testing.assert_array_equal(other, turned * joints)
        np.testing.assert_array_equal(away, moved * shared)
    assert not draws[True, True, 1][1].any()


def test_what_came_with_the_data_goes_before_the_instrument() -> None:
    robot = Robot.load("ur10e")
    poses = Poses(robot, random_configurations(robot, 2))
    stated = np.broadcast_to(np.diag([1.0, 4.0, 9.0]) * 1e-10, (2, 1, 3, 3))
    points = Points(Isotropic(1e-3), floor=False)
    np.testing.assert_allclose(points.parts(poses, {}, stated)["instrument"], stated[:, 0])
    np.testing.assert_allclose(points.parts(poses, {})["instrument"][0], 1e-6 * np.eye(3))


def test_a_model_needs_its_scales_and_some_noise() -> None:
    scales = typical().scales
    with pytest.raises(InputError, match="scales"):
        ErrorModel(Placement(), Gravity(), None, None, Points(), scales[:2])
    with pytest.raises(InputError, match="noise"):
        ErrorModel(Placement(), None, None, None, Points(floor=False), scales)
    slim = ErrorModel(Placement("flat"), None, None, Visits(shared=False), Points(), scales)
    assert [s.name for s in slim.scales] == ["repeatability", "floor"]
    with pytest.raises(UnknownNameError):
        slim.with_values({"gravity": 1.0})
    with pytest.raises(UnknownNameError, match="joint_functions, visits"):
        slim.without("placement")
    with pytest.raises(UnknownNameError, match="tolerance"):
        Placement("tight")


def test_a_model_without_a_term_keeps_the_others() -> None:
    model = typical(noise=Isotropic(1e-5))
    names = ("placement", "gravity", "joint_functions", "visits", "points")
    assert tuple(term.name for term in model.terms) == names and not model.points.estimate_scale
    for term in ("gravity", "joint_functions", "visits"):
        less = model.without(term)
        assert [t for t in less.terms if t not in model.terms] == []
        assert tuple(t.name for t in less.terms) == tuple(n for n in names if n != term)
    for left, gone in (("smooth", "short"), ("short", "smooth")):
        less = model.without(gone)
        assert less.joint_functions is not None and less.joint_functions.components == (left,)
        assert less.without(left) == model.without("joint_functions")
        assert less.terms[:2] + less.terms[3:] == model.terms[:2] + model.terms[3:]
    alone = model.placement_alone
    assert tuple(t.name for t in alone.terms) == ("placement", "visits", "points")
    kept = ("placement.length", "placement.angle", "repeatability", "shared", "floor")
    assert tuple(alone.values) == kept


def test_the_papers_model_is_placement_and_noise_and_a_stated_one_is_all_of_it() -> None:
    assert ErrorModel.paper().is_papers and ErrorModel.paper(3e-5).is_papers
    for kept in ("gravity", "joint_functions", "visits"):
        model = typical()
        for term in {"gravity", "joint_functions", "visits"} - {kept}:
            model = model.without(term)
        assert not model.is_papers and model.without(kept).is_papers
    assert ErrorModel.paper().with_noise(3e-5) == ErrorModel.paper(3e-5)
    told = typical(estimate_scale=True).with_noise(3e-5)
    assert told.points == Points(Isotropic(3e-5), estimate_scale=True) and told.values["floor"] == 2e-5


def test_sizes_are_more_than_zero_and_a_factor_is_one_or_more() -> None:
    size = Scale("floor", 2e-5, 3e-5, 1.0, "m")
    assert size.known and not replace(size, factor=1.5).known
    for field, wrong in (("value", 0.0), ("value", -0.5), ("median", 0.0), ("median", -0.5), ("factor", 0.99)):
        with pytest.raises(InputError, match=rf"floor\.{field}"):
            replace(size, **{field: wrong})


def test_tolerances_of_a_data_sheet_are_known_where_a_model_had_none() -> None:
    robot = mixed().with_parameters("full", ("base", "tool"))
    model = with_tolerances(ErrorModel.paper(3e-5))
    assert model.placement.prior == "tolerance" and all(s.known for s in model.scales)
    assert model.values == {"placement.length": 5e-4, "placement.angle": 1e-3}
    np.testing.assert_array_equal(model.variances(robot), Placement().variances(robot, model.values))
    assert with_tolerances(typical()) == typical() and with_tolerances(model) is model
