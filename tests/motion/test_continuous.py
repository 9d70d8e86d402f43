"""The equations of motion in continuous time equal a closed form and those of Drake's continuous plant."""

import numpy as np
import pytest
from helpers.models import MODELS, random_state
from helpers.plants import pd_pendulum
from helpers.table import each_row
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

import drake_diff as dd
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.motion.continuous import replayed


def test_kellys_cart_pole(load):
    """M. Kelly's equations, with m1 = 1 (cart), m2 = 0.3, l = 0.5:

    x'' = (l m2 sin q w^2 + u + m2 g cos q sin q) / (m1 + m2 sin^2 q),
    q'' = -(l m2 cos q sin q w^2 + u cos q + (m1 + m2) g sin q) / (l m1 + l m2 sin^2 q).
    """
    f = EquationsOfMotion(load("cart_pole.urdf"))
    expected = [-0.3, 1.1, 3.172075726216, -17.491825696946]
    assert f(np.array([0.1, 0.7, -0.3, 1.1]), np.array([2.0])) == pytest.approx(expected, abs=1e-11)


def test_many_knots_at_once_and_those_that_are_no_numbers(load):
    """Values that are not finite give NaN for many knots, and an error for one. Knot 1 is that of the last test."""
    f = EquationsOfMotion(load("cart_pole.urdf"))
    knots = np.array([[0.0, 0.0, 0.0, 0.0, 1.3], [0.1, 0.7, -0.3, 1.1, 2.0], [0.0, np.nan, 0.0, 0.0, 0.0]])
    found = f.values(knots)
    assert found[0] == pytest.approx([0, 0, 1.3, -1.3 / 0.5], abs=1e-12)  # at rest: u / m1 and -u / (l m1)
    assert found[1] == pytest.approx([-0.3, 1.1, 3.172075726216, -17.491825696946], abs=1e-11)
    assert np.isnan(found[2]).all()
    with pytest.raises(SimulationError, match="not finite"):
        f(knots[2, :4], knots[2, 4:])


@pytest.mark.parametrize(("q", "w", "u"), [(0.7, -1.2, 0.3), (-2.0, 3.0, -1.0)])
def test_the_damped_pendulum(load, q, w, u):
    f = EquationsOfMotion(load("pendulum.urdf"))
    acceleration = (u - 0.1 * w - 9.81 * 0.5 * np.sin(q)) / 0.25
    assert f(np.array([q, w]), np.array([u])) == pytest.approx([w, acceleration], rel=1e-12)


NAMES = ("cart_pole.urdf", "double_pendulum.urdf", "acrobot.xml", "mass_spring_damper.sdf", "projectile.sdf")


@pytest.mark.solve
@each_row("name", NAMES)
def test_values_and_derivatives_are_those_of_drakes_continuous_plant(load, name):
    model, random = load(name), np.random.default_rng(0)
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(MODELS / name))
    plant.Finalize()
    twin = plant.ToAutoDiffXd()
    context = twin.CreateDefaultContext()
    f = EquationsOfMotion(model)
    for _ in range(5):
        x, u = random_state(model, random), random.standard_normal(model.nu)
        z = InitializeAutoDiff(np.concatenate([x, u])).ravel()
        twin.SetPositionsAndVelocities(context, z[: model.nx])
        twin.get_actuation_input_port().FixValue(context, z[model.nx :])
        drake = twin.EvalTimeDerivatives(context).CopyToVector()
        ours = f.autodiff(z[: model.nx], z[model.nx :])
        assert f(x, u) == pytest.approx(ExtractValue(drake).ravel(), rel=1e-11, abs=1e-11)
        assert ExtractGradient(ours) == pytest.approx(ExtractGradient(drake), rel=1e-9, abs=1e-9)


def test_pd_control_has_no_continuous_form():
    with pytest.raises(ModelError, match="PD-controlled"):
        EquationsOfMotion(pd_pendulum())


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_an_oscillator_is_followed_in_any_unit(tmp_path, unit):
    """At 3 s, x = A cos(10 t). The relative tolerance 1e-6 must also hold for an amplitude of 1e-6 m."""
    path = tmp_path / "spring.sdf"
    path.write_text(
        '<sdf version="1.7"><model name="m"><link name="b"/><joint name="j" type="prismatic"><parent>world</parent>'
        "<child>b</child><axis><xyz>1 0 0</xyz><dynamics><spring_stiffness>100</spring_stiffness></dynamics></axis>"
        "</joint></model></sdf>"
    )
    model = dd.load_model(path, time_step=0.15)
    sizes = unit * np.array([1.0, 10.0])
    motion = replayed(model, np.array([unit, 0.0]), np.zeros((20, model.nu)), 20, 1e-6, sizes=sizes)
    assert motion.xs[-1, 0] / unit == pytest.approx(np.cos(30), abs=1e-4)
