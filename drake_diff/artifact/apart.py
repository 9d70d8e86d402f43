"""What is done with a stranger's directory in a process of its own: see `drake_diff._base.guarded`."""

from pathlib import Path

from drake_diff._base.guarded import Answer, Limits, call
from drake_diff.exceptions import ArtifactError, InputError

# What making a run again loads only where it is needed; of compiled functions the compiler alone, since such a process
# reads them without leave to write.
LOADS = ("drake_diff.artifact.page", "drake_diff.pages.meshcat", "drake_diff.mechanics.pinocchio_tree", "numba")


def call_on(
    function: str, folder: Path, models: str | Path | None, seconds: float = 60.0, memory: float = 1.0
) -> Answer:
    """Call `function(directory, models)`, which may read these two folders alone. InputError if `models` is none."""
    if models is not None and not Path(models).is_dir():
        raise InputError("models", got=str(models), expected="a folder that exists")
    given = {"directory": str(folder.resolve()), "models": None if models is None else str(Path(models).resolve())}
    readable = tuple(place for place in given.values() if place is not None)
    return call(function, given, Limits(seconds, memory, readable), LOADS)


def first_look(function: str, folder: Path, models: str | Path | None) -> None:
    """Call `function` so, before the same is done here; ArtifactError where its process does not survive that."""
    answer = call_on(function, folder, models)
    if answer.sentence:
        raise ArtifactError(f"{folder}: {answer.sentence}")
