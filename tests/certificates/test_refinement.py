"""Refinement with h, h/2 and h/4 separates physically right gradients from those that only match differences."""

import numpy as np
import pytest
from helpers.bounces import Bounce
from helpers.models import MODELS, Plant, contact_properties
from helpers.table import each_row
from pydrake.multibody.tree import PdControllerGains

import drake_diff as dd
from drake_diff.certificates.displaced import DisplacedDirection
from drake_diff.certificates.truth import TrueSlope, Truth, beside_truth, judge_levels
from drake_diff.exceptions import CertificateError, InputError, ModelError, SimulationError
from drake_diff.motion.continuous import ContinuousMotion

pytestmark = pytest.mark.solve


def height(x):
    return x[0]


@pytest.mark.slow
def test_through_a_bounce_the_gradient_does_not_converge_and_is_called_that(tmp_path):
    """A rigid ball ends at 2 r - y0 - v0 T, so d y / d y0 = -1 and d y / d v0 = -T."""
    model = Bounce(1e5, gravity=0.0).model(tmp_path / "bouncer.sdf", "lagged", 1 / 480)
    certificate = dd.certify_rollout(model, [1.003, -2.0], None, height, num_steps=480, refine=True)
    assert certificate.verdict == "not_converged", str(certificate)
    assert certificate.entries[0].verdict == "not_converged"
    assert "not converged: do not optimize with this gradient" in str(certificate)
    with pytest.raises(CertificateError, match="not converged: do not optimize with this gradient"):
        certificate.require()


DROP, FALL = (0.6, 0.0), 0.5  # touches the floor after 0.319 s at 3.13 m/s


@pytest.mark.slow
def test_a_gradient_that_converges_to_the_slope_of_the_teeth_is_refused(tmp_path):
    """The contact force of `sap` jumps by k tau v, so the loss is a sawtooth, and its gradient the slope of a tooth."""
    ball, h = Bounce(1e4, relaxation_time=0.01), 2e-3
    model = ball.model(tmp_path / "bouncer.sdf", "sap", h)
    certificate = dd.certify_rollout(model, DROP, None, height, num_steps=round(FALL / h), refine=True, seconds=60)
    refinement, (truth, uncertain) = certificate.refinements[0], ball.slopes("sap", DROP, FALL)
    assert uncertain < 1e-4
    assert np.ptp(refinement.values[:, 0]) < 0.08 * abs(refinement.values[0, 0])  # it converges to a wrong value
    assert abs(refinement.values[2, 0] - truth[0]) > 3
    assert certificate.verdict == "not_converged"
    assert [slope.value for slope in certificate.truth.slopes] == pytest.approx(truth, abs=1e-3)
    assert refinement.apart == ("slide_x[0]", "slide_v[0]")


@pytest.mark.parametrize("approximation", ["sap", "lagged"])
def test_the_continuous_motion_is_that_of_the_contact_law(tmp_path, approximation):
    """The motion over several bounces is compared with an independent integration from event to event."""
    ball = Bounce(2e3, relaxation_time=4e-3, dissipation=0.2, mass=0.7)
    model = ball.model(tmp_path / "bouncer.sdf", approximation, 0.01)
    found = ContinuousMotion(model).states(np.array([0.5, -0.5]), np.zeros((100, 0)))[-1]
    assert found == pytest.approx(ball.end(approximation, (0.5, -0.5), 1.0), abs=1e-5)


def test_a_smooth_motion_converges_to_the_slopes_of_the_motion_itself(load):
    certificate = dd.certify_rollout(
        load("pendulum.urdf"), [0.5, 0.3], np.full((30, 1), 0.2), height, refine=True, parameters=("pole.mass",)
    ).require()
    slopes = certificate.truth.slopes
    assert [slope.column for slope in slopes] == ["hinge_q[0]", "hinge_w[0]", "motor at all times", "pole.mass"]
    limit = certificate.refinements[0].limit
    for slope in slopes:  # the error of extrapolation is of second order in h = 10 ms, at 4.4 rad/s
        assert limit[list(slope.columns)].sum() == pytest.approx(slope.value, rel=0.01)
    assert certificate.refinements[0].apart == ()


@pytest.mark.slow
def test_where_there_is_no_continuous_motion_it_is_said_why(tmp_path):
    gains = '<actuator name="motor"><drake:controller_gains p="2" d="0.2"/></actuator>'
    text = (MODELS / "pendulum.urdf").read_text().replace('<actuator name="motor"/>', gains)
    held = tmp_path / "held.urdf"
    held.write_text(text.replace("<robot ", '<robot xmlns:drake="http://drake.mit.edu" '))
    model = dd.load_model(held, time_step=0.01)
    certificate = dd.certify_rollout(model, [0.5, 0.3], np.zeros((30, 1)), height, refine=True).require()
    assert "PD controllers are not supported in continuous time" in certificate.no_truth
    assert certificate.refinements[0].converged.all()  # without contact, the loss has no sawtooth


def test_a_motion_that_is_too_stiff_for_error_control_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(ContinuousMotion, "most", 300)
    model = Bounce(1e4, relaxation_time=0.01).model(tmp_path / "bouncer.sdf", "sap", 2e-3)
    with pytest.raises(SimulationError, match="too stiff: 300 evaluations do not reach its end"):
        ContinuousMotion(model).states(np.array(DROP), np.zeros((250, 0)))


@each_row("kind, converges", [("position [rad]", True), ("position [m]", False)])
def test_an_entry_is_judged_by_the_size_of_those_of_its_kind(kind, converges):
    """The first-order error 0.02, 0.01, 0.005 is small next to an entry of 1 of the same kind, and large alone."""
    values = np.array([[1.0, 0.02], [1.0, 0.01], [1.0, 0.005]])
    found = judge_levels((1.0, 0.5, 0.25), ["a", "b"], values, ["position [rad]", kind])
    assert found.converged.tolist() == [True, converges]


SLOPES = {  # value and error of the slope in continuous time, whether there is contact, and whether 1 converges
    "the same": ((1.0, 0.0), True, True),
    "9 % off": ((0.92, 0.01), True, True),
    "12 % off": ((0.88, 0.0), False, False),
    "another sign": ((-1.0, 0.0), False, False),
    "known to 20 %": ((1.0, 0.2), False, False),
    "none": (None, False, False),
    "unknown, and nothing touches": ((), False, True),
    "unknown, and something touches": ((), True, False),
}


@each_row("case", SLOPES)
def test_a_gradient_of_one_is_compared_with_the_slope_of_the_motion(case):
    slope, touches, converges = SLOPES[case]
    levels = judge_levels((1.0, 0.5, 0.25), ["z"], np.ones((3, 1)), ["position [m]"])
    assert levels.converged.all()
    known = {"value": slope[0], "error": slope[1]} if slope else {}
    exists = None if slope == () else slope is not None
    truth = Truth("Kelvin-Voigt", 0.0, 0.0, 0.0, (TrueSlope("z", (0,), 1.0, exists=exists, **known),), 1.0, touches)
    line = DisplacedDirection("z", np.array([0]), 1.0, np.ones(1), 1.0)
    found = beside_truth(levels, [line], truth, touches=touches)
    assert found.converged.all() == converges
    assert found.apart == (() if converges else ("z",))


@pytest.mark.slow
@pytest.mark.parametrize("h", [0.01, 0.005])
def test_the_gradient_of_a_spring_tends_to_the_continuous_one(load, h):
    """For m x'' + c x' + k x = 0, d x(T) / d x(0) = e^(-a T) (cos w T + a / w sin w T) with a = c / 2 m."""
    model, count = load("mass_spring_damper.sdf", time_step=h), round(0.5 / h)
    x0 = [0.35, -0.4]
    certificate = dd.certify_rollout(model, x0, np.zeros((count, 1)), height, refine=True).require()
    m, c, k = 2.0, 1.5, 50.0
    a, w, T = c / (2 * m), np.sqrt(k / m - (c / (2 * m)) ** 2), 0.5
    by_x = np.exp(-a * T) * (np.cos(w * T) + a / w * np.sin(w * T))
    by_v = np.exp(-a * T) * np.sin(w * T) / w
    # The error of extrapolation is of second order: h^2 times w^2.
    assert certificate.refinements[0].limit[:2] == pytest.approx([by_x, by_v], abs=(10 * h) ** 2)


def test_inputs_and_parameters_are_refined_too(load):
    us = np.full((30, 1), 0.1)
    certificate = dd.certify_rollout(
        load("pendulum.urdf"), [0.5, 0], us, lambda xs, us: (xs[:, 0] ** 2).sum() + (us**2).sum(),
        refine=True, parameters=("pole.mass", "hinge.damping"),
    ).require()  # fmt: skip
    assert certificate.columns[-2:] == ("pole.mass", "hinge.damping")
    assert certificate.refinements[0].values.shape == (3, 2 + 30 + 2)
    assert certificate.refinements[0].converged.all()


def test_a_model_with_one_time_step_is_compared_with_the_truth_or_refused():
    """A plant from a diagram has a motion in continuous time if it falls freely, but not under PD control."""
    plant = Plant(0.01)
    plant.ball("ball", 1.0, 0.1, contact_properties(1e4), "z")
    certificate = dd.certify_rollout(plant.model(), [1.0, 0.0], None, height, num_steps=3, refine=True).require()
    assert certificate.refinements == ()
    assert [one.value for one in certificate.truth.slopes] == pytest.approx([1.0, 0.03], abs=1e-9)
    plant = Plant(0.01)
    plant.ball("ball", 1.0, 0.1, contact_properties(1e4), "z")
    motor = plant.plant.AddJointActuator("motor", plant.plant.GetJointByName("ball_z"))
    motor.set_controller_gains(PdControllerGains(p=1.0, d=0.1))
    with pytest.raises(ModelError, match="build another diagram"):
        dd.certify_rollout(plant.model(), [1.0, 0.0], np.zeros((3, 1)), height, refine=True)


def test_the_time_step_is_not_refined_and_a_parameter_at_once(load):
    model, step = load("pendulum.urdf"), ("model.time_step",)
    with pytest.raises(InputError, match="refine=True changes"):
        dd.certify_rollout(model, [0.1, 0], [[0.0]], height, refine=True, parameters=step)


def two_balls(h, stiffness, masses=(1.0, 1.0)):
    """Build two balls on slides along x. In the tests, the first runs into the second, which is at rest."""
    plant = Plant(h, "lagged", gravity=0.0)
    for name, mass in zip(("left", "right"), masses, strict=True):
        plant.ball(name, mass, 0.1, contact_properties(2 * stiffness), "x")
    return plant.model()


@pytest.mark.parametrize("stiffness", [1e3, 1e5])
def test_momentum_holds_of_a_gradient_that_is_wrong(stiffness):
    """Rigid balls of equal mass swap velocities, so d x2(T) / d (x1, x2, v1, v2) = (1, 0, 1, 0).

    A discrete, compliant contact preserves the sums (1 for positions, T for velocities), but not the single entries.
    """
    h, count = 1 / 100, 100
    model = two_balls(h, stiffness)
    x0 = [0.0, 0.52, 1.0, 0.0]
    losses = (lambda x: x[0], lambda x: x[1])
    left, right = (dd.differentiate_rollout(model, x0, None, loss, num_steps=count).by_x0 for loss in losses)
    assert left + right == pytest.approx([1.0] * 4, rel=1e-6)  # SAP's tolerance
    assert np.abs(right - [1, 0, 1, 0]).max() > 0.05


def test_two_balls_resolved_tend_to_the_rigid_gradient():
    """In closed form, d x2(T) / d (x1, x2, v1, v2) = (1, 0, T - tau, tau) with tau = pi / (2 w) and w^2 = 2 k / m.

    The balls are in contact for pi / w, while their centre of mass moves on. With t1 = (x2 - x1 - 2 r) / v, the time
    of contact, x2(T) = x2 + v (T - t1 - pi / w) + v pi / (2 w).
    """
    h, count, k = 1e-4, 5000, 500.0
    x0 = [0.0, 0.25, 1.0, 0.0]
    gradient = dd.differentiate_rollout(two_balls(h, k), x0, None, lambda x: x[1], num_steps=count)
    half = np.pi / np.sqrt(2 * k) / 2
    # h w = 0.003, over the 1000 steps in contact
    assert gradient.by_x0 == pytest.approx([1.0, 0.0, h * count - half, half], abs=0.05)


def test_growth_rate_of_a_block_has_its_closed_form(write_urdf):
    """As |d x_N / d (x_k, v_k)| = |(1, (N - k) h)|, the growth rate over N steps is |(1, N h)|^(1/N)."""
    h, count = 0.1, 7
    model = write_urdf(mass=2.0, time_step=h)
    free = dd.differentiate_rollout(model, [0.5, -1.0], np.zeros((count, 1)), lambda x: x[0])
    assert free.growth_rate == pytest.approx(np.hypot(1, count * h) ** (1 / count), rel=1e-12)
    early = dd.differentiate_rollout(model, [0.5, -1.0], np.zeros((count, 1)), lambda xs, us: xs[0][0] + 0 * xs[1][0])
    assert np.isnan(early.growth_rate)


def test_a_gradient_grows_with_a_motion_that_falls_over_and_dies_out_where_friction_stops_one(load):
    """|dx_N / dx_k| grows by the step's spectral radius for an inverted pendulum, and vanishes for a stopped ball."""
    model = load("pendulum.urdf", time_step=0.01)
    gradient = dd.differentiate_rollout(model, [np.pi, 0], np.zeros((600, 1)), lambda x: x[0])
    radius = np.abs(np.linalg.eigvals(dd.differentiate_step(model, [np.pi, 0], [0]).A)).max()
    assert gradient.growth_rate == pytest.approx(radius, rel=1e-2)  # the start and the end are no eigenvectors
    plant = Plant(0.01, "lagged")
    plant.ball("ball", 1.0, 0.1, contact_properties(2e4, 10.0, 0.5), "x", "z")
    plant.ground(contact_properties(2e4, 10.0, 0.5))
    x0 = [0.0, 0.1 - 9.81 / 1e4, 1.0, 0.0]
    norms = dd.differentiate_rollout(plant.model(), x0, None, lambda x: x[2], num_steps=60).state_gradient_norms
    assert norms[0] < 1e-6 * norms[-1]
