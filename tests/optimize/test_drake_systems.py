"""`Dynamics.from_system`: Drake's own systems as dynamics of a problem, simulated by Drake's Simulator."""

import numpy as np
import pytest
from helpers.models import MODELS
from pydrake.examples import AcrobotPlant, CompassGait, PendulumPlant, QuadrotorPlant, VanDerPolOscillator
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, LeafSystem, LeafSystem_
from pydrake.systems.primitives import LinearSystem, Multiplexer
from pydrake.systems.scalar_conversion import TemplateSystem

import drake_diff as dd
from drake_diff.optimize.transcription import program

EFFORT = dd.QuadraticCost(R=[[1.0]])


@TemplateSystem.define("Slide_")
def Slide_(T):
    """A unit mass on a slide. With `brake`, an event halves its speed every 0.25 s, which its rates do not show."""

    class Impl(LeafSystem_[T]):
        def _construct(self, brake: bool = False, gust: float = 0.0, converter=None):
            LeafSystem_[T].__init__(self, converter)
            self.brake, self.gust = brake, gust
            self.DeclareVectorInputPort("force", 1)
            self.DeclareContinuousState(2)
            if brake:
                self.DeclarePeriodicUnrestrictedUpdateEvent(0.25, 0.1, self.slow)

        def _construct_copy(self, other, converter=None):
            Impl._construct(self, other.brake, other.gust, converter=converter)

        def slow(self, context, state):
            x = context.get_continuous_state_vector().CopyToVector()
            state.get_mutable_continuous_state().SetFromVector([x[0], 0.5 * x[1]])

        def DoCalcTimeDerivatives(self, context, derivatives):
            x, u = context.get_continuous_state_vector().CopyToVector(), self.get_input_port(0).Eval(context)
            push = self.gust * context.get_time() * u[0]
            derivatives.get_mutable_vector().SetFromVector([x[1], u[0] + push])

    return Impl


def plan_of(system: dd.Dynamics) -> dd.Solution:
    """The least effort from rest to rest over a distance of 1 in 1 s, which is 12 for a unit mass."""
    return dd.solve(
        dd.Problem(system, x0=[0, 0], x_goal=[1, 0], num_steps=20, horizon=1.0, running_cost=EFFORT),
        method="collocation",
    )


def test_a_pendulum_has_the_derivatives_of_its_formula_at_the_parameters_of_a_context():
    plant = PendulumPlant()
    context = plant.CreateDefaultContext()
    mass, length, damping, gravity = (context.get_numeric_parameter(0)[i] for i in range(4))
    x, u = np.array([0.7, -0.3]), np.array([0.4])
    for scale in (1.0, 3.0):
        context.get_mutable_numeric_parameter(0).SetAtIndex(2, scale * damping)
        f, A, B = dd.Dynamics.from_system(plant, context=context).derivatives(x, u)
        inertia, d = mass * length**2, scale * damping
        assert f == pytest.approx([x[1], (u[0] - mass * gravity * length * np.sin(x[0]) - d * x[1]) / inertia])
        assert np.allclose(A, [[0, 1], [-gravity / length * np.cos(x[0]), -d / inertia]], rtol=1e-12)
        assert np.allclose(B, [[0], [1 / inertia]], rtol=1e-12)


@pytest.mark.parametrize("system", [Slide_[None](), LinearSystem([[0, 1], [0, 0]], [[0], [1]], np.eye(2), [[0], [0]])])
def test_a_slide_in_python_and_as_a_linear_system_has_its_least_effort(system):
    solution = plan_of(dd.Dynamics.from_system(system))
    assert solution.success
    assert solution.cost == pytest.approx(12.0, rel=1e-6)
    rows = [c for c in solution.checks if c.plant == "Drake's Simulator"]
    assert [c.what for c in rows] == ["integration"]
    assert rows[0].value < 1e-6


def test_an_input_that_is_fixed_in_the_context_keeps_its_value():
    """Of two forces on a unit mass, 1 N is constant: at rest with no other force, it accelerates by 1 m/s^2."""
    system = LinearSystem([[0, 1], [0, 0]], [[0, 0], [1, 1]], np.eye(2), np.zeros((2, 2)))
    builder = DiagramBuilder()
    mass = builder.AddSystem(system)
    both = builder.AddSystem(Multiplexer([1, 1]))
    builder.Connect(both.get_output_port(), mass.get_input_port())
    builder.ExportInput(both.get_input_port(0), "force")
    builder.ExportInput(both.get_input_port(1), "wind")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    diagram.GetInputPort("wind").FixValue(context, [1.0])
    dynamics = dd.Dynamics.from_system(diagram, context=context)
    assert dynamics.input_names == ("force",)
    assert dynamics([0, 0], [0]).tolist() == [0, 1]
    solution = plan_of(dynamics)
    assert solution.success, solution.message  # the Simulator has the wind too
    assert np.mean(solution.us) == pytest.approx(-1, abs=0.5)  # the mean force of a motion from rest to rest is 0


def test_an_event_that_the_rates_do_not_show_is_found_by_the_simulator():
    solution = plan_of(dd.Dynamics.from_system(Slide_[None](True)))
    assert solution.status is dd.Status.CONVERGED_NOT_VERIFIED
    assert [c.plant for c in solution.checks.failing] == ["Drake's Simulator"]


def test_a_bare_plant_and_a_diagram_agree_with_the_model():
    bare = MultibodyPlant(0.0)
    builder = DiagramBuilder()
    inside, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    for plant in (bare, inside):
        Parser(plant).AddModels(str(MODELS / "cart_pole.urdf"))
        plant.Finalize()
    builder.ExportInput(inside.get_actuation_input_port(), "force")
    reference = dd.optimize.plant_dynamics(dd.load_model(MODELS / "cart_pole.urdf", time_step=0.01))
    systems = [dd.Dynamics.from_system(system) for system in (bare, builder.Build())]
    assert systems[0].state_names[0].endswith("slide_x")
    assert systems[1].input_names == ("force",)
    assert systems[0].bounds.u_upper.tolist() == [20.0]  # the effort limit of the file
    x, u = np.array([0.1, 0.7, -0.3, 1.1]), np.array([2.5])
    for got in (system.derivatives(x, u) for system in systems):
        for ours, wanted in zip(got, reference.derivatives(x, u), strict=True):
            assert np.allclose(ours, wanted, rtol=0, atol=1e-11)


def test_a_system_in_steps_is_a_discrete_map():
    system = dd.Dynamics.from_system(LinearSystem([[1, 0.1], [0, 1]], [[0], [0.1]], np.eye(2), [[0], [0]], 0.1))
    assert isinstance(system, dd.optimize.DiscreteMap)
    problem = dd.Problem(system, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=EFFORT)
    A, B = np.array([[1, 0.1], [0, 1]]), np.array([[0], [0.1]])
    reach = np.hstack([np.linalg.matrix_power(A, 19 - k) @ B for k in range(20)])
    least = np.linalg.lstsq(reach, np.array([1.0, 0.0]), rcond=None)[0]  # the least norm
    assert dd.solve(problem).cost == pytest.approx(least @ least, rel=1e-8)


def test_the_limit_cycle_of_a_system_without_inputs():
    """The period of the Van der Pol oscillator is 6.6632868593 at mu = 1 (Andersen and Geer, 1982)."""
    system, angle = dd.Dynamics.from_system(VanDerPolOscillator()), np.linspace(0, 2 * np.pi, 61)
    problem = dd.Problem(
        system, x0=[2.0, 0.0], num_steps=60, horizon=(4.0, 9.0), couplings=[dd.optimize.Periodic()],
        optimize=("initial_state",), initial_state_mask=[True, False],
    )  # fmt: skip
    circle = np.column_stack([2 * np.cos(angle), -2 * np.sin(angle)])
    solution = dd.solve(problem, initial_guess=(circle, None, 6.0))
    assert solution.success
    assert solution.horizon == pytest.approx(6.6632868593, rel=1e-5)
    assert dd.check_plan(problem, *solution.trajectory()).success
    assert dd.check_plan(problem, solution.xs[solution.knots], horizon=solution.horizon).success
    assert not dd.check_plan(problem, circle, horizon=solution.horizon).success


@pytest.mark.parametrize(("start", "steps"), [(1.446, 25), (2.006, 35)])
def test_the_limit_cycle_from_a_poor_guess(start, steps):
    """A straight line and noise lead to the rest at the origin. Simulations from random states lead to the cycle."""
    problem = dd.Problem(
        dd.Dynamics.from_system(VanDerPolOscillator()), x0=[start, 0.0], num_steps=steps, horizon=(3, 12),
        couplings=[dd.optimize.Periodic()], optimize=("initial_state",), initial_state_mask=[True, False],
        constraints=dd.Constraint(lambda x: x[0], lower=0.5, knots=0), running_cost=1.0,
    )  # fmt: skip
    assert dd.solve(problem).horizon == pytest.approx(6.6632868593, rel=1e-3)  # 25 intervals have an error of 1e-4


def test_systems_without_such_dynamics_are_refused_by_name():
    discrete = MultibodyPlant(0.01)
    discrete.Finalize()
    for given, words in (
        ("pendulum", "a Drake System"),
        (CompassGait(), "continuous and discrete states"),
        (discrete, "load_model and model_from_diagram"),
        (Slide_[None](False, 1.0), "rates that change in time"),
        (LeafSystem(), "no state"),
    ):
        with pytest.raises(dd.exceptions.InputError, match=words):
            dd.Dynamics.from_system(given)
    with pytest.raises(dd.exceptions.UnknownNameError, match="did you mean 'elbow_torque'"):
        dd.Dynamics.from_system(AcrobotPlant(), input_ports=["elbow_torqe"])


def test_a_system_that_cannot_be_converted_is_refused():
    class Plain(LeafSystem):
        def __init__(self):
            super().__init__()
            self.DeclareContinuousState(1)

        def DoCalcTimeDerivatives(self, context, derivatives):
            derivatives.get_mutable_vector().SetFromVector([1.0])

    with pytest.raises(dd.exceptions.GradientError, match=r"define it as a LeafSystem_\[T\]"):
        dd.Dynamics.from_system(Plain())


def test_rates_that_a_system_refuses_are_outside_its_domain():
    """Roll, pitch and yaw of Drake's quadrotor have no rates at a pitch of 90 degrees, where Drake raises an error."""
    system, x, u = dd.Dynamics.from_system(QuadrotorPlant()), np.zeros(12), np.ones(4)
    assert np.isfinite(system(x, u)).all()
    x[4] = np.pi / 2
    assert all(np.isnan(values).all() for values in system.derivatives(x, u))


def test_a_guess_that_a_system_refuses_ends_by_name():
    """A line from the gimbal lock of Drake's quadrotor has no derivatives at its first knot."""
    quadrotor, x0 = dd.Dynamics.from_system(QuadrotorPlant()), np.pi / 2 * np.eye(12)[4]
    problem = dd.Problem(quadrotor, x0=x0, x_goal=np.zeros(12), num_steps=10, horizon=1.0)
    assert "not finite" in dd.solve(problem, method="collocation", restarts=0).message


def test_a_search_that_ends_at_an_acceptable_level_is_finished_by_differences(monkeypatch):
    monkeypatch.setattr(program, "OPTIONS", program.OPTIONS | {"ipopt.acceptable_tol": 1.0})  # after 15 iterations
    lift = 0.775 * 9.81 / 4  # the input of a rotor at hover
    problem = dd.Problem(
        dd.Dynamics.from_system(QuadrotorPlant()),
        x0=np.zeros(12),
        x_goal=[-1.2, -0.3, 1.8, *np.zeros(9)],
        num_steps=23,
        horizon=2.1,
        bounds=dd.Bounds(u_lower=np.zeros(4), u_upper=np.full(4, 4.0)),
        running_cost=lambda x, u: sum((v - lift) ** 2 for v in u),
    )
    solution = dd.solve(problem, restarts=0)
    assert solution.success, solution.message
    assert "Hessian by differences" in solution.options["derivatives"]
    assert [i.dual_infeasibility for i in solution.iterations][-1] <= 1e-6  # 1e-8 in scaled variables
