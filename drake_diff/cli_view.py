"""The commands to look at a run."""

import threading
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape


def view(run: Annotated[Path, typer.Argument(help="A run directory.")]) -> None:
    """Show the motion of RUN live in a browser on this machine, until Ctrl-C."""
    from drake_diff.view import serve

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
