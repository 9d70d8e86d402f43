"""Tests of task-space goals: their checks, their values and derivatives, and motions that satisfy them."""

import shutil

import numpy as np
import pytest
from helpers.models import MODELS, robot_file
from helpers.robots import example_robot, state_in_range
from helpers.solving import solve_with
from helpers.table import each_row, slow_after
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import (
    BallRpyJoint,
    BodyIndex,
    FixedOffsetFrame,
    PlanarJoint,
    PrismaticJoint,
    RevoluteJoint,
    RpyFloatingJoint,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

import drake_diff as dd
from drake_diff.exceptions import InputError, ShapeError, UnknownNameError
from drake_diff.optimize.knots import Traced, trace
from drake_diff.optimize.problem.goals import AIMED
from drake_diff.runs.reproduce import odd_metrics

pytestmark = pytest.mark.solve

UPPER, LOWER = 0.8, 0.5  # [m] of double_pendulum.urdf
EFFORT = dd.QuadraticCost(R=np.eye(2))


@pytest.fixture(scope="module")
def arm():
    return dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.05, gravity=[0, 0, 0])


@pytest.fixture(scope="module")
def pendulum():
    return dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)


def tip(**changes):
    return dd.FrameGoal(**({"frame": "lower", "point": [0, 0, -LOWER], "position": [-0.6, None, -0.7]} | changes))


def reach(model, **changes):
    """Return the problem of moving from a bent posture to the target of `tip`, at rest."""
    start, stop = {"shoulder": 0.3, "elbow": 0.4}, {"shoulder_w": 0, "elbow_w": 0}
    given = {"x0": start, "x_goal": stop, "num_steps": 20, "goals": tip(), "running_cost": EFFORT}
    return dd.Problem(model, **given | changes)


KINDS = {
    "frame": (dd.FrameGoal, {"frame": "tip", "position": [0, 0, 1]}),
    "velocity": (dd.FrameVelocityGoal, {"frame": "tip"}),
    "joint": (dd.JointGoal, {"values": {"a": 1}}),
    "mass": (dd.CenterOfMassGoal, {"position": [0, 0, 1]}),
    "level": (dd.KeepLevel, {"frame": "tip"}),
}


@each_row(
    "kind, given, error, words",
    [
        ("frame", {"position": None}, InputError, "no position and no rotation"),
        ("frame", {"position": [None, None, np.nan]}, InputError, "no position"),
        ("frame", {"position": [0.0, 1.0]}, ShapeError, "position"),
        ("frame", {"position": [0.0, 1.0, np.inf]}, InputError, "finite"),
        ("frame", {"position": 3.0}, ShapeError, "position"),
        ("frame", {"frame": 3}, InputError, "a name"),
        ("frame", {"tolerance": 0.0}, InputError, "above 0"),
        ("frame", {"knots": 0.5}, InputError, "whole numbers"),
        ("frame", {"knots": 3, "weight": 1.0}, InputError, "-1 for the last knot, or None"),
        ("frame", {"weight": -1.0}, InputError, "above 0"),
        ("frame", {"rotation": [0, 0, 0, 0.5]}, InputError, "norm"),
        ("frame", {"rotation": np.eye(2)}, ShapeError, "rotation"),
        ("velocity", {"velocity": [None, None, None]}, InputError, "a velocity"),
        ("velocity", {"angular_velocity": [0, 0]}, ShapeError, "angular_velocity"),
        ("joint", {"values": {}}, InputError, "a value for each name"),
        ("joint", {"values": {"a": np.nan}}, InputError, "JointGoal a"),
        ("mass", {"position": [None] * 3}, InputError, "at least one number"),
        ("level", {"axis": [0, 0, 0]}, InputError, "a direction"),
        ("level", {"tolerance": -1}, InputError, "above 0"),
    ],
)
def test_goals_refuse(kind, given, error, words):
    goal, good = KINDS[kind]
    goal(**good)
    with pytest.raises(error, match=words):
        goal(**good | given)


@each_row(
    "goal, words",
    [
        (dd.FrameGoal("hand", [0.1, 0, 0]), "lower.*upper.*world"),
        (dd.FrameVelocityGoal("hand"), "lower.*upper"),
        (dd.KeepLevel("hand"), "lower.*upper"),
        (dd.JointGoal({"wrist": 1.0}), "elbow, elbow_q, elbow_w, shoulder"),
    ],
)
def test_an_unknown_name_lists_those_that_exist(arm, goal, words):
    with pytest.raises(UnknownNameError, match=words):
        reach(arm, goals=goal)


@each_row(
    "goals, words",
    [
        (dd.Constraint(lambda x: x[0], upper=1), "a goal such as FrameGoal"),
        (dd.FrameGoal("lower", [0.1, 0.2, -0.5]), "entry 1, which is 0 in every"),  # the arm swings in x and z
        (dd.FrameGoal("lower", [0.1, 0, -0.5], knots=21), "from -21 to 20"),
        (dd.KeepLevel("upper", tolerance=0.2), "upper level is 0.3 rad off"),  # x0 leans by 0.3 rad
        (dd.JointGoal({"elbow": 1.0, "elbow_q": 1.0}), "both are the same coordinate"),
    ],
)
def test_a_problem_refuses_goals_that_its_model_cannot_have(arm, goals, words):
    with pytest.raises(InputError, match=words):
        reach(arm, goals=goals)


def test_plain_dynamics_have_no_goals():
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    with pytest.raises(InputError, match="no goals with plain dynamics"):
        dd.Problem(block, x0=[0, 0], num_steps=4, horizon=1.0, goals=dd.JointGoal({"x0": 1.0}))


def test_goals_are_made_again_from_their_values():
    for goal in (
        dd.FrameGoal("hand", [0.1, None, 0.3], [0.0, 1.0, 0.0, 0.0], tolerance=0.02, knots=[3, -1]),
        dd.FrameVelocityGoal("hand", None, angular_velocity=[None, 0, 1]),
        dd.JointGoal({"elbow": 1, "wrist": 0.5}, weight=2.0),
        dd.CenterOfMassGoal([0, None, 1], knots=None),
        dd.KeepLevel("tray", axis=[1, 0, 0]),
    ):
        ((kind, values),) = goal.to_dict().items()
        assert getattr(dd, kind)(**values) == goal
    assert dd.FrameGoal("hand", rotation=[0, 1, 0, 0]).rotation == ((1, 0, 0), (0, -1, 0), (0, 0, -1))


@each_row(
    "method, options",
    [
        ("collocation", {"scheme": "hermite_simpson"}),
        ("collocation", {"scheme": "trapezoid"}),
        ("collocation", {"scheme": "drake"}),
        ("shooting", {}),
        ("ilqr", {}),
    ],
)
def test_a_two_link_arm_ends_at_the_angles_of_the_law_of_cosines(arm, method, options):
    solution = solve_with(reach(arm), method=method, progress=False, **options)
    x, z = -0.6, -0.7
    bend = np.arccos((x**2 + z**2 - UPPER**2 - LOWER**2) / (2 * UPPER * LOWER))
    found = []
    for elbow in (bend, -bend):  # a hinge about +y turns a hanging link towards -x
        inner = np.arctan2(LOWER * np.sin(elbow), UPPER + LOWER * np.cos(elbow))
        found.append([np.arctan2(-x, -z) - inner, elbow])
    off = min(np.max(np.abs(solution.xs[-1][:2] - angles)) for angles in found)
    # The plan may be off by a tenth of 5 mm. An angle changes by at most 1 / (0.5 sin bend) rad per metre.
    assert off < AIMED * 5e-3 / (LOWER * np.sin(bend))
    assert solution.constraint_violation < 1e-5


def test_checks_say_in_metres_how_far_the_hand_ends(arm):
    solution = dd.solve(reach(arm), progress=False)
    assert solution.success
    ends = [c for c in solution.checks if (c.what, c.where) == ("goal", "lower position")]
    assert {r.variant for r in solution.replays} == {c.plant for c in ends}
    where = dd.quantities.frame_position(arm, "lower", [0, 0, -LOWER])
    for c in ends:
        (replay,) = [r for r in solution.replays if (r.variant, r.control) == (c.plant, c.feedback or "open loop")]
        off = (where(replay.motion.xs[-1]) - np.array([-0.6, 0, -0.7]))[[0, 2]]
        assert (c.value, c.tolerance, c.unit) == (pytest.approx(np.linalg.norm(off), rel=1e-9), 0.005, "m")


@pytest.mark.slow
def test_a_goal_out_of_reach_is_named(arm):
    far = dd.solve(reach(arm, goals=tip(position=[-2.0, None, 0.0])), method="collocation", progress=False)
    assert not far.success
    assert "a goal within reach (lower position is " in repr(far)


def test_a_weight_makes_a_goal_a_cost(arm):
    """Check that the plan is equal to the plan for the same cost as a function."""
    where = dd.quantities.frame_position(arm, "lower", [0, 0, -LOWER])

    def written_out(x):
        off = where(x) - np.array([-0.6, 0, -0.7])
        return 30.0 * (off[0] ** 2 + off[2] ** 2)

    soft = reach(arm, goals=tip(weight=30.0))
    own = reach(arm, goals=(), final_cost=written_out)
    assert soft.kept_goals == ()
    found, wanted = (dd.solve(p, method="collocation", progress=False) for p in (soft, own))
    assert found.options["derivatives"] == wanted.options["derivatives"] == "symbolic, exact Hessian"
    assert found.cost == pytest.approx(wanted.cost, rel=1e-8)
    np.testing.assert_allclose(found.xs, wanted.xs, atol=1e-6)  # two runs of IPOPT to 1e-8


def test_a_cost_of_goals_at_many_states_is_the_sum_of_its_values():
    lift = dd.model.BodyForce("lift", "body")
    model = dd.load_model(MODELS / "quadrotor.urdf", time_step=0.02, body_forces=[lift])
    goals = [
        dd.FrameGoal("body", position=[1, None, 2], rotation=[0.6, 0, 0.8, 0], weight=3.0, knots=None),
        dd.JointGoal({model.state_names[8]: 0.5}, weight=2.0, knots=None),
    ]
    cost = dd.QuadraticCost(Q=np.eye(model.nx))
    problem = dd.Problem(model, x0=model.default_state, num_steps=5, goals=goals, running_cost=cost)
    xs, running = np.random.default_rng(1).standard_normal((6, model.nx)), problem.total_running_cost
    us = np.zeros((5, 1))
    assert running.takes_rows
    relative = Rotation.from_quat(xs[:5, [1, 2, 3, 0]]) * Rotation.from_quat([0, 0.8, 0, 0.6]).inv()
    turned = 2 * np.sin(relative.magnitude() / 2)
    off = (xs[:5, 4] - 1) ** 2 + (xs[:5, 6] - 2) ** 2 + turned**2
    wanted = np.sum(xs[:5] ** 2) + 3 * np.sum(off) + 2 * np.sum((xs[:5, 8] - 0.5) ** 2)
    assert problem.objective(xs, us) == pytest.approx(0.02 * wanted, rel=1e-12)
    assert running(xs[0], us[0]) == pytest.approx(running(xs, us)[0], rel=1e-12)


def test_a_level_link_stays_level_and_a_free_one_does_not(arm):
    """The cost pulls the upper link to 1 rad."""
    pulled = dd.QuadraticCost(Q=np.diag([20.0, 0, 1, 1]), R=np.eye(2), x_ref=[1.0, 0, 0, 0])
    tilt = dd.quantities.frame_tilt(arm, "upper")
    free, level = (
        dd.solve(reach(arm, goals=goals, running_cost=pulled), method="collocation", progress=False)
        for goals in ([], dd.KeepLevel("upper", tolerance=0.4))
    )
    largest = [max(np.linalg.norm(tilt(x)) for x in s.xs) for s in (free, level)]
    assert largest[0] > 0.6
    assert 0.2 < largest[1] <= 0.4
    assert level.success
    assert any(c.where == "upper level" and c.passes for c in level.checks)


@each_row(
    "given, words",
    [
        ({"x0": {"knee": 1.0}}, "x0: expected one of elbow, elbow_q"),
        ({"x_goal": {"knee": 1.0}}, "x_goal: expected one of elbow"),
        ({"bounds": {"knee": (0, 1)}}, "one of elbow, elbow_motor"),
        ({"bounds": {"elbow": 1.0}}, "lower, upper"),
        ({"waypoints": {3: {"knee": 1.0}}}, "one of elbow"),
        ({"x0": {"elbow": 3.0}, "bounds": {"elbow": (-1, 1)}}, "x0, elbow_q"),
    ],
)
def test_names_that_do_not_fit_are_refused(arm, given, words):
    with pytest.raises(InputError, match=words):
        reach(arm, **given)


def test_states_and_bounds_by_name_are_those_by_place(arm):
    named = reach(
        arm,
        x0={"elbow": 0.4},
        x_goal={"elbow_q": 1.0},
        bounds={"elbow": (-1, None), "shoulder_w": (None, 2.0), "elbow_motor": (-3, 3)},
        waypoints={5: {"shoulder": 0.1}},
    )
    np.testing.assert_array_equal(named.x0, [0, 0.4, 0, 0])
    np.testing.assert_array_equal(named.x_goal, [np.nan, 1.0, np.nan, np.nan])
    np.testing.assert_array_equal(named.waypoints[5], [0.1, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(named.bounds.x_lower, [-np.inf, -1, -np.inf, -np.inf])
    np.testing.assert_array_equal(named.bounds.x_upper, [np.inf, np.inf, 2, np.inf])
    assert (named.bounds.u_lower[1], named.bounds.u_upper[1]) == (-3, 3)


def quantities_of(model, random):
    """Return one quantity of each kind, for the last body in the tree."""
    body = model.plant.get_body(BodyIndex(model.plant.num_bodies() - 1)).name()
    R = RollPitchYaw(random.uniform(-1, 1, 3)).ToRotationMatrix().matrix()
    q, point = dd.quantities, random.standard_normal(3)
    found = [q.frame_position(model, body, point), q.frame_rotation_error(model, body, R)]
    found += [q.frame_velocity(model, body, point), q.frame_angular_velocity(model, body)]
    found += [q.frame_tilt(model, body, point), q.center_of_mass(model)]
    base = model.plant.get_body(BodyIndex(2)).name()
    return [*found, q.frame_position(model, body, point, base), q.frame_rotation_error(model, body, R, base)]


def check_symbols(model, states, random):
    """Check that traced functions have the values and Jacobians of AutoDiffXd, and check these by differences."""
    knots = np.hstack([states, np.zeros((len(states), model.nu))])
    for f in quantities_of(model, random):
        wanted = np.array([f(x) for x in states])
        function = Traced(trace(lambda x, u, f=f: f(x), model.nx, knots, wanted))  # raises unless values agree to 1e-10
        constraint = dd.Constraint(f, lower=0.0)
        for x, knot in zip(states, knots, strict=True):
            jacobian = constraint.differentiate(x, knot[model.nx :])[1]
            largest = max(1.0, np.max(np.abs(jacobian)))
            np.testing.assert_allclose(
                function.linearize(knot[None])[1][0], jacobian, rtol=0, atol=1e-12 * largest
            )  # rounding
            way = random.standard_normal(model.nx)
            slope = (f(x + 1e-6 * way) - f(x - 1e-6 * way)) / 2e-6
            # Central differences of 1e-6 leave 1e-16 / 1e-6 of rounding and 1e-12 of curvature.
            np.testing.assert_allclose(jacobian[:, : model.nx] @ way, slope, rtol=0, atol=1e-8 * largest)


@pytest.mark.parametrize("name", ["ur5_robot.urdf", "solo12.urdf"])
def test_goals_have_the_same_derivatives_by_symbols_and_by_autodiff(name):
    """Test a fixed and a floating base, whose quaternion has a norm other than 1 in one of the states."""
    model, random = example_robot(name), np.random.default_rng(0)
    states = np.array([state_in_range(model, random) for _ in range(3)])
    if name == "solo12.urdf":
        states[2, :4] *= 1.1
    check_symbols(model, states, random)


def test_joints_of_every_kind_are_placed_as_drake_does():
    """Test a chain of all kinds of joints with rotated frames. The last joint is traversed from its child."""
    builder, random = DiagramBuilder(), np.random.default_rng(3)
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01, use_sampled_output_ports=False), builder)
    weight = SpatialInertia(1.0, [0.1, 0.2, 0.3], UnitInertia.SolidSphere(1.0))
    before = plant.world_body()

    def pose():
        return RigidTransform(RollPitchYaw(random.uniform(-1, 1, 3)), random.uniform(-1, 1, 3))

    for i, kind in enumerate((RpyFloatingJoint, PlanarJoint, BallRpyJoint, PrismaticJoint, RevoluteJoint)):
        body = plant.AddRigidBody(f"body_{i}", weight)
        pair = (body, pose(), before, pose()) if i == 4 else (before, pose(), body, pose())
        axis = [random.uniform(-1, 1, 3)] if kind in (PrismaticJoint, RevoluteJoint) else []
        arguments = {"damping": np.zeros(3)} if kind is PlanarJoint else {}
        plant.AddJoint(kind(f"joint_{i}", *_frames(plant, f"joint_{i}", *pair), *axis, **arguments))
        before = body
    plant.Finalize()
    model = dd.model_from_diagram(builder.Build())
    check_symbols(model, random.uniform(-1, 1, (3, model.nx)), random)


def _frames(plant, name, parent, on_parent, child, on_child):
    pairs = ((f"{name}_parent", parent, on_parent), (f"{name}_child", child, on_child))
    return [plant.AddFrame(FixedOffsetFrame(n, body.body_frame(), pose)) for n, body, pose in pairs]


def test_half_a_turn_away_is_no_gap_in_the_derivatives(pendulum):
    """From hanging to upright is half a turn, at which a rotation's axis may have either sign."""
    f = dd.quantities.frame_rotation_error(pendulum, "pole", np.diag([-1.0, 1.0, -1.0]))
    probe = np.array([[0.3, 0, 0.0], [1.0, 0, 0], [2.0, 0, 0]])
    function = Traced(trace(lambda x, u: f(x), 2, probe, np.array([f(k[:2]) for k in probe])))
    at = np.zeros(3)
    assert np.all(np.isfinite(function.linearize(at[None])[1][0]))
    np.testing.assert_allclose(np.linalg.norm(f(at[:2])), 2.0, rtol=1e-12)


@pytest.mark.slow
def test_a_satellite_turns_by_every_method_whatever_the_sign_of_its_goal(tmp_path):
    """The least cost of two forces that turn by 90 degrees is 24 I^2 angle^2 / T^3, and nearly so with steps of T / 20.

    The discrete step lets a quaternion's norm grow by 0.5 % on the way, so that no state has the goal's entries.
    """
    (tmp_path / "sat.sdf").write_text(
        '<sdf version="1.9"><model name="sat"><link name="bus"><inertial><mass>10</mass><inertia><ixx>0.4</ixx>'
        "<iyy>0.7</iyy><izz>0.9</izz></inertia></inertial></link></model></sdf>"
    )
    pair = [
        dd.model.BodyForce(name, "bus", point=(0, s / 2, 0), direction=(-s, 0, 0), lower=-50.0, upper=50.0)
        for name, s in {"left": 1, "right": -1}.items()
    ]
    model = dd.load_model(tmp_path / "sat.sdf", time_step=0.2, gravity=(0, 0, 0), body_forces=pair)
    x0, goal = model.default_state, model.default_state
    goal[[0, 3]] = np.sqrt(0.5)
    costs, least = [], 24 * 0.9**2 * (np.pi / 2) ** 2 / 4**3
    for sign, method in ((1, "ilqr"), (-1, "ilqr"), (-1, "shooting")):
        goal[:4] *= sign
        problem = dd.Problem(model, x0=x0, num_steps=20, running_cost=dd.QuadraticCost(R=np.eye(2)), x_goal=goal)
        solution = dd.solve(problem, method=method)
        assert solution.success, solution.message
        assert np.linalg.norm(solution.xs[-1, :4]) > 1.001
        assert problem.goal_error(solution.xs[-1]) == pytest.approx(np.zeros(model.nx), abs=1e-5)
        costs.append(solution.cost)
    assert costs == pytest.approx([costs[0]] * 3, rel=1e-6)
    assert least < costs[0] < 1.01 * least  # 20 steps cost 1 / (1 - 1/20^2) of it for a translation
    dd.save(solution, tmp_path / "run")
    assert dd.verify(tmp_path / "run").holds
    assert list(odd_metrics(dd.load_record(tmp_path / "run"), dict(np.load(tmp_path / "run" / "plan.npz")))) == []
    turned = solution.xs[-1].copy()
    turned[:4] = np.cos(0.1), 0, 0, np.sin(0.1)
    assert np.max(np.abs(problem.goal_error(turned))) > 0.1


ARMS = [
    ("ur5_robot.urdf", "tool0", {}),
    pytest.param("panda.urdf", "panda_hand", {"mimic": "reduce"}, marks=pytest.mark.long),
    ("solo12.urdf", "HR_FOOT", {}),
]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::drake_diff.exceptions.ModelWarning")
@pytest.mark.parametrize(("name", "frame", "options"), ARMS)
def test_robots_reach_with_a_hand_or_a_foot_by_default_and_verify_holds(name, frame, options, tmp_path):
    """Reach the position that the frame has at other angles, so that it can be reached, and end at rest."""
    model = dd.load_model(robot_file(name), time_step=0.02, actuators="all", base="weld", **options)
    random, (lower, upper) = np.random.default_rng(0), model.position_limits
    lower, upper = np.maximum(lower, -2.0), np.minimum(upper, 2.0)
    start, turn = (lower + upper) / 2, 0.3 * random.uniform(-1, 1, model.nq)
    x0, there = (np.concatenate([np.clip(q, lower, upper), np.zeros(model.nv)]) for q in (start, start + turn))
    where = dd.quantities.frame_position(model, frame)
    problem = dd.Problem(
        model,
        x0=x0,
        num_steps=30,
        goals=dd.FrameGoal(frame, where(there)),
        x_goal=dict.fromkeys(model.velocity_names, 0.0),
        running_cost=dd.QuadraticCost(R=1e-3 * np.eye(model.nu)),
    )
    solution = dd.solve(problem, progress=False)
    assert solution.success, solution.message
    assert any(c.where == f"{frame} position" and c.passes for c in solution.checks)
    # The plan ends in a box of a tenth of 5 mm each way. Drake measures the distance.
    assert np.linalg.norm(where(solution.xs[-1]) - where(there)) <= AIMED * 5e-3 + 1e-5
    dd.save(solution, tmp_path / "run")
    assert dd.verify(tmp_path / "run", models="/").require().verdict == "holds"


@pytest.fixture(scope="module")
def run(pendulum, tmp_path_factory):
    goals = [dd.FrameGoal("pole", [-0.25, None, None], point=[0, 0, -0.5]), dd.FrameVelocityGoal("pole")]
    problem = dd.Problem(
        pendulum, x0={}, num_steps=20, goals=goals, running_cost=dd.QuadraticCost(R=[[1.0]]), x_goal={"hinge_w": 0.0}
    )
    solution = dd.solve(problem, method="collocation", progress=False)
    assert solution.success, solution.message
    directory = tmp_path_factory.mktemp("runs") / "pole"
    dd.save(solution, directory)
    return directory


def test_verify_binds_the_goals_again_and_holds(run):
    found = dd.verify(run).require()
    assert found.verdict == "holds"
    assert any("goal" in line and "FrameGoal" in line for line in found.claimed)


@pytest.mark.slow
@pytest.mark.parametrize(
    "lie",
    slow_after(
        2,
        [
            {"position": [-0.26, None, None]},  # the hand does not end at this position
            {"tolerance": 0.5},  # any end is within this tolerance, and the search then ends at another one
            {"frame": "nowhere"},
            {"knots": [3]},
        ],
    ),
)
def test_a_goal_that_was_moved_is_found_although_the_record_is_whole(run, tmp_path, lie):
    copy = shutil.copytree(run, tmp_path / "copy")
    record = dd.load_record(copy)
    first, second = record.problem["goals"]
    goals = [{"FrameGoal": first["FrameGoal"] | lie}, second]
    record.model_copy(update={"problem": dict(record.problem) | {"goals": goals}}).write(copy)
    found = dd.verify(copy)
    assert not found.holds
