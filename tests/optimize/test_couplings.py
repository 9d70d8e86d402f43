"""Tests of constraints that couple several knots: they are met, have exact derivatives, or are refused."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.models import MODELS

import drake_diff as dd
from drake_diff.exceptions import InputError
from drake_diff.optimize import Coupling, Options, Periodic

EFFORT = dd.QuadraticCost(R=[[1.0]])
BLOCK = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
BOTH = ("controls", "initial_state")


def swing(**more):
    """Return a periodic pendulum problem with a waypoint on the other side at half of the period."""
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.05)
    given = {"optimize": BOTH, "initial_state_mask": [False, True], "waypoints": {20: [0.8, np.nan]}}
    given |= {"couplings": Periodic(), "running_cost": EFFORT}
    return dd.Problem(model, x0=[-0.8, 0], **{"num_steps": 40} | given | more)


def test_a_forced_oscillator_finds_its_own_steady_state():
    """The only periodic motion of x'' + c x' + k x = cos(w t) is Re(exp(i w t) / (k - w^2 + i c w))."""
    c, k, w, count = 0.3, 4.0, 1.7, 60
    oscillator = dd.Dynamics(lambda x, u: [x[1], u[0] - c * x[1] - k * x[0]], nx=2, nu=1)
    problem = dd.Problem(
        oscillator, x0=[0.1, 0.2], num_steps=count, horizon=2 * np.pi / w, optimize=BOTH, couplings=Periodic(),
        running_cost=lambda x, u, t: (u[0] - np.cos(w * t)) ** 2,
    )  # fmt: skip
    solution = dd.solve(problem)
    gain = 1 / (k - w**2 + 1j * c * w)
    motion = np.array([[(gain * e).real, (1j * w * gain * e).real] for e in np.exp(1j * w * solution.times)])
    assert solution.success
    # Hermite-Simpson is of order 4: (1/60 of a period)^4 with slopes of order w^4
    assert np.max(np.abs(solution.xs - motion)) < 2e-5
    assert solution.constraint_violation < 1e-9


def test_a_spring_that_repeats_at_no_effort_does_so_in_its_own_period():
    spring = dd.Dynamics(lambda x, u: [x[1], u[0] - 4.0 * x[0]], nx=2, nu=1)
    problem = dd.Problem(spring, x0=[0.5, 0], num_steps=30, horizon=(1, 5), couplings=Periodic(), running_cost=EFFORT)
    solution = dd.solve(problem)
    assert solution.success, solution.message
    assert solution.horizon == pytest.approx(np.pi, abs=2e-5)  # of order 4 in 30 intervals: (0.2)^4 / 180 * pi / 2
    assert solution.cost < 1e-10


def test_what_cannot_be_traced_is_called_back():
    def branches(a, b):
        return b[0] - a[0] if b[0] > -10 else 0 * b[0]

    way = Coupling(branches, knots=(5, 15), lower=0.4, upper=0.4)
    solution = dd.solve(
        dd.Problem(BLOCK, x0=[0, 0], x_goal=[1, 0], num_steps=20, horizon=1.0, running_cost=EFFORT, couplings=way)
    )
    assert solution.success
    assert "coupling 0" in solution.options["derivatives"]
    assert abs(solution.xs[15, 0] - solution.xs[5, 0] - 0.4) < 1e-6


@pytest.mark.solve
@pytest.mark.parametrize("method", ["collocation", "shooting"])
def test_a_pendulum_swings_in_a_period(method):
    solution = dd.solve(swing(), method=method)
    assert solution.success
    assert np.max(np.abs(solution.xs[-1] - solution.xs[0])) < 1e-6
    assert abs(solution.xs[20, 0] - 0.8) < 1e-6


def test_a_motion_that_does_not_repeat_is_refused():
    solution = dd.solve(swing())
    random = np.random.default_rng(0)
    for _ in range(20):
        xs = np.array(solution.xs)
        xs[-1] += random.choice([-1, 1], 2) * 10 ** random.uniform(-4, -1, 2)
        planted = replace(solution, xs=xs)
        assert planted.constraint_excess["periodic"][0] > 5e-5  # the smallest change is 1e-4


def test_what_takes_no_couplings_says_so():
    problem = swing(waypoints=None)
    with pytest.raises(InputError, match=r'couplings.*method="ilqr"; method="shooting" supports it'):
        dd.solve(problem, method="ilqr")
    with pytest.raises(InputError, match=r"couplings"):
        dd.solve(problem, method="collocation", options=Options(scheme="drake", solver="snopt"))
    with pytest.raises(InputError, match=r"couplings"):
        dd.loop.MPC(swing(waypoints=None, optimize="controls", initial_state_mask=None), horizon=5)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: Coupling(3, lower=0), "function"),
        (lambda: Coupling(lambda a, b: a), "no lower and no upper"),
        (lambda: Coupling(lambda a, b: a[0], knots=(1,), lower=0), "two or more"),
        (lambda: Coupling(lambda a: a[0], lower=0), "1 arguments for 2 knots"),
        (lambda: Periodic(entries=[0, 0]), "each once"),
        (lambda: swing(couplings=Periodic(entries=[2])), "from 0 to 1"),
        (lambda: swing(couplings=Periodic(M=np.eye(3))), "shape"),
        (lambda: swing(couplings=[Periodic(), Periodic()]), "a different name"),
        (lambda: swing(couplings=Coupling(lambda a, b: a[0], knots=(0, 41), lower=0)), "from -41 to 40"),
        (lambda: swing(couplings=Coupling(lambda a, b: a[0], knots=(40, -1), lower=0)), "each once"),
        (lambda: swing(couplings=Coupling(lambda a, b: a[:1] - b, lower=[0, 0, 0])), "2 values"),
        (lambda: swing(couplings=EFFORT), "Periodic"),
        (lambda: swing(optimize="controls", initial_state_mask=None, x_goal=[0, 0]), "violate it by 0.8"),
    ],
)
def test_what_is_no_coupling_is_refused_at_once(make, told):
    with pytest.raises(dd.exceptions.DrakeDiffError, match=told):
        make()


@pytest.mark.slow
def test_a_record_of_it_is_verified_and_one_of_a_motion_that_does_not_repeat_fails(tmp_path):
    solution = dd.solve(swing())
    assert dd.save(solution, tmp_path / "a").verdict == "pass"
    found = dd.verify(tmp_path / "a")
    assert found.holds
    assert any("Periodic" in line for line in found.claimed)
    xs = np.array(solution.xs)
    xs[-1, 1] += 1e-3
    record = dd.save(replace(solution, xs=xs), tmp_path / "b")
    assert record.verdict == "fail"
    assert {m.name: m.verdict for m in record.metrics}["constraint violation"] == "fail"
    assert dd.verify(tmp_path / "b").verdict != "holds"
