"""Count how often refinement agrees with a gradient that is wrong for the motion, and with one of a smooth motion.

Bounces: a ball of random mass falls from a random height on a floor of random stiffness, dissipation and relaxation
time, with random time steps, in each of Drake's approximations in turn. The truth is the same law event by event
(`helpers.bounces`), without time steps. An `agree` is false if an entry is more than 20 % off.

Smooth motions: pendulums and other models of this repository, arms and free bodies of example-robot-data, from random
states to a random goal. They have no contact and reach no limit. Each one that does not agree is a false alarm.
"""

import re
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from helpers.bounces import RADIUS, Bounce
from helpers.models import MODELS, robot_file
from helpers.robots import state_in_range
from trust import Figure

import drake_diff as dd
from drake_diff.exceptions import DrakeDiffError, ModelWarning

COUNT = 200
APPROXIMATIONS = ("sap", "lagged", "similar")
FALSE, NEGLIGIBLE = 0.2, 1e-3  # error relative to an entry, entry relative to the largest
RIGHT = 0.05  # a gradient with at most this error should agree
# File of this repository or of example-robot-data, the link to weld, and whether it has motors.
SMOOTH = (
    ("pendulum.urdf", None, True),
    ("double_pendulum.urdf", None, True),
    ("cart_pole.urdf", None, True),
    ("acrobot.xml", None, True),
    ("mass_spring_damper.sdf", None, True),
    ("projectile.sdf", None, True),
    ("ur5_robot.urdf", None, True),
    ("z1.urdf", None, False),
    ("xarm7.urdf", None, False),
    ("kinova.urdf", "base", False),
    ("finger_edu.urdf", "base_link", False),
    ("so100.urdf", "base", False),
    ("solo12.urdf", None, False),
    ("bolt.urdf", None, False),
    ("go2.urdf", None, False),
)


def bounce(random, index):
    """Return (ball, approximation, h, steps, start, weight of the last velocity in the loss, truth)."""
    while True:
        ball = Bounce(
            stiffness=10 ** random.uniform(2, 5),
            relaxation_time=0.0 if random.random() < 0.1 else 10 ** random.uniform(-3.5, -1),
            dissipation=0.0 if random.random() < 0.2 else random.uniform(0, 2),
            mass=10 ** random.uniform(-1, 1),
        )
        approximation, h = APPROXIMATIONS[index % 3], 10 ** random.uniform(-3.3, -2.0)
        start = (RADIUS + random.uniform(0.05, 1.0), random.uniform(-2, 1))
        fall = (start[1] + np.sqrt(start[1] ** 2 + 2 * 9.81 * (start[0] - RADIUS))) / 9.81
        steps = int((fall + random.uniform(0.05, 0.4)) / h)
        weight = random.choice([0.0, 0.0, 0.1, -0.3])
        truth, uncertain = ball.slopes(approximation, start, steps * h, lambda z, v, w=weight: z + w * v)
        if steps <= 600 and uncertain <= 0.01 * max(map(abs, truth)) and max(map(abs, truth)) > 1e-6:
            return ball, approximation, h, steps, start, weight, np.array(truth)


def bounces(random, count):
    """Return the bounces with a false agree, the number of right gradients, and the number of these that agree."""
    false, right, agreed = [], 0, 0
    with TemporaryDirectory() as folder:
        for index in range(count):
            ball, approximation, h, steps, start, weight, truth = bounce(random, index)
            model = ball.model(Path(folder) / "bouncer.sdf", approximation, h)
            certificate = dd.certify_rollout(
                model, start, None, lambda x, w=weight: x[0] + w * x[1], num_steps=steps, refine=True
            )
            found = certificate.derivative[0]
            size = np.maximum(np.abs(truth), NEGLIGIBLE * np.abs(truth).max())
            off = float((np.abs(found - truth) / size).max())
            right += off <= RIGHT
            agreed += off <= RIGHT and certificate.verdict == "agree"
            if certificate.verdict == "agree" and off > FALSE:
                false.append((ball, approximation, h, steps, start, weight, truth, found))
                print(f"  false agree: {false[-1]}: {certificate}")
    return false, right, agreed


def smooth_model(index, h, folder):
    """Load a robot without coupled joints, and without motors if its inputs would be too many."""
    name, weld, motors = SMOOTH[index % len(SMOOTH)]
    file = MODELS / name
    if not file.exists():
        text = re.sub(r"<mimic [^>]*/>", "", robot_file(name).read_text())
        file = folder / name
        file.write_text(text if motors else re.sub(r"<transmission.*?</transmission>", "", text, flags=re.DOTALL))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return dd.load_model(file, time_step=h, weld_base=weld)


def smooth_motion(random, model):
    """Return (x0, us) of 30 to 60 steps without contact and with no limit nearby."""
    lower, upper = model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()
    for _ in range(1000):
        steps, x0 = int(random.integers(30, 60)), state_in_range(model, random)
        us = np.cumsum(0.05 * random.standard_normal((steps, model.nu)), axis=0)
        motion = dd.rollout(model, x0, us)
        qs = motion.xs[:, : model.nq]
        if not any(motion.contacts) and np.all(qs > lower + 0.01) and np.all(qs < upper - 0.01):
            return x0, us
    raise RuntimeError(f"{model.name} reaches a limit, or touches something, from each of 1000 states")


def smooth(random, index, folder):
    """Return the name of the model and the certificate of one smooth motion to a random goal."""
    model = smooth_model(index, 10 ** random.uniform(-3.3, -2.3), folder)
    x0, us = smooth_motion(random, model)
    goal = x0 + 0.5 * random.standard_normal(model.nx)
    return model.name, dd.certify_rollout(model, x0, us, lambda x: ((x - goal) ** 2).sum(), refine=True)


def smooth_motions(random, count):
    """Return how many of `count` certificates of smooth motions agree."""
    agreed = 0
    with TemporaryDirectory() as folder:
        for index in range(count):
            try:
                name, certificate = smooth(random, index, Path(folder))
            except DrakeDiffError as error:
                print(f"  refused: {SMOOTH[index % len(SMOOTH)][0]}: {error}")
                continue
            agreed += certificate.verdict == "agree"
            if certificate.verdict != "agree":
                print(f"  does not agree: {name}: {str(certificate)[:800]}")
    return agreed


def measure(seed, count):
    random = np.random.default_rng(seed)
    false, right, agreed = bounces(random, count)
    return [
        Figure("bounces with a false agree", len(false), count, 0.0, at_least=False),
        Figure("bounces whose gradient is within 5 % that agree", agreed, max(right, 1), 0.5, at_least=True),
        Figure("smooth motions that agree", smooth_motions(random, count), count, 0.95, at_least=True),
    ]
