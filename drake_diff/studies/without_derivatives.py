"""What a search without derivatives makes of a problem, to be set beside `solve` at the same price."""

import numpy as np
from scipy.optimize import differential_evolution

from drake_diff._base.arrays import Array, frozen, positive_float, positive_int
from drake_diff.exceptions import InputError, SimulationError
from drake_diff.model.counted import count_steps
from drake_diff.optimize.judge import judged
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import NlpResult, Outcome
from drake_diff.optimize.shooting import ShootingVariables
from drake_diff.optimize.solution import Solution, Status

POPULATION = 5  # candidates for each number: so few that a small budget has many generations
NO_MOTION = 1e10  # what a motion costs that cannot be simulated


def without_derivatives(
    problem: Problem, steps: int, *, knots: int = 10, price: float = 100.0, seed: int = 0
) -> Solution:
    """Search `problem` by differential evolution, which takes values alone, for as many steps as another search took.

    It moves what `solve` would, but of each input only the values at some knots, with lines in between: such a search
    finds few numbers better than many. Goals and limits are prices. `dd.model.count_steps` tells what a search took.

    Args:
        problem: Of a model, without a horizon of its own.
        steps: How many steps it may simulate; the generation in which it comes to them is the last.
        knots: At how many times each input is chosen, the first and the last among them.
        price: What is added to the cost for the square of each unit by which a goal, bound or constraint is not kept.
        seed: Of its random numbers.

    Returns:
        A `Solution`, measured and judged as one of `solve` is. A search of values knows no optimum: it is a success
        only where our own measures find that it has come to one.

    Raises:
        InputError: The problem is of plain dynamics, has a horizon, or an input or a parameter without bounds on both
            sides, which the search draws from; or a number is not as said.

    Source:
        Storn and Price, "Differential evolution", Journal of Global Optimization 11, 1997, as SciPy has it.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> effort, limits = dd.QuadraticCost(R=[[1.0]]), {"motor": (-5, 5)}
        >>> problem = dd.Problem(
        ...     model, x0=[0, 0], x_goal=[0.5, 0], num_steps=20, running_cost=effort, bounds=limits
        ... )
        >>> dd.studies.without_derivatives(problem, 2000, knots=4).success
        False
    """
    budget = positive_int("steps", steps)
    if not problem.has_model or problem.horizon is not None:
        got = "a horizon" if problem.has_model else "plain dynamics"
        raise InputError("problem", got=got, expected="one of a model's own steps")
    weight, few = positive_float("price", price), _Few(problem, positive_int("knots", knots))
    variables = few.variables
    lower, upper = (few.taken(side) for side in variables.limits())
    first, moves = few.taken(variables.pack(problem.x0, problem.us)), upper > lower
    if not np.all(np.isfinite(upper - lower)):
        raise InputError("bounds", got="none of some number that moves", expected="lower and upper ones of all")
    scale = (upper - lower)[moves]

    def whole(moved: Array) -> Array:
        y = first.copy()
        y[moves] = moved * scale
        return np.clip(few.spread(y), *variables.limits())

    def cost(moved: Array) -> float:
        try:
            return _cost(variables, whole(moved), weight)
        except SimulationError:
            return NO_MOTION

    with count_steps() as taken:
        found = differential_evolution(
            cost,
            np.transpose([lower[moves] / scale, upper[moves] / scale]),
            x0=first[moves] / scale,
            popsize=POPULATION,
            maxiter=budget,
            tol=0.0,  # to the end of its budget
            polish=False,
            rng=seed,
            callback=lambda *_, **__: taken.steps >= budget,
        )
    z = whole(found.x)
    values, us = variables.parameters(z).values, frozen(variables.unpack(z)[1])
    parameters = frozen(np.array(problem.design.own(values)))
    xs = frozen(variables.states(z))
    draft = Solution(problem, "shooting", "differential evolution", Status.FAILED, "", xs, us, parameters=parameters)
    return judged(draft, NlpResult(z, Outcome.ITERATION_LIMIT, f"differential evolution, {found.nit} generations", ()))


class _Few:
    """Shooting variables z by fewer numbers y: each input at some knots, with lines in between."""

    def __init__(self, problem: Problem, knots: int):
        self.variables = ShootingVariables(problem)
        steps, self._inputs = problem.num_steps, self.variables.inputs
        at = np.linspace(0, steps - 1, min(knots, steps))
        self._rows = np.round(at).astype(int)
        self._weights = np.array([np.interp(np.arange(steps), at, one) for one in np.eye(len(at))]).T

    def taken(self, z: Array) -> Array:
        """y, of which z has the values at the knots."""
        before, inputs, after = np.split(z, [self._inputs.start, self._inputs.stop])
        chosen = inputs.reshape(self.variables.shape)[self._rows].ravel() if len(inputs) else inputs
        return np.concatenate([before, chosen, after])

    def spread(self, y: Array) -> Array:
        """z."""
        size = len(self._rows) * self.variables.shape[1] if self._inputs.stop > self._inputs.start else 0
        before, chosen, after = np.split(y, [self._inputs.start, self._inputs.start + size])
        inputs = self._weights @ chosen.reshape(len(self._rows), -1) if size else chosen
        return np.concatenate([before, inputs.ravel(), after])


def _cost(variables: ShootingVariables, z: Array, price: float) -> float:
    """The cost of z, and the price of all that its motion does not keep."""
    problem, xs, us = variables.problem, variables.states(z), variables.unpack(z)[1]
    lower, upper = problem.state_limits()  # waypoints and the goal among them
    beyond = np.max(np.maximum(np.maximum(lower - xs, xs - upper), 0.0), axis=0)
    broken = float(beyond @ beyond) + sum(
        max(0.0, excess) ** 2 for excess, _ in problem.constraint_excess(xs, us).values()
    )
    own = np.array(problem.design.own(variables.parameters(z).values))
    return problem.objective(xs, us) + problem.cost_of_parameters(own) + price * broken
