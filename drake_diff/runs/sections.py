"""The sections of a record that say what was asked, observed, commanded and differentiated.

A problem is written as plain numbers and names, and comes back from them: all of it but the user's own functions.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from hashlib import sha256
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal
from drake_diff.exceptions import InputError
from drake_diff.mechanics.quantities import description_of, made_from
from drake_diff.model.model import Model
from drake_diff.model.parameters import select
from drake_diff.model.plant import FLOATING, joints
from drake_diff.motion.rollout import STEPS
from drake_diff.optimize.problem.constraint import Bounds, Constraint
from drake_diff.optimize.problem.cost import ConstantCost, CostToGo, QuadraticCost, SumOfCosts, TrackingCost
from drake_diff.optimize.problem.coupling import InputRate, Jerk, Periodic
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
from drake_diff.optimize.replay import deciding
from drake_diff.optimize.solution import Solution
from drake_diff.runs.fields import (
    ActionInterface,
    Claim,
    Command,
    DataBoundary,
    DataUse,
    EvaluationPanel,
    GradientColumn,
    GradientEvidence,
    Inputs,
    ModelInput,
    Observation,
    ObservedVariable,
    PanelCase,
    ParameterEvidence,
    Quantity,
    ReplayEvidence,
    Solver,
    evidence,
    plain,
)
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.provenance import NO_BODY, embodiment_of, gradient_evidence, model_input

# The units of the numbers in a record's `problem` and `contract`, by their key.
UNITS = {
    "horizon_s": "s",
    "time_step_s": "s",
    "free_horizon_s": "s",
    "x0, x_goal, x_lower, x_upper, waypoints": "those of `observation.variables`, entry by entry",
    "u_lower, u_upper": "those of `action.commands`, entry by entry",
    "goals": "m and rad, and per s of velocities",
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
COUPLED = "those of the states and inputs that they join, and per s of rates"
LIMITATIONS = [
    "of the model in simulation only: nothing here was measured on a robot",
    "a cost is that of a local optimum at best",
    "certificates hold at the states that they name, replays in the variants that they name",
]
FINAL_STATE_NORM = "|d x_N / d x_k|, the largest singular value, through the plant's steps after knot k"
LAGRANGIAN_NORM = (
    "|d L / d x_k| in the cost's unit per the state's, by knot k: L is the cost plus multipliers times the goal, "
    "bounds and constraints that the plan lies on, and x_k changes all later states"
)
STATIONARITY = (
    "the largest |d L / d z| of an optimized variable that no bound holds, over the largest sum of magnitudes that one "
    "is made of: 0 at an optimum; multipliers by least squares, not the solver's"
)
COSTS = ("running_cost", "final_cost", "trajectory_cost", "parameter_cost")
LIMITS = ("x_lower", "x_upper", "u_lower", "u_upper")
GAPS = {"lower": -np.inf, "upper": np.inf}  # what null is, of a bound
GUESS = ("initial_guess", "initial_guess_sha256")
KINDS_OF_GOALS = (FrameGoal, FrameVelocityGoal, JointGoal, CenterOfMassGoal, KeepLevel)
KINDS_OVER_TIME = (Dwell, TerminalSet, ContactSchedule)
KINDS_OF_OBSTACLES = (SphereObstacle, BoxObstacle, SelfCollision)
# By the names that a record has.
GOALS: dict[str, Any] = {kind.__name__: kind for kind in (*KINDS_OF_GOALS, *KINDS_OVER_TIME, *KINDS_OF_OBSTACLES)}

KINDS_OF_COSTS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "ConstantCost": (ConstantCost, ("rate",)),
    "QuadraticCost": (QuadraticCost, ("Q", "R", "x_ref", "u_ref")),
    "CostToGo": (CostToGo, ("x_ref", "gradient", "hessian")),
}
COUPLINGS: dict[str, Any] = {kind.__name__: kind for kind in (Periodic, InputRate, Jerk)}


def asked(problem: Problem, solution: Solution | None = None) -> dict[str, Any]:
    """The sections that are known when a run begins; with its `solution` those that it decides are exact."""
    time_step = problem.time_step if solution is None else solution.time_step
    options = {} if solution is None else solution.options
    goal = "" if np.all(np.isnan(problem.goal)) else " and ends in x_goal"
    goals = (", goals" if problem.goals else "") + (", couplings" if problem.couplings else "")
    equations = "the given equations" if problem.moved is None else "Drake's equations"
    if problem.motion != STEPS:
        equations += " in continuous time, contact included"
    statement = (
        f"{problem.name}, by {equations}, starts in x0{goal} after {problem.num_steps} intervals, and "
        f"keeps bounds{goals} and constraints at every knot; optimized: {', '.join(problem.optimize)}"
    )
    model = ModelInput(file=None, options=None) if problem.moved is None else model_input(problem.moved)
    return {
        "claim": Claim(statement=statement, limitations=LIMITATIONS),
        "inputs": Inputs(
            initial_guess=str(options.get("initial_guess", "not known yet")),
            initial_guess_sha256=options.get("initial_guess_sha256"),
            seed=int(options["seed"]) if "seed" in options else None,
            search=None if solution is None else _search(solution),
        ),
        "problem": describe_problem(problem),
        "contract": {} if problem.moved is None else problem.moved.contract.to_dict(),
        "embodiment": NO_BODY if problem.moved is None else embodiment_of(problem.moved.contract),
        "data": _data(problem, options, model),
        "units": UNITS | ({"couplings": COUPLED} if problem.couplings else {}),
        "observation": _observation(problem, time_step),
        "action": _action(problem, time_step, options.get("time_limit")),
        "model": model,
    }


def _data(problem: Problem, options: Mapping[str, Any], model: ModelInput) -> DataBoundary:
    """What a search saw, and what its plan is judged on: there are no recordings, and so nothing is held out."""
    guess = DataUse(
        name="initial guess",
        what=str(options.get("initial_guess", "not known yet")),
        sha256=options.get("initial_guess_sha256"),
    )
    seed = DataUse(name="seed", what=f"of random starts: {options['seed']}" if "seed" in options else "none is known")
    plant = DataUse(name="model", what=f"the equations of {problem.name}")
    if model.file is not None:
        plant = DataUse(name="model", what=model.file.path, sha256=model.file.sha256)
    given = [*_given_data(problem)]
    statement = (
        f"{'it has seen what is listed, and' if given else 'no recording was used:'} nothing was fitted to data, and "
        "no data are held out. The plan was made on the model, and is judged on the same one in the panel's cases"
    )
    return DataBoundary(statement=statement, seen=[plant, guess, seed, *given], judged_on=[plant])


def _given_data(problem: Problem) -> Iterator[DataUse]:
    """Motions that the problem's costs follow, and functions of the user, which may know any data."""
    for name in COSTS:
        cost = getattr(problem, name)
        for i, piece in enumerate(cost.costs if isinstance(cost, SumOfCosts) else (cost,)):
            if isinstance(piece, TrackingCost):
                content = b"".join(np.asarray(v, dtype=float).tobytes() for v in piece.reference if v is not None)
                what = f"a motion of {len(piece.reference[0])} times that {name.replace('_', ' ')} follows"
                yield DataUse(name=f"{name} {i}", what=what, sha256=sha256(content).hexdigest())
            elif isinstance(_cost(piece), str):
                yield DataUse(name=f"{name} {i}", what=f"{_cost(piece)}, a function: what it knows is not recorded")
    for c in problem.constraints:
        if description_of(c.function) is None:
            yield DataUse(name=f"constraint {c.label}", what="a function: what it knows is not recorded")


def panel_of(solution: Solution, replays: Sequence[ReplayEvidence]) -> EvaluationPanel:
    """Under what a solution is judged: every replay of its record, and which of them its verdict rests on."""
    problem = solution.problem
    decides = deciding(solution.plan, solution.replays) if problem.has_model else []
    cases = [evidence(PanelCase, r, decides=r.variant in decides) for r in replays]
    statement = "the plan's own start, model and inputs in each case; a variant that decides holds under one control"
    if not problem.has_model:
        statement = "the given equations alone, at and between the knots: there is no plant to replay it on"
    return EvaluationPanel(statement=statement, cases=cases, perturbations=[], latencies_s=[0.0]).hashed()


def _search(solution: Solution) -> dict[str, Any] | None:
    """What `solve` was called with; its guess by kind: null for none, "arrays", or the scheme of a solution."""
    if solution.search is None:
        return None
    guess = solution.search.guess
    kind = None if guess is None else guess.scheme if isinstance(guess, Solution) else "arrays"
    return {**solution.search.arguments, "initial_guess": kind}


def found(solution: Solution, *, measured: bool = True) -> dict[str, Any]:
    """The sections that say how a solution was found. An option that is no finite number is null.

    Norms of gradients are there of what is `measured`, as they take time.
    """
    problem, vector = solution.problem, solution.vector
    units = [p.unit for p in vector.parameters for _ in p.value]
    lower, upper = (plain(side) for side in problem.bounds_of_parameters())
    parameters = [
        ParameterEvidence(
            name=name,
            unit=units[i],
            derivative_source=vector.sources[i],
            start=float(problem.parameters.values[i]),
            value=float(vector.values[i]),
            optimized=problem.optimizes_parameters,
            lower=lower[i],
            upper=upper[i],
        )
        for i, name in enumerate(vector.names)
    ]
    options = {k: v.item() if isinstance(v, np.generic) else v for k, v in solution.options.items() if k not in GUESS}
    solver = evidence(
        Solver,
        solution,
        status=solution.status.value,
        options={k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in options.items()},
        iterations=len(solution.iterations),
    )
    return {"solver": solver, "parameters": parameters, "gradient": _gradient(solution, measured)}


def _observation(problem: Problem, time_step: float) -> Observation:
    """The state as it is observed: exactly, at every step."""
    frames = ["none: plain dynamics"] * problem.nx if problem.moved is None else _frames(problem.moved)
    exact = "exact simulation state: there is no sensor and no noise"
    variables = [
        ObservedVariable(name=name, unit=unit, frame=frame, uncertainty=Quantity(value=0.0, unit=unit, reason=exact))
        for name, unit, frame in zip(problem.state_names, units_of(problem)[: problem.nx], frames, strict=True)
    ]
    clock = "simulated time, from the first state"
    return Observation(variables=variables, clock=clock, start_s=0.0, period_s=time_step, count=problem.num_steps + 1)


def _frames(model: Model) -> list[str]:
    """(nx,) the frame of each entry of the state: a floating body's is the world's, a joint's its own axes'."""
    result = [model.contract.frame] * model.nx
    for joint in joints(model.plant):
        if joint.type_name() not in FLOATING:
            inner = f"axes of {joint.name()}, {joint.parent_body().name()} to {joint.child_body().name()}"
            q, v = model.places(joint)
            for i in [*q, *(model.nq + j for j in v)]:
                result[i] = inner
    return result


def _action(problem: Problem, time_step: float, limit: float | None) -> ActionInterface:
    """How the inputs reach the plant in the replay, whatever the solver assumed between its knots."""
    kind = "the input of plain dynamics: no plant takes it"
    if problem.has_model:
        kind = "effort, held over each step"
        if any(a.kp is not None for a in problem.model.contract.actuators):
            kind += ", added to the actuators' PD control"
    limits = (plain(problem.bounds.u_lower), plain(problem.bounds.u_upper))
    inputs = zip(problem.input_names, units_of(problem)[problem.nx :], *limits, strict=True)
    reason = "of the solve as a whole" if limit else "none: planned ahead in simulation, no time limit was given"
    return ActionInterface(
        command_type=kind,
        commands=[Command(name=name, unit=unit, lower=low, upper=high) for name, unit, low, high in inputs],
        update_rate=Quantity(value=1 / time_step, unit="Hz"),
        latency_budget=Quantity(value=limit, unit="s", reason=reason),
        safety_fallback="none: in simulation there is nothing to protect",
    )


def _gradient(solution: Solution, measured: bool) -> GradientEvidence:
    """What the solver differentiated, where each column came from, and how far it agrees with differences.

    The source of states and inputs is that of the certificates.
    """
    problem, vector = solution.problem, solution.vector
    regularization, tolerance = "none", Quantity(value=None, unit="1", reason="plain dynamics have no contact solver")
    if problem.has_model:
        contact = problem.model.contract.contact
        if contact.collision_pairs:
            regularization = f"{contact.approximation} contact, whose compliance and stiction are part of the model"
        reason = "relative, of Drake's contact solver"
        tolerance = Quantity(value=contact.solver_relative_tolerance, unit="1", reason=reason)
    methods = "; ".join(dict.fromkeys(c.method for c in solution.certificates)) or "no certificate was reached"
    if problem.motion != STEPS:
        methods = "continuous: saltation along the accepted steps of the integration"
    names = (*problem.state_names, *problem.input_names, *vector.names)
    units = (*units_of(problem), *(p.unit for p in vector.parameters for _ in p.value))
    sources = (*[methods] * (problem.nx + problem.nu), *vector.sources)
    columns = zip(names, units, sources, strict=True)
    later = Refusal("not measured yet")
    ends, result = (solution.final_state_norms, solution.optimality) if measured else (later, later)
    ratio = None if isinstance(result, Refusal) or not math.isfinite(result.ratio) else result.ratio
    return GradientEvidence(
        differentiated=list(problem.optimize),
        columns=[GradientColumn(name=name, unit=unit, source=source) for name, unit, source in columns],
        smoothing="none",
        regularization=regularization,
        solver_tolerance=tolerance,
        horizon=Quantity(value=solution.horizon, unit="s"),
        final_state_norm_definition=f"none: {ends}" if isinstance(ends, Refusal) else FINAL_STATE_NORM,
        final_state_norms=[] if isinstance(ends, Refusal) else plain(ends),
        lagrangian_norm_definition=f"none: {result}" if isinstance(result, Refusal) else LAGRANGIAN_NORM,
        lagrangian_norms=[] if isinstance(result, Refusal) else plain(result.state_norms),
        stationarity=Quantity(
            value=ratio, unit="1", reason=str(result) if isinstance(result, Refusal) else STATIONARITY
        ),
        certificates=[gradient_evidence(c) for c in solution.certificates],
    )


def describe_problem(problem: Problem) -> dict[str, Any]:
    """The problem for a record; functions by their names."""
    at_end = not (problem.has_model or problem.is_map)
    knots = [list(problem.knots_of(c, input_at_end=at_end)) for c in problem.constraints]
    return {
        "system": problem.name,
        "num_steps": problem.num_steps,
        "time_step_s": problem.time_step,
        "horizon_s": problem.start_horizon,
        "state_names": list(problem.state_names),
        "input_names": list(problem.input_names),
        "x0": plain(problem.x0),
        "x_goal": plain(problem.goal),
        "waypoints": {str(k): plain(x) for k, x in problem.waypoints.items()},
        "constraints": [
            {
                "name": c.label,
                "lower": plain(c.lower),
                "upper": plain(c.upper),
                "knots": position,
                "every_knot": c.knots is None,
                "quantity": description_of(c.function),  # null: a user's function
            }
            for c, position in zip(problem.constraints, knots, strict=True)
        ],
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


def _cost(cost: Any) -> Any:
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
    """(costs, constraints) of a record's problem that are the user's functions: their code is not in it."""
    costs = [f"{name} {record.problem[name]}" for name in COSTS if isinstance(record.problem.get(name), str)]
    listed = record.problem.get("constraints")
    constraints: list[Any] = listed if isinstance(listed, list) else []
    unknown = [c for c in constraints if isinstance(c, dict) and c.get("quantity") is None]
    coupled: Any = record.problem.get("couplings", [])
    joining = [c["Coupling"] for c in coupled if "Coupling" in c]
    return costs, [str(c.get("name")) for c in (*unknown, *joining)]


def rebuild_problem(record: PlanRecord, model: Model, us: Array, start_us: Array | None) -> Problem:
    """The problem of a record on `model`, without the user's functions.

    `us` (N, nu) are the inputs of the plan, which the problem has where they are not optimized; `start_us` (N, nu) its
    first guess of them where they are, if it has one.
    """
    p: dict[str, Any] = dict(record.problem)
    bounds = {name: _numbers(p[name], GAPS[name[2:]]) for name in LIMITS}
    starts = np.array([entry.start for entry in record.parameters])
    lower, upper = (_numbers([getattr(e, side) for e in record.parameters], gap) for side, gap in GAPS.items())
    vector = select(model, p["parameters"])
    pairs = list(zip(vector.parameters, vector.slices, strict=True))
    mask = np.array(p["initial_state_free"], dtype=bool)
    running, final = _rebuild_cost(p["running_cost"]), _rebuild_cost(p["final_cost"])
    goal = _numbers(p["x_goal"], np.nan)
    goals = [rebuild_goal(element) for element in p["goals"]]
    system = FixedContacts(model, **p["fixed_contacts"]) if p.get("fixed_contacts") else model
    constraints = [_rebuild_constraint(c, system) for c in p["constraints"] if c["quantity"] is not None]
    couplings = [_rebuild("coupling", COUPLINGS, c) for c in p.get("couplings", ()) if "Coupling" not in c]
    asked = goals or constraints or couplings or running is not None or final is not None
    if not asked and np.all(np.isnan(goal)):
        final = QuadraticCost(Q=np.zeros((model.nx, model.nx)))  # a Problem wants something to be asked
    return Problem(
        system,
        x0=_numbers(p["x0"], np.nan),
        num_steps=p["num_steps"],
        running_cost=running,
        final_cost=final,
        x_goal=goal,
        waypoints={int(k): _numbers(x, np.nan) for k, x in p["waypoints"].items()},
        constraints=constraints,
        couplings=couplings,
        goals=goals,
        horizon=p["free_horizon_s"],
        motion=p.get("motion", STEPS),
        bounds=Bounds(**bounds),
        optimize=p["optimize"],
        initial_state_mask=mask if mask.any() else None,
        us=start_us if "controls" in p["optimize"] else us,
        parameters={parameter.name: starts[s] for parameter, s in pairs},
        parameter_bounds={
            parameter.name: (lower[s], upper[s]) for parameter, s in pairs if parameter.kind.quantity != "inertia"
        },
    )


def _rebuild_constraint(c: dict[str, Any], system: Model | FixedContacts) -> Constraint:
    content = c["quantity"]
    ((kind, values),) = content.items()
    if kind in QUANTITIES:
        function = recorded_quantity(system, kind, values)
    else:
        function = made_from(system if isinstance(system, Model) else system.plant.model, content)
    lower, upper = (_numbers(c[side], gap) for side, gap in GAPS.items())
    knots = None if c["every_knot"] else c["knots"]
    return Constraint(function, lower=lower, upper=upper, knots=knots, name=c["name"])


def rebuild_goal(described: Any) -> Goal:
    """A goal from what a record tells of it; InputError where that is none."""
    goal: Goal = _rebuild("goal", GOALS, described)
    return goal


def _rebuild(subject: str, kinds: Mapping[str, Any], described: Any) -> Any:
    """One of `kinds` with its values; InputError where `told` is none."""
    if not (isinstance(described, dict) and len(described) == 1 and next(iter(described)) in kinds):
        raise InputError(subject, got=repr(described)[:80], expected=f"one of {', '.join(kinds)} with its values")
    ((kind, values),) = described.items()
    if kind == Dwell.__name__:
        values = {**values, "goal": rebuild_goal(values.get("goal"))}
    return kinds[kind](**values)


def _numbers(values: Any, missing: float) -> Array:
    """(n,) numbers, `missing` where there is none."""
    return np.array([missing if v is None else v for v in values], dtype=float)


def _rebuild_cost(cost: Any) -> Any:
    if not isinstance(cost, dict):
        return None  # none, or the user's function
    ((kind, values),) = cost.items()
    if kind == "SumOfCosts":
        return [_rebuild_cost(entry) for entry in values]
    values = {name: np.array(value, dtype=float)[()] for name, value in values.items()}
    if kind == "TrackingCost":
        reference = values["times"], values["xs"], values.get("us")
        return TrackingCost(reference, Q=values.get("Q"), R=values.get("R"))
    return KINDS_OF_COSTS[kind][0](**values)
