"""Utilities for every layer: checked numbers, clocks, files, and lazily loaded names."""

import re
from collections.abc import Callable
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from threading import RLock
from typing import Any

import lazy_loader

ONE_AT_A_TIME = RLock()  # the circular imports of NumPy and pydrake fail if two threads import at once


def attach_stub(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of `package` for the names in the stub next to `file`."""
    load, names, everything = lazy_loader.attach_stub(package, file)

    def load_alone(name: str) -> Any:
        if name == "__version__" and "." not in package:
            return import_module("importlib.metadata").version(package)
        if not name.startswith("__") and name not in names():
            similar = _similar_names(package, Path(file).parent, name, names())
            guess = f"; did you mean {similar}?" if similar else ""
            raise AttributeError(f"module {package} has no attribute {name}{guess}", name=name)
        with ONE_AT_A_TIME:
            return load(name)

    return load_alone, names, everything


def _similar_names(package: str, folder: Path, name: str, names: list[str]) -> str:
    """Return names in a package and its subpackages that resemble `name`, as "a or b", or "" if there are none."""
    known = {other: f"{package}.{other}" for other in names}
    for stub in folder.glob("*/__init__.pyi"):
        inner = re.findall(r" as (\w+)$", stub.read_text(), re.MULTILINE)
        known = {other: f"{package}.{stub.parent.name}.{other}" for other in inner} | known
    return known.get(name) or " or ".join(known[other] for other in get_close_matches(name, known, n=2))
