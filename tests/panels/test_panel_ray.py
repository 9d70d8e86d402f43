"""Tests of panels as tasks of a real Ray cluster on this machine, of one node and of two nodes."""

import contextlib
import os
import secrets
import signal
import socket
import subprocess
import sys
import time

import pytest
from helpers.engines import needs

import drake_diff as dd

needs("ray")
pytestmark = pytest.mark.slow

FUNCTIONS = """
import os, time
import numpy as np

def cheap(trial):
    with open("log", "ab", buffering=0) as file:
        file.write(f"{os.getpid()} {trial['level']} {trial['repeat']}\\n".encode())
    time.sleep(0.02)
    if trial["level"] == 2 and trial["repeat"] == 10 and not os.path.exists("victim"):
        with open("unnamed", "w") as file:
            file.write(str(os.getpid()))
        os.rename("unnamed", "victim")
        time.sleep(trial["seconds"])
    if trial["level"] == 3 and trial["repeat"] < 2:
        raise ValueError("no, that one not")
    rng = np.random.default_rng(trial["seed"])
    return {"success": bool(rng.random() < 0.5), "cost": rng.normal(), "threads": os.environ["OPENBLAS_NUM_THREADS"]}

def dies(trial):
    if trial["level"] == 3 and trial["repeat"] == 4:
        os._exit(1)
    return {"cost": trial["level"]}
"""
PANEL = 'evaluate = "trials.py:{}"\nseeds = 50\n[fixed]\nseconds = {}\n[axes]\nlevel = [1, 2, 3, 4]\n'
# This runs in a process of its own, because Ray can be restricted to loopback only before its first import.
KILLED = """
import os, signal, sys, time
from drake_diff.panels import run_panel

def kill(finished, count, errors):
    if os.path.exists("victim") and not os.path.exists("killed"):
        pids = {line.split()[0] for line in open("log")}
        os.kill(int(open("victim").read()), signal.SIGKILL)
        open("killed", "w").close()
        print("of", len(pids), "workers one is killed after", finished, "trials")

if __name__ == "__main__":
    run_panel("panel.toml", out="ray", workers=2, engine="ray", progress=kill)
"""


@pytest.fixture(autouse=True)
def token(monkeypatch):
    """Set a token for these clusters only. Without a token, Ray writes its own into the home directory."""
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))


@pytest.fixture
def write(tmp_path):
    def write_panel(function, *, seconds=0.0):
        (tmp_path / "trials.py").write_text(FUNCTIONS)
        (tmp_path / "panel.toml").write_text(PANEL.format(function, seconds))

    return write_panel


def panel(folder, *words):
    command = [sys.executable, "-m", "drake_diff.cli.main", "panel", "panel.toml", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=240)


def files(directory):
    return {name: (directory / name).read_bytes() for name in ("table.csv", "summary.json")}


def test_a_cluster_of_which_a_worker_is_killed_gives_the_table_of_local_processes(write, tmp_path):
    write("cheap", seconds=5.0)
    assert panel(tmp_path, "--out", "local", "--workers", "2").returncode == 1  # two rows are errors
    (tmp_path / "log").unlink()
    (tmp_path / "victim").unlink()
    (tmp_path / "script.py").write_text(KILLED)
    done = subprocess.run([sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert "of 2 workers one is killed" in done.stdout
    assert files(tmp_path / "ray") == files(tmp_path / "local")
    evaluated = [line.split(maxsplit=1) for line in (tmp_path / "log").read_text().splitlines()]
    assert len({pid for pid, _ in evaluated}) == 3  # two workers, and the replacement of the killed worker
    trials = [trial for _, trial in evaluated]
    assert sorted(trials) == sorted([*set(trials), "2 10"])  # each trial once, and the killed trial twice
    assert len(set(trials)) == 200


def test_a_trial_that_kills_its_worker_twice_is_the_same_row_on_a_cluster(write, tmp_path):
    write("dies")
    for engine in ("local", "ray"):
        done = panel(tmp_path, "--out", engine, "--engine", engine, "--workers", "2")
        assert done.returncode == 1, done.stderr
        assert "200 trials, 1 errors" in done.stdout
    assert files(tmp_path / "ray") == files(tmp_path / "local")


def test_a_cluster_that_is_not_there_is_refused(write, tmp_path):
    write("cheap")
    done = panel(tmp_path, "--engine", "ray", "--address", "127.0.0.1:1")
    assert done.returncode == 2
    assert "address: expected HOST:PORT of a running Ray head" in done.stderr


@pytest.fixture
def start_node(monkeypatch):
    """Return a function that starts a node of two cores; it returns the node and the address of the first, the head."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    nodes = []

    def start(name):
        words = [f"--address=127.0.0.1:{port}"] if nodes else ["--head", f"--port={port}", "--include-dashboard=false"]
        command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--num-cpus=2", "--block", *words]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        nodes.append(subprocess.Popen(command, env=os.environ | {"NODE": name}, start_new_session=True, **quiet))
        wait_for(lambda: listens(port) and has_raylet(nodes[-1]), 120)
        address = f"127.0.0.1:{port}"
        wait_for(lambda: cores(address) == 2 * len(nodes), 120)  # a panel uses the nodes that have joined before it
        return nodes[-1], address

    yield start
    for node in nodes:
        kill(node)


def processes(node):
    """Return (pid, command) of the processes in a node's session; `-ww` prevents a cut at the terminal's width."""
    listed = subprocess.run(
        ["ps", "-ww", "-o", "pid=,args=", "-s", str(node.pid)], capture_output=True, text=True
    ).stdout
    return [line.split(maxsplit=1) for line in listed.splitlines()]


def has_raylet(node):
    return any("raylet/raylet" in words for _, words in processes(node))


def cores(address):
    count = f"import ray; ray.init({address!r}, log_to_driver=False); print(int(ray.cluster_resources()['CPU']))"
    done = subprocess.run([sys.executable, "-c", count], capture_output=True, text=True, timeout=60)
    return int(done.stdout or 0)


def kill(node):
    for pid, _ in processes(node):
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(pid), signal.SIGKILL)
    node.wait(60)


def listens(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def wait_for(condition, seconds=60):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.1)


def test_a_cluster_that_runs_already_gives_the_table_of_local_processes(write, tmp_path, start_node):
    write("cheap")
    _, address = start_node("head")
    for options in (["--out", "ray", "--engine", "ray", "--address", address], ["--out", "local"]):
        done = panel(tmp_path, *options)
        assert done.returncode == 1, done.stderr
        assert "200 trials, 2 errors" in done.stdout
    assert files(tmp_path / "ray") == files(tmp_path / "local")
    done = panel(tmp_path, "--out", "more", "--engine", "ray", "--address", address, "--workers", "3")
    assert done.returncode == 2
    assert "workers: expected at most 2, the cores of the cluster" in done.stderr


NODES = """
import os, time

def slow(trial):
    with open("log", "ab", buffering=0) as file:
        file.write(f"{os.environ.get('NODE', 'here')} {trial['level']} {trial['repeat']}\\n".encode())
    time.sleep(0.2)
    while os.environ.get("NODE") == "head" and "other" not in open("log").read():
        time.sleep(0.1)  # a node that starts late would find nothing left
    last = os.environ.get("NODE") == "other" and open("log").read().count("other") >= 10
    while last and not os.path.exists("stopped"):
        time.sleep(0.02)  # until the driver is stopped: nobody fetches this row
    row = {"cost": trial["level"] * 100 + trial["repeat"]}
    if last or trial["repeat"] % 2:  # too large for a reply: it stays in the memory of the node that made it
        row["text"] = "x" * 200_000
    return row
"""


def in_log(folder):
    path = folder / "log"
    return [line.split() for line in path.read_text().splitlines()] if path.exists() else []


def test_a_node_that_is_killed_takes_no_trial_with_it(tmp_path, start_node):
    """After one of two nodes is killed, every trial ends once, also on the killed node, and the table is the same."""
    (tmp_path / "trials.py").write_text(NODES)
    (tmp_path / "panel.toml").write_text('evaluate = "trials.py:slow"\nseeds = 30\n[axes]\nlevel = [1, 2, 3, 4]\n')
    (_, address), (other, _) = start_node("head"), start_node("other")
    words = ["panel", "panel.toml", "--out", "ray", "--engine", "ray", "--address", address]
    command = [sys.executable, "-m", "drake_diff.cli.main", *words]
    done = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    wait_for(lambda: sum(node == "other" for node, *_ in in_log(tmp_path)) >= 10 or done.poll() is not None, 180)
    done.send_signal(signal.SIGSTOP)  # so that the node ends trials whose rows are not fetched
    (tmp_path / "stopped").touch()
    time.sleep(3)
    kill(other)
    done.send_signal(signal.SIGCONT)
    output = done.communicate(timeout=240)[0].decode()
    assert done.returncode == 0, output
    log = in_log(tmp_path)
    started = [tuple(trial) for _, *trial in log]
    assert len(set(started)) == 120
    # Only trials that the killed node was evaluating, or whose rows it still stored, began again.
    again = {trial for trial in started if started.count(trial) > 1}
    assert again
    assert all(started.count(trial) == 2 for trial in again)
    assert again <= {tuple(trial) for node, *trial in log if node == "other"}
    assert len(list((tmp_path / "ray" / "trials").glob("*.json"))) == 120
    assert panel(tmp_path, "--out", "local", "--workers", "2").returncode == 0
    assert files(tmp_path / "ray") == files(tmp_path / "local")
    assert dd.verify(tmp_path / "ray").verdict == "intact"
