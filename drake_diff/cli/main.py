"""The command `drake-diff`.

Exit status: 0 what was asked for holds, 1 a check failed, 2 wrong usage or input, 3 a solver or engine is missing,
4 an internal error, 130 ended by Ctrl-C, SIGTERM or SIGHUP. A reader of the output that goes away changes nothing.
"""

import sys
import traceback
from collections.abc import Callable
from typing import Annotated, Any

import typer

from drake_diff._base.clock import INTERRUPTED, INTERRUPTIONS, discard, interrupt_alike
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


class _Output:
    """A stream that takes all that is written: what its file does not take, as a closed pipe, goes nowhere.

    So a run goes on, and is written, when nobody reads what the command says of it. `error` is what its file said.
    """

    def __init__(self, stream: Any):
        self.stream = stream
        self.error: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        self._try(self.stream.write, text)
        return len(text)

    def flush(self) -> None:
        self._try(self.stream.flush)

    def _try(self, action: Callable[..., Any], *given: Any) -> None:
        try:
            action(*given)
        except OSError as error:
            self.error = error
            discard(self.stream.fileno())


def main() -> None:
    """The entry point: every error of ours becomes a sentence and an exit status."""
    interrupt_alike()
    output = _Output(sys.stdout)
    sys.stdout, sys.stderr = output, _Output(sys.stderr)
    status = _status_of_app()
    output.flush()
    if INTERRUPTIONS and status == 1:  # as Typer has it
        status = INTERRUPTED
    if output.error is not None and not isinstance(output.error, BrokenPipeError):
        print(f"drake-diff: the output could not be written: {output.error}", file=sys.stderr)
        status = status or USAGE
    sys.exit(status)


def _status_of_app() -> Any:
    """The exit status of the command, after what it has to say of its error."""
    try:
        app()
    except SystemExit as end:
        return end.code
    except DrakeDiffError as error:
        words = "; ".join((str(error), *getattr(error, "__notes__", ())))
        print(f"drake-diff: {type(error).__name__}: {words}", file=sys.stderr)
        return MISSING if isinstance(error, MissingDependencyError) else USAGE
    except MemoryError:
        text = "drake-diff: MemoryError: the command needs more memory than is free, or than its limit allows"
        print(text, file=sys.stderr)
        return USAGE
    except Exception:
        traceback.print_exc()
        advice = (
            "the last lines above show where the error occurred: correct your script, or report a bug in drake-diff"
        )
        print(f"drake-diff: {advice}", file=sys.stderr)
        return INTERNAL
    return 0


if __name__ == "__main__":
    main()
