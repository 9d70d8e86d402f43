"""The command `drake-diff`. Exit status: 0 it holds, 1 a check failed, 2 usage, 3 something is missing, 4 internal."""

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

HOLDS, CHECK_FAILED, USAGE, MISSING, INTERNAL = range(5)

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)


@app.callback()
def about() -> None:
    """Trajectory optimization on Drake with gradients that are checked before they are used."""


@app.command()
def run(
    script: Annotated[
        Path, typer.Argument(help="A Python file that defines problem(), and solve_options if it likes.")
    ],
    out: Annotated[Path | None, typer.Option(help="Run directory; artifacts/<script> where not given.")] = None,
) -> None:
    """Solve the problem that SCRIPT defines, measure the solution again, and write the run directory."""
    from drake_diff.evidence import begin, save
    from drake_diff.solver import solve

    console = Console(soft_wrap=True, highlight=False)
    module = _load(script)
    problem = module.problem()
    options = dict(getattr(module, "solve_options", {}))
    directory = out or Path("artifacts") / script.stem
    console.print(f"[bold]{escape(script.name)}[/]: {escape(repr(problem.model))}, {problem.num_steps} steps")
    with _progress(console) as report:
        solution = solve(problem, progress=report, on_start=lambda: begin(directory, problem), **options)
    record = save(solution, directory)
    _print_record(console, record, directory)
    raise typer.Exit(HOLDS if record.verdict == "pass" else CHECK_FAILED)


def main() -> None:
    """The entry point: every error of ours becomes a sentence and an exit status."""
    from drake_diff.exceptions import DrakeDiffError, MissingDependencyError

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
    from drake_diff.exceptions import InputError

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


def _print_record(console: Console, record: Any, directory: Path) -> None:
    colour = {"pass": "green", "fail": "red"}.get(record.verdict, "yellow")
    solver = record.solver
    console.print(f"[{colour} bold]{record.verdict}[/]  {solver.status}: {escape(record.sentence)}")
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in ("measured again", "value", "unit", "bound", ""):
        table.add_column(name, justify="right" if name in ("value", "bound") else "left")
    for check in record.checks:
        value, bound = check.quantity.value, check.bound
        table.add_row(
            check.name,
            "-" if value is None else f"{value:.6g}",
            check.quantity.unit,
            "" if bound is None else f"{bound:g}",
            {True: "holds", False: "[red]does not hold[/]", None: ""}[check.passed],
        )
    console.print(table)
    verdicts = [gradient.verdict for gradient in record.gradients]
    console.print(
        f"gradients: {verdicts.count('agree')} of {len(verdicts)} certificates agree; "
        f"{solver.method} with {solver.solver}, {solver.iterations} iterations, {record.wall_clock.solve_s:.1f} s",
        highlight=False,
    )
    console.print(f"wrote {escape(str(directory))}: record.json, {', '.join(sorted(record.files))}")


if __name__ == "__main__":
    main()
