"""Check that exchanged, mirrored and degree-valued columns of a recording are named, without the truth."""

import numpy as np
import pytest

import drake_diff as dd

pytestmark = pytest.mark.solve

PERIOD = 0.01


def recorded(model, q0, us, noise=1e-3, velocities=False, seed=0):
    """Return Drake's motion with steps of 0.1 ms under inputs (n, nu) constant for 10 ms, with encoder noise."""
    fine, start = model.at_time_step(PERIOD / 100), np.append(q0, np.zeros(model.nv))
    xs = dd.rollout(fine, start, np.repeat(us, 100, axis=0)).xs
    xs = xs[::100] + noise * np.random.default_rng(seed).standard_normal((len(us) + 1, model.nx))
    xs[:, model.nq :] += 9 * noise * np.random.default_rng(seed + 1).standard_normal((len(us) + 1, model.nv))
    if not velocities:
        xs[:, model.nq :] = np.nan
    return xs


def said(model, xs, us):
    return dd.explain(model, dd.Recording("lab", "1", PERIOD * np.arange(len(xs)), xs, us))


@pytest.fixture
def swung(load):
    """Return a double pendulum, its motion with velocities, and its inputs."""
    model, times = load("double_pendulum.urdf", time_step=0.005), PERIOD * np.arange(80)
    us = np.stack([1.5 * np.sin(5 * times + 0.5), 0.8 * np.cos(8 * times + 1)], axis=1)
    return model, recorded(model, [0.5, -0.3], us, velocities=True), us


@pytest.mark.slow
def test_exchanged_and_mirrored_columns_and_degrees_are_named(swung):
    model, xs, us = swung
    q, v, u = (*model.position_names,), (*model.velocity_names,), (*model.input_names,)
    other, degrees = np.array([1, -1, 1, -1]), np.array([180 / np.pi] * 2 + [1, 1])
    for mistaken, inputs, words in (
        (xs[:, [1, 0, 2, 3]], us, f"columns {q[0]} and {q[1]} are exchanged"),
        (xs[:, [1, 0, 3, 2]], us, f"columns {q[0]} and {q[1]} and {v[0]} and {v[1]} are exchanged"),
        (xs, us[:, ::-1], f"columns {u[0]} and {u[1]} are exchanged"),
        (xs * other, us, f"columns {q[1]} and {v[1]} have the opposite sign"),
        (xs * degrees, us, f"columns {q[0]} and {q[1]} have degrees, not radians"),
    ):
        w = said(model, mistaken, inputs)
        assert w.names == (words,), w
        assert w.explained
        assert w.alternatives == ()
        assert w.sentence == f"{words}: this explains the recording."


@pytest.mark.slow
def test_right_columns_are_not_named(swung):
    assert said(*swung).sentence == "Nothing: the model explains it."


def test_what_a_mirror_does_not_change_is_told_as_it_is(load):
    """A pendulum is symmetric: its mirrored angle also fits, and either sign explains a mirrored torque."""
    model, us = load("pendulum.urdf", time_step=0.005), np.zeros((100, 1))
    w = said(model, -recorded(model, [1.0], us), us)
    assert w.names == ()
    assert w.explained
    us = 3 * np.sin(0.05 * np.arange(100))[:, None]
    w = said(model, recorded(model, [1.0], us), -us)
    assert {w.names, *w.alternatives} == {
        (f"column {name} has the opposite sign",) for name in (model.position_names[0], model.input_names[0])
    }
    assert w.sentence.endswith("the recording cannot tell.")
