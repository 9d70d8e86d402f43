"""Engines other than Drake: which are installed, models that all of them support, and checks of their steps."""

from importlib.util import find_spec

import numpy as np
import pytest

import drake_diff as dd
from drake_diff.engines.formats import mjcf
from drake_diff.mechanics.description import describe
from drake_diff.model.tangent import tangent_space
from helpers.models import random_state

HAND = ["pendulum.urdf", "double_pendulum.urdf", "cart_pole.urdf", "mass_spring_damper.sdf", "projectile.sdf"]
HERE = [*HAND, "acrobot.xml"]
ROBOTS = ["panda.urdf", "ur5_robot.urdf", "solo12.urdf", "double_pendulum_continuous.urdf"]
G = 9.81


# The modules that an engine needs, and the extra that contains them. To import them only to find out whether they are
# installed would take seconds of the collection.
NEEDED = {
    "mujoco": (["mujoco"], "engines"),
    "pinocchio": (["pinocchio"], "engines"),
    "casadi": (["adam", "liecasadi"], "engines"),
    "mjx": (["jax", "mujoco.mjx", "mujoco"], "mjx"),
    "newton": (["newton"], "forward"),
    "sapien": (["sapien"], "forward"),
    "pybullet": (["pybullet"], "forward"),
}
BESIDE = {"ray": (["ray"], "cluster"), "rosbags": (["rosbags"], "ros2"), "usd": (["pxr"], "usd")}  # not engines


def needs(engine):
    """Skip the test, or the module that calls this, if the engine or the optional package is not installed."""
    modules, extra = (NEEDED | BESIDE).get(engine, ([], ""))
    if any(find_spec(module.split(".")[0]) is None or find_spec(module) is None for module in modules):
        pytest.skip(f"{engine} is not installed: pip install 'drake-diff[{extra}]'", allow_module_level=True)


def engine_of(name, model, **options):
    needs(name)
    return dd.engines.load_engine(name, model, **options)


def own_mjcf(name, tmp_path, model, *edits):
    """Load an engine with the MJCF of the model, in which the first match of each text is replaced."""
    text = mjcf(describe(model), model.time_step)
    for old, new in edits:
        assert old in text
        text = text.replace(old, new, 1)
    path = tmp_path / "own.xml"
    path.write_text(text)
    return engine_of(name, model, path=path)


class Doctored:
    """An engine with changed attributes."""

    def __init__(self, engine, **changes):
        self._engine = engine
        for name, value in changes.items():
            setattr(self, name, value)

    def __getattr__(self, name):
        return getattr(self._engine, name)


def free_state(model, random):
    """Return a random state inside the limits, with free bodies high up."""
    x = random_state(model, random)
    lower, upper = model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()
    for i in np.flatnonzero(np.isfinite(lower) & np.isfinite(upper)):
        x[i] = random.uniform(0.75 * lower[i] + 0.25 * upper[i], 0.25 * lower[i] + 0.75 * upper[i])
    if model.nq > model.nv:
        x[6] += 5.0
    return x


def on_tangent(model, A, x, x_next):
    space = tangent_space(model)
    return space.derivative_of_minus(x_next) @ A @ space.derivative_of_plus(x)


def assert_free_steps_agree(model, name, step, jacobian, *, states=5):
    """Check one step and its Jacobian (on the tangent space) to these tolerances, relative to the largest entry."""
    drake, other, random = dd.engines.load_engine("drake", model), engine_of(name, model), np.random.default_rng(2)
    for _ in range(states):
        x, u = free_state(model, random), random.standard_normal(model.nu)
        a, b = drake.step(x, u), other.step(x, u)
        np.testing.assert_allclose(b, a, rtol=0, atol=step * max(1, abs(a).max()))
        one, two = drake.differentiate_step(x, u), other.differentiate_step(x, u)
        A, A2 = on_tangent(model, one.A, x, a), on_tangent(model, two.A, x, b)
        np.testing.assert_allclose(A2, A, rtol=0, atol=jacobian * max(1, abs(A).max()))
        np.testing.assert_allclose(two.B, one.B, rtol=0, atol=jacobian * max(1, abs(one.B).max(initial=0)))
        np.testing.assert_allclose(other.energy(x), drake.energy(x), rtol=1e-12, atol=1e-12)
        assert other.contact_depth(x) == 0


def exponential_gap(x, x_next, h, q_start=0, w_start=7):
    """Return (4,) MuJoCo's quaternion after a step minus Drake's unit quaternion: exp(h w'), not 1 + h w' / 2.

    MuJoCo's is (cos, sin) of |h w'| / 2, and Drake's of arctan(|h w'| / 2), which is about |h w'|^3 / 24 less.
    """
    q, turn = x[q_start : q_start + 4], h * x_next[w_start : w_start + 3] / 2
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle else turn
    w, v = np.cos(angle) - np.cos(np.arctan(angle)), (np.sin(angle) - np.sin(np.arctan(angle))) * axis
    return np.concatenate([[w * q[0] - v @ q[1:]], w * q[1:] + q[0] * v + np.cross(v, q[1:])]) / np.linalg.norm(q)


def assert_free_bodies_differ_by_the_exponential(model, name, *, states=3):
    """Check that an engine with MuJoCo's step differs from Drake's step by the exponential map only."""
    drake, mujoco, random = dd.engines.load_engine("drake", model), engine_of(name, model), np.random.default_rng(3)
    space = tangent_space(model)

    def with_gap(x, u):
        a = np.array(drake.step(x, u))
        a[:4] = a[:4] / np.linalg.norm(a[:4]) + exponential_gap(x, a, model.time_step, 0, model.nq)
        return a

    for _ in range(states):
        x, u = free_state(model, random), random.standard_normal(model.nu)
        a, b = with_gap(x, u), mujoco.step(x, u)
        assert np.abs(b[:4] - drake.step(x, u)[:4]).max() > 1e-8  # the difference is not zero
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-12 * abs(a).max())
        one, two = drake.differentiate_step(x, u), mujoco.differentiate_step(x, u)
        A, A2 = on_tangent(model, one.A, x, drake.step(x, u)), on_tangent(model, two.A, x, b)
        # The rows of the rotation, by differences of Drake's step and the gap, are accurate to 1e-9.
        for i in range(len(A)):
            e = 1e-6 * np.eye(len(A))[i]
            ends = [space.minus(with_gap(space.plus(x, d), u), b)[:3] for d in (e, -e)]
            np.testing.assert_allclose(A2[:3, i], (ends[0] - ends[1]) / 2e-6, rtol=0, atol=1e-8)
