"""The commands on logs: `drake-diff mcap info | check | recover` and `drake-diff export --ros2`.

The commands about runs that were saved: verify, list, compare-runs, schema.

What a record holds may be a stranger's text: it is printed without markup and without control characters.

The commands to look at a run.
"""

import sys
import threading
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from drake_diff.exceptions import ArtifactError, InputError

File = Annotated[Path, typer.Argument(help="An MCAP file that drake_diff wrote.")]

mcap = typer.Typer(no_args_is_help=True, help="Look at, check and repair trace.mcap.")


def add_commands(app: typer.Typer) -> None:
    """The commands of this module, added to `app`."""
    _add_log_commands(app)
    _add_run_commands(app)


def _add_log_commands(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.add_typer(mcap, name="mcap")
    app.command()(export)


@mcap.command()
def info(file: File) -> None:
    """List the channels of FILE with their messages and units, its metadata and its attachments."""
    from drake_diff.logs.read import read_mcap

    log, console = read_mcap(file), _console()
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in ("channel", "schema", "messages", "from [s]", "to [s]"):
        table.add_column(escape(name), justify="left" if name in ("channel", "schema") else "right")
    for topic, messages in log.messages.items():
        ends = [f"{messages[i][0] / 1e9:g}" for i in (0, -1)] if messages else ["", ""]
        schema = log.message_types[topic].DESCRIPTOR.full_name
        table.add_row(escape(topic), escape(schema), str(len(messages)), *ends)
    console.print(table)
    for topic, metadata in log.channel_metadata.items():
        console.print(f"units of {escape(topic)}: {escape(_short(metadata.get('units', {})))}")
    for name, record in log.metadata.items():
        for key, value in record.items():
            console.print(f"{escape(name)}.{escape(key)} = {escape(_printable(value))}")
    for name, data in log.attachments.items():
        console.print(f"attached {escape(_printable(name))}, {len(data)} bytes")


@mcap.command()
def check(file: File) -> None:
    """Check every checksum (chunks, data, summary, attachments) and schema of FILE. Exit status 1 where one fails."""
    from drake_diff.logs.read import read_mcap

    console = _console()
    try:
        log = read_mcap(file)
    except ArtifactError as error:
        console.print(f"[red bold]damaged[/]  {escape(_printable(str(error)))}")
        raise typer.Exit(1) from error
    count = sum(len(messages) for messages in log.messages.values())
    console.print(
        f"[green bold]whole[/]  {escape(str(file))}: {count} messages in {len(log.messages)} channels, "
        f"{len(log.attachments)} attachments, every checksum holds"
    )


@mcap.command()
def recover(file: File, out: Annotated[Path, typer.Argument(help="The file to write.")]) -> None:
    """Copy what can be read of FILE, up to the first damage, to OUT; OUT's metadata say so."""
    from drake_diff.logs.read import recover_mcap

    done = recover_mcap(file, out)
    stopped = f"stopped at {done.stopped_at}" if done.stopped_at else "it was whole"
    _console().print(
        f"{done.messages} messages and {done.attachments} attachments to {escape(str(out))}; "
        f"{escape(_printable(stopped))}"
    )


def export(
    run: Annotated[Path, typer.Argument(help="A run directory.")],
    out: Annotated[Path | None, typer.Argument(help="Bag directory; RUN_ros2 beside RUN where not given.")] = None,
    ros2: Annotated[bool, typer.Option("--ros2", help="A bag that `ros2 bag` reads.")] = False,
) -> None:
    """Write the motion in RUN for other tools."""
    from drake_diff.artifact.ros2 import export_ros2

    if not ros2:
        raise InputError("export", got="no format", expected="--ros2")
    folder = out or run.resolve().with_name(f"{run.resolve().name}_ros2")
    counts = export_ros2(run, folder)
    topics = ", ".join(f"{topic} {count}" for topic, count in counts.items())
    _console().print(f"wrote {escape(str(folder))}: {topics}")


def _console() -> Console:
    return Console(soft_wrap=True, highlight=False)


def _short(units: dict[str, Any]) -> str:
    parts = []
    for name, unit in units.items():
        parts.append(f"{name} [{unit}]" if isinstance(unit, str) else f"{name} ({_short(unit)})")
    return _printable(", ".join(parts))


def _printable(text: str) -> str:
    """Control characters, which could drive the terminal, as escapes."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


COLOURS = {"pass": "green", "holds": "green", "fail": "red", "broken": "red"}
NOT_FOLDED = 160  # columns
RunDirectory = Annotated[Path, typer.Argument(help="A run directory.")]


def _add_run_commands(app: typer.Typer) -> None:
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

    RUN is what a solve, a comparison, robustness trials or a certification wrote. Exit status 0 only where every number
    came out again. Comparisons and robustness trials are not run again: where their files are as they were written
    they are "intact", with exit status 1. The run's own verdict is printed beside.
    """
    from drake_diff.artifact.verify import verify as verify_run

    console = _console_of_cli_runs()
    found = verify_run(run)
    for complaint in found.complaints:
        console.print(Text("  ").append_text(plain(complaint, "red")))
    for line in (*found.not_rerun, *found.notes):
        console.print(Text("  ").append_text(plain(line, "dim")))
    verdict = "unknown" if found.record is None else found.record.verdict
    console.print(
        plain(found.verdict, f"{COLOURS.get(found.verdict, 'yellow')} bold"),
        plain(f"{run}: {_counted(found)}; the run's verdict: {verdict}"),
    )
    raise typer.Exit(0 if found.holds else 1)


def _counted(found: Any) -> str:
    if found.verdict == "intact":
        return str(found.sentence)
    held = sum(c.holds for c in found.comparisons)
    return f"{held} of {len(found.comparisons)} numbers are the recorded ones"


def list_all(directory: Annotated[Path, typer.Argument(help="Where the runs are.")] = Path("artifacts")) -> None:
    """List the records in DIRECTORY by what they say; `verify` tells whether that is true."""
    from drake_diff.artifact.listing import list_runs

    table = _table("run", "verdict", "kind", "status", "cost", "model", "written")
    for line in list_runs(directory):
        verdict = plain(line.verdict, COLOURS.get(line.verdict, "yellow"))
        words = (line.kind, line.status, line.cost, line.model, line.written_utc)
        table.add_row(plain(line.name), verdict, *(plain(word) for word in words))
    wide_console().print(table)


def compare_runs(a: RunDirectory, b: RunDirectory) -> None:
    """Show what differs between the runs A and B: configuration, versions, metrics.

    Exit status 1 where a metric is defined otherwise in the two: such are not compared.
    """
    from drake_diff.artifact.listing import compare_runs as compare

    console, found = _console_of_cli_runs(), compare(a, b)
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
    from drake_diff.record.solve import EvidenceRecord

    sys.stdout.write(EvidenceRecord.published_schema().decode())


def _console_of_cli_runs() -> Console:
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


def view(run: Annotated[Path, typer.Argument(help="A run directory.")]) -> None:
    """Show the motion of RUN live in a browser on this machine, until Ctrl-C."""
    from drake_diff.artifact.live import serve

    console = Console(soft_wrap=True, highlight=False)
    try:
        meshcat, notes = serve(run)
        for note in notes:
            console.print(f"[yellow]{escape(note)}[/]")
        # Not by the console: interrupted after it has written, it writes what it has written once more.
        typer.echo(f"{run} is at {meshcat.web_url()} (Ctrl-C ends it)")
        threading.Event().wait()
    except KeyboardInterrupt:
        typer.echo("ended")
