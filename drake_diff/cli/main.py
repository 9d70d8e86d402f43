"""The command `drake-diff`.

Exit status: 0 what was asked for holds, 1 a check failed, 2 wrong usage or input, 3 a solver or engine is missing,
4 an internal error. A run or panel that was ended by Ctrl-C, SIGTERM or SIGHUP exits with 130.
"""

import sys
import traceback
from typing import Annotated

import typer

from drake_diff._base.clock import interrupt_alike
from drake_diff.cli import models, plans, runs
from drake_diff.exceptions import DrakeDiffError, MissingDependencyError

USAGE, MISSING, INTERNAL = 2, 3, 4

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)
for group in (runs, models, plans):
    group.add_commands(app)


def _print_version(asked: bool) -> None:
    from importlib.metadata import PackageNotFoundError, version

    if not asked:
        return
    try:
        typer.echo(f"drake-diff {version('drake-diff')}")
        typer.echo(f"Steps are differentiated by compiled functions (Numba {version('numba')})")
    except PackageNotFoundError as error:
        raise MissingDependencyError("drake-diff runs from a folder and is not installed: pip install -e .") from error
    raise typer.Exit


@app.callback()
def about(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Trajectory optimization on Drake with gradients that are checked before they are used.

    Exit status: 0 what was asked for holds, 1 a check failed, 2 bad input, 3 a missing solver, engine or extra,
    4 an internal error or one in your script.
    """


def main() -> None:
    """The entry point: every error of ours becomes a sentence and an exit status."""
    interrupt_alike()
    try:
        app()
    except DrakeDiffError as error:
        words = "; ".join((str(error), *getattr(error, "__notes__", ())))
        print(f"drake-diff: {type(error).__name__}: {words}", file=sys.stderr)
        sys.exit(MISSING if isinstance(error, MissingDependencyError) else USAGE)
    except MemoryError:
        print(
            "drake-diff: MemoryError: it needs more memory than there is, or than this command may take",
            file=sys.stderr,
        )
        sys.exit(USAGE)
    except Exception:
        traceback.print_exc()
        advice = "the last lines above say where it failed: mend your script there, or report a bug in drake-diff"
        print(f"drake-diff: {advice}", file=sys.stderr)
        sys.exit(INTERNAL)


if __name__ == "__main__":
    main()
