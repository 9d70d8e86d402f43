"""The time limit of a solve applies to everything that the solve calls, and the result names what was not made.

The clock of these tests stands still unless a test advances it.
"""

import signal
import time

import numpy as np
import pytest
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base.clock import (
    Pace,
    StoppedError,
    TimeIsUpError,
    check_time,
    noted_interrupts,
    uncounted,
    until,
    until_set,
)
from drake_diff._base.compiled import time_compilations
from drake_diff.model import twin
from drake_diff.optimize import Options, run
from drake_diff.optimize.transcription import steps

STATUS = dd.Status.TIME_LIMIT
METHODS = [("collocation", None), ("shooting", None), ("ilqr", None)]


class Clock:
    def __init__(self):
        self.now = time.monotonic()  # the time that a solve in progress has read

    def __call__(self):
        return self.now


def stopped(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock)
    monkeypatch.setattr("drake_diff._base.clock._uncounted", 0.0)  # without compilations for other tests
    return clock


def swing():
    model = dd.example_model("pendulum", time_step=0.05)
    effort = dd.QuadraticCost(R=[[1.0]])
    return dd.Problem(model, x0=[0, 0], x_goal=[0.5, 0], num_steps=10, running_cost=effort)


def late(clock, function, *, from_call):
    """Return the function with calls that take a year, from the call with number `from_call` on."""
    calls = []

    def run_late(*arguments, **options):
        calls.append(1)
        if len(calls) >= from_call:
            clock.now += 3e7
        return function(*arguments, **options)

    return run_late


def test_time_that_is_up_is_up_for_all_that_is_called(monkeypatch):
    clock = stopped(monkeypatch)
    clock.now = 0.0
    check_time()
    with until(10.0), until(20.0):
        check_time(ahead=9.0)
        with pytest.raises(TimeIsUpError):
            check_time(ahead=11.0)  # the outer block ends first
        pace = Pace()
        clock.now = 9.5
        with pytest.raises(TimeIsUpError):  # one piece took 9.5 s, so that the next one may end after 10 s
            pace.go_on()
        clock.now = 10.5
        with pytest.raises(TimeIsUpError):
            dd.step(dd.example_model("pendulum"), [0, 0], [0])
    check_time()


@each_row("method, solver", METHODS)
def test_what_is_found_in_time_and_not_certified_is_not_called_verified(monkeypatch, method, solver):
    clock = stopped(monkeypatch)
    for name in ("certify_equations", "certify_steps"):
        monkeypatch.setattr(run, name, late(clock, getattr(run, name), from_call=2))
    found = dd.solve(swing(), method=method, options=Options(solver=solver), time_limit=10.0)
    assert found.status is STATUS
    assert "not made within the time limit: certificates of the result, replays and other measures" in repr(found)
    assert found.goal_error < 1e-5  # the motion is the one that was found
    assert len(found.certificates) == 3  # the certificates of the guess


@each_row(
    "method, place",
    [
        ("collocation", "drake_diff.mechanics.casadi_tree._regrouped"),
        ("shooting", "drake_diff.optimize.run.first_knots"),
        ("ilqr", "drake_diff.optimize.run.first_knots"),
    ],
)
def test_a_limit_that_comes_before_the_search_leaves_the_guess(monkeypatch, method, place):
    clock = stopped(monkeypatch)
    module, name = place.rsplit(".", 1)
    function = getattr(__import__(module, fromlist=[name]), name)
    monkeypatch.setattr(place, late(clock, function, from_call=1))
    found = dd.solve(swing(), method=method, time_limit=10.0)
    assert found.status is STATUS
    assert "certificates of the guess, the search, certificates of the result" in repr(found)
    assert np.array_equal(found.xs[0], [0, 0])
    assert not found.certificates
    assert np.isfinite(found.cost)


def test_no_other_method_is_begun_after_the_limit(monkeypatch):
    """Other methods follow a plan that is not verified, if there is time."""
    problem, clock = swing(), stopped(monkeypatch)

    def unverified(self, search, guess, begin):
        found = search()
        clock.now += 11.0
        return found.told(status=dd.Status.CONVERGED_NOT_VERIFIED)

    monkeypatch.setattr(run.Run, "within_time", lambda *of: unverified(*of))
    monkeypatch.setattr(run.Run, "_reach", lambda *_: None)
    found = dd.solve(problem, time_limit=10.0)
    assert found.status is dd.Status.CONVERGED_NOT_VERIFIED
    ended = [link["ended"] for link in found.options["chain"]]  # of collocation, shooting from its plan, and iLQR
    assert ended == ["converged_not_verified", "converged_not_verified", "not begun: time limit"]


def test_no_iteration_is_begun_that_would_end_after_the_limit(monkeypatch):
    """A derivative with respect to thousands of variables takes seconds and cannot be interrupted."""
    clock, real, each = stopped(monkeypatch), steps.StepProgram.hessian, 3.0

    def slow(self, *at):
        clock.now += each
        return real(self, *at)

    monkeypatch.setattr(steps.StepProgram, "hessian", slow)
    begun = clock.now
    found = dd.solve(swing(), method="shooting", time_limit=10.0, options=Options(tolerance=1e-14))
    assert found.status is STATUS
    assert each < clock.now - begun <= 10.0  # a fourth evaluation would end after 12 s


@each_row("method, solver", METHODS[1:])
def test_a_signal_in_the_middle_of_an_evaluation_ends_it(monkeypatch, method, solver):
    """The solve does not wait for the next iteration, which may take seconds. It only rolls out the best point."""
    calls, plans, signalled = [], [], 110  # in the search, after the certificates of the guess

    def counted():
        calls.append(1)
        if len(calls) == signalled:
            signal.raise_signal(signal.SIGINT)
        check_time()

    monkeypatch.setattr(twin, "check_time", counted)

    def on_plan(plan):
        plans.append((plan.status, len(calls) - signalled))

    found = dd.solve(swing(), method=method, options=Options(solver=solver, tolerance=1e-14, on_plan=on_plan))
    assert found.status is dd.Status.INTERRUPTED
    ((status, after),) = plans
    assert status is dd.Status.INTERRUPTED
    assert after <= 2 * found.problem.num_steps + 10


def test_a_signal_ends_a_compilation_at_once():
    """Numba's own code is on the stack while it compiles, for seconds in which it checks no flag."""
    numba_s = {"__name__": "numba.core.compiler", "signal": signal}
    exec("def compile_it(): signal.raise_signal(signal.SIGINT)", numba_s)
    with noted_interrupts() as flag:
        with until_set(flag), pytest.raises(StoppedError):
            numba_s["compile_it"]()
        flag.clear()
        numba_s["compile_it"]()  # outside a search the signal is only noted
        assert flag.is_set()


@pytest.mark.solve
@each_row("method, solver", METHODS)
def test_what_numba_compiles_is_told_and_no_limit_counts_it(monkeypatch, method, solver):
    """A compilation takes a year by the clock, and the whole limit of 10 s is left for the search."""
    import numba

    clock, lines, problem = stopped(monkeypatch), [], swing()
    monkeypatch.setattr("drake_diff._base.clock._uncounted", 0.0)  # restored at the end
    time_compilations()
    before = uncounted()
    numba.njit(lambda x: 2 * x)(1.0)
    assert uncounted() == before  # the clock of the test stands still

    def compiling(*arguments, **options):
        with numba.core.event.trigger_event("numba:compile"), numba.core.event.trigger_event("numba:compile"):
            clock.now += 3e7
        return real(*arguments, **options)

    name = "certify_equations" if method == "collocation" else "certify_steps"
    real = getattr(run, name)
    monkeypatch.setattr(run, name, compiling)
    found = dd.solve(problem, method=method, options=Options(solver=solver), time_limit=10.0, progress=lines.append)
    assert found.success
    assert uncounted() - before == pytest.approx(6e7)  # for the certificates of the guess and of the result
    assert lines[-1] == "Numba compiled for 6e+07 s, once on this machine, which no time limit counts"
    monkeypatch.setattr(run, "judged", late(clock, run.judged, from_call=1))
    found = dd.solve(problem, method=method, options=Options(solver=solver), time_limit=10.0)
    assert found.status is STATUS
    assert found.notes[-1] == lines[-1]
