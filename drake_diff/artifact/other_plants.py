"""A solution followed in plants that had no part in it, other simulators included: evidence for its record."""

import math
from collections.abc import Sequence

import numpy as np

from drake_diff.engines.contract_line import is_another_model
from drake_diff.engines.contract_match import match_contracts
from drake_diff.engines.drake import DrakeEngine
from drake_diff.engines.interface import Engine
from drake_diff.engines.load import load_engine
from drake_diff.exceptions import InputError, MissingDependencyError, ModelError
from drake_diff.model.parameters import select
from drake_diff.optimize.elsewhere import LONGEST, Elsewhere, Followed, Follower, followed_in_drake
from drake_diff.optimize.solution import Solution

SIMULATORS = ("mujoco",)
NOT_INSTALLED = "it is not installed: "  # the failure of a simulator, begins so


def elsewhere(solution: Solution, engines: Sequence[str] = SIMULATORS) -> Solution:
    """Follow a solution by its own feedback in other plants, and tell where it holds and where it leaves its plan.

    The plants are Drake's in steps of h, h/2 and h/4, h being the solution's own, the motion in continuous time that
    these stand for, integrated with error control (or Drake's in steps of 0.1 ms where there is none), and other
    simulators in steps of 1 ms or less, their contacts matched to Drake's. Everywhere TVLQR with the gains of the
    solution's own steps follows it, a command being held for h; where that does not hold, the inputs alone are tried.

    What is asked is what replays are asked; in another simulator all tolerances but obstacles' are twice as wide. It is
    evidence only: whether a solution is a success rests on its replays. Nothing of this runs unless it is asked for.

    Args:
        solution: A result of `solve` for a model, of any status.
        engines: Names of simulators for `engines.load_engine`. One that is not installed or cannot have the model is
            told as not measured.

    Returns:
        The same solution with its `elsewhere`, which it prints; `save` writes it, and `verify` measures it again.

    Raises:
        InputError: The solution has no model, or is one in phases.
        UnknownNameError: There is no such simulator.

    Example:
        >>> from drake_diff.artifact import elsewhere
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.02)
        >>> effort = dd.QuadraticCost(R=[[1.0]])
        >>> problem = dd.Problem(model, x0=[0, 0], x_goal=[0.5, 0], num_steps=25, running_cost=effort)
        >>> found = elsewhere(dd.solve(problem, method="ilqr"), engines=())
        >>> print(found.elsewhere)
        followed at its own rate of 0.02 s, it holds under TVLQR in steps of 0.02 s, ... and in continuous time
    """
    if not isinstance(solution, Solution) or not solution.problem.has_model:
        got = f"{type(solution).__name__} of plain dynamics" if isinstance(solution, Solution) else type(solution)
        raise InputError("solution", got=got, expected="the Solution of a problem with a model")
    found = solution.replays if solution.transcribed is not None else ()
    rows = followed_in_drake(solution.plan, found)
    follower = Follower(solution.plan, found)
    rows = (*rows, *(_in_simulator(follower, name) for name in engines))
    return solution.told(elsewhere=Elsewhere(rows, tuple(engines), follower.period))


def _in_simulator(follower: Follower, name: str) -> Followed:
    plan, parts = follower.plan, max(1, math.ceil(follower.period / LONGEST - 1e-9))
    try:
        if not np.array_equal(plan.vector.values, select(plan.problem.model, plan.vector.names).values):
            raise ModelError("another simulator is given the model's own parameters, and the plan has others")
        if name == "mujoco":  # which takes any step of a model that Drake has at one alone
            return followed_in(follower, load_engine(name, plan.problem.model, time_step=follower.period / parts))
        return followed_in(follower, load_engine(name, plan.problem.model.at_time_step(follower.period / parts)))
    except MissingDependencyError as error:
        return follower.missing(name, f"{NOT_INSTALLED}{error}")
    except ModelError as error:
        return follower.missing(name, str(error))


def followed_in(follower: Follower, engine: Engine) -> Followed:
    """A plan in a simulator of one's own; what its contract has otherwise than Drake's is told, and does not hold."""
    model = follower.plan.problem.model
    touch = bool(model.contract.contact.collision_pairs)
    lines = [line for line in match_contracts(DrakeEngine(model), engine) if line.verdict == "different"]
    wrong = [line for line in lines if is_another_model(line, touch)]
    unlike = tuple(f"{line.quantity}: {line.detail}" for line in wrong if line.quantity != "time step")
    told = f"{engine.name} {engine.version}"
    return follower.in_engine(engine.name, told, engine.step, engine.contract.time_step, unlike)
