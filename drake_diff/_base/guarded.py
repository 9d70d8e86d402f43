"""Call a function in a process that a stranger's file may crash, fill or hang, and that can reach nothing else.

A keeper is started once, imports what is asked for, and forks a process for each call: that costs milliseconds, where
an import of Drake costs a second. The keeper itself never reads what a stranger wrote. Of a function that is called a
second time it imports also what each call of it would load for itself.
"""

import atexit
import faulthandler
import json
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

from drake_diff._base import compiled
from drake_diff._base.confined import confine, limit_memory, pythons
from drake_diff.exceptions import ArtifactError

GIB = 2**30
MOST_ANSWER = 64 * 2**20  # bytes
TO_START = 60.0  # seconds in which the keeper has imported Drake, on a busy machine too
LAST_WORDS = 300  # characters of what a process wrote before it ended
TO_END = 5.0
KEPT = 600.0  # seconds without a call after which the keeper ends
COMMAND = "from drake_diff._base.guarded import keep; keep()"


@dataclass(frozen=True)
class Limits:
    """What a call may take: seconds, GiB of memory, and the folders whose files it may read."""

    seconds: float = 60.0
    memory: float = 1.0
    readable: tuple[str, ...] = ()


@dataclass(frozen=True)
class Answer:
    """What came of a call: the value that it returned, or why there is none.

    `crashed` says how its process ended, where a signal ended it; `exceeded` which limit it came to; `error` is what
    it raised. `unlimited` are the limits that this system could not set.
    """

    value: Any = None
    crashed: str = ""
    exceeded: str = ""
    error: str = ""
    unlimited: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """Why there is no value; "" where there is one."""
        if self.crashed:
            return f"the model cannot be read or run: the process that did so ended by {self.crashed}"
        return self.exceeded or self.error


class _Keeper:
    """The process that forks for this one."""

    def __init__(self) -> None:
        places = [str(Path(__file__).parents[2]), *(str(place) for place in pythons())]
        own = {"PYTHONPATH": os.pathsep.join(places), "OBJC_DISABLE_INITIALIZE_FORK_SAFETY": "YES"}
        if not sys.executable:
            raise ArtifactError("a stranger's model is read in a process of its own, and this Python cannot start one")
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", COMMAND],  # -P: the current directory may be the stranger's
            bufsize=0,  # half a request in a buffer would be sent by a process forked from this one too
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True,
            env={**os.environ, **own},
        )  # fmt: skip

    def ask(self, request: Mapping[str, Any], seconds: float) -> dict[str, Any] | None:
        """Its answer; None where it gave none."""
        given, answers = self.process.stdin, self.process.stdout
        if given is None or answers is None:
            return None
        words = json.dumps(request).encode() + b"\n"
        try:
            while words:
                words = words[os.write(given.fileno(), words) :]
        except OSError:
            return None
        data = _read(answers.fileno(), time.monotonic() + seconds, until=b"\n")
        return None if data is None else json.loads(data)

    def end(self) -> None:
        """Close its input, at which it ends what it does and itself."""
        if self.process.stdin is not None and self.process.stdout is not None:
            with suppress(OSError):
                self.process.stdin.close()
            self.process.stdout.close()
            try:
                self.process.wait(timeout=TO_END)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()


_one: _Keeper | None = None
_taken = threading.Lock()


def start() -> None:
    """Start the keeper, so that it imports while something else is done."""
    with _taken:
        _running()


def _running() -> _Keeper:
    global _one
    if _one is None or _one.process.poll() is not None:
        _end()
        _one = _Keeper()
    return _one


@atexit.register
def _end() -> None:
    global _one
    if _one is not None:
        _one.end()
    _one = None


def _forget() -> None:
    """In a process forked from this one: the keeper is not its own, and who held the lock is not there."""
    global _one, _taken
    _one, _taken = None, threading.Lock()


os.register_at_fork(after_in_child=_forget)


def call(function: str, arguments: Mapping[str, Any], limits: Limits, loads: Iterable[str] = ()) -> Answer:
    """Call `function`, "module:name", with arguments and a value that JSON has, in a process of its own.

    `loads` are modules that most calls of it load, where they are installed.
    """
    request = {
        "function": function,
        "loads": list(loads),
        "arguments": dict(arguments),
        "seconds": limits.seconds,
        "memory": int(limits.memory * GIB),
        "readable": [str(Path(place).resolve()) for place in limits.readable],
    }
    told = None
    with _taken:
        for _ in range(2):  # one that has waited too long ends, perhaps just now
            try:
                told = _running().ask(request, limits.seconds + TO_START)
            except BaseException:  # Ctrl-C: what it still answers belongs to this call
                _end()
                raise
            if told is not None:
                break
            _end()
    if told is None:
        return Answer(error="the process that reads strangers' models could not be started, or was killed")
    return Answer(**{**told, "unlimited": tuple(told.get("unlimited", ()))})


def _read(place: int, deadline: float, until: bytes = b"", watched: int | None = None) -> bytes | None:
    """What comes out of a pipe, to its end or `until` its last byte is that; None at the deadline, or if it ends early.

    None too where `watched` ends; ValueError where there is too much of it.
    """
    found = bytearray()
    while True:
        ready = _ready((place,) if watched is None else (place, watched), deadline - time.monotonic())
        if not ready or watched in ready:
            return None
        piece = os.read(place, 2**16)
        found += piece
        if not piece:
            return None if until else bytes(found)
        if until and found.endswith(until):
            return bytes(found)
        if len(found) > MOST_ANSWER:
            raise ValueError(f"its answer has more than {MOST_ANSWER} bytes")


def _ready(places: Iterable[int], seconds: float) -> list[int]:
    """Those of `places` that can be read within so many seconds; select() takes none of a number above 1023."""
    asked = select.poll()
    for place in places:
        asked.register(place, select.POLLIN)
    return [place for place, _ in asked.poll(max(0.0, 1e3 * seconds))]


def keep() -> None:
    """What the keeper does: answer a request on each line of its input, until that ends."""
    answers = os.dup(1)
    nothing = os.open(os.devnull, os.O_RDWR)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    called = set()
    while line := _line():
        request = json.loads(line)
        import_module(request["function"].partition(":")[0])
        for module in request["loads"] if request["function"] in called else ():
            with suppress(ImportError):
                import_module(module)
        called.add(request["function"])
        answer = json.dumps(_forked(request)).encode() + b"\n"
        with os.fdopen(os.dup(answers), "wb") as file:
            file.write(answer)


def _line() -> bytes:
    """A line of the input, read byte by byte: nothing of the next one is taken from it, which is watched."""
    found = bytearray()
    if not _ready((0,), KEPT):
        return b""
    while (piece := os.read(0, 1)) and piece != b"\n":
        found += piece
    return bytes(found)


def _forked(request: Mapping[str, Any]) -> dict[str, Any]:
    """The answer to a request, by a process of its own, which is gone when this returns, and its folder with it."""
    folder = tempfile.mkdtemp(prefix="drake_diff_")
    words = _file_of_words(folder)
    end, begin = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(end)
        _serve(request, Path(folder), begin, words)
    os.close(begin)
    data: bytes | None = b""
    try:
        try:
            data = _read(end, time.monotonic() + request["seconds"], watched=0)
        except ValueError as error:
            return {"error": str(error)}
        finally:
            if not data:
                _kill(child)
            _, status = os.waitpid(child, 0)
            _kill(child)  # what it started
        crash = _crash(status, words)
    finally:
        os.close(end)
        os.close(words)
        shutil.rmtree(folder, ignore_errors=True)
    if data is None:
        return {"exceeded": f"it did not end within {request['seconds']:g} s, the limit that was given"}
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL:
        return {"exceeded": "its process was killed from outside, as where a machine has no memory left"}
    if crash:
        return {"crashed": crash}
    try:
        answer: dict[str, Any] = json.loads(data)
    except ValueError:
        return {"error": f"its process ended with status {os.waitstatus_to_exitcode(status)} and gave no answer"}
    return answer


def crash_of(action: Callable[[], object]) -> str:
    """The signal that ended a process forked from this one to call `action()`, and its last words; "" where none did.

    For a file of the user's own, which nothing is kept from: it takes as long as `action()`, and some milliseconds.
    Only for a process without threads of Python, as a command is.
    """
    words, own = _file_of_words(tempfile.gettempdir()), os.getpid()
    child = 0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 counts the threads of libraries too
            child = os.fork()
        if child == 0:
            os.dup2(words, 1)
            os.dup2(words, 2)
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            faulthandler.disable()  # its words would be the last ones
            action()
        return _crash(os.waitpid(child, 0)[1], words)
    except BaseException:  # Ctrl-C; in the child, whatever `action` raises is for the caller to meet
        if child:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
        raise
    finally:
        if os.getpid() != own:
            os._exit(0)
        os.close(words)


def _file_of_words(folder: str) -> int:
    """A file without a name, for what a process writes to its terminal."""
    return os.open(folder, os.O_TMPFILE | os.O_RDWR) if hasattr(os, "O_TMPFILE") else os.open(os.devnull, os.O_RDWR)


def _crash(status: int, words: int) -> str:
    """The signal that a process ended by, with the last line that it wrote; "" where it ended by itself."""
    if not os.WIFSIGNALED(status):
        return ""
    said = os.pread(words, LAST_WORDS, max(0, os.fstat(words).st_size - LAST_WORDS))
    last = said.decode(errors="replace").strip().rpartition("\n")[2]
    return signal.Signals(os.WTERMSIG(status)).name + (f" ({last})" if last else "")


def _kill(child: int) -> None:
    with suppress(OSError):  # all of them have ended
        os.killpg(child, signal.SIGKILL)


def _serve(request: Mapping[str, Any], folder: Path, answers: int, words: int) -> NoReturn:
    """Call the function with all limits set, write the answer, and end."""
    status = 1
    try:
        os.setsid()
        os.dup2(words, 1)
        os.dup2(words, 2)
        os.close(0)
        os.chdir(folder)
        os.environ["TMPDIR"] = tempfile.tempdir = str(folder)
        compiled.never_save()
        limit_memory(request["memory"])
        unlimited = confine([Path(place) for place in request["readable"]], folder)
        answer: dict[str, Any] = {"unlimited": unlimited}
        module, _, name = request["function"].partition(":")
        try:
            answer["value"] = getattr(import_module(module), name)(**request["arguments"])
        except MemoryError:
            answer["exceeded"] = f"it needs more than {request['memory'] / GIB:g} GiB, the limit that was given"
        except (Exception, SystemExit) as error:
            answer["error"] = f"{type(error).__name__}: {error}"
        data = json.dumps(answer).encode()
        while data:
            data = data[os.write(answers, data) :]
        status = 0
    finally:
        os._exit(status)
