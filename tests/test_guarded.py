"""What a stranger's model does to the process that reads it stays there, and is told; it reaches nothing else."""

import contextlib
import ctypes
import json
import os
import resource
import shutil
import socket
import subprocess
import sys
import threading
import time
from hashlib import sha256
from pathlib import Path

import pytest
from helpers.forks import fork, status_of
from helpers.models import MODELS, ROOT
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base import guarded
from drake_diff._base.guarded import Limits, call
from drake_diff.artifact.live import scene_of_run
from drake_diff.artifact.verify import recalled
from drake_diff.exceptions import ArtifactError, InputError, ModelError

sys.path.insert(0, str(ROOT / "tests" / "benchmarks"))
from fuzz_directories import Canaries, fuzz, models, with_attachment
from trust_verify import seal

HERE = Path(__file__)


@pytest.fixture(autouse=True, scope="module")
def importable():
    """The keeper finds this module, as it imports what this process can."""
    guarded._end()
    sys.path.append(str(HERE.parent))
    yield
    sys.path.remove(str(HERE.parent))
    guarded._end()


def give(value):
    return value


def has_loaded(module):
    return module in sys.modules


def end():
    os.abort()


def touch_nothing():
    ctypes.string_at(0)


def never_end():
    while True:
        pass


def take_memory():
    return len(bytearray(2 * 2**30))


def answer_much():
    return "x" * 10**8


def read(path):
    return Path(path).read_text()


def write(path):
    Path(path).write_text("x")


def connect(port):
    socket.create_connection(("127.0.0.1", port), timeout=5)


def run_git():
    subprocess.run(["git", "--version"], check=True)


def kill_the_keeper():
    os.kill(os.getppid(), 9)


def leave():
    sys.exit("enough")


def ask(function, seconds=20.0, **arguments):
    return call(f"test_guarded:{function.__name__}", arguments, Limits(seconds=seconds))


@each_row(
    "function, kind, told",
    [
        (end, "crashed", "SIGABRT"),
        (touch_nothing, "crashed", "SIGSEGV"),
        (take_memory, "exceeded", "more than 1 GiB"),
        (answer_much, "error", "67108864 bytes"),
        (run_git, "error", "PermissionError"),
        (kill_the_keeper, "error", "PermissionError"),
        (leave, "error", "enough"),
    ],
)
def test_what_a_call_does_is_told_and_the_next_one_is_answered(function, kind, told):
    found = ask(function)
    assert told in getattr(found, kind)
    assert (found.value, bool(found.sentence)) == (None, True)
    assert ask(give, value=[1, "a"]).value == [1, "a"]


def test_what_every_call_loads_is_loaded_once_from_the_second_call_on():
    """And what is not installed is not asked for again."""
    loads = ("no_such_module", "wave")
    found = [call("test_guarded:has_loaded", {"module": "wave"}, Limits(), loads).value for _ in range(3)]
    assert found == [False, True, True]


def test_a_call_that_never_ends_is_ended():
    start = time.monotonic()
    assert "within 0.5 s" in ask(never_end, seconds=0.5).exceeded
    assert time.monotonic() - start < 60


def test_files_outside_and_the_network_are_not_there(tmp_path):
    (tmp_path / "secret").write_text("secret")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert ask(connect, port=port).error
    for path in (tmp_path / "secret", Path("/etc/passwd")):
        assert "PermissionError" in ask(read, path=str(path)).error
    assert "PermissionError" in ask(write, path=str(tmp_path / "new")).error
    own = call("test_guarded:read", {"path": str(tmp_path / "secret")}, Limits(readable=(str(tmp_path),)))
    assert (own.value, own.unlimited) == ("secret", ())


def test_threads_and_forked_processes_each_get_their_answers():
    found = {}
    threads = [threading.Thread(target=lambda i=i: found.update({i: ask(give, value=i).value})) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {i: i for i in range(8)}

    assert status_of(fork(asks)) == 0
    assert ask(give, value=6).value == 6


def asks():
    answer = ask(give, value=5)
    assert answer.value == 5, answer


def test_a_process_forked_while_a_thread_asks_waits_for_nobody():
    """The lock that the thread held stayed locked for ever in a process that has not that thread."""
    with guarded._taken:
        assert status_of(fork(asks)) == 0


def test_a_process_with_many_open_files_gets_its_answer():
    """select() refuses files of a number above 1023."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = 2048 if hard == resource.RLIM_INFINITY else min(hard, 2048)
    if wanted < 2048:
        pytest.skip("this system does not let a process open so many files")
    opened = []
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, wanted), hard))
    try:
        opened += [os.open(os.devnull, os.O_RDONLY) for _ in range(1100)]
        guarded._end()
        assert ask(give, value=7).value == 7
    finally:
        for number in opened:
            os.close(number)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_no_process_is_left_behind():
    code = "from drake_diff._base.guarded import start, _running\nstart()\nprint(_running().process.pid, flush=True)"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    keeper = int(child.stdout)
    for _ in range(100):
        try:
            os.kill(keeper, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    pytest.fail("the keeper outlived the process that started it")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    task = dd.Problem(model, x0=[0, 0], x_goal=[0.1, 0], num_steps=4, running_cost=dd.QuadraticCost(R=[[1.0]]))
    directory = tmp_path_factory.mktemp("runs") / "run"
    dd.save(dd.solve(task, method="shooting"), directory)
    return directory


def with_model(run, place, name, data):
    """The run with another robot file, all hashes right."""
    folder = Path(shutil.copytree(run, place))
    fields = json.loads((folder / "record.json").read_text())
    with_attachment(folder / "trace.mcap", "pendulum.urdf", name, data)
    fields["model"]["file"] = {"path": name, "bytes": len(data), "sha256": sha256(data).hexdigest(), "reason": None}
    seal(folder, fields)
    return folder


def test_no_model_leads_out_of_a_directory_or_ends_this_process(run, tmp_path):
    """Drake, ElementTree and PyYAML read them in the process apart; inotify would see whoever opens a canary."""
    canaries = Canaries(tmp_path / "canaries")
    (canaries.folder / "secret.obj").read_text()
    assert canaries.opened() > 0, "the watch sees nothing"
    accepted = []
    for i, (name, text) in enumerate(models(canaries.folder)):
        folder = with_model(run, tmp_path / str(i), name, text.encode())
        found = dd.verify(folder)
        accepted += [name] * found.holds
        for opened in (scene_of_run, lambda given: recalled(given).__enter__()) if i % 5 == 0 else ():
            with contextlib.suppress(ArtifactError, ModelError):
                opened(folder)
    assert accepted == []
    assert canaries.opened() == 0


def test_a_model_that_ends_drake_is_told(run, monkeypatch):
    """In the process apart: here nothing is patched but what it is told to call."""
    monkeypatch.setattr("drake_diff.artifact.verify.call_on", lambda *_: ask(end))
    found = dd.verify(run)
    assert found.verdict == "broken"
    assert "the model cannot be read or run: the process that did so ended by SIGABRT" in found.sentence


@each_row("limit", [{"time_limit": 0.05}, {"memory_limit": 0.05}])
def test_a_limit_makes_a_run_undecided_and_is_named(run, limit):
    found = dd.verify(run, **limit)
    assert found.verdict == "undecided"
    assert "--time-limit and --memory-limit, give it more" in found.sentence


def test_limits_and_folders_that_are_none_are_refused(run, tmp_path):
    for given in ({"time_limit": 0}, {"memory_limit": float("nan")}, {"models": tmp_path / "none"}):
        with pytest.raises(InputError):
            dd.verify(run, **given)


def test_20_strange_directories():
    wrong, ended, _ = fuzz(20, 3)
    assert wrong == []
    assert ended["verify: exit status 1"] > 5


@pytest.mark.slow
def test_100_strange_directories():
    wrong, ended, _ = fuzz(100, 0)
    assert wrong == []
    assert ended["verify: exit status 1"] > 30
