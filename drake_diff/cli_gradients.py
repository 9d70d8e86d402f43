"""The command that compares gradients of different orders."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console


def add_commands(app: typer.Typer) -> None:
    """Add the command of this module to `app`."""
    app.command()(gradient_panel)


def gradient_panel(
    cases: Annotated[str | None, typer.Option(help="Names with commas between; all where not given.")] = None,
    samples: Annotated[int, typer.Option(help="Of one estimate.")] = 30,
    seeds: Annotated[int, typer.Option(help="How many estimates and how many descents.")] = 10,
    out: Annotated[Path, typer.Option(help="Directory.")] = Path("artifacts/gradient_panel"),
) -> None:
    """Compare first-order, zeroth-order and blended gradients: variance, bias, and whether a descent arrives.

    All cases take minutes. Writes gradient_panel.json, .csv and .html.
    """
    from drake_diff.gradient_panel import gradient_panel as compare
    from drake_diff.gradient_panel_files import PAGE, save_gradient_panel

    names = None if cases is None else [name.strip() for name in cases.split(",") if name.strip()]
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    panel = compare(names, samples=samples, seeds=seeds, progress=lambda name: console.print(f"[dim]{name}[/]"))
    save_gradient_panel(panel, out)
    print(panel)
    print(f"wrote {out / PAGE}")
