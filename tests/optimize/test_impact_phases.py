"""Tests of phased plans through rigid impacts: replays by SciPy with events, and planted errors that are refused."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from helpers.forgery import edit
from helpers.models import Plant, add_slide, contact_properties
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces, RevoluteJoint, SpatialInertia
from scipy.integrate import solve_ivp

import drake_diff as dd
from drake_diff.exceptions import InputError, ModelWarning
from drake_diff.optimize import FixedContacts, Impact, PhasedProblem
from drake_diff.optimize.phased import _across, judged_phases
from drake_diff.optimize.program import NlpResult, Outcome

G, RESTITUTION = 9.81, 0.7
FOOT = [0, 0, -0.05]


@pytest.fixture(scope="module")
def thrown():
    """Solve for a ball with two motors that bounces into a target with the least effort."""
    plant, properties = Plant(0.01, "lagged"), contact_properties(2e4)
    plant.ball("ball", 1.0, 0.1, properties, "x", "z")
    plant.ground(properties)
    for axis in "xz":
        plant.plant.AddJointActuator(f"push_{axis}", plant.plant.GetJointByName(f"ball_{axis}"))
    model = plant.model()
    reset = Impact(FixedContacts(model, {"ball": [0, 0, -0.1]}, axes="z"), restitution=RESTITUTION, at=0.0)
    way = {"num_steps": 12, "horizon": (0.1, 1.5), "running_cost": dd.QuadraticCost(R=np.eye(2))}
    down = dd.Problem(model, x0=[0, 0.8, 0, 0], constraints=reset.kept(), **way)
    up = dd.Problem(model, x0=[0.5, 0.1, 1, 1], x_goal=[1.2, 0.9, np.nan, np.nan], **way)
    return dd.solve(PhasedProblem([down, up], resets=[reset], names=["down", "up"]))


@pytest.fixture(scope="module")
def landed():
    """Solve for a hopper that falls from 0.3 m at 0.4 m/s forwards, lands on its foot and comes to rest."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        model = dd.load_model("models/hopper.sdf", time_step=0.01, contact=False)
    stance, effort = FixedContacts(model, {"foot": FOOT}), dd.QuadraticCost(R=1e-2 * np.eye(2))
    landing = Impact(stance, at=0.0, friction=0.8)
    x0, begins = np.array([0, 0.35, 0, 0, 0.4, 0, 0, 0]), np.array([0.1, 0.05, 0, 0, 0, 0, 0, 0])
    fly = dd.Problem(model, x0=x0, num_steps=15, horizon=(0.1, 0.8), running_cost=effort, constraints=landing.kept())
    stand = dd.Problem(
        stance, x0=begins, num_steps=20, horizon=(0.1, 1.0), running_cost=effort,
        x_goal={"x_v": 0.0, "z_v": 0.0, "z": 0.0}, constraints=stance.kept(friction=0.8)[1:],
    )  # fmt: skip
    return dd.solve(PhasedProblem([fly, stand], resets=[landing], names=["flight", "landing"]))


def inputs(phase):
    """Return u(t) of a plan, with its last value after its end."""
    return lambda t: phase.transcribed.applied_at(np.array([min(t, phase.horizon)]))[0]


@pytest.mark.solve
def test_a_ball_bounces_into_its_target(thrown):
    """SciPy integrates free flight and z' -> -e z' at z = r. The fall ends at the floor, not at the plan's time."""
    assert thrown.success, thrown.message
    down, up = (inputs(phase) for phase in thrown.phases)

    def rates(x, u):
        return [x[2], x[3], u[0], u[1] - G]

    def floor(t, x):
        return x[1] - 0.1

    floor.terminal, floor.direction = True, -1
    tight = {"rtol": 1e-11, "atol": 1e-12, "max_step": 0.01}
    fall = solve_ivp(lambda t, x: rates(x, down(t)), (0, 2), [0, 0.8, 0, 0], events=floor, **tight)
    assert fall.t[-1] == pytest.approx(thrown.phases[0].horizon, abs=1e-6)
    begins = fall.y[:, -1] * [1, 1, 1, -RESTITUTION]
    rise = solve_ivp(lambda t, x: rates(x, up(t)), (0, thrown.phases[1].horizon), begins, **tight)
    np.testing.assert_allclose(rise.y[:2, -1], [1.2, 0.9], atol=1e-5)
    assert np.min(rise.y[1]) > 0.0999
    assert thrown.message == "converged: holds open loop in continuous time"
    assert [c.verdict for c in thrown.certificates] == ["agree"]


class HopperByHand:
    """The hopper by Drake's mass matrix, bias and Jacobian, with an impact and a foot constraint of its own."""

    def __init__(self, model):
        self.plant, self.context = model.plant, model.plant.CreateDefaultContext()
        self.foot, self.B = model.plant.GetBodyByName("foot"), model.actuation

    def terms(self, x):
        plant, world = self.plant, self.plant.world_frame()
        plant.SetPositionsAndVelocities(self.context, x)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(self.context, forces)
        bias = plant.CalcInverseDynamics(self.context, np.zeros(4), forces)
        frame, at = self.foot.body_frame(), np.array(FOOT, dtype=float)
        J = plant.CalcJacobianTranslationalVelocity(self.context, JacobianWrtVariable.kV, frame, at, world, world)
        own = plant.CalcBiasTranslationalAcceleration(self.context, JacobianWrtVariable.kV, frame, at, world, world)
        height = plant.CalcPointsPositions(self.context, frame, at, world)[2, 0]
        return plant.CalcMassMatrix(self.context), bias, J[[0, 2]], np.asarray(own).ravel()[[0, 2]], height

    def rates(self, x, u, held):
        M, bias, J, own, _ = self.terms(x)
        free = np.linalg.solve(M, self.B @ u - bias)
        if held:
            pushed = np.linalg.solve(M, J.T)
            free = free - pushed @ np.linalg.solve(J @ pushed, own + J @ free)
        return np.concatenate([x[4:], free])

    def impact(self, x):
        M, _, J, _, _ = self.terms(x)
        pushed = np.linalg.solve(M, J.T)
        P = -np.linalg.solve(J @ pushed, J @ x[4:])
        return np.concatenate([x[:4], x[4:] + pushed @ P]), P


@pytest.mark.solve
def test_a_hopper_lands_where_another_simulation_lands(landed):
    assert landed.success, landed.message
    hopper = HopperByHand(landed.problem.phases[0].system)
    fly, stand = (inputs(phase) for phase in landed.phases)

    def foot(t, x):
        return hopper.terms(x)[4]

    foot.terminal, foot.direction = True, -1
    tight = {"rtol": 1e-9, "atol": 1e-10, "max_step": 0.02}
    x0 = landed.phases[0].xs[0]
    fall = solve_ivp(lambda t, x: hopper.rates(x, fly(t), False), (0, 1), x0, events=foot, **tight)
    assert fall.t[-1] == pytest.approx(landed.phases[0].horizon, abs=1e-5)
    begins, P = hopper.impact(fall.y[:, -1])
    assert P[1] > 0
    assert abs(P[0]) <= 0.8 * P[1] * (1 + 1e-6)
    np.testing.assert_allclose(begins, landed.phases[1].xs[0], atol=1e-5)
    end = solve_ivp(lambda t, x: hopper.rates(x, stand(t), True), (0, landed.phases[1].horizon), begins, **tight)
    np.testing.assert_allclose(end.y[[1, 4, 5], -1], 0.0, atol=1e-4)


def test_feedback_is_led_back_through_the_saltation_matrix(thrown):
    """Check [[-e, 0], [-(1 + e) z'' / z', -e]] for height and speed, where the phases have different inputs."""
    motions = [phase.transcribed for phase in thrown.phases]
    xi = _across(thrown.problem.switches[0], *motions)
    v, e = thrown.phases[0].xs[-1, 3], RESTITUTION
    push, after = motions[0].us[-1], motions[1].us[0]
    wanted = np.diag([1.0, -e, 1.0, -e])
    wanted[2, 1] = (after[0] - push[0]) / v
    wanted[3, 1] = (after[1] - G + e * (push[1] - G)) / v
    np.testing.assert_allclose(xi, wanted, atol=1e-9)


def rejudged(solution, **fields):
    result = NlpResult(np.zeros(0), Outcome.SOLVED, "IPOPT: Solve Succeeded", ())
    return judged_phases(replace(solution, **fields), result)


@pytest.mark.solve
@pytest.mark.parametrize("seed", range(4))
def test_a_plan_that_the_law_of_impact_does_not_have_is_refused(landed, seed):
    """The floor has less friction than the landing's impulse needs, or the impact has another restitution."""
    assert rejudged(landed).success
    random, problem = np.random.default_rng(seed), landed.problem
    reset = problem.switches[0].reset
    P = HopperByHand(problem.phases[0].system).impact(landed.phases[0].xs[-1])[1]
    needed = abs(P[0]) / P[1]
    less = Impact(reset.contacts, at=0.0, friction=needed * random.uniform(0.1, 0.9))
    bouncy = Impact(reset.contacts, restitution=10 ** random.uniform(-4, -1), at=0.0, friction=0.8)
    for impact, reason in ((less, "foot slides"), (bouncy, "is missed by")):
        other = PhasedProblem(problem.phases, resets=[impact], names=problem.names)
        again = rejudged(landed, problem=other)
        assert again.status is dd.Status.CONVERGED_NOT_VERIFIED
        assert reason in repr(again)


@pytest.mark.parametrize("seed", range(4))
def test_a_plan_whose_impact_comes_at_another_time_is_refused(thrown, seed):
    """The moved fall satisfies the same equations, but meets the floor earlier or later than the plan states."""
    shift = np.random.default_rng(seed).choice([-1, 1]) * 10 ** np.random.default_rng(seed).uniform(-3, -1)
    phases = list(thrown.phases)
    xs = np.array(phases[0].xs)
    xs[:, 1] += shift
    phases[0] = replace(phases[0], xs=xs)
    again = rejudged(thrown, phases=tuple(phases))
    assert again.status is dd.Status.CONVERGED_NOT_VERIFIED
    assert "has a gap of" in repr(again)


def test_what_is_no_impact_is_refused_early(landed):
    stance = landed.problem.phases[1].system
    for wrong, message in (
        ({"restitution": 1.1}, "restitution: expected a number from 0 to 1"),
        ({"at": [0.0]}, "at: expected a height, or a coordinate for each"),
        ({"friction": -0.1}, "friction: expected"),
    ):
        with pytest.raises(InputError, match=message):
            Impact(stance, **wrong)
    with pytest.raises(InputError, match="contacts: expected FixedContacts"):
        Impact(stance.model)


def test_the_saltation_matrix_of_a_bounce():
    """The matrix is [[-e, 0], [-(1 + e) g / v, -e]] for height and speed, at e = 0.8 and v = -3."""
    plant = Plant(0.01, "lagged")
    plant.ball("ball", 1.0, 0.1, contact_properties(2e4), "x", "z")
    plant.plant.AddJointActuator("push", plant.plant.GetJointByName("ball_x"))
    impact = Impact(FixedContacts(plant.model(), {"ball": [0, 0, -0.1]}, axes="z"), restitution=0.8, at=0.0)
    x = np.array([0, 0.1, 0, -3.0])
    np.testing.assert_allclose(impact(x), [0, 0.1, 0, 2.4], atol=1e-14)
    np.testing.assert_allclose(impact.by_drake(x), [0, 0.1, 0, 2.4], atol=1e-14)
    xi = impact.saltation(x, np.array([0, -3.0, 0, -G]), np.array([0, 2.4, 0, -G]))
    np.testing.assert_allclose(xi[np.ix_([1, 3], [1, 3])], [[-0.8, 0], [5.886, -0.8]], atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 0.4, -1.1])
def test_a_rod_that_strikes_with_its_end(angle):
    """Without friction P = (1 + e) v / (1 / m + r^2 / I), with the horizontal distance r of the end, I = m L^2 / 12."""
    m, length, e, v = 2.0, 1.2, 0.6, np.array([0.3, -1.5, -0.7])
    plant = Plant(0.01, "lagged")
    bodies = [plant.plant.AddRigidBody(name, SpatialInertia.Zero()) for name in ("one", "two")]
    rod = plant.plant.AddRigidBody("rod", SpatialInertia.ThinRodWithMass(m, length, np.array([1.0, 0, 0])))
    add_slide(plant.plant, "x", plant.plant.world_frame(), bodies[0], "x")
    add_slide(plant.plant, "z", bodies[0].body_frame(), bodies[1], "z")
    plant.plant.AddJoint(RevoluteJoint("angle", bodies[1].body_frame(), rod.body_frame(), [0, 1, 0]))
    plant.plant.AddJointActuator("push", plant.plant.GetJointByName("angle"))
    rod = FixedContacts(plant.model(), {"rod": [length / 2, 0, 0]}, axes="z")
    end = np.array([np.cos(angle), -np.sin(angle)]) * length / 2
    x = np.array([0.2, -end[1], angle, *v])
    impact, inertia = Impact(rod, restitution=e, at=0.0), m * length**2 / 12
    impulse = (1 + e) * -(v[1] - v[2] * end[0]) / (1 / m + end[0] ** 2 / inertia)
    np.testing.assert_allclose(impact.impulses(x), [impulse], rtol=1e-11)
    wanted = v + np.array([0, impulse / m, -end[0] * impulse / inertia])
    for after in (impact(x), impact.by_drake(x)):
        np.testing.assert_allclose(after[3:], wanted, atol=1e-11)
    assert impact.broken_rules(x) == []
    assert impact.first_gap(x + 0.1) == pytest.approx(0.1 + (np.sin(angle) - np.sin(angle + 0.1)) * length / 2)


@pytest.mark.slow
def test_a_landing_is_made_again_and_a_forged_one_is_not(landed, tmp_path):
    """The record contains the impact's restitution, friction, point and law."""
    record = dd.save(landed, tmp_path / "run")
    assert record.verdict == "pass", record.sentence
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        found = dd.verify(tmp_path / "run")
        assert found.verdict == "holds", found.complaints
        assert record.phases.links[0].reset["impact"]["points"]["foot"] == FOOT
        edit(tmp_path / "run", lambda f: f["phases"]["links"][0]["reset"]["impact"].update(restitution=0.01))
        assert dd.verify(tmp_path / "run").verdict == "broken"
