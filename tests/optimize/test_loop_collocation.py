"""Tests of collocation with closed loops against a pendulum of one freedom, Drake's steps, and forged loops."""

import warnings

import numpy as np
import pytest
from helpers.linkages import LEG
from helpers.table import each_row
from scipy.integrate import solve_ivp

import drake_diff as dd
from drake_diff.exceptions import ModelError
from drake_diff.mechanics import fixed_contacts
from drake_diff.mechanics.fixed_contacts import loop_plant
from drake_diff.model.assembly import gap

# A planar four-bar linkage: the hinges and the lengths of crank, bar and rocker, and every link's centre of mass.
GROUND, CRANK, BAR, ROCKER = np.array([0.5, 0.0]), np.array([0.0, 0.2]), np.array([0.5, 0.1]), np.array([0.0, 0.3])
CENTER, MASS, INERTIA, G = np.array([0.1, 0.1]), 0.4, 0.01, 9.81  # [m, kg, kg m^2 about the centre, m/s^2]
LINK = (
    '<link name="{}"><pose>{} 0 {} 0 0 0</pose><inertial><pose>0.1 0 0.1 0 0 0</pose><mass>0.4</mass><inertia>'
    "<ixx>0.01</ixx><iyy>0.01</iyy><izz>0.01</izz></inertia></inertial></link>"
)
JOINT = (
    '<joint name="{}" type="revolute">{}<parent>{}</parent><child>{}</child><axis><xyz>{}</xyz><limit>'
    "<effort>{}</effort></limit></axis></joint>"
)
Y = "0 1 0"
HEAVY = LINK.replace("0.4", "1").replace("0.01", "0.1")  # of the arm


def four_bar(path, on="world", more=""):
    """Write the four-bar on the body `on`. Its last joint closes the loop, with two points on its axis."""
    links = LINK.format("crank", 0, 1) + LINK.format("bar", 0, 1.2) + LINK.format("rocker", 0.5, 1)
    rows = [("a", "", on, "crank", Y, 5), ("b", "", "crank", "bar", Y, 0), ("c", "", on, "rocker", Y, 0)]
    rows.append(("d", '<pose relative_to="rocker">0 0 0.3 0 0 0</pose>', "bar", "rocker", Y, 0))
    joints = "".join(JOINT.format(*row) for row in rows)
    path.write_text(f'<sdf version="1.9"><model name="loop">{more}{links}{joints}</model></sdf>')
    return path


def load(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return dd.load_model(path, **{"time_step": 0.01, **options})


def turned(vector, angle):
    """Return a vector (x, z) after a positive rotation about y."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * vector[0] + s * vector[1], -s * vector[0] + c * vector[1]])


def closed_form(crank):
    """Return the angles of crank, bar and rocker in the world by the intersection of two circles."""
    from_tip = GROUND - turned(CRANK, crank)
    d, bar, rocker = np.linalg.norm(from_tip), np.linalg.norm(BAR), np.linalg.norm(ROCKER)
    along = (d**2 + bar**2 - rocker**2) / (2 * d)
    e = from_tip / d
    joint = along * e + np.sqrt(bar**2 - along**2) * np.array([-e[1], e[0]])  # the upper intersection
    angle = [np.arctan2(v[0], v[1]) - np.arctan2(w[0], w[1]) for v, w in ((joint, BAR), (joint - from_tip, ROCKER))]
    return np.array([crank, *angle])


def energies(crank):
    """Return the inertia [kg m^2] of the mechanism about the crank's angle, and its potential energy [J]."""
    d = 1e-4  # [rad] of a central difference of fourth order, whose error is below 1e-12
    steps = ((-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12))
    rates = sum(weight * _centers(crank + i * d) for i, weight in steps) / d
    spin = sum(weight * closed_form(crank + i * d) for i, weight in steps) / d
    return MASS * np.sum(rates**2) + INERTIA * np.sum(spin**2), MASS * G * np.sum(_centers(crank)[:, 1])


def _centers(crank):
    a, b, c = closed_form(crank)
    return np.array([turned(CENTER, a), turned(CRANK, a) + turned(CENTER, b), GROUND + turned(CENTER, c)])


def pendulum(t, x, torque):
    """Return the rates of the pendulum: I(a) a'' + I'(a) a'^2 / 2 + V'(a) = torque."""
    d = 1e-3  # [rad]
    sides = [energies(x[0] + i * d) for i in (-2, -1, 1, 2)]
    slopes = [(s[0] - 8 * s[1] + 8 * s[2] - s[3]) / (12 * d) for s in zip(*sides, strict=True)]
    return [x[1], (torque(t) - slopes[0] * x[1] ** 2 / 2 - slopes[1]) / energies(x[0])[0]]


def problem_of(model, **changes):
    """Return a problem: swing the crank by 0.8 rad from rest to rest in 0.4 s."""
    given = {"x_goal": {"a_q": 0.8, "a_w": 0.0}, "num_steps": 20, "horizon": 0.4}
    cost = dd.QuadraticCost(R=np.eye(model.nu))
    return dd.Problem(model, **{"x0": np.zeros(model.nx), "running_cost": cost, **given, **changes})


def worst_gap(model, xs):
    return max(gap(model, x[: model.nq])[0] for x in xs)


@pytest.fixture(scope="module")
def four_bar_plan(tmp_path_factory):
    model = load(four_bar(tmp_path_factory.mktemp("loop") / "loop.sdf"))
    return model, dd.solve(problem_of(model))


@pytest.mark.solve
def test_a_four_bar_moves_as_its_pendulum(four_bar_plan):
    """The plan's crank is that of the pendulum under its torque, its other joints those of the closed form."""
    _, plan = four_bar_plan
    assert plan.success, plan.message
    assert plan.method == "collocation"
    assert "exact Hessian" in plan.options["derivatives"]
    torque = plan.trajectory().input
    options = {"rtol": 1e-9, "atol": 1e-11, "t_eval": plan.times}
    truth = solve_ivp(pendulum, (0.0, 0.4), [0.0, 0.0], args=(lambda t: torque.value(t)[0, 0],), **options)
    # The scheme's error in an interval of 20 ms is of order h^5: 3e-7 of the angle's range, 3e-6 of its rate's.
    np.testing.assert_allclose(plan.xs[:, 0], truth.y[0], atol=2e-6)
    np.testing.assert_allclose(plan.xs[:, 3], truth.y[1], atol=2e-5)
    for x in plan.xs:
        a, b, c = closed_form(x[0])
        np.testing.assert_allclose(x[:3], [a, b - a, c], atol=2e-6)
    kinetic = [energies(a)[0] * rate**2 / 2 for a, rate in truth.y.T]
    work = solve_ivp(lambda t, _: [torque.value(t)[0, 0] * plan.trajectory().state.value(t)[3, 0]], (0, 0.4), [0.0])
    gained = kinetic[-1] + energies(truth.y[0, -1])[1] - energies(0.0)[1]
    assert gained == pytest.approx(work.y[0, -1], abs=1e-3)


@pytest.mark.solve
def test_the_plan_is_the_limit_of_drakes_steps(four_bar_plan):
    """Drake's nearly rigid constraint has an error of first order in the step: half the step, half the distance."""
    model, plan = four_bar_plan
    torque, distances = plan.trajectory().input, []
    for step in (1e-3, 5e-4):
        x, fine = plan.xs[0], model.at_time_step(step)
        for k in range(round(0.4 / step)):
            x = dd.step(fine, x, torque.value((k + 0.5) * step).ravel())
        distances.append(np.abs(x - plan.xs[-1]).max())
    assert distances[0] < 0.05  # of a rate of 4 rad/s
    assert distances[0] / distances[1] == pytest.approx(2.0, rel=0.1)


@pytest.mark.solve
def test_the_loop_closes_by_the_fourth_order_between_knots(four_bar_plan):
    model, plan = four_bar_plan
    gaps = []
    for solution in (plan, dd.solve(problem_of(model, num_steps=40), method="collocation")):
        gaps.append(max(worst_gap(model, xs) for xs in (solution.xs, solution.transcribed.between_knots[1])))
    assert gaps[0] < 1e-6
    assert 8 < gaps[0] / gaps[1] < 32  # 2^4 in the limit
    (check,) = [c for c in plan.checks if c.what == "loop" and c.plant == "plan"]
    assert check.value == pytest.approx(gaps[0], rel=1e-6)


@pytest.mark.solve
def test_a_loop_that_opens_is_not_verified(tmp_path, four_bar_plan):
    """A start whose velocities open the loop opens it all along, as the equations constrain accelerations."""
    model, _ = four_bar_plan
    problem = problem_of(model, x0={"a_w": 0.5}, x_goal={"a_q": 0.5})
    solution = dd.solve(problem, method="collocation")
    assert solution.status is dd.Status.CONVERGED_NOT_VERIFIED
    assert "points of a loop are" in solution.message
    assert worst_gap(model, solution.xs[-1:]) > 0.05


@pytest.mark.solve
def test_a_missing_row_of_a_loop_is_noticed(tmp_path, monkeypatch):
    """Without one of the loop's independent rows, the solver's motion opens the loop, and Drake's steps do not."""
    right = fixed_contacts._independent
    monkeypatch.setattr(fixed_contacts, "_independent", lambda J: right(J)[:1])
    model = load(four_bar(tmp_path / "loop.sdf"))
    with monkeypatch.context() as lost:
        lost.setattr(fixed_contacts, "_independent", lambda J: right(J)[:-1])
        with pytest.raises(ModelError, match="other independent constraints in other positions"):
            loop_plant(load(tmp_path / "loop.sdf"))
    assert len(loop_plant(model).rows) == 1
    solution = dd.solve(problem_of(model), method="collocation")
    assert not solution.success
    failed = {c.what for c in solution.checks if not c.passes}
    assert "loop" in failed
    assert failed & {"goal", "following"}  # of a replay


TURN = (
    HEAVY.format("turn", 0, 1) + HEAVY.format("tilt", 0, 1) + JOINT.format("yaw", "", "world", "turn", "0 0 1", 20)
) + JOINT.format("roll", "", "turn", "tilt", "1 0 0", 20)


@pytest.mark.solve
def test_rows_of_a_loop_suffice_however_its_body_turns(tmp_path):
    """An arm turns the four-bar's plane by a right angle. In the frame of a link, the same rows are independent."""
    model = load(four_bar(tmp_path / "arm.sdf", on="tilt", more=TURN))
    plant = loop_plant(model)
    assert len(plant.rows) == 2  # of six, as every point moves in a plane and both have the same motion
    goal = {"yaw_q": 1.5, "yaw_w": 0.0, "roll_q": 0.7, "roll_w": 0.0, "a_q": 0.6, "a_w": 0.0}
    problem = problem_of(model, x_goal=goal, num_steps=30, horizon=0.6, running_cost=dd.QuadraticCost(R=np.eye(3)))
    solution = dd.solve(problem, method="collocation")
    assert solution.success, solution.message
    assert worst_gap(model, solution.xs) < 1e-4
    a, b, c = closed_form(solution.xs[-1][2])
    np.testing.assert_allclose(solution.xs[-1][2:5], [a, b - a, c], atol=1e-4)


FREE = (
    '<mujoco model="free"><worldbody><body name="trunk" pos="0 0 1"><freejoint/>'
    '<inertial pos="0 0 0" mass="3" diaginertia="0.02 0.03 0.04"/>'
    '<body name="first"><joint name="a" axis="0 1 0"/>'
    '<inertial pos="0 0 -0.1" mass="0.5" diaginertia="2e-3 2e-3 1e-4"/>'
    '<body name="bar" pos="0 0 -0.2"><joint name="b" axis="0 1 0"/>'
    '<inertial pos="0.1 0.02 0" mass="0.2" diaginertia="1e-4 1e-3 1e-3"/></body></body>'
    '<body name="second" pos="0.2 0 0"><joint name="c" axis="0 1 0"/>'
    '<inertial pos="0 0 -0.1" mass="0.5" diaginertia="2e-3 2e-3 1e-4"/></body></body></worldbody>'
    '<equality><connect body1="bar" body2="second" anchor="0.2 0 0"/></equality>'
    '<actuator><motor name="m" joint="a" ctrlrange="-9 9"/></actuator></mujoco>'
)


def test_a_floating_linkage_moves_as_in_drakes_steps(tmp_path):
    """Without gravity and torque, momentum is constant, and Drake's steps tend to the same accelerations."""
    (tmp_path / "free.xml").write_text(FREE)
    model = load(tmp_path / "free.xml", gravity=[0, 0, 0])
    dynamics, random = dd.optimize.plant_dynamics(model), np.random.default_rng(3)
    x = np.array(dd.model.assembled(model, model.default_state))
    J, _ = fixed_contacts.slopes_at(model, dynamics.form.held, x)
    v = random.standard_normal(model.nv)
    x[model.nq :] = v - np.linalg.pinv(J) @ (J @ v)
    options = {"rtol": 1e-10, "atol": 1e-12}
    end = solve_ivp(lambda t, z: dynamics(z, [0.5]), (0.0, 0.1), x, **options).y[:, -1]
    distances = []
    for step in (1e-3, 5e-4):
        z, fine = x, model.at_time_step(step)
        for _ in range(round(0.1 / step)):
            z = dd.step(fine, z, [0.5])
        distances.append(np.abs(z - end).max())
    assert distances[0] < 0.01
    assert distances[0] / distances[1] == pytest.approx(2.0, rel=0.1)


@each_row("change, words", [({"parameters": ["a.damping"]}, "constraints have no continuous form")])
def test_what_has_no_continuous_form_is_refused(tmp_path, change, words):
    model = load(four_bar(tmp_path / "loop.sdf"))
    with pytest.raises(ModelError, match=words):
        dd.solve(problem_of(model, **change), method="collocation")


def test_stance_with_a_closed_loop(tmp_path):
    """A rail holds the four-bar, whose bar is fixed to the world: nothing moves, and the forces carry the weight."""
    rail = HEAVY.format("rail", 0, 1) + JOINT.format("lift", "", "world", "rail", "0 0 1", 99).replace(
        "revolute", "prismatic"
    )
    model = load(four_bar(tmp_path / "rail.sdf", on="rail", more=rail))
    stance = dd.optimize.FixedContacts(model, {"bar": [0, 0, 0]})
    assert stance.rows == ("bar x", "bar z")
    assert len(stance.plant.rows) == 4
    x = np.zeros(model.nx)
    rates = stance(x, [0.0, 0.0])
    np.testing.assert_allclose(rates[4:], 0.0, atol=1e-9)
    forces = stance.forces(x, [0.0, 0.0])
    assert forces.shape == (2,)
    assert forces[1] == pytest.approx((1 + 3 * MASS) * G, rel=1e-9)


PARALLELOGRAM = (
    '<mujoco model="loop"><worldbody><body name="first" pos="0 0 1"><joint name="a" axis="0 1 0"/>{rod}'
    '<body name="bar" pos="0 0 -0.3"><joint name="b" axis="0 1 0"/>'
    '<inertial pos="0.2 0 0" mass="0.5" diaginertia="1e-4 0.01 0.01"/></body></body>'
    '<body name="second" pos="0.4 0 1"><joint name="c" axis="0 1 0"/>{rod}</body>'
    '<body name="wheel" pos="0 1 1"><joint name="d" axis="0 1 0"/>'
    '<inertial pos="0 0 0" mass="1" diaginertia="0.02 0.03 0.02"/></body></worldbody>'
    '<equality><connect body1="bar" body2="second" anchor="0.4 0 0"/><joint joint1="d" joint2="a" polycoef="0 -2"/>'
    '</equality><actuator><motor name="m" joint="a" ctrlrange="-9 9"/></actuator></mujoco>'
)


@pytest.mark.solve
def test_a_loop_beside_a_coupled_joint_has_its_closed_form(tmp_path):
    """The cranks turn by the same angle a, the bar not, and the wheel by -2 a, which adds 4 times its inertia."""
    rod = '<inertial pos="0 0 -0.15" mass="0.7" diaginertia="{0} {0} 1e-4"/>'.format(0.7 * 0.3**2 / 12)
    (tmp_path / "loop.xml").write_text(PARALLELOGRAM.format(rod=rod))
    model = load(tmp_path / "loop.xml", mimic="reduce")
    assert model.coupling is not None
    a = [model.position_names.index(f"{name}_q") for name in "abc"]
    x = np.zeros(model.nx)
    x[a] = -0.4, 0.4, -0.4
    rates = dd.optimize.plant_dynamics(model)(x, [1.5])[model.nq :]
    inertia = 2 * 0.7 * 0.3**2 / 3 + 0.5 * 0.3**2 + 4 * 0.03
    wanted = (1.5 + (0.7 + 0.5) * G * 0.3 * np.sin(0.4)) / inertia
    np.testing.assert_allclose(rates[a], np.array([1, -1, 1]) * wanted, rtol=1e-9)
    problem = problem_of(model, x_goal={"a_q": 0.5, "a_w": 0.0})
    solution = dd.solve(problem, method="collocation")
    assert solution.success, solution.message
    assert worst_gap(model, solution.xs) < 1e-9


@pytest.mark.solve
@pytest.mark.parametrize("free", [[1, 1, 1, 0, 0, 0], [0, 0, 0, 1, 1, 1]])
def test_a_free_start_closes_the_loop(four_bar_plan, free):
    """Without a constraint at the start, the cheapest start has an open loop."""
    model, plan = four_bar_plan
    problem = problem_of(model, optimize=("controls", "initial_state"), initial_state_mask=np.array(free, dtype=bool))
    solution = dd.solve(problem, method="collocation")
    assert solution.success, solution.message
    assert solution.cost < plan.cost
    start = solution.xs[0]
    assert np.abs(loop_plant(model).closing(start)).max() < 1.1e-7  # the tolerance, and IPOPT's relaxation of it
    a, b, c = closed_form(start[0])
    np.testing.assert_allclose(start[:3], [a, b - a, c], atol=1e-5)


@pytest.mark.solve
def test_a_saved_plan_of_a_loop_is_made_again(four_bar_plan, tmp_path):
    _, plan = four_bar_plan
    record = dd.save(plan, tmp_path / "run")
    assert 0 < next(metric.value for metric in record.metrics if metric.name == "loop gap") < 0.005
    assert dd.verify(tmp_path / "run").holds


@pytest.mark.solve
def test_a_leg_with_a_rod_moves_in_least_time(tmp_path):
    """The rod keeps the shank parallel to the crank, as both have the same length: hip + knee = drive."""
    (tmp_path / "leg.xml").write_text(LEG)
    model = load(tmp_path / "leg.xml")
    goal = {"hip_q": 0.4, "drive_q": -0.3, "rail_x": 0.05, "hip_w": 0.0, "drive_w": 0.0, "rail_v": 0.0}
    cost = lambda x, u: 1.0 + 1e-4 * u.dot(u)  # noqa: E731
    solution = dd.solve(problem_of(model, x_goal=goal, num_steps=30, horizon=(0.05, 2.0), running_cost=cost))
    assert solution.success, solution.message
    assert solution.method == "collocation"
    assert 0.1 < solution.times[-1] < 0.2
    hip, knee, drive, pin = solution.xs[:, 1:5].T
    np.testing.assert_allclose(hip + knee, drive, atol=1e-9)
    np.testing.assert_allclose(drive + pin, hip, atol=1e-9)
