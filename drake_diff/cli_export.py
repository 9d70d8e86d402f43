"""The command `drake-diff export-model`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from drake_diff.cli_options import Approximation, ContactModel, Geometry, Ground, ModelFile, TimeStep, WeldBase
from drake_diff.cli_runs import plain


def add_commands(app: typer.Typer) -> None:
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
    from drake_diff.engines.export import export_model
    from drake_diff.model import load_model

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
