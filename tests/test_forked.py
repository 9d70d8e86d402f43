"""Work in a forked process is ended at the limit or by a signal, in the middle of a call that hears nothing."""

import math
import os
import signal
import threading

import numpy as np
import pytest
from helpers.table import each_row
from pydrake.solvers import MathematicalProgram

import drake_diff as dd
from drake_diff._base import forked as base
from drake_diff._base.clock import now
from drake_diff._base.forked import can_fork, forked
from drake_diff.exceptions import InputError
from drake_diff.model import count_steps
from drake_diff.optimize import drake_program
from drake_diff.optimize.drake_program import solve_program
from drake_diff.optimize.program import Limits, Outcome, Report

SOLVERS = ("ipopt", "snopt")


def deaf(*_):
    """As a call into a library in C: a signal is noted, and it goes on."""
    while True:
        pass


@pytest.fixture(autouse=True)
def forks(monkeypatch):
    """The processes that are forked; at the end of a test none is left, not even to be waited for."""
    real, found = os.fork, []

    def fork():
        child = real()
        found.append(child)
        return child

    monkeypatch.setattr(os, "fork", fork)
    yield found
    for child in found:
        with pytest.raises(ProcessLookupError):
            os.kill(child, 0)


def run(work, heard=lambda value: None, seconds=60.0, flag=None):
    return forked(work, heard, flag or threading.Event(), now() + seconds)


def test_what_is_sent_returned_and_raised_comes_back():
    heard = []

    def work(send):
        for i in range(3):
            send(np.full(200_000, float(i)))  # more than a pipe holds
        return os.getpid()

    assert run(work, heard.append).returned != os.getpid()
    assert [each[-1] for each in heard] == [0, 1, 2]

    def refused(send):
        raise InputError("x0", got=1, expected=2)

    with pytest.raises(InputError, match="x0: expected 2"):
        run(refused)

    class Own(Exception):  # noqa: N818  (of a function: nothing pickles it)
        pass

    def failed(send):
        raise Own("mine")

    with pytest.raises(RuntimeError, match="Own: mine"):
        run(failed)
    assert run(lambda send: signal.raise_signal(signal.SIGKILL)).crashed == "SIGKILL"


def test_what_hears_nothing_is_ended(forks):
    assert run(deaf, seconds=0.1).stopped
    flag = threading.Event()

    def first(send):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a search, one that notes it
        send("begun")
        deaf()

    assert run(first, lambda _: flag.set(), flag=flag).stopped

    def refuse(_):
        raise KeyError("the caller's")

    with pytest.raises(KeyError):
        run(first, refuse)
    assert len(forks) == 3


def test_no_process_is_forked_beside_others_threads(monkeypatch):
    """Other tests of this process may have left threads, and may have loaded what breaks: those are not looked at."""
    until, main = threading.Event(), threading.main_thread()
    other = threading.Thread(target=until.wait)
    monkeypatch.setattr(base, "BREAK", ())
    monkeypatch.setattr(threading, "enumerate", lambda: [main, *([other] if other.is_alive() else [])])
    assert can_fork()
    other.start()
    assert not can_fork()
    until.set()
    other.join()
    assert can_fork()
    monkeypatch.setattr(base, "BREAK", ("numpy",))
    assert not can_fork()


def program(cost):
    p = MathematicalProgram()
    p.AddCost(cost, vars=p.NewContinuousVariables(2, "z"))
    return p


@each_row("solver, limit", [(solver, limit) for solver in SOLVERS for limit in (1.0, math.inf)])
def test_a_solver_that_hears_nothing_leaves_its_best_point(forks, monkeypatch, solver, limit):
    """The third evaluation never ends: the limit ends it, or a signal that comes while it runs."""
    monkeypatch.setattr(drake_program, "LARGE", 0)
    monkeypatch.setattr(drake_program, "can_fork", lambda: True)  # whatever other tests left in this process
    monkeypatch.setattr("drake_diff.optimize.program.REPORT_PERIOD", 0.0)
    own, calls, rows = os.getpid(), [], []

    def cost(z):
        calls.append(z.dtype == object)
        if sum(calls) > 2:
            if math.isinf(limit):
                os.kill(own, signal.SIGINT)
            deaf()
        return (z[0] - 1) ** 2 + (z[1] + 2) ** 4

    limits, report = Limits(max_iterations=500, time_limit=limit, tolerance=1e-12), Report(callback=rows.append)
    found = solve_program(program(cost), np.zeros(2), solver=solver, limits=limits, report=report)
    assert not calls
    assert found.outcome is (Outcome.INTERRUPTED if math.isinf(limit) else Outcome.TIME_LIMIT)
    assert "own work" in found.message
    assert rows
    assert np.all(np.isfinite(found.z))
    assert forks


@each_row("solver", SOLVERS)
def test_a_search_in_a_process_of_its_own_finds_the_same(monkeypatch, solver):
    model = dd.example_model("pendulum", time_step=0.05)
    problem = dd.Problem(
        model, x0=[0, 0], x_goal=[0.5, 0], num_steps=10, running_cost=dd.QuadraticCost(R=[[1.0]], Q=np.eye(2))
    )
    found, counts = [], []
    monkeypatch.setattr(drake_program, "can_fork", lambda: True)
    monkeypatch.setattr("drake_diff.optimize.program.REPORT_PERIOD", math.inf)  # progress evaluates some points again
    for large in (math.inf, 0):
        monkeypatch.setattr(drake_program, "LARGE", large)
        with count_steps() as count:
            found.append(dd.solve(problem, method="shooting", solver=solver))
        counts.append(count.steps)
    here, apart = found
    assert here.success
    assert np.array_equal(here.xs, apart.xs)
    assert len(here.iterations) == len(apart.iterations) > 0
    assert apart.message == here.message
    assert 0 <= counts[1] - counts[0] <= 10  # of which the last motion was not kept here: 10 steps again
