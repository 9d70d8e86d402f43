"""Write the problem, its solver and its gradient to a record, and rebuild the problem from a record.

A problem is stored as numbers and names, from which everything except a user's functions is rebuilt.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal
from drake_diff.exceptions import InputError
from drake_diff.mechanics.quantities import description_of, made_from
from drake_diff.model.model import Model
from drake_diff.model.parameters import select
from drake_diff.motion.rollout import STEPS
from drake_diff.optimize.problem.constraint import Bounds, Constraint
from drake_diff.optimize.problem.cost import ConstantCost, CostToGo, QuadraticCost, SumOfCosts, TrackingCost
from drake_diff.optimize.problem.coupling import Acceleration, InputRate, Jerk, Periodic
from drake_diff.optimize.problem.dynamics import units_of
from drake_diff.optimize.problem.fixed_contacts import QUANTITIES, FixedContacts, recorded_quantity
from drake_diff.optimize.problem.goals import (
    CenterOfMassGoal,
    Dwell,
    FrameGoal,
    FrameVelocityGoal,
    Goal,
    JointGoal,
    KeepLevel,
)
from drake_diff.optimize.problem.obstacles import BoxObstacle, SelfCollision, SphereObstacle
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.problem.schedule import ContactSchedule
from drake_diff.optimize.problem.terminal import TerminalSet
from drake_diff.optimize.solution import Solution
from drake_diff.runs.fields import (
    GradientColumn,
    GradientEvidence,
    Inputs,
    ParameterEvidence,
    Solver,
    evidence,
    finite,
    plain,
)
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.provenance import contract_of, gradient_evidence

COSTS = ("running_cost", "final_cost", "trajectory_cost", "parameter_cost")
LIMITS = ("x_lower", "x_upper", "u_lower", "u_upper")
MISSING = {"lower": -np.inf, "upper": np.inf}  # the meaning of null in a bound
GUESS = ("initial_guess", "initial_guess_sha256")
KINDS_OF_GOALS = (FrameGoal, FrameVelocityGoal, JointGoal, CenterOfMassGoal, KeepLevel, Dwell, TerminalSet)
KINDS_OF_OBSTACLES = (ContactSchedule, SphereObstacle, BoxObstacle, SelfCollision)
GOALS: dict[str, Any] = {kind.__name__: kind for kind in (*KINDS_OF_GOALS, *KINDS_OF_OBSTACLES)}
COUPLINGS: dict[str, Any] = {kind.__name__: kind for kind in (Periodic, InputRate, Acceleration, Jerk)}
# Costs with their attributes, which are also the arguments of their constructors.
KINDS_OF_COSTS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "ConstantCost": (ConstantCost, ("rate",)),
    "QuadraticCost": (QuadraticCost, ("Q", "R", "x_ref", "u_ref")),
    "CostToGo": (CostToGo, ("x_ref", "gradient", "hessian")),
}


def asked(problem: Problem, solution: Solution | None = None) -> dict[str, Any]:
    """Return the sections that are known when a run begins; with a `solution`, also those of its search."""
    options = {} if solution is None else solution.options
    seed = options.get("seed")
    return {
        "inputs": Inputs(
            initial_guess=str(options.get("initial_guess", "not known yet")),
            initial_guess_sha256=options.get("initial_guess_sha256"),
            seed=None if seed is None else int(seed),
            search=None if solution is None else _search(solution),
        ),
        "problem": describe_problem(problem),
        "contract": contract_of(problem.moved),
    }


def _search(solution: Solution) -> dict[str, Any] | None:
    """Return the arguments of `solve`; the guess by kind: null for none, "arrays", or the scheme of a solution."""
    if solution.search is None:
        return None
    guess = solution.search.guess
    kind = None if guess is None else guess.scheme if isinstance(guess, Solution) else "arrays"
    return {**solution.search.arguments, "initial_guess": kind}


def found(solution: Solution, *, measured: bool = True) -> dict[str, Any]:
    """Return the sections on how a solution was found; the gradients' norms are only computed if `measured`."""
    gradient = (
        _gradient(solution) if measured else GradientEvidence(reason="not measured yet", columns=_columns(solution))
    )
    certificates = [gradient_evidence(c) for c in solution.certificates]
    return {
        "solver": solver_of(solution, measured=measured),
        "parameters": _parameters(solution),
        "gradient": gradient.model_copy(update={"certificates": certificates}),
    }


def solver_of(solution: Solution, *, measured: bool = True) -> Solver:
    """Return the solver's section with the result of the solve; non-finite options are null."""
    options = {name: value for name, value in solution.options.items() if name not in GUESS}
    return evidence(
        Solver,
        solution,
        status=solution.status.value,
        options={k: plain(v.item() if isinstance(v, np.generic) else v) for k, v in options.items()},
        iterations=len(solution.iterations),
        plant=solution.plant if measured else None,
        feedback=solution.feedback if measured else None,
    )


def _parameters(solution: Solution) -> list[ParameterEvidence]:
    problem, vector = solution.problem, solution.vector
    lower, upper = (plain(side) for side in problem.bounds_of_parameters())
    units = [p.unit for p in vector.parameters for _ in p.value]
    starts, values = problem.parameters.values.tolist(), vector.values.tolist()
    columns = zip(vector.names, units, vector.sources, starts, values, lower, upper, strict=True)
    names = ("name", "unit", "derivative_source", "start", "value", "lower", "upper")
    return [
        ParameterEvidence(**dict(zip(names, row, strict=True)), optimized=problem.optimizes_parameters)
        for row in columns
    ]


def _gradient(solution: Solution) -> GradientEvidence:
    """Return the settings of the derivatives, and the norms."""
    problem = solution.problem
    contact = problem.model.contract.contact if problem.has_model else None
    regularization = "none"
    if contact is not None and contact.collision_pairs:
        regularization = f"{contact.approximation} contact, whose compliance and stiction are part of the model"
    ends, result = solution.final_state_norms, solution.optimality
    reasons = [str(value) for value in (ends, result) if isinstance(value, Refusal)]
    return GradientEvidence(
        columns=_columns(solution),
        regularization=regularization,
        solver_tolerance=None if contact is None else contact.solver_relative_tolerance,
        horizon_s=solution.horizon,
        final_state_norms=[] if isinstance(ends, Refusal) else plain(ends),
        lagrangian_norms=[] if isinstance(result, Refusal) else plain(result.state_norms),
        stationarity=None if isinstance(result, Refusal) else finite(result.ratio),
        reason="; ".join(reasons) or None,
    )


def _columns(solution: Solution) -> list[GradientColumn]:
    """Return the variables of the derivatives; states and inputs have the source of the certificates."""
    problem, vector = solution.problem, solution.vector
    methods = "; ".join(dict.fromkeys(c.method for c in solution.certificates)) or "no certificate was reached"
    if problem.motion != STEPS:
        methods = "continuous: saltation along the accepted steps of the integration"
    names = (*problem.state_names, *problem.input_names, *vector.names)
    units = (*units_of(problem), *(p.unit for p in vector.parameters for _ in p.value))
    sources = (*[methods] * (problem.nx + problem.nu), *vector.sources)
    return [GradientColumn(name=n, unit=u, source=s) for n, u, s in zip(names, units, sources, strict=True)]


def describe_problem(problem: Problem) -> dict[str, Any]:
    """Describe the problem for a record; functions are described by their names."""
    return {
        "system": problem.name,
        "num_steps": problem.num_steps,
        "time_step_s": problem.time_step,
        "horizon_s": problem.start_horizon,
        "state_names": list(problem.state_names),
        "input_names": list(problem.input_names),
        "x0": plain(problem.x0),
        "x_goal": plain(problem.goal),
        **({} if problem.goal_tolerance is None else {"goal_tolerance": plain(problem.goal_tolerance)}),
        "waypoints": {str(k): plain(x) for k, x in problem.waypoints.items()},
        "constraints": [_constraint(problem, c) for c in problem.constraints],
        **({"couplings": [c.to_dict() for c in problem.couplings]} if problem.couplings else {}),
        "goals": [goal.to_dict() for goal in problem.goals],
        "free_horizon_s": None if problem.horizon is None else list(problem.horizon),
        **{name: plain(getattr(problem.bounds, name)) for name in LIMITS},
        "optimize": list(problem.optimize),
        "parameters": [p.name for p in problem.parameters.parameters],
        **{name: _cost(getattr(problem, name)) for name in COSTS},
        "initial_state_free": [bool(free) for free in problem.initial_state_mask],
        **({} if problem.motion == STEPS else {"motion": problem.motion}),
        **({"fixed_contacts": problem.system.to_dict()} if isinstance(problem.system, FixedContacts) else {}),
    }


def _constraint(problem: Problem, c: Constraint) -> dict[str, Any]:
    return {
        "name": c.label,
        "lower": plain(c.lower),
        "upper": plain(c.upper),
        "knots": list(problem.knots_of(c, input_at_end=not (problem.has_model or problem.is_map))),
        "every_knot": c.knots is None,
        "quantity": description_of(c.function),  # null: a user's function
    }


def _cost(cost: Any) -> Any:
    """Return {kind: values}, or the name of a user's function."""
    if isinstance(cost, SumOfCosts):
        result = [_cost(entry) for entry in cost.costs]
        unknown = [entry for entry in result if isinstance(entry, str)]
        return f"a sum with {', '.join(unknown)}" if unknown else {"SumOfCosts": result}
    kind, names = KINDS_OF_COSTS.get(type(cost).__name__, (None, ()))
    values = {name: getattr(cost, name) for name in names if type(cost) is kind}
    if isinstance(cost, TrackingCost):
        values = {**dict(zip(("times", "xs", "us"), cost.reference, strict=True)), "Q": cost.Q, "R": cost.R}
    if not values:
        return None if cost is None else getattr(cost, "__qualname__", type(cost).__name__)
    return {type(cost).__name__: {name: np.asarray(v).tolist() for name, v in values.items() if v is not None}}


def unknown_functions(record: PlanRecord) -> tuple[list[str], list[str]]:
    """Return the (costs, constraints) of a recorded problem that are a user's functions, whose code is not recorded."""
    p: dict[str, Any] = dict(record.problem)
    costs = [f"{name} {p[name]}" for name in COSTS if isinstance(p.get(name), str)]
    listed = p.get("constraints")
    constraints = listed if isinstance(listed, list) else []
    unknown = [c for c in constraints if isinstance(c, dict) and c.get("quantity") is None]
    unknown += [c["Coupling"] for c in p.get("couplings", []) if "Coupling" in c]
    return costs, [str(c.get("name")) for c in unknown]


def rebuild_problem(record: PlanRecord, model: Model, us: Array, start_us: Array | None) -> Problem:
    """Rebuild the problem of a record on `model`, without the user's functions.

    `us` (N, nu) are the inputs of the plan, which the problem uses if they are not optimized. `start_us` (N, nu) is its
    initial guess of optimized inputs, if it has one.
    """
    p: dict[str, Any] = dict(record.problem)
    starts = np.array([entry.start for entry in record.parameters])
    lower, upper = (numbers_of([getattr(e, side) for e in record.parameters], gap) for side, gap in MISSING.items())
    vector = select(model, p["parameters"])
    pairs = list(zip(vector.parameters, vector.slices, strict=True))
    mask = np.array(p["initial_state_free"], dtype=bool)
    goal = numbers_of(p["x_goal"], np.nan)
    system = FixedContacts(model, **p["fixed_contacts"]) if p.get("fixed_contacts") else model
    requests: dict[str, Any] = {
        "running_cost": _rebuild_cost(p["running_cost"]),
        "final_cost": _rebuild_cost(p["final_cost"]),
        "goals": [rebuild_goal(element) for element in p["goals"]],
        "constraints": [_rebuild_constraint(c, system) for c in p["constraints"] if c["quantity"] is not None],
        "couplings": [_rebuild("coupling", COUPLINGS, c) for c in p.get("couplings", ()) if "Coupling" not in c],
    }
    if not any(requests.values()) and np.all(np.isnan(goal)):
        requests["final_cost"] = QuadraticCost(Q=np.zeros((model.nx, model.nx)))  # a Problem needs a cost or goal
    return Problem(
        system,
        x0=numbers_of(p["x0"], np.nan),
        num_steps=p["num_steps"],
        x_goal=goal,
        goal_tolerance=numbers_of(p["goal_tolerance"], np.nan) if "goal_tolerance" in p else None,
        waypoints={int(k): numbers_of(x, np.nan) for k, x in p["waypoints"].items()},
        horizon=p["free_horizon_s"],
        motion=p.get("motion", STEPS),
        bounds=Bounds(**{name: numbers_of(p[name], MISSING[name[2:]]) for name in LIMITS}),
        optimize=p["optimize"],
        initial_state_mask=mask if mask.any() else None,
        us=start_us if "controls" in p["optimize"] else us,
        parameters={parameter.name: starts[s] for parameter, s in pairs},
        parameter_bounds={
            parameter.name: (lower[s], upper[s]) for parameter, s in pairs if parameter.kind.quantity != "inertia"
        },
        **requests,
    )


def _rebuild_constraint(c: dict[str, Any], system: Model | FixedContacts) -> Constraint:
    content = c["quantity"]
    ((kind, values),) = content.items()
    if kind in QUANTITIES:
        function = recorded_quantity(system, kind, values)
    else:
        function = made_from(system if isinstance(system, Model) else system.plant.model, content)
    lower, upper = (numbers_of(c[side], gap) for side, gap in MISSING.items())
    knots = None if c["every_knot"] else c["knots"]
    return Constraint(function, lower=lower, upper=upper, knots=knots, name=c["name"])


def rebuild_goal(described: Any) -> Goal:
    """Rebuild a goal from its description in a record; raise InputError if that is not a goal."""
    goal: Goal = _rebuild("goal", GOALS, described)
    return goal


def _rebuild(subject: str, kinds: Mapping[str, Any], described: Any) -> Any:
    """Rebuild one of `kinds` from its values; raise InputError if `described` is not one of them."""
    if not (isinstance(described, dict) and len(described) == 1 and next(iter(described)) in kinds):
        raise InputError(subject, got=repr(described)[:80], expected=f"one of {', '.join(kinds)} with its values")
    ((kind, values),) = described.items()
    if kind == Dwell.__name__:
        values = {**values, "goal": rebuild_goal(values.get("goal"))}
    return kinds[kind](**values)


def numbers_of(values: Any, missing: float) -> Array:
    """Convert `values` to an array (n,) with `missing` in place of None."""
    return np.array([missing if v is None else v for v in values], dtype=float)


def _rebuild_cost(cost: Any) -> Any:
    if not isinstance(cost, dict):
        return None  # no cost, or a user's function
    ((kind, values),) = cost.items()
    if kind == "SumOfCosts":
        return [_rebuild_cost(entry) for entry in values]
    values = {name: np.array(value, dtype=float)[()] for name, value in values.items()}
    if kind == "TrackingCost":
        reference = values["times"], values["xs"], values.get("us")
        return TrackingCost(reference, Q=values.get("Q"), R=values.get("R"))
    return KINDS_OF_COSTS[kind][0](**values)
