"""A problem as plain numbers and names in a record, and back again: all of it but the user's own functions."""

import math
from typing import Any

import numpy as np

from drake_diff.arrays import Array
from drake_diff.bounds import Bounds
from drake_diff.constraint import Constraint
from drake_diff.cost import ConstantCost, QuadraticCost
from drake_diff.model import Model
from drake_diff.parameters import select
from drake_diff.problem import Problem
from drake_diff.record import EvidenceRecord

# The units of the numbers in a record's `problem` and `contract`, by their key.
UNITS = {
    "horizon_s": "s",
    "time_step_s": "s",
    "free_horizon_s": "s",
    "x0, x_goal, x_lower, x_upper, waypoints": "those of `observation.variables`, entry by entry",
    "u_lower, u_upper": "those of `action.commands`, entry by entry",
    "constraints": "those of what the constraint's function returns",
    "Q, R, rate": "cost per s and squared unit of the state or input; as a final cost without the s; rate: cost per s",
    "time_step": "s",
    "gravity": "m/s^2",
    "lower, upper": "the `unit` beside them",
    "mass": "kg",
    "center_of_mass": "m",
    "inertia": "kg m^2",
    "damping": "N s/m or N m s/rad",
    "effort_limit": "N or N m",
    "gear_ratio": "1",
    "rotor_inertia": "kg m^2",
    "kp": "N/m or N m/rad",
    "kd": "N s/m or N m s/rad",
    "friction": "1",
    "stiffness": "N/m",
    "dissipation": "s/m",
    "relaxation_time": "s",
    "hydroelastic_modulus": "Pa",
    "solver_relative_tolerance": "1",
    "sap_near_rigid_threshold": "1",
    "collision_pairs, constraints, num_steps": "1",
}


def describe_problem(problem: Problem) -> dict[str, Any]:
    """The problem for a record; functions by their names."""
    b = problem.bounds
    return {
        "num_steps": problem.num_steps,
        "time_step_s": problem.model.time_step,
        "horizon_s": problem.num_steps * problem.model.time_step,
        "state_names": list(problem.model.state_names),
        "input_names": list(problem.model.input_names),
        "x0": finite_list(problem.x0),
        "x_goal": finite_list(problem.goal),
        "waypoints": {str(k): finite_list(x) for k, x in problem.waypoints.items()},
        "constraints": [_constraint(problem, c) for c in problem.constraints],
        "free_horizon_s": None if problem.horizon is None else list(problem.horizon),
        "x_lower": finite_list(b.x_lower),
        "x_upper": finite_list(b.x_upper),
        "u_lower": finite_list(b.u_lower),
        "u_upper": finite_list(b.u_upper),
        "optimize": list(problem.optimize),
        "parameters": [p.name for p in problem.parameters.parameters],
        "running_cost": _cost(problem.running_cost),
        "final_cost": _cost(problem.final_cost),
        "trajectory_cost": _cost(problem.trajectory_cost),
        "initial_state_free": [bool(free) for free in problem.initial_state_mask],
    }


def finite_list(values: Any) -> list[float | None]:
    """Numbers for JSON; None where there is no bound or no goal (infinite, NaN)."""
    return [float(v) if math.isfinite(v) else None for v in np.asarray(values).ravel()]


def _constraint(problem: Problem, c: Constraint) -> dict[str, Any]:
    knots = c.at_knots(problem.num_steps, problem.initial_state_is_given)
    return {"name": c.label, "lower": finite_list(c.lower), "upper": finite_list(c.upper), "knots": list(knots)}


def _cost(cost: Any) -> Any:
    if isinstance(cost, ConstantCost):
        return {"ConstantCost": {"rate": cost.rate}}
    if isinstance(cost, QuadraticCost):
        parts = {name: getattr(cost, name) for name in ("Q", "R", "x_ref", "u_ref")}
        return {"QuadraticCost": {name: np.asarray(v).tolist() for name, v in parts.items() if v is not None}}
    return None if cost is None else getattr(cost, "__qualname__", type(cost).__name__)


def unknown_functions(record: EvidenceRecord) -> tuple[list[str], list[str]]:
    """(costs, constraints) of a record's problem that are the user's functions: their code is not in it."""
    names = ("running_cost", "final_cost", "trajectory_cost")
    costs = [f"{name} {record.problem[name]}" for name in names if isinstance(record.problem.get(name), str)]
    listed = record.problem.get("constraints")
    constraints: list[Any] = listed if isinstance(listed, list) else []
    return costs, [str(c.get("name")) for c in constraints if isinstance(c, dict)]


def rebuild_problem(record: EvidenceRecord, model: Model, us: Array) -> Problem:
    """The problem of a record on `model`, without the user's functions; `us` (N, nu) are the inputs of the plan."""
    p: dict[str, Any] = dict(record.problem)
    limits = [_numbers(p[f"{kind}_{side}"], sign) for kind in "xu" for side, sign in (("lower", -1), ("upper", 1))]
    starts = np.array([entry.start for entry in record.parameters])
    sides = [
        np.array([sign * np.inf if v is None else v for v in values])
        for sign, values in (
            (-1, [entry.lower for entry in record.parameters]),
            (1, [entry.upper for entry in record.parameters]),
        )
    ]
    vector = select(model, p["parameters"])
    pairs = list(zip(vector.parameters, vector.slices, strict=True))
    mask = np.array(p["initial_state_free"], dtype=bool)
    optimize = p["optimize"]
    running, final = _rebuild_cost(p["running_cost"]), _rebuild_cost(p["final_cost"])
    goal = _numbers(p["x_goal"], np.nan)
    if running is None and final is None and np.all(np.isnan(goal)):
        final = _nothing  # a Problem wants a cost or a goal
    return Problem(
        model,
        x0=_numbers(p["x0"], np.nan),
        num_steps=p["num_steps"],
        running_cost=running,
        final_cost=final,
        x_goal=goal,
        waypoints={int(k): _numbers(x, np.nan) for k, x in p["waypoints"].items()},
        horizon=p["free_horizon_s"],
        bounds=Bounds(*limits),
        optimize=optimize,
        initial_state_mask=mask if mask.any() else None,
        us=None if "controls" in optimize else us,
        parameters={parameter.name: starts[s] for parameter, s in pairs},
        parameter_bounds={
            parameter.name: (sides[0][s], sides[1][s]) for parameter, s in pairs if parameter.kind.quantity != "inertia"
        },
    )


def _nothing(x: Any) -> Any:
    return 0.0 * x[0]


def _numbers(values: Any, missing: float) -> Array:
    """(n,) numbers; where there is none `missing`, of a bound its sign times infinity."""
    gap = missing if np.isnan(missing) else missing * np.inf
    return np.array([gap if v is None else v for v in values], dtype=float)


def _rebuild_cost(cost: Any) -> Any:
    if not isinstance(cost, dict):
        return None  # none, or the user's function
    if "ConstantCost" in cost:
        return ConstantCost(cost["ConstantCost"]["rate"])
    return QuadraticCost(**cost["QuadraticCost"])
