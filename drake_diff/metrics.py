"""The metrics of a run: every measure of a solution and of its replay, by the name that it has in a record.

What a record says and what `verify` computes again come from here.
"""

import math

import numpy as np

from drake_diff.nonlinear_program import FEASIBILITY_TOLERANCE
from drake_diff.record import ReplayEvidence
from drake_diff.record_parts import Metric
from drake_diff.replay import Replay
from drake_diff.solution import INTEGRATION_TOLERANCE, Solution
from drake_diff.transcribed import violation_between_nodes

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
