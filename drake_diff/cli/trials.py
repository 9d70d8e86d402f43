"""Commands that try many times: robustness, panel."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from drake_diff._base.signals import INTERRUPTED
from drake_diff.cli.text import (
    ModelFolder,
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

COLOURS = {"rigid answer": "green", "right": "green", "own law's": "yellow", "not asked": "dim", "none": "dim"}
EVERY = 5.0  # seconds between two lines of a panel's progress where there is no terminal


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    for command in (robustness, panel):
        app.command()(command)


def robustness(
    run: RunDirectory,
    trials: Annotated[int, typer.Option(help="How many trials at each level.")] = 100,
    perturbations: Annotated[str | None, names_option("Perturbations", "all that apply to the model")] = None,
    controller: Annotated[str, typer.Option(help="tvlqr, mpc or open_loop")] = "tvlqr",
    seed: Seed = 0,
    models: ModelFolder = None,
    out: Annotated[Path | None, out_option("<RUN>_robustness")] = None,
) -> None:
    """Try the plan of RUN under perturbations of plant, start, sensor and actuator: how often does it reach the goal?

    Exit status 0 only if it reaches the goal unperturbed, and each perturbation has a level at which 95 % of the
    trials succeed.
    """
    from drake_diff.artifact.verify import recalled
    from drake_diff.record.directory import written_whole
    from drake_diff.trials.files import PAGE, write_robustness
    from drake_diff.trials.run import levels_named
    from drake_diff.trials.run import robustness as try_plan

    names, whole = names_in(perturbations), run.resolve()
    directory = out or whole.with_name(f"{whole.name}_robustness")
    with recalled(run, models=models) as solution:
        levels = levels_named(solution.problem.model, names)
        with written_whole(directory) as folder:
            with progress_line("trying", stderr=True) as report:
                result = try_plan(solution, levels, trials=trials, controller=controller, seed=seed, progress=report)
            record = write_robustness(result, folder, run)
    columns = ("perturbation", "level", "success", "95 % interval", "goal error", "measured", "predicted", "labels")
    rows = table(*columns, wrap=False)
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
    show(f"wrote {directory / PAGE}")
    raise typer.Exit(0 if record.verdict == "pass" else 1)


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
    """Evaluate every trial of FILE in parallel, and write table.csv, summary.json, panel.html and trials/.

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
        for name in names:
            n = cell["numbers"].get(name)
            spread = "" if n is None or n["std"] is None else f" ± {n['std']:.2g}"
            words.append(None if n is None else f"{n['mean']:.4g}{spread}")
        rows.add_row(*(plain(word) for word in words))
    show(rows)
    show(f"{found.summary['trials']} trials, {found.errors} errors")
    show(
        f"wrote {directory}: panel.json, table.csv, summary.json, trials.jsonl, panel.html, a record of each in trials"
    )
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
