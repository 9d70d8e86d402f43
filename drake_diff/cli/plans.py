"""Commands that plan, or run many trials: plan, robustness, panel."""

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_diff._base.clock import INTERRUPTED
from drake_diff.cli.text import (
    ModelFolder,
    Packages,
    RunDirectory,
    Seed,
    WithoutMeshes,
    conclude,
    console,
    floats_in,
    judged,
    names_in,
    names_option,
    numbers_in,
    out_option,
    packages_in,
    plain,
    progress_line,
    show,
    show_table,
    survived,
    takes_model,
)
from drake_diff.exceptions import InputError

EXAMPLE = "panda"  # the robot of `drake-diff plan` without arguments

Goals = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=NUMBERS", help="hand=0.4,0,0.5 [m] for a frame or body, elbow=1.0 for a joint."),
]

Obstacles = Annotated[
    list[str] | None,
    typer.Option(
        metavar="SHAPE:NUMBERS", help="sphere:x,y,z,radius or box:x,y,z,length,width,height in metres; repeatable."
    ),
]
NUMBERS = {"sphere": 4, "box": 6}
SHOWN = 12  # checks that `check` prints, the worst first
PAUSE = 5.0  # [s] between two lines of progress without a terminal


def plan(
    robot: Annotated[
        Path | None,
        typer.Argument(metavar="ROBOT", help="A URDF, SDF, MJCF (.xml) or .dmd.yaml file. Default: a Panda."),
    ] = None,
    goal: Goals = None,
    avoid: Obstacles = None,
    time: Annotated[str | None, typer.Option(help="least: the least time. Default: the least effort.")] = None,
    out: Annotated[Path | None, out_option("artifacts/plan_<robot>")] = None,
    seed: Seed = 0,
    restarts: Annotated[int, typer.Option(min=0, help="Additional initial guesses, to list other optima.")] = 0,
    without_meshes: WithoutMeshes = False,
    packages: Packages = None,
) -> None:
    """Plan a motion of ROBOT: repair its file, solve, write the run directory and verify it.

    The default goal is a random state that the robot can reach. Exit status 0 only if the plan is verified.
    """
    expected = "NAME=x,y,z for a frame, or NAME=number for a joint"
    numbers = numbers_in("--goal", goal or (), expected, counts=range(1, 100))
    goals = {name: list(values) for name, values in numbers.items()}
    folders, obstacles = packages_in(packages), [_shape(words) for words in avoid or ()]
    if robot is not None and not robot.is_file():
        raise InputError("ROBOT", got=str(robot), expected="a file that exists")
    # Imported late, so that invalid input is rejected before Drake is loaded.
    from drake_diff.model.model import example_files
    from drake_diff.planning.planner import plan as planned
    from drake_diff.planning.robot import TIME_STEP

    file = robot or example_files()[EXAMPLE]
    if robot is not None:
        survived(robot, {"time_step": TIME_STEP, "packages": folders})
    try:
        with progress_line("reading", pause=PAUSE) as report:
            asked: dict[str, Any] = {
                "goals": goals,
                "avoid": _obstacles(obstacles),
                "time": time,
                "out": out,
                "seed": seed,
                "restarts": restarts,
                "meshes": not without_meshes,
                "packages": folders,
            }
            done = planned(file, **asked, report=lambda stage, sentence: report(f"{stage:9} {sentence}"))
    except KeyboardInterrupt as error:
        show("; ".join(("interrupted", *getattr(error, "__notes__", ()))))
        show("`drake-diff recover` measures the plan of that directory, if it has one")
        raise typer.Exit(INTERRUPTED) from None
    show(judged("pass" if done.success else "fail"), f" {file.name}: {done.solution.status.value}")
    for line in done.lines:
        show(plain(line))
    conclude(done.success)


def check(
    model: Any,
    file: Path,
    plan: Annotated[
        Path, typer.Argument(metavar="PLAN", help="Samples of states and inputs: CSV, MCAP or a ROS 2 bag.")
    ],
    goal: Goals = None,
    avoid: Obstacles = None,
    plant: Annotated[
        str, typer.Option(help="steps (inputs are held until the next sample) or continuous (linear in between)")
    ] = "steps",
    tolerance: Annotated[float, typer.Option(help="Relative tolerance of the plan at its samples.")] = 1e-4,
    out: Annotated[Path | None, out_option("artifacts/check_<plan>")] = None,
) -> None:
    """Verify PLAN, a plan of another tool, on the robot of --model, and write a run directory.

    The samples are one time step of the model apart. With --goal, the plan must end there at rest, and without it the
    replays must end at its last state. The limits of the robot file apply. Exit status 0 only if every check passes.
    """
    from drake_diff.optimize.check_plan import check_plan
    from drake_diff.planning.guesses import recorded_plan
    from drake_diff.runs.save import save

    goals = numbers_in("--goal", goal or (), "NAME=x,y,z or NAME=number", counts=range(1, 100))
    problem, xs, us = recorded_plan(plan, model, goals, _obstacles([_shape(words) for words in avoid or ()]))
    inputs = us if plant == "steps" else [*us, us[-1]]
    solution = check_plan(problem, xs, inputs, plant=plant, tolerance=tolerance)
    directory = out or Path("artifacts") / f"check_{plan.stem}"
    record = save(solution, directory)
    columns = ("check", "where", "plant", "feedback", "value", "tolerance", "unit")
    rows = []
    for c in solution.checks[:SHOWN]:
        numbers = (f"{number:.3g}" for number in (c.value, c.tolerance))
        verdict = plain(c.verdict, "green" if c.passes else "red")
        rows.append((verdict, c.what, c.where, c.plant, c.feedback or "open loop", *numbers, c.unit))
    show_table(("verdict", *columns), rows, wrap=False)
    show(judged(record.verdict), solution.message)
    show(f"wrote {directory}")
    conclude(record.verdict == "pass")


def _obstacles(shapes: list[tuple[str, list[float]]]) -> list[Any]:
    from drake_diff.optimize.problem.obstacles import BoxObstacle, SphereObstacle

    return [SphereObstacle(n[:3], n[3]) if kind == "sphere" else BoxObstacle(n[:3], n[3:]) for kind, n in shapes]


def _shape(words: str) -> tuple[str, list[float]]:
    kind, colon, values = words.partition(":")
    expected = "sphere:x,y,z,radius or box:x,y,z,length,width,height"
    if not colon or kind not in NUMBERS:
        raise InputError("--avoid", got=repr(words), expected=expected)
    numbers = floats_in("--avoid", values, f"numbers separated by commas: {expected}")
    if len(numbers) != NUMBERS[kind]:
        raise InputError("--avoid", got=repr(words), expected=f"{NUMBERS[kind]} numbers: {expected}")
    return kind, numbers


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    for command in (plan, robustness, panel):
        app.command()(command)
    app.command()(takes_model(check, of_a_plan=True))


def robustness(
    run: RunDirectory,
    trials: Annotated[int, typer.Option(help="Number of trials at each level.")] = 100,
    perturbations: Annotated[str | None, names_option("Perturbations", "all that apply to the model")] = None,
    controller: Annotated[str, typer.Option(help="tvlqr, mpc or open_loop")] = "tvlqr",
    seed: Seed = 0,
    models: ModelFolder = None,
    out: Annotated[Path | None, out_option("<RUN>_robustness")] = None,
) -> None:
    """Try the plan of RUN under perturbations of plant, start, sensor and actuator, and count how often it succeeds.

    Exit status 0 only if the unperturbed plan reaches the goal, and each perturbation has a level at which 95 % of the
    trials succeed.
    """
    from drake_diff.runs.directory import written_whole
    from drake_diff.runs.verify import recalled
    from drake_diff.trials.files import PAGE, write_robustness
    from drake_diff.trials.perturbation import levels_named
    from drake_diff.trials.run import robustness as try_plan

    names, whole = names_in(perturbations), run.resolve()
    directory = out or whole.with_name(f"{whole.name}_robustness")
    with recalled(run, models=models) as solution:
        levels = levels_named(solution.problem.model, names)
        with written_whole(directory) as folder:
            with progress_line("trying", stderr=True) as report:
                result = try_plan(solution, levels, trials=trials, controller=controller, seed=seed, progress=report)
            record: Any = write_robustness(result, folder, run)
    rows: list[Any] = []
    for p in record.robustness.perturbations:
        for i, c in enumerate(p.cells):
            rate = plain(f"{c.successes} of {c.trials}", "green" if c.level <= p.margin else "red")
            errors = ("-" if v is None else f"{v:.3g}" for v in (c.goal_error_median, c.displacement, c.predicted))
            labels = ", ".join(f"{count} {label.removesuffix('_error')}" for label, count in c.labels.items())
            name = plain("" if i else p.name, "bold")
            rows.append((name, f"{c.level:g}", rate, f"{c.lower_95:.3f} to {c.upper_95:.3f}", *errors, labels))
    columns = ("perturbation", "level", "success", "95 % interval", "goal error", "measured", "predicted", "labels")
    show_table(columns, rows, wrap=False)
    show(judged(record.verdict), record.sentence)
    show(f"wrote {directory / PAGE}")
    conclude(record.verdict == "pass")


def panel(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A TOML file that names a function, axes and the number of seeds.")
    ],
    workers: Annotated[int | None, typer.Option(help="Number of processes.", show_default="one for each core")] = None,
    engine: Annotated[str, typer.Option(help="local, or ray for a cluster")] = "local",
    address: Annotated[
        str | None, typer.Option(help="HOST:PORT of a running Ray cluster.", show_default="start one here")
    ] = None,
    out: Annotated[Path | None, out_option("artifacts/<file>")] = None,
) -> None:
    """Evaluate every trial of FILE in parallel, and write table.csv, summary.json, panel.html and trials/.

    Finished trials are kept: after Ctrl-C (exit status 130) or a kill, the same command resumes.
    Exit status 1 if a trial ended in an error; its row states the error.
    """
    from drake_diff.panels.panel import run_panel

    directory, start = out or Path("artifacts") / file.stem, time.monotonic()
    try:
        with progress_line("starting", pause=PAUSE) as report:

            def count(finished: int, trials: int, errors: int) -> None:
                report(f"{finished} of {trials} trials, {errors} errors, {time.monotonic() - start:.0f} s")

            results = run_panel(file, out=directory, workers=workers, engine=engine, address=address, progress=count)
    except KeyboardInterrupt:
        show(f"interrupted: finished trials are in {directory}; the same command continues with the others")
        raise typer.Exit(INTERRUPTED) from None
    cells = results.summary["cells"]
    axes, names = (list(dict.fromkeys(name for cell in cells for name in cell[key])) for key in ("cell", "numbers"))
    judgement = ["success", "95 %"] if any("success" in cell for cell in cells) else []
    rows = []
    for cell in cells:
        words = [cell["cell"].get(name) for name in axes] + [cell["trials"], cell["errors"]]
        if judgement:
            success = cell["success"]
            words += [f"{success['rate']:.3g}", f"{success['low']:.3g} to {success['high']:.3g}"]
        for n in (cell["numbers"].get(name) for name in names):
            spread = "" if n is None or n["std"] is None else f" ± {n['std']:.2g}"
            words.append(None if n is None else f"{n['mean']:.4g}{spread}")
        rows.append(words)
    show_table([*axes, "trials", "errors", *judgement, *names], rows, wrap=console().is_terminal)
    show(f"{results.summary['trials']} trials, {results.errors} errors")
    show(f"wrote {directory}: record.json, table.csv, summary.json, panel.html, and a record of each trial in trials")
    conclude(not results.errors)
