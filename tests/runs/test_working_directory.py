"""Check that a command runs no file that the (possibly untrusted) working directory names. Each test sets traps."""

import os
import shutil
import subprocess

import pytest
from helpers.command import drake_diff
from helpers.engines import needs
from helpers.models import MODELS

from drake_diff.runs.provenance import provenance_of

pytestmark = pytest.mark.solve

TRAP = "import pathlib\npathlib.Path({!r}).touch()\n"


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Create an empty working directory, and return it with the path of a file that a trap creates."""
    folder, sprung = tmp_path / "here", tmp_path / "sprung"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    return folder, sprung


def git(*words):
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    command_line = ["git", "-c", "user.name=a", "-c", "user.email=a@b", *words]
    return subprocess.run(command_line, check=True, capture_output=True, text=True).stdout.strip()


def commit(text):
    with open("file", "w") as file:
        file.write(text)
    git("add", ".")
    git("commit", "-qm", "message")
    return git("rev-parse", "HEAD")


def test_the_commit_of_a_checkout_and_whether_it_differs(here):
    folder, _ = here
    assert provenance_of().git is None
    git("init", "-q")
    assert provenance_of().git is None  # the repository has no commit
    head = commit("text")
    assert provenance_of().git == {"commit": head, "dirty": False}
    (folder / "untracked").touch()
    git("pack-refs", "--all")
    git("gc", "-q")
    assert provenance_of().git == {"commit": head, "dirty": False}
    git("worktree", "add", "-q", str(folder.parent / "other"))
    os.chdir(folder.parent / "other")
    assert provenance_of().git == {"commit": head, "dirty": False}
    (folder / "file").write_text("changed")
    assert provenance_of().git == {"commit": head, "dirty": False}
    os.chdir(folder)
    assert provenance_of().git == {"commit": head, "dirty": True}
    (folder / "below").mkdir()
    os.chdir(folder / "below")
    assert provenance_of().git == {"commit": head, "dirty": True}
    os.chdir(folder)
    git("add", "file")
    assert provenance_of().git == {"commit": head, "dirty": True}


def test_settings_of_a_checkout_run_no_drake_diff(here):
    folder, sprung = here
    git("init", "-q")
    (folder / ".gitattributes").write_text("* filter=trap diff=trap\n")
    head = commit("text")
    (folder / "post-index-change").write_text(f"#!/bin/sh\ntouch {sprung}\n")
    (folder / "post-index-change").chmod(0o755)
    settings = ("core.fsmonitor", "filter.trap.clean", "filter.trap.process", "diff.external", "core.sshCommand")
    for name in settings:
        git("config", name, f"touch {sprung}")
    git("config", "core.hooksPath", str(folder))
    (folder / "file").write_text("changed")
    assert provenance_of().git == {"commit": head, "dirty": True}
    assert not sprung.exists()
    subprocess.run(["git", "status"], check=False)
    assert sprung.exists()  # the traps work


def test_ipopt_reads_no_options(here):
    folder, sprung = here
    (folder / "ipopt.opt").write_text(f"output_file {sprung}\n")
    done = drake_diff("plan", str(MODELS / "pendulum.urdf"), "--goal", "hinge=0.1", "--out", "run")
    assert done.returncode == 0, done.stderr
    assert not sprung.exists()


def test_numba_loads_nothing_from_where_the_directory_says(here):
    folder, sprung = here
    (folder / ".numba_config.yaml").write_text(f"cache_dir: {sprung}\n")
    done = drake_diff("certify", str(MODELS / "pendulum.urdf"))
    assert done.returncode == 2
    assert ".numba_config.yaml: expected no such file" in done.stderr
    assert not sprung.exists()


def test_processes_of_libraries_import_nothing_from_the_directory(here):
    needs("mujoco")
    folder, sprung = here
    for name in ("ctypes", "numpy", "glfw"):
        (folder / f"{name}.py").write_text(TRAP.format(str(sprung)))
    done = drake_diff("compare", str(MODELS / "pendulum.urdf"), "--engines", "mujoco", "--out", "run")
    assert done.returncode in (0, 1), done.stderr
    assert not sprung.exists()
