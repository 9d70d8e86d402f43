"""Tests of models, problems, solutions and errors in other processes."""

import copy
import inspect
import multiprocessing
import pickle

import numpy as np
import pytest
from helpers.plants import pd_pendulum
from helpers.table import each_row

import drake_diff as dd
from drake_diff import exceptions
from drake_diff.exceptions import InputError, ModelError, NonFiniteError, ShapeError, UnknownNameError
from drake_diff.model.contact import SoftContact, softened

pytestmark = pytest.mark.solve

SECONDS = 120  # time limit of a pool that would wait forever
GIVEN = {
    InputError: [
        InputError("x", got=3, expected="4"),
        InputError("f", got=lambda: 0, expected="a value that can be pickled"),
        InputError("f", got=[open], expected="a name that is a module's"),
    ],
    ShapeError: [ShapeError("x", got=(3,), expected=("N", 4))],
    NonFiniteError: [NonFiniteError("x", index=(2,), got=float("nan"))],
    UnknownNameError: [UnknownNameError("joint", got="elbo", known=("elbow", "wrist"))],
}
KINDS = [
    kind
    for _, kind in inspect.getmembers(exceptions, inspect.isclass)
    if issubclass(kind, (exceptions.DrakeDiffError, Warning))
]
ERRORS = [error for kind in KINDS for error in (GIVEN.get(kind) or [kind("what went wrong")])]


def raised(error):
    raise error


def stepped(model, problem, solution):
    """Return a step, a solution and a cost from a worker, and the three arguments."""
    x, u = np.full(model.nx, 0.1), np.full(model.nu, 0.2)
    again = dd.solve(problem, method="ilqr")
    return dd.step(model, x, u), again.xs, solution.cost, (model, problem, solution)


@pytest.fixture(scope="module")
def pool():
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        yield pool


def same(found, error):
    assert type(found) is type(error)
    assert str(found) == str(error)
    if isinstance(error, InputError):
        assert (found.subject, found.expected) == (error.subject, error.expected)
        assert repr(found.got) == repr(error.got) or found.got == repr(error.got)


@each_row("error", ERRORS)
def test_every_error_pickles_and_copies(error):
    same(pickle.loads(pickle.dumps(error)), error)
    same(copy.copy(error), error)


def test_every_error_comes_out_of_a_pool_and_goes_into_it(pool):
    """An InputError in a worker formerly made `map` wait forever."""
    for error in ERRORS:
        with pytest.raises(type(error)) as found:
            pool.apply_async(raised, (error,)).get(timeout=SECONDS)
        same(found.value, error)


def swing(model, factor=2.0):
    """Return a problem with a function that closes over a number, which plain pickle rejects."""
    return dd.Problem(
        model,
        x0=[0, 0],
        x_goal=[0.5, 0],
        num_steps=10,
        running_cost=lambda x, u: factor * u[0] ** 2,
        constraints=dd.Constraint(lambda x: x[0], lower=-1, upper=1),
        parameters={"pole.mass": 1.5},
    )


def test_a_model_a_problem_and_a_solution_are_the_same_in_another_process(load, pool):
    model = load("pendulum.urdf").at_time_step(0.05).changed(gravity=[0, 0, -3.0])
    problem = swing(model)
    solution = dd.solve(problem, method="ilqr")
    assert solution.success
    end, xs, cost, back = pool.apply_async(stepped, (model, problem, solution)).get(timeout=SECONDS)
    assert np.array_equal(end, dd.step(model, np.full(2, 0.1), [0.2]))
    assert np.array_equal(xs, solution.xs)
    assert cost == solution.cost
    assert back[0].options == model.options
    assert repr(back[1]) == repr(problem)
    found = back[2]
    assert (found.status, found.message, found.options) == (solution.status, solution.message, solution.options)
    assert np.array_equal(found.us, solution.us)
    assert np.array_equal(found.replay.xs, solution.replay.xs)
    assert [str(c) for c in found.certificates] == [str(c) for c in solution.certificates]
    assert found.problem.parameters.model is found.problem.model


@each_row("method", ["collocation", "shooting"])
def test_solutions_of_plain_dynamics_and_in_phases_pickle(method):
    if method == "collocation":
        block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        way = {"num_steps": 5, "horizon": 0.5, "running_cost": dd.QuadraticCost(R=[[1.0]])}
        problem = dd.Problem(block, x0=[0, 0], **way)
        problem = dd.optimize.PhasedProblem([problem, dd.Problem(block, x0=[0.5, 0], x_goal=[1, 0], **way)])
    else:
        problem = swing(dd.example_model("pendulum", time_step=0.05))
    solution = dd.solve(problem, method=method)
    found = pickle.loads(pickle.dumps(solution))
    assert found.success
    assert found.cost == solution.cost


def test_what_cannot_be_made_again_is_refused_by_name(load, tmp_path):
    with pytest.raises(ModelError, match="cannot be pickled, as `load_model` did not load it from a file"):
        pickle.dumps(pd_pendulum())
    ball = load("sphere_on_ground.sdf")
    with pytest.raises(ModelError, match="cannot be pickled"):
        pickle.dumps(softened(ball, SoftContact(distance=0.05, stiffness=100.0)))
    handle = (tmp_path / "log").open("w")
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    problem = dd.Problem(block, x0=[0, 0], num_steps=2, horizon=1.0, final_cost=lambda x: (handle, x[0])[1])
    with (
        handle,
        pytest.raises(InputError, match=r"Problem.final_cost: expected a value that can be pickled, got <function"),
    ):
        pickle.dumps(problem)


def test_a_model_whose_file_has_changed_since_is_refused(write_urdf):
    model = write_urdf(mass=1.0)
    data = pickle.dumps(model)
    assert pickle.loads(data).nx == 2
    write_urdf(mass=2.0)
    with pytest.raises(ModelError, match="which has changed"):
        pickle.loads(data)
    model.source.unlink()
    with pytest.raises(ModelError, match="which does not exist"):
        pickle.loads(data)
