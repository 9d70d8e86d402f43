"""What a stranger's model does to the process that reads it stays there, and is reported."""

import contextlib
import ctypes
import json
import os
import shutil
import sys
import time
from hashlib import sha256
from pathlib import Path

import pytest
from helpers.models import MODELS, ROOT
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base.sandbox import call
from drake_diff.exceptions import ArtifactError, InputError, ModelError
from drake_diff.runs.verify import recalled
from drake_diff.runs.view import scene_of_run

sys.path.insert(0, str(ROOT / "tests" / "benchmarks"))
from fuzz_directories import Canaries, fuzz, models, with_attachment
from trust_verify import seal

pytestmark = pytest.mark.usefixtures("child_process")


def give(value):
    return value


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


def leave():
    sys.exit("enough")


def ask(function, monkeypatch, seconds=20.0, **arguments):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))  # the child imports what this process can
    return call(f"test_sandbox:{function.__name__}", arguments, seconds)


@each_row(
    "function, kind, sentence",
    [
        (end, "crashed", "SIGABRT"),
        (touch_nothing, "crashed", "SIGSEGV"),
        (take_memory, "exceeded", "more than 1 GiB"),
        (answer_much, "error", "67108864 bytes"),
        (leave, "error", "enough"),
    ],
)
def test_how_a_call_ends_is_reported(function, kind, sentence, monkeypatch):
    outcome = ask(function, monkeypatch)
    assert sentence in getattr(outcome, kind)
    assert (outcome.value, bool(outcome.sentence)) == (None, True)


def test_a_value_comes_back(monkeypatch):
    assert ask(give, monkeypatch, value=[1, "a"]).value == [1, "a"]


def test_a_call_that_never_ends_is_ended(monkeypatch):
    start = time.monotonic()
    assert "within 0.5 s" in ask(never_end, monkeypatch, seconds=0.5).exceeded
    assert time.monotonic() - start < 60


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


@pytest.mark.slow
def test_no_model_leads_out_of_a_directory_or_ends_this_process(run, tmp_path):
    """Drake, ElementTree and PyYAML read them in the child process; inotify sees whoever opens a canary."""
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


def test_a_model_that_ends_drake_breaks_the_run(run, monkeypatch):
    monkeypatch.setattr("drake_diff.runs.verify.call", lambda *_: ask(end, monkeypatch))
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


@pytest.mark.slow
def test_100_strange_directories():
    wrong, ended, _ = fuzz(100, 0)
    assert wrong == []
    assert ended["verify: exit status 1"] > 30
