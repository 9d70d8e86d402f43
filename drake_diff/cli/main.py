"""The command `drake-diff`. Exit status: 0 it holds, 1 a check failed, 2 usage, 3 something is missing, 4 internal.

A panel that Ctrl-C ended exits with 130.
"""

import importlib.util
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from drake_diff.cli import engines, runs, studies, trials
from drake_diff.cli.runs import plain, view
from drake_diff.cli.text import Approximation, ContactModel, Geometry, Ground, ModelFile, TimeStep, WeldBase
from drake_diff.exceptions import DrakeDiffError, InputError, MissingDependencyError

HOLDS, CHECK_FAILED, USAGE, MISSING, INTERNAL = range(5)

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)
for noun in (runs, engines, studies, trials):
    noun.add_commands(app)


def _print_version(asked: bool) -> None:
    from importlib.metadata import PackageNotFoundError, version

    if not asked:
        return
    try:
        typer.echo(f"drake-diff {version('drake-diff')}")
    except PackageNotFoundError as error:
        raise MissingDependencyError("drake-diff runs from a folder that is not installed: pip install -e .") from error
    raise typer.Exit


@app.callback()
def about(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Trajectory optimization on Drake with gradients that are checked before they are used."""


@app.command()
def run(
    script: Annotated[
        Path, typer.Argument(help="A Python file that defines problem(), and solve_options if it likes.")
    ],
    out: Annotated[Path | None, typer.Option(help="Run directory; artifacts/<script> where not given.")] = None,
) -> None:
    """Solve the problem that SCRIPT defines, measure the solution again, and write the run directory."""
    console = Console(soft_wrap=True, highlight=False)
    module = _load(script)
    problem = module.problem()
    options = dict(getattr(module, "solve_options", {}))
    directory = out or Path("artifacts") / script.stem
    console.print(f"[bold]{escape(script.name)}[/]: {escape(repr(problem.model))}, {problem.num_steps} steps")
    # Only here: a script that is not there, or is wrong, is told of at once.
    from drake_diff.artifact.save import begin, save, save_failure
    from drake_diff.optimize.solve import solve

    begun: list[Path] = []

    def on_start() -> None:
        begin(directory, problem)
        begun.append(directory)

    try:
        with _progress(console) as report:
            solution = solve(problem, progress=report, on_start=on_start, **options)
    except Exception as error:
        if begun:
            save_failure(error, directory, problem)
        raise
    record = save(solution, directory)
    _print_record(console, record, directory)
    raise typer.Exit(HOLDS if record.verdict == "pass" else CHECK_FAILED)


@app.command()
def audit(
    model: ModelFile,
    time_step: TimeStep = 0.01,
    contact_model: ContactModel = "point",
    contact_approximation: Approximation = "sap",
    contact_geometry: Geometry = None,
    weld_base: WeldBase = None,
    ground: Ground = None,
) -> None:
    """List what of MODEL cannot be differentiated or will be differentiated wrongly, and what to change.

    Exit status 1 where a finding is an error.
    """
    from drake_diff.certificates.audit import audit as audit_model
    from drake_diff.model.model import load_model

    loaded = load_model(
        model,
        time_step=time_step,
        contact_model=contact_model,
        contact_approximation=contact_approximation,
        contact_geometry=contact_geometry,
        weld_base=weld_base,
        ground=ground,
    )
    console = Console(soft_wrap=True, highlight=False)
    findings = audit_model(loaded)
    for finding in findings:
        colour = {"error": "red", "warning": "yellow"}.get(finding.severity, "dim")
        console.print(f"[{colour} bold]{finding.severity}[/] {escape(finding.subject)}: {escape(finding.message)}")
        console.print(f"    [dim]remedy:[/] {escape(finding.remedy)}")
    counts = [sum(f.severity == severity for f in findings) for severity in ("error", "warning", "info")]
    console.print(f"{escape(loaded.name)}: {counts[0]} errors, {counts[1]} warnings, {counts[2]} notes")
    raise typer.Exit(CHECK_FAILED if counts[0] else HOLDS)


@app.command()
def certify(
    model: ModelFile,
    states: Annotated[int, typer.Option(help="How many states to sample; every other one in contact.")] = 20,
    seed: Annotated[int, typer.Option(help="The same seed gives the same states.")] = 0,
    parameter: Annotated[list[str] | None, typer.Option(help="Also certify the derivative by this one.")] = None,
    method: Annotated[str, typer.Option(help="auto, analytic, autodiff, implicit or finite_difference")] = "auto",
    out: Annotated[Path | None, typer.Option(help="Directory; artifacts/certify_<model> where not given.")] = None,
    time_step: TimeStep = 0.01,
    contact_model: ContactModel = "point",
    contact_approximation: Approximation = "sap",
    contact_geometry: Geometry = None,
    weld_base: WeldBase = None,
    ground: Ground = None,
) -> None:
    """Compare the step's derivatives of MODEL with differences, entry by entry, at sampled states.

    Writes certification.json. Exit status 0 only where every certificate agrees.
    """
    from drake_diff.model.model import load_model
    from drake_diff.record.certification import certify_model

    loaded = load_model(
        model,
        time_step=time_step,
        contact_model=contact_model,
        contact_approximation=contact_approximation,
        contact_geometry=contact_geometry,
        weld_base=weld_base,
        ground=ground,
    )
    console = Console(soft_wrap=True, highlight=False)
    console.print(f"[bold]{escape(model.name)}[/]: {escape(repr(loaded))}, contact {loaded.contract.contact.model}")
    directory = out or Path("artifacts") / f"certify_{model.stem}"
    names = tuple(parameter or ())
    record = certify_model(loaded, states=states, seed=seed, parameters=names, method=method, directory=directory)
    _print_certification(console, record)
    console.print(f"wrote {escape(str(directory / record.FILE))}")
    raise typer.Exit(HOLDS if record.verdict == "pass" else CHECK_FAILED)


app.command()(view)


def main() -> None:
    """The entry point: every error of ours becomes a sentence and an exit status."""
    try:
        app()
    except MissingDependencyError as error:
        _fail(error, MISSING)
    except DrakeDiffError as error:
        _fail(error, USAGE)
    except Exception:
        traceback.print_exc()
        print("drake-diff: this is a bug in the script or in drake-diff, not in what was asked", file=sys.stderr)
        sys.exit(INTERNAL)


def _fail(error: Exception, status: int) -> None:
    print(f"drake-diff: {type(error).__name__}: {error}", file=sys.stderr)
    sys.exit(status)


def _load(script: Path) -> ModuleType:
    """The script as a module; its `if __name__ == "__main__"` part does not run."""
    if not script.is_file():
        raise InputError("SCRIPT", got=str(script), expected="a Python file that exists")
    spec = importlib.util.spec_from_file_location("drake_diff_script", script)
    if spec is None or spec.loader is None:
        raise InputError("SCRIPT", got=str(script), expected="a Python file, its name ending in .py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not callable(getattr(module, "problem", None)):
        raise InputError("SCRIPT", got=f"{script} without it", expected="a function problem() that returns a Problem")
    return module


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[str], None]]:
    """One line that is rewritten on a terminal, plain lines elsewhere."""
    if not console.is_terminal:
        yield lambda line: console.print(escape(line))
        return
    with console.status("solving") as status:
        yield lambda line: status.update(escape(line))


def _print_certification(console: Console, record: Any) -> None:
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in ("state", "motion", "contacts", "entries", "largest", "from", "verdict"):
        table.add_column(name, justify="right" if name in ("state", "entries", "largest") else "left")
    for i, state in enumerate(record.states):
        modes = list(state.contact_modes.values())
        contacts = ", ".join(f"{modes.count(mode)} {mode}" for mode in sorted(set(modes)))
        gradient, largest = state.gradient, state.largest
        colour = "green" if state.verdict == "agree" else "red"
        table.add_row(
            str(i),
            state.kind,
            contacts,
            str(gradient.entries) if gradient else "",
            "" if largest is None else f"{largest:.4g}",
            gradient.method if gradient else "",
            f"[{colour}]{state.verdict}[/]" + (f", {len(state.mode_changes)} near" if state.mode_changes else ""),
        )
    console.print(table)
    for i, state in enumerate(record.states):
        if state.verdict != "agree":
            console.print(f"state {i}: {escape(state.refusal or state.gradient.worst)}")
            for change in state.mode_changes[:3]:
                console.print(f"    {escape(change)}")
    colour = "green" if record.verdict == "pass" else "red"
    console.print(
        f"[{colour} bold]{record.verdict}[/]  {escape(record.sentence)}, {record.wall_clock.duration_s:.1f} s"
    )


def _print_record(console: Console, record: Any, directory: Path) -> None:
    colour = {"pass": "green", "fail": "red"}.get(record.verdict, "yellow")
    solver = record.solver
    console.print(f"[{colour} bold]{record.verdict}[/]  {solver.status}: {escape(record.sentence)}")
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in ("measured again", "value", "unit", "tolerance", ""):
        table.add_column(name, justify="right" if name in ("value", "tolerance") else "left")
    for metric in record.metrics:
        tolerance = "" if metric.tolerance is None else f"{metric.tolerance:g}"
        shown = {"pass": "holds", "info": ""}.get(metric.verdict, "[red]does not hold[/]")
        table.add_row(metric.name, plain(metric.value), metric.unit, tolerance, shown)
    console.print(table)
    for replay in record.replays:
        told = "holds" if replay.holds else "[red]does not hold[/]: " + escape(replay.failures[0])
        goal = "-" if replay.goal_error is None else f"{replay.goal_error:.3g}"
        console.print(f"replayed {replay.variant}, {replay.control}: goal error {goal}, {told}", highlight=False)
    for p in record.parameters:
        moved = f", from {p.start:.6g}" if p.optimized else ""
        console.print(f"{escape(p.name)} = {p.value:.9g} {p.unit}{moved}, derivative from {p.derivative_source}")
    verdicts = [certificate.verdict for certificate in record.gradient.certificates]
    console.print(
        f"gradients: {verdicts.count('agree')} of {len(verdicts)} certificates agree; "
        f"{solver.method} with {solver.solver}, {solver.iterations} iterations, {record.wall_clock.duration_s:.1f} s",
        highlight=False,
    )
    console.print(f"wrote {escape(str(directory))}: record.json, {', '.join(sorted(record.files))}")


if __name__ == "__main__":
    main()
