"""Tests of the Jacobians and Hessians of whole programs against central differences."""

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import random_tree

import drake_diff as dd
from drake_diff.optimize import Coupling, InputRate, Jerk, Periodic, PhasedProblem
from drake_diff.optimize.transcription.collocation import Transcription
from drake_diff.optimize.transcription.steps import StepProgram

BOTH = ("controls", "initial_state")
EFFORT = dd.QuadraticCost(R=[[1.0]])
STEP = 1e-6


def block(x, u):
    return [x[1], u[0]]


def pendulum(x, u):
    return [x[1], u[0] - np.sin(x[0])]


def coupled(horizon):
    several = [
        Coupling(lambda a, b, c: [a[0] * b[1] * c[0], b[0] ** 3], knots=(5, 2, -1), upper=[0.4, 1.0], name="states"),
        Coupling(lambda a, b, u, w: np.sin(b[0]) * u[0] * w[0] - a[1], knots=(3, 5), lower=0.0, name="inputs"),
        Periodic(M=[[0.0, 1.0]], offset=[0.3], entries=[0]),
    ]
    way = {"num_steps": 6, "horizon": horizon, "running_cost": EFFORT, "couplings": several, "optimize": BOTH}
    return dd.Problem(dd.Dynamics(block, 2, 1), x0=[0, 0], **way)


def with_rates(horizon):
    model = dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.05)
    limits = [Jerk({"elbow": 80.0}, name="elbow"), InputRate(50.0), Jerk(100.0)]
    cost = dd.QuadraticCost(R=np.eye(2))
    return dd.Problem(model, x0=np.zeros(4), num_steps=4, horizon=horizon, running_cost=cost, couplings=limits)


def with_everything(horizon):
    keep = dd.Constraint(lambda x, u: [x[0] * u[0], x[1] ** 3], lower=[-1, -2], upper=[2, 9])
    return dd.Problem(
        dd.Dynamics(pendulum, 2, 1, x_lower=[-9, np.nan], u_lower=[-4], u_upper=[5]),
        x0=[0, 0],
        x_goal=[np.pi, np.nan],
        num_steps=5,
        horizon=horizon,
        running_cost=lambda x, u: u[0] ** 2 * np.cos(x[1]),
        final_cost=lambda x: np.sin(x[1]) * x[0] ** 2,
        constraints=[keep, dd.Constraint(lambda x: x[0] ** 2 * x[1], upper=3, knots=[2, -1])],
        waypoints={3: [np.nan, 1.0]},
    )


def co_design(horizon):
    return dd.Problem(
        dd.load_model(MODELS / "cart_pole.urdf", time_step=0.05),
        x0=np.zeros(4),
        x_goal=[0.5, 0.2, 0, 0],
        num_steps=3,
        running_cost=EFFORT,
        horizon=horizon,
        optimize=("controls", "parameters"),
        parameters=("pole.mass", "cart.mass", "pole.center_of_mass"),
        parameter_cost=lambda p: p[0] ** 3 + p[1] * p[2],
        bounds=dd.Bounds(x_upper=[1, 2, 3, 4], u_upper=[5], u_lower=[-5]),
    )


def of_a_tree(horizon):
    model = random_tree(1)
    return dd.Problem(model, x0=np.zeros(model.nx), x_goal=np.full(model.nx, 0.1), num_steps=2, horizon=horizon)


def in_phases(horizon):
    def reset(x):
        return np.array([-x[0], x[1] * np.cos(x[0])])

    step = dd.Problem(dd.Dynamics(pendulum, 2, 1), x0=[0, 0], num_steps=2, horizon=horizon, running_cost=EFFORT)
    return PhasedProblem([step, step], resets=[reset], periodic=reset, horizon=(0.6, 4))


def of_a_map(_):
    f = dd.optimize.DiscreteMap(lambda x, u, k: [x[0] * x[1] + u[0], x[1] - k * x[0] ** 2], 2, 1)
    return dd.Problem(f, x0=[0.1, 0.2], num_steps=4, running_cost=lambda x, u, t: t * u[0] ** 2 * x[1])


PROBLEMS = [coupled, with_rates, with_everything, co_design, of_a_tree, in_phases]


def check(program, *, free=slice(None), tolerance=1e-6):
    """Check the derivatives of the cost, the rows and the Lagrangian, relative to the largest entry."""
    made, random = program.derivatives(exact=not program.why_not), np.random.default_rng(0)
    z, weights = random.uniform(0.4, 1, program.size), random.standard_normal(len(program.sides[0]))

    def values(z):
        return np.append(np.asarray(made["jac_g"](z, [])[0]).ravel(), float(made["grad_f"](z, [])[0]))

    def slopes(z):
        return np.vstack([np.asarray(made["jac_g"](z, [])[1]), np.asarray(made["grad_f"](z, [])[1]).T])

    def differences(f):
        return np.array([(f(z + e) - f(z - e)) / (2 * STEP) for e in STEP * np.eye(len(z))])

    wanted = differences(values).T
    assert np.max(np.abs(slopes(z) - wanted)) < tolerance * np.max(np.abs(wanted))
    assert made["jac_g"](z, [])[1].nnz() < 0.75 * wanted[:-1].size
    if program.why_not:
        return
    wanted = differences(lambda z: np.append(weights, 0.7) @ slopes(z))
    upper = np.asarray(made["hess_lag"](z, [], 0.7, weights))
    found = upper + np.triu(upper, 1).T
    assert np.max(np.abs(found - wanted)[free][:, free]) < 10 * tolerance * np.max(np.abs(wanted))


@pytest.mark.parametrize("horizon", [1.0, (0.3, 2.0)], ids=["given", "free"])
@pytest.mark.parametrize("problem", PROBLEMS)
def test_derivatives_of_a_program_are_its_differences(problem, horizon):
    check(Transcription(problem(horizon), "hermite_simpson").program())


@pytest.mark.parametrize("problem", [coupled, with_rates, with_everything])
@pytest.mark.parametrize("scheme", ["trapezoid", "drake"])
def test_derivatives_in_other_schemes_are_differences(problem, scheme):
    check(Transcription(problem((0.3, 2.0)), scheme).program())


def test_derivatives_of_a_map_of_many_steps_are_differences():
    check(Transcription(of_a_map(None), "map").program())


def test_what_has_no_expression_is_called_and_has_no_hessian():
    def branches(x, u):
        return pendulum(x, u) if x[0] > -10 else [0 * x[0], 0 * x[1]]

    problem = dd.Problem(dd.Dynamics(branches, 2, 1), x0=[0, 0], x_goal=[1, 0], num_steps=3, horizon=(0.3, 2.0))
    program = Transcription(problem, "hermite_simpson").program()
    assert program.why_not.startswith("dynamics: ")
    check(program)


JOINED = {"trajectory_cost": lambda xs, us: xs[3, 0] * xs[4, 1] + us[2, 0] ** 3}


@pytest.mark.parametrize("changes", [{}, JOINED], ids=["plain", "trajectory_cost"])
def test_derivatives_of_a_program_of_steps_are_differences(changes):
    """The steps do not lead from state to state, as during a search."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    problem = dd.Problem(
        model,
        x0=[0, 0],
        num_steps=6,
        running_cost=EFFORT,
        optimize=("controls", "initial_state", "parameters"),
        initial_state_mask=[False, True],
        parameters=["hinge.damping"],
        parameter_cost=lambda p: p[0] ** 3,
        bounds=dd.Bounds(x_upper=[9, 4]),
        waypoints={4: [0.3, np.nan]},
        constraints=[
            dd.Constraint(lambda x, u: u[0] * x[1], upper=5),
            dd.Constraint(lambda x: np.sin(x[0]), lower=-0.9, upper=0.9, knots=[0, 2, -1]),
            dd.Constraint(lambda x: x[0] ** 2 if x[0] > -10 else 0 * x[0], upper=5, name="called"),
        ],
        couplings=[Coupling(lambda a, b, u, w: a[0] * b[1] + u[0] * w[0], knots=(3, 5), upper=1.0, name="joined")],
        **changes,
    )
    program = StepProgram(problem)
    check(program, tolerance=1e-5)


@pytest.mark.parametrize("unit", [1.0, 1e6])
def test_a_row_that_changes_by_rounding_alone_is_as_large_as_its_values(unit):
    """An example is the distance of a shape from the axis that it turns about, whose slope is 1e-17."""

    def rows(x):
        return np.array([0.5 * unit + 1e-17 * unit * x[0], 2e-5 * unit * x[1]])

    problem = dd.Problem(
        dd.Dynamics(pendulum, 2, 1),
        x0=[0, 0],
        num_steps=3,
        horizon=1.0,
        running_cost=EFFORT,
        constraints=[dd.Constraint(rows, lower=[0.1 * unit, 0.0])],
    )
    transcription = Transcription(problem, "hermite_simpson")
    program = transcription.program([np.linspace(0, 1, 4)])
    constant = program.sides[0] == 0.1 * unit
    scales = program.scales_at(np.full(program.size, 0.2)).rows
    assert scales[constant] == pytest.approx(np.full(np.sum(constant), 0.5 * unit))
    assert np.min(scales) == pytest.approx(min(0.2, 2e-5 * unit * 0.2))
