"""Commands that repeat what was found with the toolkit: gradients of different orders, contact laws of the engines."""

from pathlib import Path
from typing import Annotated

import typer

from drake_diff.cli.text import names_in, names_option, out_option, plain, progress_line, show, table

COLOURS = {"rigid answer": "green", "right": "green", "own law's": "yellow", "not asked": "dim", "none": "dim"}


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    app.command()(gradient_panel)
    app.command()(contact_table)


def gradient_panel(
    cases: Annotated[str | None, names_option("Cases", "all")] = None,
    samples: Annotated[int, typer.Option(help="How many samples one estimate takes.")] = 30,
    seeds: Annotated[int, typer.Option(help="How many estimates and how many descents.")] = 10,
    out: Annotated[Path | None, out_option("artifacts/gradient_panel")] = None,
) -> None:
    """Compare first-order, zeroth-order and blended gradients: variance, bias, and whether a descent arrives.

    All cases take minutes. Writes gradient_panel.json, .csv and .html.
    """
    from drake_diff.studies.gradient_study import PAGE, save_gradient_panel
    from drake_diff.studies.gradient_study import gradient_panel as compare

    directory = out or Path("artifacts/gradient_panel")
    with progress_line("comparing", stderr=True) as report:
        found = compare(names_in(cases), samples=samples, seeds=seeds, progress=report)
    save_gradient_panel(found, directory)
    typer.echo(str(found))
    show(f"wrote {directory / PAGE}")


def contact_table(
    engines: Annotated[str | None, names_option("Engines, such as mujoco or drake:lagged", "all installed")] = None,
    out: Annotated[Path | None, typer.Option(dir_okay=False, help="A JSON file to write as well.")] = None,
) -> None:
    """Rest, stop, slide, hold, roll and bounce in every engine, beside the rigid answer and the engine's own law.

    Exit status 1 if a value is neither.
    """
    from drake_diff._base.files import write_whole
    from drake_diff.studies.contact_comparison import as_json, lines_of
    from drake_diff.studies.contact_comparison import contact_table as compare

    found = compare(names_in(engines))
    names = ("case", "engine", "value", "rigid", "own law", "verdict", "gradient", "rigid", "own law", "verdict")
    rows = table(*names, wrap=False)
    for row in found.rows:
        values = (plain(number) for number in (row.value, row.rigid, row.law))
        gradients = (plain(number) for number in (row.gradient, row.rigid_gradient, row.law_gradient))
        verdict, gradient = (plain(v, COLOURS.get(v, "red")) for v in (row.verdict, row.gradient_verdict))
        rows.add_row(plain(row.case), plain(row.engine), *values, verdict, *gradients, gradient)
    show(rows)
    for engine in found.engines:
        first, *reasons = lines_of(found, engine)
        show(plain(engine, "bold"), first)
        for reason in reasons:
            show(plain(f"    {reason}", "dim"))
    for refused in found.refused:
        show(plain(f"{refused.engine} is not installed: {refused.reason}", "dim"))
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_whole(out, as_json(found).encode())
        show(f"wrote {out}")
    raise typer.Exit(1 if found.off else 0)
