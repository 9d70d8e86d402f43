"""The command `drake-diff`.

Exit status: 0 success, 1 a failed check, 2 wrong usage or input, 3 a missing solver or engine, 4 an internal error, 130
interrupted by Ctrl-C, SIGTERM or SIGHUP. A closed output pipe does not change the status.
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
        raise MissingDependencyError("drake-diff has no version, as it is not installed: pip install -e .") from error
    raise typer.Exit


@app.callback()
def about(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Trajectory optimization on Drake with gradients that are checked before they are used.

    Exit status: 0 success, 1 a failed check, 2 bad input, 3 a missing solver, engine or extra, 4 an internal error or
    an error in your script.
    """


class _Output:
    """A stream that accepts all output, and discards what its file does not accept, such as a closed pipe.

    A run therefore continues and is written even if nobody reads the output. `error` is the file's error.
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
    """Run the command; convert every error of drake_diff to a sentence and an exit status."""
    interrupt_alike()
    output = _Output(sys.stdout)
    sys.stdout, sys.stderr = output, _Output(sys.stderr)
    status = _status_of_app()
    output.flush()
    if INTERRUPTIONS and status == 1:  # Typer's status for an interrupt
        status = INTERRUPTED
    if output.error is not None and not isinstance(output.error, BrokenPipeError):
        print(f"drake-diff: the output could not be written: {output.error}", file=sys.stderr)
        status = status or USAGE
    sys.exit(status)


def _status_of_app() -> Any:
    """Return the exit status of the command, after printing its error."""
    try:
        app()
    except SystemExit as end:
        return end.code
    except DrakeDiffError as error:
        words = "; ".join((str(error), *getattr(error, "__notes__", ())))
        print(f"drake-diff: {type(error).__name__}: {words}", file=sys.stderr)
        return MISSING if isinstance(error, MissingDependencyError) else USAGE
    except MemoryError:
        text = "drake-diff: MemoryError: the command needs more memory than is free or than its limit allows"
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
