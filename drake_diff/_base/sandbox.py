"""Run a function in a child process with limits of time and memory, and report a crash or an exceeded limit.

The child is a new Python process; arguments and results are passed as JSON. It has the rights of the user who started
it. docs/verification.md lists the risks that remain.
"""

import faulthandler
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from drake_diff.exceptions import ArtifactError, DrakeDiffError

GIB = 2**30
LARGEST_ANSWER = 64 * 2**20  # bytes, also for any other file that the child writes
START_UP = 180.0  # [s] for importing Drake and compiling with Numba, even on a busy machine
LAST_WORDS = 300  # maximum number of characters reported from the end of a process's output
COMMAND = "from drake_diff._base.sandbox import serve; serve()"
REQUEST, ANSWER, OUTPUT = "request.json", "answer.json", "output.txt"
USED = "/proc/self/statm"  # in pages; the sixth number is the size of data and stack
NEARLY = 0.9  # of a process's memory limit
NO_MEMORY = 99  # the exit status of a child whose memory allocation failed
MOST_TAKEN = GIB  # bytes that reading one file may take


class CallOutcome(NamedTuple):
    """The value that a call returned, or an `error` message, and whether the error is an exceeded limit."""

    value: Any = None
    error: str = ""
    is_limit: bool = False


def call(function: str, arguments: Mapping[str, Any], seconds: float = 60.0, memory: float = 1.0) -> CallOutcome:
    """Call `function`, "module:name", in a child process.

    Args:
        function: The name; its module is imported before the limits apply.
        arguments: The keyword arguments, as JSON values.
        seconds: The time limit of the call, not counting Numba's compilation.
        memory: The memory limit of the child in GiB.
    """
    request = {"function": function, "arguments": dict(arguments), "seconds": seconds, "memory": int(memory * GIB)}
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, sys.path)]),
    }
    with tempfile.TemporaryDirectory(prefix="drake_diff_") as name:
        folder = Path(name)
        (folder / REQUEST).write_text(json.dumps(request))
        with (folder / OUTPUT).open("wb") as output:
            child = subprocess.Popen(
                [sys.executable, "-P", "-c", COMMAND],  # -P: the child imports nothing from the working directory
                cwd=folder,
                env={**environment, "TMPDIR": name},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )
            try:
                child.wait(timeout=seconds + START_UP)
            except subprocess.TimeoutExpired:
                pass
            finally:
                with suppress(OSError):  # kill the child and the processes that it started
                    os.killpg(child.pid, signal.SIGKILL)
                status = child.wait()
        return _outcome(folder, status, request)


def _outcome(folder: Path, status: int, request: Mapping[str, Any]) -> CallOutcome:
    """Return the outcome of a child process that ended with `status`."""
    answer = folder / ANSWER
    if status == 0 and answer.is_file():
        return CallOutcome(*json.loads(answer.read_bytes()))
    if -status in (signal.SIGALRM, signal.SIGKILL):
        killed = ", or the machine ran out of memory" if -status == signal.SIGKILL else ""
        return CallOutcome(error=f"it exceeded its time limit of {request['seconds']:g} s{killed}", is_limit=True)
    if -status == signal.SIGXFSZ:
        return CallOutcome(error=f"its result has more than {LARGEST_ANSWER} bytes")
    if status < 0:
        name = signal.Signals(-status).name + _last_line((folder / OUTPUT).read_bytes())
        return CallOutcome(error=f"the model cannot be read or run: the child process was ended by {name}")
    return CallOutcome(error=f"the child process ended with status {status} and without a result")


def serve() -> None:
    """Call the function of request.json under its limits and write answer.json; runs in the child process."""
    request = json.loads(Path(REQUEST).read_text())
    module, _, name = request["function"].partition(":")
    function = getattr(import_module(module), name)
    _limit(resource.RLIMIT_DATA, request["memory"])
    _limit(resource.RLIMIT_CORE, 0)
    _limit(resource.RLIMIT_FSIZE, LARGEST_ANSWER)
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # Python ignores it by default, so that a write would only fail
    signal.setitimer(signal.ITIMER_REAL, request["seconds"])  # ends the child in any state, even without its parent
    try:
        answer = CallOutcome(function(**request["arguments"]))
    except MemoryError:
        limit = f"it exceeded its memory limit of {request['memory'] / GIB:g} GiB"
        answer = CallOutcome(error=limit, is_limit=True)
    except (Exception, SystemExit) as error:
        answer = CallOutcome(error=f"{type(error).__name__}: {error}")
    Path(ANSWER).write_text(json.dumps(answer))
    os._exit(0)  # threads of libraries may not end


def _limit(kind: int, most: int) -> None:
    _, hard = resource.getrlimit(kind)
    most = most if hard == resource.RLIM_INFINITY else min(most, hard)
    resource.setrlimit(kind, (most, most))


def _last_line(output: bytes) -> str:
    last = output[-LAST_WORDS:].decode(errors="replace").strip().rpartition("\n")[2]
    return f" ({last})" if last else ""


def crash_of(action: Callable[[], object], seconds: float = 60.0, memory: float = 1.0) -> str:
    """Call `action()` in a forked process; return "" or the crash: a signal with the last output line, or a limit.

    Use it for the user's own files: it adds only milliseconds to the time of `action()`. This process must have no
    other Python threads. The limits are those of `call`, except that `memory` is in addition to this process's memory.
    """
    parent, child = os.getpid(), 0
    with tempfile.TemporaryFile() as output:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 counts the threads of libraries too
                child = os.fork()
            if child == 0:
                os.dup2(output.fileno(), 1)
                os.dup2(output.fileno(), 2)
                _limit(resource.RLIMIT_CORE, 0)
                _limit(resource.RLIMIT_DATA, _used() + int(memory * GIB))
                signal.signal(signal.SIGALRM, signal.SIG_DFL)
                signal.setitimer(signal.ITIMER_REAL, seconds)
                faulthandler.disable()  # its output would hide the last line
                action()
            status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) if child else 0
        except BaseException as error:  # Ctrl-C; errors of `action` in the child are ignored
            if child:
                os.kill(child, signal.SIGKILL)
                os.waitpid(child, 0)
            elif os.getpid() != parent and isinstance(error, MemoryError):
                os._exit(NO_MEMORY)
            raise
        finally:
            if os.getpid() != parent:
                os._exit(0)
        if status == -signal.SIGALRM:
            return f"the limit of {seconds:g} s"
        if status == NO_MEMORY:
            return f"the limit of {memory:g} GiB"
        if status >= 0:
            return ""
        output.seek(0)
        return signal.Signals(-status).name + _last_line(output.read())


@contextmanager
def memory_at_most(bytes_: int) -> Iterator[None]:
    """Limit the memory of this process while the block runs; an allocation beyond the limit raises MemoryError."""
    with _at_most(resource.RLIMIT_DATA, bytes_):
        yield


@contextmanager
def _at_most(kind: int, most: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(kind)
    least = min(limit for limit in (most, soft, hard) if limit != resource.RLIM_INFINITY)
    resource.setrlimit(kind, (least, hard))
    try:
        yield
    finally:
        resource.setrlimit(kind, (soft, hard))


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Parse an untrusted file in at most `MOST_TAKEN` bytes of additional memory, and of files.

    Raises ArtifactError, "{path} is not {what}", for any error of a parser, or beyond the limit. Our own errors pass.
    """
    try:
        with memory_at_most(_used() + MOST_TAKEN), _at_most(resource.RLIMIT_FSIZE, MOST_TAKEN):
            yield
    except DrakeDiffError:
        raise
    except MemoryError as error:
        raise ArtifactError(f"{path}: reading it takes more than {MOST_TAKEN / GIB:g} GiB of memory") from error
    except Exception as error:  # parsers raise many errors for damaged files
        raise ArtifactError(f"{path} is not {what}: {type(error).__name__}: {error!s:.300}") from error


def _used() -> int:
    """Return the bytes of data and stack that this process uses, or 0 if the system does not report them."""
    return int(Path(USED).read_text().split()[5]) * resource.getpagesize() if os.path.exists(USED) else 0


def check_memory() -> None:
    """Raise MemoryError close to the memory limit of this process, because C libraries crash without memory."""
    most, _ = resource.getrlimit(resource.RLIMIT_DATA)
    if most != resource.RLIM_INFINITY and _used() > NEARLY * most:
        raise MemoryError
