"""Check that faults of an untrusted model stay in the process that reads it, and are reported."""

import ctypes
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers.models import MODELS, ROOT
from helpers.table import each_row
from numba.core import event

import drake_diff as dd
from drake_diff._base.compiled import time_compilations
from drake_diff._base.sandbox import call
from drake_diff.exceptions import InputError

FUZZ = ROOT / "tests" / "benchmarks" / "fuzz_directories.py"

pytestmark = [pytest.mark.usefixtures("child_process"), pytest.mark.solve]


def give(value):
    return value


def end():
    os.abort()


def touch_nothing():
    ctypes.string_at(0)


def never_end():
    while True:
        pass


def compile_for_long():
    time_compilations()
    with event.trigger_event("numba:compile"):
        time.sleep(1.5)
    return "compiled"


def take_memory():
    return len(bytearray(2 * 2**30))


def answer_much():
    return "x" * 10**8


def leave():
    sys.exit("enough")


def ask(function, monkeypatch, seconds=20.0, **arguments):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))  # the child can import what this process can
    return call(f"test_sandbox:{function.__name__}", arguments, seconds)


@pytest.mark.slow
@each_row(
    "function, is_limit, sentence",
    [
        (end, False, "SIGABRT"),
        (touch_nothing, False, "SIGSEGV"),
        (take_memory, True, "exceeded its memory limit of 1 GiB"),
        (answer_much, False, "67108864 bytes"),
        (leave, False, "enough"),
    ],
)
def test_how_a_call_ends_is_reported(function, is_limit, sentence, monkeypatch):
    outcome = ask(function, monkeypatch)
    assert sentence in outcome.error
    assert (outcome.value, outcome.is_limit) == (None, is_limit)


def test_a_call_that_never_ends_is_ended(monkeypatch):
    start = time.monotonic()
    assert "exceeded its time limit of 0.5 s" in ask(never_end, monkeypatch, seconds=0.5).error
    assert time.monotonic() - start < 60


def test_what_numba_compiles_does_not_count(monkeypatch):
    assert ask(compile_for_long, monkeypatch, seconds=1.0).value == "compiled"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    task = dd.Problem(model, x0=[0, 0], x_goal=[0.1, 0], num_steps=4, running_cost=dd.QuadraticCost(R=[[1.0]]))
    directory = tmp_path_factory.mktemp("runs") / "run"
    dd.save(dd.solve(task, method="shooting"), directory)
    return directory


def test_a_model_that_ends_drake_breaks_the_run(run, monkeypatch):
    monkeypatch.setattr("drake_diff.runs.verify.call", lambda *_: ask(end, monkeypatch))
    found = dd.verify(run)
    assert found.verdict == "broken"
    assert "the model cannot be read or run: the child process was ended by SIGABRT" in found.sentence


@pytest.mark.slow
@each_row("limit", [{"time_limit": 0.05}, {"memory_limit": 0.05}])
def test_a_limit_makes_a_run_undecided_and_is_named(run, limit):
    found = dd.verify(run, **limit)
    assert found.verdict == "undecided"
    assert "increase time_limit or memory_limit" in found.sentence


def test_limits_and_folders_that_are_none_are_refused(run, tmp_path):
    for given in ({"time_limit": 0}, {"memory_limit": float("nan")}, {"models": tmp_path / "none"}):
        with pytest.raises(InputError):
            dd.verify(run, **given)


@pytest.mark.slow
@pytest.mark.long
@each_row("words, refused", [(["--every-model", "--count", "12"], 8), (["--count", "25"], 8)])
def test_no_strange_directory_ends_this_process_or_leads_the_reader_out(words, refused):
    """The program fails on crashes, hangs, opened canaries, errors without a name, and accepted robot files."""
    done = subprocess.run([sys.executable, FUZZ, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(re.search(r"(\d+) verify: exit status 1", done.stdout)[1]) > refused
