"""Tests of the solvers against known optima, and of the status, which is measured."""

import dataclasses
import math

import numpy as np
import pytest
from helpers.models import Plant, contact_properties
from helpers.plants import pd_pendulum
from helpers.solving import solve_with
from helpers.table import each_row, slow_after
from pydrake.geometry import Sphere

import drake_diff as dd
from drake_diff.derivatives.step import derivatives_along
from drake_diff.exceptions import GradientError, InputError, ModelError, SimulationError
from drake_diff.optimize import Options
from drake_diff.optimize.program import NlpResult, Outcome
from drake_diff.optimize.run import Run
from drake_diff.optimize.solution import Status
from drake_diff.optimize.verification import near

pytestmark = pytest.mark.solve

EFFORT = dd.QuadraticCost(R=[[1.0]])


def swing_up(load, count, cost=EFFORT, **changes):
    model = load("cart_pole.urdf", time_step=2 / count)
    return dd.Problem(model, x0=np.zeros(4), x_goal=[1, np.pi, 0, 0], num_steps=count, running_cost=cost, **changes)


@pytest.mark.slow
def test_snopt_finds_the_same_swing_up(load):
    solution = dd.solve(swing_up(load, 20), method="collocation", options=Options(scheme="drake", solver="snopt"))
    assert solution.transcribed.quadrature == pytest.approx(62.58516350539, rel=1e-8)


def pendulum(load, **problem):
    fields = {"x0": [0, 0], "num_steps": 100, **problem}
    return dd.Problem(load("pendulum.urdf", time_step=0.02), **fields)


QUADRATIC = dd.QuadraticCost(R=[[1.0]])
SOFT = {
    "running_cost": dd.QuadraticCost(Q=np.diag([0.1, 0.01]), R=[[0.1]], x_ref=[np.pi, 0]),
    "final_cost": dd.QuadraticCost(Q=np.diag([50, 5]), x_ref=[np.pi, 0]),
}


@pytest.mark.parametrize("outcome", [Outcome.INACCURATE, Outcome.INFEASIBLE])
def test_where_the_optimum_in_steps_is_far_a_motion_in_them_near_the_collocated_one_will_do(load, monkeypatch, outcome):
    """The motion need not be the nearest one. A motion that violates the dynamics is refused, however near it is."""
    monkeypatch.setattr("drake_diff.optimize.solve.REFINING", 1)
    shoot = Run.shoot

    def ended(run, *args, **more):
        judge = run._judge
        object.__setattr__(
            run, "_judge", lambda draft, result: judge(draft, dataclasses.replace(result, outcome=outcome))
        )
        return shoot(run, *args, **more)

    monkeypatch.setattr(Run, "shoot", ended)
    solution = dd.solve(swing_up(load, 100))
    assert solution.success == (outcome is Outcome.INACCURATE), solution.message
    if solution.success:
        assert solution.plant == "steps"
        assert "not an optimum in these steps" in " ".join(solution.notes)
        replayed = dd.rollout(solution.problem.model, solution.xs[0], solution.us).xs
        assert np.max(np.abs(replayed - solution.xs)) < 1e-6  # required of the README's cart-pole


@each_row("factor, verified", [(1.2, True), (1.3, False)])
def test_a_motion_in_steps_near_a_plan_is_not_verified_at_a_much_higher_cost(load, factor, verified):
    problem = dd.Problem(
        load("pendulum.urdf", time_step=0.01), x0=[0, 0], x_goal=[0.5, 0], num_steps=40, running_cost=QUADRATIC
    )
    plan, motion = (dd.solve(problem, method=method) for method in ("collocation", "shooting"))
    assert near(plan, motion) is motion
    dearer = dataclasses.replace(problem, running_cost=dd.QuadraticCost(R=factor * QUADRATIC.R))
    found = near(plan, dataclasses.replace(motion, problem=dearer))
    assert found.success == verified
    assert (f"exceeds the collocated plan's cost {plan.cost:.4g} by over 25%" in found.message) != verified


@pytest.mark.parametrize("method", ["shooting", "ilqr"])
def test_pendulum_with_a_soft_goal(load, method):
    """J* = 1.88951695347 by a solve of the same steps without Drake."""
    solution = dd.solve(pendulum(load, **SOFT), method=method, options=Options(tolerance=1e-10))
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(1.88951695347, rel=1e-10)
    assert solution.us[:4, 0] == pytest.approx([3.31679908, 3.64914248, 3.96280849, 4.25531903], abs=1e-5)


def test_active_input_bounds_give_the_same_optimum_by_ilqr_and_by_shooting(load):
    problem = pendulum(load, **SOFT, bounds=dd.Bounds(u_lower=[-4.0], u_upper=[4.0]))
    a, b = (dd.solve(problem, method=m) for m in ("ilqr", "shooting"))
    assert a.success, a.message
    assert b.success, b.message
    assert np.abs(a.us).max() == 4.0
    assert a.cost == pytest.approx(b.cost, rel=1e-8)


def test_a_coarse_collocation_is_not_called_converged(load):
    solution = dd.solve(swing_up(load, 8), method="collocation", options=Options(refine=False))
    assert not solution.success
    assert "an accurate integration from knot" in repr(solution)


@pytest.mark.parametrize("method", ["collocation", "shooting"])
def test_limits_end_a_solve_and_are_named(load, method):
    problem = swing_up(load, 40)
    short = dd.solve(problem, method=method, max_iterations=2)
    assert short.status is Status.ITERATION_LIMIT
    late = dd.solve(problem, method=method, time_limit=0.001)
    assert late.status is Status.TIME_LIMIT
    assert np.all(np.isfinite(late.xs))


def test_a_solver_that_lies_is_not_believed(load, monkeypatch):
    def liar(problem, xs, us, **options):
        return NlpResult(us.ravel(), Outcome.SOLVED, "all is well", ()), xs, np.zeros_like(us)

    monkeypatch.setattr("drake_diff.optimize.run.solve_shooting", liar)
    solution = dd.solve(swing_up(load, 20), method="shooting")
    assert solution.status is Status.CONVERGED_NOT_VERIFIED
    assert any(c.what == "defect" for c in solution.plan_checks.failing)


def test_a_refused_derivative_ends_as_no_gradient(load, monkeypatch):
    monkeypatch.setattr("drake_diff.derivatives.step.MAGNITUDE_BOUND", 1e-3)
    solution = dd.solve(pendulum(load, running_cost=EFFORT, x_goal=[np.pi, 0]), method="shooting")
    assert solution.status is Status.NO_GRADIENT
    assert "expected a finite number of at most" in repr(solution)


@pytest.mark.parametrize(
    ("method", "solver"),
    slow_after(2, [("collocation", "ipopt"), ("shooting", None), ("collocation", "snopt")]),
)
def test_the_solvers_own_table_is_kept(load, method, solver):
    scheme = "drake" if (method, solver) == ("collocation", "snopt") else None
    rows = dd.solve(swing_up(load, 20), method=method, options=Options(solver=solver, scheme=scheme)).iterations
    assert len(rows) > 5
    assert all(math.isfinite(row.objective) and math.isfinite(row.primal_infeasibility) for row in rows)
    assert [row.iteration for row in rows] == sorted({row.iteration for row in rows})
    assert rows[-1].primal_infeasibility < 1e-5


def test_progress_is_told_while_it_runs(load, monkeypatch):
    monkeypatch.setattr("drake_diff.optimize.program.REPORT_PERIOD", 0.01)
    lines = []
    solution = dd.solve(swing_up(load, 100), method="shooting", progress=lines.append, max_iterations=15)
    assert solution.wall_time > 0.02
    assert len(lines) > 1
    assert "cost" in lines[0]


def test_the_same_seed_gives_the_same_bits(load):
    a, b = (dd.solve(swing_up(load, 20), method="shooting", seed=3) for _ in range(2))
    assert a.xs.tobytes() == b.xs.tobytes()
    assert repr(a.iterations) == repr(b.iterations)  # as text, since a blank cell is NaN, which is not equal to itself


def test_auto_chooses_and_says_why(load):
    chain = dd.solve(swing_up(load, 40)).options["chain"]
    steps = "the collocated plan in the model's own steps"
    assert [(link["method"], link["reason"]) for link in chain][:2] == [
        ("collocation", "the model is smooth"),
        ("shooting", steps),
    ]
    model = load("sphere_on_ground.sdf")
    free = np.zeros(13, dtype=bool)
    free[10] = True
    for horizon in (None, 0.05):  # collocation does not support this problem, with or without a horizon
        problem = dd.Problem(
            model,
            x0=model.default_state + 0.3 * np.eye(13)[6],
            num_steps=5,
            horizon=horizon,
            final_cost=lambda x: (x[4] - 1) ** 2,
            optimize="initial_state",
            initial_state_mask=free,
        )
        assert dd.solve(problem).method == "shooting"


def test_pd_control_is_left_to_the_discrete_methods():
    problem = dd.Problem(pd_pendulum(), x0=[0.5, 0], num_steps=20, running_cost=EFFORT, x_goal=[0.2, 0])
    with pytest.raises(ModelError, match="use method='shooting'"):
        dd.solve(problem, method="collocation")
    solution = dd.solve(problem)
    assert solution.method == "ilqr"
    assert solution.success, solution.message


def test_collocation_through_a_ball_between_two_knots_is_not_verified():
    """Move from 1 m before a fixed ball to 1 m behind it in three intervals, with knots at least 0.4 m away."""
    plant = Plant(0.25)
    plant.ball("ball", 1.0, 0.1, contact_properties(1e4), "x")
    plant.shape(plant.plant.world_body(), Sphere(0.1), contact_properties(1e4))
    plant.plant.AddJointActuator("push", plant.plant.GetJointByName("ball_x"))
    problem = dd.Problem(plant.model(), x0=[-1, 0], num_steps=3, running_cost=EFFORT, x_goal=[1, 0])
    solution = dd.solve(problem, method="collocation")
    assert np.abs(solution.xs[:, 0]).min() > 0.4
    assert solution.status is Status.CONVERGED_NOT_VERIFIED
    assert "geometries overlap by 0.2 m at 0.375 s" in repr(solution)
    aside = dd.solve(dataclasses.replace(problem, x_goal=[-0.3, 0]), method="collocation")
    assert "geometries overlap" not in repr(aside)


@each_row(
    "options, words",
    [
        ({"method": "magic"}, "method: expected one of auto, collocation, ilqr, shooting, got 'magic'"),
        ({"solver": "magic"}, "solver: expected one of ipopt, snopt, got 'magic'"),
        ({"method": "ilqr", "solver": "snopt"}, "solver: expected (no value|another one) for method"),
        ({"method": "ilqr", "mesh_rounds": 2}, "mesh_rounds: expected no value for method"),
        ({"method": "collocation", "sweeps": 2}, "sweeps: expected no value for .* of method=.shooting"),
        ({"method": "shooting", "guess_iterations": 2}, "guess_iterations: .* of method=.auto"),
        ({"max_iterations": 0}, "max_iterations"),
        ({"time_limit": -1.0}, "time_limit"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"initial_guess": "good"}, r"initial_guess: expected None, \(xs, us\), .* or a Solution, got str"),
        ({"initial_guess": (np.zeros((3, 4)), np.zeros((20, 1)))}, r"initial_guess xs: expected shape \(21, 4\)"),
        ({"initial_guess": (np.zeros((21, 4)), np.full((20, 1), np.nan))}, "initial_guess us"),
        ({"method": None}, "method: expected one of .*, got None"),
        ({"max_iterations": 2.5}, "max_iterations: expected a whole number of at least 1, got 2.5"),
        ({"time_limit": math.nan}, r"time_limit \[s\]: expected a finite number above 0, got nan"),
        ({"tolerance": math.inf}, "tolerance: expected a finite number above 0, got inf"),
        ({"initial_guess": np.zeros((2, 4))}, r"initial_guess: expected None, .* got ndarray"),
        ({"method": "shooting", "seed": -1}, "seed: expected .*, got -1"),
        ({"method": "shooting", "seed": "lucky"}, "seed: expected .*, got 'lucky'"),
        ({"progress": 3}, "progress: expected .*, got"),
    ],
)
def test_bad_options_are_named_before_anything_runs(load, options, words):
    started = []
    with pytest.raises(InputError, match=words):
        solve_with(swing_up(load, 20), on_start=lambda: started.append(1), **options)
    assert not started


def test_only_a_problem_can_be_solved():
    with pytest.raises(InputError, match="problem: expected a Problem, a PhasedProblem or a PathTiming, got NoneType"):
        dd.solve(None)


def test_collocation_needs_controls_to_optimize(load):
    problem = swing_up(load, 20, optimize="initial_state")
    with pytest.raises(InputError, match='"controls" for method="collocation"'):
        dd.solve(problem, method="collocation")


def test_auto_goes_on_from_what_a_failed_attempt_left(load, monkeypatch):
    """Collocation is made to fail once. iLQR then finds a motion, from which collocation starts."""
    honest = Run.collocate
    calls = []

    def fail_once(self, guess):
        calls.append(guess)
        solution = honest(self, guess)
        return dataclasses.replace(solution, status=Status.INFEASIBLE) if len(calls) == 1 else solution

    monkeypatch.setattr(Run, "collocate", fail_once)
    problem = pendulum(load, running_cost=EFFORT, x_goal=[np.pi, 0])
    solution = dd.solve(problem, options=Options(other_guesses=0), restarts=0)
    assert solution.success, solution.message
    assert [link["method"] for link in solution.options["chain"]] == ["collocation", "shooting", "ilqr"]
    assert solution.options["chain"][2]["reason"] == "collocation was not verified: a guess for it"
    assert solution.options["chain"][0]["ended"] == "infeasible"


def test_more_equations_than_inputs_print_nothing(load, capfd):
    waypoints = {k: [0.1 * k, 0.2] for k in range(1, 10)}
    problem = dd.Problem(load("pendulum.urdf"), x0=[0, 0], x_goal=[1, 0], num_steps=10, waypoints=waypoints)
    assert dd.solve(problem, method="shooting").status is Status.INFEASIBLE
    assert capfd.readouterr() == ("", "")


def test_the_callback_sees_every_iteration_and_may_end_the_solve(load):
    class Enough(Exception):  # noqa: N818
        pass

    def stop_at_three(row):
        if row.iteration == 3:
            raise Enough

    for method in ("ilqr", "collocation"):
        rows = []
        solution = dd.solve(pendulum(load, running_cost=EFFORT, x_goal=[np.pi, 0]), method=method, callback=rows.append)
        assert [row.iteration for row in rows] == list(range(rows[0].iteration, len(rows) + rows[0].iteration))
        assert rows[-1].objective == pytest.approx(solution.cost, rel=1e-6)
        with pytest.raises(Enough):
            dd.solve(pendulum(load, running_cost=EFFORT, x_goal=[np.pi, 0]), method=method, callback=stop_at_three)
    with pytest.raises(InputError, match="callback"):
        dd.solve(pendulum(load, running_cost=EFFORT, x_goal=[np.pi, 0]), callback=3)


@pytest.mark.slow
@each_row("error, status", [(SimulationError, Status.DIVERGED), (GradientError, Status.NO_GRADIENT)])
def test_a_step_refused_in_the_middle_of_a_solve_is_named(load, monkeypatch, error, status):
    original, calls = derivatives_along, []

    def refusing(*args, **options):
        calls.append(1)
        if len(calls) > 3:
            raise error("this far and no further")
        return original(*args, **options)

    monkeypatch.setattr("drake_diff.motion.intervals.derivatives_along", refusing)
    solution = dd.solve(swing_up(load, 20), method="shooting")
    assert solution.status is status
    assert "this far and no further" in repr(solution)
    assert "Traceback" not in solution.message
    assert np.all(np.isfinite(solution.xs))
