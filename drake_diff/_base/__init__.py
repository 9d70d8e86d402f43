"""What every layer uses: checked numbers, clocks, files; and names that load their module when first used."""

from collections.abc import Callable
from threading import RLock
from typing import Any

import lazy_loader

ONE_AT_A_TIME = RLock()  # NumPy and pydrake import in circles, which fails where two threads enter one at once


def attach_stub(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of `package`: the names that the stub beside `file` imports."""
    load, names, everything = lazy_loader.attach_stub(package, file)

    def load_alone(name: str) -> Any:
        with ONE_AT_A_TIME:
            return load(name)

    return load_alone, names, everything
