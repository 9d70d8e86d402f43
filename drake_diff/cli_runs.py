"""The commands about runs that were saved: verify, list, compare-runs, schema.

What a record holds may be a stranger's text: it is printed without markup and without control characters.
"""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

COLOURS = {"pass": "green", "holds": "green", "fail": "red", "broken": "red"}
NOT_FOLDED = 160  # columns
RunDirectory = Annotated[Path, typer.Argument(help="A run directory.")]


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    app.command()(verify)
    app.command("list")(list_all)
    app.command()(compare_runs)
    app.command()(schema)


def plain(value: Any, style: str = "") -> Text:
    """`value` as text that changes nothing else on a terminal."""
    shown = "-" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return Text("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in shown), style=style)


def verify(run: RunDirectory) -> None:
    """Check every byte of RUN, run it again from its own files, and compare every number.

    Exit status 0 only where all of it holds, that is, where the record is true; the run's own verdict is printed
    beside it.
    """
    from drake_diff.verify import verify as verify_run

    console = _console()
    found = verify_run(run)
    for complaint in found.complaints:
        console.print(Text("  ").append_text(plain(complaint, "red")))
    for line in (*found.not_rerun, *found.notes):
        console.print(Text("  ").append_text(plain(line, "dim")))
    held = sum(c.holds for c in found.comparisons)
    verdict = "unknown" if found.record is None else found.record.verdict
    console.print(
        plain(found.verdict, f"{COLOURS.get(found.verdict, 'yellow')} bold"),
        plain(f"{run}: {held} of {len(found.comparisons)} numbers are the recorded ones; the run's verdict: {verdict}"),
    )
    raise typer.Exit(0 if found.holds else 1)


def list_all(directory: Annotated[Path, typer.Argument(help="Where the runs are.")] = Path("artifacts")) -> None:
    """List the runs in DIRECTORY by what their records say; `verify` tells whether that is true."""
    from drake_diff.runs import list_runs

    table = _table("run", "verdict", "status", "cost", "model", "written")
    for line in list_runs(directory):
        verdict = plain(line.verdict, COLOURS.get(line.verdict, "yellow"))
        words = (line.status, line.cost, line.model, line.written_utc)
        table.add_row(plain(line.name), verdict, *(plain(word) for word in words))
    _console().print(table)


def compare_runs(a: RunDirectory, b: RunDirectory) -> None:
    """Show what differs between the runs A and B: configuration, versions, metrics.

    Exit status 1 where a metric is defined otherwise in the two: such are not compared.
    """
    from drake_diff.runs import compare_runs as compare

    console, found = _console(), compare(a, b)
    for title in ("configuration", "versions", "metrics"):
        rows = getattr(found, title)
        console.print(plain(title if rows else f"{title}: no difference", "bold"))
        table = _table("", "A", "B")
        for row in rows:
            table.add_row(plain(row.key), plain(row.a), plain(row.b))
        if rows:
            console.print(table)
    for line in found.refused:
        console.print(plain(f"not compared: {line}", "red"))
    raise typer.Exit(0 if found.comparable else 1)


def schema() -> None:
    """Print the JSON Schema of record.json."""
    from drake_diff.record_schema import published_schema

    sys.stdout.write(published_schema().decode())


def _console() -> Console:
    return Console(soft_wrap=True, highlight=False, markup=False)


def wide_console() -> Console:
    """For tables of many columns: into a file or a pipe they are not folded to a terminal's width."""
    console = Console(soft_wrap=True, highlight=False, markup=False)
    return console if console.is_terminal else Console(soft_wrap=True, highlight=False, markup=False, width=NOT_FOLDED)


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in columns:
        table.add_column(name, overflow="fold")
    return table
