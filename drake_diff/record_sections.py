"""The sections of a record that say what was asked, observed, commanded and differentiated."""

import math

import numpy as np

from drake_diff.model import Model
from drake_diff.plant_elements import FLOATING, joints
from drake_diff.problem import Problem
from drake_diff.problem_record import finite_list
from drake_diff.provenance import gradient_evidence, model_input
from drake_diff.record import (
    ActionInterface,
    Claim,
    Command,
    GradientColumn,
    GradientEvidence,
    Inputs,
    Observation,
    ObservedVariable,
    ParameterEvidence,
    Solver,
)
from drake_diff.record_parts import Quantity
from drake_diff.solution import Solution

LIMITATIONS = [
    "of the model in simulation only: nothing here was measured on a robot",
    "a cost is that of a local optimum at best",
    "certificates hold at the states that they name, replays in the variants that they name",
]

GUESS = ("initial_guess", "initial_guess_sha256")


def claim_of(problem: Problem) -> Claim:
    """What a run of this problem says is true when its verdict is "pass"."""
    goal = "" if np.all(np.isnan(problem.goal)) else " and ends in x_goal"
    statement = (
        f"{problem.model.name}, by Drake's equations, starts in x0{goal} after {problem.num_steps} intervals, and "
        f"keeps bounds and constraints at every knot; optimized: {', '.join(problem.optimize)}"
    )
    return Claim(statement=statement, limitations=LIMITATIONS)


def inputs_of(problem: Problem, solution: Solution | None) -> Inputs:
    """What the run starts from; the guess is known once it has been made."""
    options = {} if solution is None else solution.options
    return Inputs(
        model=model_input(problem.model),
        initial_guess=str(options.get("initial_guess", "not known yet")),
        initial_guess_sha256=options.get("initial_guess_sha256"),
        seed=int(options["seed"]) if "seed" in options else None,
    )


def observation_of(problem: Problem, time_step: float) -> Observation:
    """The state as it is observed: exactly, at every step."""
    contract, frames = problem.model.contract, _frames(problem.model)
    variables = [
        ObservedVariable(name=x.name, unit=x.unit, frame=frame, uncertainty=_exact(x.unit))
        for x, frame in zip(contract.positions + contract.velocities, frames, strict=True)
    ]
    clock = "simulated time, from the first state"
    return Observation(variables=variables, clock=clock, start_s=0.0, period_s=time_step, count=problem.num_steps + 1)


def _exact(unit: str) -> Quantity:
    return Quantity(value=0.0, unit=unit, reason="exact simulation state: there is no sensor and no noise")


def _frames(model: Model) -> list[str]:
    """(nx,) the frame of each entry of the state: a floating body's is the world's, a joint's its own axes'."""
    found = [model.contract.frame] * model.nx
    for joint in joints(model.plant):
        if joint.type_name() not in FLOATING:
            own = f"axes of {joint.name()}, {joint.parent_body().name()} to {joint.child_body().name()}"
            for start, count in (
                (joint.position_start(), joint.num_positions()),
                (model.nq + joint.velocity_start(), joint.num_velocities()),
            ):
                found[start : start + count] = [own] * count
    return found


def action_of(problem: Problem, time_step: float, solution: Solution | None) -> ActionInterface:
    """How the inputs reach the plant in the replay, whatever the solver assumed between its knots."""
    model, bounds = problem.model, problem.bounds
    limit = None if solution is None else solution.options.get("time_limit")
    pd = any(a.kp is not None for a in model.contract.actuators)
    kind = "effort, held over each step" + (", added to the actuators' PD control" if pd else "")
    lower, upper = finite_list(bounds.u_lower), finite_list(bounds.u_upper)
    return ActionInterface(
        command_type=kind,
        commands=[
            Command(name=u.name, unit=u.unit, lower=lower[i], upper=upper[i])
            for i, u in enumerate(model.contract.inputs)
        ],
        update_rate=Quantity(value=1 / time_step, unit="Hz"),
        latency_budget=Quantity(
            value=limit,
            unit="s",
            reason="of the solve as a whole" if limit else "none: planned ahead in simulation, no time limit was given",
        ),
        safety_fallback="none: in simulation there is nothing to protect",
    )


def gradient_of(solution: Solution) -> GradientEvidence:
    """What the solver differentiated, where each column came from, and how far it agrees with differences."""
    contact = solution.problem.model.contract.contact
    touching = f"{contact.approximation} contact, whose compliance and stiction are part of the model"
    norms = [] if solution.gradient_norms is None else finite_list(solution.gradient_norms)
    return GradientEvidence(
        differentiated=list(solution.problem.optimize),
        columns=_columns(solution),
        smoothing="none",
        regularization=touching if contact.collision_pairs else "none",
        solver_tolerance=Quantity(
            value=contact.solver_relative_tolerance, unit="1", reason="relative, of Drake's contact solver"
        ),
        horizon=Quantity(value=solution.horizon, unit="s"),
        norm_definition="|d cost / d x_k| in the cost's unit per the state's, by knot k",
        norms=norms,
        certificates=[gradient_evidence(c) for c in solution.certificates],
    )


def _columns(solution: Solution) -> list[GradientColumn]:
    """States, inputs and parameters; of the first two the source that the certificates were of."""
    contract, vector = solution.problem.model.contract, solution.vector
    methods = list(dict.fromkeys(c.method for c in solution.certificates)) or ["no certificate was reached"]
    of_states = "; ".join(methods)
    units = [p.unit for p in vector.parameters for _ in p.value]
    coordinates = contract.positions + contract.velocities + contract.inputs
    return [
        *(GradientColumn(name=x.name, unit=x.unit, source=of_states) for x in coordinates),
        *(GradientColumn(name=name, unit=units[i], source=vector.sources[i]) for i, name in enumerate(vector.names)),
    ]


def parameters_of(solution: Solution) -> list[ParameterEvidence]:
    """Each entry of the parameter vector."""
    problem, found = solution.problem, solution.vector
    lower, upper = (finite_list(side) for side in problem.bounds_of_parameters())
    units = [p.unit for p in found.parameters for _ in p.value]
    return [
        ParameterEvidence(
            name=name,
            unit=units[i],
            derivative_source=found.sources[i],
            start=float(problem.parameters.values[i]),
            value=float(found.values[i]),
            optimized=problem.optimizes_parameters,
            lower=lower[i],
            upper=upper[i],
        )
        for i, name in enumerate(found.names)
    ]


def solver_of(solution: Solution) -> Solver:
    """What solved the problem; an option that is no finite number is null, and the guess is in `inputs`."""
    options = {k: v.item() if isinstance(v, np.generic) else v for k, v in solution.options.items() if k not in GUESS}
    plain = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in options.items()}
    return Solver(
        method=solution.method,
        solver=solution.solver,
        scheme=solution.scheme,
        status=solution.status.value,
        message=solution.message,
        solver_message=solution.solver_message,
        options=plain,
        iterations=len(solution.iterations),
    )
