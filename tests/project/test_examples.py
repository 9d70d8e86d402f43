"""Tests that the examples do what their texts say."""

import dataclasses
import importlib.util
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from helpers.table import each_row, slow_after

import drake_diff as dd
from drake_diff.exceptions import GradientWarning, ModelWarning

pytestmark = pytest.mark.solve

EXAMPLES = Path(__file__).parents[2] / "examples"


def example(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def solved(module, problem=None):
    solution = dd.solve(module.problem() if problem is None else problem, **getattr(module, "solve_options", {}))
    assert solution.success, solution.message
    return solution


def test_the_cart_pole_swings_up_near_the_continuous_optimum():
    """From u = 0 the solution is the local optimum with cost 58.8077 N^2 s in continuous time (Hermite-Simpson at 50
    and 100 intervals). Another optimum has 57.9448. Semi-implicit Euler is of first order: 1 % at h = 0.02 s.
    """
    module = example("cart_pole_swing_up")
    solution = solved(module)
    assert solution.cost == pytest.approx(58.8077, rel=0.01)
    assert np.abs(solution.replay.xs[-1] - [1, np.pi, 0, 0]).max() < 1e-8  # in the simulation


@pytest.mark.slow
@pytest.mark.parametrize("vx", slow_after(1, [3.7, 0.3]))  # beyond the target and short of it
def test_the_projectiles_three_gradients_agree(vx):
    """The closed form is d loss / d vx = (x_T - 6) * 3.0 with x_T = 3 vx."""
    module = example("projectile_hits_target")
    model = dd.load_model(module.MODEL, time_step=module.TIME_STEP)
    by_hand = (3 * vx - 6) * 3.0
    loss, hand_built, end = module.hand_built(vx)
    gradient = dd.differentiate_rollout(model, module.launch(vx), None, module.loss, num_steps=module.NUM_STEPS)
    assert hand_built == pytest.approx(by_hand, rel=1e-12, abs=1e-12)
    assert gradient.by_x0[module.VX] == pytest.approx(by_hand, rel=1e-12, abs=1e-12)
    assert gradient.loss == pytest.approx(loss, rel=1e-12, abs=1e-12)
    assert gradient.xs[-1][[module.X, module.X + 2]] == pytest.approx(end, abs=1e-10)
    certificate = dd.certify_rollout(model, module.launch(vx), None, module.loss, num_steps=module.NUM_STEPS)
    certificate.require()


def test_the_projectile_lands_on_the_target():
    module = example("projectile_hits_target")
    solution = solved(module)
    assert solution.xs[0][module.VX] == pytest.approx(2.0, abs=1e-8)
    assert solution.xs[-1][module.X] == pytest.approx(6.0, abs=1e-8)
    assert solution.xs[-1][module.X + 2] == pytest.approx(0.0, abs=1e-9)  # back on the ground at the last step


def test_the_sphere_has_no_gradient_where_it_touches_and_one_elsewhere():
    module = example("sphere_on_ground")
    model = dd.load_model(module.MODEL, time_step=0.005)
    assert dd.certify(model, module.ball(0.3, vx=1, vz=-1)).verdict == "agree"
    assert dd.certify(model, module.ball(module.RADIUS - 0.003, vx=1, vz=-1)).verdict == "agree"
    assert dd.certify(model, module.ball(module.RADIUS, vx=1, vz=-1)).verdict == "discontinuous"


@pytest.mark.slow
def test_the_sphere_rolls_to_where_it_is_sent():
    module = example("sphere_on_ground")
    solution = solved(module)
    assert solution.xs[-1][module.X] == pytest.approx(1.0, abs=1e-5)
    assert 0 < solution.replay.penetration.max() < 0.02


@pytest.mark.slow
def test_the_ball_is_pushed_from_a_guess_that_never_touches_it():
    """The goal is a hard constraint: 1e-8 for the solver, 1e-5 for the package, on the plant's own rollout."""
    module = example("push_without_touching")
    solution = solved(module)
    assert solution.replay.xs[-1][module.BALL] == pytest.approx(module.GOAL, abs=1e-7)
    assert not solution.replay.contacts[0]


@pytest.mark.slow
def test_the_network_learns_to_balance():
    module = example("neural_network_policy")
    random = np.random.default_rng(1)
    model = dd.load_model(module.MODEL, time_step=module.TIME_STEP)
    untrained, starts, unseen = (
        module.first_parameters(random), module.initial_states(random, 4), module.initial_states(random, 10)
    )  # fmt: skip
    trained = module.train(model, untrained, starts)
    assert module.survivors(model, trained, unseen) > module.survivors(model, untrained, unseen)
    before, after = (module.loss_and_gradient(model, p, starts, 60)[0] for p in (untrained, trained))
    assert after < 0.1 * before


@pytest.mark.slow
def test_the_hidden_parameters_are_found():
    """The motion has no noise, so the only limit is the solver's tolerance."""
    module = example("hidden_parameters")
    model, x0, us = module.sliding()
    solution = dd.solve(
        module.problem(model, x0, us, {"ball.friction": 0.25}, {"ball.friction": 0.5}), method="shooting"
    )
    assert solution.vector.to_dict()["ball.friction"][0] == pytest.approx(0.25, rel=1e-4)


@pytest.mark.slow
def test_the_cart_pole_stands_again_after_pushes_and_how_fast_is_told():
    """The latency depends on the machine, so only the message is checked, with given latencies."""
    module = example("mpc_under_pushes")
    controller, problem, loop, steps = module.cart_pole()
    run = module.run((controller, problem, loop, steps))
    assert np.abs(problem.goal_error(run.motion.xs[-1])).max() < 0.02
    assert [event.kind for event in run.events] == ["push", "push"]
    assert "period 20 ms" in module.told("cart-pole", run, problem)
    for latencies, said in (
        ([0.01, 0.01, 0.01], ": in real time"),
        ([0.01, 0.01, 0.03], "in real time but for 1 of 3 steps"),
        ([0.05, 0.05, 0.05], "2.5 times slower than real time"),
    ):
        made_up = dataclasses.replace(run, latencies=np.array(latencies))
        assert module.told("cart-pole", made_up, problem).endswith(said)


@pytest.mark.slow
def test_the_panda_arrives_although_it_is_pushed(tmp_path):
    module = example("mpc_under_pushes")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # meshes of visuals are skipped
        case = module.panda(module.panda_file(tmp_path))
    run, problem = module.run(case), case[1]
    change = np.abs(np.diff(run.motion.xs[:, 7:], axis=0)).max(axis=1)
    assert change[20] > 10 * change[19]  # it is pushed at 0.4 s
    assert np.abs(problem.goal_error(run.motion.xs[-1])).max() < 1e-3
    assert np.all(np.abs(run.commands) <= problem.bounds.u_upper)


@pytest.mark.slow
@pytest.mark.long
def test_a_quadrotor_flies_through_its_gates_and_its_record_holds(tmp_path):
    """The plan and its replays pass each gate, also in finer steps, and verify builds the rotors again."""
    module = example("quadrotor_gates")
    solution = solved(module)
    for knot, gate in module.GATES.items():
        assert np.linalg.norm(solution.xs[knot, 4:7] - gate) <= module.OPENING
    finer = [
        r for r in solution.replays if r.holds and r.motion is not None and len(r.motion.us) > 2 * module.NUM_STEPS
    ]
    assert finer
    for replay in finer:
        parts = len(replay.motion.us) // module.NUM_STEPS
        for knot, gate in module.GATES.items():
            assert np.linalg.norm(replay.motion.xs[parts * knot, 4:7] - gate) <= module.OPENING
    assert np.all((solution.us >= 0) & (solution.us <= module.MOST))
    dd.save(solution, tmp_path / "run")
    assert [f["name"] for f in dd.load_record(tmp_path / "run").model.options["body_forces"]] == list(
        solution.problem.input_names
    )
    assert dd.verify(tmp_path / "run").verdict == "holds"


@pytest.mark.slow
def test_the_acrobot_stands_and_its_elbow_keeps_its_limit():
    """Check the plan. On the plant, with feedback and the shortest steps, its end is within 5 % of a turn."""
    module = example("acrobot_swing_up")
    solution = solved(module)
    assert solution.xs[-1] == pytest.approx(module.UPRIGHT, abs=1e-6)
    assert np.all(np.abs(solution.inputs_at_knots) <= module.STRONGEST)
    followed = max((r for r in solution.replays if r.control != "open loop"), key=lambda r: len(r.motion.us))
    assert followed.holds
    assert np.abs(followed.motion.xs[-1] - module.UPRIGHT)[:2].max() < 0.05 * 2 * np.pi


@pytest.mark.slow
def test_the_load_of_the_crane_sways_no_more_than_it_may():
    """All replays keep the limit too. Without the limit the load sways more, and the motion costs less."""
    module = example("crane_without_sway")
    solution, free = dd.solve(module.problem()), dd.solve(module.problem(np.pi))
    assert solution.success, solution.message
    assert free.success, free.message
    for replay in solution.replays:
        assert np.abs(replay.motion.xs[:, 1]).max() < module.SWAY + 2e-3  # [rad] the error of steps of 20 ms
        assert replay.motion.xs[-1] == pytest.approx([1, 0, 0, 0], abs=0.01)
    assert np.abs(free.xs[:, 1]).max() > 1.5 * module.SWAY
    assert free.cost < solution.cost


@pytest.mark.slow
@pytest.mark.long
def test_the_hand_of_the_panda_reaches_its_target_around_the_ball():
    """Drake's forward kinematics gives the hand's final position and the links' frames along the path."""
    module = example("panda_around_a_ball")
    solution = solved(module)
    model = solution.problem.model
    context = model.plant.CreateDefaultContext()
    near = module.BALL.radius + module.BALL.margin
    for x in solution.xs:
        model.plant.SetPositions(context, x[: model.nq])
        for i in range(1, 8):
            at = model.plant.GetBodyByName(f"panda_link{i}").EvalPoseInWorld(context).translation()
            assert np.linalg.norm(at - module.BALL.center) > near
    hand = model.plant.GetBodyByName("panda_hand").EvalPoseInWorld(context).translation()
    assert hand == pytest.approx(module.TARGET, abs=0.01)


@pytest.mark.slow
def test_the_pushed_cart_pole_stands_again():
    module = example("pushed_cart_pole")
    problem = module.problem()
    solution = solved(module, problem)
    stands = solution.xs[module.UP :] - [1, np.pi, 0, 0]
    assert np.abs(stands).max() < 0.05  # [m, rad, m/s, rad/s] it falls slightly and returns, without any force
    controller = dd.loop.MPC(problem, horizon=30, plan=solution)
    push = dd.loop.Push("pole", [0.3, 0, 0], 1.0)
    run = dd.loop.closed_loop(problem.model, controller, problem.x0, problem.num_steps, dd.loop.Loop(pushes=[push]))
    assert [event.kind for event in run.events if event.kind == "push"] == ["push"]
    assert np.abs(problem.goal_error(run.motion.xs[-1])).max() < 0.05


@pytest.mark.slow
def test_the_ball_bounces_into_its_target(capsys):
    module = example("bounce_into_target")
    module.main()
    text = capsys.readouterr().out
    assert text.startswith("converged")
    assert "on the ground from 0.60 to 0.62 s" in text  # only once


@pytest.mark.slow
def test_the_hopper_flies_and_stands_half_a_metre_on():
    module = example("hop_from_standing")
    solution = solved(module)
    end, flies = solution.replay.xs[-1], [not contacts for contacts in solution.replay.contacts]
    assert end[0] == pytest.approx(module.WAY, abs=1e-6)
    assert np.abs(end[4:]).max() < 1e-6
    assert flies[60]
    assert not flies[-1]


@pytest.mark.slow
def test_two_fingers_hold_the_box_up_by_its_sides():
    """At the end the box is carried only by two forces at its sides, within their friction cones."""
    module = example("grasp_and_lift")
    solution = solved(module)
    for found in solution.replay.contacts[-5:]:
        assert sorted(name for c in found for name in (c.body_a, c.body_b)) == ["box", "box", "left", "right"]
        for contact in found:
            across = abs(contact.normal[0])
            assert across > 0.99
            assert np.linalg.norm(contact.force[1:]) < 0.85 * abs(contact.force[0])  # friction of 0.8, plus the tilt
    assert solution.replay.xs[-1][1] == pytest.approx(module.HEIGHT, abs=0.01)  # the goal's tolerance


@pytest.mark.slow
def test_the_ball_flies_out_of_the_cup_into_its_target():
    """After the cup the ball has no contact and flies a parabola, in Drake's steps z = z_0 + v t - g t (t + h) / 2."""
    module = example("throw_into_target")
    solution = solved(module)
    xs, h = solution.replay.xs, module.TIME_STEP
    assert np.linalg.norm(xs[-1][3:5] - module.TARGET) < 0.05 * np.sqrt(2)  # 5 cm in x and in z
    flies = 1 + max(k for k, contacts in enumerate(solution.replay.contacts) if contacts)
    assert 0 < flies < len(xs) - 40
    t = h * np.arange(len(xs) - flies)
    place, velocity = xs[flies][3:5], xs[flies][9:11]
    parabola = place + np.outer(t, velocity) - np.outer(t * (t + h) / 2, [0, module.GRAVITY])
    assert np.allclose(xs[flies:, 3:5], parabola, atol=1e-9)
    assert np.linalg.norm(place - module.TARGET) > 0.5  # beyond the arm's reach from the release point


@pytest.mark.slow
@pytest.mark.long
@each_row("name, way", [("quadruped_jump", 0.06), ("quadruped_trot", 0.12)])
def test_the_quadruped_goes_as_its_schedule_says_and_its_record_holds(name, way, tmp_path):
    """By Drake's own kinematics, a foot is on the ground if the schedule says so, and above the ground if not."""
    module = example(name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        problem = module.problem()
    solution = solved(module, problem)
    model, knot = problem.model, 0
    context = model.plant.CreateDefaultContext()
    assert solution.xs[-1][4] == pytest.approx(way, abs=0.03)  # the goal's tolerance
    for steps, standing in module.schedule.phases:
        knot += steps
        model.plant.SetPositions(context, solution.xs[knot - steps // 2, : model.nq])
        for foot in module.FEET:
            body = model.plant.GetBodyByName(foot)
            height = model.plant.EvalBodyPoseInWorld(context, body).translation()[2] - 0.025  # the foot's radius
            assert (height < 1e-6) == (foot in standing)
    dd.save(solution, tmp_path / name)
    assert dd.verify(tmp_path / name, time_limit=600).verdict == "holds"


@pytest.mark.slow
@pytest.mark.long
def test_the_leg_that_is_designed_jumps_by_a_design_inside_its_bounds():
    """The design and its torques are found together. No length or stiffness is at a bound, and every replay jumps."""
    module = example("jumping_leg")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # about the linkage
        problem = module.problem()
    solution = solved(module, problem)
    lower, upper = problem.bounds_of_parameters()
    moves = upper > lower
    inside = (solution.parameters - lower)[moves] / (upper - lower)[moves]
    assert np.all((inside > 0.1) & (inside < 0.9))
    replays = [replay for replay in solution.replays if replay.control == "open loop"]
    assert all(replay.holds and replay.motion.xs[-1][0] > 0.5 for replay in replays)  # [m] half of the 1 m out of reach


@pytest.mark.slow
@pytest.mark.long
def test_the_policy_lands_and_rests_at_its_height_and_its_plan_can_be_verified(tmp_path):
    """The policy also lands from heights outside its training. The saved plan is its own motion, to the last input."""
    module = example("landing_policy")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GradientWarning)  # at one height, a contact begins at a knot
        weights = module.train(16)
    for height in module.DROPS + module.UNSEEN:
        assert module.fall(dd.rollout, weights, height).xs[-1][0] == pytest.approx(module.HEIGHT, abs=0.03)
    solution = dd.solve(module.problem(weights))
    assert solution.success, solution.message
    own = module.fall(dd.rollout, weights, module.DROPS[0])
    assert solution.us == pytest.approx(own.us, abs=1e-6)
    assert not own.contacts[0]  # in the air
    assert own.contacts[-1]  # on the ground
    dd.save(solution, tmp_path / "run")
    assert dd.verify(tmp_path / "run").verdict == "holds"


@pytest.mark.slow
@pytest.mark.long
def test_the_tossed_cube_has_its_published_size_and_is_predicted_better_than_by_hand(tmp_path, monkeypatch, capsys):
    """Half of the width of 104.8 mm is found to 1 %, from tosses whose free fall gives the scale of the cameras."""
    monkeypatch.chdir(tmp_path)
    module = example("tossed_cube")
    module.main()
    text = capsys.readouterr().out
    assert float(re.search(r"Half its width is ([\d.]+) mm", text)[1]) == pytest.approx(52.4, rel=0.01)
    metre = float(re.search(r"a recorded metre is ([\d.]+) m", text)[1])
    assert metre == pytest.approx(52.4 / 51.24, abs=0.01)  # from the height of its centre at rest
    by_hand, identified = (float(e) for e in re.findall(r"Tosses not used, .*?: ([\d.]+) %", text))
    assert identified < by_hand
    record = dd.load_record(tmp_path / "artifacts" / "tossed_cube" / "impacts")
    assert record.inputs.motion == "impacts"
    assert record.verdict == "fail"  # no cube of rigid spheres explains real impacts to the noise of the cameras
    assert dd.verify(tmp_path / "artifacts" / "tossed_cube" / "fall").holds


@pytest.mark.slow
def test_a_network_in_pytorch_pushes_a_ball_to_targets_that_it_was_not_trained_on():
    torch = pytest.importorskip("torch", reason="pip install 'drake-diff[torch]'")
    module = example("torch_push_policy")
    model, net = dd.load_model(module.MODEL, time_step=module.TIME_STEP), module.network()
    module.certify(model, net)  # raises if the derivative of a step does not agree
    losses = module.train(model, net)
    assert losses[-1] < 0.02 * losses[0]
    with torch.no_grad():
        xs, _ = module.push(model, net, module.UNSEEN)
    assert (xs[:, -1, module.BALL] - module.UNSEEN).abs().max() < 0.02  # m


@pytest.mark.slow
def test_jax_improves_the_gears_of_a_leg_by_the_slopes_of_its_optimal_motion():
    """The slopes are those of the heat of plans at other gears."""
    jax = pytest.importorskip("jax", reason="pip install 'drake-diff[jax]'")
    before = jax.config.jax_enable_x64
    try:
        module = example("jax_leg_design")  # sets double precision
        swing, first = module.problem(), np.log(module.FIRST)
        value, slopes = jax.value_and_grad(lambda logarithms: module.heat(swing, logarithms))(first)
        for i in range(2):
            ahead, behind = (module.heat(swing, first + sign * 1e-3 * np.eye(2)[i]) for sign in (1, -1))
            assert float(slopes[i]) == pytest.approx(float(ahead - behind) / 2e-3, rel=1e-4)
        assert float(module.heat(swing, np.log(module.improve(swing)))) < 0.25 * float(value)
    finally:
        jax.config.update("jax_enable_x64", before)


@pytest.mark.slow
def test_a_network_in_pytorch_learns_the_torque_that_a_model_does_not_have():
    torch = pytest.importorskip("torch", reason="pip install 'drake-diff[torch]'")
    module = example("torch_residual_force")
    model, net = dd.load_model(module.MODEL, time_step=module.TIME_STEP), module.network()
    losses = module.train(model, net, *map(torch.from_numpy, module.recordings(model)))
    assert losses[-1] < 4  # of the noise's square; the noise of the first state moves the whole motion
    assert np.abs(module.errors(net)).max() < 0.15  # N m, of 2.7
