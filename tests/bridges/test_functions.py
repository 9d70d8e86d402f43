"""Steps, rollouts and plans as functions of PyTorch and JAX have the derivatives of drake_diff."""

import gc
import sys
import warnings
from functools import partial
from importlib import import_module

import numpy as np
import pytest
from helpers.robots import example_robot, state_in_range
from helpers.table import slow_after

import drake_diff as dd
from drake_diff.bridges import plans, rollouts
from drake_diff.exceptions import (
    GradientError,
    GradientWarning,
    InputError,
    MissingDependencyError,
    NonFiniteError,
    ShapeError,
)
from drake_diff.motion import ParametricPolicy

pytestmark = pytest.mark.solve

SAME = 1e-10  # relative to the largest entry: the same Jacobians, multiplied in another order


def motions(model, *batch, steps=5, seed=0):
    random = np.random.default_rng(seed)
    x0 = [state_in_range(model, random) for _ in range(int(np.prod(batch)))]
    return np.reshape(x0, (*batch, model.nx)), random.standard_normal((*batch, steps, model.nu))


def assert_same(found, expected):
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=SAME * max(1.0, np.abs(b).max(initial=0)))


def test_a_steps_gradients_are_those_of_differentiate_step(library, load):
    model, weights = load("acrobot.xml"), np.array([1.0, -2.0, 3.0, 4.0])
    x, u = np.array([0.3, -0.2, 0.5, 1.0]), np.array([0.7])
    step = partial(library.functions.step, model)
    value, found = library.gradients(lambda x, u: (library.array(weights) * step(x, u)).sum(), x, u)
    d = dd.differentiate_step(model, x, u)
    assert value == pytest.approx(weights @ dd.step(model, x, u), rel=1e-14)
    assert_same(found, [weights @ d.A, weights @ d.B])


@pytest.mark.parametrize("name", ["cart_pole.urdf", "projectile.sdf"])
def test_a_batchs_gradients_are_those_of_differentiate_rollout(library, load, name):
    """The loss is the sum of the squares of all states and inputs, also by a mass of each rollout."""
    model = load(name)
    (x0, us), mass = motions(model, 2, 3), f"{'pole' if model.nu else 'ball'}.mass"
    masses = np.array([[1.0, 1.1, 1.2], [1.3, 1.0, 1.0]])

    def loss(x0, us, masses):
        xs, inputs = library.functions.rollout(model, x0, us, parameters={mass: masses})
        return (xs**2).sum() + (inputs**2).sum()

    value, found = library.gradients(loss, x0, us, masses)
    values, expected = [], [np.empty(x0.shape), np.empty(us.shape), np.empty((2, 3))]
    for i in np.ndindex(2, 3):
        g = dd.differentiate_rollout(
            model, x0[i], us[i], lambda xs, us: (xs**2).sum() + (us**2).sum(), parameters={mass: masses[i]}
        )
        values.append(g.loss)
        expected[0][i], expected[1][i], expected[2][i] = g.by_x0, g.by_us, g.by_parameters[0]
    assert value == pytest.approx(sum(values), rel=1e-12)
    assert_same(found, expected)


def test_what_is_broadcast_has_the_sum_of_the_gradients(library, load):
    model = load("cart_pole.urdf")
    x0, us = motions(model, 3)
    gravity = np.array([0.0, 0.0, -9.0])

    def loss(x0, us, gravity):
        xs, _ = library.functions.rollout(model, x0, us, parameters={"model.gravity": gravity})
        return (xs**2).sum()

    _, found = library.gradients(loss, x0, us[0], gravity)
    g = dd.differentiate_rollout(model, x0, us[0], lambda xs, us: (xs**2).sum(), parameters={"model.gravity": gravity})
    assert_same(found, [g.by_x0, g.by_us.sum(axis=0), g.by_parameters.sum(axis=0)])


@pytest.mark.parametrize("name", ["ur5_robot.urdf", "solo12.urdf"])
def test_the_check_of_the_library_passes_in_free_motion(library, name):
    model = example_robot(name)
    x0, us = motions(model, steps=3)
    library.check(lambda x0, us: library.functions.rollout(model, x0, us)[0], (x0, us), 1e-6)


def test_the_check_of_the_library_passes_for_a_standing_robot(library):
    """Differences of Drake's steps contain the residual of its solver, 1e-6 of the momentum."""
    model = example_robot("go2.urdf", 0.002, feet=True, approximation="sap", leg=(0.0, 0.8, -1.6))
    x0 = dd.rollout(model, model.default_state, np.zeros((20, model.nu))).xs[-1]
    us = 0.1 * np.random.default_rng(0).standard_normal((1, model.nu))
    assert dd.certify(model, x0, us[0]).verdict == "agree"
    library.check(lambda x0, us: library.functions.rollout(model, x0, us)[0], (x0, us), 1e-4, eps=1e-6)


def test_the_gradient_of_a_policy_is_that_of_a_parametric_policy(library, load):
    model = load("cart_pole.urdf")
    x0, _ = motions(model, 3)
    weights = np.array([0.5, -1.0, 0.3, 0.2])

    def loss(x0, weights, mass):
        policy = lambda x, t: library.tanh(x @ weights)[..., None] + t  # noqa: E731  the formula below
        xs, us = library.functions.rollout(model, x0, policy=policy, num_steps=6, parameters={"pole.mass": mass})
        return (xs**2).sum() + (us**2).sum()

    value, found = library.gradients(loss, x0, weights, 1.2)
    g = dd.differentiate_rollout(
        model,
        x0,
        None,
        lambda xs, us: (xs**2).sum() + (us**2).sum(),
        policy=ParametricPolicy(lambda x, t, p: np.tanh(p[None] @ x) + t, weights),
        num_steps=6,
        parameters={"pole.mass": 1.2},
    )
    assert value == pytest.approx(g.loss.sum(), rel=1e-12)
    assert_same(found, [g.by_x0, g.by_policy.sum(axis=0), g.by_parameters.sum()])


def test_jacobians_are_computed_in_parts_and_only_before_the_last_state_of_the_loss(library, load, monkeypatch):
    model, lengths = load("cart_pole.urdf"), []
    x0, us = motions(model, 5, steps=9)
    real = rollouts.linearize_steps
    monkeypatch.setattr(rollouts, "linearize_steps", lambda s, *a, **k: lengths.append(len(s)) or real(s, *a, **k))
    monkeypatch.setattr(rollouts, "MOST_NUMBERS", 2 * 9 * 4 * 5)  # two rollouts of 9 steps
    _, found = library.gradients(lambda x0, us: (library.functions.rollout(model, x0, us)[0][:, 3] ** 2).sum(), x0, us)
    assert lengths == [6, 6, 3]
    g = dd.differentiate_rollout(model, x0, us, lambda xs, us: (xs[3] ** 2).sum())
    assert_same(found, [g.by_x0, g.by_us])
    lengths.clear()
    library.gradients(lambda x0: (library.functions.rollout(model, x0, us)[0][:, 0] ** 2).sum(), x0)
    assert lengths == []


def test_a_gradient_in_continuous_time_warns_of_a_loss_without_a_slope(library, load):
    model = load("sphere_on_ground.sdf")
    x0 = np.array([1.0, 0, 0, 0, 0, 0, 0.2964, 0, 0, 0, 0, 0, 0])  # it touches just at the end, or not

    def loss(x0):
        xs, _ = library.functions.rollout(model, x0, np.zeros((20, 0)), method="continuous")
        return xs[-1, 12]

    with pytest.warns(GradientWarning, match=r"no slope.*ball_z\[0\]"):
        _, found = library.gradients(loss, x0)
    with warnings.catch_warnings(action="ignore"):
        g = dd.differentiate_rollout(model, x0, None, lambda x: x[12], num_steps=20, method="continuous")
    assert_same(found, [g.by_x0])


def test_certify_warns_of_a_step_without_a_derivative_and_of_no_other(library, load):
    model = load("sphere_on_ground.sdf", time_step=0.005)
    (z, vz), flying = (model.state_names.index(name) for name in ("ball_z", "ball_vz")), model.default_state
    touching = flying.copy()
    flying[z], touching[z], touching[vz] = 0.3, 0.1, -1.0

    def loss(x):
        return library.functions.step(model, x, certify=True)[..., vz].sum()

    with pytest.warns(GradientWarning, match="1 of 2 steps have no certified derivative: step 0 of rollout 1 discont"):
        library.gradients(loss, np.array([flying, touching]))
    with warnings.catch_warnings():
        warnings.simplefilter("error", GradientWarning)
        library.gradients(loss, flying)


# ---- plans -----------------------------------------------------------------------------------------------------------


def reach(load, **changes):
    effort = dd.QuadraticCost(R=[[1.0]])
    given = {"x0": [0.1, 0], "x_goal": [0.5, 0], "num_steps": 20, "running_cost": effort}
    return dd.Problem(load("pendulum.urdf", time_step=0.05), **given | changes)


@pytest.mark.parametrize("method", slow_after(1, ["collocation", "shooting"]))
def test_a_plans_gradients_are_its_sensitivities(library, load, method):
    problem, masses = reach(load), np.array([1.0, 1.2])
    x0, goal = np.array([0.1, 0.0]), np.array([0.5, 0.0])

    def loss(x0, goal, masses):
        plan = library.functions.solve(problem, {"x0": x0, "goal": goal, "pole.mass": masses}, method=method)
        return (plan.cost + plan.xs[..., 10, 0] + 2 * plan.us[..., 3, 0] + plan.horizon).sum()

    value, found = library.gradients(loss, x0, goal, masses)
    values, rows = [], {"x0": [], "goal": [], "pole.mass": []}
    for mass in masses:
        solution = dd.solve(reach(load, parameters={"pole.mass": mass}), method=method)
        values.append(solution.cost + solution.xs[10, 0] + 2 * solution.us[3, 0] + solution.times[-1])
        for by, of_plans in rows.items():
            s = dd.sensitivity(solution, by, certified=False)
            of_plans.append(s.cost + s.xs[10, 0] + 2 * s.us[3, 0])
    assert value == pytest.approx(sum(values), rel=1e-12)
    assert_same(found, [sum(rows["x0"]), sum(rows["goal"]), np.concatenate(rows["pole.mass"])])
    _, (by_mass,) = library.gradients(
        lambda mass: library.functions.solve(problem, {"pole.mass": mass}, method=method).cost, 1.2
    )
    assert by_mass == pytest.approx(s.cost[0], rel=SAME)  # of the last solution


def test_a_plan_at_a_corner_warns_and_an_unsolved_problem_is_refused(library):
    """For a limit of 6, the first input 6 is on its bound without force (see the tests of `sensitivity`)."""
    push = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1, u_lower=[-6.0], u_upper=[6.0])
    effort = dd.QuadraticCost(R=[[1.0]])
    problem = dd.Problem(push, x0=[0, 0], x_goal=[1, 0], num_steps=10, horizon=1.0, running_cost=effort)

    def cost(goal):
        return library.functions.solve(problem, {"goal": goal}).cost

    with pytest.warns(GradientWarning, match="valid on both sides"):
        library.gradients(cost, np.array([1.0, 0.0]))
    with pytest.raises(Exception, match=r"problem 1 of the batch was not solved: \w+: ") as caught:
        library.gradients(lambda goals: cost(goals).sum(), np.array([[0.9, 0.0], [100.0, 0.0]]))
    assert library.name == "jax" or isinstance(caught.value, GradientError)


@pytest.mark.parametrize("entry", [np.nan, np.inf])
def test_a_goal_that_is_not_finite_is_refused_where_the_problem_has_a_goal(library, load, entry):
    problem = reach(load, x_goal=[0.5, np.nan])
    assert library.functions.solve(problem, {"goal": [0.5, entry]}).xs.shape == (21, 2)
    with pytest.raises(NonFiniteError, match=r"goal\[0\]: expected a finite number"):
        library.functions.solve(problem, {"goal": [entry, 0.0]})


def test_a_batch_of_more_plans_than_are_remembered_is_solved_again_only_where_forgotten(library, load, monkeypatch):
    count, real = [], plans.solve
    monkeypatch.setattr(plans, "REMEMBERED", 2)
    monkeypatch.setattr(plans, "solve", lambda *a, **k: count.append(1) or real(*a, **k))
    x0 = np.array([[0.1, 0.0], [0.2, 0.0], [0.3, 0.0]])
    _, (found,) = library.gradients(lambda x0: library.functions.solve(reach(load), {"x0": x0}).cost.sum(), x0)
    assert len(count) == 3 + 1
    alone = [dd.sensitivity(dd.solve(reach(load, x0=x)), "x0", certified=False).cost for x in x0]
    assert_same([found], [np.array(alone)])


def test_a_second_plan_uses_the_cost_as_it_is_then(library, load):
    weights = [1.0]
    problem = reach(load, running_cost=lambda x, u: weights[0] * u[0] ** 2)
    first = float(library.functions.solve(problem, {"x0": [0.1, 0.0]}).cost)
    weights[0] = 2.0
    second = float(library.functions.solve(problem, {"x0": [0.1, 0.0]}).cost)
    assert second == pytest.approx(2 * first, rel=1e-6)  # the solver's tolerance


@pytest.mark.parametrize("options", [{}, {"initial_guess": (np.zeros((21, 2)), np.zeros((20, 1)))}])
def test_repeated_plans_do_not_stay_in_the_caches_of_the_library(library, load, options):
    problem = reach(load)
    for end in (0.5, 0.6):
        library.functions.solve(problem, {"goal": [end, 0.0]}, **options)
    if library.name == "jax" and not options:
        for end in (0.5, 0.6):
            library.jax.vmap(lambda goal: library.functions.solve(problem, {"goal": goal}).cost)(np.array([[end, 0.0]]))
    gc.collect()
    functions = [f for f in gc.get_objects() if type(f) is plans.PlanFunction and f.problem is problem]
    assert len(functions) <= (library.name == "jax" and not options)


def test_a_plan_whose_mesh_was_refined_is_refused(library, load):
    options = dd.optimize.Options(refine=True, error_tolerance=1e-12)
    with pytest.raises(Exception, match="the mesh was refined from 20 to "):
        library.gradients(
            lambda x0: library.functions.solve(reach(load), {"x0": x0}, method="collocation", options=options).cost,
            np.array([0.1, 0.0]),
        )


# ---- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("x0", "us", "mass", "error", "words"),
    [
        (np.zeros(3), np.zeros((5, 1)), 1.0, ShapeError, r"x0: expected shape \(..., 4\)"),
        (np.zeros(4), np.zeros(5), 1.0, ShapeError, r"us: expected shape \(..., N, 1\)"),
        (
            np.zeros((2, 4)),
            np.zeros((3, 5, 1)),
            1.0,
            InputError,
            r"x0, us, pole.mass: .* got leading dim",
        ),
        (np.zeros((2, 4)), np.zeros((5, 1)), np.ones(3), InputError, r"x0, us, pole.mass: .* got leading dim"),
    ],
)
def test_shapes_that_do_not_fit_are_refused_before_a_step(library, load, x0, us, mass, error, words):
    with pytest.raises(error, match=words):
        library.functions.rollout(load("cart_pole.urdf"), x0, us, parameters={"pole.mass": mass})


def test_what_is_left_out_is_refused_by_name(library, load):
    model, start = load("cart_pole.urdf"), np.zeros(4)
    for call, words in (
        (partial(library.functions.solve, reach(load), {}), "parameters: expected at least one value"),
        (partial(library.functions.rollout, model, start), r"us: expected shape \(N, 1\)"),
        (partial(library.functions.step, model, start), r"u: expected shape \(1,\)"),
        (
            partial(
                library.functions.rollout,
                model,
                np.zeros((0, 4)),
                np.zeros((5, 1)),
                parameters={"pole.mass": np.zeros(0)},
            ),
            "at least one entry in a batch",
        ),
    ):
        with pytest.raises(InputError, match=words):
            call()


def test_the_inputs_are_returned_with_the_leading_dimensions_of_the_states(library, load):
    model, x0 = load("cart_pole.urdf"), np.zeros((4, 4))
    policy = lambda x, t: library.array([0.3])  # noqa: E731
    for given in ({"us": np.zeros((3, 1))}, {"policy": policy, "num_steps": 3}):
        xs, us = library.functions.rollout(model, x0, **given)
        assert (tuple(xs.shape), tuple(us.shape)) == ((4, 4, 4), (4, 3, 1))


@pytest.mark.parametrize("shape", [(2,), (3, 1), ()])
def test_a_policy_whose_input_has_another_shape_is_refused(library, load, shape):
    with pytest.raises(ShapeError):
        library.functions.rollout(
            load("cart_pole.urdf"), np.zeros(4), policy=lambda x, t: library.array(np.ones(shape)), num_steps=3
        )


def test_inputs_and_a_policy_are_refused_together(library, load):
    with pytest.raises(InputError, match="got us and policy"):
        library.functions.rollout(load("cart_pole.urdf"), np.zeros(4), np.zeros((5, 1)), policy=lambda x, t: x[:1])


def test_a_second_derivative_is_refused(load):
    torch = pytest.importorskip("torch", reason="pip install 'drake-diff[torch]'")
    from drake_diff.torch import step

    x = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    with pytest.raises(GradientError, match="no second derivatives"):
        torch.autograd.grad(step(load("pendulum.urdf"), x, [0.0]).sum(), x, create_graph=True)


def test_single_precision_in_jax_is_refused_by_name(load):
    jax = pytest.importorskip("jax", reason="pip install 'drake-diff[jax]'")
    from drake_diff.jax import step

    with jax.enable_x64(False), pytest.raises(InputError, match="jax_enable_x64: expected double precision"):
        step(load("pendulum.urdf"), [0.0, 0.0], [0.0])


def test_vmap_gives_the_gradient_of_each(load):
    jax = pytest.importorskip("jax", reason="pip install 'drake-diff[jax]'")
    from drake_diff.jax import rollout

    model = load("cart_pole.urdf")
    x0, us = motions(model, 4)
    with jax.enable_x64(True):
        gradient = jax.grad(lambda x0, us, m: rollout(model, x0, us, parameters={"pole.mass": m})[0][-1, 1], (0, 1, 2))
        found = jax.jit(jax.vmap(gradient, in_axes=(0, 0, None)))(x0, us, 1.2)
    g = dd.differentiate_rollout(model, x0, us, lambda x: x[1], parameters={"pole.mass": 1.2})
    assert_same(map(np.asarray, found), [g.by_x0, g.by_us, g.by_parameters[:, 0]])


@pytest.mark.parametrize("name", ["torch", "jax"])
def test_a_missing_library_is_named_with_its_extra(monkeypatch, name):
    monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, f"drake_diff.{name}", raising=False)
    with pytest.raises(MissingDependencyError, match=rf"pip install 'drake-diff\[{name}\]'"):
        import_module(f"drake_diff.{name}")
