"""Recordings of robots in contact. In some of them, one parameter differs from the model's."""

from pathlib import Path

import numpy as np

import drake_diff as dd
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.tangent import tangent_space
from helpers.legged import LEGGED, legged_model, rest

MODELS = Path(__file__).parents[2] / "models"
DOGS = ("anymal", "go2", "solo12")
SOFTER = {"anymal": 0.5, "go2": 0.5, "solo12": 0.25}  # relative to the gains of a controller without a hold of 10 ms
FINER, MUJOCO = 5, 0.0005  # Drake's steps in one step of the model; [s] MuJoCo's step
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
for dog in DOGS:
    foot, base = LEGGED[dog].feet[1], LEGGED[dog].base
    KINDS[dog] = (
        *(f"{foot}.{quantity}" for quantity in ("friction", "stiffness", "dissipation", "radius")),
        *("world.friction", f"{base}_z.bias", f"{base}.mass", f"{foot}.mass", "model.gravity"),
    )


def made(robot, step):
    return legged_model(robot, step) if robot in DOGS else dd.load_model(MODELS / f"{robot}.sdf", time_step=step)


def started(robot, model, random):
    """Return (first state, command(k, x)) of a throw, or of a controller whose torques are recorded."""
    x0 = model.default_state.copy()
    if robot in DOGS:
        return squatting(robot, model, random)
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


def squatting(robot, model, random):
    facts, nq = LEGGED[robot], model.nq
    x0 = rest(robot, model, np.array(facts.high), random)
    held, way, drive = x0[nq - 12 : nq].copy(), np.array(facts.low) - np.array(facts.high), model.actuation[-12:]
    x0[6] += random.uniform(0.005, 0.03)
    x0[nq + 3 : nq + 6] += random.uniform(-0.2, 0.2, 3)
    kp, kd = SOFTER[robot] * np.array(facts.gains)
    deep, often = random.uniform(0.1, 0.3), random.uniform(1, 2)

    def squat(k, x):
        wanted = held + deep * (1 - np.cos(2 * np.pi * often * k * PERIOD)) / 2 * way
        return np.linalg.solve(drive, kp * (wanted - x[nq - 12 : nq]) - kd * x[-12:])

    return x0, squat


def changed(model, name, random):
    """Return (parameters, bias by column) with the changed value."""
    if name.endswith(".bias"):
        return {}, {name.rsplit(".", 1)[0]: random.choice([-1, 1]) * random.uniform(0.003, 0.01)}
    value = np.array({p.name: p.value for p in dd.list_parameters(model)}[name], dtype=float)
    low, high = {"radius": (0.03, 0.1), "gravity": (0.05, 0.2)}.get(name.rsplit(".", 1)[1], (0.15, 0.5))
    value = value * np.exp(random.choice([-1, 1]) * random.uniform(low, high))
    return {name: value if len(value) > 1 else float(value[0])}, {}


def moved(model, x0, command, parameters, bias, by="same"):
    """Return (states (n + 1, nx), inputs (n, nu)) of the controller on the model with the changed value."""
    shift = np.zeros(model.nx)
    for column, value in bias.items():
        shift[model.state_names.index(column)] = value
    fine = model.at_time_step(model.time_step / FINER) if by == "finer" else model
    engine = dd.engines.load_engine("mujoco", model, time_step=MUJOCO) if by == "mujoco" else None
    each = round(PERIOD / (MUJOCO if engine else fine.time_step))
    xs, us = [x0 - shift], []
    for k in range(SAMPLES):
        us.append(command(k, xs[-1] + shift))
        x = xs[-1]
        for _ in range(each):
            x = engine.step(x, us[-1]) if engine else dd.step(fine, x, us[-1], parameters=parameters)
        xs.append(x)
    return np.array(xs) + shift, np.array(us).reshape(SAMPLES, model.nu)


def scales(model):
    """Return the tangent space and the scales (2 nv,) of the noise."""
    coordinates = coordinates_of(model)
    turns = np.zeros(model.nv, dtype=bool)
    for i, j in coordinates.single:
        turns[j] = model.position_names[i].endswith("_q")
    for _, j in coordinates.free:
        turns[j : j + 3] = True
    return tangent_space(model), np.concatenate(
        [np.where(turns, NOISE["angle"], NOISE["length"]), np.where(turns, NOISE["turn"], NOISE["speed"])]
    )


def recorded(robot, step, is_changed, seed, by="same"):
    random = np.random.default_rng(seed)
    model = made(robot, step)
    space, size = scales(model)
    while True:
        x0, command = started(robot, model, random)
        name = str(random.choice(KINDS[robot])) if is_changed else ""
        parameters, bias = changed(model, name, random) if name else ({}, {})
        xs, us = moved(model, x0, command, parameters, bias, by)
        if not name:
            break
        apart = space.minus(xs, moved(model, x0, lambda k, x, us=us: us[k], {}, {}, by)[0]) / size
        if np.max(np.sqrt(np.mean(apart**2, axis=0))) > SEEN:
            break
    measured = space.plus(xs, size * random.standard_normal((len(xs), len(size))))
    log = dd.Recording("MuJoCo" if by == "mujoco" else "Drake", "1", PERIOD * np.arange(len(xs)), measured, us)
    return model, log, name, {**parameters, **bias}
