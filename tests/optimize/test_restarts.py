"""Tests of restarts: the cheapest verified plan is returned, and all optima are listed."""

import signal

import numpy as np
import pytest
from helpers.table import each_row

import drake_diff as dd
from drake_diff.exceptions import InputError

pytestmark = pytest.mark.solve


def around(size=0.5, **asked):
    """Return the problem of passing a disk at constant speed, on the left, or on the right by a longer way."""
    move = dd.Dynamics(lambda x, u: [u[0], u[1]], nx=2, nu=2)
    disk = dd.Constraint(lambda x: (x[0] - 1) ** 2 + (x[1] - 0.1) ** 2, lower=size**2, name="disk")
    effort = dd.QuadraticCost(R=np.eye(2))
    return dd.Problem(
        move, x0=[0, 0], x_goal=[2, 0], num_steps=20, horizon=1.0, running_cost=effort, constraints=disk, **asked
    )


def length(side, size=0.5):
    """Return the length of the shortest way past the disk, below it (1) or above it (-1): two tangents and an arc."""
    middle = np.array([1.0, 0.1 * side])
    total = 0.0
    angles = []
    for end in (np.array([0.0, 0.0]), np.array([2.0, 0.0])):
        apart = end - middle
        far = np.linalg.norm(apart)
        total += np.sqrt(far**2 - size**2)
        angles.append(np.arctan2(-apart[1], abs(apart[0])) + np.arccos(size / far))  # up from the line's direction
    return total + size * (np.pi - angles[0] - angles[1])


def test_the_ways_around_a_disk_are_listed():
    """The cost of a way is the square of its length. There is one way on each side of the disk."""
    solution = dd.solve(around(), restarts=6)
    assert solution.success
    costs = [each.cost for each in solution.optima]
    np.testing.assert_allclose(sorted(costs)[:2], [length(1) ** 2, length(-1) ** 2], rtol=1e-3)  # 20 intervals
    assert solution.cost == min(costs) == costs[0]
    told = solution.options["optima"]
    assert [each["cost"] for each in told] == costs
    assert sum(each["count"] for each in told) <= 7
    assert any("seed 0" in each["guess"] for each in told)
    chain = solution.options["chain"]
    assert len(chain) >= 7
    assert [link["reason"][:14] for link in chain][-6:] == [f"restart {i} of 6" for i in range(1, 7)]
    assert "first guesses were verified" in repr(solution)
    sides = [np.sign(each.xs[len(each.xs) // 2, 1] - 0.1) for each in solution.optima[:2]]
    assert sorted(sides) == [-1, 1]


def test_restarts_come_out_the_same_and_none_leaves_all_as_it_is():
    once, again = (dd.solve(around(), restarts=2, seed=3) for _ in range(2))
    assert once.xs.tobytes() == again.xs.tobytes()
    assert once.options["optima"] == again.options["optima"]
    plain = dd.solve(around())
    assert plain.optima == ()
    assert "optima" not in plain.options


@each_row("method", ["ilqr", "shooting"])
def test_discrete_methods_restart_too(write_urdf, method):
    problem = dd.Problem(
        write_urdf(time_step=0.1), x0=[0, 0], x_goal=[1, 0], num_steps=10, running_cost=dd.QuadraticCost(R=[[1.0]])
    )
    solution = dd.solve(problem, method=method, restarts=2)
    assert solution.success
    assert [optimum["count"] for optimum in solution.options["optima"]] == [3]  # a convex problem has one optimum


def test_ctrl_c_ends_restarts_and_keeps_the_plan():
    """Interrupt the third search. The verified plan is returned, and the interruption is reported."""
    begun = []

    def press(row):
        begun.append(row.iteration == 0)
        if row.iteration == 0 and sum(begun) == 3:
            signal.raise_signal(signal.SIGINT)

    solution = dd.solve(around(), restarts=50, callback=press)
    assert solution.success
    assert "the restarts were ended: the run was interrupted" in repr(solution)
    assert [link["ended"] for link in solution.options["chain"]] == ["converged", "converged", "interrupted"]


def test_a_number_of_restarts_is_checked():
    for given in (-1, 1.5, True, "2"):
        with pytest.raises(InputError, match="restarts: expected a whole number"):
            dd.solve(around(), restarts=given)
