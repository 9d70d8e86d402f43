"""Tests of the command as a process: signals, closed pipes, full disks and names that are not UTF-8."""

import os
import subprocess
import sys

import pytest
from helpers.command import drake_diff
from helpers.models import MODELS

pytestmark = pytest.mark.solve

PROBLEM = f"""import drake_diff as dd
def problem():
    model = dd.load_model({str(MODELS / "pendulum.urdf")!r}, time_step=0.05)
    return dd.Problem(model, x0=[0, 0], x_goal=[0.5, 0], num_steps=10, running_cost=dd.QuadraticCost(R=[[1.0]]))
"""


@pytest.fixture
def python(tmp_path):
    options = {"cwd": tmp_path, "capture_output": True, "text": True, "timeout": 60}
    return lambda code: subprocess.run([sys.executable, "-c", code], **options)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_amid_the_import_of_an_extension_comes_after_it(python, name):
    """If an exception is raised during the import of Drake's extension, it aborts, or prints it and continues."""
    done = python(f"""import os, signal, sys
from drake_diff._base.clock import interrupt_alike
interrupt_alike()
def trace(frame, event, argument):
    if "enum" in frame.f_code.co_filename and any("pydrake" in name for name in sys.modules):
        sys.settrace(None)
        sys.stdout.write("sent ")
        os.kill(os.getpid(), signal.{name})
sys.settrace(trace)
try:
    import pydrake.common
    sys.stdout.write("imported ")  # not print, which the signal may part from its newline
    while True: pass
except KeyboardInterrupt:
    sys.stdout.write("interrupted")""")
    assert (done.stdout.split(), done.stderr) == (["sent", "imported", "interrupted"], "")


def test_ctrl_c_in_any_command_is_status_130_and_a_later_command_has_its_own_status(python):
    code = """import os, sys
from drake_diff.cli import main
@main.app.command()
def trap(): os.kill(os.getpid(), 2) if first else sys.exit(1)
sys.argv = ["drake-diff", "trap"]
for first in (True, False):
    try: main.main()
    except SystemExit as end: sys.__stdout__.write(f"{end.code} ")"""
    assert python(code).stdout.split() == ["130", "1"]


@pytest.mark.parametrize(("reader", "status"), [("pipe", 0), ("/dev/full", 2)])
def test_a_run_is_written_although_its_output_is_not(tmp_path, reader, status):
    (tmp_path / "problem.py").write_text(PROBLEM)
    end, pipe = os.pipe()
    os.close(end)
    file = pipe if reader == "pipe" else os.open(reader, os.O_WRONLY)
    done = drake_diff("run", "problem.py", "--out", "run", cwd=tmp_path, stdout=file)
    os.close(file)
    assert done.returncode == status, done.stderr
    assert ("the output could not be written: [Errno 28]" in done.stderr) == (status == 2)
    assert drake_diff("verify", "run", cwd=tmp_path).returncode == 0


def test_names_that_are_no_text_are_refused_by_name(tmp_path):
    name = os.fsdecode(b"\xff.urdf")
    (tmp_path / name).write_bytes((MODELS / "pendulum.urdf").read_bytes())
    (tmp_path / "problem.py").write_text(PROBLEM)
    run = ("run", "problem.py", "--out", os.fsdecode(b"\xff"))
    for words, subject in ((("certify", name), "model file"), (run, "name")):
        done = drake_diff(*words, cwd=tmp_path)
        assert done.returncode == 2
        assert f"{subject}: expected a name in UTF-8, got '\\udcff" in done.stderr
    assert drake_diff("audit", name, cwd=tmp_path).returncode == 0
