"""A Solution measures itself: corrupt a motion in any one place and a measure grows; what is missing is infinite."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.plants import block
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError
from drake_diff.optimize.checks import check
from drake_diff.optimize.messages import controls
from drake_diff.optimize.replay import deciding, judged_replay
from drake_diff.runs import measure

METHODS = ("collocation", "shooting", "ilqr")
OPEN, CLOSED = "open loop", "TVLQR"
N, H = 10, 0.1
MOVED = 1e-3


@functools.cache
def solved(method):
    """A block moved by 1 m within bounds that are not active."""
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
    """`solution` with one entry of one of its arrays changed."""
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
    """A first position can hide from no interval here, nor can a velocity: both ends of an interval are measured."""
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
    """No interval of it is wrong: only where it starts."""
    s = solved(method)
    shifted = dataclasses.replace(s, xs=s.xs + np.array([MOVED, 0]))
    assert shifted.defect < 1e-9
    assert shifted.initial_state_error == pytest.approx(MOVED, rel=1e-6)


@each_row("method", METHODS)
@each_row("index", [0, N // 2, N - 1])
def test_one_moved_input_shows_in_the_defect(method, index):
    """A held input moves the velocity of 1 kg by h du; one at a knot a sixth of that, by Simpson's rule."""
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


@pytest.mark.parametrize("method", ["collocation", "shooting"])
def test_the_worst_of_several_broken_bounds_counts(method):
    """A position 0.25 m and an input 1 N beyond: the larger number, whichever stands first."""
    s = solved(method)
    broken = moved(moved(s, "xs", (3, 0), 1.75 - s.xs[3, 0]), "us", (0, 0), 21.0 - s.us[0, 0])
    assert sorted(excess for excess, _ in broken.bound_excess.values()) == pytest.approx([0.25, 1.0], rel=1e-12)
    assert broken.bound_violation == pytest.approx(1.0, rel=1e-12)


def test_collocations_last_input_is_held_to_its_bound():
    s = solved("collocation")
    assert moved(s, "u_final", 0, 100 - s.u_final[0]).bound_violation == pytest.approx(80, rel=1e-12)


@each_row("method", METHODS)
@each_row("order", [1, -1])
def test_the_worst_of_several_constraints_counts(method, order):
    """One holds and one is broken by a known excess, in either order: the other way round both would seem to hold."""
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
    """Inputs twice as large cost four times as much; the final cost of a motion left as it is stays."""
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


@each_row("bad", [math.nan, math.inf])
@each_row("method", METHODS)
def test_one_input_that_is_no_number_makes_the_motion_infinitely_wrong(method, bad):
    s = moved(solved(method), "us", (4, 0), bad)
    assert s.defect == s.bound_violation == s.cost == s.integration_error == math.inf
    assert s.replay is None


@pytest.mark.parametrize("method", METHODS)
def test_ends_that_are_no_numbers_are_infinitely_wrong(method):
    s = solved(method)
    assert moved(s, "xs", (0, 0), math.nan).initial_state_error == math.inf
    if s.problem.x_goal is not None:
        assert moved(s, "xs", (N, 0), math.nan).goal_error == math.inf


@each_row("method", METHODS)
@each_row("steps", [0, 1, N - 1])
def test_a_motion_that_ends_too_early_is_infinitely_wrong(method, steps):
    """Each of its intervals may be right: those that are missing are not."""
    s = solved(method)
    assert dataclasses.replace(s, xs=s.xs[: steps + 1], us=s.us[:steps]).defect == math.inf


@pytest.mark.parametrize("method", ["shooting", "ilqr"])
def test_the_replay_of_a_discrete_solution_is_the_solution(method):
    s = solved(method)
    assert np.array_equal(s.replay.xs, s.xs)


def test_the_replay_of_a_collocated_solution_is_the_discrete_plants():
    """Held mean inputs on 1 kg by symplectic Euler: v_k+1 = v_k + h (u_k + u_k+1) / 2, x_k+1 = x_k + h v_k+1."""
    s = solved("collocation")
    v = np.concatenate([[0], H * np.cumsum((s.inputs_at_knots[:-1, 0] + s.inputs_at_knots[1:, 0]) / 2)])
    x = np.concatenate([[0], H * np.cumsum(v[1:])])
    assert s.replay.xs == pytest.approx(np.column_stack([x, v]), abs=1e-12)
    assert abs(s.replay.xs[-1, 0] - 1) > MOVED  # another integrator: it does not land where the cubic does


def test_the_integration_error_of_a_cubic_motion_is_rounding():
    assert solved("collocation").integration_error < 1e-9


def test_the_integration_error_falls_by_the_fourth_order_of_hermite_simpson():
    """Per interval it is O(h^5): halving h divides it by about 32 on a smooth motion, by 16 at the very least."""
    errors = []
    for count in (20, 40):
        model = dd.load_model(MODELS / "cart_pole.urdf", time_step=2 / count)
        problem = dd.Problem(
            model, x0=np.zeros(4), x_goal=[1, np.pi, 0, 0], num_steps=count, running_cost=dd.QuadraticCost(R=[[1.0]])
        )
        errors.append(dd.solve(problem, method="collocation", refine=False).integration_error)
    assert 0 < errors[1] < errors[0] / 16


@pytest.mark.parametrize("method", METHODS)
def test_a_solutions_arrays_are_read_only(method):
    with pytest.raises(ValueError, match="read-only"):
        solved(method).xs[0, 0] = 1.0


def test_only_converged_is_success():
    s = solved("shooting")
    assert [status for status in dd.Status if dataclasses.replace(s, status=status).success] == [dd.Status.CONVERGED]


@pytest.mark.parametrize("method", METHODS)
def test_another_status_leaves_the_measures_as_they_were_taken(method):
    """The status is told of the motion: nothing of the motion is measured again."""
    s = dataclasses.replace(solved(method))
    measured = {name: getattr(s, name) for name in ("cost", "defects", "plan", "replay", "replays", "transcribed")}
    told = s.told(status=dd.Status.INFEASIBLE, message="m", options={"chain": []}, iterations=(), solver_message="w")
    assert (told.status, told.message, told.options) == (dd.Status.INFEASIBLE, "m", {"chain": []})
    assert (told.iterations, told.solver_message) == ((), "w")
    assert all(getattr(told, name) is value for name, value in measured.items())
    assert s.status is dd.Status.CONVERGED


@each_row("name", ["xs", "us", "problem", "certificates", "cost"])
def test_what_a_measure_may_depend_on_is_not_told(name):
    with pytest.raises(InputError, match=f"expected one of cross_checks, iterations, .*, got '{name}'"):
        solved("ilqr").told(**{name: None})


@pytest.mark.parametrize("method", METHODS)
def test_what_the_verdict_measured_is_not_measured_again(method):
    assert {"cost", "defects", "plan", "replays"} <= vars(solved.__wrapped__(method)).keys()


def of_replays(good):
    """What is told of a discrete plan of which the replays in `good` (by control) hold."""
    s = solved("ilqr")
    found = []
    for variant in ("in steps of 0.1 s", "in steps of 0.05 s"):
        for control in (OPEN, CLOSED):
            why = f"x ends far off {variant} by {control}"
            checks = () if control in good else (check("motion", why, math.inf, 0.0),)
            found.append(dataclasses.replace(s.replays[0], variant=variant, control=control, checks=checks))
    return controls(found, deciding(s.plan, found), finest=False), judged_replay(s.plan, found)


def test_a_plan_that_holds_under_every_control_says_so():
    told, shown = of_replays({OPEN, CLOSED})
    assert told == "on the plant open loop and under TVLQR"
    assert shown.control == OPEN


def test_where_nothing_holds_there_is_no_motion_that_was_judged():
    assert of_replays(set())[1] is None


@each_row("holding, failing", [(OPEN, CLOSED), (CLOSED, OPEN)])
def test_the_control_that_does_not_hold_is_in_the_first_sentence_with_why(holding, failing):
    words = {OPEN: "open loop", CLOSED: "under TVLQR"}
    told, shown = of_replays({holding})
    why = f"in steps of 0.1 s, x ends far off in steps of 0.1 s by {failing}"
    assert told == f"on the plant {words[holding]}, not {words[failing]}: {why}"
    assert shown.control == holding


def test_a_success_that_only_feedback_holds_says_so_wherever_it_is_told(tmp_path):
    """A cart-pole swung up: what half a step changes grows on the way up, and open loop ends elsewhere."""
    model = dd.load_model(MODELS / "cart_pole.urdf", time_step=0.02)
    effort = dd.QuadraticCost(R=[[1.0]])
    problem = dd.Problem(model, x0=np.zeros(4), x_goal=[1, np.pi, 0, 0], num_steps=100, running_cost=effort)
    solution = dd.solve(problem)
    assert solution.success, solution.message
    assert not any(r.holds for r in solution.replays if r.control == OPEN)
    first = solution.message.split(";")[0]
    held = "under TVLQR in steps of 0.01 s or less"
    assert f"on the plant {held}, not open loop: in steps of 0.02 s, hinge_w ends" in first
    assert "converged under TVLQR, not open loop" in str(solution)
    assert "not open loop" in repr(solution)
    record = dd.save(solution, tmp_path / "run")
    assert record.sentence == solution.message
    page = (tmp_path / "run" / "report.html").read_text()
    assert "own motion, in steps of 0.01 s, while feedback (TVLQR) keeps it near the plan." in page
    assert "Under the planned inputs alone it leaves the plan." in page
    shown, control = measure(solution).shown
    assert control == "TVLQR, in steps of 0.01 s"
    assert shown is solution.judged_replay.motion
    assert np.abs(shown.xs[-1] - [1, np.pi, 0, 0]).max() < 0.2  # the motion that is drawn is the one that arrives
