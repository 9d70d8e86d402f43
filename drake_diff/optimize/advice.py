"""What to try after a solve that is no success: nothing that it has just tried."""

from collections.abc import Iterator, Sequence
from typing import Any

from drake_diff.optimize.solution import Solution, Status


def advice(solution: Solution, arguments: dict[str, Any], other_methods: Sequence[str]) -> str:
    """A clause that says what to try; empty after a success or Ctrl-C.

    `arguments` are those of `solve`, `other_methods` those that take the problem and were not tried.
    """
    found = list(_remedies(solution, arguments, other_methods))
    return f"to try: {', or '.join(dict.fromkeys(found))}" if found else ""


def _remedies(solution: Solution, arguments: dict[str, Any], other_methods: Sequence[str]) -> Iterator[str]:
    status, problem = solution.status, solution.problem
    if status in (Status.CONVERGED, Status.INTERRUPTED):
        return
    touching = problem.has_model and problem.model.contract.contact.collision_pairs > 0
    if status is Status.NO_GRADIENT and touching and _may_continue(solution, other_methods):
        yield 'method="ilqr" with continuation="auto"'
    if status is Status.ITERATION_LIMIT:
        most = arguments["max_iterations"]
        if solution.options.get("max_iterations", most) < most:  # an attempt that was to find a guess
            yield f'method="{solution.method}", which then gets all {most} iterations'
        else:
            yield f"max_iterations above {most}"
    if status is Status.TIME_LIMIT:
        yield f"time_limit above {arguments['time_limit']:g} s"
    if status is Status.INFEASIBLE:
        yield "wider bounds or a longer horizon"
        yield from _nearer_goals(solution)
    if status is Status.DIVERGED:
        yield "a smaller time step"
    if status is not Status.NO_GRADIENT:
        yield from (f'method="{method}"' for method in other_methods)
    if status is Status.NO_GRADIENT and touching:
        yield "an initial_guess in which the bodies touch"
    else:
        yield "another initial_guess"


def _nearer_goals(solution: Solution) -> Iterator[str]:
    """The goals that the plan does not come near to."""
    for c in solution.problem.kept_goals:
        knots = solution.problem.knots_of(c, input_at_end=False)
        miss = max(c.miss(solution.xs[solution.knots[k]]) for k in knots)
        if not miss <= c.tolerance:
            yield f"a goal within reach ({c.told(miss)} here)"


def _may_continue(solution: Solution, other_methods: Sequence[str]) -> bool:
    """Whether iLQR takes the problem, and no attempt was a continuation."""
    chain = solution.options.get("chain", ())
    tried = "continuation" in solution.options or any("continuation" in link for link in chain)
    return not tried and (solution.method == "ilqr" or "ilqr" in other_methods)
