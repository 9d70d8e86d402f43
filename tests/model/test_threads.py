"""Tests of threads: a model in several threads gives the numbers of one thread, or raises a named error."""

import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import drake_diff as dd
from drake_diff.exceptions import ModelError
from drake_diff.model.step import advance
from drake_diff.optimize import Options

pytestmark = pytest.mark.solve

SOLVES = (("collocation", None), ("shooting", None), ("ilqr", None))


@pytest.fixture(autouse=True)
def switch_often():
    """Switch threads almost at every instruction. By default, Python lets a thread run for 5 ms, about 200 steps."""
    former = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(former)


def together(*calls):
    """Return the results of the calls, which run at once in a thread each."""
    start = threading.Barrier(len(calls))

    def run(call):
        start.wait()
        return call()

    with ThreadPoolExecutor(len(calls)) as pool:
        return [future.result() for future in [pool.submit(run, call) for call in calls]]


def elsewhere(call):
    """Return the result of the call, which runs in another thread."""
    return together(call)[0]


def test_two_threads_step_and_differentiate_one_model_as_one_thread_does(load):
    """When threads shared a context, 10 of 2 * 1,500 steps were wrong without an error."""
    model, random = load("cart_pole.urdf"), np.random.default_rng(0)
    points = random.standard_normal((2, 1500, 5))

    def run(of):
        steps = [dd.step(model, z[:4], z[4:]) for z in of]
        heavy = [dd.step(model, z[:4], z[4:], parameters={"pole.mass": 1 + z[0] ** 2}) for z in of[:300]]
        slopes = [
            dd.differentiate_step(model, z[:4], z[4:], parameters=["cart.mass"], method="autodiff").C for z in of[:60]
        ]
        return np.array(steps), np.array(heavy), np.array(slopes)

    alone = [run(of) for of in points]
    for found, right in zip(together(*(lambda of=of: run(of) for of in points)), alone, strict=True):
        for a, b in zip(found, right, strict=True):
            assert np.array_equal(a, b)
    assert not np.array_equal(alone[0][0], alone[1][0])  # the two threads have different results


def test_threads_with_a_model_each_solve_as_one_thread_does():
    def solve(method, solver):
        model = dd.example_model("pendulum", time_step=0.05)
        cost = dd.QuadraticCost(R=[[1.0]])
        problem = dd.Problem(model, x0=[0, 0], x_goal=[0.5, 0], num_steps=12, running_cost=cost)
        found = dd.solve(problem, method=method, options=Options(solver=solver))
        assert found.success
        return found.xs, found.us, found.cost, found.message

    calls = [lambda of=of: solve(*of) for of in SOLVES]
    alone = [call() for call in calls]
    for found, right in zip(together(*calls), alone, strict=True):
        assert np.array_equal(found[0], right[0])
        assert np.array_equal(found[1], right[1])
        assert found[2:] == right[2:]


def test_what_drake_keeps_in_the_plant_is_not_set_while_another_thread_uses_the_model(load):
    parameters = {"model.gravity": [0, 0, -1.62]}
    model, x, go_on, begun = load("pendulum.urdf"), [0.3, 0.0], threading.Event(), threading.Event()

    def use():
        dd.step(model, x, [0.0])
        begun.set()
        go_on.wait(10)

    with ThreadPoolExecutor(1) as pool:
        user = pool.submit(use)
        assert begun.wait(10)
        with pytest.raises(
            ModelError, match=r"another thread \(ThreadPool\S+\) uses this model: no thread can set model.gravity"
        ):
            dd.step(model, x, [0.0], parameters=parameters)
        go_on.set()
        user.result()
    light = dd.step(model, x, [0.0], parameters=parameters)  # that thread has ended
    assert abs(light[1]) < 0.2 * abs(dd.step(model, x, [0.0])[1])  # 1.62 / 9.81 = 0.165


def test_no_thread_begins_to_use_a_model_whose_plant_another_one_has_changed(load):
    model = load("pendulum.urdf")
    with dd.model.parameters.applied(dd.model.parameters.select(model, {"model.gravity": [0, 0, -1.62]})):
        with pytest.raises(
            ModelError, match=r"another thread \(MainThread\) has set model.gravity of this model.*a separate model"
        ):
            elsewhere(lambda: dd.step(model, [0.3, 0.0], [0.0]))
        assert dd.step(model, [0.3, 0.0], [0.0]).shape == (2,)
    assert elsewhere(lambda: dd.step(model, [0.3, 0.0], [0.0])).shape == (2,)


def test_one_threads_context_is_refused_in_another(load):
    model = load("pendulum.urdf")
    twin, x, u = model.double, np.zeros(2), np.zeros(1)
    assert elsewhere(lambda: advance(model.double, x, u)) == pytest.approx(advance(twin, x, u), abs=0)
    with pytest.raises(ModelError, match="of one thread is used in another thread"):
        elsewhere(lambda: advance(twin, x, u))


def test_a_model_that_is_changed_in_two_threads_is_built_once(load):
    model = load("pendulum.urdf")
    a, b = together(*2 * [lambda: model.at_time_step(0.001)])
    assert a is b is model.at_time_step(0.001)
