"""A comparison of two saved runs: the factor by which each ratio changed, and the changes that exceed the spread.

The ratios are relative to a base that ran in the same rounds, so that two machines, or one machine at two loads, can be
compared. A row has changed if the interquartile ranges are disjoint and the medians differ by more than a factor LEAST.
"""

import json
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table
from table import FORMAT, ratio
from timing import Spread

from drake_diff.exceptions import InputError

LEAST = 1.1  # quartiles of a few rounds can differ by smaller factors by chance
KEY = ("model", "quantity", "horizon", "peer", "base")


@dataclass(frozen=True)
class Change:
    key: tuple  # as in KEY
    old: dict  # rows
    new: dict
    factor: float  # new ratio over old ratio
    changed: bool


def read(path: Path) -> dict:
    """Read a saved run. Raises InputError if the file does not have this format."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError("a saved run", got=f"{path}: {error}", expected="the JSON that --out writes") from error
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise InputError(f"the format of {path}", got=found, expected=f'"format": {FORMAT}')
    return found


def changes(old: dict, new: dict) -> tuple[list[Change], list[tuple]]:
    """Return the changes of the rows in both runs, without bases, and the keys of rows in only one run."""
    before, after = ({tuple(row[k] for k in KEY): row for row in run["rows"]} for run in (old, new))
    both = [key for key in before if key in after and key[-1] != key[-2]]
    return [_change(key, before[key], after[key]) for key in both], sorted(before.keys() ^ after.keys(), key=str)


def _change(key: tuple, old: dict, new: dict) -> Change:
    a, b = Spread(**old["ratio"]), Spread(**new["ratio"])
    factor = b.median / a.median
    disjoint = a.q3 < b.q1 or b.q3 < a.q1
    return Change(key, old, new, factor, disjoint and not 1 / LEAST <= factor <= LEAST)


def show(found: list[Change], alone: list[tuple]) -> None:
    """Print a table of the ratios. Changed ratios are first, and larger factors precede smaller ones."""
    console = Console(width=None if Console().is_terminal else 150)
    table = Table(title=f"{sum(c.changed for c in found)} of {len(found)} ratios changed", title_justify="left")
    for name in ("", "model", "quantity", "peer", "old", "new", "new / old"):
        table.add_column(name)
    for one in sorted(found, key=lambda c: (not c.changed, -max(c.factor, 1 / c.factor))):
        model, quantity, horizon, peer, _ = one.key
        steps = f", {horizon} steps" if horizon else ""
        told = "" if not one.changed else "slower" if one.factor > 1 else "faster"
        ratios = (ratio(row["ratio"]) for row in (one.old, one.new))
        table.add_row(told, model, quantity + steps, peer, *ratios, f"{one.factor:.2f}")
    console.print(table)
    for key in alone:
        console.print(f"in one file alone: {', '.join(str(part) for part in key[:4] if part)}", highlight=False)
