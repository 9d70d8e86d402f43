"""Texts of checks and verdicts of plans."""

from collections.abc import Sequence
from typing import Any

FEW = 4  # number of names of a list that are written out
LONGEST = 160  # characters of a message, so that it fits on one line

# {name} and {time} are the parts of a check's `where` before and after " at ".
CLAUSES = {
    "left-out pair": "{where} overlap where the file has them: SelfCollision(ignore=) says which may",
    "bound": "{name} is {value} beyond its bound at {time}, tolerance {tolerance}",
    "chain": "through all phases, {where}, {value} of its range, tolerance {tolerance}",
    "clearance": "{name} come {value} nearer than their margin at {time}, tolerance {tolerance}",
    "constraint": "{name} is broken by {value} at {time}, tolerance {tolerance}",
    "cost": "the cost that was minimized is {value} from that of the motion, tolerance {tolerance}",
    "replayed cost": "the cost is {value} from the plan's, tolerance {tolerance}",
    "defect": "defect {value} is above {tolerance}: the motion does not follow the dynamics after {where}",
    "depth": "{name} is broken at {time}, {value} of the ranges of states and inputs from where it holds",
    "derivative": "a certificate of derivatives does not agree: {where}",
    "energy": "{value} of energy are {where}, tolerance {tolerance}",
    "following": "{name} is {value} from the plan at {time}, tolerance {tolerance}",
    "goal": "{where} ends {value} from its goal, tolerance {tolerance}",
    "horizon": "{where} take {value} beyond the horizon, tolerance {tolerance}",
    "impact": "{where}",
    "integration": "an accurate integration from {time} misses the next in {name} by {value}, tolerance {tolerance}",
    "jump": "{name} jumps by {value} at {time}: a derivative does not see that",
    "link": "{name} is missed by {value} in {time}, tolerance {tolerance}",
    "loop": "points of a loop are {value} from each other {where}, tolerance {tolerance}: smaller steps hold it closer"
    ", unless the velocities at the start open it",
    "model": "another plant: {where}",
    "motion": "{where}",
    "overlap": "geometries overlap by {value} at {time}, and collocation leaves contact out",
    "passage": "the motion goes through what {name} forbids at {time}",
    "penetration": "geometries overlap by {value} at {time}, limit {tolerance} (a quarter of {name})",
    "regulator": "the regulator of its {where} does not converge from its end",
    "traced": "{name} with derivatives is {value} from that of plain numbers at {time}, tolerance {tolerance}",
    "start": "{where} starts {value} from x0, tolerance {tolerance}",
}
BETWEEN = ("between the nodes", "between the knots")
NO_UNIT = ("1", "", "unknown")


def quantity(value: float, unit: str) -> str:
    """Format a number with its unit, such as "0.05 rad"."""
    return f"{value:.3g}" if unit in NO_UNIT else f"{value:.3g} {unit}"


def clause(c: Any) -> str:
    """Describe a `Check` in a clause."""
    name, _, time = c.where.rpartition(" at ")
    values = {"value": quantity(c.value, c.unit), "tolerance": quantity(c.tolerance, c.unit)}
    text = CLAUSES[c.what].format(name=name or c.where, time=time, where=c.where, **values)
    return f"{c.plant} {text}" if c.plant in BETWEEN else text


def under(control: str | None) -> str:
    """Describe a controller: "open loop" or "under TVLQR"."""
    return "open loop" if control in (None, "open loop") else f"under {control}"


def in_milliseconds(seconds: float) -> str:
    """Format a time step in milliseconds, such as "20 ms"."""
    return f"{1e3 * seconds:.4g} ms"


def headline(status: str, text: str) -> str:
    """Return the status and the most important text, in at most LONGEST characters."""
    line = f"{status}: {text}" if text else status
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 3].rstrip()}..."


def joined(words: Sequence[str]) -> str:
    """Join words by commas and one "and". A long list has its first words and the number of other words."""
    words = list(dict.fromkeys(words))
    if len(words) > FEW + 1:
        words = [*words[:FEW], f"{len(words) - FEW} more"]
    return ", ".join(words[:-1]) + " and " + words[-1] if len(words) > 1 else words[0]
