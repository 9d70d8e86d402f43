"""Tests of Hermite-Simpson and trapezoid against closed forms, published optima, and their exact discrete optima.

All expected numbers are independent of this code. The block is x'' = u from rest at 0 to rest at 1 in 1 s, whose
least integral of u^2 is 12, by u = 6 - 12 t. Kelly's cart-pole and its optimum are from "An Introduction to Trajectory
Optimization", SIAM Review 59(4), 2017. Most of the others are from Betts, "Practical Methods for Optimal Control".
"""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from helpers.models import MODELS, random_state
from helpers.plants import block, floating
from helpers.solving import solve_with
from helpers.table import each_row
from helpers.transcription import BLOCK, collocate, effort, heavy_pendulum, move, push, unit_inputs
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.multibody.tree import QuaternionFloatingJoint

import drake_diff as dd
from drake_diff.exceptions import GradientError, InputError
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.optimize.problem.dynamics import Dynamics, plant_dynamics
from drake_diff.optimize.transcription.between import violation_between_nodes
from drake_diff.optimize.transcription.collocation import collocated
from drake_diff.optimize.transcription.nodes import TranscribedProgram
from drake_diff.optimize.transcription.task import SCHEMES as SCHEMES_OF

pytestmark = pytest.mark.solve

SCHEMES = ("trapezoid", "hermite_simpson")


def half_effort(x, u):
    return 0.5 * u[0] ** 2


# ------------------------------------------------------------------------------ exact discrete optima


@each_row("count", [2, 5, 10, 20])
def test_the_blocks_move_has_each_schemes_own_optimum(count):
    by_trapezoid = move(count, scheme="trapezoid")
    assert 12 / by_trapezoid.transcribed.quadrature == pytest.approx(1 - 4 / count**2 + 3 / count**3, rel=1e-9)
    by_simpson = move(count)
    assert by_simpson.cost == pytest.approx(12, rel=1e-9)
    t = by_simpson.times
    assert by_simpson.inputs_at_knots[:, 0] == pytest.approx(6 - 12 * t, abs=1e-6)
    assert by_simpson.xs[:, 0] == pytest.approx(3 * t**2 - 2 * t**3, abs=1e-8)


@pytest.mark.parametrize(
    ("scheme", "count", "optimum"),
    [("trapezoid", 25, 60.03551947), ("hermite_simpson", 25, 58.80542547), ("hermite_simpson", 50, 58.80764217)],
)
def test_the_cart_pole_from_its_file_swings_up(scheme, count, optimum):
    dynamics = plant_dynamics(dd.load_model(MODELS / "cart_pole.urdf", time_step=0.04))
    motion = move(count, dynamics, x0=np.zeros(4), x_goal=[1, np.pi, 0, 0], horizon=2.0, scheme=scheme)
    assert motion.transcribed.quadrature == pytest.approx(optimum, rel=1e-7)
    if count == 50:  # the largest input is between two nodes
        xs, us = motion.transcribed.at(np.linspace(0, 2, 2001))
        assert np.abs(us).max() == pytest.approx(13.98, abs=0.01)
        assert [xs[:, 0].min(), xs[:, 0].max()] == pytest.approx([0, 1.1795], abs=1e-3)
    assert dynamics.bounds.u_upper == pytest.approx([20])


# ------------------------------------------------------------------------------ pendulums


@each_row(
    "scheme, count, optimum",
    [
        ("trapezoid", 20, 8.876255),
        ("trapezoid", 40, 8.821279),
        ("trapezoid", 80, 8.807238),
        ("hermite_simpson", 20, 8.8024872),
        ("hermite_simpson", 40, 8.8024843),
    ],
)
def test_the_simple_pendulum_with_a_free_final_time(scheme, count, optimum):
    pendulum = Dynamics(
        lambda x, u: np.array([x[1], -0.1 * x[1] - np.sin(x[0]) + u[0]]), 2, 1, u_lower=[-5], u_upper=[5]
    )
    motion = move(count, pendulum, x_goal=[np.pi, 0], horizon=(0.5, 2.5), scheme=scheme)
    assert motion.transcribed.quadrature == pytest.approx(optimum, rel=1e-7)
    assert motion.horizon == pytest.approx(2.5, abs=1e-6)
    if scheme == "hermite_simpson":
        assert np.abs(motion.inputs_at_knots).max() == pytest.approx(2.968, abs=5e-3)


@pytest.mark.parametrize(
    ("scheme", "errors", "orders"),
    [
        ("hermite_simpson", (1.12727e-3, 6.99377e-5, 4.36113e-6), (3.8, 4.2)),
        ("trapezoid", (0.58681, 0.16957, 0.045002), (1.75, 2.05)),
    ],
)
def test_the_cost_converges_at_the_schemes_order(scheme, errors, orders):
    """Between 20, 40 and 80 intervals the trapezoid's order goes from 1.79 to 1.91. Hermite-Simpson has order 4."""
    found = [
        move(n, heavy_pendulum(0.1), x_goal=[np.pi, 0], horizon=2.0, scheme=scheme).transcribed.quadrature
        - 72.126618030
        for n in (20, 40, 80)
    ]
    assert np.abs(found) == pytest.approx(errors, rel=1e-4)
    for coarse, fine in itertools.pairwise(found):
        assert orders[0] < math.log2(coarse / fine) < orders[1]


def test_minimum_time():
    pendulum = heavy_pendulum(0.0, u_lower=[-5], u_upper=[5])
    motion = move(50, pendulum, x_goal=[np.pi, 0], horizon=(0.5, 6), running_cost=1.0)
    assert 2.38569 < motion.horizon < 2.38569 * (1 + 1e-3)  # inputs cannot jump, and nodes miss the switches
    assert motion.horizon == pytest.approx(motion.cost, rel=1e-12)


# ------------------------------------------------------------------------------ minimum time


@pytest.mark.parametrize(("scheme", "count"), [("hermite_simpson", 10), ("hermite_simpson", 20)])
def test_the_double_integrator_in_minimum_time(scheme, count):
    """The optimum is 2, by an input that jumps at a node. A continuous parabola within 1 is 1 - tau^2 before the node.

    It loses h^2 / 12 of the way in each half: T = 2 / sqrt(1 - 2 / (3 N^2)).
    """
    motion = move(count, x0=[-1, 0], x_goal=[0, 0], horizon=(0.1, 10), running_cost=1.0, bounds=unit_inputs())
    assert motion.horizon == pytest.approx(2 / math.sqrt(1 - 2 / (3 * count**2)), rel=1e-7)
    assert np.abs(motion.transcribed.at(np.linspace(0, motion.horizon, 2001))[1]).max() < 1 + 1e-7
    half = count // 2
    assert motion.inputs_at_knots[:half, 0] == pytest.approx(1, abs=1e-5)
    assert motion.inputs_at_knots[half + 1 :, 0] == pytest.approx(-1, abs=1e-5)


@pytest.mark.parametrize(("count", "rel"), [(10, 3e-7), (20, 2e-8)])
def test_the_brachistochrone(count, rel):
    def slide(x, u):
        return np.array([x[2] * np.sin(u[0]), x[2] * np.cos(u[0]), 9.8 * np.cos(u[0])])

    dynamics = Dynamics(slide, 3, 1, x_lower=[0, 0, 0], u_lower=[0], u_upper=[np.pi])
    guess = np.linspace([0, 0, 0], [2, 2, 6], count + 1), np.full((count + 1, 1), 0.8), 1.0
    ends = {"x0": np.zeros(3), "x_goal": [2, 2, np.nan]}
    motion = move(count, dynamics, horizon=(0.1, 5), running_cost=1.0, initial_guess=guess, **ends)
    assert motion.horizon == pytest.approx(0.824759143156625, rel=rel)


# ------------------------------------------------------------------------------ linear dynamics


def test_a_free_final_velocity():
    assert move(x_goal=[1, np.nan], running_cost=half_effort).cost == pytest.approx(1.5, rel=1e-9)


# ------------------------------------------------------------------------------ bounds


def bryson_denham(count, scheme="hermite_simpson"):
    bounds = dd.Bounds(x_upper=[1 / 9, np.inf])
    return move(count, x0=[0, 1], x_goal=[0, -1], running_cost=half_effort, bounds=bounds, scheme=scheme)


def test_bryson_and_denham():
    """With nodes at the arcs' ends, 1/3 and 2/3, Hermite-Simpson is exact and the bound holds between the nodes."""
    motion = bryson_denham(15)
    assert motion.cost == pytest.approx(4, rel=1e-7)
    assert motion.inputs_at_knots[0, 0] == pytest.approx(-6, abs=1e-4)
    assert violation_between_nodes(motion.transcribed).state < 1e-7
    assert (
        4.0035267 < bryson_denham(100, "trapezoid").transcribed.quadrature < 4.0036
    )  # 4.0035267 is the optimum with the bound at the nodes only


@each_row("count", [5, 7, 10, 11])
@each_row("scheme", ["hermite_simpson", "trapezoid", "drake"])
def test_a_bound_holds_between_the_nodes_wherever_they_lie(count, scheme):
    """Bryson and Denham's optimum is 4. No motion that satisfies the bound everywhere costs less."""
    motion = bryson_denham(count, scheme)
    dense = motion.transcribed.at(np.linspace(0, 1, 5001))[0][:, 0].max() - 1 / 9
    assert dense < 1e-7
    assert motion.transcribed.quadrature > 4 * (1 - 1e-7)
    # The motion of the trapezoid is a parabola, but not that of the block. The error of its rule is at least 2 %.
    missed = {"trapezoid": "an accurate integration from knot", "drake": "the cost that was minimized is"}
    assert missed[scheme] in repr(motion) if scheme in missed else motion.success, motion.message


def at_nodes_alone(monkeypatch):
    """Make the solver enforce bounds only at the nodes."""
    monkeypatch.setattr(TranscribedProgram, "_add_inputs", lambda *_: None)
    for name, scheme in SCHEMES_OF.items():
        none = np.zeros((0, scheme.nodes + 1))
        monkeypatch.setitem(SCHEMES_OF, name, dataclasses.replace(scheme, hull_states=none, hull_slopes=none))


def test_a_cost_below_the_optimum_goes_with_an_excess_between_the_nodes(monkeypatch):
    at_nodes_alone(monkeypatch)
    motion = bryson_denham(7)
    excess = violation_between_nodes(motion.transcribed)
    assert motion.cost < 4 - 1e-4
    assert excess.input == 0
    dense = motion.transcribed.at(np.linspace(0, 1, 5001))[0][:, 0].max() - 1 / 9
    assert 0.9 * dense < excess.state <= dense + 1e-9
    assert (motion.transcribed.nodes[:, 0] <= 1 / 9 + 1e-8).all()
    assert not motion.success
    assert f"between the nodes x0 is {excess.state:.3g} beyond its bound at " in repr(motion)


def test_an_input_that_is_too_large_between_the_nodes_is_no_success(monkeypatch):
    """1 kg and 1 N over 1 m need at least 2 s, except with an input of 9/8 N between the nodes."""
    at_nodes_alone(monkeypatch)
    asked = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": 20, "horizon": (0.1, 10), "running_cost": 1.0}
    once = {"method": "collocation", "refine": False}
    by_model = solve_with(dd.Problem(block(effort=1.0), **asked), **once)
    by_formula = solve_with(dd.Problem(BLOCK, bounds=unit_inputs(), **asked), **once)
    by_its_limits = solve_with(dd.Problem(dd.Dynamics(push, 2, 1, u_lower=[-1], u_upper=[1]), **asked), **once)
    for motion in (by_model, by_formula, by_its_limits):
        assert motion.horizon < 2
        assert np.abs(motion.us).max() < 1 + 1e-7
        assert not motion.success
        assert "is 0.125 beyond its bound at " in repr(motion)
    # The motion lacks the part of the input that the plant clips.
    assert by_formula.integration_error < 1e-7 < 1e-4 < by_its_limits.integration_error


def test_a_constraint_that_is_broken_between_the_nodes_is_no_success():
    """v <= 1.25 holds at nodes with a distance of 0.25 s, but its arc begins at 0.3 s. See `test_a_speed_limit`."""
    slow = dd.Constraint(lambda x: x[1], upper=1.25, name="slow")
    coarse, fine = (move(n, constraints=slow) for n in (4, 40))
    assert coarse.constraint_violation < 1e-7
    assert not coarse.success
    assert "between the nodes slow is " in repr(coarse)
    assert fine.success
    everywhere = move(4, bounds=dd.Bounds(x_upper=[np.inf, 1.25]))  # a bound is satisfied everywhere
    assert everywhere.success
    assert everywhere.cost > 8 * 1.25**2 / (3 * 0.3)


def van_der_pol(**bounds):
    return Dynamics(lambda x, u: np.array([(1 - x[1] ** 2) * x[0] - x[1] + u[0], x[0]]), 2, 1, **bounds)


def state_and_effort(x, u):
    return x[0] ** 2 + x[1] ** 2 + u[0] ** 2


def test_van_der_pols_oscillator():
    dynamics = van_der_pol(u_lower=[-1], u_upper=[1], x_lower=[-0.25, -np.inf])
    motion = move(100, dynamics, x0=[0, 1], x_goal=None, horizon=10.0, running_cost=state_and_effort)
    assert motion.cost == pytest.approx(3.6152, rel=3e-5)
    assert motion.xs[:, 0].min() == pytest.approx(-0.25, abs=1e-6)


def test_friction_with_a_push_only():
    dynamics = Dynamics(lambda x, u: np.array([x[1], u[0] - 4.0]), 2, 1, u_lower=[0])
    motion = move(20, dynamics)  # a node lies at 3/4
    assert motion.cost == pytest.approx(28.4444444444, rel=1e-8)
    assert motion.inputs_at_knots[0, 0] == pytest.approx(0.75 * 14.2222222, rel=1e-4)
    assert motion.inputs_at_knots[16:, 0] == pytest.approx(0, abs=1e-4)


# ------------------------------------------------------------------------------ many states and scales


HOVER = 0.486 * 9.81 / 2  # [N] per rotor


def fly(x, u):
    """Return x' of a planar quadrotor of 0.486 kg and 0.00383 kg m^2, with its rotors 0.25 m from the middle."""
    push = (u[0] + u[1]) / 0.486
    return np.array(
        [x[3], x[4], x[5], -push * np.sin(x[2]), push * np.cos(x[2]) - 9.81, 0.25 * (u[0] - u[1]) / 0.00383]
    )


@each_row("scheme, follows", [("trapezoid", False), ("hermite_simpson", True)])
def test_a_plan_that_its_dynamics_do_not_follow_is_no_success(scheme, follows):
    """Each interval of the trapezoid is right to 1 %, but the motion is not. Rotors at a limit cannot correct it."""
    count, goal = 25, np.array([0.782, 0.966, 0, 0, 0, 0])
    found = collocate(
        Dynamics(fly, 6, 2, u_lower=[0.5, 0.5], u_upper=[5.18, 5.18]),
        x0=np.zeros(6),
        x_goal=goal,
        num_steps=count,
        horizon=1.2,
        running_cost=lambda x, u: (u[0] - HOVER) ** 2 + (u[1] - HOVER) ** 2,
        initial_guess=(np.linspace(np.zeros(6), goal, count + 1), np.full((count + 1, 2), HOVER)),
        scheme=scheme,
    )
    off = np.abs(found.transcribed.led("TVLQR")[-1] - found.xs[-1]) / np.ptp(found.xs, axis=0)
    assert found.success is follows, found.message
    assert bool(np.max(off) < 0.01) is follows
    assert np.all(found.transcribed.gaps < 0.01 * np.minimum(np.ptp(found.xs, axis=0), 1))
    if not follows:
        assert {c.feedback for c in found.following if not c.passes} == {None, "TVLQR"}


def test_feedback_follows_what_open_loop_loses():
    """Errors of x' = 3 x + u from 1 to 0 in 3 s grow by exp(9) open loop, and TVLQR keeps them small."""
    unstable = Dynamics(lambda x, u: [3 * x[0] + u[0]], 1, 1)
    found = collocate(unstable, x0=[1], x_goal=[0], num_steps=30, horizon=3.0, running_cost=effort)
    assert abs(found.transcribed.led("open loop")[-1, 0]) > 100 * abs(found.transcribed.led("TVLQR")[-1, 0])
    off = dataclasses.replace(found, xs=found.xs + 1e-5)  # a negligible defect, but 0.08 at the end
    assert found.success
    assert abs(off.transcribed.led("open loop")[-1, 0]) > 0.01
    assert abs(off.transcribed.led("TVLQR")[-1, 0]) < 1e-4


def test_feedback_asks_for_no_more_than_the_bounds_allow():
    """From 1 m/s backwards, a block whose input is at its limit cannot catch up with its plan."""
    limits = {"u_lower": [-1.0], "u_upper": [1.0]}
    asked = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": 20, "horizon": 2.01, "running_cost": effort}
    for problem in (
        dd.Problem(Dynamics(push, 2, 1, **limits), **asked),
        dd.Problem(BLOCK, **asked, bounds=unit_inputs()),
    ):
        found = dd.solve(problem)
        xs = np.array(found.xs)
        xs[0, 1] = -1.0
        assert abs(dataclasses.replace(found, xs=xs).transcribed.led("TVLQR")[-1, 0] - 1) > 0.3


HYPERSENSITIVE = 1.330806904943


def hypersensitive(horizon, count, **options):
    return move(
        count,
        Dynamics(lambda x, u: -(x**3) + u, 1, 1),
        x0=[1.5],
        x_goal=[1],
        horizon=horizon,
        running_cost=lambda x, u: 0.5 * (x[0] ** 2 + u[0] ** 2),
        refine=True,
        max_iterations=1000,
        tolerance=1e-7,
        **options,
    )


def test_the_hypersensitive_problem_over_50_seconds():
    """The optimum is within exp(-50) of that of an infinite horizon. The refinement resolves both ends."""
    motion = hypersensitive(50.0, 25, error_tolerance=1e-5)
    assert motion.cost == pytest.approx(HYPERSENSITIVE, rel=1e-4)
    assert np.abs(motion.transcribed.at(np.linspace(20, 30, 100))[0]).max() < 1e-3
    lengths = np.diff(motion.times)
    assert lengths[0] < lengths.max() / 4
    assert lengths[-1] < lengths.max() / 4


# ------------------------------------------------------------------------------ measures, refinement


def test_refinement_ends_below_its_tolerance():
    motion = move(
        8, heavy_pendulum(0.1), x_goal=[np.pi, 0], horizon=2.0, refine=True, error_tolerance=1e-8, max_num_steps=400
    )
    counts, errors = zip(*motion.options["refinements"], strict=True)
    assert list(counts) == sorted(counts)
    assert len(counts) > 1
    assert errors[-1] <= 1e-8 < errors[-2]
    assert motion.cost == pytest.approx(72.126618030, abs=2e-5)


def test_refinement_says_when_it_gives_up():
    motion = move(
        10, heavy_pendulum(0.1), x_goal=[np.pi, 0], horizon=2.0, refine=True, scheme="trapezoid", max_num_steps=50
    )
    assert len(motion.xs) <= 51
    assert "raise max_num_steps" in repr(motion)


def test_the_cost_alone_can_ask_for_a_finer_mesh():
    """For x' = u the states of the trapezoid are exact, but its cost is not."""
    dynamics, options = Dynamics(lambda x, u: u, 1, 1), {"x0": [1], "x_goal": [0.5], "horizon": 2.0}
    cost = dd.QuadraticCost(Q=[[0.5]], R=[[0.5]])
    motion = move(10, dynamics, running_cost=cost, scheme="trapezoid", refine=True, error_tolerance=1e-6, **options)
    assert len(motion.options["refinements"]) > 1
    assert motion.integration_errors.max() < 1e-12
    assert motion.cost == pytest.approx(0.510461418068826, abs=1e-4)


def test_errors_are_the_distance_from_an_accurate_integration():
    """A knot that is moved by 0.01 m has an error of 0.01 m, and so has the next one."""
    motion = move()
    assert motion.integration_errors.max() < 1e-12
    xs = np.array(motion.xs)
    xs[3, 0] += 0.01
    worse = dataclasses.replace(motion, xs=xs)
    assert worse.integration_errors[[2, 3]] == pytest.approx([0.01, 0.01], rel=1e-9)
    assert worse.defect == pytest.approx(0.01, rel=1e-9)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_the_motion_between_knots_goes_through_them(scheme):
    motion = move(7, heavy_pendulum(0.1), x_goal=[np.pi, 0], horizon=2.0, scheme=scheme)
    xs, us = motion.transcribed.at(motion.times)
    assert xs == pytest.approx(motion.xs, abs=1e-8)
    assert us == pytest.approx(motion.inputs_at_knots, abs=1e-8)
    if scheme == "hermite_simpson":
        xs, us = motion.transcribed.at((motion.times[1:] + motion.times[:-1]) / 2)
        assert xs == pytest.approx(motion.transcribed.xs_mid, abs=1e-8)
        assert us == pytest.approx(motion.us_mid, abs=1e-8)
    else:
        assert motion.transcribed.xs_mid is None
        assert motion.us_mid is None


def test_the_same_problem_gives_the_same_bits():
    a, b = (move(20, heavy_pendulum(0.1), x_goal=[np.pi, 0], horizon=(1, 2)) for _ in range(2))
    assert a.transcribed.nodes.tobytes() == b.transcribed.nodes.tobytes()
    assert a.horizon == b.horizon


def test_what_cannot_be_is_infeasible():
    motion = collocate(BLOCK, x0=[0, 0], x_goal=[1, 0], num_steps=5, horizon=1.0, bounds=unit_inputs(3.9))
    assert not motion.success


# ------------------------------------------------------------------------------ derivatives


@each_row("name", ["cart_pole.urdf", "double_pendulum.urdf", "acrobot.xml", "floating"])
def test_a_plants_derivatives_are_those_of_its_equations_of_motion(load, name):
    model = floating(QuaternionFloatingJoint, 0) if name == "floating" else load(name)
    dynamics, equations, random = plant_dynamics(model), EquationsOfMotion(model), np.random.default_rng(0)
    for _ in range(3):
        x, u = random_state(model, random), random.standard_normal(model.nu)
        z = InitializeAutoDiff(np.concatenate([x, u])).ravel()
        expected = equations.autodiff(z[: model.nx], z[model.nx :]).reshape(-1, 1)
        f, A, B = dynamics.derivatives(x, u)
        assert f == pytest.approx(ExtractValue(expected).ravel(), rel=1e-12, abs=1e-12)
        assert np.hstack([A, B]) == pytest.approx(ExtractGradient(expected), rel=1e-10, abs=1e-10)
        assert dynamics(x, u) == pytest.approx(f, rel=1e-12, abs=1e-12)


# ------------------------------------------------------------------------------ bad input


@each_row(
    "f, message",
    [
        (3, "dynamics: expected a function of x and u"),
        (lambda x: x, r"dynamics <lambda> .*: expected numbers .* got TypeError"),
        (lambda x, u: np.array([x[1]]), r"dynamics <lambda> .* its ndarray: expected shape \(2,\), got shape \(1,\)"),
        (lambda x, u: np.array([x[1], u[3]]), "got IndexError"),
    ],
)
def test_a_function_that_is_no_dynamics_is_refused(f, message):
    with pytest.raises(InputError, match=message):
        Dynamics(f, 2, 1)


def test_dynamics_without_derivatives_are_refused():
    with pytest.raises(GradientError, match="dynamics lost its derivatives"):
        Dynamics(lambda x, u: np.array([1.0, 2.0]), 2, 1)
    for f in (lambda x, u: np.array([x[1], math.sin(x[0])]), lambda x, u: np.array([x[1], float(x[0])])):
        with pytest.raises(GradientError, match=r"dynamics <lambda> .* lost its derivatives: TypeError"):
            Dynamics(f, 2, 1)


@each_row(
    "options, message",
    [
        ({"nx": 0}, "nx: expected a whole number"),
        ({"nu": 1.5}, "nu: expected a whole number"),
        ({"x_lower": [0]}, r"x_lower: expected shape \(2,\)"),
        (
            {"u_lower": [2], "u_upper": [1]},
            r"bounds of u0: expected a lower bound of at most the upper bound, got \[2, 1\]",
        ),
        ({"state_names": ["a"]}, "state_names: expected 2 names"),
    ],
)
def test_bad_dynamics_are_named(options, message):
    sizes = {"nx": 2, "nu": 1} | options
    with pytest.raises(InputError, match=message):
        Dynamics(push, **sizes)


@each_row(
    "options, message",
    [
        ({"system": push}, "system: expected a Model or Dynamics, got function"),
        ({"x0": [0]}, r"x0: expected shape \(2,\)"),
        ({"x0": [0, np.inf]}, r"x0\[1\]: expected a finite number, got inf"),
        ({"x_goal": [1, 0, 0]}, r"x_goal: expected shape \(2,\)"),
        ({"x_goal": [3, 0], "bounds": dd.Bounds(x_upper=[2, 9])}, r"x_goal, x0: expected within \[-inf, 2\], got 3"),
        ({"num_steps": 0}, "num_steps: expected a whole number"),
        ({"horizon": None}, r"horizon: expected a number of seconds, or \(lower, upper\), got none"),
        ({"horizon": 0}, r"horizon \[s\]: expected a finite number above 0"),
        ({"horizon": (2, 1)}, "horizon: expected a lower bound of at most the upper bound"),
        ({"horizon": (1, np.inf)}, r"horizon \[s\]: expected a finite number above 0"),
        ({"horizon": (1, 2, 3)}, "horizon: expected a number of seconds"),
        ({"scheme": "radau"}, "scheme: expected one of drake, hermite_simpson, trapezoid, got 'radau'"),
        ({"bounds": (0, 1)}, "bounds: expected Bounds"),
        ({"initial_guess": 3}, "initial_guess: expected"),
        ({"initial_guess": (np.zeros((3, 2)), np.zeros((3, 1)))}, r"initial_guess xs: expected shape \(6, 2\)"),
        ({"initial_guess": (np.zeros((6, 2)), np.zeros((5, 1)), -1.0)}, r"initial_guess horizon \[s\]"),
        ({"running_cost": "effort"}, "running_cost: expected a QuadraticCost or a function, such as .*, got str"),
        ({"parameters": ("mass",)}, "parameters: expected no parameters with these dynamics"),
        ({"trajectory_cost": lambda xs, us: xs[0, 0]}, "trajectory_cost: expected .* got given"),
        ({"running_cost": np.nan}, "running_cost"),
        ({"running_cost": lambda x, u: x}, "running_cost <lambda> .* expected shape"),
        ({"running_cost": dd.QuadraticCost(R=np.eye(2))}, r"running_cost.R: expected shape \(1, 1\)"),
        ({"final_cost": dd.QuadraticCost(Q=np.eye(3))}, r"final_cost.Q: expected shape \(2, 2\)"),
        ({"final_cost": 3}, "final_cost: expected a QuadraticCost or a function"),
        ({"running_cost": None, "x_goal": None}, "problem: expected a cost, an x_goal, goals or constraints"),
        ({"refine": True, "error_tolerance": 0}, "error_tolerance: expected a finite number above 0"),
        ({"max_num_steps": 0}, "max_num_steps: expected a whole number"),
    ],
)
def test_bad_input_is_named_before_anything_runs(options, message):
    given = {"system": BLOCK, "x0": [0, 0], "x_goal": [1, 0], "num_steps": 5, "horizon": 1.0, "running_cost": effort}
    given |= options
    with pytest.raises(InputError, match=message):
        collocate(given.pop("system"), **given)


def test_a_running_cost_without_derivatives_is_refused():
    with pytest.raises(GradientError, match=r"running_cost <lambda> .* lost its derivatives"):
        move(running_cost=lambda x, u: 1.0)


# ------------------------------------------------------------------------------ errors and violations


@each_row("end, error", [(1.0, 1 / 3), (2.0, 1 / 3)])
def test_the_trapezoids_error_of_a_parabola_is_a_part_of_the_cost(end, error):
    """The cost of x = end t is end^2 / 2 by the rule and end^2 / 3 exactly."""
    problem = dd.Problem(
        dd.Dynamics(lambda x, u: [u[0]], 1, 1), x0=[0], num_steps=1, horizon=1.0, running_cost=lambda x, u: x[0] ** 2
    )
    found = collocated(
        problem, "trapezoid", np.array([[0], [end]]), np.full((2, 1), end), None, 1.0, np.array([0.0, 1.0])
    )
    assert found.cost_errors == pytest.approx([error], rel=1e-5)


@each_row("row", [0, 2, -1])
@each_row("column", [0, 1])
def test_a_moved_knot_is_no_success(row, column):
    """The motion is measured, whatever the status of the solver is."""
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], 2, 1)
    found = collocate(block, x0=[0, 0], x_goal=[1, 0], num_steps=5, horizon=1.0, running_cost=lambda x, u: u[0] ** 2)
    assert found.success
    assert found.plan_checks.failing == []
    xs = np.array(found.xs)
    xs[row, column] += 1e-3
    moved = dataclasses.replace(found, xs=xs)
    assert moved.plan_checks.failing != []
    assert max(moved.defect, moved.goal_error, moved.initial_state_error) >= 1e-4
    xs[row, column] = np.nan
    assert dataclasses.replace(found, xs=xs).defect == np.inf


def test_an_input_beyond_its_bound_is_no_success():
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], 2, 1, u_lower=[-10], u_upper=[10])
    found = collocate(block, x0=[0, 0], x_goal=[1, 0], num_steps=5, horizon=1.0, running_cost=lambda x, u: u[0] ** 2)
    assert found.success
    tight = dataclasses.replace(found.problem, bounds=dd.Bounds([-9, -9], [9, 9], [-5.0], [5.0]))
    beyond = dataclasses.replace(found, problem=tight)
    assert beyond.bound_violation == pytest.approx(1.0, abs=1e-6)  # |u| is 6 at the ends
    assert any(c.what == "bound" and c.value == pytest.approx(1.0, abs=1e-6) for c in beyond.plan_checks.failing)


def test_a_users_constraint_is_not_called_where_the_dynamics_lead_nowhere():
    """x' = x^2 from 1 is 1 / (1 - t), which has no value from 1 s on. Drake ends the process at such a state."""

    def finite(x):
        assert np.asarray(x).dtype == object or np.isfinite(x).all()
        return x[0]

    bent = dd.Dynamics(lambda x, u: [x[0] ** 2 + 0 * u[0]], nx=1, nu=1)
    low = dd.Constraint(finite, upper=5.0, name="low")
    problem = dd.Problem(bent, x0=[1.0], num_steps=2, horizon=3.0, running_cost=1.0, constraints=low)
    motion = collocated(problem, "hermite_simpson", np.ones((3, 1)), np.zeros((3, 1)), None, 3.0, np.linspace(0, 1, 3))
    with np.errstate(all="ignore"):
        assert not np.isfinite(motion.between_knots[1]).all()
        assert violation_between_nodes(motion).constraint >= 0
