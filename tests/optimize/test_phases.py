"""Tests of problems in phases: closed forms, a known gait, and planted violations that must be refused."""

from dataclasses import replace

import numpy as np
import pytest

import drake_diff as dd
from drake_diff.exceptions import InputError, ShapeError
from drake_diff.optimize import Options
from drake_diff.optimize.phased import judged_phases
from drake_diff.optimize.program import NlpResult, Outcome

G = 9.81


def falling(x, u):
    return [x[1], u[0] - G]


def ball(limit=0.0):
    return dd.Dynamics(falling, 2, 1, u_lower=[-limit], u_upper=[limit])


def floor():
    return dd.Constraint(lambda x: x[0], 0.0, 0.0, knots=-1, name="floor")


def bouncing(height, restitution, bounces):
    """Return the problem of a ball that is dropped, bounces `bounces` times, and ends at rest in the air."""
    kept = {"num_steps": 4, "horizon": (0.01, 5.0), "bounds": dd.Bounds(x_lower=[0.0, np.nan])}
    fall = dd.Problem(ball(), x0=[height, 0.0], constraints=floor(), **kept)
    flights = [dd.Problem(ball(), x0=[0.0, 2.0], constraints=floor(), **kept) for _ in range(bounces - 1)]
    last = dd.Problem(ball(), x0=[0.0, 2.0], x_goal=[np.nan, 0.0], **kept)
    return dd.optimize.PhasedProblem([fall, *flights, last], resets=[np.diag([1.0, -restitution])] * bounces)


def walker(slope):
    """Return the simplest walker, whose hip is free, as its only input is fixed at 0."""

    def rates(x, u):
        a = np.sin(x[0] - slope)
        return [x[2], x[3], a, a + x[2] ** 2 * np.sin(x[1]) - np.cos(x[0] - slope) * np.sin(x[1]) + u[0]]

    return dd.Dynamics(rates, 4, 1, u_lower=[0], u_upper=[0])


def heel_strike(x):
    c = np.cos(2 * x[0])
    return np.array([-x[0], -2 * x[0], c * x[2], c * (1 - c) * x[2]])


def gait(slope=0.009, x0=(0.2, 0.4, -0.2, 0.0)):
    step = dd.Problem(
        walker(slope),
        x0=x0,
        num_steps=30,
        horizon=(3.5, 5.0),
        optimize=("controls", "initial_state"),
        running_cost=dd.QuadraticCost(R=[[1.0]]),
        constraints=[
            dd.Constraint(lambda x: x[1] - 2 * x[0], 0.0, 0.0, knots=-1, name="heel strike"),
            dd.Constraint(lambda x: x[0], upper=-0.05, knots=-1, name="forward"),
        ],
    )
    return dd.optimize.PhasedProblem([step], periodic=heel_strike, names=["step"])


@pytest.fixture(scope="module")
def walked():
    return dd.solve(gait())


@pytest.fixture(scope="module")
def bounced():
    return dd.solve(bouncing(1.0, 0.8, 2))


@pytest.mark.parametrize(("height", "restitution", "bounces"), [(1.0, 0.8, 1), (0.3, 0.5, 3), (2.0, 0.95, 4)])
def test_a_ball_bounces_as_newton_says(height, restitution, bounces):
    solution = dd.solve(bouncing(height, restitution, bounces))
    assert solution.success, solution.message
    speed, first = np.sqrt(2 * G * height), np.sqrt(2 * height / G)
    durations = [first, *(2 * speed * restitution**i / G for i in range(1, bounces)), speed * restitution**bounces / G]
    np.testing.assert_allclose([phase.horizon for phase in solution.phases], durations, rtol=1e-6)
    np.testing.assert_allclose(solution.starts, np.cumsum([0, *durations[:-1]]), rtol=1e-6)
    top = height * restitution ** (2 * bounces)
    assert solution.phases[-1].xs[-1, 0] == pytest.approx(top, rel=1e-6, abs=1e-7)  # each row is met to 1e-8
    assert solution.link_error < 1e-8


def test_two_halves_of_a_problem_are_the_whole():
    """The least effort of a block over 1 m in 1 s from rest to rest is 12 / m^2, wherever the problem is cut."""
    block, effort = dd.Dynamics(lambda x, u: [x[1], u[0]], 2, 1), dd.QuadraticCost(R=[[1.0]])
    parts = [
        dd.Problem(block, x0=[0, 0], num_steps=6, horizon=(0.1, 0.9), running_cost=effort),
        dd.Problem(block, x0=[0.5, 0], x_goal=[1, 0], num_steps=9, horizon=(0.1, 0.9), running_cost=effort),
    ]
    solution = dd.solve(dd.optimize.PhasedProblem(parts, horizon=1.0))
    assert solution.success, solution.message
    assert solution.cost == pytest.approx(12.0, rel=1e-7)
    assert solution.horizon == pytest.approx(1.0, abs=1e-8)


def test_the_simplest_walker_walks_its_known_gait(walked):
    """Garcia, Chatterjee, Ruina and Coleman, "The Simplest Walking Model", 1998: the long gait at a slope of 0.009.

    The published stance angle is 0.200310900544287, its rate -0.199832473004977, and the step time 3.882.
    """
    assert walked.success, walked.message
    step = walked.phases[0]
    np.testing.assert_allclose(step.xs[0, [0, 2]], [0.200310900544287, -0.199832473004977], atol=2e-6)
    assert walked.horizon == pytest.approx(3.882, abs=1e-3)
    assert walked.cost == pytest.approx(0.0, abs=1e-12)
    assert "exact Hessian" in walked.options["derivatives"]
    assert [c.verdict for c in walked.certificates] == ["agree"]


def test_a_load_that_is_dropped_leaves_with_its_states():
    """A cart drops its pendulum, so that four states become two. The cart alone has the cost of a block."""

    def loaded(x, u):
        return [x[2], x[3], u[0] + x[1], -10 * x[1] - u[0]]

    effort = dd.QuadraticCost(R=[[1.0]])
    carry = dd.Problem(
        dd.Dynamics(loaded, 4, 1), x0=[0, 0, 0, 0], x_goal=[0.5, 0, 0, 0], num_steps=20, horizon=1.0,
        running_cost=effort,
    )  # fmt: skip
    free = dd.Problem(
        dd.Dynamics(lambda x, u: [x[1], u[0]], 2, 1), x0=[0.5, 0], x_goal=[1.5, 0], num_steps=10, horizon=1.0,
        running_cost=effort,
    )  # fmt: skip
    solution = dd.solve(dd.optimize.PhasedProblem([carry, free], resets=[[[1, 0, 0, 0], [0, 0, 1, 0]]]))
    assert solution.success, solution.message
    assert solution.phases[1].cost == pytest.approx(12.0, rel=1e-6)
    assert [phase.xs.shape[1] for phase in solution.phases] == [4, 2]


def test_a_reset_without_an_expression_is_differentiated_too():
    def branching(x):
        return [x[0], -0.8 * x[1]] if x[0] < 100 else [x[0], x[1]]

    problem = bouncing(1.0, 0.8, 1)
    solution = dd.solve(dd.optimize.PhasedProblem(problem.phases, resets=[branching]))
    assert solution.success, solution.message
    assert "a reset: TypeError" in solution.options["derivatives"]
    assert solution.phases[-1].xs[-1, 0] == pytest.approx(0.64, rel=1e-6)


def rejudged(solution, phases):
    """Judge the solution with other phases, as after a solver that reports a solution."""
    result = NlpResult(np.zeros(0), Outcome.SOLVED, "IPOPT: Solve Succeeded", ())
    return judged_phases(replace(solution, phases=tuple(phases)), result)


def changed(phase, **fields):
    """Return a phase with other arrays and its own status, so that only the measures of all phases can refuse it."""
    return replace(phase, **fields)


@pytest.mark.parametrize("seed", range(6))
def test_a_planted_jump_between_phases_is_refused(bounced, seed):
    """A phase is moved as a whole. It is still a motion of the dynamics, but the link is violated."""
    random = np.random.default_rng(seed)
    which, shift = int(random.integers(1, 3)), random.choice([-1, 1]) * 10 ** random.uniform(-4, -1)
    xs = np.array(bounced.phases[which].xs) + np.array([shift, 0.0])
    phases = list(bounced.phases)
    phases[which] = changed(phases[which], xs=xs)
    again = rejudged(bounced, phases)
    assert again.status is dd.Status.CONVERGED_NOT_VERIFIED
    assert "is missed by" in repr(again)
    assert again.link_error == pytest.approx(abs(shift), rel=1e-3)
    assert rejudged(bounced, bounced.phases).success  # the unchanged plan holds


@pytest.mark.parametrize("seed", range(4))
def test_a_plan_for_another_reset_is_refused(bounced, seed):
    """The plan for one restitution is judged with another one."""
    factor = 0.8 + np.random.default_rng(seed).choice([-1, 1]) * 10 ** np.random.default_rng(seed).uniform(-4, -1)
    other = bouncing(1.0, 0.8, 2)
    other = dd.optimize.PhasedProblem(other.phases, resets=[np.diag([1.0, -factor]), np.diag([1.0, -0.8])])
    again = rejudged(replace(bounced, problem=other), bounced.phases)
    assert again.status is dd.Status.CONVERGED_NOT_VERIFIED
    assert "from phase 0 to phase 1 is missed by" in repr(again)


def test_a_plan_that_leaves_its_guard_is_refused():
    """A ball is released too late. The phase's own checks report that the guard is violated at the end of the phase."""
    problem = bouncing(1.0, 0.8, 1)
    solution = dd.solve(problem)
    for seed in range(4):
        height = 10 ** np.random.default_rng(seed).uniform(-4, -1)
        lifted = dd.Constraint(lambda x, at=height: x[0] - at, 0.0, 0.0, knots=-1, name="floor")
        fall = replace(problem.phases[0], constraints=lifted)
        phase = replace(solution.phases[0], problem=fall)
        assert phase.constraint_violation == pytest.approx(height, rel=1e-3)


def test_a_wrong_derivative_of_a_reset_is_found(bounced):
    from drake_diff.certificates.certificate import certify_jacobian

    switch = bounced.problem.switches[0]
    at = np.concatenate([bounced.phases[0].xs[-1], bounced.phases[1].xs[0]])
    wrong = np.hstack([-np.diag([1.0, -0.81]), np.eye(2)])
    certificate = certify_jacobian(lambda z: switch.link(z[:2], z[2:]), at, wrong)
    assert certificate.verdict == "disagree"
    again = rejudged(replace(bounced, certificates=(certificate,)), bounced.phases)
    assert again.status is dd.Status.CONVERGED_NOT_VERIFIED
    assert "certificate" in repr(again)


@pytest.mark.solve
def test_what_cannot_be_is_told_as_infeasible():
    """A ball cannot rise above where it was dropped."""
    problem = bouncing(1.0, 0.8, 1)
    up = replace(problem.phases[1], x_goal=[1.2, 0.0])
    solution = dd.solve(dd.optimize.PhasedProblem([problem.phases[0], up], resets=problem.resets), max_iterations=60)
    assert solution.status in (dd.Status.INFEASIBLE, dd.Status.ITERATION_LIMIT)
    assert len(solution.options["chain"]) == 9
    assert "no plan was found from 9 first guesses" in repr(solution)


def test_coarse_meshes_are_refined():
    problem = gait()
    coarse = replace(problem.phases[0], num_steps=3, us=None)
    solution = dd.solve(dd.optimize.PhasedProblem([coarse], periodic=heel_strike))
    assert solution.success, solution.message
    assert solution.options["refinements"][-1][0] > 3
    unrefined = dd.solve(dd.optimize.PhasedProblem([coarse], periodic=heel_strike), options=Options(refine=False))
    assert unrefined.status is dd.Status.CONVERGED_NOT_VERIFIED


def test_maps_come_in_phases_too():
    """Savings grow under one rate of interest. Half of them is spent, and the rest grows under another rate."""

    def saving(rate):
        return dd.optimize.DiscreteMap(lambda x, u: [rate * x[0] + u[0]], 1, 1, u_lower=[0], u_upper=[10])

    cost = dd.QuadraticCost(R=[[1.0]])
    parts = [
        dd.Problem(saving(1.1), x0=[0.0], num_steps=3, running_cost=cost),
        dd.Problem(saving(1.2), x0=[5.0], x_goal=[20.0], num_steps=2, running_cost=cost),
    ]
    solution = dd.solve(dd.optimize.PhasedProblem(parts, resets=[[[0.5]]]))
    assert solution.success, solution.message
    gain = np.array([0.5 * 1.44 * 1.1**2, 0.5 * 1.44 * 1.1, 0.5 * 1.44, 1.2, 1.0])  # the final value of each payment
    found = np.concatenate([phase.us[:, 0] for phase in solution.phases])
    np.testing.assert_allclose(found, 20 * gain / (gain @ gain), rtol=1e-6)  # least squares


def test_what_does_not_fit_is_refused_early():
    problem = bouncing(1.0, 0.8, 1)
    fall, up = problem.phases
    make = dd.optimize.PhasedProblem
    saving = dd.optimize.DiscreteMap(lambda x, u: [x[0] + u[0], x[1]], 2, 1)
    bad = [
        (lambda: make([fall]), "1"),
        (lambda: make([]), "0"),
        (lambda: make([fall, "up"]), "str"),
        (lambda: make([fall, up], resets=[]), "resets"),
        (lambda: make([fall, up], resets=[np.eye(3)]), "the reset from phase 0 to phase 1"),
        (lambda: make([fall, up], resets=[lambda x: [x[0]]]), "the reset from phase 0 to phase 1"),
        (lambda: make([fall, up], resets=[lambda x: float(x[0])]), "the reset from phase 0 to phase 1"),
        (lambda: make([fall, up], horizon=(20, 30)), "horizon"),
        (lambda: make([fall, up], names=["one"]), "names"),
        (lambda: make([fall, dd.Problem(saving, x0=[0, 0], x_goal=[1, 0], num_steps=3)]), "DiscreteMaps in all phases"),
        (lambda: dd.solve(problem, method="ilqr"), "method"),
        (lambda: dd.solve(problem, method="shooting"), "method"),
        (lambda: dd.solve(problem, options=Options(scheme="drake")), "scheme"),
        (lambda: dd.solve(problem, initial_guess=[None]), "initial_guess"),
    ]
    for make_it, words in bad:
        with pytest.raises((InputError, ShapeError), match=words):
            make_it()
