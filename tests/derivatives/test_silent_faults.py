"""Wrong derivatives that Drake returns without an error, and the checks that detect them."""

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import offset_pendulum, pair, pd_pendulum
from helpers.table import slow_after
from pydrake.geometry import Box, Cylinder, Sphere
from pydrake.multibody.tree import PdControllerGains

import drake_diff as dd
from drake_diff.derivatives.sources import check_parity
from drake_diff.exceptions import CertificateError, GradientError, InputError, SimulationError, UnknownNameError
from drake_diff.model.plant import actuators


def test_pd_gains_reach_the_autodiff_twin():
    """(m l^2 + h d + h^2 p) w+ = m l^2 w + h (u - m g l sin q - p q) with the target q = 0 at rest."""
    model, h, q, w, u = pd_pendulum(), 0.01, 0.7, -1.2, 0.3
    inertia = 0.25 + h * 3.0 + h**2 * 20.0
    w_next = (0.25 * w + h * (u - 9.81 * 0.5 * np.sin(q) - 20.0 * q)) / inertia
    d = dd.differentiate_step(model, [q, w], [u], method="autodiff")
    assert d.x_next[1] == pytest.approx(w_next, rel=1e-7)  # solved by SAP
    assert d.A[1] == pytest.approx([-h * (4.905 * np.cos(q) + 20.0) / inertia, 0.25 / inertia], rel=1e-6)
    assert d.B[1, 0] == pytest.approx(h / inertia, rel=1e-6)


@pytest.mark.slow
def test_dropped_pd_gains_are_caught_by_the_parity_gate():
    model = pd_pendulum()
    twin = actuators(model.autodiff.plant)[0]
    twin.set_controller_gains(PdControllerGains(p=1e-12, d=0.0))  # almost 0, as if they were dropped
    with pytest.raises(GradientError, match="the AutoDiffXd step differs from the double step: hinge_w"):
        dd.differentiate_step(model, [0.7, -1.2], [0.3], method="autodiff")
    found = dd.differentiate_step(model, [0.7, -1.2], [0.3])
    assert found.method == "analytic"  # its equation has the gains of the double plant
    np.testing.assert_allclose(found.A, dd.differentiate_step(pd_pendulum(), [0.7, -1.2], [0.3]).A, rtol=1e-12)


def certify_offset():
    return dd.certify(offset_pendulum(), [0.3, 0.4, 0.5, 0.6], parameters=("second.offset",))


def test_the_derivative_by_an_identity_offset_is_kept():
    certify_offset().require()


def test_the_derivative_that_drake_drops_at_an_identity_offset_is_caught(monkeypatch):
    monkeypatch.setattr("drake_diff.model.parameters.IDENTITY_OFFSET", 0.0)
    certificate = certify_offset()
    assert certificate.verdict == "disagree"
    assert certificate.worst.column.startswith("second.offset")
    assert certificate.worst.derivative == 0.0
    with pytest.raises(CertificateError, match=r"second\.offset"):
        certificate.require()


def refuses(model, x):
    """Return whether the derivative at x is refused or not certified."""
    try:
        return dd.certify(model, x, method="autodiff").verdict != "agree"
    except GradientError:
        return True  # AutoDiffXd gives NaN at this state in Drake 1.51


@pytest.mark.solve
def test_a_sphere_exactly_on_a_cylinders_axis_is_caught():
    assert refuses(*pair(Sphere(0.1), Cylinder(0.2, 0.2), hydroelastic=False, height=0.0995))


def test_the_same_sphere_beside_the_axis_is_certified():
    model, x = pair(Sphere(0.1), Cylinder(0.2, 0.2), hydroelastic=False, height=0.0995)
    x[4] = 0.013
    dd.certify(model, x, method="autodiff").require()


@pytest.mark.solve
@pytest.mark.parametrize(
    ("upper", "lower", "height"),
    slow_after(
        1,
        [
            (Sphere(0.1), Cylinder(0.2, 0.2), 0.095),  # a sphere over a horizontal cap
            (Cylinder(0.1, 0.2), Cylinder(0.2, 0.2), 0.095),  # aligned caps
            (Box(0.2, 0.2, 0.2), Box(1, 1, 0.2), 0.0995),  # flat faces
        ],
    ),
)
def test_aligned_hydroelastic_shapes_are_caught(upper, lower, height):
    assert refuses(*pair(upper, lower, hydroelastic=True, height=height))


@pytest.mark.slow
def test_a_pair_that_autodiff_refuses_has_the_derivative_of_the_steps_equation():
    model, x = pair(Box(0.2, 0.2, 0.2), Box(1, 1, 0.2), hydroelastic=False, height=0.0995)
    x[:4] = [0.9996, 0.02, -0.015, 0.01]
    x[:4] /= np.linalg.norm(x[:4])
    d = dd.differentiate_step(model, x)
    assert d.method == "analytic"
    differences = dd.differentiate_step(model, x, method="finite_difference")
    assert np.abs(d.A - differences.A).max() <= 1e-5 * np.abs(d.A).max()  # differences of a stiff step
    with pytest.raises(SimulationError, match="Box"):
        dd.differentiate_step(model, x, method="autodiff")


def test_an_unknown_method_or_parameter_is_named(load):
    model = load("pendulum.urdf")
    known = "one of analytic, auto, autodiff, finite_difference, implicit, got 'magic'"
    with pytest.raises(UnknownNameError, match=known):
        dd.differentiate_step(model, [0, 0], [0], method="magic")
    for refused in (
        lambda: dd.certify(model, [0, 0], [0], method="magic"),
        lambda: dd.certify_rollout(model, [0, 0], [[0]], lambda x: x[0], method="magic"),
        lambda: dd.differentiate_rollout(model, [0, 0], [[0]], lambda x: x[0], method="magic"),
    ):
        with pytest.raises(UnknownNameError, match="one of analytic, auto, autodiff"):
            refused()
    with pytest.raises(UnknownNameError, match=r"pole\.mass"):
        dd.differentiate_step(model, [0, 0], [0], parameters=("poel.mass",))


def test_parameter_columns_have_their_closed_form(load):
    """w+ = s (w + h (u - m g l sin q) / I) with s = 1 / (1 + h b / I), I = m l^2, and a fixed l."""
    h, q, w, u, b, inertia = 0.01, 0.7, -1.2, 0.3, 0.1, 0.25
    d = dd.differentiate_step(load("pendulum.urdf"), [q, w], [u], parameters=("hinge.damping", "pole.mass"))
    s = 1 / (1 + h * b / inertia)
    w_next = s * (w + h * (-(9.81 / 0.5) * np.sin(q) + u / inertia))
    by_damping = -h / inertia * s * w_next
    by_mass = s * (h * b / inertia * w_next - h * u / inertia)  # dI/dm = I at m = 1
    assert d.parameters == ("hinge.damping", "pole.mass")
    assert d.C[1] == pytest.approx([by_damping, by_mass], rel=1e-9)
    assert d.C[0] == pytest.approx([h * by_damping, h * by_mass], rel=1e-9)


@pytest.mark.solve
def test_every_listed_parameter_is_certified_at_a_good_state():
    model = dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.005)
    names = [p.name for p in dd.list_parameters(model)]
    assert {"upper.mass", "lower.center_of_mass", "elbow.damping", "elbow.offset"} <= set(names)
    edge = (".damping", ".rotor_inertia", ".inertia")  # values of zero, and rods: see the next test
    names = [name for name in names if not name.endswith(edge)]
    dd.certify(model, [0.4, -0.9, 1.3, -0.6], [0.25, -0.15], parameters=names).require()


def test_a_parameter_that_cannot_be_differenced_is_named_before_drake_ends_the_process(load):
    model = load("double_pendulum.urdf")
    with pytest.raises(InputError, match=r"elbow\.damping: expected a value above 0"):
        dd.certify(model, np.zeros(4), np.zeros(2), parameters=("elbow.damping",))


@pytest.mark.parametrize("value", [2.0 + 1e-6, np.nan])
def test_one_coordinate_in_which_the_autodiff_step_leads_elsewhere_is_enough(value):
    model = pd_pendulum()
    double = np.array([1.0, 2.0])
    check_parity(model, double + 1e-12, double)  # rounding
    with pytest.raises(GradientError, match="the AutoDiffXd step differs from the double step: hinge_w"):
        check_parity(model, np.array([1.0, value]), double)
