"""Shared parts of all commands: options, loading of a model, and text that is safe to print.

Records and models may contain untrusted text, which is printed without markup and control characters.
"""

import functools
import inspect
import shlex
import time
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from drake_diff.exceptions import InputError

NOT_FOLDED = 160  # columns
GREEN, RED = ("pass", "holds", "agree"), ("fail", "broken", "error", "damaged")

RunDirectory = Annotated[Path, typer.Argument(metavar="RUN", help="A run directory.")]
ModelFolder = Annotated[
    Path | None, typer.Option("--models", help="Folder from which the models and meshes of RUN may be read.")
]
WithoutMeshes = Annotated[
    bool,
    typer.Option("--without-meshes", help="Do not copy the meshes into the run directory; verify then needs --models."),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all random numbers.")]


def out_option(default: str) -> Any:
    """Return the option for the directory that a command writes."""
    return typer.Option("--out", file_okay=False, show_default=default, help="Directory to write.")


def names_option(what: str, otherwise: str) -> Any:
    """Return an option for names separated by commas; see `names_in`."""
    return typer.Option(metavar="NAMES", show_default=otherwise, help=f"{what}, separated by commas.")


def repeated(metavar: str, what: str) -> Any:
    """Return an option that can be given several times."""
    return typer.Option(metavar=metavar, help=f"{what}. Repeatable.")


Packages = Annotated[list[str] | None, repeated("NAME=FOLDER", "Folder of a package:// name")]


def packages_in(given: list[str] | None) -> dict[str, str] | None:
    """Return the folders of packages by name, or None if there are none."""
    return dict(split_pair("--packages", words, "NAME=FOLDER") for words in given) if given else None


def names_in(words: str | None) -> list[str] | None:
    """Split "a, b" into names; None gives None."""
    return None if words is None else [name.strip() for name in words.split(",") if name.strip()]


def takes_model(command: Callable[..., None], *, of_a_plan: bool = False) -> Callable[..., None]:
    """Convert `command(model, file, ...)` to a command with the argument MODEL and the options of `load_model`.

    Typer reads options from the signature of a function, so this function sets it in one place for all commands. If the
    command takes a file `of_a_plan`, MODEL is the option --model, and there is no --time-step, as the plan has its own.
    """
    loading = dict(inspect.signature(_load).parameters)
    if of_a_plan:
        del loading["time_step"]
        option = typer.Option(help="A URDF, SDF, MJCF (.xml) or .dmd.yaml file.")
        loading["model"] = loading["model"].replace(annotation=Annotated[Path, option])
    arguments = [p for p in inspect.signature(command).parameters.values() if p.name not in ("model", "file")]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        file = given["model"]
        command(_load(**{name: given.pop(name) for name in loading}), file, **given)

    model, *options = loading.values()
    parameters = [*arguments[:1], model, *arguments[1:], *options] if of_a_plan else [model, *arguments, *options]
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


def _load(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="A URDF, SDF, MJCF (.xml) or .dmd.yaml file.")],
    time_step: Annotated[float, typer.Option(help="Time step of the discrete plant, in seconds.")] = 0.01,
    contact_model: Annotated[str, typer.Option(help="point, hydroelastic or hydroelastic_with_fallback")] = "point",
    contact_approximation: Annotated[str, typer.Option(help="sap, similar or lagged")] = "sap",
    contact_geometry: Annotated[
        str | None,
        typer.Option(help="Treatment of shape pairs without derivatives: corner_spheres, hydroelastic or differences"),
    ] = None,
    actuators: Annotated[
        str | None,
        typer.Option(metavar="all|NAMES|NAME=EFFORT,...", help="Joints to drive in addition to those of the file."),
    ] = None,
    base: Annotated[
        str | None,
        typer.Option(
            metavar="weld|free|FRAME", help="weld fixes a floating base; FRAME is welded to the world's origin."
        ),
    ] = None,
    fix_joints: Annotated[str | None, names_option("Joints to fix by welds", "none")] = None,
    meshes: Annotated[str, typer.Option(help="Treatment of collision meshes: skip, convex or spheres")] = "skip",
    packages: Packages = None,
    mimic: Annotated[str | None, typer.Option(help="Treatment of mimic joints: reduce or fix")] = None,
    ground: Annotated[
        str | None,
        typer.Option(
            metavar="FRICTION", help="Add a ground at z = 0 with this friction coefficient; true: the default one."
        ),
    ] = None,
    gravity: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", show_default="0,0,-9.81", help="Gravity in m/s^2.")
    ] = None,
    contact: Annotated[bool, typer.Option(help="Whether to simulate contact.")] = True,
    gains: Annotated[
        str | None,
        typer.Option(metavar="KP,KD|file", help="Inputs are commanded positions, with these gains or the file's."),
    ] = None,
) -> Any:
    # Invalid input is rejected before Drake is loaded.
    options: dict[str, Any] = {
        "time_step": time_step,
        "contact_model": contact_model,
        "contact_approximation": contact_approximation,
        "contact_geometry": contact_geometry,
        "actuators": _actuators(actuators),
        "base": base,
        "fix_joints": names_in(fix_joints) or (),
        "meshes": meshes,
        "packages": packages_in(packages),
        "mimic": mimic,
        "ground": True
        if ground == "true"
        else ground and _number("--ground", ground, "true, or a friction coefficient"),
        "gravity": gravity and floats_in("--gravity", gravity, "three numbers"),
        "contact": contact,
        "inputs": gains and "position",
        "gains": None if gains in (None, "file") else tuple(floats_in("--gains", gains, "two numbers, or file")),
    }
    from drake_diff.model.model import load_model

    survived(model, options)
    return load_model(model, **options)


def survived(file: Path, options: Mapping[str, Any]) -> None:
    """Read a model and take one step in a child process; if that crashes, report it and exit with status 1.

    Drake's parsers crash on some files, such as OBJ and VTK meshes with wrong numbers, and would end this process.
    """
    from drake_diff._base.sandbox import crash_of
    from drake_diff.model.model import load_model
    from drake_diff.model.step import step

    def read() -> None:
        model = load_model(file, **options)
        step(model, model.default_state, [0.0] * model.nu)

    crash = crash_of(read)
    if crash:
        message = f"ModelError: {file}: the model cannot be read: the process that read it ended by {crash}"
        console(stderr=True).print(plain(f"drake-diff: {message}"), soft_wrap=True)
        raise typer.Exit(1)


def _actuators(words: str | None) -> str | list[str] | dict[str, float] | None:
    names, expected = names_in(words), "all, names of joints, or an effort for each: NAME=EFFORT"
    if names is None or names == ["all"]:
        return words
    if not any("=" in name for name in names):
        return names
    efforts = [split_pair("--actuators", name, expected) for name in names]
    return {name: _number("--actuators", effort, "an effort limit [N or N m]") for name, effort in efforts}


def split_pair(option: str, words: str, expected: str) -> tuple[str, str]:
    """Split "NAME=VALUE" into NAME and VALUE."""
    name, sign, value = words.partition("=")
    if not (name and sign and value):
        raise InputError(option, got=repr(words), expected=expected)
    return name.strip(), value.strip()


def numbers_in(option: str, words: Iterable[str], expected: str, *, counts: Container[int] = (1,)) -> dict[str, Any]:
    """Parse "NAME=NUMBER,NUMBER,..." to a tuple of numbers by name; `counts` are the allowed numbers of numbers."""
    values: dict[str, Any] = {}
    for word in words:
        name, text = split_pair(option, word, expected)
        if name in values:
            raise InputError(option, got=f"{name} twice", expected="each name once")
        values[name] = tuple(floats_in(option, text, expected))
        if len(values[name]) not in counts:
            raise InputError(option, got=repr(word), expected=expected)
    return values


def floats_in(option: str, words: str, expected: str) -> list[float]:
    """Parse the numbers in "1, 2"."""
    return [_number(option, word, expected) for word in words.split(",")]


def _number(option: str, words: str, expected: str) -> float:
    try:
        return float(words)
    except ValueError as error:
        raise InputError(option, got=repr(words), expected=expected) from error


def as_options(arguments: Mapping[str, Any]) -> str:
    """Format arguments of `load_model` as options on the command line."""
    words = []
    for name, value in arguments.items():
        option = "--" + name.replace("_", "-")
        if value is False:
            words.append(option.replace("--", "--no-", 1))
            continue
        text = "true" if value is True else value if isinstance(value, str) else ",".join(map(str, value))
        words += [option, shlex.quote(text)]
    return " ".join(words)


def console(*, stderr: bool = False) -> Console:
    """Return a console without markup; tables in a file or pipe are not folded to a terminal's width."""
    terminal = Console(soft_wrap=True, highlight=False, markup=False, stderr=stderr)
    if not terminal.is_terminal:
        terminal.width = NOT_FOLDED
    return terminal


def show(*parts: str | Text) -> None:
    """Print a line; only `Text` parts keep a style."""
    console().print(*(plain(renderable) if isinstance(renderable, str) else renderable for renderable in parts))


def plain(value: Any, style: str = "") -> Text:
    """Convert `value` to text without control characters, for printing on a terminal."""
    shown = "-" if value is None else f"{value:.6g}" if isinstance(value, float) else str(value)
    return Text("".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in shown), style=style)


def judged(verdict: str) -> Text:
    """Return a verdict in its colour."""
    colour = "green" if verdict in GREEN else "red" if verdict in RED else "yellow"
    return plain(verdict, f"bold {colour}")


def show_table(columns: Sequence[str], rows: Iterable[Sequence[Any]], *, left: int = 99, wrap: bool = True) -> None:
    """Print a table; all but the first `left` columns are right-aligned."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    for i, name in enumerate(columns):
        justify: Any = "left" if i < left else "right"
        table.add_column(plain(name), overflow="fold", no_wrap=not wrap, justify=justify)
    for row in rows:
        table.add_row(*(cell if isinstance(cell, Text) else plain(cell) for cell in row))
    console().print(table)


def conclude(holds: bool) -> NoReturn:
    """End the command, with status 0 only if its checks hold."""
    raise typer.Exit(0 if holds else 1)


def show_written(directory: Path, record: Any) -> None:
    """Print the names of a record's files in a directory."""
    show(f"wrote {directory}: {record.FILE}, {', '.join(record.file_names)}")


@contextmanager
def progress_line(begin: str, *, stderr: bool = False, pause: float = 0.0) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows progress, on one terminal line, or else in lines at least `pause` [s] apart."""
    screen, last = console(stderr=stderr), -pause
    if screen.is_terminal:
        with screen.status(begin) as status:
            yield lambda line: status.update(plain(line))
        return

    def write(line: str) -> None:
        nonlocal last
        if time.monotonic() - last >= pause:
            last = time.monotonic()
            screen.print(plain(line))

    yield write
