"""The command that evaluates a panel of trials.

The command that tries a saved plan under perturbations.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from drake_diff.cli.runs import plain, wide_console

INTERRUPTED = 130  # 128 + SIGINT, as shells have it
EVERY = 5.0  # seconds between two lines of progress where there is no terminal


def add_commands(app: typer.Typer) -> None:
    """The commands of this module, added to `app`."""
    _add_panel_commands(app)
    _add_robustness_commands(app)


def _add_panel_commands(app: typer.Typer) -> None:
    """Add the command of this module to `app`."""
    app.command()(panel)


def panel(
    file: Annotated[Path, typer.Argument(help="A TOML file that names a function, axes and the number of seeds.")],
    workers: Annotated[int | None, typer.Option(help="Processes; as many as there are cores where not given.")] = None,
    engine: Annotated[str, typer.Option(help="local, or ray for a cluster")] = "local",
    address: Annotated[str | None, typer.Option(help="HOST:PORT of the cluster's head; Ray here if not given.")] = None,
    out: Annotated[Path | None, typer.Option(help="Directory; artifacts/<file> where not given.")] = None,
) -> None:
    """Evaluate every trial of FILE, and write table.csv and summary.json: the same whoever evaluates what.

    What is finished is kept: after Ctrl-C (exit status 130) or a kill the same command goes on. Exit status 1 where a
    trial ended in an error, which is its row.
    """
    from drake_diff.panels.panel import run_panel

    console = wide_console()
    directory = out or Path("artifacts") / file.stem
    try:
        with _progress(console) as progress:
            table = run_panel(file, out=directory, workers=workers, engine=engine, address=address, progress=progress)
    except KeyboardInterrupt:
        console.print(
            plain(f"interrupted: what is finished stands in {directory}; the same command goes on from there")
        )
        raise typer.Exit(INTERRUPTED) from None
    _print(console, table)
    console.print(plain(f"wrote {directory}: table.csv, summary.json, trials.jsonl"))
    raise typer.Exit(1 if table.errors else 0)


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[int, int, int], None]]:
    """One line that is rewritten on a terminal, one every few seconds elsewhere."""
    start = last = time.monotonic()

    def line(finished: int, count: int, errors: int) -> str:
        return f"{finished} of {count} trials, {errors} errors, {time.monotonic() - start:.0f} s"

    def print_now_and_then(*numbers: int) -> None:
        nonlocal last
        if time.monotonic() - last >= EVERY:
            last = time.monotonic()
            console.print(line(*numbers))

    if not console.is_terminal:
        yield print_now_and_then
        return
    with console.status("starting") as status:
        yield lambda *numbers: status.update(line(*numbers))


def _print(console: Console, found: Any) -> None:
    cells = found.summary["cells"]
    judged = any("success" in cell for cell in cells)
    names = list(dict.fromkeys(name for cell in cells for name in cell["numbers"]))
    axes = list(dict.fromkeys(name for cell in cells for name in cell["cell"]))
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in (*axes, "trials", "errors", *(["success", "95 %"] if judged else []), *names):
        table.add_column(plain(name), overflow="fold", no_wrap=not console.is_terminal)
    for cell in cells:
        words = [cell["cell"].get(name) for name in axes] + [cell["trials"], cell["errors"]]
        if judged:
            success = cell["success"]
            words += [f"{success['rate']:.3g}", f"{success['low']:.3g} to {success['high']:.3g}"]
        words += [_spread(cell["numbers"].get(name)) for name in names]
        table.add_row(*(plain(word) for word in words))
    console.print(table)
    console.print(plain(f"{found.summary['trials']} trials, {found.errors} errors"))


def _spread(numbers: dict[str, Any] | None) -> str | None:
    if numbers is None:
        return None
    return f"{numbers['mean']:.4g}" + ("" if numbers["std"] is None else f" ± {numbers['std']:.2g}")


def _add_robustness_commands(app: typer.Typer) -> None:
    """Add the command of this module to `app`."""
    app.command()(robustness)


def robustness(
    run: Annotated[Path, typer.Argument(help="A run directory.")],
    trials: Annotated[int, typer.Option(help="How many at each level.")] = 100,
    perturbations: Annotated[
        str | None,
        typer.Option(help="Names with commas between; all that the model has something for where not given."),
    ] = None,
    controller: Annotated[str, typer.Option(help="tvlqr, mpc or open_loop")] = "tvlqr",
    seed: Annotated[int, typer.Option(help="The same seed gives the same trials.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Directory; <RUN>_robustness where not given.")] = None,
) -> None:
    """Try the plan of RUN under perturbations of plant, start, sensor and actuator: how often it arrives, and how far.

    Exit status 0 only where the unperturbed run succeeds and each perturbation has a level that 95 % survive.
    """
    from drake_diff.artifact.verify import recalled
    from drake_diff.trials.files import PAGE, begin_robustness, save_robustness
    from drake_diff.trials.run import robustness as try_plan

    names = None if perturbations is None else [name.strip() for name in perturbations.split(",") if name.strip()]
    whole = run.resolve()
    directory = out or whole.with_name(f"{whole.name}_robustness")
    console = wide_console()
    with recalled(run) as solution:
        begin_robustness(directory, solution.problem.model)
        with _progress_of_cli_robustness(console) as report:
            result = try_plan(solution, names, trials=trials, controller=controller, seed=seed, progress=report)
        record = save_robustness(result, directory, run)
    _print_of_cli_robustness(console, record)
    console.print(plain(f"wrote {directory / PAGE}"))
    raise typer.Exit(0 if record.verdict == "pass" else 1)


@contextmanager
def _progress_of_cli_robustness(console: Console) -> Iterator[Callable[[str], None] | None]:
    """One line that is rewritten on a terminal, nothing elsewhere."""
    if not console.is_terminal:
        yield None
        return
    with console.status("trying") as status:
        yield lambda line: status.update(plain(line))


def _print_of_cli_robustness(console: Console, record: Any) -> None:
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in ("perturbation", "level", "success", "95 % interval", "goal error", "measured", "predicted", "labels"):
        table.add_column(name, no_wrap=True)
    for p in record.perturbations:
        for i, c in enumerate(p.cells):
            labels = ", ".join(f"{count} {label.removesuffix('_error')}" for label, count in c.labels.items())
            table.add_row(
                plain("" if i else p.name, "bold"),
                f"{c.level:g}",
                plain(f"{c.successes} of {c.trials}", "green" if c.level <= p.margin else "red"),
                f"{c.lower_95:.3f} to {c.upper_95:.3f}",
                *(_short(v) for v in (c.goal_error_median, c.displacement, c.predicted)),
                plain(labels),
            )
    console.print(table)
    colour = "green" if record.verdict == "pass" else "red"
    console.print(plain(record.verdict, f"{colour} bold"), plain(record.sentence))


def _short(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"
