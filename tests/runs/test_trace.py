"""Check that trace.mcap round-trips a solution bit for bit, is readable by other tools, and is safe to read."""

import dataclasses
import importlib.util
import subprocess
import sys

import numpy as np
import pytest
from helpers.models import MODELS
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.reader import make_reader

import drake_diff as dd
from drake_diff._base.values import Refusal
from drake_diff.exceptions import ArtifactError
from drake_diff.logs import read_mcap
from drake_diff.optimize import Options
from drake_diff.optimize.program import Iteration
from drake_diff.optimize.solution import Solution
from drake_diff.runs import measure, read_trace
from drake_diff.runs.rebuild import plan_fields, read_plan, write_plan
from drake_diff.runs.trace import write_trace

pytestmark = pytest.mark.solve


def pendulum(folder=MODELS, name="pendulum.urdf", **options):
    model = dd.load_model(folder / name, time_step=0.02)
    return dd.Problem(
        model, x0=[0, 0], x_goal=[np.pi, 0], num_steps=20, running_cost=dd.QuadraticCost(R=[[1.0]]), **options
    )


def solution_of(problem, **fields):
    """Return a solution of `problem` that no solver found, with its own guess or the given `fields`."""
    found = {"xs": np.zeros((problem.num_steps + 1, problem.model.nx)), "us": problem.us, "message": "made by hand"}
    return Solution(problem, "shooting", "none", dd.Status.ITERATION_LIMIT, **(found | fields))


def bits(value):
    return None if value is None else (np.shape(value), np.asarray(value, dtype=float).tobytes())


@pytest.fixture(scope="module")
def collocated():
    """Return a collocated solution with a free horizon and midpoint inputs."""
    solution = dd.solve(pendulum(horizon=(0.5, 3.0)), method="collocation", options=Options(scheme="hermite_simpson"))
    assert solution.us_mid is not None
    assert solution.free_horizon is not None
    return solution


@pytest.fixture(scope="module")
def trace_of_collocated(collocated, tmp_path_factory):
    path = tmp_path_factory.mktemp("trace") / "trace.mcap"
    write_trace(path, measure(collocated), {})
    return path


@pytest.fixture(scope="module")
def thrown(tmp_path_factory):
    """Return a solution and trace of a ball that falls 0.05 m onto the ground."""
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.005)
    x0 = model.default_state
    x0[6] = 0.15
    problem = dd.Problem(model, x0=x0, num_steps=60, final_cost=lambda x: x[4] ** 2, optimize="initial_state")
    motion = dd.rollout(model, x0, num_steps=60)
    solution = solution_of(problem, xs=motion.xs)
    path = tmp_path_factory.mktemp("thrown") / "trace.mcap"
    write_trace(path, measure(solution), {})
    return solution, read_mcap(path)


def test_a_collocated_plan_comes_back_as_the_same_solution(collocated, tmp_path):
    write_plan(tmp_path / "plan.npz", collocated)
    plan = plan_fields(read_plan(tmp_path / "plan.npz"))
    for name in ("xs", "us", "us_mid", "u_final", "free_horizon"):
        assert bits(plan[name]) == bits(getattr(collocated, name)), name
    again = solution_of(collocated.problem, scheme=collocated.scheme, **plan)
    assert (again.cost, again.defect, again.integration_error) == (
        collocated.cost,
        collocated.defect,
        collocated.integration_error,
    )


def test_parameters_that_were_found_come_back_and_move_the_frames(tmp_path, load):
    """Hanging at q = 0, the lower link's frame is at the elbow's position."""
    problem = dd.Problem(
        load("double_pendulum.urdf"),
        x0=[0] * 4,
        num_steps=3,
        final_cost=lambda x: x[0],
        optimize="parameters",
        parameters=["elbow.offset"],
    )
    solution = solution_of(problem, parameters=np.array([0.1, 0.0, -0.9]))
    write_trace(tmp_path / "a.mcap", measure(solution), {})
    log = read_mcap(tmp_path / "a.mcap")
    assert bits(log.arrays("/planned/plan")["parameters"][0]) == bits(solution.parameters)
    assert log.channel_metadata["/planned/plan"]["names"]["parameters"] == [f"elbow.offset[{i}]" for i in range(3)]
    lower = log.messages["/tf"][0][1].transforms[1].translation
    assert [lower.x, lower.y, lower.z] == pytest.approx([0.1, 0.0, -0.9], abs=1e-12)


# Values after divergence, up to 1e6: overflowing squares give warnings of the replay instead of the log.
NUMBERS = st.floats(-10, 10) | st.sampled_from([np.nan, np.inf, -np.inf, -0.0, 5e-324, 1e6])


@pytest.mark.solve
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_any_plan_round_trips_whatever_its_numbers(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("trace") / "trace.mcap"
    count = data.draw(st.integers(1, 8))
    problem = dd.Problem(pendulum().model, x0=[0, 0], num_steps=count, final_cost=lambda x: x[0])
    number = data.draw(st.sampled_from([NUMBERS, st.floats(-10, 10)]))  # the second strategy can be stepped
    fields = {
        "xs": data.draw(arrays(float, (count + 1, 2), elements=number)),
        "us": data.draw(arrays(float, (count, 1), elements=number)),
        "message": data.draw(st.text(st.characters(codec="utf-8"))),
        "iterations": tuple(Iteration(k, *data.draw(st.tuples(*[st.floats()] * 4))) for k in range(count)),
    }
    solution = solution_of(problem, **fields)
    write_trace(path, measure(solution), {})
    trace, log = read_trace(path), read_mcap(path)
    assert bits(trace.planned_xs) == bits(solution.xs)
    assert bits(trace.planned_us) == bits(solution.us)
    assert bits(trace.times) == bits(solution.times)
    norms = solution.final_state_norms
    logged = log.arrays("/gradient/norm")["final_state"]
    assert len(logged) == 0 if isinstance(norms, Refusal) else bits(logged) == bits(norms)
    assert bits(log.arrays("/solver/iterations")["step"]) == bits([row.step for row in solution.iterations])
    assert log.arrays("/events")["message"][-1] == solution.message
    if solution.replay is None:
        assert (trace.xs.shape, trace.us.shape) == ((0, 2), (0, 1))
    else:
        assert bits(trace.xs) == bits(solution.replay.xs)
        for name in ("penetration", "work", "dissipation"):
            written = {"penetration": "max_penetration", "work": "work_actuators"}.get(name, name)
            assert bits(trace.diagnostics[written]) == bits(getattr(solution.replay, name))


def test_a_plan_whose_motion_differs_has_a_ghost_and_one_that_does_not_has_none(
    collocated, trace_of_collocated, tmp_path
):
    log = read_mcap(trace_of_collocated)
    frames = [t.child_frame_id for t in log.messages["/tf"][3][1].transforms]
    assert [name.startswith("planned/") for name in frames] == [False, True]
    assert frames[1] == "planned/" + frames[0]
    assert log.channel_metadata["/tf"]["ghost"] == "planned/"
    half_angle = collocated.xs[3, 0] / 2  # the pole rotates by q about +y; either sign is this rotation
    rotation = log.messages["/tf"][3][1].transforms[1].rotation
    assert abs(rotation.w * np.cos(half_angle) + rotation.y * np.sin(half_angle)) == pytest.approx(1, abs=1e-12)
    still = solution_of(pendulum())
    write_trace(tmp_path / "a.mcap", measure(dataclasses.replace(still, xs=still.replay.xs)), {})
    log = read_mcap(tmp_path / "a.mcap")
    assert {len(message.transforms) for _, message in log.messages["/tf"]} == {1}


def test_every_replay_has_its_row(collocated, trace_of_collocated):
    found = read_mcap(trace_of_collocated).arrays("/replays")
    replays = collocated.replays
    assert found["variant"] == [r.variant for r in replays]
    assert found["control"] == [r.control for r in replays]
    assert found["holds"].tolist() == [r.holds for r in replays]
    assert found["failures"] == [list(r.failures) for r in replays]
    assert bits(found["goal_error"]) == bits([r.goal_error for r in replays])
    assert bits(found["time_step"]) == bits([r.time_step for r in replays])


def test_contact_made_and_broken_are_events_at_the_steps_where_they_happen(thrown):
    """The ball's lowest point starts 0.05 m above the ground and falls for sqrt(2 * 0.05 / 9.81) = 0.101 s."""
    solution, log = thrown
    events = log.arrays("/events")
    made = events["kind"].index("contact_made")
    assert events["message"][made] == "ball touches ground"
    assert events["time"][made] == pytest.approx(0.101, abs=2 * 0.005)
    in_contact = [bool(c) for c in solution.replay.contacts]
    changes = [k for k in range(60) if in_contact[k] != (k > 0 and in_contact[k - 1])]
    contact = [kind.startswith("contact_") for kind in events["kind"]]
    assert events["time"][contact].tolist() == solution.times[changes].tolist()


def test_arrows_start_at_the_contact_and_point_along_the_force(thrown):
    """The arrow is drawn along +x. Rotated by its quaternion, it points along the force."""
    _, log = thrown
    found = log.arrays("/contacts")
    for k, (_, scene) in enumerate(log.messages["/scene/contacts"]):
        arrow, force = scene.entities[0].arrows[0], [found[f"f{axis}"][k][0] for axis in "xyz"]
        q = arrow.pose.orientation
        x_axis = [1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.w * q.z), 2 * (q.x * q.z - q.w * q.y)]
        size = float(np.linalg.norm(force))
        if size == 0:
            continue  # first contact with zero force: no direction
        assert np.allclose(x_axis, np.array(force) / size, rtol=0, atol=1e-9)
        assert arrow.shaft_length == pytest.approx(0.02 * size, rel=1e-12)
        assert scene.entities[0].lifetime.nanos == 5_000_000


def test_a_state_without_a_pose_has_no_frames_and_the_rest_is_there(tmp_path, load):
    model = load("sphere_on_ground.sdf")
    problem = dd.Problem(
        model, x0=model.default_state, num_steps=3, final_cost=lambda x: x[4], optimize="initial_state"
    )
    xs = np.tile(problem.model.default_state, (4, 1))
    xs[1, :4], xs[2, 5] = 0.0, np.nan
    write_trace(tmp_path / "a.mcap", measure(solution_of(problem, xs=xs)), {})
    log = read_mcap(tmp_path / "a.mcap")
    planned = [[t for t in m.transforms if t.child_frame_id.startswith("planned/")] for _, m in log.messages["/tf"]]
    assert [len(p) for p in planned] == [2, 0, 0, 2]  # ball and ground
    assert bits(read_trace(tmp_path / "a.mcap").planned_xs) == bits(xs)


def test_a_whole_log_that_is_no_trace_is_refused(tmp_path):
    from drake_diff.logs.mcap_file import write_mcap

    write_mcap(tmp_path / "a.mcap", [], {}, {})
    with pytest.raises(ArtifactError, match="no channel /diagnostics, /input"):
        read_trace(tmp_path / "a.mcap")


CHANNELS = {
    "/state": "drake_diff.State",
    "/input": "drake_diff.Input",
    "/joint_states": "foxglove.JointStates",
    "/planned/joint_states": "foxglove.JointStates",
    "/tf": "foxglove.FrameTransforms",
    "/diagnostics": "drake_diff.Diagnostics",
    "/contacts": "drake_diff.Contacts",
    "/scene/contacts": "foxglove.SceneUpdate",
    "/solver/iterations": "drake_diff.SolverIteration",
    "/gradient/check": "drake_diff.GradientCheck",
    "/gradient/norm": "drake_diff.GradientNorm",
    "/replays": "drake_diff.Replay",
    "/planned/state": "drake_diff.State",
    "/planned/input": "drake_diff.Input",
    "/planned/input_mid": "drake_diff.Input",
    "/planned/plan": "drake_diff.Plan",
    "/events": "drake_diff.Event",
}


def test_the_mcap_package_s_own_reader_finds_every_channel_in_protobuf_with_its_units(trace_of_collocated):
    with trace_of_collocated.open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    found = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
    assert found == CHANNELS
    for channel in summary.channels.values():
        assert channel.message_encoding == summary.schemas[channel.schema_id].encoding == "protobuf"
        assert "units" in channel.metadata
    assert all(chunk.compression == "zstd" for chunk in summary.chunk_indexes)


@pytest.mark.skipif(importlib.util.find_spec("rerun_cli") is None, reason="no rerun-sdk (700 MB: the extra `rerun`)")
def test_rerun_checks_the_trace_in_full_and_finds_every_channel(trace_of_collocated):
    def rerun(*words, path=trace_of_collocated):
        command = [sys.executable, "-m", "rerun_cli", "mcap", *words, str(path)]
        return subprocess.run(command, capture_output=True, text=True, timeout=60)

    done = rerun("check", "--full")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Failed" not in done.stdout + done.stderr
    listed = rerun("info").stdout.split()
    assert set(CHANNELS) <= set(listed)
    with trace_of_collocated.open("rb") as file:
        chunk = make_reader(file).get_summary().chunk_indexes[0]
    damaged = bytearray(trace_of_collocated.read_bytes())
    damaged[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
    trace_of_collocated.with_name("damaged.mcap").write_bytes(damaged)
    done = rerun("check", "--full", path=trace_of_collocated.with_name("damaged.mcap"))
    assert "Failed" in done.stdout + done.stderr or done.returncode  # Rerun 0.41 may exit with 0 anyway
