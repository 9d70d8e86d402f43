"""Tests of `drake-diff mcap` and `drake-diff export`: their output and exit status."""

import numpy as np
import pytest
from typer.testing import CliRunner

import drake_diff as dd
from drake_diff.cli.main import app
from drake_diff.exceptions import InputError
from drake_diff.optimize.solution import Solution
from drake_diff.runs import measure
from drake_diff.runs.trace import write_trace

pytestmark = pytest.mark.solve


def drake_diff(*words):
    return CliRunner().invoke(app, [str(word) for word in words])


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
