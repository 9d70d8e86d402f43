"""Show measurements as tables, and save them as JSON with versions, machine and load."""

import json
import os
import platform
import subprocess
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from rich.console import Console
from rich.table import Table
from suite import Missing, Row
from timing import Spread

FORMAT = 1
SAME = 1e-6  # finite differences deviate by up to 1e-8, another contact law by 1e-3
PACKAGES = ["drake-diff", "drake", "numpy", "mujoco", "mujoco-mjx", "jax", "pin", "casadi", "adam-robotics"]
ROOT = Path(__file__).parents[2]


def machine() -> dict:
    """Return processor, cores, system and the load of the last minute."""
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "load": os.getloadavg()[0],
    }


def versions() -> dict[str, str | None]:
    """Return the versions of the packages (None if not installed) and the commit of this checkout."""
    found: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    done = subprocess.run(["git", "-C", ROOT, "describe", "--always", "--dirty"], capture_output=True, text=True)
    return found | {"commit": done.stdout.strip() or None}


def document(rows: list[Row], missing: list[Missing], before: dict, asked: dict) -> dict:
    """Return a run in the form in which it is saved. `before` is the machine at its start."""
    return {
        "format": FORMAT,
        "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "asked": asked,
        "machine": before | {"load_after": os.getloadavg()[0]},
        "versions": versions(),
        "rows": [row.as_dict() for row in rows],
        "missing": [asdict(one) for one in missing],
    }


def save(path: Path, found: dict) -> None:
    path.write_text(json.dumps(found, indent=1) + "\n")


def show(found: dict) -> None:
    """Print a table of ratios to the base for each quantity and horizon, and the missing measurements."""
    console = Console(width=None if Console().is_terminal else 190)
    about = found["machine"]
    console.print(
        f"{about['processor']}, {about['cores']} cores, load {about['load']:.1f} to {about['load_after']:.1f}; "
        f"{found['versions']['commit']}\nProcessor time over the base's: median of rounds, half the distance of their "
        f"quartiles. * an answer more than {SAME:g} of its largest entry (1 at least) from the base's."
    )
    rows = found["rows"]
    for quantity, horizon in dict.fromkeys((r["quantity"], r["horizon"]) for r in rows if r["quantity"] != "solve"):
        chosen = [r for r in rows if (r["quantity"], r["horizon"]) == (quantity, horizon)]
        console.print(_ratios(quantity + (f", {horizon} steps" if horizon else ""), chosen))
    if solves := [r for r in rows if r["quantity"] == "solve"]:
        console.print(_solves(solves))
    for line in [*_how(rows), *_missing(found["missing"])]:
        console.print(line, highlight=False)


def _how(rows: list[dict]) -> Iterator[str]:
    """Yield a line for each peer with the functions that were called for each quantity."""
    for peer in dict.fromkeys(row["peer"] for row in rows if row["quantity"] != "solve"):
        own = [row for row in rows if row["peer"] == peer and row["quantity"] != "solve"]
        told = dict.fromkeys((row["how"], row["quantity"]) for row in own)
        by = {how: [q for h, q in told if h == how] for how, _ in told}
        calls = "; ".join(f"{', '.join(quantities)}: {how}" for how, quantities in by.items())
        yield f"{peer}: {calls}; first calls up to {seconds(max(row['first'] for row in own))}"


def _missing(missing: list[dict]) -> Iterator[str]:
    """Yield a line for each reason, with its models."""
    models: dict[tuple[str, str, str], list[str]] = {}
    for one in missing:
        models.setdefault((one["peer"], one["quantity"], one["reason"]), []).append(one["model"])
    for (peer, quantity, reason), names in models.items():
        yield f"no {peer}, {quantity}, of {', '.join(names)}: {reason}"


def seconds(value: float) -> str:
    """Return a time with a unit that leaves one to three digits before the decimal point."""
    scale, unit = next(((s, u) for s, u in ((1.0, "s"), (1e3, "ms")) if value * s >= 1), (1e6, "us"))
    return f"{value * scale:.3g} {unit}"


def ratio(given: dict) -> str:
    """Return the median, and half the distance of the quartiles as a percentage of the median."""
    one = Spread(**given)
    return f"{one.median:.2g} ±{50 * (one.q3 - one.q1) / one.median:.0f}%"


def _ratios(title: str, rows: list[dict]) -> Table:
    base = rows[0]["base"]
    table = Table(title=title, title_justify="left")
    peers = list(dict.fromkeys(row["peer"] for row in rows if row["peer"] != base))
    for name in ("model", "joints", base, *peers):
        table.add_column(name, justify="left" if name == "model" else "right")
    for model in dict.fromkeys(row["model"] for row in rows):
        by = {row["peer"]: row for row in rows if row["model"] == model}
        own = by[base]
        cells = [ratio(by[peer]["ratio"]) + _apart(by[peer]["gap"]) if peer in by else "-" for peer in peers]
        table.add_row(model, str(own["joints"]), seconds(own["cpu"]["median"]), *cells)
    return table


def _apart(gap: float | None) -> str:
    """Return " *" if the result differs from the base's, else ""."""
    return " *" if gap is not None and gap > SAME else ""


def _solves(rows: Iterable[dict]) -> Table:
    table = Table(title="whole solves", title_justify="left")
    for name in ("problem", "who", "processor", "wall", "ratio", "to", "outcome"):
        table.add_column(name)
    for row in rows:
        times = (seconds(row[clock]["median"]) for clock in ("cpu", "wall"))
        table.add_row(row["model"], row["peer"], *times, ratio(row["ratio"]), row["base"], row["how"])
    return table
