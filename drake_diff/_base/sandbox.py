"""Run a function in one child process with limits of time and memory: its crash or overrun is reported, not shared.

The child is a fresh Python process; arguments and value travel as JSON. It has the rights of the user who started it:
see docs/verification.md for what that does not protect against.
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
LARGEST_ANSWER = 64 * 2**20  # bytes, also of any other file that the child writes
START_UP = 180.0  # [s] in which Python has imported Drake and Numba has compiled, on a busy machine too
LAST_WORDS = 300  # characters of what a process wrote before it ended
COMMAND = "from drake_diff._base.sandbox import serve; serve()"
REQUEST, ANSWER, OUTPUT = "request.json", "answer.json", "output.txt"
USED = "/proc/self/statm"  # in pages; the sixth number is that of data and stack
NEARLY = 0.9  # of the memory that a process may have
NO_MEMORY = 99  # the exit status of a child that got none
MOST_TAKEN = GIB  # bytes that reading one file may take


class CallOutcome(NamedTuple):
    """The value that a call returned, or the `error` why there is none, and whether that is a limit it reached."""

    value: Any = None
    error: str = ""
    is_limit: bool = False


def call(function: str, arguments: Mapping[str, Any], seconds: float = 60.0, memory: float = 1.0) -> CallOutcome:
    """Call `function`, "module:name", in a child process.

    Args:
        function: The module is imported before the limits hold.
        arguments: By keyword, as JSON has them.
        seconds: How long the call may take, without what Numba compiles.
        memory: How much memory the child may have, in GiB.
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
                with suppress(OSError):  # the child, and whatever it started
                    os.killpg(child.pid, signal.SIGKILL)
                status = child.wait()
        return _outcome(folder, status, request)


def _outcome(folder: Path, status: int, request: Mapping[str, Any]) -> CallOutcome:
    """What came of a child that has ended with `status`."""
    answer = folder / ANSWER
    if status == 0 and answer.is_file():
        return CallOutcome(*json.loads(answer.read_bytes()))
    if -status in (signal.SIGALRM, signal.SIGKILL):
        killed = ", or the machine ran out of memory" if -status == signal.SIGKILL else ""
        return CallOutcome(error=f"it exceeded its time limit of {request['seconds']:g} s{killed}", is_limit=True)
    if -status == signal.SIGXFSZ:
        return CallOutcome(error=f"its answer has more than {LARGEST_ANSWER} bytes")
    if status < 0:
        name = signal.Signals(-status).name + _last_line((folder / OUTPUT).read_bytes())
        return CallOutcome(error=f"the model cannot be read or run: the process that did so ended by {name}")
    return CallOutcome(error=f"its process ended with status {status} and gave no answer")


def serve() -> None:
    """In the child: call the function of request.json under its limits, and write answer.json."""
    request = json.loads(Path(REQUEST).read_text())
    module, _, name = request["function"].partition(":")
    function = getattr(import_module(module), name)
    _limit(resource.RLIMIT_DATA, request["memory"])
    _limit(resource.RLIMIT_CORE, 0)
    _limit(resource.RLIMIT_FSIZE, LARGEST_ANSWER)
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # Python ignores it, and a write fails
    signal.setitimer(signal.ITIMER_REAL, request["seconds"])  # ends the child, whatever it does, also without a parent
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
    """What ended a process forked from this one to call `action()`: a signal and last words, a limit; "" if nothing.

    For a file of the user's own: it takes as long as `action()`, and some milliseconds. Only for a process without
    threads of Python, as a command is. The limits are as those of `call`, the memory beside what this process has.
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
                faulthandler.disable()  # its words would be the last ones
                action()
            status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) if child else 0
        except BaseException as error:  # Ctrl-C; in the child, whatever `action` raises is for the caller to meet
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
    """Let this process have at most so much of its own memory while the block runs; MemoryError where it needs more."""
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
    """Parse a stranger's file with no more than `MOST_TAKEN` bytes of memory beside what is used, and of files.

    ArtifactError, "{path} is not {what}", of whatever a parser raises, or where it needs more; our errors stay.
    """
    try:
        with memory_at_most(_used() + MOST_TAKEN), _at_most(resource.RLIMIT_FSIZE, MOST_TAKEN):
            yield
    except DrakeDiffError:
        raise
    except MemoryError as error:
        raise ArtifactError(f"{path}: reading it takes more than {MOST_TAKEN / GIB:g} GiB of memory") from error
    except Exception as error:  # parsers fail in many ways on what is damaged
        raise ArtifactError(f"{path} is not {what}: {type(error).__name__}: {error!s:.300}") from error


def _used() -> int:
    """Bytes of data and stack that this process has; 0 where the system does not say."""
    return int(Path(USED).read_text().split()[5]) * resource.getpagesize() if os.path.exists(USED) else 0


def check_memory() -> None:
    """MemoryError where this process has used nearly all that it may have: libraries in C crash where they get none."""
    most, _ = resource.getrlimit(resource.RLIMIT_DATA)
    if most != resource.RLIM_INFINITY and _used() > NEARLY * most:
        raise MemoryError
