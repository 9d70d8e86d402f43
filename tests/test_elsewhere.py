"""A plan followed in other plants: closed forms for what it becomes there, and plans that must not hold."""

import math
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.models import ball_on_ground
from helpers.plants import pd_pendulum
from helpers.problems import lqr, pendulum
from helpers.table import each_row, slow_after
from typer.testing import CliRunner

import drake_diff as dd
import drake_diff.artifact.save as evidence
from drake_diff.artifact import elsewhere
from drake_diff.artifact.measurement import elsewhere_evidence
from drake_diff.artifact.other_plants import followed_in
from drake_diff.artifact.verify import verify_own
from drake_diff.cli.main import app
from drake_diff.engines.load import load_engine
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.optimize.elsewhere import Follower
from drake_diff.optimize.solution import Solution, Status
from drake_diff.record.solve import EvidenceRecord, FollowedEvidence

FREE = math.nan
G, MU, STIFF = 9.81, 0.4, 2e4


def given(model, x0, us, **fields):
    """The motion of the model's own steps, as a solution."""
    us = np.asarray(us, dtype=float)
    xs = dd.rollout(model, x0, us).xs
    asked = {"final_cost": lambda x: x[0], "optimize": ("controls",) if model.nu else "initial_state", **fields}
    problem = dd.Problem(model, x0=x0, num_steps=len(us), **asked)
    return Solution(problem, "given", "none", Status.CONVERGED, "given", xs, us)


def slide(tmp_path, speed=1.0, **fields):
    """It slides to rest within v^2 / (2 mu g) and v / (mu g), on a spring that its weight presses by m g / k."""
    model = ball_on_ground(tmp_path, time_step=0.01, stiffness=STIFF, relaxation_time=0.01, friction=MU)
    x0 = [0, 0.1 - G * 1.001 / (STIFF / 2), speed, 0]
    distance, count = speed**2 / (2 * MU * G), round(1.2 * speed / (MU * G) / 0.01)
    return given(model, x0, np.zeros((count, 0)), x_goal=[distance, FREE, 0, 0], **fields), distance


def by_plant(found):
    return [(row.plant, row.holds) for row in found.elsewhere.rows]


def test_a_block_under_a_constant_force_ends_where_the_sums_say(write_urdf):
    """x = u T (T + h) / 2 in steps of h, u T^2 / 2 in continuous time: 5 % of 1.05 are allowed, 10 % in MuJoCo."""
    h, count, u = 0.05, 20, 2.0
    fixed = dd.Bounds(u_lower=[u], u_upper=[u])  # feedback cannot help
    for goal, expected in ((1.05, [True, True, True, True, True]), (1.1, [True, False, False, False, True])):
        problem = {"x_goal": [goal, FREE], "bounds": fixed}
        found = elsewhere(given(write_urdf(time_step=h), [0, 0], np.full((count, 1), u), **problem))
        ends = [u * (1 + part) / 2 for part in (h, h / 2, h / 4, 0.0, 0.001)]
        assert [row.xs[-1, 0] for row in found.elsewhere.rows] == pytest.approx(ends, rel=1e-6)
        assert [row.goal_error for row in found.elsewhere.rows] == pytest.approx(
            [abs(goal - e) for e in ends], abs=1e-6
        )
        assert [row.holds for row in found.elsewhere.rows] == expected
        assert found.elsewhere.holds == all(expected)
    told = found.elsewhere.sentence
    assert told.startswith(
        "followed at its own rate of 0.05 s, it holds open loop in steps of 0.05 s; under TVLQR in mujoco "
    )
    assert "not in continuous time, TVLQR: slide_x ends 0.1 from its goal, tolerance 0.0525" in told
    assert f"elsewhere: {told}" in repr(found)
    assert "elsewhere" not in repr(given(write_urdf(time_step=h), [0, 0], np.full((count, 1), u)))


def test_its_own_gains_are_held_over_its_own_steps(write_urdf):
    """The law in finer steps is the plan's own, of the first state of each of its steps."""
    solution = dd.solve(lqr(0.1, 12, np.eye(2), 1.0, np.eye(2)), method="ilqr")
    follower = Follower(solution.plan)
    coarse, fine = follower._law("TVLQR", 1), follower._law("TVLQR", 4)
    random = np.random.default_rng(0)
    for k in range(12):
        x = random.normal(size=2)
        wanted = coarse(x, 0.1 * k)
        for j in range(4):
            assert fine(x if j == 0 else random.normal(size=2), 0.1 * k + 0.025 * j) == pytest.approx(wanted, abs=1e-12)


def test_a_smooth_plan_holds_everywhere():
    """A swing-up in steps of 0.02 s."""
    solution = dd.solve(
        pendulum(running_cost=dd.QuadraticCost(R=[[1.0]]), final_cost=None, x_goal=[np.pi, 0]), method="shooting"
    )
    assert solution.success
    found = elsewhere(solution)
    plants = ["steps", "steps", "steps", "continuous time", "mujoco"]
    assert by_plant(found) == [(plant, True) for plant in plants]
    assert found.elsewhere.holds
    assert found.success
    assert "it holds under TVLQR in steps of 0.02 s, 0.01 s, 0.005 s, in continuous time and in " in str(
        found.elsewhere
    )
    assert found.elsewhere["steps"][0].off < 1e-9  # its own steps again


def test_a_hopper_that_stands_does_so_everywhere(load):
    """The motor of its leg carries the body of 1 kg, and the hip of 1 g; the ground all of it."""
    model = load("hopper.sdf", time_step=0.01)
    carried, whole, spring = 1.001 * G, 1.201 * G, STIFF / 2
    x0 = [0, 0.5 + 0.05 - whole / spring, 0, 0.5, 0, 0, 0, 0]
    solution = given(model, x0, np.tile([0.0, carried], (50, 1)), x_goal=x0)
    assert np.abs(np.ptp(solution.xs, axis=0)).max() < 1e-3  # it stands
    found = elsewhere(solution).elsewhere
    assert found.holds, found
    assert [row.plant for row in found.rows] == ["steps"] * 3 + ["continuous time", "mujoco"]
    assert [row.penetration for row in found.rows] == pytest.approx([whole / spring] * 5, rel=0.02)


def test_a_slide_ends_where_friction_says_in_every_plant(tmp_path):
    """v^2 / (2 mu g) = 0.127 m: the steps are O(h) off, and MuJoCo's friction has the same number."""
    solution, distance = slide(tmp_path)
    found = elsewhere(solution).elsewhere
    assert [row.holds for row in found.rows] == [True] * 5, found
    assert [row.xs[-1, 0] for row in found.rows[1:]] == pytest.approx([distance] * 4, rel=0.05)


@each_row("quantity, speed, ends", [("friction", 1.0, 1 / 0.8), ("mass", 1.0, 1.0)])
def test_a_simulator_with_a_number_that_is_20_percent_off_is_told(tmp_path, quantity, speed, ends):
    """Friction of 0.8 mu lets it slide 1 / 0.8 times as far; its mass does not matter to where it stops."""
    solution, distance = slide(tmp_path, speed)
    follower, model = Follower(solution.plan), solution.problem.model
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
    row = followed_in(follower, load_engine("mujoco", model, path=path))
    assert not row.holds
    assert any(line.startswith(f"{quantity}: ") for line in row.unlike), row.unlike
    assert f"another plant: {quantity}" in str(row)
    assert row.xs[-1, 0] == pytest.approx(ends * distance, rel=0.05)
    assert bool(row.failures) == (ends != 1.0)


def test_a_plan_that_lives_by_its_coarse_step_is_told_where_it_does_not_hold(tmp_path):
    """A spring without loss throws a ball back to where it fell from; a step that is longer than the blow stops it."""
    h, fall = 0.02, 0.1
    model = ball_on_ground(tmp_path, time_step=h, stiffness=1e6, relaxation_time=0.0, friction=MU)
    count = round(2 * math.sqrt(2 * fall / G) / h)
    solution = given(model, [0, 0.1 + fall, 0, 0], np.zeros((count, 0)), x_goal=[FREE, 0.1, FREE, 0])
    found = elsewhere(solution).elsewhere
    assert found.rows[0].holds, found
    (row,) = found["continuous time"]
    assert not row.holds
    assert row.xs[-1, 1] == pytest.approx(0.1 + fall, abs=0.01)
    assert re.match(r"z_x ends 0\.(1|09)\d* from its goal", row.failures[0]), row.failures
    assert row.left_at is not None
    assert row.left_at >= math.sqrt(2 * fall / G) - h
    assert f"away from the plan from {row.left_at:.3g} s on" in found.sentence
    assert not found.holds


def test_where_nothing_is_asked_of_the_end_the_plans_own_end_is(tmp_path):
    """The same ball, and a cost alone: without it, a motion that ends anywhere would hold."""
    model = ball_on_ground(tmp_path, time_step=0.02, stiffness=1e6, relaxation_time=0.0, friction=MU)
    found = elsewhere(given(model, [0, 0.2, 0, 0], np.zeros((14, 0)))).elsewhere
    assert found.rows[0].holds
    (row,) = found["continuous time"]
    assert "from the plan's end, tolerance " in row.failures[0]


def test_without_a_motion_in_continuous_time_steps_of_a_tenth_of_a_millisecond_are_told_instead():
    solution = given(pd_pendulum(), [0.1, 0], np.zeros((20, 1)))
    found = elsewhere(solution).elsewhere
    (row,) = found["continuous time"]
    assert not row.measured  # a diagram allows no other step either
    assert "PD controllers have none" in row.failures[0]
    (row,) = found["mujoco"]
    assert not row.measured
    assert "has PD gains" in str(row)
    assert "not measured" in found.sentence
    assert [row.measured for row in found["steps"]] == [True, False, False]
    assert not found.holds


def test_a_plan_that_reaches_a_joint_limit_is_followed_in_short_steps_instead(tmp_path):
    """Pushed against the stop of its rail, of which there is no motion in continuous time."""
    path = tmp_path / "stop.urdf"
    path.write_text(STOP)
    model = dd.load_model(path, time_step=0.01)
    solution = given(model, [0, 0], np.full((100, 1), 2.0), x_goal=[0.5, 0])
    found = elsewhere(solution, engines=()).elsewhere
    (row,) = found["continuous time"]
    assert row.measured
    assert row.holds, found
    assert row.time_step == pytest.approx(1e-4)
    assert row.remark == "in place of continuous time: it reaches a joint limit, which has none"
    assert "in steps of 0.0001 s in place of continuous time: it reaches a joint limit" in found.sentence


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
        found = elsewhere(replace(solution, parameters=np.array([value]))).elsewhere
        assert found["mujoco"][0].measured == measured, found
    assert "the plan has others" in found["mujoco"][0].failures[0]


def test_a_simulator_that_is_not_installed_is_told(write_urdf, monkeypatch):
    solution = given(write_urdf(time_step=0.05), [0, 0], np.ones((4, 1)))
    no_mujoco(monkeypatch)
    found = elsewhere(solution).elsewhere
    assert not found["mujoco"][0].measured
    assert "in mujoco: not measured: it is not installed: this engine needs MuJoCo" in found.sentence
    assert not found.holds


def test_bad_input_is_refused(write_urdf):
    solution = given(write_urdf(time_step=0.05), [0, 0], np.ones((4, 1)))
    with pytest.raises(UnknownNameError, match="mujoco"):
        elsewhere(solution, engines=("mojuco",))
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    effort = dd.QuadraticCost(R=[[1.0]])
    plain = dd.solve(dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=4, horizon=1.0, running_cost=effort))
    for wrong in (plain, solution.plan):
        with pytest.raises(InputError, match="solution"):
            elsewhere(wrong)
    engine = load_engine("mujoco", solution.problem.model, time_step=0.03)
    with pytest.raises(InputError, match=r"a whole part of 0\.05"):
        followed_in(Follower(solution.plan), engine)


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    """A block that is pushed to 1 m in two steps a second holds in its own steps, and not where the sums are others."""
    path = tmp_path_factory.mktemp("elsewhere") / "stop.urdf"
    path.write_text(STOP.replace('upper="0.5"', 'upper="2"'))
    model = dd.load_model(path, time_step=0.05)
    effort = dd.QuadraticCost(R=[[1.0]])
    problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=effort)
    return elsewhere(dd.solve(problem, method="shooting"))


def test_a_record_has_it_and_verify_measures_it_again(pushed, tmp_path):
    record = dd.save(pushed, tmp_path / "run")
    found = pushed.elsewhere
    assert record.elsewhere.sentence == found.sentence
    assert [row.holds for row in record.elsewhere.rows] == [row.holds for row in found.rows]
    assert [row.goal_error for row in record.elsewhere.rows] == [row.goal_error for row in found.rows]
    assert [row.time_step_s for row in record.elsewhere.rows] == [0.05, 0.025, 0.0125, None, 0.001]
    page = (tmp_path / "run" / "report.html").read_text()
    assert "<h2>In other plants</h2>" in page
    assert found.sentence in page
    assert dd.verify(tmp_path / "run").require().verdict == "holds"


@pytest.mark.parametrize(
    ("change", "words"),
    slow_after(
        1,
        [
            (lambda part: part["rows"][3].update(goal_error=0.0), "elsewhere.rows[3].goal_error: recorded 0"),
            (
                lambda part: part.update(sentence="it holds everywhere"),
                "elsewhere.sentence: recorded it holds everywhere",
            ),
        ],
    ),
)
def test_a_record_that_lies_of_it_is_found(pushed, tmp_path, monkeypatch, change, words):
    honest = evidence.record_of

    def lying(measurement, folder):
        fields = honest(measurement, folder).model_dump()
        change(fields["elsewhere"])
        return EvidenceRecord.model_validate(fields)

    monkeypatch.setattr(evidence, "record_of", lying)
    dd.save(pushed, tmp_path / "run")
    monkeypatch.undo()
    found = dd.verify(tmp_path / "run")
    assert found.verdict == "broken"
    assert any(words in complaint for complaint in found.complaints), found.complaints


def test_a_row_that_holds_although_something_fails_is_no_record(pushed):
    row = elsewhere_evidence(pushed.elsewhere).rows[0].model_dump()
    assert row["holds"]
    for change in ({"failures": ["it fell"]}, {"unlike": ["mass: 1; 2"]}, {"measured": False}, {"holds": False}):
        with pytest.raises(ValueError, match="against what it says of it"):
            FollowedEvidence.model_validate({**row, **change})


@each_row("there, words", [(True, "mujoco is not installed here"), (False, "mujoco was not installed where")])
def test_what_a_simulator_said_that_is_not_installed_stands_unchecked(pushed, tmp_path, monkeypatch, there, words):
    with monkeypatch.context() as without:
        if not there:
            no_mujoco(without)
        dd.save(elsewhere(pushed), tmp_path / "run")
    with monkeypatch.context() as without:
        if there:
            no_mujoco(without)
        found = verify_own(tmp_path / "run")  # in this process, in which it is not installed
    assert found.verdict == "holds", found
    assert any(words in line for line in found.unchecked), found.unchecked


def no_mujoco(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for name in [name for name in sys.modules if name.startswith("drake_diff.engines.mujoco")]:
        monkeypatch.delitem(sys.modules, name)


def test_the_command_follows_a_plan_elsewhere_where_it_is_asked_to(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stop.urdf").write_text(STOP.replace('upper="0.5"', 'upper="2"'))
    (tmp_path / "push.py").write_text(SCRIPT)
    done = CliRunner().invoke(app, ["run", "push.py", "--elsewhere"])
    assert done.exit_code == 0, done.output
    assert "followed in continuous time, TVLQR: holds" in done.output
    assert dd.load_record("artifacts/push").elsewhere is not None
    (tmp_path / "plain.py").write_text(PLAIN)
    done = CliRunner().invoke(app, ["run", "plain.py", "--elsewhere"])
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
