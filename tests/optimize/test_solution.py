"""Tests of a Solution's measures: any change of the motion increases one, and missing parts make one infinite."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import block
from helpers.table import each_row

import drake_diff as dd
from drake_diff.optimize import Options

METHODS = ("collocation", "shooting", "ilqr")
N, H = 10, 0.1
MOVED = 1e-3


@functools.cache
def solved(method):
    """Solve for a block that moves by 1 m within bounds that are not active."""
    problem = dd.Problem(
        block(),
        x0=[0, 0],
        num_steps=N,
        x_goal=[1, 0],
        running_cost=dd.QuadraticCost(R=[[1.0]]),
        bounds=dd.Bounds([-0.5, -3], [1.5, 3], [-20], [20]),
    )
    solution = dd.solve(problem, method=method)
    assert solution.success, solution.message
    return solution


def moved(solution, name, index, by):
    """Return `solution` with one entry of one of its arrays changed."""
    values = np.array(getattr(solution, name))
    values[index] += by
    return dataclasses.replace(solution, **{name: values})


@pytest.mark.parametrize("method", METHODS)
def test_an_untouched_solution_measures_as_exact(method):
    s = solved(method)
    assert s.defect < 1e-9  # a linear plant: rounding, and the solver's 1e-8 on collocation's defects times h
    assert s.initial_state_error < 1e-9
    assert s.bound_violation == 0.0


@each_row("method", METHODS)
@each_row("coordinate", [0, 1])
@each_row("knot", [0, 1, N // 2, N - 1, N])
def test_one_moved_knot_shows_in_its_own_intervals(method, coordinate, knot):
    """Both ends of an interval are measured, so that a moved position or velocity shows in each of its intervals."""
    s = moved(solved(method), "xs", (knot, coordinate), MOVED)
    touched = [k for k in (knot - 1, knot) if 0 <= k < N]
    assert s.defect > MOVED / 2
    assert int(np.argmax(s.defects)) in touched
    assert np.delete(s.defects, touched).max() < 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_a_moved_first_state_shows_in_the_initial_state_error(method):
    assert moved(solved(method), "xs", (0, 1), MOVED).initial_state_error == pytest.approx(MOVED, rel=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_a_motion_shifted_as_a_whole_shows_at_its_start(method):
    """All intervals of the motion are correct. Only its start is wrong."""
    s = solved(method)
    shifted = dataclasses.replace(s, xs=s.xs + np.array([MOVED, 0]))
    assert shifted.defect < 1e-9
    assert shifted.initial_state_error == pytest.approx(MOVED, rel=1e-6)


@each_row("method", METHODS)
@each_row("index", [0, N // 2, N - 1])
def test_one_moved_input_shows_in_the_defect(method, index):
    """An input over a step moves the velocity of 1 kg by h du, and one at a knot by a sixth of it (Simpson's rule)."""
    assert moved(solved(method), "us", index, 0.01).defect >= 0.99 * H * 0.01 / 6


def test_collocations_last_input_shows_in_the_defect():
    assert moved(solved("collocation"), "u_final", 0, 0.01).defect >= 0.99 * H * 0.01 / 6


@pytest.mark.parametrize("method", ["collocation", "shooting"])
def test_a_missed_goal_is_measured_in_its_own_unit(method):
    assert moved(solved(method), "xs", (N, 0), MOVED).goal_error == pytest.approx(MOVED, rel=1e-4)


@each_row("method", ["collocation", "shooting"])
@each_row(
    "name, index, to, violation",
    [
        ("xs", (3, 0), 1.75, 0.25),
        ("xs", (3, 1), -3.5, 0.5),
        ("xs", (N, 0), -0.6, 0.1),
        ("us", (0, 0), 21.0, 1.0),
        ("us", (N - 1, 0), -22.0, 2.0),
    ],
)
def test_a_broken_bound_is_measured_by_its_excess(method, name, index, to, violation):
    s = solved(method)
    broken = moved(s, name, index, to - getattr(s, name)[index])
    assert broken.bound_violation == pytest.approx(violation, rel=1e-12)


def test_collocations_last_input_is_held_to_its_bound():
    s = solved("collocation")
    assert moved(s, "u_final", 0, 100 - s.u_final[0]).bound_violation == pytest.approx(80, rel=1e-12)


@each_row("method", METHODS)
@each_row("order", [1, -1])
def test_the_worst_of_several_constraints_counts(method, order):
    """One constraint holds and one has a known excess, in either order. The violated one must be measured in both."""
    s = solved(method)
    kept = dd.Constraint(lambda x: x[0], upper=2.0, name="kept")
    broken = dd.Constraint(lambda x: x[0], upper=float(s.xs[N, 0]) - 0.25, name="broken")
    asked = dataclasses.replace(s.problem, constraints=(kept, broken)[::order])
    measured = dataclasses.replace(s, problem=asked)
    assert measured.constraint_violation == pytest.approx(0.25, rel=1e-9)
    assert measured.constraint_excess["broken"] == (pytest.approx(0.25, rel=1e-9), N)
    assert measured.constraint_excess["kept"][0] == 0


@pytest.mark.parametrize("method", METHODS)
def test_the_cost_is_computed_from_the_motion(method):
    """Inputs twice as large cost four times as much. The final cost of the unchanged states is the same."""
    s = solved(method)
    final = 0.0 if s.problem.final_cost is None else s.problem.final_cost(s.xs[-1])
    inputs = {name: getattr(s, name) for name in ("us", "u_final", "us_mid")}
    fields = {name: 2 * values for name, values in inputs.items() if values is not None}
    assert dataclasses.replace(s, **fields).cost == pytest.approx(4 * (s.cost - final) + final, rel=1e-12)


@each_row("bad", [math.nan, math.inf, -math.inf])
@each_row("method", METHODS)
def test_one_entry_of_a_state_that_is_no_number_makes_the_motion_infinitely_wrong(method, bad):
    s = moved(solved(method), "xs", (4, 1), bad)
    assert s.defect == s.bound_violation == s.integration_error == math.inf
    assert s.half_step_error == math.inf


@each_row("method", METHODS)
@each_row("steps", [0, 1, N - 1])
def test_a_motion_that_ends_too_early_is_infinitely_wrong(method, steps):
    """All intervals of the motion may be correct, but some are missing."""
    s = solved(method)
    assert dataclasses.replace(s, xs=s.xs[: steps + 1], us=s.us[:steps]).defect == math.inf


def test_the_replay_of_a_collocated_solution_is_the_discrete_plants():
    """Mean inputs on 1 kg by symplectic Euler give v_k+1 = v_k + h (u_k + u_k+1) / 2, x_k+1 = x_k + h v_k+1."""
    s = solved("collocation")
    v = np.concatenate([[0], H * np.cumsum((s.inputs_at_knots[:-1, 0] + s.inputs_at_knots[1:, 0]) / 2)])
    x = np.concatenate([[0], H * np.cumsum(v[1:])])
    assert s.replay.xs == pytest.approx(np.column_stack([x, v]), abs=1e-12)
    assert abs(s.replay.xs[-1, 0] - 1) > MOVED  # another integrator does not end where the cubic ends


def test_the_integration_error_of_a_cubic_motion_is_rounding():
    assert solved("collocation").integration_error < 1e-9


@pytest.mark.solve
def test_the_integration_error_falls_by_the_fourth_order_of_hermite_simpson():
    """The error per interval is O(h^5). Halving h divides it by about 32 on a smooth motion, and at least by 16."""
    errors = []
    for count in (20, 40):
        model = dd.load_model(MODELS / "cart_pole.urdf", time_step=2 / count)
        problem = dd.Problem(
            model, x0=np.zeros(4), x_goal=[1, np.pi, 0, 0], num_steps=count, running_cost=dd.QuadraticCost(R=[[1.0]])
        )
        errors.append(dd.solve(problem, method="collocation", options=Options(refine=False)).integration_error)
    assert 0 < errors[1] < errors[0] / 16


def test_only_converged_is_success():
    s = solved("shooting")
    assert [status for status in dd.Status if dataclasses.replace(s, status=status).success] == [dd.Status.CONVERGED]
