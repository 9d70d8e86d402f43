"""Tests of SNOPT on a program of Drake: outcomes, limits, Ctrl-C, its table of iterations, and the watch."""

import math
import signal
import threading

import numpy as np
import pytest
from helpers.table import each_row
from pydrake.solvers import MathematicalProgram, SnoptSolver

from drake_diff.exceptions import GradientError, MissingDependencyError, SimulationError
from drake_diff.optimize.program import Limits, Outcome, Report, Watch
from drake_diff.optimize.transcription.drake import _snopt_rows, _solve_snopt

UNLIMITED = Limits(max_iterations=500, time_limit=math.inf, tolerance=1e-8)


def program(cost, *, constraint=None, lower=0.0, upper=0.0):
    p = MathematicalProgram()
    z = p.NewContinuousVariables(2, "z")
    p.AddCost(cost, vars=z)
    if constraint is not None:
        p.AddConstraint(lambda z: np.array([constraint(z)]), [lower], [upper], vars=z)
    return p


def bowl(z):
    return (z[0] - 1) ** 2 + (z[1] + 2) ** 2 + (z[0] - 1) ** 4


def rosenbrock(z):
    return 100 * (z[1] - z[0] ** 2) ** 2 + (1 - z[0]) ** 2


def flat_bowl(z):
    """Return a cost with a minimum of fourth order, where a tolerance of 1e-30 is never met."""
    return (z[0] - 1) ** 4 + (z[1] + 2) ** 4


def run(p, *, guess=(0.0, 0.0), limits=UNLIMITED, report=None):
    return _solve_snopt(p, np.array(guess), limits, Report(report), lambda z: ())


def test_a_minimum_on_a_circle_is_found():
    """The minimum of -x - y on x^2 + y^2 = 2 is at (1, 1)."""
    p = program(lambda z: -z[0] - z[1], constraint=lambda z: z[0] ** 2 + z[1] ** 2, lower=2, upper=2)
    result = run(p, guess=(1.5, 0.5))
    assert result.outcome is Outcome.SOLVED, result.message
    assert result.z == pytest.approx([1, 1], abs=1e-6)


def test_constraints_that_no_point_meets_are_infeasible():
    p = program(lambda z: z @ z, constraint=lambda z: z[0] ** 2 + z[1] ** 2, lower=-5, upper=-1)
    result = run(p, guess=(1.0, 1.0))
    assert result.outcome is Outcome.INFEASIBLE
    assert result.message


def test_snopt_says_that_a_cost_has_no_bottom():
    p = program(lambda z: -z[0], constraint=lambda z: z[0] - z[1] ** 2, lower=0, upper=np.inf)
    assert run(p, guess=(1.0, 1.0)).outcome is Outcome.UNBOUNDED


def test_a_solver_that_stops_short_of_its_tolerance_is_inaccurate():
    result = run(program(flat_bowl), limits=Limits(500, math.inf, 1e-30))
    assert result.outcome is Outcome.INACCURATE, result.message


def test_the_time_limit_ends_it_at_the_best_point_so_far():
    result = run(program(rosenbrock), guess=(-1.2, 1.0), limits=Limits(500, 1e-6, 1e-8))
    assert result.outcome is Outcome.TIME_LIMIT
    assert rosenbrock(result.z) <= rosenbrock(np.array([-1.2, 1.0]))


def test_the_best_point_is_a_feasible_one_where_there_is_one(monkeypatch):
    """Interrupt after a few evaluations. The guess is feasible, and no infeasible point may win by its lower cost."""
    monkeypatch.setattr("drake_diff.optimize.program.REPORT_PERIOD", 0.0)
    p = program(lambda z: z[0] + z[1], constraint=lambda z: z[0] ** 2 + z[1] ** 2, lower=2, upper=2)
    lines = []

    def report(line):
        lines.append(line)
        if len(lines) == 3:
            signal.raise_signal(signal.SIGINT)

    result = run(p, guess=(math.sqrt(2), 0.0), report=report)
    assert result.outcome is Outcome.INTERRUPTED
    assert result.z @ result.z == pytest.approx(2, abs=1e-6)
    assert result.z.sum() <= math.sqrt(2) + 1e-6


def test_a_solve_works_outside_the_main_thread():
    """A signal handler can be set only in the main thread."""
    found = []
    thread = threading.Thread(target=lambda: found.append(run(program(bowl))))
    thread.start()
    thread.join()
    assert found[0].outcome is Outcome.SOLVED
    assert found[0].z == pytest.approx([1, -2], abs=1e-6)


@each_row(
    "error, outcome",
    [(SimulationError, Outcome.DIVERGED), (GradientError, Outcome.NO_GRADIENT)],
)
def test_a_refusal_inside_the_callback_is_told_in_its_own_words(error, outcome):
    def cost(z):
        raise error("the ground opened")

    result = run(program(cost), guess=(3.0, 4.0))
    assert result.outcome is outcome
    assert "the ground opened" in repr(result)
    assert "Traceback" not in result.message
    assert result.z.tolist() == [3.0, 4.0]


def test_the_table_is_read():
    rows = run(program(rosenbrock), guess=(-1.2, 1.0)).iterations
    assert len(rows) >= 3
    assert rows[0].objective == pytest.approx(24.2, rel=1e-6)  # 100 (1 - 1.44)^2 + 2.2^2
    assert rows[-1].objective < 1e-8
    assert all(math.isfinite(row.objective) for row in rows)
    numbers = [row.iteration for row in rows]
    assert numbers == sorted(set(numbers))


SNOPT_TABLE = """
   Itns Major Minors    Step   nCon Feasible  Optimal  MeritFunction     L+U BSwap     nS condZHZ Penalty
     38     0     38              1  7.1E+00  2.0E+00  4.9503550E+07     572                              _  r i
     57     1     19 5.0E-02      2 (6.7E-09) 1.9E+01  4.6700506E+07     566           15 3.3E+00         _  rl
    101     2     44 1.0E+00      3 (1.0E-10)(2.0E-09)-4.6700506E+01     566     2     14 3.3E+00 1.0E-02 _
"""


def test_snopts_rows_are_read_where_their_columns_stand():
    """The first row leaves Step blank. Brackets mark values within tolerance."""
    rows = list(_snopt_rows(SNOPT_TABLE.splitlines()))
    assert [(r.iteration, r.objective, r.primal_infeasibility, r.dual_infeasibility) for r in rows] == [
        (0, 4.9503550e7, 7.1, 2.0),
        (1, 4.6700506e7, 6.7e-9, 19.0),
        (2, -46.700506, 1e-10, 2e-9),
    ]
    assert math.isnan(rows[0].step)
    assert [row.step for row in rows[1:]] == [0.05, 1.0]


def test_a_drake_without_snopt_is_named(monkeypatch):
    monkeypatch.setattr(SnoptSolver, "available", lambda self: False)
    with pytest.raises(MissingDependencyError, match="this build of Drake has no SNOPT"):
        run(program(bowl))


def watch(time_limit=math.inf):
    return Watch(Limits(500, time_limit, 1e-8), threading.Event())


def test_the_best_iterate_is_feasible_first_and_cheap_second():
    """cost + 1e6 * (violation - 1e-8) is 5, then 1 + 1e6 (1e-3 - 1e-8), then 4, then 4.5."""
    seen, z = watch(), np.zeros(1)
    for i, (cost, violation) in enumerate([(5.0, 0.0), (1.0, 1e-3), (4.0, 1e-8), (4.5, 0.0)]):
        z[0] = i
        seen.offer(z, cost, violation)
    assert seen.best_of(np.array([9.0])).tolist() == [2.0]  # a copy, as z itself has changed
    seen.offer(np.array([7.0]), math.nan, 0.0)
    assert seen.best_of(np.array([9.0])).tolist() == [2.0]


def test_the_clock_and_ctrl_c_end_a_solve_and_the_end_is_reported(monkeypatch):
    going, late, interrupted = watch(), watch(time_limit=0.0), watch()
    interrupted.interrupted.set()
    assert [w.look_up() for w in (going, late, interrupted)] == [False, True, True]
    assert [w.stopped_by for w in (going, late, interrupted)] == [None, Outcome.TIME_LIMIT, Outcome.INTERRUPTED]
    monkeypatch.setattr("drake_diff.optimize.program.REPORT_PERIOD", 0.0)
    assert going.look_up()
    assert going.stopped_by is None
