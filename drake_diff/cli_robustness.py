"""The command that tries a saved plan under perturbations."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from drake_diff.cli_runs import plain, wide_console


def add_commands(app: typer.Typer) -> None:
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
    from drake_diff.loop.robustness import robustness as try_plan
    from drake_diff.loop.robustness_files import PAGE, begin_robustness, save_robustness
    from drake_diff.verify import recalled

    names = None if perturbations is None else [name.strip() for name in perturbations.split(",") if name.strip()]
    whole = run.resolve()
    directory = out or whole.with_name(f"{whole.name}_robustness")
    console = wide_console()
    with recalled(run) as solution:
        begin_robustness(directory, solution.problem.model)
        with _progress(console) as report:
            result = try_plan(solution, names, trials=trials, controller=controller, seed=seed, progress=report)
        record = save_robustness(result, directory, run)
    _print(console, record)
    console.print(plain(f"wrote {directory / PAGE}"))
    raise typer.Exit(0 if record.verdict == "pass" else 1)


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[str], None] | None]:
    """One line that is rewritten on a terminal, nothing elsewhere."""
    if not console.is_terminal:
        yield None
        return
    with console.status("trying") as status:
        yield lambda line: status.update(plain(line))


def _print(console: Console, record: Any) -> None:
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
