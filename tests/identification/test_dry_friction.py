"""Check Coulomb friction with sticking in `dd.identify`, with closed forms and then with motions from MuJoCo."""

import numpy as np
import pytest
from helpers.estimates import assert_known
from helpers.mujoco_arm import MuJoCoArm, bare_arm, drakes, shaken
from scipy import stats
from scipy.integrate import solve_ivp

import drake_diff as dd
from drake_diff.identification.motion import TreeMotion
from drake_diff.identification.sensors import choose_sensors
from drake_diff.identification.tree import tree_for_identification
from drake_diff.identification.unknowns import choose_unknowns
from drake_diff.model.tangent import tangent_space

pytestmark = pytest.mark.solve

MASS, FRICTION = 2.0, 0.3 * 2.0 * 9.81  # [kg], [N] for a block on a floor
H, N = 0.01, 180  # [s] between samples
NOISE = 1e-4  # [m]


def pushes(amplitude):
    """Return a sine of 0.9 Hz (N, 1), constant from each sample to the next [N]."""
    return amplitude * np.sin(2 * np.pi * 0.9 * H * np.arange(N))[:, None]


def sticks_and_slips(us, mass=MASS, friction=FRICTION):
    """Return the states (N + 1, 2) of a block from rest, which slides along parabolas, stops, and stays or moves on."""
    x, v, found = 0.0, 0.0, [(0.0, 0.0)]
    for push in us[:, 0]:
        left = H
        while left > 0 and (v != 0 or abs(push) > friction):
            way = np.sign(v) if v != 0 else np.sign(push)
            a = (push - way * friction) / mass
            stops = a * way < 0 and -v / a <= left
            t = -v / a if stops else left
            x, v, left = x + v * t + a * t**2 / 2, 0.0 if stops else v + a * t, left - t
        found.append((x, v))
    return np.array(found)


def measured(xs, us, seed=0):
    """Return a recording of positions with noise."""
    q = xs[:, 0] + NOISE * np.random.default_rng(seed).standard_normal(N + 1)
    seen = np.column_stack([q, np.full(N + 1, np.nan)])
    return dd.Recording("lab", "1", H * np.arange(N + 1), seen, us)


def test_a_block_that_sticks_and_slips_has_its_friction(write_urdf):
    us = pushes(9.0)
    xs = sticks_and_slips(us)
    assert np.mean(xs[:, 1] == 0) > 0.2  # the block sticks in a part of the samples
    model = write_urdf(mass=MASS)
    off = []
    for seed in range(3):
        e = dd.identify(model, measured(xs, us, seed=seed), ["slide.coulomb_friction"])
        assert e.explained, e.reason
        assert "Coulomb friction that sticks" in e.motion
        low, high = e.intervals["slide.coulomb_friction"]
        assert high - low < 0.005 * FRICTION
        off.append((e.values["slide.coulomb_friction"] - FRICTION) / ((high - low) / (2 * 1.96)))
    assert np.sum(np.square(off)) < stats.chi2.ppf(0.999, 3)  # three standard normal numbers


def test_a_block_that_comes_to_rest_and_stays_has_its_friction(write_urdf, tmp_path):
    us = np.where(np.arange(N)[:, None] < 30, 20.0, 0.0)
    us[120:] = 0.9 * FRICTION  # too little to move the block
    xs = sticks_and_slips(us)
    assert np.all(xs[-70:, 1] == 0)
    e = dd.identify(write_urdf(mass=MASS), measured(xs, us), ["slide.coulomb_friction"], held_out=0)
    assert_known(e, "slide.coulomb_friction", FRICTION, 0.01 * FRICTION)
    assert np.all(e.motions[0].xs[-60:, 1] == 0)  # the fitted block also stays at rest
    dd.save(e, tmp_path / "run")
    assert dd.verify(tmp_path / "run").holds  # verification repeats the fit


@pytest.mark.slow
def test_friction_that_creeps_is_not_sold_as_dry_friction(write_urdf):
    """With c tanh(v / 0.05 m/s), the block creeps where Coulomb friction would stick."""
    us, at = pushes(9.0), H * np.arange(N + 1)

    def rates(t, y):
        push = us[min(int(t / H + 1e-9), N - 1), 0]
        return [y[1], (push - FRICTION * np.tanh(y[1] / 0.05)) / MASS]

    xs = solve_ivp(rates, (0, at[-1]), (0, 0), t_eval=at, rtol=1e-8, atol=1e-10, max_step=H).y.T
    e = dd.identify(write_urdf(mass=MASS), measured(xs, us), ["slide.coulomb_friction"])
    assert not e.explained  # the creep is visible at noise of 0.1 mm


LINK = '<link name="{}"><inertial><mass value="{}"/>{}</inertial></link>'
JOINT = '<joint name="{}" type="prismatic"><parent link="world"/><child link="{}"/><axis xyz="1 0 0"/>{}</joint>'
SOLID = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
MOTOR = """<transmission><type>transmission_interface/SimpleTransmission</type><joint name="a">
  <hardwareInterface>EffortJointInterface</hardwareInterface></joint><actuator name="push"/></transmission>"""
LIMIT = '<limit effort="1e9"/>'


def sliders(folder):
    """Return a model of a slide and a second slide that follows the first with the ratio -0.4."""
    links = LINK.format("first", 2, SOLID) + LINK.format("second", 3, SOLID)
    follows = f'{LIMIT}<mimic joint="a" multiplier="-0.4" offset="0"/>'
    rails = JOINT.format("a", "first", LIMIT) + JOINT.format("b", "second", follows)
    (folder / "sliders.urdf").write_text(f'<robot name="sliders">{links}{rails}{MOTOR}</robot>')
    return dd.load_model(folder / "sliders.urdf", time_step=0.01, mimic="reduce")


def test_the_friction_of_a_joint_that_follows_another_holds_both(tmp_path):
    """The friction acts with the ratio -0.4, as does the link's mass: 2 + 0.16 * 3 kg, and 0.4 times the friction."""
    us = pushes(9.0)
    xs = sticks_and_slips(us, mass=2 + 0.4**2 * 3)
    e = dd.identify(sliders(tmp_path), measured(xs, us), ["b.coulomb_friction"])
    assert_known(e, "b.coulomb_friction", FRICTION / 0.4, 0.02 * FRICTION / 0.4)


def test_derivatives_go_through_a_stop_that_lets_another_joint_go(load):
    """Compare with differences in random steps of two joints that stop, reverse and release one after another."""
    model, random, count = load("double_pendulum.urdf"), np.random.default_rng(0), 300
    tree, names = tree_for_identification(model), ["shoulder.coulomb_friction", "elbow.coulomb_friction"]
    law = TreeMotion(model, tree, choose_unknowns(model, tree, names), 0.02)
    z, hs, us = np.full(2, 2.0), np.full((count, 1), 0.02), random.uniform(-4, 4, (count, 1, 2))
    starts = random.uniform(-1, 1, (count, 4)) * [1, 1, 0.3, 0.3]
    starts[::2, 3] = 0.0
    ends = law.run(z, starts, hs, us)
    (slopes,) = law.slopes(z, ends, hs, us)
    found = np.concatenate([slopes.by_x, slopes.by_z], axis=3)[:, 0]
    still = np.flatnonzero((ends[:, 1, 3] == 0) & (starts[:, 3] == 0))
    assert len(still) > 20  # the elbow sticks during the whole step
    compared = 0
    for i, step in enumerate(1e-7 * np.eye(6)):
        one, other = (law.run(z + s * step[4:], starts + s * step[:4], hs, us)[:, -1] for s in (1, -1))
        ahead, back = (one - ends[:, -1]) / 1e-7, (ends[:, -1] - other) / 1e-7
        rows = np.max(np.abs(ahead - back), axis=1) < 1e-4  # otherwise 1e-7 changes the order of stops
        rows &= (i != 3) | (starts[:, 3] != 0)  # at rest, the joint can slide to either side
        np.testing.assert_allclose(found[rows, :, i], (ahead + back)[rows] / 2, atol=1e-4)
        compared += int(np.sum(rows))
    assert compared > 0.9 * 5.5 * count


def test_readings_of_held_joints_are_those_of_joints_that_stand(load):
    """With one of two joints stuck, its link receives the sum of the friction and the motor torque."""
    model = load("double_pendulum.urdf")
    tree, names = tree_for_identification(model), ["elbow.coulomb_friction", "lower.mass", "elbow.offset"]
    unknowns = choose_unknowns(model, tree, names)
    law = TreeMotion(model, tree, unknowns, 0.01)
    columns = ("elbow.force", "lower.accel_x", "lower.accel_z", "shoulder.force")
    sensors = choose_sensors(model, tree, columns, None)
    q, v, u = np.array([[0.4, -0.3], [0.4, -0.3]]), np.array([[0.7, 0.0], [0.7, -0.9]]), np.array([[0.1, 0.2]] * 2)

    def read(z, q, v):
        return sensors.read(law.dynamics(unknowns.values(z)), np.hstack([q, v]), u)

    z = unknowns.z_start.copy()
    z[0] = 5.0
    dynamics = law.dynamics(unknowns.values(z))
    turn, held = dynamics.grip(np.hstack([q, v]), u)
    assert held.tolist() == [[0, 1], [0, 0]]
    assert turn.tolist() == [[0, 0], [0, -1]]
    by_x, by_z = sensors.slopes(tangent_space(model), dynamics, np.hstack([q, v]), u, law.by(z))
    free = np.array([[True, True, True, False], [True] * 4])  # a stuck joint has no independent velocity
    for j, step in enumerate(1e-6 * np.eye(4)):
        rows = free[:, j]
        ends = [read(z, q + s * step[:2], v + s * step[2:])[rows] for s in (1, -1)]
        np.testing.assert_allclose(by_x[rows, :, j], (ends[0] - ends[1]) / 2e-6, atol=1e-7, err_msg=str(j))
    for j, step in enumerate(1e-6 * np.eye(len(z))):
        ends = [read(z + s * step, q, v) for s in (1, -1)]
        np.testing.assert_allclose(by_z[..., j], (ends[0] - ends[1]) / 2e-6, atol=1e-7, err_msg=names[0])


def test_the_force_on_a_block_is_what_friction_leaves_of_the_push(write_urdf):
    model, push = write_urdf(mass=MASS), np.array([[9.0], [3.0], [9.0]])
    tree = tree_for_identification(model)
    unknowns = choose_unknowns(model, tree, ["slide.coulomb_friction"])
    law = TreeMotion(model, tree, unknowns, 0.01)
    x = np.array([[0, 0.5], [0, 0], [0, 0]])
    sensors = choose_sensors(model, tree, ("slide.force",), None)
    read = sensors.read(law.dynamics(np.array([FRICTION])), x, push)
    np.testing.assert_allclose(read[:, 0], [9 - FRICTION, 0, 9 - FRICTION], atol=1e-12)  # 3 N do not move the block


def test_a_step_in_which_a_block_stops_has_no_motion_after_it(write_urdf):
    model = write_urdf(mass=MASS)
    tree = tree_for_identification(model)
    law = TreeMotion(model, tree, choose_unknowns(model, tree, ["slide.coulomb_friction"]), 0.02)
    given = np.array([FRICTION]), np.array([[0.0, 0.02]]), np.full((1, 1), 0.02), np.zeros((1, 1, 1))
    (stopped,) = law.run(*given)[:, 1]
    np.testing.assert_allclose(stopped, [0.02**2 / 2 / (FRICTION / MASS), 0.0], atol=1e-12)


@pytest.mark.slow
def test_three_frictions_of_an_arm_that_mujoco_moved_are_found(tmp_path):
    """MuJoCo's `frictionloss` stops a joint within two of its steps, so the steps are short.

    With steps of 0.25 ms, the friction found is 0.05 % too low.
    """
    mujoco = pytest.importorskip("mujoco")
    path = bare_arm(tmp_path)
    model, random, noise = drakes(path), np.random.default_rng(7), 2e-4
    q0 = np.array([0.3, -1.2, 1.0, -0.5, 0.4, 0.2])
    us = shaken(model, q0, 150, 0.01, random)
    friction = np.append(random.uniform(0.1, 0.3, 3) * np.std(us, axis=0)[:3], np.zeros(3))
    q, v = MuJoCoArm(mujoco, path).move(q0, us, 0.01, friction=friction, step=2e-5)
    xs = np.hstack([q + noise * random.standard_normal(q.shape), np.full_like(v, np.nan)])
    log = dd.Recording("MuJoCo", mujoco.__version__, 0.01 * np.arange(151), xs, us)
    names = [f"{name.removesuffix('_q')}.coulomb_friction" for name in model.position_names[:3]]
    e = dd.identify(model, log, names, motion="continuous")
    assert e.explained, e.reason
    off = []
    for name, value in zip(names, friction, strict=False):
        low, high = e.intervals[name]
        assert high - low < 0.01 * value
        off.append((e.values[name] - value) / ((high - low) / (2 * 1.96)))
    assert np.sum(np.square(off)) < stats.chi2.ppf(0.999, 3), off  # three standard normal numbers
