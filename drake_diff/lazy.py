"""The public names, each of which loads its module, and what that needs of Drake, when it is first asked for.

They stand once, in `__init__.pyi`: for type checkers and editors as for this.
"""

from importlib import import_module
from pathlib import Path
from threading import RLock
from types import ModuleType
from typing import Any


def _read(stub: Path) -> dict[str, str]:
    """The module of each name, from the lines "from MODULE import NAME as NAME"."""
    lines = (line.split() for line in stub.read_text(encoding="utf-8").splitlines())
    return {words[3]: words[1] for words in lines if words[:1] == ["from"]}


PLACES = _read(Path(__file__).with_name("__init__.pyi"))
ONE_AT_A_TIME = RLock()  # NumPy and pydrake import in circles, which fails where two threads enter one at once


class Package(ModuleType):
    """The class of drake_diff itself (the Python data model's "Customizing module attribute access")."""

    def __getattr__(self, name: str) -> Any:
        if name not in PLACES:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}", name=name, obj=self)
        try:
            with ONE_AT_A_TIME:
                value = getattr(import_module(PLACES[name]), name)
        except AttributeError as error:  # which `from drake_diff import` would take for a name that is not there
            raise ImportError(f"{PLACES[name]}: {error}", name=PLACES[name]) from error
        setattr(self, name, value)
        return value

    def __setattr__(self, name: str, value: object) -> None:
        """Importing drake_diff.step sets the module `step`, which must not hide the function."""
        if name in PLACES and isinstance(value, ModuleType):
            return
        super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *PLACES})

    def __reduce__(self) -> tuple[Any, ...]:
        """By name, as cloudpickle (Ray, joblib) has modules of the plain class."""
        return import_module, (self.__name__,)
