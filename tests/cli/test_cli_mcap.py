"""`drake-diff mcap` and `drake-diff export`: what they print and their exit status."""

import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

import drake_diff as dd
from drake_diff.cli.main import app
from drake_diff.exceptions import InputError
from drake_diff.logs import read_mcap
from drake_diff.logs.channels import TYPES
from drake_diff.logs.mcap_file import Channel, write_mcap
from drake_diff.optimize.solution import Solution
from drake_diff.runs import measure
from drake_diff.runs.trace import write_trace

pytestmark = pytest.mark.solve

STATE = TYPES["State"]


@pytest.fixture
def file(tmp_path):
    rows = [(k * 10_000_000, STATE.cls(time=k / 100, q=[k], v=[0.0])) for k in range(3000)]
    channel = Channel("/state", STATE.cls, rows, {"units": {"q": {"[red]hinge": "rad"}}})
    attachments = {"../../etc/passwd": ("text/plain", b"x"), "a\x1b[2J": ("text/plain", b"yz")}
    write_mcap(tmp_path / "a.mcap", [channel], {"model": "<script>[bold]alert(1)[/]\x1b[2J"}, attachments)
    return tmp_path / "a.mcap"


def drake_diff(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


def test_info_lists_channels_units_metadata_and_attachments_as_plain_text(file):
    done = drake_diff("mcap", "info", file)
    assert done.exit_code == 0
    assert done.stdout.split("\n")[:2] == [
        "channel  schema            messages  from [s]  to [s]",
        "/state   drake_diff.State      3000         0   29.99",
    ]
    assert "units of /state: q ([red]hinge [rad])" in done.stdout
    assert "run.model = <script>[bold]alert(1)[/]\ufffd[2J" in done.stdout
    assert "attached ../../etc/passwd, 1 bytes" in done.stdout
    assert "\x1b" not in done.stdout


def test_check_exits_with_0_where_every_checksum_holds_and_with_1_where_one_does_not(file):
    done = drake_diff("mcap", "check", file)
    assert done.exit_code == 0
    assert "3000 messages in 1 channels, 2 attachments, every checksum holds" in done.stdout
    whole = file.read_bytes()
    for place in np.linspace(0, len(whole) - 1, 20).astype(int):
        damaged = bytearray(whole)
        damaged[place] ^= 4
        file.write_bytes(damaged)
        done = drake_diff("mcap", "check", file)
        assert (done.exit_code, "damaged" in done.stdout, "a.mcap" in done.stdout) == (1, True, True)


def test_recover_says_how_much_and_what_stopped_it(file):
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    done = drake_diff("mcap", "recover", file, file.with_name("b.mcap"))
    assert done.exit_code == 0
    log = read_mcap(file.with_name("b.mcap"))
    count = len(log.messages["/state"])
    assert 0 < count < 3000
    assert f"{count} messages and 2 attachments to" in done.stdout
    assert "stopped at" in done.stdout
    assert log.metadata["recovered"]["messages"] == str(count)
    assert drake_diff("mcap", "check", file.with_name("b.mcap")).exit_code == 0


def test_a_missing_file_is_a_usage_error_in_one_line(tmp_path):
    command = [sys.executable, "-m", "drake_diff.cli.main", "mcap", "info", "missing.mcap"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith("drake-diff: ArtifactError: missing.mcap")
    assert len(done.stderr.splitlines()) == 1


def test_export_writes_a_bag_beside_the_run_and_wants_to_be_told_the_format(tmp_path, load):
    pytest.importorskip("rosbags", reason="no rosbags (the extra `ros2`)")
    problem = dd.Problem(load("pendulum.urdf"), x0=[0, 0], num_steps=5, final_cost=lambda x: x[0])
    (tmp_path / "run").mkdir()
    xs = np.zeros((6, 2))
    write_trace(
        tmp_path / "run" / "trace.mcap",
        measure(Solution(problem, "shooting", "none", dd.Status.FAILED, "by hand", xs, problem.us)),
        {},
    )
    done = drake_diff("export", "--ros2", tmp_path / "run")
    assert done.exit_code == 0
    assert "/joint_states 6" in done.stdout
    assert sorted(p.name for p in (tmp_path / "run_ros2").iterdir()) == ["metadata.yaml", "run_ros2.mcap"]
    assert isinstance(drake_diff("export", tmp_path / "run").exception, InputError)
