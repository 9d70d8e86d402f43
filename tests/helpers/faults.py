"""Calls that change a disk below a folder are listed, made to fail, or made the last calls of their process.

Each attempt is a process of its own, which is forked from a process that has the solution to be saved.
"""

import errno
import json
import os
import signal
from pathlib import Path

import numpy as np

import drake_diff as dd
from drake_diff._base import files
from drake_diff.runs import page, provenance
from drake_diff.runs.fields import files_below
from helpers.forks import fork, status_of

ERRORS = ("ENOSPC", "EIO", "EACCES")
FULL = "full"  # a disk that is full from this call on: writing fails, removing and renaming do not
KILLED, KILLED_AFTER = "killed", "killed after"
FAULTS = (*ERRORS, FULL, KILLED, KILLED_AFTER)
WRITES = ("create", "write", "mkdir", "fsync")


class Disk:
    """A list of the calls below `root`, of which the `at`-th has the `fault`. The object patches its own process."""

    def __init__(self, root, at=None, fault=""):
        self.root, self.at, self.fault = str(Path(root).resolve()), at, fault
        self.calls = []
        for name in ("replace", "rename", "mkdir", "rmdir", "unlink", "chmod", "open", "fsync"):
            setattr(os, name, self._watched(name, getattr(os, name)))
        disk = self

        class Watched(files.FileIO):
            def __init__(self, path, mode):
                disk.meet("create", path, lambda: super(Watched, self).__init__(path, mode))

            def write(self, data):
                return disk.meet("write", self.name, lambda: super(Watched, self).write(data))

        files.FileIO = Watched
        exchange = files._renameat2()
        if exchange is not None:
            files._renameat2 = lambda: lambda *words: disk.meet("exchange", words[3], lambda: exchange(*words))

    def _watched(self, name, call):
        def watched(path, *words, dir_fd=None, **more):
            if dir_fd is not None:
                more["dir_fd"] = dir_fd
            if name == "open" and not words[0] & (os.O_WRONLY | os.O_RDWR | os.O_DIRECTORY):
                return call(path, *words, **more)  # opened for reading
            told = "create" if name == "open" and words[0] & os.O_CREAT else name
            return self.meet(told, path, lambda: call(path, *words, **more), dir_fd)

        return watched

    def meet(self, name, path, call, dir_fd=None):
        where = os.readlink(f"/proc/self/fd/{path}") if isinstance(path, int) else os.fsdecode(path)
        if dir_fd is not None:
            where = os.path.join(os.readlink(f"/proc/self/fd/{dir_fd}"), where)
        if not os.path.abspath(where).startswith(self.root):
            return call()
        number = len(self.calls)
        self.calls.append(f"{name} {os.path.relpath(where, self.root)}")
        if self.fault == FULL and number >= self.at and name in WRITES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if number != self.at or self.fault == FULL:
            return call()
        if self.fault in ERRORS:
            raise OSError(getattr(errno, self.fault), os.strerror(getattr(errno, self.fault)))
        if self.fault == KILLED_AFTER:
            call()
        os.kill(os.getpid(), signal.SIGKILL)
        return None


def forked(action):
    """Start a process of `action()`, which returns JSON data; return it and the pipe that `ended` reads."""
    reading, writing = os.pipe()

    def tell():
        try:
            told = {"ended": "done", "found": action()}
        except BaseException as error:
            told = {
                "ended": type(error).__name__,
                "message": str(error),
                "named": isinstance(error, dd.exceptions.DrakeDiffError),
            }
        with os.fdopen(writing, "wb") as pipe:
            pipe.write(json.dumps(told).encode())

    child = fork(tell)
    os.close(writing)
    return child, reading


def ended(child, reading):
    """Return the outcome of a process: its result, its exception, or that it was killed."""
    with os.fdopen(reading, "rb") as pipe:
        told = pipe.read()
    status = status_of(child)
    assert status in (0, -signal.SIGKILL), f"a forked process ended with status {status}, and told {told!r}"
    return json.loads(told) if status == 0 else {"ended": "killed"}


def tried(action, root, at=None, fault="", *, exchanges=True):
    """Return the outcome of `action()` if the `at`-th call below `root` has the `fault`; without one, all calls."""

    def act():
        if not exchanges:
            files._renameat2 = lambda: None
        disk = Disk(root, at, fault)
        action()
        return disk.calls

    return ended(*forked(act))


def two_solutions(folder):
    """Return two plans of a pendulum with a mesh in `folder`, one that was saved and one that replaces it."""
    sphere = '<sphere radius="0.05"/>'
    urdf = Path("models/pendulum.urdf").read_text().replace(sphere, '<mesh filename="meshes/bob.obj"/>')
    (folder / "meshes").mkdir()
    (folder / "meshes" / "bob.obj").write_text("mtllib bob.mtl\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "meshes" / "bob.mtl").write_text("newmtl red\nKd 1 0 0\n")
    (folder / "pendulum.urdf").write_text(urdf)
    model = dd.load_model(folder / "pendulum.urdf", time_step=0.02)
    asked = {"x0": [0, 0], "num_steps": 10, "running_cost": dd.QuadraticCost(R=[[1.0]])}
    return [dd.solve(dd.Problem(model, x_goal=[goal, 0], **asked), method="shooting") for goal in (0.2, 0.3)]


def quick_pages(monkeypatch):
    """Write short pages and look up versions once, so that the same files are written with less computation."""
    monkeypatch.setattr(page, "write_pages", lambda *words: [files.write_whole(path, b"a page") for path in words[:2]])
    known = provenance.provenance_of()
    monkeypatch.setattr(provenance, "provenance_of", lambda *_: known)


def goal_of(directory):
    """Return the goal of the run in `directory`; raise an AssertionError if the run is not complete."""
    record = dd.load_record(directory)
    assert record.state == "complete"
    assert record.sealed() == record
    assert files_below(Path(directory), record.FILE) == record.files
    return record.problem["x_goal"][0]


def has_plan(directory, solution):
    """Return whether the plan of `solution` can be read in `directory`."""
    try:
        with np.load(Path(directory) / "plan.npz") as plan:
            return np.array_equal(plan["xs"], solution.xs) and np.array_equal(plan["us"], solution.us)
    except (OSError, ValueError):
        return False
