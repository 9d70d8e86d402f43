"""Tests of constraints, waypoints, limits and interrupts of a transcription, against closed forms, and of failures."""

import dataclasses
import math
import re
import signal

import numpy as np
import pytest
from helpers.table import each_row
from helpers.transcription import BLOCK, collocate, effort, heavy_pendulum, move, own_derivatives, unit_inputs

import drake_diff as dd
from drake_diff.exceptions import GradientError, InputError, SimulationError
from drake_diff.optimize.problem.dynamics import Dynamics

CALLED = Dynamics(own_derivatives(BLOCK), 2, 1)
TASK = {"x0": [0, 0], "x_goal": [1, 0], "num_steps": 10, "horizon": 1.0, "running_cost": effort}
SWING = TASK | {"x_goal": [np.pi, 0], "num_steps": 20, "horizon": 2.0}


# ------------------------------------------------------------------------------ waypoints


@pytest.mark.solve
@each_row("dynamics", [BLOCK, CALLED])
@each_row("place", [0.5, 0.7, -0.2])
def test_a_place_half_way(dynamics, place):
    """J = 12 + 192 (w - 1/2)^2 for the move and a hump, whose inputs are orthogonal. The scheme is exact for cubics."""
    motion = move(10, dynamics, waypoints={5: [place, np.nan]})
    assert motion.cost == pytest.approx(12 + 192 * (place - 0.5) ** 2, rel=1e-9)
    assert motion.xs[5, 0] == pytest.approx(place, abs=1e-9)
    assert motion.success


def test_a_refined_mesh_keeps_the_waypoints_place():
    options = {"x_goal": [np.pi, 0], "horizon": 2.0, "refine": True, "error_tolerance": 1e-7, "max_num_steps": 400}
    motion = move(8, heavy_pendulum(0.1), waypoints={2: [-0.5, np.nan]}, **options)
    assert len(motion.options["refinements"]) > 1
    assert motion.transcribed.at([0.5])[0][0, 0] == pytest.approx(-0.5, abs=1e-8)
    assert motion.success


@each_row(
    "waypoints, message",
    [
        ({0: [0, 0]}, "knots of waypoints.*at least 1"),
        ({10: [0, 0]}, "knots of waypoints.*at least 1"),
        ({True: [0, 0]}, "knots of waypoints"),
        ({0.5: [0, 0]}, "knots of waypoints"),
        ({3: [0]}, r"waypoint at knot 3: expected shape \(2,\)"),
        ({3: [0, np.inf]}, "waypoint at knot 3: expected finite numbers, NaN where free"),
        ({3: [9, 0]}, r"waypoint at knot 3, x0: expected within \[-inf, 5\], got 9"),
    ],
)
def test_bad_waypoints_are_named(waypoints, message):
    with pytest.raises(InputError, match=message):
        collocate(BLOCK, **TASK, waypoints=waypoints, bounds=dd.Bounds(x_upper=[5, np.inf]))


# ------------------------------------------------------------------------------ constraints


@pytest.mark.parametrize("dynamics", [BLOCK, CALLED])
def test_a_speed_limit(dynamics):
    """v is a parabola up to the limit V, which it reaches at tau = 3/2 (1 - 1/V), so that J = 8 V^2 / (3 tau)."""
    motion = move(10, dynamics, constraints=dd.Constraint(lambda x: x[1], upper=1.25))
    assert motion.cost == pytest.approx(8 * 1.25**2 / (3 * 0.3), rel=1e-7)
    assert motion.transcribed.nodes[:, 1].max() == pytest.approx(1.25, abs=1e-7)
    assert motion.success


def test_a_constraint_of_all_knots_holds_at_midpoints_and_one_of_some_does_not():
    limit = dd.Constraint(lambda x: x[1], upper=1.25)
    everywhere = move(10, constraints=[limit])
    at_knots = move(10, constraints=[dataclasses.replace(limit, knots=np.arange(11))])
    assert everywhere.transcribed.xs_mid[:, 1].max() < 1.25 + 1e-7
    assert at_knots.cost <= everywhere.cost * (1 + 1e-9)
    one = move(10, constraints=[dataclasses.replace(limit, knots=5)])
    assert one.xs[5, 1] == pytest.approx(1.25, abs=1e-7)
    assert one.xs[4, 1] > 1.25


@pytest.mark.parametrize("scheme", ["trapezoid", "hermite_simpson"])
def test_a_constraint_of_the_input_holds_at_the_last_knot_and_is_a_bound(scheme):
    limit = dd.Constraint(lambda x, u: u[0], lower=-5, upper=5)
    by_constraint = move(10, constraints=limit, scheme=scheme)
    by_bounds = move(10, bounds=unit_inputs(5.0), scheme=scheme)
    assert by_constraint.cost == pytest.approx(by_bounds.cost, rel=1e-7)
    assert by_constraint.inputs_at_knots[[0, -1], 0] == pytest.approx([5, -5], abs=1e-6)
    only_last = move(10, constraints=dataclasses.replace(limit, knots=-1), scheme=scheme)
    assert only_last.inputs_at_knots[-1, 0] == pytest.approx(-5, abs=1e-6)
    assert only_last.us[0, 0] > 5


def test_a_given_first_state_need_not_keep_a_constraint():
    motion = move(10, x0=[0, 1], constraints=dd.Constraint(lambda x: x[1], lower=None, upper=0.9), x_goal=[0.4, 0])
    assert motion.success
    assert motion.transcribed.nodes[1:, 1].max() < 0.9 + 1e-7


@each_row(
    "constraint, message",
    [
        (3, "constraints: expected a Constraint or several, such as .*, got int"),
        ([3], "constraints: expected a Constraint or several, such as .*, got int"),
        (
            dd.optimize.Periodic(),
            "constraints: expected a Constraint or several, such as .*; pass a coupling as couplings=, got Periodic",
        ),
        (dd.Constraint(lambda x: x[5], upper=1), "constraint .* got IndexError"),
        (dd.Constraint(lambda x: x, upper=[1, 2, 3]), "constraint .* expected 3, one per bound, got 2 values"),
        (
            dd.Constraint(lambda x: x, upper=1, knots=[11], name="far"),
            "knots of constraint far: expected whole",
        ),
    ],
)
def test_bad_constraints_are_named(constraint, message):
    with pytest.raises(InputError, match=message):
        collocate(BLOCK, **TASK, constraints=constraint)


# ------------------------------------------------------------------------------ violated constraints


@pytest.mark.solve
@pytest.mark.parametrize("dynamics", [BLOCK, CALLED])
def test_a_constraint_that_cannot_be_kept_is_no_success(dynamics):
    motion = collocate(
        dynamics,
        **TASK,
        constraints=dd.Constraint(lambda x: x[0], upper=0.5),
        max_iterations=200,
        time_limit=9.0,
        tolerance=1e-9,
    )
    assert not motion.success
    assert max(motion.defect, motion.constraint_violation) > 0.01


@pytest.mark.parametrize("kind", ["waypoint", "constraint"])
def test_a_node_moved_off_its_waypoint_or_constraint_is_no_success(kind):
    """Only the velocity of an inner knot is moved, which has no bound. The status of the solver has no effect."""
    limit = dd.Constraint(lambda x: x[1], upper=2.0)
    options = {"waypoints": {5: [np.nan, 1.5]}} if kind == "waypoint" else {"constraints": limit}
    motion = move(10, **options)
    assert motion.success
    xs = np.array(motion.xs)
    xs[5, 1] += 0.7
    moved = dataclasses.replace(motion, xs=xs)
    assert moved.constraint_violation == pytest.approx(0.7 if kind == "waypoint" else 0.2, abs=1e-7)
    if kind == "constraint":  # the motion is unchanged, but the constraint is tighter
        tighter = dataclasses.replace(limit, upper=1.0)
        held = dataclasses.replace(motion.problem, constraints=tighter)
        assert dataclasses.replace(motion, problem=held).constraint_violation == pytest.approx(0.5, abs=1e-7)
        broken = dataclasses.replace(motion.problem, constraints=dataclasses.replace(limit, function=lambda x: np.nan))
        assert dataclasses.replace(motion, problem=broken).constraint_violation == math.inf


# ------------------------------------------------------------------------------ limits, interrupts, errors


def test_an_interrupt_ends_with_the_best_iterate(monkeypatch):
    monkeypatch.setattr("drake_diff.optimize.program.REPORT_PERIOD", 0.0)
    lines, former = [], signal.getsignal(signal.SIGINT)

    def report(line):
        lines.append(line)
        if len(lines) == 4:
            signal.raise_signal(signal.SIGINT)

    motion = collocate(heavy_pendulum(0.1), **SWING, progress=report)
    assert motion.status is dd.Status.INTERRUPTED
    assert motion.solver_message == "stopped: interrupted"
    assert not motion.success
    assert np.isfinite(motion.transcribed.nodes).all()
    assert len(lines) == 4  # no further iteration begins
    form = r"iteration +(\d+)  cost +\S+  violation +\d\.\d\de[+-]\d\d"
    assert [re.fullmatch(form, line)[1] for line in lines] == ["0", "1", "2", "3"]
    assert signal.getsignal(signal.SIGINT) is former


@each_row(
    "error, status",
    [(SimulationError, dd.Status.DIVERGED), (GradientError, dd.Status.NO_GRADIENT)],
)
@each_row("at", ["values", "linearize"])
def test_an_error_of_the_dynamics_ends_the_solve_and_is_told(error, status, at):
    own, calls = own_derivatives(heavy_pendulum(0.1)), []
    plain = getattr(own, at)

    def failing(knots):
        calls.append(len(knots))
        if calls.count(len(knots)) == 4 and len(knots) == 41:  # the solver's calls at all nodes, not the certificates'
            raise error("here it ends")
        return plain(knots)

    setattr(own, at, failing)
    motion = collocate(Dynamics(own, 2, 1), other_guesses=0, **SWING)  # other guesses would not meet the error
    assert motion.status is status
    assert f"{error.__name__}: here it ends" in repr(motion)
    assert np.isfinite(motion.transcribed.nodes).all()


def test_a_trial_point_out_of_the_domain_is_stepped_back_from():
    """sqrt(x) is NaN below 0, which must not end the solve."""
    dynamics = Dynamics(lambda x, u: u * np.sqrt(x), 1, 1)
    motion = collocate(dynamics, x0=[1], x_goal=[4], num_steps=10, horizon=1.0, running_cost=effort)
    assert motion.success
    assert motion.cost == pytest.approx(4, rel=1e-4)  # y = 2 sqrt(x) has y' = u, from 2 to 4: u = 2
