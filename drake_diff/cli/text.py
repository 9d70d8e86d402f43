"""The options of commands that load a model."""

from pathlib import Path
from typing import Annotated

import typer

ModelFile = Annotated[Path, typer.Argument(help="A URDF, SDF, MJCF (.xml) or .dmd.yaml file.")]
TimeStep = Annotated[float, typer.Option(help="[s]")]
ContactModel = Annotated[str, typer.Option(help="point, hydroelastic or hydroelastic_with_fallback")]
Approximation = Annotated[str, typer.Option(help="sap, similar or lagged")]
Geometry = Annotated[str | None, typer.Option(help="Around refused pairs: corner_spheres, hydroelastic, differences")]
WeldBase = Annotated[str | None, typer.Option(help="A link to fix to the world.")]
Ground = Annotated[float | None, typer.Option(help="Friction [1] of a ground to add.")]
