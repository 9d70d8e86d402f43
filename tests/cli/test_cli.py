"""Tests of the command line: its output, its exit status, and the files that it writes."""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from importlib import metadata

import numpy as np
import pytest
from helpers.models import ROOT
from helpers.table import each_row

import drake_diff as dd
from drake_diff.cli import main as cli
from drake_diff.comparison.recordings import write_csv
from drake_diff.exceptions import ArtifactError
from drake_diff.optimize import solve as solving
from drake_diff.runs import directory as directories
from drake_diff.runs.save import recover
from drake_diff.runs.view import list_runs

pytestmark = pytest.mark.solve

PENDULUM = f"""
import numpy as np
import drake_diff as dd

def problem():
    model = dd.load_model({str(ROOT / "models" / "pendulum.urdf")!r}, time_step=0.02)
    return dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=NUM_STEPS,
                      running_cost=dd.QuadraticCost(R=[[1.0]]),
                      bounds=dd.Bounds([-50, -99], [50, 99], [-LIMIT], [LIMIT]))

solve_options = OPTIONS
"""


def script(folder, *, num_steps=40, limit=30.0, options=None):
    path = folder / "task.py"
    text = PENDULUM.replace("NUM_STEPS", str(num_steps)).replace("LIMIT", str(limit))
    path.write_text(
        text.replace("OPTIONS", repr(options or {"method": "shooting"}).replace("Options(", "dd.optimize.Options("))
    )
    return path


def drake_diff(*words, cwd):
    command = [sys.executable, "-m", "drake_diff.cli.main", *map(str, words)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_a_run_that_holds_prints_its_checks_and_exits_with_0(tmp_path):
    done = drake_diff("run", script(tmp_path), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "pass  converged" in done.stdout
    assert re.search(r"goal error +\S+ +rad or rad/s +\S+ +holds", done.stdout)
    assert dd.load_record(tmp_path / "artifacts" / "task").verdict == "pass"


def test_a_script_may_define_plain_dynamics(tmp_path, monkeypatch, capsys):
    """A block is pushed from rest to rest over 1 m in 1 s. The least effort is 12."""
    text = """import drake_diff as dd
def problem():
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    ends = {"x0": [0, 0], "x_goal": [1, 0]}
    return dd.Problem(block, **ends, num_steps=10, horizon=1.0, running_cost=dd.QuadraticCost(R=[[1.0]]))
"""
    (tmp_path / "block.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    assert exit_of(monkeypatch, "run", tmp_path / "block.py", "--out", tmp_path / "elsewhere") == 0
    assert (tmp_path / "elsewhere" / "record.json").is_file()
    assert not (tmp_path / "artifacts").exists()
    shown = capsys.readouterr().out
    assert "Dynamics of the states x0, x1 under the inputs u0, 10 steps" in shown
    assert re.search(r"cost +12 ", shown)


PATH_TIMING = """import drake_diff as dd
def problem():
    path = [[0.0], [1.0]]
    return dd.optimize.PathTiming(dd.example_model("pendulum"), path, acceleration=4.0)
"""


def test_a_script_may_define_the_timing_of_a_path(tmp_path, monkeypatch, capsys):
    (tmp_path / "timing.py").write_text(PATH_TIMING)
    monkeypatch.chdir(tmp_path)
    assert exit_of(monkeypatch, "run", tmp_path / "timing.py", "--out", tmp_path / "run") == 0
    assert "PathTiming of pendulum" in capsys.readouterr().out
    (duration,) = (m.value for m in dd.load_record(tmp_path / "run").metrics if m.name == "horizon")
    assert duration == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("error", [RuntimeError("broken"), KeyboardInterrupt()])
def test_the_timing_of_a_path_that_ends_early_leaves_a_record_that_says_so(tmp_path, monkeypatch, error):
    def ended(*arguments):
        raise error

    monkeypatch.setattr("drake_diff.optimize.path_timing._Search.run", ended)
    (tmp_path / "timing.py").write_text(PATH_TIMING)
    monkeypatch.chdir(tmp_path)
    assert exit_of(monkeypatch, "run", tmp_path / "timing.py", "--out", tmp_path / "run") in (cli.INTERNAL, 130)
    (folder,) = tmp_path.glob("run.partial-*")
    record = dd.load_record(folder)
    assert record.verdict == "incomplete"
    assert "interrupted" in record.sentence or "broken" in record.sentence
    assert exit_of(monkeypatch, "recover", folder) == cli.USAGE


def test_an_option_that_the_timing_of_a_path_does_not_take_leaves_no_run(tmp_path, monkeypatch, capsys):
    (tmp_path / "timing.py").write_text(f"{PATH_TIMING}solve_options = {{'method': 'ilqr'}}\n")
    monkeypatch.chdir(tmp_path)
    assert exit_of(monkeypatch, "run", tmp_path / "timing.py", "--out", tmp_path / "run") == cli.USAGE
    assert "method: expected no value for a PathTiming" in capsys.readouterr().err
    assert not [*tmp_path.glob("run*")]


@pytest.mark.slow
def test_a_problem_that_cannot_be_solved_exits_with_1_and_a_complete_artifact(tmp_path):
    """0.1 N m cannot lift 1 kg at 0.5 m, which needs 4.9 N m, to the top within 0.8 s."""
    done = drake_diff("run", script(tmp_path, limit=0.1), cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    record = dd.load_record(tmp_path / "artifacts" / "task")
    assert (record.state, record.verdict) == ("complete", "fail")
    assert record.solver.status in done.stdout
    assert {p.name for p in (tmp_path / "artifacts" / "task").iterdir()} == {
        "plan.npz",
        "record.schema.json",
        "record.json",
        "replay.html",
        "report.html",
        "trace.mcap",
    }


@each_row(
    "edit, words",
    [
        (("num_steps=40", "num_steps=0"), "num_steps"),
        (("x0=[0, 0]", "x0=[0, 0, 0]"), "expected shape (2,)"),
        (("x0=[0, 0]", "x0=[0, float('nan')]"), "finite"),
        (("[-30.0]", "[31.0]"), "a lower bound of at most the upper bound"),
        (("time_step=0.02", "time_step=-0.02"), "time_step"),
        (("pendulum.urdf", "nothing.urdf"), "a file that exists"),
        (("'shooting'", "'magic'"), "one of auto, collocation"),
        (("{'method'", "{'solver': 'ipopt', 'method'"), "time_limit, got 'solver'"),
        (("pendulum.urdf", "../README.md"), ".urdf, .sdf"),
        (("pendulum.urdf", "../tests/not_a_robot.urdf"), "a robot model that Drake can read"),
        (("pendulum.urdf", "projectile.sdf"), "expected"),
        (("x0=[0, 0]", "x0=[99, 0]"), "expected within [-50, 50]"),
        (("def problem", "def another"), "problem()"),
        (
            ("return dd.Problem", "return lambda *_, **__: dd.Problem"),
            "problem(): expected a Problem, a PhasedProblem or a PathTiming, got function",
        ),
        (("{'method'", "{'metod'"), "solve_options: expected one of"),
    ],
)
def test_bad_input_exits_with_2_a_named_error_and_no_artifact(tmp_path, monkeypatch, capsys, edit, words):
    monkeypatch.chdir(tmp_path)
    path = script(tmp_path)
    text = path.read_text()
    assert edit[0] in text
    path.write_text(text.replace(*edit))
    assert exit_of(monkeypatch, "run", path) == cli.USAGE
    shown = capsys.readouterr().err
    assert words in shown
    assert "Error: " in shown
    assert "Traceback" not in shown
    assert not (tmp_path / "artifacts").exists()


def test_a_bug_in_the_script_exits_with_4_and_its_traceback(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = script(tmp_path)
    path.write_text(path.read_text().replace("import numpy as np", "import numpy as np\n1 / 0"))
    assert exit_of(monkeypatch, "run", path) == cli.INTERNAL
    assert "ZeroDivisionError" in capsys.readouterr().err


@pytest.mark.slow
def test_ctrl_c_ends_the_run_with_the_best_motion_so_far(tmp_path):
    options = {"method": "shooting", "max_iterations": 100000, "options": dd.optimize.Options(tolerance=1e-30)}
    running = start(script(tmp_path, num_steps=400, options=options), tmp_path)
    wait_until(lambda: list((tmp_path / "artifacts").glob("task.partial-*/record.json")))
    time.sleep(2.0)
    running.send_signal(signal.SIGINT)
    assert running.wait(timeout=60) == 1
    found = dd.load_record(tmp_path / "artifacts" / "task")
    assert found.state == "complete"
    assert found.solver.status == "interrupted"
    assert found.failures[0].code == "interrupted"


@each_row(
    "place, told",
    [
        ("import numpy as np", "during the setup of its problem, before the search began"),
        ("def problem():", "during the setup of its problem, before the search began"),
        ("the search", "interrupted before the search began: there is no plan"),
    ],
)
def test_a_signal_before_the_search_leaves_a_record_that_says_so(tmp_path, monkeypatch, place, told):
    """The signal is raised while the script is loaded, in problem(), or at the start of `solve`."""
    path = script(tmp_path, num_steps=5)
    signalled = "import signal; signal.raise_signal(signal.SIGTERM)"
    indent = "\n    " if place.startswith("def") else "\n"
    path.write_text(path.read_text().replace(place, f"{place}{indent}{signalled}"))
    if place == "the search":
        monkeypatch.setattr(solving, "first_guesses", lambda *_: signal.raise_signal(signal.SIGTERM))
    monkeypatch.chdir(tmp_path)
    with kept_handlers():
        assert exit_of(monkeypatch, "run", path) == 130
    (left,) = (tmp_path / "artifacts").glob("task.partial-*")
    found = dd.load_record(left)
    assert found.state == "incomplete"
    assert told in found.sentence
    assert not (tmp_path / "artifacts" / "task").exists()
    (line,) = list_runs(tmp_path / "artifacts")
    assert line.verdict == "incomplete"
    (undecided,) = dd.verify(left).undecided
    assert told in undecided
    with pytest.raises(ArtifactError, match="no plan of a solve to recover"):
        recover(left)
    shutil.rmtree(left)


def test_a_signal_before_the_directory_is_opened_writes_nothing_and_says_so(tmp_path, monkeypatch, capsys):
    path = script(tmp_path, num_steps=5)
    monkeypatch.setattr(directories, "check_place", lambda _: signal.raise_signal(signal.SIGTERM))
    monkeypatch.chdir(tmp_path)
    with kept_handlers():
        assert exit_of(monkeypatch, "run", path) == 130
    assert "no file is written" in capsys.readouterr().out
    assert [each.name for each in tmp_path.iterdir()] == ["task.py"]


@contextmanager
def kept_handlers():
    """Restore the signal handlers at the end."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_what_is_interrupted_stays_beside_an_earlier_run(tmp_path, number):
    earlier, runs = script(tmp_path, num_steps=5), tmp_path / "artifacts"
    start(earlier, tmp_path).wait(timeout=60)
    before = dd.load_record(runs / "task")
    options = {"method": "shooting", "max_iterations": 100000, "options": dd.optimize.Options(tolerance=1e-14)}
    running = start(script(tmp_path, num_steps=400, options=options), tmp_path)
    wait_until(lambda: list(runs.glob("task.partial-*/record.json")))
    time.sleep(1.0)
    running.send_signal(number)
    assert running.wait(timeout=60) == 1
    assert dd.load_record(runs / "task") == before
    (left,) = runs.glob("task.partial-*")
    found = dd.load_record(left)
    assert (found.state, found.solver.status) == ("complete", "interrupted")
    assert {line.name: line.verdict for line in list_runs(runs)} == {"task": before.verdict, left.name: "incomplete"}


@pytest.mark.slow
@each_row("delay", [0.0, 0.3, 1.0, 1.5])
def test_a_killed_run_never_looks_finished(tmp_path, delay):
    running = start(script(tmp_path, num_steps=60), tmp_path)
    runs = tmp_path / "artifacts"
    wait_until(lambda: list(runs.glob("task*/record.json")))
    time.sleep(delay)
    os.kill(running.pid, signal.SIGKILL)
    running.wait(timeout=10)
    if (runs / "task").exists():  # the run ended before the kill, so all of its files must exist
        found = dd.load_record(runs / "task")
        assert found.state == "complete"
        assert all((runs / "task" / name).stat().st_size == file.bytes for name, file in found.files.items())
    else:
        (line,) = list_runs(runs)
        assert line.verdict == "incomplete"


def start(path, cwd):
    command = [sys.executable, "-m", "drake_diff.cli.main", "run", str(path)]
    return subprocess.Popen(command, cwd=cwd, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def wait_until(condition, timeout=60.0):
    end = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def exit_of(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["drake-diff", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    return end.value.code


@each_row(
    "words, told",
    [
        (("certify", "PENDULUM", "--method", "magic"), "expected one of analytic"),
        (("certify", "PENDULUM", "--parameters", "hinge.damping, wind"), "got 'wind'"),
        (("compare", "PENDULUM", "--seed", "-3"), "--seed"),
        (("compare", "PENDULUM", "--num-steps", "0"), "--num-steps"),
        (("audit", "PENDULUM", "--time-step", "nan"), "time_step [s]: expected a finite number above 0, got nan"),
        (("audit", "PENDULUM", "--ground", "yes"), "--ground: expected true, or a friction coefficient, got 'yes'"),
        (("audit", "PENDULUM", "--actuators", "hinge=strong"), "--actuators: expected an effort limit [N or N m]"),
        (("audit", "PENDULUM", "--actuators", "hinge=1,wrist"), "--actuators: expected all, names of joints, or"),
        (("audit", "PENDULUM", "--gravity", "down"), "--gravity: expected three numbers, got 'down'"),
        (("audit", "PENDULUM", "--packages", "arm"), "--packages: expected NAME=FOLDER, got 'arm'"),
        (("audit", "PENDULUM", "--meshes", "round"), "meshes: expected one of convex, skip, spheres, got 'round'"),
        (("certify", "PENDULUM", "--mimic", "lock"), "got 'lock'"),
        (("certify", "PENDULUM", "--base", "hand"), "base: frame: expected one of"),
        (("audit", "nothing.urdf"), "expected a file that exists, got nothing.urdf"),
        (("certify", "PENDULUM", "--out", "FILE"), "is a file"),
        (("panel", "nothing.toml"), "expected a panel in TOML"),
        (("export", "nothing"), "expected --ros2"),
    ],
)
def test_bad_words_exit_with_2_and_one_sentence(tmp_path, monkeypatch, capsys, words, told):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "file").touch()
    names = {"PENDULUM": ROOT / "models" / "pendulum.urdf", "FILE": tmp_path / "file"}
    assert exit_of(monkeypatch, *(names.get(word, word) for word in words)) == cli.USAGE
    shown = capsys.readouterr().err
    assert told in shown
    assert "Traceback" not in shown


STRANGER = """<robot name="arm">
<link name="base"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<link name="arm"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="jaw"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="the hinge" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit effort="7" velocity="1" lower="-2" upper="2"/></joint>
<joint name="jaw" type="prismatic"><parent link="arm"/><child link="jaw"/><axis xyz="0 1 0"/>
<limit effort="7" velocity="1" lower="-2" upper="2"/><mimic joint="the hinge" multiplier="0.5"/></joint></robot>"""


@pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")
def test_what_the_audit_tells_can_be_typed_until_nothing_is_left_to_mend(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.urdf").write_text(STRANGER)
    typed, seen = [], []
    for _ in range(8):
        exit_of(monkeypatch, "audit", "arm.urdf", *typed)
        shown = capsys.readouterr().out.splitlines()
        options = [line.split("option: ")[1] for line in shown if "    option: " in line]
        if not options:
            break
        seen.append(options[0])
        typed += shlex.split(options[0])
    told = ["--actuators all", "--contact-geometry corner_spheres", "--ground true", "--mimic reduce"]
    assert sorted(seen) == told
    assert exit_of(monkeypatch, "certify", "arm.urdf", "--states", "2", *typed) == 0


def test_the_version_is_that_of_the_installation(tmp_path):
    done = drake_diff("--version", cwd=tmp_path)
    version, computes = done.stdout.splitlines()
    assert (done.returncode, version) == (0, f"drake-diff {metadata.version('drake-diff')}")
    assert computes.startswith("Steps are differentiated by compiled functions (Numba ")


def test_a_plan_of_another_tool_is_checked(tmp_path, monkeypatch, capsys):
    """A plan in steps, the same with a wrong state, and the same for another goal."""
    monkeypatch.setenv("COLUMNS", "200")
    model = dd.load_model(ROOT / "models" / "pendulum.urdf", time_step=0.05)
    problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=dd.QuadraticCost(R=[[1.0]]))
    plan = dd.solve(problem)
    write_csv(dd.Recording("plan", "1", plan.times, plan.xs, plan.us), model, tmp_path / "plan.csv")
    wrong = plan.xs + np.eye(21)[5][:, None] * [0.1, 0]
    write_csv(dd.Recording("wrong", "1", plan.times, wrong, plan.us), model, tmp_path / "wrong.csv")
    robot = ("--model", ROOT / "models" / "pendulum.urdf", "--out", tmp_path / "run")
    for words, status, text in (
        (("plan.csv", "--goal", "hinge=1"), 0, "pass verified: holds open loop at 50 ms"),
        (("plan.csv",), 0, "verified: holds"),
        (("wrong.csv", "--goal", "hinge=1"), 1, "the motion does not follow the dynamics after knots 4-5"),
        (("plan.csv", "--goal", "hinge=1.2"), 1, "hinge_q ends 0.2 rad from its goal"),
        (("plan.csv", "--goal", "wrist=1.2"), 2, ""),
    ):
        assert exit_of(monkeypatch, "check", tmp_path / words[0], *words[1:], *robot) == status
        assert text in capsys.readouterr().out
    assert dd.verify(tmp_path / "run").verdict == "holds"


@each_row(
    "words, status, message",
    [
        (("mine:step", "--x", "1,2", "--jacobian", "jacobian"), 0, "agree"),
        (("mine:step", "--x", "start", "--vjp", "vjp", "--scales", "1,1"), 0, "agree"),
        (("mine:step", "--x", "start", "--jacobian", "wrong"), 1, "d f[0] / d x[1]"),
        (("mine:stop", "--x", "start", "--jacobian", "wrong"), 2, "did you mean 'step'"),
        (("other:step", "--x", "start", "--jacobian", "wrong"), 2, "a module here or installed"),
        (("mine", "--x", "start", "--jacobian", "wrong"), 2, "numbers separated by commas, or a name in MODULE"),
        (("mine:step", "--x", "1,two", "--jacobian", "wrong"), 2, "numbers separated by commas"),
        (("mine:step", "--x", "1,2"), 2, "expected one of them"),
        ((".mine:step", "--x", "1,2"), 2, "a module here or installed"),
        (("mine.other:step", "--x", "1,2"), 2, "a module here or installed"),
        (
            ("mine:Own.step", "--x", "start", "--jacobian", "Own.jacobian", "--solver-tolerance", "1e-9"),
            0,
            "noise 1e-09",
        ),
        (("mine:Own.stop", "--x", "start", "--jacobian", "wrong"), 2, "did you mean 'step'"),
        (("mine:leave", "--x", "start", "--jacobian", "wrong"), 2, "got sys.exit(0)"),
        (("leaves:step", "--x", "start", "--jacobian", "wrong"), 2, "got sys.exit(0)"),
    ],
)
def test_a_function_of_a_module_is_certified(tmp_path_factory, words, status, message):
    folder = tmp_path_factory.mktemp("functions")
    (folder / "mine.py").write_text(
        "import numpy as np\n"
        "start = np.array([1.0, 2.0])\n"
        "step = lambda x: np.array([x[0] * x[1], np.sin(x[1])])\n"
        "jacobian = lambda x: np.array([[x[1], x[0]], [0.0, np.cos(x[1])]])\n"
        "wrong = lambda x: jacobian(x) * [1.0, 1.02]\n"
        "vjp = lambda x, w: w @ jacobian(x)\n"
        "leave = lambda x: exit(0)\n"
        "class Own: step, jacobian = staticmethod(step), staticmethod(jacobian)\n"
    )
    (folder / "leaves.py").write_text("raise SystemExit(0)\n")
    done = drake_diff("certify-function", *words, cwd=folder)
    assert done.returncode == status, done.stderr
    assert message in re.sub(r"\s+", " ", done.stdout + done.stderr)
