"""Tests of relaxed contact: inverse dynamics, their derivatives, the result of a stage, and the true plant's plan."""

import numpy as np
import pytest
from helpers.models import MODELS
from helpers.problems import push
from helpers.robots import example_robot, state_in_contact, state_in_range
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base.values import Refusal
from drake_diff.exceptions import InputError
from drake_diff.mechanics.coordinates import Coordinates
from drake_diff.model.tangent import tangent_space
from drake_diff.optimize import Options
from drake_diff.optimize.continuation import follow, read_relaxed_plant, relaxed_schedule
from drake_diff.optimize.ilqr.riccati import slope_along
from drake_diff.optimize.relaxed_contact import RelaxedSearch, Softness, between, relaxed_plant, slopes_of


def softness(plant, reach=0.02, force=20.0):
    return Softness(reach, np.full(len(plant.pairs.ids), force), 0.1, 0.2)


def in_contact(count, seed=1):
    """Return states of a Solo12 with its feet in contact, and velocities after the step that are not from a rollout."""
    model, random = example_robot("solo12.urdf", 0.01, feet=True, approximation="sap"), np.random.default_rng(seed)
    xs = np.array([state_in_contact(model, random) for _ in range(count)])
    q, v = xs[:, : model.nq], xs[:, model.nq :]
    return model, q, v, v + 0.1 * random.standard_normal(v.shape)


@each_row("name", ["solo12.urdf", "ur5_robot.urdf"])
def test_where_nothing_is_near_the_force_is_what_drakes_step_was_given(name):
    """In Drake's own step from a random state with random inputs, the motors apply the only forces."""
    random = np.random.default_rng(3)
    model = example_robot(name, 0.01, feet=name == "solo12.urdf", approximation="sap")
    plant = relaxed_plant(model)
    x, u = state_in_range(model, random, speed=0.1), 0.1 * random.uniform(-1, 1, model.nu)
    x_next = dd.step(model, x, u)
    nq = model.nq
    states = x[None, :nq], x[None, nq:], x_next[None, nq:]
    found = plant.forces(*states, softness(plant, reach=1e-4), slopes=False).tau[0]
    assert found == pytest.approx(plant.actuation @ u, abs=1e-8)  # of tens of N m: rounding of Drake's solver over h


def test_slopes_are_those_of_differences():
    model, q, v, v_next = in_contact(6)
    plant, tangent, step = relaxed_plant(model), tangent_space(model), 1e-6
    soft = softness(plant)

    def force(q, v, v_next):
        return plant.forces(q, v, v_next, soft, slopes=False).tau

    at = plant.forces(q, v, v_next, soft, slopes=True)
    assert at.tau == pytest.approx(force(q, v, v_next), abs=1e-10)
    for j in range(model.nv):
        d = np.zeros(tangent.size)
        d[j] = step
        moved = [np.array([tangent.plus(x, s * d) for x in np.hstack([q, v])])[:, : model.nq] for s in (1, -1)]
        e = d[: model.nv]
        for by, ahead, back in (
            (at.by_motion, (moved[0], v, v_next), (moved[1], v, v_next)),
            (at.by_v, (q, v + e, v_next), (q, v - e, v_next)),
            (at.by_next, (q, v, v_next + e), (q, v, v_next - e)),
        ):
            quotient = (force(*ahead) - force(*back)) / (2 * step)
            assert np.abs(by[:, :, j] - quotient).max() < 1e-8 * np.abs(by).max()


def test_a_ball_is_pushed_by_the_laws_own_formula(load):
    """The force is F log2(1 + exp(-phi / reach)) straight up at rest. tau is the weight minus this force."""
    model = load("sphere_on_ground.sdf", time_step=0.01)
    plant = relaxed_plant(model)
    x = np.array(model.default_state)
    heights = np.array([0.08, 0.1, 0.13, 0.5])
    q = np.tile(x[: model.nq], (4, 1))
    q[:, 6] = heights
    still = np.zeros((4, model.nv))
    tau = plant.forces(q, still, still, softness(plant, reach=0.02, force=5.0), slopes=False).tau
    (mass,) = (body.default_mass() for body in map(model.plant.GetBodyByName, ["ball"]))
    wanted = mass * 9.81 - 5.0 * np.log2(1 + np.exp(-(heights - 0.1) / 0.02))
    assert tau[:3, 5] == pytest.approx(wanted[:3], rel=1e-12)
    assert tau[3, 5] == pytest.approx(mass * 9.81, rel=1e-12)


def test_small_motions_between_positions_are_what_drakes_step_moves_by():
    coordinates, random = Coordinates(((0, 0),), ((7, 6),)), np.random.default_rng(0)
    q = random.standard_normal((5, 8))
    q[:, :4] /= np.linalg.norm(q[:, :4], axis=1)[:, None]
    d = 0.3 * random.standard_normal((5, 7))
    q_next = q + (coordinates.rate(q) @ d[..., None])[..., 0]
    assert between(coordinates, q, q_next)[0] == pytest.approx(d, abs=1e-14)
    first, second = slopes_of(coordinates, q, q_next)
    for j in range(7):
        e = np.zeros(7)
        e[j] = 1e-6
        for slope, move in ((first, lambda s, e=e: (q + s * coordinates.rate(q) @ e, q_next)),
                            (second, lambda s, e=e: (q, q_next + s * coordinates.rate(q_next) @ e))):  # fmt: skip
            quotient = (between(coordinates, *move(1))[0] - between(coordinates, *move(-1))[0]) / 2e-6
            assert slope[:, :, j] == pytest.approx(quotient, abs=1e-8)


def test_the_gradient_of_the_augmented_cost_is_that_of_differences():
    """The problem has a goal, input bounds, and multipliers of forces without motors. The motion is infeasible."""
    model, q, v, _ = in_contact(1)
    random, N = np.random.default_rng(0), 8
    x0 = np.concatenate([q[0], v[0]])
    goal = np.full(model.nx, np.nan)
    goal[4:7] = x0[4:7] + np.array([0, 0, 0.1])
    limit = np.full(model.nu, 0.1)
    problem = dd.Problem(
        model,
        x0=x0,
        num_steps=N,
        x_goal=goal,
        running_cost=dd.QuadraticCost(R=0.01 * np.eye(model.nu)),
        bounds=dd.Bounds(u_lower=-limit, u_upper=limit),
    )
    plant = relaxed_plant(model)
    search, soft = RelaxedSearch(problem, plant), softness(plant)
    still = np.tile(x0[: model.nq], (N + 1, 1))
    search._start(search.motion(still, soft))
    step = 0.01 * random.standard_normal((N + 1, model.nv))
    step[0] = 0.0
    at = search._moved(still, step)
    search.rest.multipliers = 0.1 * random.standard_normal(search.rest.multipliers.shape)
    quadratic, _ = search._expand(search.motion(at, soft), soft)
    dvs, moved = random.standard_normal((N, model.nv)), np.zeros((N + 1, 2 * model.nv))
    for k, (F, dv) in enumerate(zip(quadratic.F, dvs, strict=True)):
        moved[k + 1] = F @ np.concatenate([moved[k], dv])
    d = moved[:, : model.nv]
    merits = [search._merit(search.motion(search._moved(at, s * 1e-7 * d), soft)) for s in (1, -1)]
    slope, _ = slope_along(quadratic, moved, dvs)
    assert slope == pytest.approx((merits[0] - merits[1]) / 2e-7, rel=1e-6)


def test_least_effort_far_from_contact_is_the_closed_form(two_spheres):
    """For the pusher, sum u^2 with x_N = h^2 / m sum (N - k) u_k = d is at least d^2 m^2 / (h^4 sum (N - k)^2)."""
    h, N, distance = 0.02, 20, -0.3
    goal = np.full(4, np.nan)
    goal[0] = distance
    problem = push(two_spheres(damping=0), gap=1.0, goal=1.0, num_steps=N, x_goal=goal)
    plant = read_relaxed_plant(problem)
    search = RelaxedSearch(problem, plant)
    q = np.tile(problem.x0[:2], (N + 1, 1))
    found = search.run(q, softness(plant, reach=0.01), 50, lambda: False, lambda line: None)
    assert found.ended == "solved"
    squares = distance**2 / (h**4 * np.sum(np.arange(1, N + 1) ** 2.0))
    rate = problem.running_cost.R[0, 0]
    assert found.cost == pytest.approx(h * rate * squares, rel=1e-2)  # the goal is met to 1e-3 of 0.3 m


def test_the_true_plant_follows_what_was_rolled_out(two_spheres):
    problem = push(two_spheres(), gap=0.4, goal=1.0)
    us = np.full((problem.num_steps, 1), 2.0)
    xs = dd.rollout(problem.model, problem.x0, us).xs
    found, inputs = follow(problem, xs, us, 0.1)
    assert found == pytest.approx(xs, abs=1e-12)
    assert inputs == pytest.approx(us, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("time_step", "clearance"), [(0.01, 0.05), (0.05, None)])
def test_a_hopper_that_stands_gets_half_a_metre_on(time_step, clearance):
    """The guess is a line to the goal and stays on the ground. With a clearance on the way the hopper has to hop.

    At 20 ms it lands too deep for a plan that is verified, as a foot moves 4 cm in a step at 2 m/s.
    """
    model = dd.load_model(MODELS / "hopper.sdf", time_step=time_step)
    x0, goal, count = np.zeros(8), np.full(8, np.nan), round(1 / time_step)
    x0[1], x0[3] = 0.5, 0.45 + 12 / 2e4
    goal[[0, 1]], goal[4:] = 0.5, 0.0
    above = {} if clearance is None else {round(0.6 * count): {"z": 0.5 + clearance, "leg": 0.45}}
    cost = dd.QuadraticCost(R=1e-3 * np.eye(2), u_ref=[0, 10])
    near = {"z_x": 1e-3, "z_v": 1e-2}  # the hopper rises by a tenth of a millimetre
    problem = dd.Problem(
        model, x0=x0, x_goal=goal, num_steps=count, running_cost=cost, waypoints=above, goal_tolerance=near
    )
    solution = dd.solve(problem, options=Options(continuation="relaxed"), max_iterations=100)
    assert solution.success, solution.message
    assert any(not contacts for contacts in solution.replay.contacts) or clearance is None
    assert solution.replay.contacts[-1]


def test_what_has_no_relaxed_contact_is_refused_by_name(load, two_spheres):
    pendulum = dd.Problem(load("pendulum.urdf"), x0=[0, 0], num_steps=5, x_goal=[1, 0])
    with pytest.raises(InputError, match="no sphere of the model has a collision pair"):
        dd.solve(pendulum, method="ilqr", options=Options(continuation="relaxed"))
    free = push(two_spheres(), gap=0.4, goal=1.0, optimize=("controls", "initial_state"))
    with pytest.raises(InputError, match="free initial state"):
        dd.solve(free, method="ilqr", options=Options(continuation="relaxed"))
    hydroelastic = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.01, contact_model="hydroelastic")
    assert isinstance(relaxed_plant(hydroelastic), Refusal)
    assert "couplers" in relaxed_plant(example_robot("panda.urdf")).reason  # for its two fingers


def test_the_schedule_is_read_off_the_model(two_spheres):
    """The reach starts at the balls' radius, 0.1 m, and is halved per stage. The force is 1/3 of 0.5 kg's weight."""
    problem = push(two_spheres(), gap=0.3, goal=1.0)
    stages = relaxed_schedule(problem, read_relaxed_plant(problem))
    assert [stage.reach for stage in stages] == pytest.approx(0.1 / 2.0 ** np.arange(5), rel=1e-9)
    assert stages[0].force == pytest.approx([0.5 * 9.81 / 3], rel=1e-9)
