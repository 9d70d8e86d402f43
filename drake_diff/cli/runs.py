"""Commands on runs: run, recover, verify, list, compare-runs, schema, view, export."""

import importlib.util
import inspect
import shlex
import sys
import threading
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import typer

from drake_diff._base.clock import INTERRUPTED, held_interrupts
from drake_diff._base.sandbox import memory_at_most
from drake_diff.cli.text import (
    ModelFolder,
    RunDirectory,
    WithoutMeshes,
    conclude,
    judged,
    out_option,
    plain,
    progress_line,
    show,
    show_table,
    show_written,
)
from drake_diff.exceptions import InputError, UnknownNameError, WriteError

OURS = ("problem", "progress", "view")  # arguments of `solve` that a script cannot set
MOST_MEMORY = 4 * 2**30  # bytes


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to `app`."""
    for command in (run, verify, compare_runs, schema, view, export):
        app.command()(command)
    app.command("list")(list_all)
    app.command("recover")(recover_run)


def run(
    script: Annotated[Path, typer.Argument(metavar="SCRIPT", help="A Python file with a function problem().")],
    out: Annotated[Path | None, out_option("artifacts/<script>")] = None,
    cross_check: Annotated[
        bool, typer.Option("--cross-check", help="Also replay the plan in continuous time and in MuJoCo.")
    ] = False,
    view: Annotated[
        bool, typer.Option("--view", help="Show the search in a browser on this machine, and its plan until Ctrl-C.")
    ] = False,
    without_meshes: WithoutMeshes = False,
) -> None:
    """Solve the problem that SCRIPT defines, measure the solution again, and write the run directory.

    SCRIPT may also define solve_options, a dictionary of arguments of drake_diff.solve. With --cross-check the plan is
    also replayed in other plants, and the record states where it holds; the exit status does not depend on that. Exit
    status 0 only if the solution passes every check. Ctrl-C, SIGTERM and SIGHUP end the search, and its best plan is
    written. A later signal, while the plan is measured, ends the run (exit status 130), and `recover` completes it. A
    signal before the search leaves a record that says so (130 too).
    """
    if not script.is_file():
        raise InputError("SCRIPT", got=str(script), expected="a Python file that exists")
    directory = out or Path("artifacts") / script.stem
    addresses: list[str] = []

    def show_address(address: str) -> None:
        addresses.append(address)
        typer.echo(f"the search is shown at {address}")

    record = _run_into(directory, script, cross_check, {"view": show_address} if view else {}, not without_meshes)
    (_show_record if record.phases is None else _show_phases)(record)
    show_written(directory, record)
    if addresses:
        _wait_at(f"the plan is at {addresses[0]}")
    conclude(record.verdict == "pass")


def _run_into(directory: Path, script: Path, cross_check: bool, options: dict[str, Any], meshes: bool) -> Any:
    """Set up the problem and write the record of its solution; an interrupted run does not replace another run."""
    from drake_diff.runs.directory import written_whole  # late, so that a missing script is reported first
    from drake_diff.runs.save import IN_THE_SETUP, begin_interrupted

    folder = None
    try:
        with written_whole(directory) as folder:
            try:
                problem, asked = _asked(script, cross_check)
            except KeyboardInterrupt:
                with held_interrupts():
                    begin_interrupted(folder, None)
                show(f"{IN_THE_SETUP}; its record is in {folder}")
                raise typer.Exit(INTERRUPTED) from None
            return _solved_into(directory, folder, problem, asked | options, cross_check, meshes)
    except KeyboardInterrupt:
        if folder is not None:
            raise
        show(f"interrupted before {directory} was created: no file is written")
        raise typer.Exit(INTERRUPTED) from None


def _asked(script: Path, cross_check: bool) -> tuple[Any, dict[str, Any]]:
    """Return the problem that a script defines, and its options of `solve`."""
    module = _loaded(script)
    problem, options = module.problem(), getattr(module, "solve_options", {})
    from drake_diff.optimize.options import Options
    from drake_diff.optimize.path_timing import PathTiming
    from drake_diff.optimize.problem.phases import PhasedProblem
    from drake_diff.optimize.problem.problem import Problem
    from drake_diff.optimize.solve import solve

    if not isinstance(problem, (Problem, PhasedProblem, PathTiming)):
        expected = "a Problem, a PhasedProblem or a PathTiming"
        raise InputError("problem()", got=type(problem).__name__, expected=expected)
    if cross_check and not (isinstance(problem, PathTiming) or (isinstance(problem, Problem) and problem.has_model)):
        raise InputError(
            "--cross-check", got="a problem without a model, or in phases", expected="a Problem with a model"
        )
    if not isinstance(options, dict):
        raise InputError("solve_options", got=type(options).__name__, expected="a dictionary")
    known = [name for name in inspect.signature(solve).parameters if name not in OURS]
    for name in options.keys() - set(known):
        raise UnknownNameError("solve_options", got=name, known=known)
    if not isinstance(options.get("options", Options()), Options):
        got = type(options["options"]).__name__
        raise InputError("solve_options, options", got=got, expected="a drake_diff.optimize.Options")
    parts = () if isinstance(problem, PathTiming) else problem.phases
    words = "; ".join(f"{phase.system}, {phase.num_steps} steps" for phase in parts) or repr(problem)
    show(plain(script.name, "bold"), words)
    return problem, options


def _wait_at(location: str) -> None:
    """Print a location that is available until Ctrl-C, and wait for that."""
    try:
        # Not with a console, which would print the line again if it is interrupted after printing.
        typer.echo(f"{location} (Ctrl-C ends it)")
        threading.Event().wait()
    except KeyboardInterrupt:
        typer.echo("ended")


def _solved_into(
    directory: Path, folder: Path, problem: Any, options: dict[str, Any], checked: bool, meshes: bool
) -> Any:
    """Solve, measure and write `folder`, later `directory`; an interrupted run does not replace another run."""
    from drake_diff.optimize.options import Options
    from drake_diff.optimize.path_timing import PathTiming
    from drake_diff.optimize.solve import solve
    from drake_diff.runs.cross_check import cross_check
    from drake_diff.runs.directory import is_taken
    from drake_diff.runs.save import begin, begin_failure, begin_interrupted, keep_plan, plan_kept, write_run

    begun: list[Any] = []
    stated = None if isinstance(problem, PathTiming) else problem  # a path's problem is known at the end

    def on_start() -> None:
        begun.append(problem)
        begin(folder, stated)

    def on_plan(plan: Any) -> None:
        with plan_kept(plan, directory.name, folder):
            keep_plan(plan, folder)

    try:
        with progress_line("solving") as report:
            hooks = {"on_start": on_start} if stated is None else {"on_start": on_start, "on_plan": on_plan}
            hooked = replace(options.pop("options", Options()), **hooks)
            solution: Any = solve(problem, progress=report, options=hooked, **options)
        if checked:
            with progress_line("replaying the plan in other simulators"):
                solution = cross_check(solution)
        with plan_kept(solution, directory.name, folder):
            record: Any = write_run(solution, folder, meshes=meshes)
    except KeyboardInterrupt:
        with held_interrupts():
            begin_interrupted(folder, stated)
        show(f"interrupted: the partial run is in {folder}")
        if begun:
            show(plain(f"drake-diff recover {shlex.quote(str(folder))} measures its plan, if it has one"))
        raise typer.Exit(INTERRUPTED) from None
    except Exception as error:
        if begun and not isinstance(error, WriteError):
            begin_failure(error, folder, stated)
        raise
    if record.solver.status == "interrupted" and is_taken(directory):
        show(judged(record.verdict), f" interrupted: {record.sentence}")
        show(f"{directory} has an earlier run and is unchanged; this run is in {folder}")
        raise typer.Exit(1)
    return record


def _show_phases(record: Any) -> None:
    show(judged(record.verdict), f" {record.sentence}")
    columns = ("phase", "ended", "cost", "steps" if record.phases.counts_steps else "seconds")
    show_table(columns, [(p.name, p.status, p.cost, p.duration) for p in record.phases.phases])
    for link in record.phases.links:
        errors = [float("inf") if error is None else error for error in link.errors]
        show(f"link {link.before} to {link.after}: error {max(errors):.3g}, tolerance {link.tolerance:g}")
    show(f"the chain of all phases: {plain(record.phases.chain.told)}")


def _loaded(script: Path) -> ModuleType:
    """Import the script as a module; its `if __name__ == "__main__"` part does not run."""
    spec = importlib.util.spec_from_file_location("drake_diff_script", script)
    if spec is None or spec.loader is None:
        raise InputError("SCRIPT", got=str(script), expected="a Python file, whose name ends in .py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not callable(getattr(module, "problem", None)):
        raise InputError("SCRIPT", got=str(script), expected="a file with a function problem() that returns a Problem")
    return module


def _show_record(record: Any) -> None:
    solver, holds = record.solver, {"pass": "holds", "info": ""}
    show(judged(record.verdict), f" {record.sentence}")
    rows = []
    for m in record.metrics:
        tolerance = "" if m.tolerance is None else f"{m.tolerance:g}"
        rows.append((m.name, m.value, m.unit, tolerance, holds.get(m.verdict, plain("does not hold", "red"))))
    show_table(("measured again", "value", "unit", "tolerance", ""), rows)
    for replay in record.replays:
        verdict = plain("holds") if replay.holds else plain(f"does not hold: {replay.failures[0]}", "red")
        goal = "-" if replay.goal_error is None else f"{replay.goal_error:.3g}"
        show(f"replayed {replay.variant}, {replay.control}: goal error {goal},", verdict)
    for p in record.parameters:
        moved = f", from {p.start:.6g}" if p.optimized else ""
        show(f"{p.name} = {p.value:.9g} {p.unit}{moved}, derivative from {p.derivative_source}")
    verdicts = [certificate.verdict for certificate in record.gradient.certificates]
    show(
        f"gradients: {verdicts.count('agree')} of {len(verdicts)} certificates agree; {solver.method} with "
        f"{solver.solver}, {solver.iterations} iterations, {record.wall_clock.duration_s:.1f} s"
    )


def verify(
    run: RunDirectory,
    models: ModelFolder = None,
    time_limit: Annotated[float, typer.Option(help="Time limit of the new computation in seconds.")] = 60.0,
    memory_limit: Annotated[float, typer.Option(help="Memory limit of the new computation [GiB].")] = 1.0,
) -> None:
    """Check every file of RUN, reproduce RUN from its own files, and compare record, trace and pages.

    RUN is a directory of a solve, a comparison, robustness trials or a certification.
    Exit status 0 only if everything was reproduced. The claims and the unchecked parts are printed first.
    Comparisons and robustness trials are not repeated: if unchanged, they are "intact", with exit status 1. However,
    results on recordings are reproduced: the comparison and the causes.
    RUN may be untrusted: its model is read in a child process with limits of time and memory.
    """
    from drake_diff.runs.verify import verify as verify_run

    verification = verify_run(run, models=models, time_limit=time_limit, memory_limit=memory_limit)
    verdict = "unknown" if verification.record is None else verification.record.verdict
    sentence = verification.sentence if verification.verdict in ("holds", "intact") else "see below"
    show(judged(verification.verdict), f"{run}: {sentence}; the run's verdict: {verdict}")
    for line in verification.lines:
        show(plain(f"  {line}", "red" if line.startswith("broken") else "dim"))
    conclude(verification.holds)


@memory_at_most(MOST_MEMORY)
def list_all(
    directory: Annotated[Path, typer.Argument(metavar="DIRECTORY", help="The directory with the runs.")] = Path(
        "artifacts"
    ),
) -> None:
    """List the records in DIRECTORY with their unverified verdicts; `verify` checks them."""
    from drake_diff.runs.view import list_runs

    columns = ("run", "verdict", "kind", "status", "cost", "model", "written")
    lines = list_runs(directory)
    show_table(columns, [(r.name, judged(r.verdict), r.kind, r.status, r.cost, r.model, r.written_utc) for r in lines])


def recover_run(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The directory NAME.partial-... of an unfinished run.")],
    out: Annotated[Path | None, out_option("<NAME>")] = None,
) -> None:
    """Complete a run that was killed, interrupted or stopped by a full disk: measure the plan in RUN, write the rest.

    Exit status 0 only if the plan passes every check. No run is replaced.
    """
    from drake_diff.runs.save import recover as complete

    record: Any = complete(run, out)
    show(judged(record.verdict), f" {record.sentence}")
    show_written(out or run.resolve().with_name(record.name), record)
    conclude(record.verdict == "pass")


@memory_at_most(MOST_MEMORY)
def compare_runs(
    a: Annotated[Path, typer.Argument(metavar="A", help="A run directory.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Another one.")],
    out: Annotated[Path | None, typer.Option("--out", metavar="PAGE", dir_okay=False, help="Page to write.")] = None,
    models: ModelFolder = None,
) -> None:
    """Show the differences between the runs A and B: configuration, versions, metrics.

    With --out, a page also shows both plans in one replay and in the same plots.
    Exit status 1 if the runs define a metric differently; such metrics are not compared.
    """
    from drake_diff.runs.view import compare_runs as compare

    comparison = compare(a, b)
    for title in ("configuration", "versions", "metrics"):
        differing = getattr(comparison, title)
        show(plain(title if differing else f"{title}: no difference", "bold"))
        if differing:
            show_table(("", "A", "B"), [(row.key, row.a, row.b) for row in differing])
    for line in comparison.refused:
        show(plain(f"not compared: {line}", "red"))
    if out is not None:
        from drake_diff.runs.view import write_runs_page

        write_runs_page(out, a, b, models=models)
        show(f"wrote {out}")
    conclude(comparison.comparable)


def schema(
    kind: Annotated[str, typer.Argument(metavar="KIND", help="plan, fit or comparison.")] = "plan",
) -> None:
    """Print the JSON Schema of record.json for one kind of record."""
    from drake_diff.runs.directory import KINDS

    if kind not in KINDS:
        raise UnknownNameError("KIND", got=kind, known=KINDS)
    sys.stdout.write(KINDS[kind].published_schema().decode())


def view(run: RunDirectory, models: ModelFolder = None) -> None:
    """Show the motion of RUN in a browser on this machine, until Ctrl-C."""
    from drake_diff.runs.view import serve

    try:
        meshcat, notes = serve(run, models=models)
        for note in notes:
            show(plain(note, "yellow"))
    except KeyboardInterrupt:
        typer.echo("ended")
        return
    _wait_at(f"{run} is at {meshcat.web_url()}")


@memory_at_most(MOST_MEMORY)
def export(
    run: RunDirectory,
    out: Annotated[
        Path | None, typer.Argument(metavar="OUT", file_okay=False, show_default="<RUN>_ros2", help="Bag directory.")
    ] = None,
    ros2: Annotated[bool, typer.Option("--ros2", help="Write a bag for ROS 2.")] = False,
) -> None:
    """Write the motion in RUN for other tools."""
    from drake_diff.runs.trace import export_ros2

    if not ros2:
        raise InputError("export", got="no format", expected="--ros2")
    folder = out or run.resolve().with_name(f"{run.resolve().name}_ros2")
    counts = export_ros2(run, folder)
    show(f"wrote {folder}: {', '.join(f'{topic} {count}' for topic, count in counts.items())}")
