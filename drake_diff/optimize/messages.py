"""How checks and verdicts of plans read."""

from collections.abc import Sequence
from typing import Any

# {name} and {time} are the two parts of a check's `where` that " at " joins.
CLAUSES = {
    "bound": "{name} is {value} beyond its bound at {time}, tolerance {tolerance}",
    "chain": "through all phases, {where}, {value} of its range, tolerance {tolerance}",
    "clearance": "{name} come {value} nearer than their margin at {time}, tolerance {tolerance}",
    "constraint": "{name} is broken by {value} at {time}, tolerance {tolerance}",
    "cost": "the cost that was minimized is {value} from that of the motion, tolerance {tolerance}",
    "defect": "defect {value} is above {tolerance}: the motion does not follow the dynamics after {where}",
    "depth": "{name} is broken at {time}, {value} of the ranges of states and inputs from where it holds",
    "derivative": "a certificate of derivatives does not agree: {where}",
    "end": "{where} ends {value} from the plan's end, tolerance {tolerance}",
    "energy": "{value} of energy are {where}, tolerance {tolerance}",
    "following": "{name} is {value} from the plan at {time}, tolerance {tolerance}",
    "goal": "{where} ends {value} from its goal, tolerance {tolerance}",
    "horizon": "{where} take {value} beyond the horizon, tolerance {tolerance}",
    "impact": "{where}",
    "integration": "an accurate integration from {time} misses the next in {name} by {value}, tolerance {tolerance}",
    "link": "{name} is missed by {value} in {time}, tolerance {tolerance}",
    "model": "another plant: {where}",
    "motion": "{where}",
    "overlap": "geometries overlap by {value} at {time}, and collocation leaves contact out",
    "passage": "the motion goes through what {name} forbids at {time}",
    "penetration": "geometries overlap by {value} at {time}, limit {tolerance} (a quarter of {name})",
    "regulator": "the regulator of its {where} does not converge from its end",
    "start": "{where} starts {value} from x0, tolerance {tolerance}",
}
BETWEEN = ("between the nodes", "between the knots")
NO_UNIT = ("1", "", "unknown")


def quantity(value: float, unit: str) -> str:
    """A number with its unit: "0.05 rad"."""
    return f"{value:.3g}" if unit in NO_UNIT else f"{value:.3g} {unit}"


def clause(c: Any) -> str:
    """A `Check` as a clause."""
    name, _, time = c.where.rpartition(" at ")
    values = {"value": quantity(c.value, c.unit), "tolerance": quantity(c.tolerance, c.unit)}
    text = CLAUSES[c.what].format(name=name or c.where, time=time, where=c.where, **values)
    return f"{c.plant} {text}" if c.plant in BETWEEN else text


def under(control: str) -> str:
    """The words of a control: "open loop", "under TVLQR"."""
    return control if control == "open loop" else f"under {control}"


def followed(checks: Sequence[Any]) -> str:
    """Where the dynamics lead from the first state of a plan, under each feedback that was tried."""
    verdicts = "; ".join(f"{under(c.feedback or 'open loop')}, {c}" for c in checks)
    return f"integrated from its first state the plan does not hold: {verdicts}"


def broken_variant(variant: str, replays: Sequence[Any]) -> str:
    """Why a plan holds in a variant of the plant under no control."""
    reasons = "; ".join(f"{r.control}, {r.failures[0]}" for r in replays)
    return f"replayed {variant} it does not hold: {reasons}"


def controls(replays: Sequence[Any], decides: Sequence[str], *, finest: bool) -> str:
    """Under which controls a plan that holds does so, and under which it does not and why.

    `finest` says that `decides` are the finest steps that were tried.
    """
    if not replays:
        return ""
    if not decides:
        return "on the plant nothing was replayed in finer steps, which a diagram does not allow"
    tried = list(dict.fromkeys(r.control for r in replays))
    good = [c for c in tried if all(r.holds for r in replays if r.control == c and r.variant in decides)]
    if not good:
        where = ", ".join(f"{r.variant} {under(r.control)}" for r in replays if r.holds and r.variant in decides)
        return f"on the plant, {where}; nowhere under both"
    text = "on the plant " + " and ".join(map(under, good)) + (f" {decides[0]} or less" if finest else "")
    for control in tried:
        failed = [r for r in replays if r.control == control and not r.holds]
        if failed and control in good:  # in steps that do not decide
            text += f"; {under(control)} {failed[0].variant}, where steps are longer, not: {failed[0].failures[0]}"
        elif failed:
            text += f", not {under(control)}: {failed[0].variant}, {failed[0].failures[0]}"
    return text
