"""What all commands share: options, the loading of a model, and text that is safe to print.

What a record or a model says may be a stranger's text: it is printed without markup and control characters.
"""

import functools
import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

NOT_FOLDED = 160  # columns
GREEN, RED, YELLOW = ("pass", "holds", "agree"), ("fail", "broken", "error", "damaged"), ("warning",)

ModelFile = Annotated[Path, typer.Argument(metavar="MODEL", help="A URDF, SDF, MJCF (.xml) or .dmd.yaml file.")]
RunDirectory = Annotated[Path, typer.Argument(metavar="RUN", help="A run directory.")]
TimeStep = Annotated[float, typer.Option(help="Time step of the discrete plant, in seconds.")]
ContactModel = Annotated[str, typer.Option(help="point, hydroelastic or hydroelastic_with_fallback")]
Approximation = Annotated[str, typer.Option(help="sap, similar or lagged")]
Geometry = Annotated[
    str | None, typer.Option(help="For pairs of shapes that Drake refuses: corner_spheres, hydroelastic or differences")
]
WeldBase = Annotated[str | None, typer.Option(help="A link to fix to the world.")]
Ground = Annotated[float | None, typer.Option(help="Add a ground plane with this friction coefficient.")]
Seed = Annotated[int, typer.Option(min=0, help="The same seed gives the same draws.")]


def out_option(default: str) -> Any:
    """The option for the directory that a command writes."""
    return typer.Option("--out", file_okay=False, show_default=default, help="Directory to write.")


def names_option(what: str, otherwise: str) -> Any:
    """An option that takes names with commas between; see `names_in`."""
    return typer.Option(metavar="NAMES", show_default=otherwise, help=f"{what}, with commas between.")


def names_in(words: str | None) -> list[str] | None:
    """The names in "a, b"; None for None."""
    return None if words is None else [name.strip() for name in words.split(",") if name.strip()]


def takes_model(command: Callable[..., None]) -> Callable[..., None]:
    """`command(model, file, ...)` as a command with the argument MODEL and the options of `load_model`.

    Typer reads options from a function's signature, so this one writes them there, once for all commands.
    """
    loading = inspect.signature(_load).parameters
    own = [p for p in inspect.signature(command).parameters.values() if p.name not in ("model", "file")]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        file = given["model"]
        command(_load(**{name: given.pop(name) for name in loading}), file, **given)

    model, *options = loading.values()
    parameters = [model, *own, *options]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


def _load(
    model: ModelFile,
    time_step: TimeStep = 0.01,
    contact_model: ContactModel = "point",
    contact_approximation: Approximation = "sap",
    contact_geometry: Geometry = None,
    weld_base: WeldBase = None,
    ground: Ground = None,
) -> Any:
    from drake_diff.model.model import load_model

    return load_model(
        model,
        time_step=time_step,
        contact_model=contact_model,
        contact_approximation=contact_approximation,
        contact_geometry=contact_geometry,
        weld_base=weld_base,
        ground=ground,
    )


def console(*, stderr: bool = False) -> Console:
    """A console without markup; tables in a file or pipe are not folded to a terminal's width."""
    found = Console(soft_wrap=True, highlight=False, markup=False, stderr=stderr)
    if not found.is_terminal:
        found.width = NOT_FOLDED
    return found


def show(*parts: str | Text | Table) -> None:
    """Print a line or a table; only `Text` keeps a style."""
    console().print(*(plain(part) if isinstance(part, str) else part for part in parts))


def plain(value: Any, style: str = "") -> Text:
    """`value` as text that changes nothing else on a terminal."""
    shown = "-" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return Text("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in shown), style=style)


def judged(verdict: str) -> Text:
    """A verdict in its colour."""
    colour = "green" if verdict in GREEN else "red" if verdict in RED else "yellow"
    return plain(verdict, f"bold {colour}")


def table(*columns: str, left: int | None = None, wrap: bool = True) -> Table:
    """An empty table; all but the first `left` columns are set to the right."""
    made = Table(box=None, pad_edge=False, header_style="dim")
    for i, name in enumerate(columns):
        justify: Any = "left" if left is None or i < left else "right"
        made.add_column(plain(name), overflow="fold", no_wrap=not wrap, justify=justify)
    return made


@contextmanager
def progress_line(begin: str, *, stderr: bool = False) -> Iterator[Callable[[str], None]]:
    """A function that shows a line of progress: rewritten on a terminal, one below the other elsewhere."""
    screen = console(stderr=stderr)
    if not screen.is_terminal:
        yield lambda line: screen.print(plain(line))
        return
    with screen.status(begin) as status:
        yield lambda line: status.update(plain(line))
