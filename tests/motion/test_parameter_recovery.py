"""Hidden parameters are recovered from a simulated motion with every seed, to 1e-4 (measured: 1e-6)."""

import numpy as np
import pytest
from helpers.models import Plant, contact_properties
from pydrake.geometry import HalfSpace
from pydrake.math import RigidTransform
from pydrake.multibody.tree import RevoluteJoint, RotationalInertia, SpatialInertia

import drake_diff as dd
from drake_diff.model.parameters import from_log_cholesky, room_of_inertia, to_log_cholesky
from drake_diff.optimize.solution import Status

pytestmark = pytest.mark.solve

G = 9.81
SEEDS = range(6)
RECOVERED = 1e-4  # relative


def within_a_factor_of_two(random):
    return 2 ** random.uniform(-1, 1)


def recover(model, x0, us, truth, start, **fields):
    """Fit the parameters `start` to the motion with `truth`. Return the solution and the values by parameter name."""
    xs_true = dd.rollout(model, x0, us, num_steps=len(us), parameters=truth).xs
    problem = dd.Problem(
        model,
        x0=x0,
        us=us,
        num_steps=len(us),
        optimize=("parameters",),
        parameters=start,
        trajectory_cost=lambda xs, us: ((xs - xs_true) ** 2).sum(),
        **fields,
    )
    solution = dd.solve(problem, method="shooting")
    found = solution.vector.to_dict()
    assert set(found) == set(truth)
    assert np.array_equal(solution.parameters, np.concatenate([found[name] for name in start]))
    assert np.array_equal(problem.parameters.values, np.concatenate([np.atleast_1d(v) for v in start.values()]))
    return solution, found


def is_recovered(found, truth):
    return all(
        np.all(np.abs(found[n] - value) <= RECOVERED * np.abs(value).max())
        for n, value in ((n, np.atleast_1d(v)) for n, v in truth.items())
    )


def all_recovered(outcomes, *, certified=True):
    """Check that all `outcomes` (solution, found, truth) by seed are recovered and reported as converged.

    If not `certified`, steps in contact may be too inaccurate for a certificate, which the status shows.
    """
    missed = {seed: (s.status, f, t) for seed, (s, f, t) in outcomes.items() if not is_recovered(f, t)}
    assert not missed
    accepted = {Status.CONVERGED} if certified else {Status.CONVERGED, Status.CONVERGED_NOT_VERIFIED}
    assert {seed: s.message for seed, (s, _, _) in outcomes.items() if s.status not in accepted} == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "parameter", "size"),
    [
        ("pendulum.urdf", "pole.mass", 2.0),
        pytest.param("acrobot.xml", "lower.mass", 1.0, marks=pytest.mark.slow),
    ],
)
def test_a_hidden_mass(load, name, parameter, size):
    model = load(name, time_step=0.02)
    value = next(p.value[0] for p in dd.list_parameters(model) if p.name == parameter)
    outcomes = {}
    for seed in SEEDS:
        random = np.random.default_rng(seed)
        truth = value * within_a_factor_of_two(random)
        start = truth * within_a_factor_of_two(random)
        us = size * np.ones((50, 1)) * np.sin(0.1 * np.arange(50) + random.uniform(0, 6))[:, None]
        x0 = random.uniform(-1, 1, model.nx)
        outcomes[seed] = (*recover(model, x0, us, {parameter: truth}, {parameter: start}), {parameter: truth})
    all_recovered(outcomes)


def sliding_ball(approximation):
    """Build a ball that slides on the ground. It is free in z under lagged, else fixed at its static height.

    Under sap and similar a fast slide lifts a free ball (Drake's convex approximation). The ball hops, and the
    distance of two motions jumps with the friction, so that a gradient method fails.
    """
    made = Plant(0.01, approximation)
    properties = contact_properties(2e4, dissipation=5.0, friction=0.5, relaxation_time=0.01)
    if approximation == "lagged":
        made.ball("ball", 1.0, 0.1, properties, "z", "x")
        made.ground(properties)
        return made.model(), [0.1 - G / 1e4, 0.0]
    made.ball("ball", 1.0, 0.1, properties, "x")
    ground = made.plant.world_body()
    made.plant.RegisterCollisionGeometry(ground, RigidTransform([0, 0, G / 1e4 - 0.1]), HalfSpace(), "g", properties)
    return made.model(), [0.0]


@pytest.mark.slow
@pytest.mark.parametrize("approximation", ["lagged", "sap", "similar"])
def test_a_hidden_friction(approximation):
    """The friction of a sliding ball is recovered, although the ball may stop with the initial guess."""
    (model, rest), outcomes = sliding_ball(approximation), {}
    for seed in SEEDS:
        random = np.random.default_rng(seed)
        truth = {"ball.friction": 0.4 * within_a_factor_of_two(random)}
        start = {"ball.friction": truth["ball.friction"] * within_a_factor_of_two(random)}
        speed = random.uniform(0.8, 2.0) * random.choice([-1, 1])
        x0 = [*rest, *np.zeros(len(rest) - 1), speed]
        outcomes[seed] = (*recover(model, x0, np.zeros((15, 0)), truth, start), truth)
        slowed = dd.rollout(model, x0, num_steps=15, parameters=truth).xs[-1, -1]
        assert abs(slowed) < abs(speed) - 0.1
    all_recovered(outcomes, certified=False)


def gimbal():
    """Build a body on three actuated hinges about x, y and z, all through its centre of mass."""
    made = Plant(0.02)
    plant, parent = made.plant, made.plant.world_frame()
    for name, axis in zip("abc", np.eye(3), strict=True):
        inertia = SpatialInertia.SolidSphereWithMass(0.1, 0.1)
        if name == "c":
            inertia = SpatialInertia.MakeFromCentralInertia(1.0, np.zeros(3), RotationalInertia(0.2, 0.25, 0.3))
        body = plant.AddRigidBody(name, inertia)
        hinge = plant.AddJoint(RevoluteJoint(f"hinge_{name}", parent, body.body_frame(), axis))
        plant.AddJointActuator(f"motor_{name}", hinge)
        parent = body.body_frame()
    return made.model()


@pytest.mark.slow
def test_a_hidden_inertia():
    """All six entries are recovered from a guess with errors in each log-Cholesky coordinate, and are physical."""
    model, outcomes = gimbal(), {}
    for seed in SEEDS:
        random = np.random.default_rng(seed)
        z = to_log_cholesky(np.array([0.2, 0.25, 0.3, 0, 0, 0]))
        true_z = z + np.concatenate([random.uniform(-0.3, 0.3, 3), random.uniform(-0.1, 0.1, 3)])
        start_z = true_z + np.concatenate([random.uniform(-0.3, 0.3, 3), random.uniform(-0.1, 0.1, 3)])
        truth, start = ({"c.inertia": from_log_cholesky(each)} for each in (true_z, start_z))
        us = 0.5 * np.sin(0.2 * np.arange(50)[:, None] + random.uniform(0, 6, 3))
        x0 = np.concatenate([random.uniform(-0.5, 0.5, 3), random.uniform(-1, 1, 3)])
        outcomes[seed] = (*recover(model, x0, us, truth, start), truth)
        assert room_of_inertia(outcomes[seed][1]["c.inertia"]) > 0
    all_recovered(outcomes)


def test_a_parameter_stops_at_its_bound(write_urdf):
    """The truth, 2 kg, is outside the bounds, so that the bound nearest to it is optimal."""
    model = write_urdf(mass=1.0)
    us = np.ones((10, 1))
    solution, found = recover(
        model, [0, 0], us, {"block.mass": 2.0}, {"block.mass": 1.0}, parameter_bounds={"block.mass": (0.5, 1.4)}
    )
    assert found["block.mass"][0] == pytest.approx(1.4, abs=1e-9)
    assert solution.success


@pytest.mark.parametrize(("count", "h", "weight"), [(20, 0.1, 0.3), (11, 0.05, 2.0)])
def test_controls_initial_state_and_parameters_together_at_a_known_optimum(write_urdf, count, h, weight):
    """The minimum of sum h u^2 + w v0^2 from x = 0 to (1, 0) has the lightest block and the least norm of (v0, u).

    It is a least-norm problem as x_N = N h v0 + (h^2 / m) sum (N - k) u_k and v_N = v0 + (h / m) sum u_k.
    """
    model, lightest = write_urdf(mass=1.0, time_step=h), 0.6
    problem = dd.Problem(
        model,
        x0=[0.0, 0.2],
        num_steps=count,
        optimize=("controls", "initial_state", "parameters"),
        initial_state_mask=np.array([False, True]),
        parameters={"block.mass": 1.3},
        parameter_bounds={"block.mass": (lightest, 2.0)},
        x_goal=[1.0, 0.0],
        running_cost=dd.QuadraticCost(R=[[1.0]]),
        trajectory_cost=lambda xs, us: weight * xs[0, 1] ** 2,
    )
    solution = dd.solve(problem, method="shooting")
    k = np.arange(count)
    rows = np.vstack([[count * h, *(h**2 / lightest * (count - k))], [1.0, *np.full(count, h / lightest)]])
    # The running cost is a multiple of u^2 that QuadraticCost defines.
    unit = float(problem.running_cost(np.zeros(2), np.ones(1)))
    inverse = 1 / np.array([weight, *np.full(count, h * unit)])
    best = inverse * (rows.T @ np.linalg.solve(rows * inverse @ rows.T, [1.0, 0.0]))
    assert solution.success, solution.message
    assert solution.vector.to_dict()["block.mass"] == pytest.approx([lightest], rel=1e-6)
    assert solution.xs[0] == pytest.approx([0.0, best[0]], rel=1e-5)  # the solver's tolerance is 1e-8 for squared costs
    assert solution.us.ravel() == pytest.approx(best[1:], rel=1e-4, abs=1e-4)
    assert solution.cost == pytest.approx(best @ (best / inverse), rel=1e-7)
