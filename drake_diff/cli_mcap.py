"""The commands on logs: `drake-diff mcap info | check | recover` and `drake-diff export --ros2`."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from drake_diff.exceptions import ArtifactError, InputError

File = Annotated[Path, typer.Argument(help="An MCAP file that drake_diff wrote.")]

mcap = typer.Typer(no_args_is_help=True, help="Look at, check and repair trace.mcap.")


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.add_typer(mcap, name="mcap")
    app.command()(export)


@mcap.command()
def info(file: File) -> None:
    """List the channels of FILE with their messages and units, its metadata and its attachments."""
    from drake_diff.mcap_read import read_mcap

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
    from drake_diff.mcap_read import read_mcap

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
    from drake_diff.mcap_recover import recover_mcap

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
    from drake_diff.ros2_bag import export_ros2

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
