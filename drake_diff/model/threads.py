"""What each thread that uses a model has of its own, and what threads share: the plant."""

import threading
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from typing import Any
from weakref import WeakSet

from drake_diff.exceptions import ModelError
from drake_diff.model.twin import Twin

REMEDY = "which Drake keeps in the plant, not in a context: load a model of its own for each thread"


class OfThread(threading.local):
    """What a model keeps for one thread: a context holds one state, and so does much that is made of it.

    Nobody else sees it, so that threads which share a model cannot read each other's states. It ends with its thread.
    """

    def __init__(self) -> None:
        self.double: Twin | None = None
        self.autodiff: Twin | None = None
        self.cache: dict[Hashable, Any] = {}
        # What parameters in the contexts are, for the time being, not the model's own: see `parameters.applied`.
        self.other_quantities: frozenset[str] = frozenset()
        self.applied: Any = None  # the ParameterVector that is applied, if one is


class SharedPlant:
    """Which threads have contexts of one plant, and whether one of them has changed the plant itself."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self._users: WeakSet[threading.Thread] = WeakSet()
        self._changed: tuple[threading.Thread, str] | None = None  # by whom, and what

    def enter(self) -> None:
        """Before a thread makes a context. ModelError where another one has changed the plant."""
        me = threading.current_thread()
        with self.lock:
            if self._changed is not None and self._changed[0] is not me:
                thread, names = self._changed
                raise ModelError(f"another thread ({thread.name}) has set {names} of this model, {REMEDY}")
            self._users.add(me)

    @contextmanager
    def changed(self, names: str) -> Iterator[None]:
        """For as long as the parameters `names` are written into the plant itself.

        Raises ModelError where another thread uses the plant; until the end no other one may begin to.
        """
        me = threading.current_thread()
        with self.lock:
            others = [thread.name for thread in self._users if thread is not me and thread.is_alive()]
            if others:
                raise ModelError(f"another thread ({others[0]}) uses this model: none may set {names}, {REMEDY}")
            outer, self._changed = self._changed, (me, names)
        try:
            yield
        finally:
            with self.lock:
                self._changed = outer
