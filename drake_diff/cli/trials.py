"""Commands that try many times: robustness of a saved plan, and panels of trials."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_diff.cli.text import (
    RunDirectory,
    Seed,
    console,
    judged,
    names_in,
    names_option,
    out_option,
    plain,
    progress_line,
    show,
    table,
)

INTERRUPTED = 130  # 128 + SIGINT, as in shells
EVERY = 5.0  # seconds between two lines of a panel's progress where there is no terminal


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    app.command()(robustness)
    app.command()(panel)


def robustness(
    run: RunDirectory,
    trials: Annotated[int, typer.Option(help="How many at each level.")] = 100,
    perturbations: Annotated[str | None, names_option("Perturbations", "all that apply to the model")] = None,
    controller: Annotated[str, typer.Option(help="tvlqr, mpc or open_loop")] = "tvlqr",
    seed: Seed = 0,
    out: Annotated[Path | None, out_option("<RUN>_robustness")] = None,
) -> None:
    """Try the plan of RUN under perturbations of plant, start, sensor and actuator: how often does it arrive?

    Exit status 0 only if it arrives unperturbed, and each perturbation has a level that 95 % of the trials survive.
    """
    from drake_diff.artifact.verify import recalled
    from drake_diff.trials.files import PAGE, begin_robustness, save_robustness
    from drake_diff.trials.run import robustness as try_plan

    names, whole = names_in(perturbations), run.resolve()
    directory = out or whole.with_name(f"{whole.name}_robustness")
    with recalled(run) as solution:
        begin_robustness(directory, solution.problem.model)
        with progress_line("trying", stderr=True) as report:
            result = try_plan(solution, names, trials=trials, controller=controller, seed=seed, progress=report)
        record = save_robustness(result, directory, run)
    _show_robustness(record)
    show(f"wrote {directory / PAGE}")
    raise typer.Exit(0 if record.verdict == "pass" else 1)


def _show_robustness(record: Any) -> None:
    names = ("perturbation", "level", "success", "95 % interval", "goal error", "measured", "predicted", "labels")
    rows = table(*names, wrap=False)
    for p in record.perturbations:
        for i, c in enumerate(p.cells):
            labels = ", ".join(f"{count} {label.removesuffix('_error')}" for label, count in c.labels.items())
            rows.add_row(
                plain("" if i else p.name, "bold"),
                f"{c.level:g}",
                plain(f"{c.successes} of {c.trials}", "green" if c.level <= p.margin else "red"),
                f"{c.lower_95:.3f} to {c.upper_95:.3f}",
                *("-" if v is None else f"{v:.3g}" for v in (c.goal_error_median, c.displacement, c.predicted)),
                plain(labels),
            )
    show(rows)
    show(judged(record.verdict), record.sentence)


def panel(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A TOML file that names a function, axes and the number of seeds.")
    ],
    workers: Annotated[int | None, typer.Option(help="How many processes.", show_default="one for each core")] = None,
    engine: Annotated[str, typer.Option(help="local, or ray for a cluster")] = "local",
    address: Annotated[
        str | None, typer.Option(help="HOST:PORT of a running Ray cluster.", show_default="start one here")
    ] = None,
    out: Annotated[Path | None, out_option("artifacts/<file>")] = None,
) -> None:
    """Evaluate every trial of FILE in parallel, and write table.csv and summary.json.

    Finished trials are kept: after Ctrl-C (exit status 130) or a kill the same command goes on.
    Exit status 1 if a trial ended in an error; its row says which.
    """
    from drake_diff.panels.panel import run_panel

    directory = out or Path("artifacts") / file.stem
    try:
        with _counted() as progress:
            found = run_panel(file, out=directory, workers=workers, engine=engine, address=address, progress=progress)
    except KeyboardInterrupt:
        show(f"interrupted: finished trials are in {directory}; the same command goes on from there")
        raise typer.Exit(INTERRUPTED) from None
    _show_panel(found)
    show(f"wrote {directory}: table.csv, summary.json, trials.jsonl")
    raise typer.Exit(1 if found.errors else 0)


@contextmanager
def _counted() -> Iterator[Callable[[int, int, int], None]]:
    """Progress in numbers: on a terminal at once, elsewhere every few seconds."""
    start = last = time.monotonic()
    pause = 0.0 if console().is_terminal else EVERY
    with progress_line("starting") as report:

        def count(finished: int, trials: int, errors: int) -> None:
            nonlocal last
            now = time.monotonic()
            if now - last >= pause:
                last = now
                report(f"{finished} of {trials} trials, {errors} errors, {now - start:.0f} s")

        yield count


def _show_panel(found: Any) -> None:
    cells = found.summary["cells"]
    with_success = any("success" in cell for cell in cells)
    axes, names = (list(dict.fromkeys(name for cell in cells for name in cell[key])) for key in ("cell", "numbers"))
    judgement = ["success", "95 %"] if with_success else []
    rows = table(*axes, "trials", "errors", *judgement, *names, wrap=console().is_terminal)
    for cell in cells:
        words = [cell["cell"].get(name) for name in axes] + [cell["trials"], cell["errors"]]
        if with_success:
            success = cell["success"]
            words += [f"{success['rate']:.3g}", f"{success['low']:.3g} to {success['high']:.3g}"]
        words += [_spread(cell["numbers"].get(name)) for name in names]
        rows.add_row(*(plain(word) for word in words))
    show(rows)
    show(f"{found.summary['trials']} trials, {found.errors} errors")


def _spread(numbers: dict[str, Any] | None) -> str | None:
    if numbers is None:
        return None
    return f"{numbers['mean']:.4g}" + ("" if numbers["std"] is None else f" ± {numbers['std']:.2g}")
