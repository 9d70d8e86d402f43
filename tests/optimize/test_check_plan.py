"""`check_plan`: a given plan is verified without a search, and each kind of error in it is found."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.models import MODELS
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.planning import DirectCollocation, DirectTranscription
from pydrake.solvers import Solve
from pydrake.systems.primitives import LinearSystem
from pydrake.trajectories import PiecewisePolynomial, Trajectory

import drake_diff as dd

HORIZON = 2.0


def slide() -> dd.Problem:
    """A unit mass without friction that moves by 1 in 1 s; the least effort 12 has the input 6 - 12 t."""
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    return dd.Problem(
        block, x0=[0, 0], x_goal=[1, 0], num_steps=4, horizon=1.0, running_cost=dd.QuadraticCost(R=[[1.0]])
    )


def of_slide(count: int = 5) -> tuple[np.ndarray, np.ndarray]:
    t = np.linspace(0, 1, count)
    return np.column_stack([3 * t**2 - 2 * t**3, 6 * t - 6 * t**2]), (6 - 12 * t)[:, None]


def pendulum(steps: int = 40) -> dd.Problem:
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=HORIZON / steps)
    return dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=steps, running_cost=dd.QuadraticCost(R=[[1.0]]))


@pytest.fixture(scope="module")
def in_drake() -> tuple[Trajectory, Trajectory]:
    """The swing-up of Drake's DirectCollocation."""
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(MODELS / "pendulum.urdf"))
    plant.Finalize()
    program = DirectCollocation(
        plant, plant.CreateDefaultContext(), 41, HORIZON / 40, HORIZON / 40,
        input_port_index=plant.get_actuation_input_port().get_index(), assume_non_continuous_states_are_fixed=True,
    )  # fmt: skip
    for state, wanted in ((program.initial_state(), [0, 0]), (program.final_state(), [np.pi, 0])):
        program.prog().AddBoundingBoxConstraint(wanted, wanted, state)
    program.AddRunningCost(program.input()[0] ** 2)
    line = PiecewisePolynomial.FirstOrderHold([0, HORIZON], np.array([[0, np.pi], [0, 0]]))
    program.SetInitialTrajectory(PiecewisePolynomial(), line)
    result = Solve(program.prog())
    assert result.is_success()
    return program.ReconstructStateTrajectory(result), program.ReconstructInputTrajectory(result)


def test_a_plan_in_closed_form_is_verified_with_its_cost():
    solution = dd.check_plan(slide(), *of_slide())
    assert solution.success
    assert solution.plant == "continuous"
    assert solution.feedback is None
    assert solution.message == "verified: holds open loop in continuous time"
    assert solution.cost == pytest.approx(12.0, abs=1e-9)  # a quadratic of a line: the quadrature is exact
    assert "no better plan was searched for" in solution.notes[0]


@pytest.mark.parametrize(
    ("error", "what"),
    [
        (lambda xs, us: (xs + 0.05 * np.eye(5)[2][:, None], us), "integration"),
        (lambda xs, us: (xs, us * 1.05), "following"),
        (lambda xs, us: (xs * 0.99, us * 0.99), "goal"),
        (lambda xs, us: (xs + 0.01, us), "start"),
    ],
    ids=["state", "inputs", "goal", "start"],
)
def test_an_error_in_a_plan_is_named(error, what):
    solution = dd.check_plan(slide(), *error(*of_slide()))
    assert solution.status is dd.Status.CONVERGED_NOT_VERIFIED
    assert what in {c.what for c in solution.checks.failing}


def test_a_bound_that_a_plan_breaks_is_named():
    problem = replace(slide(), bounds=dd.Bounds(u_lower=[-5], u_upper=[5]))
    solution = dd.check_plan(problem, *of_slide())
    assert not solution.success
    assert "u0 is 1 beyond its bound" in solution.message


def test_a_plan_of_drake_is_continuous_and_costs_its_integral(in_drake):
    solution = dd.check_plan(pendulum(), *in_drake)
    assert solution.success
    assert solution.plant == "continuous"
    # Drake's input is linear between its breaks: Simpson's rule of its square is exact.
    exact = 0.0
    for a, b in pairwise(in_drake[1].get_segment_times()):
        first, middle, last = (in_drake[1].value(t)[0, 0] ** 2 for t in (a, (a + b) / 2, b))
        exact += (b - a) / 6 * (first + 4 * middle + last)
    assert solution.cost == pytest.approx(exact, rel=1e-9)


def test_breaks_between_the_problem_s_knots_are_kept(in_drake):
    """On the problem's 9 knots alone, the input would lose its corners."""
    solution = dd.check_plan(pendulum(8), *in_drake)
    assert solution.success
    assert len(solution.us) == 40
    assert np.allclose(solution.times, in_drake[0].get_segment_times(), atol=1e-12)


def test_the_same_plan_is_no_motion_of_the_model_s_steps(in_drake):
    solution = dd.check_plan(pendulum(), *in_drake, plant="steps")
    assert not solution.success
    assert "the motion does not follow the dynamics" in solution.message
    assert 'plant="continuous"' in solution.notes[0]


def test_a_plan_in_steps_is_verified_from_arrays_and_trajectories():
    problem = pendulum()
    plan = dd.solve(problem)
    for given in ((plan.xs, plan.us), plan.trajectory()):
        solution = dd.check_plan(problem, *given)
        assert solution.success
        assert solution.plant == "steps"
        assert solution.cost == plan.cost
    rounded = dd.check_plan(problem, np.round(plan.xs, 6), np.round(plan.us, 6))
    assert rounded.success
    assert not dd.check_plan(problem, np.round(plan.xs, 6), np.round(plan.us, 6), tolerance=1e-8).success


@pytest.mark.parametrize("size", [0.05, 0.3])
def test_random_errors_in_one_state_or_input_are_found(size):
    """Of a collocated plan and of a plan in steps; `size` is a part of the range; states have 0.005."""
    problem, random = pendulum(), np.random.default_rng(7)
    collocated, stepped = dd.solve(problem, method="collocation"), dd.solve(problem)
    plans = (("continuous", collocated.xs, collocated.inputs_at_knots), ("steps", stepped.xs, stepped.us))
    for plant, xs, us in plans:
        assert dd.check_plan(problem, xs, us, plant=plant).success
        for _ in range(5):
            wrong = xs.copy()
            k, i = random.integers(1, len(xs) - 1), random.integers(2)
            wrong[k, i] += size * np.ptp(xs[:, i])
            assert not dd.check_plan(problem, wrong, us, plant=plant).success
        if size > 0.1:
            for _ in range(5):
                wrong = us.copy()
                wrong[random.integers(len(us))] += size * np.ptp(us)
                assert not dd.check_plan(problem, xs, wrong, plant=plant).success


def test_contact_is_judged_in_steps():
    """A passive ball that falls on the ground: its own steps are a plan, and a fall through the ground is none."""
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.0005)
    x0, none = np.array(model.default_state), np.zeros((200, 0))
    x0[6] = 0.11  # the radius is 0.1
    problem = dd.Problem(model, x0=x0, num_steps=200, final_cost=dd.QuadraticCost(Q=np.eye(model.nx)))
    motion = dd.rollout(model, x0, none).xs
    assert dd.check_plan(problem, motion).plant == "steps"
    assert dd.check_plan(problem, motion).success
    falling = motion.copy()
    falling[-1, 6] -= 0.05
    assert "defect" in {c.what for c in dd.check_plan(problem, falling).checks.failing}
    with pytest.raises(dd.exceptions.InputError, match="no actuators"):
        dd.solve(problem)


def test_the_horizon_is_the_trajectory_s_if_it_is_free(in_drake):
    free = replace(pendulum(), horizon=(1.0, 3.0))
    solution = dd.check_plan(free, *in_drake)
    assert solution.success
    assert solution.horizon == pytest.approx(HORIZON)
    short = dd.check_plan(replace(free, horizon=(2.5, 3.0)), *in_drake)
    assert not short.success
    assert "horizon" in {c.where.split(" at ")[0] for c in short.checks.failing}


def test_a_checked_plan_is_saved_and_verified(tmp_path, in_drake):
    record = dd.save(dd.check_plan(pendulum(), *in_drake), tmp_path / "run")
    assert record.verdict == "pass"
    assert record.solver.method == "check_plan"
    assert dd.verify(tmp_path / "run").verdict == "holds"
    assert "a given plan, without a search" in (tmp_path / "run" / "report.html").read_text()
    failing = dd.save(dd.check_plan(pendulum(), *in_drake, plant="steps"), tmp_path / "steps")
    assert failing.verdict == "fail"
    assert dd.verify(tmp_path / "steps").verdict == "holds"


def test_what_is_no_plan_is_refused_by_name(in_drake):
    xs, us = of_slide()
    with pytest.raises(dd.exceptions.InputError, match=r'plant: expected "continuous"'):
        dd.check_plan(slide(), xs, us[:4], plant="steps")
    with pytest.raises(dd.exceptions.InputError, match=r"us: expected shape \(5, 1\) at the knots"):
        dd.check_plan(slide(), xs, us[:4])
    with pytest.raises(dd.exceptions.InputError, match=r"two arrays, or two Drake trajectories"):
        dd.check_plan(pendulum(), in_drake[0], us)
    with pytest.raises(dd.exceptions.InputError, match=r"expected 1 s: 20 steps of 0.05 s, got 2 s long"):
        dd.check_plan(replace(pendulum(), num_steps=20), *in_drake)
    with pytest.raises(dd.exceptions.UnknownNameError, match="plant"):
        dd.check_plan(slide(), xs, us, plant="step")
    with pytest.raises(dd.exceptions.InputError, match=r"at most 0\.01"):
        dd.check_plan(slide(), xs, us, tolerance=0.1)
    with pytest.raises(dd.exceptions.InputError, match="without phases"):
        dd.check_plan(dd.optimize.PhasedProblem([slide(), replace(slide(), x0=[1, 0])]), xs, us)


def test_a_plan_of_direct_transcription_is_judged_in_the_steps_of_its_system():
    """Drake's trajectories of a discrete system are in seconds, a `DiscreteMap` counts its steps."""
    period, count = 0.1, 20
    A, B = np.array([[1.0, period], [0.0, 1.0]]), np.array([[0.0], [period]])
    system = LinearSystem(A, B, np.eye(2), np.zeros((2, 1)), period)
    program = DirectTranscription(system, system.CreateDefaultContext(), count + 1)
    program.prog().AddBoundingBoxConstraint([0, 0], [0, 0], program.initial_state())
    program.prog().AddBoundingBoxConstraint([1, 0], [1, 0], program.final_state())
    program.AddRunningCost(program.input() @ program.input())
    result = Solve(program.prog())
    states, inputs = program.ReconstructStateTrajectory(result), program.ReconstructInputTrajectory(result)
    assert states.end_time() == pytest.approx(period * count)
    problem = dd.Problem(dd.Dynamics.from_system(system), x0=[0, 0], x_goal=[1, 0], num_steps=count)
    assert dd.check_plan(problem, states, inputs).success
    other = PiecewisePolynomial.ZeroOrderHold(
        inputs.get_segment_times(), 1.02 * inputs.vector_values(inputs.get_segment_times())
    )
    assert not dd.check_plan(problem, states, other).success
