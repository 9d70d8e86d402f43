"""The metrics of a run: every measure of a solution and of its replay, by the name that it has in a record.

What a record says and what `verify` computes again come from here.

What physics keeps along a run's replay: energy of free motion, momentum, contact within its cone, limits.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.model.contact import ContactPoint
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied
from drake_diff.model.plant import FLOATING, bodies, joints
from drake_diff.model.step import set_state
from drake_diff.motion.rollout import Rollout, drift, smooth_mean
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE
from drake_diff.optimize.replay import Replay
from drake_diff.optimize.solution import INTEGRATION_TOLERANCE, Solution
from drake_diff.optimize.transcription.motion import violation_between_nodes
from drake_diff.record.parts import Metric
from drake_diff.record.solve import ReplayEvidence

ON_THE_PLANT = "in the open-loop replay on the discrete plant"
NO_REPLAY = "the discrete plant could not be stepped along these inputs"


def measured(
    name: str,
    definition: str,
    value: float,
    unit: str,
    tolerance: float | None = None,
    *,
    reason: str = "not finite",
    t_s: float | None = None,
) -> Metric:
    """A metric that is to be at most `tolerance`, or that informs; `reason` is why where `value` is not finite."""
    finite = math.isfinite(value)
    return Metric(
        name=name,
        definition=definition,
        unit=unit,
        value=float(value) if finite else None,
        reason=None if finite else reason,
        tolerance=tolerance,
        direction="info" if tolerance is None else "at_most",
        verdict="info" if tolerance is None else "pass" if value <= tolerance else "fail",
        t_s=t_s if finite else None,
    )


def units_of(solution: Solution, *kinds: str) -> str:
    """The units of the worst of several coordinates, out of positions, velocities, inputs, parameters: "rad or m"."""
    contract = solution.problem.model.contract
    units = [c.unit for kind in kinds if kind != "parameters" for c in getattr(contract, kind)]
    units += [p.unit for p in solution.vector.parameters] if "parameters" in kinds else []
    return " or ".join(dict.fromkeys(units))


def metrics_of(solution: Solution) -> list[Metric]:
    """Every measure of the solution and of its replay; those with a tolerance decide, the others inform."""
    tolerance, x = FEASIBILITY_TOLERANCE, units_of(solution, "positions", "velocities")
    bounded = units_of(solution, "positions", "velocities", "inputs", "parameters")
    worst = int(np.argmax(solution.defects)) if len(solution.defects) else 0
    found = [
        measured("cost", "objective of the states and inputs as the problem defines it", solution.cost, "1"),
        measured(
            "defect",
            "largest distance from the dynamics over one step",
            solution.defect,
            x,
            tolerance,
            t_s=float(solution.times[worst]),
        ),
        measured("goal error", "largest distance of the final state from the goal", solution.goal_error, x, tolerance),
        measured("bound violation", "largest excess over a bound", solution.bound_violation, bounded, tolerance),
        measured(
            "initial state error", "distance of the first state from x0", solution.initial_state_error, x, tolerance
        ),
        measured(
            "constraint violation",
            "largest excess over a bound of a constraint, or distance from a waypoint",
            solution.constraint_violation,
            "the constraint's",
            tolerance,
        ),
        measured("horizon", "time from the first state to the last", solution.horizon, "s"),
    ]
    if solution.transcribed is not None:
        definition = "largest distance of a knot from an accurate integration from the knot before"
        found.append(measured("integration error", definition, solution.integration_error, x, INTEGRATION_TOLERANCE))
        between = violation_between_nodes(solution.transcribed)
        for name, value, unit in (("state", between.state, x), ("input", between.input, units_of(solution, "inputs"))):
            definition = f"largest excess of the {name} over its bounds between the nodes, where no solver keeps them"
            found.append(measured(f"{name} excess between nodes", definition, value, unit))
    return found + _metrics_of_the_replay(solution)


def _metrics_of_the_replay(solution: Solution) -> list[Metric]:
    r, nothing = solution.replay, float("inf")
    x, q = units_of(solution, "positions", "velocities"), units_of(solution, "positions")
    here, missing = ON_THE_PLANT, "not finite" if solution.replay else NO_REPLAY
    values = (
        ("replay end error", f"largest distance of the final state {here} from the plan's", x),
        ("half-step end error", "the same, in steps half as long", x),
        ("energy drift", f"lasting energy that actuators and damping do not explain, {here}", "J"),
        ("energy oscillation", f"largest oscillation of that energy about its drift, {here}", "J"),
        ("energy scale", f"range of kinetic plus potential energy {here}", "J"),
        ("penetration", f"largest overlap of two geometries {here}", "m"),
        ("joint limit violation", f"largest excess over a joint limit or of a quaternion's norm {here}", q),
    )
    if r is None:
        return [measured(*words[:2], nothing, words[2], reason=missing) for words in values]
    numbers = (
        float(np.abs(r.xs[-1] - solution.xs[-1]).max()),
        solution.half_step_error,
        r.energy_drift,
        r.energy_oscillation,
        float(np.ptp(r.energy)),
        float(np.max(r.penetration)),
        float(np.max(r.constraint_violation)),
    )
    return [measured(*words[:2], number, words[2]) for words, number in zip(values, numbers, strict=True)]


def replay_evidence(r: Replay) -> ReplayEvidence:
    """A replay as it stands in a record."""
    goal, bound, energy, depth = (
        float(v) if math.isfinite(v) else None for v in (r.goal_error, r.bound_violation, r.energy_error, r.penetration)
    )
    return ReplayEvidence(
        variant=r.variant,
        control=r.control,
        time_step_s=r.time_step,
        contact_approximation=r.approximation,
        goal_error=goal,
        bound_violation=bound,
        energy_error_J=energy,
        penetration_m=depth,
        holds=r.holds,
        failures=list(r.failures),
    )


NAMES = {
    "free-motion energy drift": "J",
    "free-motion energy oscillation": "J",
    "linear momentum error": "N s",
    "angular momentum error": "N m s",
    "penetration": "m",
    "limit violation": "",  # the positions' own
    "friction-cone excess": "N",
}


def invariants_of(solution: Solution) -> list[Metric]:
    """Each invariant along the replay; null with a reason where it does not apply."""
    motion, units = solution.replay, {**NAMES, "limit violation": units_of(solution, "positions")}
    if motion is None:
        return [measured(name, ON_THE_PLANT, np.inf, unit, reason=NO_REPLAY) for name, unit in units.items()]
    free = _free_steps(solution.problem.model, motion)
    return [
        *_energy(motion, free),
        *_momentum(solution, motion, free),
        _worst("penetration", f"largest overlap of two geometries {ON_THE_PLANT}", "m", motion, motion.penetration),
        _worst(
            "limit violation",
            f"largest excess over a joint limit, or of a quaternion's norm over 1, {ON_THE_PLANT}",
            units["limit violation"],
            motion,
            motion.constraint_violation,
            reason="the plant has constraints (couplers, balls, welds), whose violation pydrake does not tell",
        ),
        _friction_cone(solution, motion),
    ]


def _worst(name: str, definition: str, unit: str, motion: Rollout, values: Array, reason: str = "not finite") -> Metric:
    worst = int(np.argmax(values))
    when = float(motion.times[worst])
    return measured(name, definition, float(values[worst]), unit, reason=reason, t_s=when)


def _free_steps(model: Model, motion: Rollout) -> int:
    """How many steps from the start there is neither contact nor a joint limit in the way."""
    lower, upper = model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()
    positions = motion.xs[:, : model.nq]
    beyond = np.any((positions <= lower) | (positions >= upper), axis=1)
    held = np.array([bool(c) for c in motion.contacts]) | beyond[1:]  # a limit is implicit: it acts before it is met
    return int(np.argmax(held)) if held.any() else len(held)


def _energy(motion: Rollout, free: int) -> Iterator[Metric]:
    """Of the first, free part: what neither actuators nor damping explain, drift apart from oscillation."""
    error = motion.energy_error[: free + 1]
    part = f"over the {free} steps from the start without contact, {ON_THE_PLANT}"
    names = list(NAMES)[:2]
    definitions = (
        f"lasting part of the energy that neither actuators nor damping explain, {part}",
        f"largest distance of that energy from its drift line, {part}",
    )
    lasting, swing = float("inf"), float("inf")
    if free > 0:
        lasting = drift(error)
        swing = float(np.abs(error - smooth_mean(error) - lasting * np.linspace(-0.5, 0.5, len(error))).max())
    for name, definition, value in zip(names, definitions, (lasting, swing), strict=True):
        yield measured(name, definition, value, "J", reason="there is contact, or a limit, from the first step on")


def _momentum(solution: Solution, motion: Rollout, free: int) -> Iterator[Metric]:
    """Of a system that nothing holds to the world: momentum less what gravity gave, and spin about the mass centre."""
    definitions = {
        "linear momentum error": "largest change of the linear momentum beyond gravity's, in free motion",
        "angular momentum error": "largest change of the angular momentum about the centre of mass, in free motion",
    }
    reason = _why_not_conserved(solution.problem.model, free)
    values = (np.inf, np.inf)
    if not reason:
        with applied(solution.vector) as model:
            values = _momentum_errors(model, motion, free)
    for (name, definition), value in zip(definitions.items(), values, strict=True):
        yield measured(name, definition, value, NAMES[name], reason=reason or "not finite")


def _why_not_conserved(model: Model, free: int) -> str:
    """Why momentum is not conserved in this model; empty where it is."""
    for joint in joints(model.plant):
        holds = model.plant.IsAnchored(joint.parent_body()) and not model.plant.IsAnchored(joint.child_body())
        if holds and joint.type_name() not in FLOATING:
            return f"{joint.name()} holds the model to the world, which takes up momentum"
        if joint.type_name() in FLOATING and np.any(np.asarray(joint.default_damping_vector()) != 0):
            return f"{joint.name()} is damped, which takes momentum away"
    return "" if free > 0 else "there is contact, or a limit, from the first step on"


def _momentum_errors(model: Model, motion: Rollout, free: int) -> tuple[float, float]:
    plant, context = model.plant, model.double.context
    linear, angular = [], []
    moving = [body for body in bodies(plant) if not plant.IsAnchored(body)]
    masses = np.array([body.get_mass(context) for body in moving])
    for x in motion.xs[: free + 1]:
        set_state(model.double, x)
        centres = [plant.EvalBodyPoseInWorld(context, b) @ b.CalcCenterOfMassInBodyFrame(context) for b in moving]
        centre = masses @ np.array(centres) / masses.sum()
        momentum = plant.CalcSpatialMomentumInWorldAboutPoint(context, centre)
        linear.append(np.asarray(momentum.translational()))
        angular.append(np.asarray(momentum.rotational()))
    pull = masses.sum() * np.asarray(plant.gravity_field().gravity_vector())
    change = np.array(linear) - linear[0] - motion.times[: free + 1, None] * pull
    return float(np.abs(change).max()), float(np.abs(np.array(angular) - angular[0]).max())


@dataclass(frozen=True)
class _Friction:
    """The coefficient of each body that has one for all its geometries."""

    by_body: dict[str, float]

    def between(self, contact: ContactPoint) -> float | None:
        """Drake's combination of the two; None where one is not known."""
        a, b = (self.by_body.get(body) for body in (contact.body_a, contact.body_b))
        if a is None or b is None:
            return None
        return 2 * a * b / (a + b) if a + b else 0.0


def _read_friction(model: Model) -> _Friction:
    found: dict[str, set[Any]] = {}
    for geometry in model.contract.geometries:
        found.setdefault(geometry.body, set()).add(geometry.friction)
    return _Friction({body: values.pop() for body, values in found.items() if len(values) == 1})


def _friction_cone(solution: Solution, motion: Rollout) -> Metric:
    """By how much a tangential contact force is larger than friction allows."""
    name, definition = "friction-cone excess", f"largest |f_t| - mu f_n of a contact's force {ON_THE_PLANT}"
    if any(parameter.name.endswith(".friction") for parameter in solution.vector.parameters):
        return measured(name, definition, np.inf, "N", reason="friction is a parameter here, not the contract's")
    known, worst, when = _read_friction(solution.problem.model), -np.inf, 0.0
    for time, contacts in zip(motion.times, motion.contacts, strict=False):
        for contact in contacts:
            mu = known.between(contact)
            if mu is None:
                pair = f"{contact.body_a} and {contact.body_b}"
                return measured(name, definition, np.inf, "N", reason=f"the friction between {pair} is not one number")
            push = float(contact.force @ contact.normal)
            excess = float(np.linalg.norm(contact.force - push * contact.normal)) - mu * push
            if excess > worst:
                worst, when = excess, float(time)
    return measured(name, definition, worst, "N", reason="nothing touches", t_s=when)
