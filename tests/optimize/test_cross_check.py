"""Tests of plans in other plants, against closed forms of the resulting motion, and plans that must fail."""

import math
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.models import ball_on_ground
from helpers.plants import pd_pendulum
from helpers.problems import pendulum
from helpers.table import each_row
from typer.testing import CliRunner

import drake_diff as dd
import drake_diff.runs.save as evidence
from drake_diff.cli.main import app
from drake_diff.engines.drake import DrakeEngine
from drake_diff.engines.load import load_engine
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.optimize import replay
from drake_diff.optimize.solution import Solution, Status
from drake_diff.runs import cross_check
from drake_diff.runs.cross_check import follower_of, replays_in
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.verify import verify_own

pytestmark = pytest.mark.solve

FREE = math.nan
G, MU, STIFF = 9.81, 0.4, 2e4
PLANTS = "continuous time", "mujoco"


def given(model, x0, us, **fields):
    """Return the motion of the model's own steps as a solution."""
    us = np.asarray(us, dtype=float)
    xs = dd.rollout(model, x0, us).xs
    asked = {"final_cost": lambda x: x[0], "optimize": ("controls",) if model.nu else "initial_state", **fields}
    problem = dd.Problem(model, x0=x0, num_steps=len(us), **asked)
    return Solution(problem, "given", "none", Status.CONVERGED, "given", xs, us)


def slide(tmp_path, speed=1.0, **fields):
    """Return a slide to rest over v^2 / (2 mu g) in v / (mu g), on a contact spring that is compressed by m g / k."""
    model = ball_on_ground(tmp_path, time_step=0.01, stiffness=STIFF, relaxation_time=0.01, friction=MU)
    x0 = [0, 0.1 - G * 1.001 / (STIFF / 2), speed, 0]
    distance, count = speed**2 / (2 * MU * G), round(1.2 * speed / (MU * G) / 0.01)
    return given(model, x0, np.zeros((count, 0)), x_goal=[distance, FREE, 0, 0], **fields), distance


def in_plant(found, plant):
    """Return the replays of a solution in `plant`."""
    rows = [row for row in found.cross_checks if row.variant.startswith(f"in {plant}")]
    assert rows
    return rows


def holds(found):
    """Return for every plant whether one of its replays holds."""
    return {plant: any(row.holds for row in in_plant(found, plant)) for plant in PLANTS}


def test_a_block_under_a_constant_force_ends_where_the_sums_say(write_urdf):
    """x = u T (T + h) / 2 for steps of h, u T^2 / 2 in continuous time. 3 % of 1.05 are allowed, 10 % in MuJoCo."""
    h, count, u = 0.05, 20, 2.0
    fixed = dd.Bounds(u_lower=[u], u_upper=[u])  # feedback has no effect
    for goal, expected in ((1.02, [True, True]), (1.1, [False, True])):
        problem = {"x_goal": [goal, FREE], "bounds": fixed}
        found = cross_check(given(write_urdf(time_step=h), [0, 0], np.full((count, 1), u), **problem))
        for plant, h_plant in zip(PLANTS, (0.0, h / 4 / 13), strict=True):
            for row in in_plant(found, plant):
                assert row.motion.xs[-1, 0] == pytest.approx(u * (1 + h_plant) / 2, rel=1e-6)
                assert row.goal_error == pytest.approx(abs(goal - u * (1 + h_plant) / 2), abs=1e-6)
        assert list(holds(found).values()) == expected
    (check,) = [c for c in in_plant(found, "continuous time")[0].checks if c.what == "goal"]
    assert (check.where, check.feedback, check.verdict) == ("slide_x", "TVLQR", "fail")
    assert (check.value, check.tolerance) == pytest.approx((0.1, 0.0315), rel=1e-6)
    assert check in found.checks
    assert "cross-checked in continuous time, TVLQR: slide_x ends 0.1 m from its goal" in repr(found)


def test_a_smooth_plan_holds_everywhere():
    """Check a swing-up in steps of 0.02 s."""
    solution = dd.solve(
        pendulum(running_cost=dd.QuadraticCost(R=[[1.0]]), final_cost=None, x_goal=[np.pi, 0]), method="shooting"
    )
    found = cross_check(solution)
    assert found.success
    assert holds(found) == dict.fromkeys(PLANTS, True)
    assert [row.control for row in found.cross_checks] == ["TVLQR", "TVLQR"]


def test_a_slide_ends_where_friction_says_in_every_plant(tmp_path):
    """The distance is v^2 / (2 mu g) = 0.127 m. Steps have an error of O(h), and MuJoCo has the same friction."""
    solution, distance = slide(tmp_path)
    found = cross_check(solution)
    assert holds(found) == dict.fromkeys(PLANTS, True), found.cross_checks
    assert [row.motion.xs[-1, 0] for row in found.cross_checks] == pytest.approx([distance] * 2, rel=0.05)


@each_row("quantity, speed, ends", [("friction", 1.0, 1 / 0.8), ("mass", 1.0, 1.0)])
def test_a_simulator_with_a_number_that_is_20_percent_off_is_told(tmp_path, quantity, speed, ends):
    """With a friction of 0.8 mu the ball slides 1 / 0.8 times as far. Its mass does not change where it stops."""
    solution, distance = slide(tmp_path, speed)
    follower, model = follower_of(solution.plan), solution.problem.model
    path = tmp_path / "other.xml"
    text = load_engine("mujoco", model, time_step=0.001).mjcf
    change = {
        "friction": (r'(friction=")(\S+) (\S+)', MU),
        "mass": (r'(name="ball" .*\n *<inertial mass=")(1)\.0', 1.0),
    }
    pattern, value = change[quantity]
    text, changed = re.subn(pattern, rf"\g<1>{0.8 * value}" + " 0.32" * (quantity == "friction"), text)
    assert changed == 1
    path.write_text(text)
    row = replays_in(follower, load_engine("mujoco", model, path=path))[0]
    assert not row.holds
    unlike = [c for c in row.checks if c.what == "model"]
    assert any(c.where.startswith(f"{quantity}: ") for c in unlike), unlike
    assert row.motion.xs[-1, 0] == pytest.approx(ends * distance, rel=0.05)
    assert any(not c.passes for c in row.checks if c.what == "goal") == (ends != 1.0)


def test_a_plan_that_lives_by_its_coarse_step_is_told_where_it_does_not_hold(tmp_path):
    """An elastic contact returns a ball to its initial height. A time step longer than the impact stops the ball."""
    h, fall = 0.02, 0.1
    model = ball_on_ground(tmp_path, time_step=h, stiffness=1e6, relaxation_time=0.0, friction=MU)
    count = round(2 * math.sqrt(2 * fall / G) / h)
    solution = given(model, [0, 0.1 + fall, 0, 0], np.zeros((count, 0)), x_goal=[FREE, 0.1, FREE, 0])
    (row,) = in_plant(cross_check(solution), "continuous time")
    assert row.motion.xs[-1, 1] == pytest.approx(0.1 + fall, abs=0.01)
    (check,) = [c for c in row.checks if not c.passes]
    assert (check.what, check.where) == ("goal", "z_x")
    assert check.value == pytest.approx(0.1, abs=0.01)


def test_without_a_motion_in_continuous_time_steps_of_a_tenth_of_a_millisecond_are_told_instead():
    solution = given(pd_pendulum(), [0.1, 0], np.zeros((20, 1)))
    found = cross_check(solution)
    for plant, why in (
        ("continuous time", "PD controllers are not supported in continuous time"),
        ("mujoco", "has PD gains"),
    ):
        rows = in_plant(found, plant)
        assert all(row.motion is None for row in rows)  # a diagram has no other time step either
        assert {c.verdict for row in rows for c in row.checks} == {"undecided"}
        assert why in str(rows[0])


def test_a_plan_that_reaches_a_joint_limit_is_followed_in_short_steps_instead(tmp_path):
    """The block is pushed against the stop of its rail, which continuous time does not support."""
    path = tmp_path / "stop.urdf"
    path.write_text(STOP)
    model = dd.load_model(path, time_step=0.01)
    solution = given(model, [0, 0], np.full((100, 1), 2.0), x_goal=[0.5, 0])
    row = cross_check(solution, engines=()).cross_checks[-1]
    assert row.holds, row
    assert row.time_step == pytest.approx(0.01 / 64)
    why = "it reaches a joint limit, which is not supported in continuous time"
    assert row.variant == f"in steps of 0.0001563 s in place of continuous time: {why}"


def test_where_only_offsets_keep_off_a_joint_limit_all_are_followed_in_short_steps(tmp_path, monkeypatch):
    """Without offsets the motion reaches the limit, so that all controllers are replayed in the same plant."""
    path = tmp_path / "stop.urdf"
    path.write_text(STOP)
    model = dd.load_model(path, time_step=0.01)
    solution = given(model, [0, 0], np.full((50, 1), 0.1), x_goal=[0.0125, 0.05])
    follower = solution.plan.follower_in_continuous_time
    taken = replay.PlanFollower.replay

    def stopped(self, plant, control):
        row = taken(self, plant, control)
        refused = plant.variant == replay.IN_CONTINUOUS_TIME and control != replay.FEEDBACK
        return replay.missing_replay(self.plan, plant.variant, control, "a joint limit", 0.0) if refused else row

    monkeypatch.setattr(replay.PlanFollower, "replay", stopped)
    rows = follower.in_continuous_time()
    assert {row.variant for row in rows} == {"in steps of 0.0001563 s in place of continuous time: a joint limit"}
    assert all(row.holds for row in rows)


STOP = """<robot name="stop"><link name="world"/><link name="block"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="rail" type="prismatic"><parent link="world"/><child link="block"/><axis xyz="1 0 0"/>
<limit effort="100" lower="-1" upper="0.5" velocity="100"/></joint>
<transmission name="t"><type>transmission_interface/SimpleTransmission</type><joint name="rail"/>
<actuator name="motor"/></transmission></robot>"""


def test_a_plan_with_other_parameters_is_not_given_to_another_simulator(load):
    model = load("pendulum.urdf", time_step=0.02)
    solution = given(model, [0.1, 0], np.zeros((5, 1)), parameters=("pole.mass",))
    for value, measured in ((float(solution.problem.parameters.values[0]), True), (1.5, False)):
        row, *_ = in_plant(cross_check(replace(solution, parameters=np.array([value]))), "mujoco")
        assert (row.motion is not None) == measured, row
    assert "the plan has others" in str(row)


def test_a_simulator_that_is_not_installed_is_undecided(write_urdf, monkeypatch):
    solution = given(write_urdf(time_step=0.05), [0, 0], np.ones((4, 1)))
    no_mujoco(monkeypatch)
    (row,) = in_plant(cross_check(solution), "mujoco")
    assert not row.holds
    assert "it is not installed: this engine needs MuJoCo" in str(row)


def test_another_simulator_of_the_same_name_is_simulated_again(load):
    """The second one ends every step at the upright, so that the plan does not hold there."""
    model = load("pendulum.urdf", time_step=0.02)
    plan = dd.solve(
        dd.Problem(model, x0=[0, 0], x_goal=[0.1, 0], num_steps=20, running_cost=lambda x, u: u[0] ** 2)
    ).plan
    follower = follower_of(plan)
    model = model.at_time_step(follower.period)

    class Stuck(DrakeEngine):
        def step(self, x, u):
            return np.array([np.pi, 0.0])

    assert any(row.holds for row in replays_in(follower, DrakeEngine(model)))
    assert not any(row.holds for row in replays_in(follower, Stuck(model)))


def test_bad_input_is_refused(write_urdf):
    solution = given(write_urdf(time_step=0.05), [0, 0], np.ones((4, 1)))
    with pytest.raises(UnknownNameError, match="mujoco"):
        cross_check(solution, engines=("mojuco",))
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    effort = dd.QuadraticCost(R=[[1.0]])
    plain = dd.solve(dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=4, horizon=1.0, running_cost=effort))
    for wrong in (plain, solution.plan):
        with pytest.raises(InputError, match="solution"):
            cross_check(wrong)
    engine = load_engine("mujoco", solution.problem.model, time_step=0.03)
    with pytest.raises(InputError, match=r"0\.0125 divided by a whole number"):
        replays_in(follower_of(solution.plan), engine)


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    """Return a block pushed to 1 m with steps of 0.05 s. The plan holds with its own steps, but not in other plants."""
    path = tmp_path_factory.mktemp("plants") / "stop.urdf"
    path.write_text(STOP.replace('upper="0.5"', 'upper="2"'))
    model = dd.load_model(path, time_step=0.05)
    effort = dd.QuadraticCost(R=[[1.0]])
    problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=effort)
    return cross_check(dd.solve(problem, method="shooting"))


def test_a_record_has_it_and_verify_measures_it_again(pushed, tmp_path):
    record = dd.save(pushed, tmp_path / "run")
    rows = record.replays[-len(pushed.cross_checks) :]
    assert [row.variant for row in rows] == [row.variant for row in pushed.cross_checks]
    assert [row.goal_error for row in rows] == [row.goal_error for row in pushed.cross_checks]
    assert dd.verify(tmp_path / "run").require().verdict == "holds"


@pytest.mark.slow
def test_a_record_that_lies_of_it_is_found(pushed, tmp_path, monkeypatch):
    honest = evidence.record_of

    def lying(measurement, folder):
        fields = honest(measurement, folder).model_dump()
        fields["replays"][-1].update(goal_error=0.0)
        return PlanRecord.model_validate(fields)

    monkeypatch.setattr(evidence, "record_of", lying)
    dd.save(pushed, tmp_path / "run")
    monkeypatch.undo()
    found = dd.verify(tmp_path / "run")
    assert found.verdict == "broken"
    assert any("goal_error: recorded 0" in complaint for complaint in found.complaints), found.complaints


@pytest.mark.slow
@each_row(
    "there, words", [(True, "mujoco, which is not installed on this"), (False, "mujoco, which was not installed where")]
)
def test_what_a_simulator_said_that_is_not_installed_stands_unchecked(pushed, tmp_path, monkeypatch, there, words):
    with monkeypatch.context() as without:
        if not there:
            no_mujoco(without)
        dd.save(cross_check(pushed), tmp_path / "run")
    with monkeypatch.context() as without:
        if there:
            no_mujoco(without)
        found = verify_own(tmp_path / "run")  # in this process, in which MuJoCo may be missing
    assert found.verdict == "holds", found
    assert any(words in line for line in found.unchecked), found.unchecked


def no_mujoco(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for name in [name for name in sys.modules if name.startswith("drake_diff.engines.mujoco")]:
        monkeypatch.delitem(sys.modules, name)


def test_the_command_replays_a_plan_in_other_plants_where_it_is_asked_to(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stop.urdf").write_text(STOP.replace('upper="0.5"', 'upper="2"'))
    (tmp_path / "push.py").write_text(SCRIPT)
    done = CliRunner().invoke(app, ["run", "push.py", "--cross-check"])
    assert done.exit_code == 0, done.output
    assert "replayed in continuous time, TVLQR: goal error" in done.output
    assert any(row.variant.startswith("in mujoco") for row in dd.load_record("artifacts/push").replays)
    (tmp_path / "plain.py").write_text(PLAIN)
    done = CliRunner().invoke(app, ["run", "plain.py", "--cross-check"])
    assert done.exit_code != 0
    assert not (tmp_path / "artifacts" / "plain").exists()


SCRIPT = """
import drake_diff as dd

def problem():
    model = dd.load_model("stop.urdf", time_step=0.02)
    return dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=50, running_cost=dd.QuadraticCost(R=[[1.0]]))

solve_options = {"method": "shooting"}
"""
PLAIN = """
import drake_diff as dd

def problem():
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    effort = dd.QuadraticCost(R=[[1.0]])
    return dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=10, horizon=1.0, running_cost=effort)
"""
