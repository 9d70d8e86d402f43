"""The robots included in drake_diff: the files of `models/` and of `robots/` in this folder, also in the wheel."""

from pathlib import Path
from typing import Any

from drake_diff.exceptions import UnknownNameError
from drake_diff.model.load_file import FORMATS
from drake_diff.model.model import Model, load_model

HERE = Path(__file__).parent
FOLDERS = (HERE.parent / "models", HERE / "robots")  # in a clone, the first folder is a link to the top-level folder


def example_files() -> dict[str, Path]:
    """Return the file of each example by its name."""
    files = [file for folder in FOLDERS for file in folder.iterdir() if file.name.endswith(FORMATS)]
    return {file.stem: file for file in sorted(files, key=lambda file: file.name)}


def example_model(name: str, *, time_step: float = 0.01, **options: Any) -> Model:
    """Load a robot that is included in drake_diff.

    Args:
        name: "panda", "cart_pole", "pendulum", "double_pendulum", "acrobot", "hopper", "box_push", ...: the name of a
            file in `models/` without its extension, or the Panda.
        time_step: The time step of the discrete plant [s].
        options: Further arguments of `load_model`.

    Returns:
        The Model that `load_model` returns.

    Raises:
        UnknownNameError: The example does not exist; the message lists the existing examples.
        InputError: An option is invalid.

    Example:
        >>> dd.example_model("panda").nu
        7
    """
    files = example_files()
    if name not in files:
        raise UnknownNameError("example model", got=name, known=files)
    return load_model(files[name], time_step=time_step, **options)
