"""Whether `dd.explain` names what was changed in a model whose bodies touch: a sphere, a block, a box and a hopper.

    pip install -e '.[test]'
    python tests/benchmarks/identify_contact_causes.py [--seed 0] [--count 24]

Each case is a motion of 0.6 s, sampled every 10 ms, by Drake's steps of 5 or 2.5 ms, which are the model's too.
Positions have a noise of 0.1 mm and 0.5 mrad, velocities of 5 mm/s and 25 mrad/s. A sphere and a block are thrown onto
the ground, a pusher moves a box, and a controller lets a hopper land and hop by recorded torques. In every third case
nothing is changed, and anything that is named is a false alarm. Else one thing is, by 15 to 50 %: a friction,
stiffness, dissipation, radius (by 3 to 10 %), a mass, a damping, gravity along the vertical (by 5 to 20 %), or the
height of the ground (by 3 to 10 mm). A change that moves nothing by more than five times its noise is drawn anew.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import drake_diff as dd
from drake_diff._base.statistics import success_rate
from drake_diff.identification.chart import Chart
from drake_diff.mechanics.description import coordinates_of

MODELS = Path(__file__).parents[2] / "models"
ROBOTS = ("sphere_on_ground", "sliding_block", "hopper", "box_push")
STEPS = (0.005, 0.0025)  # [s]
PERIOD, SAMPLES = 0.01, 60
NOISE = {"length": 1e-4, "angle": 5e-4, "speed": 5e-3, "turn": 2.5e-2}  # [m, rad, m/s, rad/s]
SEEN = 5
KINDS = {
    "sphere_on_ground": ("ball.friction", "ground.friction", "ball.stiffness", "ball.dissipation", "ball.radius",
                         "ball_z.bias", "ball.mass", "model.gravity"),
    "sliding_block": ("block.friction", "ground.friction", "block.stiffness", "ground.dissipation", "block_z.bias",
                      "block.mass", "model.gravity"),
    "hopper": ("foot.friction", "foot.stiffness", "foot.radius", "z_x.bias", "body.mass", "foot.mass", "leg.damping",
               "model.gravity"),
    "box_push": ("box.stiffness", "pusher.radius", "box.mass", "pusher.mass", "bx.damping", "box.friction"),
}  # fmt: skip


def started(robot, model, random):
    """(first state, command(k, x)): a throw, or a controller whose torques are recorded."""
    x0 = model.default_state.copy()
    if robot in ("sphere_on_ground", "sliding_block"):
        x0[:4] = [1, 0, 0, 0]
        height = 0.13 if robot == "sphere_on_ground" else 0.09
        x0[4:7] = [0, 0, height + random.uniform(0, 0.03)]
        x0[7:10] = random.uniform(-2, 2, 3) if robot == "sphere_on_ground" else random.uniform(-0.5, 0.5, 3)
        x0[10:] = [random.uniform(0.6, 1.5), random.uniform(-0.3, 0.3), random.uniform(-0.8, -0.2)]
        return x0, lambda k, x: np.zeros(0)
    if robot == "hopper":
        x0[:] = [0, 0.5 + random.uniform(0, 0.03), 0.02, 0.4, random.uniform(0.1, 0.4), 0, 0, 0]
        push, when = random.uniform(3, 6), random.uniform(0.15, 0.25)

        def hop(k, x):
            wanted = 0.4 + 0.06 * np.sin(2 * np.pi * push * max(k * PERIOD - when, 0))
            return np.array([-40 * (x[2] - 0.02) - 4 * x[6], 12 + 300 * (wanted - x[3]) - 15 * x[7]])

        return x0, hop
    x0[:5] = [0.25, random.uniform(-0.08, 0.08), random.uniform(-0.3, 0.3), -0.05, 0]
    push, slide = random.uniform(4, 8), random.uniform(-1, 1)
    return x0, lambda k, x: np.array([push * (1 if k < 35 else -0.5), slide * np.cos(0.3 * k)])


def changed(model, name, random):
    """(parameters, bias by column): the value that is planted."""
    if name.endswith(".bias"):
        return {}, {name.rsplit(".", 1)[0]: random.choice([-1, 1]) * random.uniform(0.003, 0.01)}
    value = np.array({p.name: p.value for p in dd.list_parameters(model)}[name], dtype=float)
    low, high = {"radius": (0.03, 0.1), "gravity": (0.05, 0.2)}.get(name.rsplit(".", 1)[1], (0.15, 0.5))
    value = value * np.exp(random.choice([-1, 1]) * random.uniform(low, high))
    return {name: value if len(value) > 1 else float(value[0])}, {}


def moved(model, x0, us, parameters, bias):
    shift = np.zeros(model.nx)
    for column, value in bias.items():
        shift[model.state_names.index(column)] = value
    each = round(PERIOD / model.time_step)
    return dd.rollout(model, x0 - shift, np.repeat(us, each, axis=0), parameters=parameters).xs[::each] + shift


def led(model, x0, command, parameters, bias):
    """(n, nu) what the controller does on the model as it really is."""
    shift = np.zeros(model.nx)
    for column, value in bias.items():
        shift[model.state_names.index(column)] = value
    x, us = x0 - shift, []
    for k in range(SAMPLES):
        us.append(command(k, x + shift))
        for _ in range(round(PERIOD / model.time_step)):
            x = dd.step(model, x, us[-1], parameters=parameters)
    return np.array(us)


def scales(model):
    """(2 nv,) of the noise."""
    chart = Chart(coordinates_of(model))
    turns = np.zeros(model.nv, dtype=bool)
    for i, j in chart.coordinates.single:
        turns[j] = model.position_names[i].endswith("_q")
    for _, j in chart.coordinates.free:
        turns[j : j + 3] = True
    return chart, np.concatenate(
        [np.where(turns, NOISE["angle"], NOISE["length"]), np.where(turns, NOISE["turn"], NOISE["speed"])]
    )


def recorded(robot, step, is_changed, seed):
    random = np.random.default_rng(seed)
    model = dd.load_model(MODELS / f"{robot}.sdf", time_step=step)
    chart, size = scales(model)
    while True:
        x0, command = started(robot, model, random)
        name = str(random.choice(KINDS[robot])) if is_changed else ""
        parameters, bias = changed(model, name, random) if name else ({}, {})
        us = np.zeros((SAMPLES, 0)) if model.nu == 0 else led(model, x0, command, parameters, bias)
        xs = moved(model, x0, us, parameters, bias)
        apart = chart.minus(xs, moved(model, x0, us, {}, {})) / size
        if not name or np.max(np.sqrt(np.mean(apart**2, axis=0))) > SEEN:
            break
    measured = chart.plus(xs, size * random.standard_normal((len(xs), len(size))))
    log = dd.Recording("Drake", "1", PERIOD * np.arange(len(xs)), measured, us)
    return model, log, name, {**parameters, **bias}


def measure(robot, step, is_changed, seed):
    model, log, name, truth = recorded(robot, step, is_changed, seed)
    begin = time.process_time()
    w = dd.explain(model, log)
    seconds = time.process_time() - begin
    every = [w.names, *w.alternatives]
    if not name:
        verdict = "right" if w.explained and not w.names else "false alarm"
    elif w.names == (name,) and not w.alternatives:
        verdict = "named alone"
    elif (name,) in every:
        verdict = "named among alternatives"
    else:
        verdict = "another named" if w.names else "nothing" if w.explained else "not explained"
    inside = []
    if verdict.startswith("named"):
        within, value = np.atleast_2d(w.intervals[name]), np.atleast_1d(next(iter(truth.values())))
        known = np.isfinite(within).all(axis=1)
        inside = list(((within[:, 0] <= value) & (value <= within[:, 1]))[known])
    return verdict, inside, seconds, name, truth, w.sentence


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=24)
    given = parser.parse_args()
    verdicts, insides, times = {}, [], []
    for i in range(given.count):
        robot, step, is_changed = ROBOTS[i % 4], STEPS[i // 4 % 2], i // 4 % 3 != 2
        verdict, inside, seconds, name, truth, said = measure(robot, step, is_changed, 10000 * given.seed + i)
        verdicts.setdefault(is_changed, []).append(verdict)
        insides += inside
        times.append(seconds)
        told = f"{name} {np.round(next(iter(truth.values())), 5)}" if name else "nothing"
        missed = f", outside {inside.count(False)} of {len(inside)} intervals" if not all(inside) else ""
        print(f"{i:3} {robot:16} {1e3 * step:3g} ms {seconds:5.1f} s {verdict}{missed}: {told} -> {said}", flush=True)
    for is_changed, each in sorted(verdicts.items()):
        for verdict in sorted(set(each)):
            rate = success_rate(each.count(verdict), len(each))
            what, within = "changed" if is_changed else "right", f"{100 * rate.lower:.3g} to {100 * rate.upper:.3g} %"
            print(f"{what} models, {verdict}: {each.count(verdict)} of {len(each)} ({within})")
    print(f"intervals that have the truth: {sum(insides)} of {len(insides)}")
    print(f"processor time: {np.mean(times):.3g} s a recording, {max(times):.3g} s at most")


if __name__ == "__main__":
    main()
