"""The command that compares gradients of different orders.

The command contact-table: the textbook contact cases in every engine.
"""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from drake_diff.cli.runs import plain, wide_console


def add_commands(app: typer.Typer) -> None:
    """The commands of this module, added to `app`."""
    _add_gradient_commands(app)
    _add_contact_commands(app)


def _add_gradient_commands(app: typer.Typer) -> None:
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
    from drake_diff.studies.gradient_study import PAGE, save_gradient_panel
    from drake_diff.studies.gradient_study import gradient_panel as compare

    names = None if cases is None else [name.strip() for name in cases.split(",") if name.strip()]
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    panel = compare(names, samples=samples, seeds=seeds, progress=lambda name: console.print(f"[dim]{name}[/]"))
    save_gradient_panel(panel, out)
    print(panel)
    print(f"wrote {out / PAGE}")


COLOURS = {"rigid answer": "green", "right": "green", "own law's": "yellow", "not asked": "dim", "none": "dim"}


def _add_contact_commands(app: typer.Typer) -> None:
    """Add the command of this module to `app`."""
    app.command("contact-table")(table)


def table(
    engines: Annotated[
        str | None, typer.Option(help="Names with commas between: drake,drake:lagged,mujoco. All there are.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="A JSON file to write too.")] = None,
) -> None:
    """Rest, stop, slide, hold, roll and bounce in every engine, beside the rigid answer and the engine's own law.

    Exit status 1 where a value is neither.
    """
    from drake_diff._base.files import write_whole
    from drake_diff.studies.contact_comparison import as_json, contact_table, lines_of

    found = contact_table(None if engines is None else engines.split(","))
    console = wide_console()
    shown = Table(box=None, pad_edge=False, header_style="dim")
    for name in ("case", "engine", "value", "rigid", "own law", "verdict", "gradient", "rigid", "own law", "verdict"):
        shown.add_column(name, no_wrap=True)
    for row in found.rows:
        numbers = [
            plain(number)
            for number in (row.value, row.rigid, row.law, row.gradient, row.rigid_gradient, row.law_gradient)
        ]
        verdict, gradient = (plain(v, COLOURS.get(v, "red")) for v in (row.verdict, row.gradient_verdict))
        shown.add_row(plain(row.case), plain(row.engine), *numbers[:3], verdict, *numbers[3:], gradient)
    console.print(shown)
    for engine in found.engines:
        first, *reasons = lines_of(found, engine)
        console.print(plain(engine, "bold"), plain(first))
        for reason in reasons:
            console.print(plain(f"    {reason}", "dim"))
    for refused in found.refused:
        console.print(plain(f"{refused.engine} is not there: {refused.reason}", "dim"))
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_whole(out, as_json(found).encode())
        console.print(plain(f"wrote {out}"))
    raise typer.Exit(1 if found.off else 0)
