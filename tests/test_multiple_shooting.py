"""Multiple shooting: the same optima as one segment, one where that fails, and bindings that see their own alone."""

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import block
from helpers.problems import DOUBLE_INTEGRATOR, lqr
from helpers.table import each_row
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff

import drake_diff as dd
from drake_diff.exceptions import InputError
from drake_diff.optimize.shooting import SegmentedMotion
from drake_diff.optimize.solution import Status

EFFORT = dd.QuadraticCost(R=[[1.0]])
SOLVERS = ("ipopt", "snopt")


def shoot(problem, **options):
    return dd.solve(problem, method="shooting", **options)


def pendulum(**changes):
    fields = {"x0": [0, 0], "num_steps": 100, "running_cost": EFFORT, "x_goal": [np.pi, 0], **changes}
    return dd.Problem(dd.load_model(MODELS / "pendulum.urdf", time_step=0.02), **fields)


@pytest.mark.parametrize(
    ("solver", "segments"),
    [
        ("ipopt", 7),
        ("snopt", 20),
        pytest.param("ipopt", 2, marks=pytest.mark.slow),
        pytest.param("ipopt", 100, marks=pytest.mark.slow),
    ],
)
def test_a_pendulum_swings_up_with_the_oracles_cost(solver, segments):
    """J = 8.826541704941 by an independent program; 100 segments are direct transcription. The goal is met to 1e-8."""
    solution = shoot(pendulum(), solver=solver, segments=segments)
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(8.826541704941, rel=1e-8)
    assert solution.options["segments"] == segments
    assert solution.defect < 1e-8
    assert len(solution.optimality.state_norms) == 101


@each_row("solver", SOLVERS)
@each_row("segments", [1, 20])
def test_lqr_has_the_riccati_recursions_cost_from_states_that_are_no_rollout(solver, segments):
    """The double integrator; the cost is flat at its minimum, but for the defects, which are met to 1e-8."""
    problem = lqr(*DOUBLE_INTEGRATOR)
    count = problem.num_steps
    random = np.random.default_rng(0)
    guess = random.standard_normal((count + 1, 2)), random.standard_normal((count, 1))
    solution = shoot(problem, solver=solver, segments=segments, initial_guess=guess)
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(12.948481280713864, rel=1e-9)


@pytest.mark.slow
def test_an_acrobot_swings_up_from_rest_where_one_segment_fails():
    problem = dd.Problem(
        dd.load_model(MODELS / "acrobot.xml", time_step=0.05),
        x0=np.zeros(4),
        x_goal=[np.pi, 0, 0, 0],
        num_steps=100,
        running_cost=EFFORT,
    )
    assert not shoot(problem).success
    solution = shoot(problem, solver="ipopt", segments=10)
    assert solution.status in (Status.CONVERGED, Status.CONVERGED_NOT_VERIFIED), solution.message
    assert not solution.plan_checks.failing  # but open loop at half the step it would fall over
    assert solution.goal_error < 1e-7
    assert solution.defect < 1e-7


@each_row("solver", SOLVERS)
@each_row("segments", [1, 4])
def test_a_mass_is_chosen_together_with_the_inputs(solver, segments):
    """The effort 12 m^2 / (1 - 1 / N^2) is least for the least mass allowed, 0.5 kg, in every segment."""
    problem = dd.Problem(
        block(time_step=0.05),
        x0=[0, 0],
        x_goal=[1, 0],
        num_steps=20,
        running_cost=EFFORT,
        optimize=("controls", "parameters"),
        parameters=["block_0.mass"],
        parameter_bounds={"block_0.mass": (0.5, 2)},
    )
    solution = shoot(problem, solver=solver, segments=segments)
    assert solution.success, solution.message
    assert solution.parameters == pytest.approx([0.5], abs=1e-7)
    assert solution.cost == pytest.approx(12 * 0.25 / (1 - 1 / 400), rel=1e-6)


def everything(**changes):
    """30 steps whose initial speed, inputs and damping move; limits of every kind."""
    return pendulum(
        num_steps=30,
        final_cost=lambda x: np.cos(x[0]) + x[1] ** 2,
        optimize=("controls", "initial_state", "parameters"),
        initial_state_mask=[False, True],
        parameters=["hinge.damping"],
        bounds=dd.Bounds(x_upper=[9, 4]),
        waypoints={10: [0.3, np.nan], 14: [np.nan, 0.2]},
        constraints=[
            dd.Constraint(lambda x, u: u[0] * x[1], upper=5),
            dd.Constraint(lambda x: np.sin(x[0]), lower=-0.9, upper=0.9, knots=[0, 9, 10, -1]),
        ],
        **changes,
    )


@pytest.mark.parametrize("segments", [1, 3, 30])
def test_every_bindings_gradient_is_its_difference(segments):
    """Differences of 1e-6 leave 1e-8 or so; the states between segments do not fit, as in the midst of a search."""
    problem = everything()
    motion, random = SegmentedMotion(problem, segments), np.random.default_rng(0)
    program = motion.program()
    point = motion.pack(0.3 * random.standard_normal((31, 2)), 0.3 * random.standard_normal((30, 1)))
    for binding in program.GetAllCosts() + program.generic_constraints():
        f, z = binding.evaluator(), point[program.FindDecisionVariableIndices(binding.variables())]
        gradient = ExtractGradient(f.Eval(InitializeAutoDiff(z).ravel()))
        differences = [(f.Eval(z + d) - f.Eval(z - d)) / 2e-6 for d in 1e-6 * np.eye(len(z))]
        np.testing.assert_allclose(gradient, np.array(differences).T, rtol=1e-6, atol=1e-6)


def test_bindings_see_one_segments_variables_and_the_state_after_it():
    """30 steps in 3 segments, 33 variables and 2 states of 2: [speed; 10 inputs; damping], [2 states; ...]."""
    problem = everything()
    motion = SegmentedMotion(problem, 3)
    program = motion.program()
    assert program.num_vars() == 1 + 30 + 1 + 2 * 2
    sizes = {}
    for binding in program.generic_constraints():
        name = binding.evaluator().get_description()
        sizes.setdefault(name, []).append((binding.evaluator().num_constraints(), len(binding.variables())))
    assert sizes["defect"] == [(2, 12 + 2), (2, 13 + 2)]
    # v <= 4 at knots 1 ... 9, then 11 ... 19 with q <= 9 too, then 21 ... 30 and the goal.
    assert [n for _, n in sizes["states"]] == [12, 13, 13]
    assert [m for m, _ in sizes["states"]] == [18, 18, 20]
    # a power at each of 10 steps, and the height at 0 and 9, at 10, and at 30.
    assert sizes["constraints"] == [(12, 12), (11, 13), (11, 13)]
    assert [len(binding.variables()) for binding in program.GetAllCosts()] == [12, 13, 13]
    ends = [set(map(str, b.variables())) for b in program.GetAllCosts()]
    assert ends[0] & ends[2] == {"z(31)"}  # the damping alone is shared


def test_bounds_and_a_waypoint_hold_where_segments_meet():
    """Knot 10 begins the second segment: its angle is given, and no binding's rollout is needed for it."""
    motion = SegmentedMotion(everything(), 3)
    lower, upper = motion._bounds()
    at = motion.start_of(1)
    assert lower[at].tolist() == [0.3, -np.inf]
    assert upper[at].tolist() == [0.3, 4]


def test_all_of_it_together_is_solved_alike_with_one_segment_and_with_three():
    one, three = (shoot(everything(x_goal=None), solver="ipopt", segments=n) for n in (1, 3))
    assert one.success, one.message
    assert three.success, three.message
    assert three.cost == pytest.approx(one.cost, rel=1e-6)
    assert three.xs[10, 0] == pytest.approx(0.3, abs=1e-6)


def test_states_that_are_not_joined_are_told_by_the_defect():
    solution = shoot(pendulum(), solver="ipopt", segments=10, max_iterations=2)
    assert solution.status is Status.ITERATION_LIMIT
    assert solution.defect > 1e-3
    assert np.flatnonzero(solution.defects > 1e-9).tolist() == [9, 19, 29, 39, 49, 59, 69, 79, 89]


def test_a_goal_that_nothing_moves_is_found_before_it_runs():
    problem = dd.Problem(
        block(blocks=2, actuated=1), x0=np.zeros(4), num_steps=6, running_cost=EFFORT, x_goal=[np.nan, 1, np.nan, 0]
    )
    solution = shoot(problem, segments=3)
    assert solution.status is Status.NO_GRADIENT
    assert "whose goal is not reached" in solution.message


@each_row(
    "changes, options, words",
    [
        ({}, {"method": "ilqr", "segments": 2}, 'segments: expected 1 for method="ilqr", got 2'),
        ({}, {"segments": 101}, "at most num_steps, 100, got 101"),
        ({}, {"segments": 0}, "segments"),
        ({}, {"segments": 2.5}, "segments"),
        (
            {"trajectory_cost": lambda xs, us: xs[3, 0]},
            {"segments": 2},
            "trajectory_cost, which is of the whole motion",
        ),
    ],
)
def test_segments_that_cannot_be_are_refused(changes, options, words):
    with pytest.raises(InputError, match=words):
        dd.solve(pendulum(**changes), **{"method": "shooting", **options})
