"""The command that compares engines.

The command `drake-diff export-model`.
"""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from drake_diff.cli.runs import plain, wide_console
from drake_diff.cli.text import Approximation, ContactModel, Geometry, Ground, ModelFile, TimeStep, WeldBase

COLOURS = {"same": "green", "other law": "yellow", "other model": "red", "unexplained": "red"}


def add_commands(app: typer.Typer) -> None:
    """The commands of this module, added to `app`."""
    _add_engine_commands(app)
    _add_export_commands(app)


def _add_engine_commands(app: typer.Typer) -> None:
    """Add the command of this module to `app`."""
    app.command()(compare)


def compare(
    model: ModelFile,
    engines: Annotated[
        str | None, typer.Option(help="Names with commas between, drake:lagged among them; all where not given.")
    ] = None,
    recording: Annotated[
        list[Path] | None, typer.Option(help="A recorded motion: CSV, MCAP or a ROS 2 bag; all run its motion.")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(help="How many steps the motion has; one second where not given.")
    ] = None,
    seed: Annotated[int, typer.Option(help="The same seed gives the same start, inputs and states.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Directory; artifacts/compare_<model> where not given.")] = None,
    time_step: TimeStep = 0.01,
    contact_approximation: Approximation = "sap",
    contact_geometry: Geometry = None,
    weld_base: WeldBase = None,
    ground: Ground = None,
) -> None:
    """Simulate MODEL in every engine on one contract, and say which are the same, which are not, and why.

    Exit status 0 only where every engine is the same as Drake or differs by a law that its contract tells of.
    """
    from drake_diff.comparison.files import PAGE, begin_comparison, save_comparison
    from drake_diff.comparison.recordings import read_recording
    from drake_diff.comparison.side_by_side import compare as compare_engines
    from drake_diff.model.model import load_model

    loaded = load_model(
        model,
        time_step=time_step,
        contact_approximation=contact_approximation,
        contact_geometry=contact_geometry,
        weld_base=weld_base,
        ground=ground,
    )
    directory = out or Path("artifacts") / f"compare_{model.stem}"
    recordings = [read_recording(path, loaded) for path in recording or ()]
    begin_comparison(directory, loaded)
    names = None if engines is None else [name.strip() for name in engines.split(",") if name.strip()]
    found = compare_engines(loaded, names, recordings=recordings, num_steps=steps, seed=seed)
    record = save_comparison(found, directory)
    _print(record)
    print(f"wrote {directory / PAGE}")
    raise typer.Exit(0 if record.verdict == "pass" else 1)


def _print(record: Any) -> None:
    console = wide_console()
    table = Table(box=None, pad_edge=False)
    for name in ("engine", "verdict", "step gap", "apart from", "Jacobian gap", "its own", "step", "Jacobian"):
        table.add_column(name, no_wrap=name != "engine")
    clock = record.wall_clock
    for i, e in enumerate(record.engines):
        verdict = plain(e.verdict, COLOURS[e.verdict]) if i else plain("reference", "dim")
        own = {"its own step's": "yes", "not its own step's": "no"}.get(e.gradient, e.gradient)
        table.add_row(
            plain(e.engine),
            verdict,
            f"{e.largest_step_gap:.1e}",
            "" if e.first_apart_s is None else f"{e.first_apart_s:.4g} s",
            f"{max((j.gap for j in e.jacobians), default=0.0):.1e}",
            plain(own, "red" if own == "no" else ""),
            _time(clock.seconds_per_step[e.engine]),
            _time(clock.seconds_per_jacobian[e.engine]),
        )
    console.print(table)
    for e in record.engines[1:]:
        console.print(plain(e.engine, "bold"), plain(e.sentence))
    for r in record.refused:
        console.print(plain(r.engine, "bold dim"), plain(f"not compared: {r.reason}", "dim"))
    console.print(
        plain(record.verdict, f"{'green' if record.verdict == 'pass' else 'red'} bold"), plain(record.sentence)
    )


def _time(seconds: float | None) -> str:
    return "-" if seconds is None else f"{1e6 * seconds:.0f} µs"


def _add_export_commands(app: typer.Typer) -> None:
    """Add the command of this module to `app`."""
    app.command("export-model")(export_model_command)


def export_model_command(
    model: ModelFile,
    to: Annotated[str, typer.Option(help="gazebo, isaaclab, urdf, sdf or mjcf")],
    out: Annotated[Path, typer.Option(help="A directory that does not exist.")],
    time_step: TimeStep = 0.01,
    contact_model: ContactModel = "point",
    contact_approximation: Approximation = "sap",
    contact_geometry: Geometry = None,
    weld_base: WeldBase = None,
    ground: Ground = None,
) -> None:
    """Write MODEL for an engine that cannot be had here: model file, contract, states to start from, what to record."""
    from drake_diff.export.export import export_model
    from drake_diff.model.model import load_model

    loaded = load_model(
        model,
        time_step=time_step,
        contact_model=contact_model,
        contact_approximation=contact_approximation,
        contact_geometry=contact_geometry,
        weld_base=weld_base,
        ground=ground,
    )
    files = export_model(loaded, out, target=to)
    Console(soft_wrap=True, highlight=False, markup=False).print(plain("wrote " + ", ".join(map(str, files))))
