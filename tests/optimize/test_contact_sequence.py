"""Tests of optimization across the jumps at contact: the fixed distances, their sides, and the messages."""

import numpy as np
import pytest
from helpers.problems import push
from helpers.table import each_row, slow_after

import drake_diff as dd
from drake_diff.model.contact import separations
from drake_diff.model.step import set_state
from drake_diff.optimize import Options
from drake_diff.optimize.ilqr.through_contact import MARGIN, beginnings
from drake_diff.optimize.problem.design import ShootingVariables

pytestmark = pytest.mark.solve


def separation(model, x):
    set_state(model.double, x)
    return separations(model.double)[0]


@each_row(
    "name, x",
    [
        ("two_spheres.sdf", [0.1, 0.5, 0, 0]),
        ("box_push.sdf", [0.1, 0.05, 0.3, -0.3, -0.02, 0, 0, 0, 0, 0]),
        ("box_push.sdf", [0, 0, 0, -0.19, 0.02, 0, 0, 0, 0, 0]),
        ("hopper.sdf", [0.1, 0.4, 0.02, 0.3, 0, 0, 0, 0]),
    ],
)
def test_a_distance_has_its_slope_and_a_mobility(load, name, x):
    """Central differences with steps of 1e-6 are accurate to 1e-9."""
    model, x, d = load(name), np.array(x, dtype=float), 1e-6
    found = separation(model, x)
    for i, slope in enumerate(found.gradient):
        e = d * np.eye(model.nx)[i]
        assert slope == pytest.approx(
            (separation(model, x + e).distance - separation(model, x - e).distance) / (2 * d), abs=1e-8
        )
    assert (found.distance < 0) == (x[3] == -0.19)
    mass = model.double.plant.CalcMassMatrix(model.double.context)
    rate = found.gradient  # also the slope with respect to the velocities, as all joints are hinges and slides
    assert found.mobility == pytest.approx(rate @ np.linalg.solve(mass, rate), rel=1e-10)


def test_beginnings_are_where_a_distance_turns_negative(two_spheres):
    """Contact begins at knots 1 and 4 for these gaps. No step follows the last state."""
    gaps = np.array([0.1, -0.01, 0.02, 0.01, -0.02, 0.05, -0.03])
    problem = push(two_spheres(), gap=0.1, goal=1.0, num_steps=6)
    xs = np.stack([0 * gaps, 0.2 + gaps, 0 * gaps, 0 * gaps], axis=1)
    found = beginnings(problem, xs)
    assert [(h.knot, h.apart) for h in found] == [(1, False), (3, True), (4, False)]  # the state at knot 0 is given
    assert str(found[1]) == "pusher and ball apart at knot 3"
    for hold in found:
        rows = hold.constraint(problem.model).differentiate(xs[hold.knot], np.zeros(1))
        assert rows[0] == pytest.approx([gaps[hold.knot]], abs=1e-12)
        assert rows[1] == pytest.approx(np.array([[-1.0, 1, 0, 0, 0]]), abs=1e-12)


@pytest.mark.parametrize(
    ("gap", "goal", "fields"),
    slow_after(
        1,
        [
            (0.15, 0.7, {"damping": 1.0, "ball": 1.2}),
            (0.3, 1.0, {}),
            (0.4, 1.2, {"damping": 0.5}),
            (0.55, 1.1, {"damping": 0.2, "pusher": 1.7, "time_step": 0.025}),
        ],
    ),
)
def test_pushes_converge(two_spheres, gap, goal, fields):
    model = two_spheres(**fields)
    problem = push(model, gap=gap, goal=goal, num_steps=round(1 / model.time_step))
    solution = dd.solve(problem)
    assert solution.success, solution.message
    assert solution.replay.xs[-1][1] == pytest.approx(goal, abs=1e-7)


@pytest.fixture
def elastic(two_spheres, monkeypatch, tmp_path):
    """Build spheres that rebound. Steps of 0.02 s do not resolve the impacts, so that each contact is a large jump."""

    def build(**fields):
        two_spheres(**fields)
        path = tmp_path / "two_spheres.sdf"
        text = path.read_text()
        for old, new in (("dissipation>50<", "dissipation>1<"), ("time>0.1<", "time>0.001<")):
            assert text.count(old) == 2
            text = text.replace(old, new)
        path.write_text(text)
        return dd.load_model(path, time_step=0.02)

    return build


def at_a_jump(elastic):
    return push(elastic(damping=1.06, pusher=1.74, ball=0.586), gap=0.18, goal=0.93)


@pytest.mark.slow
def test_a_minimum_at_a_jump_meets_the_conditions_of_one_on_its_side(elastic):
    """For least effort u combines the slopes of the goal and the fixed distance, the latter with the sign of its side.

    The slopes with respect to u are products of Drake's step Jacobians. The search ends at 1e-8 of the cost's scale.
    """
    problem = at_a_jump(elastic)
    solution = dd.solve(problem, method="ilqr", options=Options(continuation="auto"))
    assert solution.success, solution.message
    note = solution.options["contact_sequence"]
    assert note in repr(solution)
    assert "a minimum for its own sequence of contacts" in note
    distance = [x[1] - x[0] - 0.2 for x in solution.xs]
    (knot,) = (k for k, d in enumerate(distance) if abs(abs(d) - MARGIN) < 1e-7)
    apart = distance[knot] > 0
    assert f"held by pusher and ball {'apart' if apart else 'touching'} at knot {knot}" in note
    variables = ShootingVariables(problem)
    by_u = [np.zeros((problem.nx, solution.us.size))]
    for k, d in enumerate(variables.linearization(variables.pack(solution.xs[0], solution.us))):
        by_u.append(d.A @ by_u[-1])
        by_u[-1][:, k : k + 1] += d.B
    slopes = np.stack([by_u[-1][1], by_u[knot][1] - by_u[knot][0]], axis=1)
    u = solution.us.ravel()
    multipliers = np.linalg.lstsq(slopes, u)[0]
    assert np.abs(slopes @ multipliers - u).max() < 1e-5 * np.abs(u).max()
    assert multipliers[1] > 0 if apart else multipliers[1] < 0
    alone = slopes[:, :1]
    assert np.abs(alone @ np.linalg.lstsq(alone, u)[0] - u).max() > 1e-2 * np.abs(u).max()  # the row is needed


@pytest.mark.parametrize("goal", [0.3, -1.0])
def test_a_goal_that_no_contact_reaches_is_no_success(two_spheres, goal):
    """The ball at 0.6 m can only be pushed away from the pusher."""
    solution = dd.solve(
        push(two_spheres(), gap=0.4, goal=goal), method="ilqr", options=Options(continuation="auto"), max_iterations=60
    )
    assert not solution.success
    assert solution.goal_error > 0.25
