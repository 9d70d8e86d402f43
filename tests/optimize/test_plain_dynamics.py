"""Tests of plain dynamics x' = f(x, u): status, measures, certificates, artifact, and refused problems."""

import dataclasses
import types

import numpy as np
import pytest
from helpers.solving import solve_with
from helpers.table import each_row
from helpers.transcription import BLOCK, own_derivatives

import drake_diff as dd
from drake_diff.exceptions import ArtifactError, GradientError, InputError, ModelError
from drake_diff.optimize import Options
from drake_diff.optimize.problem.dynamics import Pointwise
from drake_diff.optimize.program import Outcome
from drake_diff.optimize.transcription.collocation import Transcription
from drake_diff.runs.view import scene_of_run

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])


def block_move(**changes):
    """Return a move from rest to rest over 1 m in 1 s, for which u = 6 - 12 t and the integral of u^2 is 12."""
    fields = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": 10, "horizon": 1.0, "running_cost": EFFORT}
    return dd.Problem(BLOCK, **fields | changes)


def test_auto_solves_plain_dynamics_by_collocation():
    solution = dd.solve(block_move())
    assert solution.success, solution.message
    assert (solution.method, solution.scheme) == ("collocation", "hermite_simpson")
    assert solution.options["method_reason"] == "plain dynamics have no discrete step"
    assert solution.cost == pytest.approx(12, rel=1e-9)
    assert solution.inputs_at_knots[:, 0] == pytest.approx(6 - 12 * solution.times, abs=1e-6)
    assert (solution.horizon, solution.time_step) == (1.0, 0.1)
    assert {certificate.verdict for certificate in solution.certificates} == {"agree"}
    assert len(solution.certificates) == 8  # 3 at the guess, 5 at the result


def test_a_plant_as_plain_dynamics_is_solved_as_the_model_is(load):
    model = load("pendulum.urdf", time_step=0.05)
    asked = {"x0": [0, 0], "x_goal": [np.pi, 0], "num_steps": 40, "running_cost": EFFORT}
    of_model = dd.solve(dd.Problem(model, **asked), method="collocation")
    plain = dd.solve(dd.Problem(dd.optimize.plant_dynamics(model), horizon=2.0, **asked))
    assert plain.cost == pytest.approx(of_model.cost, rel=1e-9)
    assert plain.xs == pytest.approx(of_model.xs, abs=1e-6)


def test_the_integrated_motion_is_the_closed_form_from_another_input():
    """Under u = 1 from rest, x = t^2 / 2, whatever the states of the plan are."""
    solution = dd.solve(block_move())
    ones = {"us": np.ones((10, 1)), "us_mid": np.ones((10, 1)), "u_final": np.ones(1)}
    other = dataclasses.replace(solution, **ones)
    assert other.integrated[:, 0] == pytest.approx(other.times**2 / 2, abs=1e-12)
    assert other.integrated[:, 1] == pytest.approx(other.times, abs=1e-12)
    assert other.integration_error > 0.1
    assert other.replays == ()
    assert other.replay is None


def test_a_wrong_derivative_of_the_users_is_named_and_no_success():
    """dv'/du is one percent off. The solver still converges, but with a derivative that is not the function's."""

    def linearize(knots):
        values, rows = BLOCK.linearize(knots)
        return values, rows * np.array([[1, 1, 1], [1, 1, 1.01]])

    wrong = dd.Dynamics(types.SimpleNamespace(values=BLOCK.values, linearize=linearize), 2, 1)
    solution = dd.solve(dataclasses.replace(block_move(), system=wrong), max_iterations=50)
    assert not solution.success
    assert "d d(x1)/dt / d u0" in repr(solution)
    honest = dd.Dynamics(own_derivatives(BLOCK), 2, 1)
    assert dd.solve(dataclasses.replace(block_move(), system=honest)).success


@pytest.mark.parametrize("method", ["shooting", "ilqr"])
def test_discrete_methods_refuse_plain_dynamics(method):
    with pytest.raises(InputError, match=f'problem: expected a model for method="{method}".*, got plain dynamics'):
        dd.solve(block_move(), method=method)


def test_a_problem_of_plain_dynamics_says_that_it_has_no_model():
    with pytest.raises(ModelError, match="plain dynamics and no model"):
        _ = block_move().model


@each_row(
    "changes, options, match",
    [
        ({}, {"solver": "snopt"}, 'solver: expected "ipopt" for scheme="hermite_simpson"'),
        ({}, {"solver": "snopt", "scheme": "drake"}, 'dynamics: expected no value for solver="snopt"'),
        (
            {"system": "model", "horizon": (1, 2)},
            {"solver": "snopt", "scheme": "drake"},
            "horizon: expected no value for",
        ),
        (
            {"system": "model", "horizon": None, "waypoints": {3: [0.5, np.nan]}},
            {"solver": "snopt", "scheme": "drake"},
            "waypoints: expected no value for",
        ),
        (
            {"system": "model", "horizon": None, "constraints": dd.Constraint(lambda x: x[1], upper=9)},
            {"solver": "snopt", "scheme": "drake"},
            "constraints: expected no value for",
        ),
        (
            {"system": "model", "horizon": None},
            {"method": "shooting", "refine": True},
            "refine: expected no value for",
        ),
    ],
)
def test_what_a_solver_would_leave_out_is_refused(load, changes, options, match):
    if changes.get("system") == "model":
        changes = changes | {"system": load("pendulum.urdf", time_step=0.05)}
    problem = dataclasses.replace(block_move(), **changes)
    with pytest.raises(InputError, match=match):
        solve_with(problem, **{"method": "collocation"} | options)


def test_a_run_of_plain_dynamics_has_no_body_to_draw(tmp_path):
    dd.save(dd.solve(block_move()), tmp_path / "run")
    with pytest.raises(ArtifactError, match="plain dynamics: there is no body to draw"):
        scene_of_run(tmp_path / "run")


# ------------------------------------------------------------------------------ refined meshes


def test_a_mesh_on_which_the_plan_does_not_hold_is_refined_by_itself():
    """Meshes are too coarse by their errors, or by an input (9/8 of its bound) or a constraint between the nodes."""
    swing = dd.Dynamics(lambda x, u: [x[1], u[0] - 10 * np.sin(x[0])], nx=2, nu=1)
    up = dd.Problem(swing, x0=[0, 0], x_goal=[np.pi, 0], num_steps=4, horizon=2.0, running_cost=EFFORT)
    slow = block_move(num_steps=4, constraints=dd.Constraint(lambda x: x[1], upper=1.25, name="slow"))
    for problem in (up, slow):
        coarse, found, fine = (dd.solve(problem, options=Options(refine=refine)) for refine in (False, None, True))
        assert coarse.status is dd.Status.CONVERGED_NOT_VERIFIED
        assert found.success, found.message
        rounds = found.options["refinements"]
        assert rounds[0][0] == 4 < len(found.us) == rounds[-1][0]
        assert f"the mesh was refined from 4 to {len(found.us)} intervals" in repr(found)
        if problem is up:
            assert found.cost == pytest.approx(fine.cost, rel=0.07)  # `fine` is refined to 1e-6


def test_a_plan_that_holds_is_not_refined():
    solution = dd.solve(block_move())
    assert solution.success
    assert solution.mesh is None
    assert "refinements" not in solution.options


@each_row("refine", [None, True])
def test_where_a_finer_mesh_fails_the_last_motion_is_kept(monkeypatch, refine):
    """The first mesh is solved, and every finer one is made to fail."""
    swing = dd.Dynamics(lambda x, u: [x[1], u[0] - 10 * np.sin(x[0])], nx=2, nu=1)
    problem = dd.Problem(swing, x0=[0, 0], x_goal=[np.pi, 0], num_steps=4, horizon=2.0, running_cost=EFFORT)
    coarse = dd.solve(problem, options=Options(refine=False), restarts=0)
    honest = Transcription._solve_on

    def fails_later(outcome):
        def solve_on(self, begun, *arguments, **named):
            found = honest(self, begun, *arguments, **named)
            if len(begun[0].mesh) == 5:
                return found
            return dataclasses.replace(found, result=dataclasses.replace(found.result, outcome=outcome))

        return solve_on

    for outcome in (Outcome.INFEASIBLE, Outcome.TIME_LIMIT, Outcome.INTERRUPTED):
        with monkeypatch.context() as patched:
            patched.setattr(Transcription, "_solve_on", fails_later(outcome))
            solution = dd.solve(problem, options=Options(refine=refine), method="collocation", time_limit=60)
        np.testing.assert_array_equal(solution.xs, coarse.xs)
        if outcome is Outcome.INFEASIBLE:
            assert solution.status is dd.Status.CONVERGED_NOT_VERIFIED
            assert "intervals no motion was found" in repr(solution)
            assert "the motion on 4 is kept" in repr(solution)
        else:  # without the limit, as in `verify`, the solve would continue
            assert solution.status is dd.Status[outcome.name]


def test_a_models_mesh_is_refined_and_its_plan_replayed(load, tmp_path):
    model = load("pendulum.urdf", time_step=0.1)
    problem = dd.Problem(
        model,
        x0=[0, 0],
        x_goal=[np.pi, 0],
        num_steps=20,
        running_cost=EFFORT,
        waypoints={5: [-0.1, np.nan]},
        constraints=dd.Constraint(lambda x: x[1], upper=6.0, name="speed"),
    )
    coarse = dd.solve(problem, method="collocation")
    fine = dd.solve(problem, method="collocation", options=Options(refine=True, error_tolerance=1e-8))
    assert len(fine.us) > 20
    assert fine.integration_error <= 1e-8 < coarse.integration_error
    assert fine.times[fine.knots] == pytest.approx(coarse.times, rel=1e-12)
    assert fine.xs[fine.knots[5], 0] == pytest.approx(-0.1, abs=1e-8)
    assert fine.constraint_violation < 1e-7
    assert fine.replays[0].goal_error == pytest.approx(coarse.replays[0].goal_error, abs=0.05)
    record = dd.save(fine, tmp_path / "run")
    verification = dd.verify(tmp_path / "run")
    assert verification.verdict == "undecided"  # only because of the constraint's function
    assert verification.complaints == ()
    assert verification.checked > 700
    assert record.problem["num_steps"] == 20
    again = np.load(tmp_path / "run" / "plan.npz")
    assert np.array_equal(again["mesh"], fine.mesh)
    assert np.array_equal(again["xs"], fine.xs)


def test_a_midpoint_beyond_a_bound_or_constraint_is_measured():
    """The motion goes there and back in one interval. Both knots satisfy the limit, and the midpoint violates it."""
    solution = dd.solve(block_move(num_steps=1, x_goal=None, final_cost=lambda x: 100 * x[0] ** 2, x0=[0, 1.2]))
    middle = solution.transcribed.xs_mid[0, 0]
    assert middle > solution.xs[1, 0] + 0.05
    limit = middle - 0.05
    bounded = dataclasses.replace(solution.problem, bounds=dd.Bounds(x_upper=[limit, np.inf]))
    assert dataclasses.replace(solution, problem=bounded).bound_violation == pytest.approx(0.05, rel=1e-9)
    kept = dataclasses.replace(solution.problem, constraints=dd.Constraint(lambda x: x[0], upper=limit))
    assert dataclasses.replace(solution, problem=kept).constraint_violation == pytest.approx(0.05, rel=1e-9)


# ------------------------------------------------------------------------------ singular slopes and rounding


def test_the_shortest_way_of_a_car_that_begins_along_an_axis_is_found():
    """Dubins' path is two quarter turns of unit radius with 0.2 m between them. At heading 0 cos has no slope."""
    car = dd.Dynamics(lambda x, u: [np.cos(x[2]), np.sin(x[2]), u[0]], 3, 1, u_lower=[-1], u_upper=[1])
    problem = dd.Problem(car, x0=np.zeros(3), x_goal=[0, 2.2, np.pi], num_steps=30, horizon=(0.3, 20), running_cost=1.0)
    solution = dd.solve(problem)
    assert solution.success, solution.message
    assert solution.horizon == pytest.approx(np.pi + 0.2, rel=1e-4)


def test_rounding_of_terms_that_cancel_is_no_other_value():
    """Numbers with derivatives are added one by one, plain ones in pairs. 1000 x 0.07 - 70 rounds differently."""
    kept = np.full((3, 1), 0.7)  # a feasible plan has no larger value of the constraint
    function = Pointwise("sum", lambda x, u: np.sum(np.full(1000, 0.1) * x[0]) - 70, 1, (), kept)
    plain, carried = function.values(kept), function.linearize(kept)[0]
    assert np.all(np.abs(carried - plain) > 1e-9 * np.abs(carried))


def test_other_values_are_seen_beside_an_infinite_slope():
    """The root of x - 1 has an infinite slope at 1. A function with another value under derivatives is refused too."""

    def other(x, u):
        return (x[0] - 1) ** 0.5 + (0.0 if isinstance(x[0], float) else 1e-3)

    with pytest.raises(GradientError, match="with AutoDiffXd and"):
        Pointwise("root", other, 1, (), np.array([[1.0], [1.5], [2.0]]))
