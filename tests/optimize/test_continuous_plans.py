"""Tests of rollouts and plans in continuous time, against closed forms and another integration of the same law."""

import shutil

import numpy as np
import pytest
from helpers.models import MODELS, Plant, contact_properties
from helpers.robots import example_robot, state_in_contact

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.motion.continuous import replayed
from drake_diff.optimize import Options, optimality

pytestmark = pytest.mark.solve

ENERGY = 1e-7  # [J] of a few J: some hundred steps in contact, with an error of 1e-9 each


def ball_on_rails(*, stiffness=1e4, dissipation=0.0, friction=0.0, gravity=0.0, time_step=0.01, motors=()):
    """Return a ball of 1 kg and radius 0.1 m on rails along x and z above the ground. `stiffness` is the pair's."""
    plant = Plant(time_step, "lagged", gravity=gravity)
    properties = contact_properties(2 * stiffness, dissipation, friction)
    plant.ball("ball", 1.0, 0.1, properties, "x", "z")
    plant.ground(properties)
    for axis in motors:
        plant.plant.AddJointActuator(f"thrust_{axis}", plant.plant.GetJointByName(f"ball_{axis}"), 50.0)
    return plant.model()


def test_an_elastic_bounce_between_two_ends_is_where_its_closed_form_is():
    """The contact lasts half a period, pi / omega, is V / omega deep, and returns all of its energy."""
    stiffness, speed = 1e4, 2.0
    model, omega = ball_on_rails(stiffness=stiffness), np.sqrt(1e4)
    motion = dd.rollout(model, [0, 1.005, 0, -speed], num_steps=100, method="continuous")
    t, touch = motion.times, 0.905 / speed
    after = 0.1 + speed * (t - touch - np.pi / omega)
    away = (t < touch) | (t > touch + np.pi / omega)
    expected = np.where(t < touch, 1.005 - speed * t, after)
    assert np.max(np.abs(motion.xs[away, 1] - expected[away])) < 1e-7
    assert np.max(motion.penetration) == pytest.approx(speed / omega, rel=1e-2)
    assert np.max(np.abs(motion.energy_error)) < ENERGY
    stored = np.where(away, 0.0, 2.0 * np.sin(omega * (t - touch)) ** 2)  # [J] of the initial 2 J
    assert np.max(np.abs(motion.contact_work + stored)) < 1e-6
    assert [i for i, c in enumerate(motion.contacts) if c] == [45, 46, 47, 48]


def test_a_slide_stops_where_coulomb_says_and_friction_took_its_energy():
    mu, g, v0 = 0.5, 9.81, 1.0
    model = ball_on_rails(dissipation=10, friction=mu, gravity=g)
    motion = dd.rollout(model, [0, 0.1 - g / 1e4, v0, 0], num_steps=60, method="continuous")
    assert motion.xs[-1, 0] == pytest.approx(v0**2 / (2 * mu * g), rel=2e-3)
    assert motion.contact_work[-1] == pytest.approx(-(v0**2) / 2, rel=1e-3)
    assert np.max(np.abs(motion.energy_error)) < ENERGY
    (contact,) = motion.contacts[10]
    assert contact.force == pytest.approx([-mu * g, 0, g], rel=1e-3)
    assert contact.body_a == "ball"
    assert motion.xs[11, 2] - 1e-6 <= contact.slip_speed <= motion.xs[10, 2] + 1e-6


@pytest.mark.parametrize(("name", "seed"), [("bolt.urdf", 0), pytest.param("solo12.urdf", 2, marks=pytest.mark.slow)])
def test_the_work_on_a_robot_in_contact_accounts_for_its_energy(name, seed):
    """Drake computes the energies, but not the motion and the powers. Another integration gives the same motion."""
    model, random = example_robot(name, feet=True, friction=0.6), np.random.default_rng(seed)
    x0 = state_in_contact(model, random)
    us = 0.3 * random.standard_normal((8, model.nu))
    motion = dd.rollout(model, x0, us, method="continuous")
    assert any(motion.contacts)
    exchanged = motion.energy_exchanged
    assert np.max(np.abs(motion.energy_error)) < 1e-6 * exchanged
    other = replayed(model, x0, us, len(us))
    assert np.max(np.abs(other.xs - motion.xs)) < 1e-5
    assert np.max(np.abs(other.energy_error)) < 1e-6 * exchanged
    for measure in ("work", "dissipation", "contact_work"):
        assert np.allclose(getattr(other, measure), getattr(motion, measure), atol=1e-4 * exchanged), measure
    assert np.allclose(other.penetration, motion.penetration, atol=1e-5)  # of 1e-3, each with its own steps
    touched = [{(c.body_a, c.body_b) for c in contacts} for contacts in motion.contacts]
    assert touched == [{(c.body_a, c.body_b) for c in contacts} for contacts in other.contacts]


def test_a_policy_drives_the_motion_in_continuous_time():
    model = ball_on_rails(dissipation=0.5, gravity=9.81, motors=("z",))
    x0, gain = [0, 0.3, 0.2, 0], np.array([[0, 3.0, 0, 1.0]])
    closed = dd.rollout(model, x0, policy=lambda x, t: -gain @ x, num_steps=60, method="continuous")
    again = dd.rollout(model, x0, closed.us, method="continuous")
    assert np.allclose(closed.us, -closed.xs[:-1] @ gain.T)
    assert np.array_equal(closed.xs, again.xs)
    assert closed.work[-1] < -0.1
    assert np.max(np.abs(closed.energy_error)) < ENERGY


def test_stiffer_contact_is_another_motion_and_other_parameters_are_refused():
    model, x0 = ball_on_rails(), [0, 0.2, 0, -2.0]
    soft, stiff = (
        dd.rollout(model, x0, num_steps=20, method="continuous", parameters={"ball.stiffness": k}).xs[-1, 1]
        for k in (1e4, 1e6)
    )
    pair = [1e4 * 2e4 / 3e4, 1e6 * 2e4 / 1.02e6]
    expected = [0.1 + 2 * (0.2 - 0.05 - np.pi / np.sqrt(k)) for k in pair]
    assert [soft, stiff] == pytest.approx(expected, abs=1e-7)
    with pytest.raises(ModelError, match=r"does not support ball\.mass, only contact's"):
        dd.rollout(model, x0, num_steps=5, method="continuous", parameters={"ball.mass": 2.0})
    with pytest.raises(InputError, match="method"):
        dd.rollout(model, x0, num_steps=5, method="rk3")
    controlled = dd.load_model(MODELS / "acrobot.xml", time_step=0.01)
    assert controlled.nx == dd.rollout(controlled, controlled.default_state, [[0.1]], method="continuous").xs.shape[1]


def thrown(model, **more):
    """Return the problem of throwing a ball down so that it is at (1, 0.6) after 0.8 s. Its first velocity is free."""
    bounds = dd.Bounds(x_lower=[-np.inf, -np.inf, -10, -8], x_upper=[np.inf, np.inf, 10, 20])
    mask = np.array([False, False, True, True])
    asked = {"x0": [0, 1, 0.5, -0.5], "x_goal": [1, 0.6, np.nan, np.nan], "num_steps": 40, "bounds": bounds}
    return dd.Problem(model, optimize="initial_state", initial_state_mask=mask, motion="continuous", **asked | more)


@pytest.mark.slow
def test_a_ball_is_thrown_to_bounce_into_its_target():
    """A ball thrown at v reaches the ground at V, stays for 2 (pi - atan(omega V / g)) / omega, and leaves at V."""
    low = dd.Constraint(lambda x, u: x[3:], lower=[-np.inf], upper=[2.0], knots=[0], name="no lob over the ground")
    solution = dd.solve(thrown(ball_on_rails(gravity=9.81, time_step=0.02), constraints=[low]))
    assert solution.status is dd.Status.CONVERGED, solution.message
    across, down = solution.xs[0, 2:]
    assert across == pytest.approx(1 / 0.8, abs=1e-6)
    landing = np.sqrt(down**2 + 2 * 9.81 * 0.9)
    rising = 0.8 - (landing + down) / 9.81 - 2 * (np.pi - np.arctan(100 * landing / 9.81)) / 100
    assert 0.1 + landing * rising - 9.81 / 2 * rising**2 == pytest.approx(0.6, abs=1e-6)
    (replay,) = solution.replays
    assert replay.variant == "by another integration in continuous time"
    assert replay.holds
    assert np.max(np.abs(replay.motion.xs - solution.xs)) < 1e-5
    assert {(c.body_a, c.body_b) for contacts in replay.motion.contacts for c in contacts} == {("ball", "world")}


def struck(model, speed, **more):
    """Return the problem of pushing one ball for 0.2 s so that the other one leaves at `speed`."""
    free = dd.Constraint(lambda x, u: u, lower=[0.0], upper=[0.0], knots=range(10, 60), name="let go")
    asked = {"x0": [0, 0.5, 0, 0], "x_goal": [np.nan, np.nan, np.nan, speed], "num_steps": 60, "constraints": [free]}
    return dd.Problem(model, running_cost=dd.QuadraticCost(R=[[1e-3]]), motion="continuous", **asked | more)


def two_balls(masses=(1.0, 0.5), stiffness=2e4):
    plant = Plant(0.02, "lagged", gravity=0.0)
    for name, mass in zip("ab", masses, strict=True):
        plant.ball(name, mass, 0.1, contact_properties(stiffness), "x")
    plant.plant.AddJointActuator("push", plant.plant.GetJointByName("a_x"), 100.0)
    return plant.model()


def test_a_ball_strikes_another_which_leaves_as_two_bodies_do():
    """v_b = 2 m_a / (m_a + m_b) v_a. The initial guess has no contact, and others are tried."""
    problem = struck(two_balls(), 1.2)
    solution = dd.solve(problem)
    assert solution.status is dd.Status.CONVERGED, solution.message
    assert 0.02 * solution.us[:10].sum() == pytest.approx(1.2 * 1.5 / 2, rel=1e-5)
    tried = solution.options["chain"]
    assert tried[0]["ended"] == "no_gradient"
    assert "another first guess" in tried[-1]["reason"]


@pytest.mark.slow
def test_a_plan_in_continuous_time_is_refused_what_it_has_not():
    model = ball_on_rails(gravity=9.81, time_step=0.02, motors=("x",))
    asked = {"x0": [0, 1, 0, 0], "num_steps": 5, "x_goal": [0.05, np.nan, np.nan, np.nan]}
    problem = dd.Problem(model, motion="continuous", **asked)
    with pytest.raises(InputError, match='method="ilqr" or "shooting"'):
        dd.solve(problem, method="collocation")
    with pytest.raises(InputError, match="use restarts to try other initial guesses"):
        dd.solve(problem, method="ilqr", options=Options(continuation="auto"))
    with pytest.raises(InputError, match=r"num_steps \* model\.time_step"):
        dd.Problem(model, motion="continuous", horizon=(0.1, 0.2), **asked)
    with pytest.raises(UnknownNameError, match="motion"):
        dd.Problem(model, motion="rk3", **asked)
    with pytest.raises(ModelError, match=r"does not support ball\.mass"):
        dd.Problem(model, motion="continuous", parameters=["ball.mass"], **asked)
    block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
    with pytest.raises(InputError, match="plain dynamics"):
        dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=5, horizon=1.0, motion="continuous")
    solution = dd.solve(problem, method="ilqr")
    with pytest.raises(InputError, match='motion="steps", as trials consist of steps'):
        dd.robustness(solution)
    with pytest.raises(ModelError, match="no second derivatives"):
        dd.sensitivity(solution)
    with pytest.raises(InputError, match="motion"):
        dd.loop.MPC(problem, horizon=3)


def thrown_from_a_file(**more):
    """Return the throw for a model from a file, which a record can refer to."""
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.02, contact_approximation="lagged")
    x0, goal, free = np.array(model.default_state), np.full(13, np.nan), np.zeros(13, dtype=bool)
    x0[[4, 6, 10, 12]], goal[[4, 6]], free[[10, 12]] = [0.0, 1.0, 1.2, -0.8], [1.0, 0.5], True
    asked = {"x0": x0, "x_goal": goal, "num_steps": 40, "optimize": ("initial_state",), "initial_state_mask": free}
    parameters = dict.fromkeys(("ball.dissipation", "ground.dissipation"), 0.05)
    return dd.Problem(model, parameters=parameters, motion="continuous", **asked | more)


@pytest.fixture(scope="module")
def thrown_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("thrown") / "run"
    assert dd.save(dd.solve(thrown_from_a_file()), folder).verdict == "pass"
    return folder


@pytest.mark.slow
def test_a_run_in_continuous_time_comes_out_again_and_its_page_says_what_was_checked(thrown_run):
    assert dd.load_record(thrown_run).problem["motion"] == "continuous"
    found = dd.verify(thrown_run)
    assert found.holds, found.complaints
    assert "that of the end is a slope of another integration" in (thrown_run / "report.html").read_text()


def moved(folder):
    """Change the initial velocity by 1 mm/s."""
    with np.load(folder / "plan.npz") as plan:
        parts = dict(plan)
    parts["xs"] = parts["xs"].copy()
    parts["xs"][0, 12] += 1e-3
    np.savez(folder / "plan.npz", **parts)
    return {}


def of_less_penetration(folder):
    found = dd.load_record(folder).invariants
    of = {"penetration": 0.5}
    return {"invariants": tuple(m.model_copy(update={"value": of.get(m.name, 1.0) * m.value}) for m in found)}


@pytest.mark.slow
@pytest.mark.parametrize("forge", [moved, of_less_penetration])
def test_a_forged_run_in_continuous_time_is_refused(thrown_run, tmp_path, forge):
    """Check that the run is refused although all hashes are correct."""
    folder = tmp_path / "forged"
    shutil.copytree(thrown_run, folder)
    dd.load_record(folder).model_copy(update=forge(folder)).write(folder)
    assert dd.verify(folder).verdict == "broken"


@pytest.mark.slow
def test_a_derivative_that_another_integration_does_not_have_is_no_plans(monkeypatch):
    """Test a derivative 2 % off at every step width, and slopes that do not converge, as for a tumbling body."""
    model = ball_on_rails(gravity=9.81, time_step=0.02)
    right = optimality.final_sensitivity
    monkeypatch.setattr(optimality, "final_sensitivity", lambda *at: 1.02 * right(*at))
    off = dd.solve(thrown(model), method="shooting")
    assert off.status is dd.Status.CONVERGED_NOT_VERIFIED
    assert "from the slope of another integration" in repr(off)
    monkeypatch.setattr(optimality, "final_sensitivity", right)
    measured, factors = optimality._slope, iter([1.5, 0.4, 1.7] * 9)
    monkeypatch.setattr(optimality, "_slope", lambda *at: next(factors) * measured(*at))
    tumbles = dd.solve(thrown(model), method="shooting")
    assert tumbles.status is dd.Status.NO_GRADIENT
    assert "holds at this point only" in repr(tumbles)
