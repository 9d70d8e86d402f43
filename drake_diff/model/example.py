"""The robots that come with drake_diff: the files of `models/` and of `robots/` here, which are in the wheel too."""

from pathlib import Path
from typing import Any

from drake_diff.exceptions import UnknownNameError
from drake_diff.model.load_file import FORMATS
from drake_diff.model.model import Model, load_model

HERE = Path(__file__).parent
FOLDERS = (HERE.parent / "models", HERE / "robots")  # in a clone the first is a link to the top-level folder


def example_files() -> dict[str, Path]:
    """The file of each example, by its name."""
    files = [file for folder in FOLDERS for file in folder.iterdir() if file.name.endswith(FORMATS)]
    return {file.stem: file for file in sorted(files, key=lambda file: file.name)}


def example_model(name: str, *, time_step: float = 0.01, **options: Any) -> Model:
    """A robot that comes with drake_diff, loaded; it needs no file of yours.

    Args:
        name: "panda", "cart_pole", "pendulum", "double_pendulum", "acrobot", "hopper", "box_push", ...: a file of
            `models/`, without its ending, or the Panda.
        time_step: [s] of the discrete plant.
        options: All else that `load_model` takes.

    Returns:
        The Model, as `load_model` gives it.

    Raises:
        UnknownNameError: There is no such example; the message lists those that exist.
        InputError: An option is wrong.

    Example:
        >>> dd.example_model("panda").nu
        7
    """
    files = example_files()
    if name not in files:
        raise UnknownNameError("example model", got=name, known=files)
    return load_model(files[name], time_step=time_step, **options)
