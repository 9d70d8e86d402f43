"""What is lost of runs that are killed, that meet a disk that fails, that meet each other, or that get a signal.

    python tests/benchmarks/runs.py [--faults] [--kills 10000] [--pairs 1000] [--signals 12] [--seed 0]

A run lies in a directory, and another is saved there. --faults: every call that changes the disk, listed by a trace,
meets every fault in turn. --kills: so many processes are killed by SIGKILL at a random moment of the save. --pairs: so
many pairs of processes save to one directory at once. "Lost" is where the directory holds neither run whole, or, after
an error, the new plan is not where its message says. Pages are a word each; the rest is written as it is.

--signals: `drake-diff run` gets SIGINT, SIGTERM and SIGHUP in turn, at a random moment after its first record, so many
times for each task, half of them within the first half second, the others within 4 seconds: a pendulum of 400 steps by
shooting, a hopper with contact through relaxed stages, a Panda by collocation, a quadruped on its feet by iLQR. Told is
how long until a record says "interrupted" beside a plan.
"""

import argparse
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]

from helpers.faults import (  # noqa: E402
    FAULTS,
    ended,
    forked,
    goal_of,
    has_plan,
    killed_after,
    quick_pages,
    tried,
    two_solutions,
)

import drake_diff as dd  # noqa: E402

OLD = 0.2  # the goal of the run that is there
TASKS = {
    "pendulum": f"""
import numpy as np
import drake_diff as dd

def problem():
    model = dd.load_model({str(ROOT / "models/pendulum.urdf")!r}, time_step=0.02)
    return dd.Problem(model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=400, running_cost=dd.QuadraticCost(R=[[1.0]]))

solve_options = {{"method": "shooting", "solver": "ipopt", "tolerance": 1e-14, "max_iterations": 100000}}
""",
    "hop": f"""
import sys
sys.path.insert(0, {str(ROOT)!r})
from examples.hop_from_standing import problem, solve_options
""",
    "panda": """
import numpy as np
import drake_diff as dd

def problem():
    model = dd.example_model("panda", time_step=0.02)
    middle = sum(model.position_limits) / 2
    x0, goal = (np.concatenate([q, np.zeros(model.nv)]) for q in (middle, middle + 0.3))
    effort = dd.QuadraticCost(R=1e-3 * np.eye(model.nu))
    return dd.Problem(model, x0=x0, x_goal=goal, num_steps=50, running_cost=effort)

solve_options = {"method": "collocation", "tolerance": 1e-14, "max_iterations": 100000}
""",
    "quadruped": f"""
import numpy as np
import drake_diff as dd

def problem():
    joints = ("abduction", "hip_pitch", "knee")
    motors = {{f"{{leg}}_{{joint}}": 6.0 for leg in ("FL", "FR", "RL", "RR") for joint in joints}}
    more = {{"base": "free", "actuators": motors, "ground": 0.7, "contact": "ground"}}
    model = dd.load_model({str(ROOT / "models/quadruped.urdf")!r}, time_step=0.01, **more)
    x0 = model.default_state
    x0[6] = 0.3
    near = dd.QuadraticCost(Q=np.eye(model.nx), R=1e-3 * np.eye(model.nu), x_ref=x0)
    return dd.Problem(model, x0=x0, num_steps=100, running_cost=near)

solve_options = {{"method": "ilqr", "tolerance": 1e-14, "max_iterations": 100000}}
""",
}


class Quick:
    """What `monkeypatch.setattr` does, for good."""

    setattr = staticmethod(setattr)


class Place:
    """A folder with a run in it, and what is lost there."""

    def __init__(self, folder):
        self.solutions, self.run, self.kept = two_solutions(), folder / "runs" / "run", folder / "kept"
        self.kept.mkdir()
        tempfile.tempdir = str(self.kept)
        quick_pages(Quick)
        self.found = Counter()
        dd.save(self.solutions[0], self.run)

    def again(self):
        """As at first: the old run, and nothing else."""
        for path in (*self.run.parent.glob("run.*"), *self.kept.iterdir()):
            shutil.rmtree(path)
        (self.run.parent / ".run.lock").unlink(missing_ok=True)
        if not self.run.exists() or goal_of(self.run) != OLD:
            shutil.rmtree(self.run, ignore_errors=True)
            dd.save(self.solutions[0], self.run)

    def save(self):
        dd.save(self.solutions[1], self.run)

    def count(self, told):
        """Count what became of one save."""
        try:
            new = goal_of(self.run) != OLD
        except (AssertionError, dd.exceptions.DrakeDiffError) as error:
            print("lost:", told, error)
            self.found["lost"] += 1
        else:
            self.found["the new one is there" if new else "the old one is there"] += 1
        if told["ended"] not in ("done", "killed"):
            places = [self.run, *self.run.parent.glob("run.*"), *self.kept.iterdir()]
            if not any(str(p) in told["message"] and has_plan(p, self.solutions[1]) for p in places):
                print("the plan is not where it is said to be:", told)
                self.found["lost"] += 1
            self.found[told["ended"]] += 1
        self.again()


def faults(place):
    """Every call of a save meets every fault."""
    calls = tried(place.save, place.run.parent)["found"]
    place.again()
    for at in range(len(calls)):
        for fault in FAULTS:
            place.count(tried(place.save, place.run.parent, at, fault))
    kinds = Counter(call.split()[0] for call in calls)
    print(f"{len(calls)} calls ({', '.join(f'{n} {kind}' for kind, n in kinds.items())}), {len(FAULTS)} faults each")


def kills(place, count, seed):
    """Processes that are killed at a random moment."""
    rng, begun = random.Random(seed), time.monotonic()
    ended(*forked(place.save))
    seconds = time.monotonic() - begun
    place.again()
    for _ in range(count):
        place.count(killed_after(place.save, rng.uniform(0, seconds)))


def pairs(place, count):
    """Two processes at a time."""
    for _ in range(count):
        both = [forked(lambda solution=solution: dd.save(solution, place.run).verdict) for solution in place.solutions]
        told = [ended(*each) for each in both]
        place.found[", ".join(sorted("saved" if each["ended"] == "done" else each["ended"] for each in told))] += 1
        left = sorted(path.name for path in place.run.parent.iterdir())
        try:
            goal_of(place.run)
            broken = left != ["run"] or not any(each["ended"] == "done" for each in told)
        except (AssertionError, dd.exceptions.DrakeDiffError) as error:
            print(error)
            broken = True
        place.found["broken"] += broken


def signals(folder, count, seed):
    """How long after a signal the best plan can be read."""
    rng = random.Random(seed)
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    for name, text in TASKS.items():
        (folder / "task.py").write_text(text)
        moments = [rng.uniform(0.0, 4.0 if i % 2 else 0.5) for i in range(count)]
        took = sorted(told_after(folder, numbers[i % 3], moment) for i, moment in enumerate(moments))
        within = sum(t <= 1.0 for t in took)
        print(f"{name}: {within} of {count} within 1 s; [s] {', '.join(f'{t:.2f}' for t in took)}", flush=True)


def told_after(folder, number, seconds):
    """[s] from a signal until a record says that the run was interrupted; infinite if none does, NaN if it was over."""
    shutil.rmtree(folder / "runs", ignore_errors=True)
    words = [sys.executable, "-m", "drake_diff.cli.main", "run", str(folder / "task.py"), "--out", "runs/run"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    running = subprocess.Popen(words, cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, **quiet)
    while not list(folder.glob("runs/run*/record.json")):
        if running.poll() is not None:
            raise SystemExit(f"the run ended with status {running.returncode} before it began: {words}")
        time.sleep(0.01)
    time.sleep(seconds)
    begun = time.monotonic()
    running.send_signal(number)
    while True:
        for path in folder.glob("runs/run*/record.json"):
            try:
                record = json.loads(path.read_text())
            except (OSError, ValueError):  # it is being moved to its place
                continue
            if "interrupted" in record["sentence"] and (path.parent / "plan.npz").is_file():
                took = time.monotonic() - begun
                running.kill()  # the rest is measured without an end to wait for
                running.wait()
                return took
        if running.poll() is not None:
            return math.nan if running.returncode in (0, 1) else math.inf
        time.sleep(0.002)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", action="store_true")
    for name in ("kills", "pairs", "signals"):
        parser.add_argument(f"--{name}", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0, help="of the moments of kills and signals")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        if given.signals:
            signals(folder, given.signals, given.seed)
        place = Place(folder)
        for asked, work in (
            (given.faults, lambda: faults(place)),
            (given.kills, lambda: kills(place, given.kills, given.seed)),
            (given.pairs, lambda: pairs(place, given.pairs)),
        ):
            if asked:
                place.found.clear()
                begun = time.monotonic()
                work()
                told = ", ".join(f"{what}: {n}" for what, n in sorted(place.found.items()))
                print(f"{told}; lost: {place.found['lost']}; {time.monotonic() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main()
