"""Test verdicts on plans in continuous time and in another simulator against formulas of the motion.

Balls fall on springs with losses, and the plan is the motion of the discrete steps. SciPy integrates the motion in
continuous time from a formula of the force. Balls slide to rest over d = v^2 / (2 mu g) in MuJoCo, where one number
may be wrong.
"""

import re
import tempfile
from pathlib import Path

import numpy as np
from helpers.models import ball_on_ground
from scipy.integrate import solve_ivp
from trust import Figure

import drake_diff as dd
from drake_diff.engines.load import load_engine
from drake_diff.optimize.replay import STATE_TOLERANCE
from drake_diff.optimize.solution import Solution, Status
from drake_diff.runs.cross_check import WIDER, follower_of, replays_in

COUNT = 120
G, RADIUS, FREE = 9.81, 0.1, np.nan
CLEAR = 0.8  # errors between this part of the tolerance and its inverse are not counted
OFF = 0.2  # relative error of a number in MuJoCo
# Patterns of the numbers in the MJCF by quantity.
NUMBERS = {
    "friction": r'(pair [^>]*friction=")([0-9.e+-]+) ([0-9.e+-]+)',
    "stiffness": r'(pair [^>]*solref=")(-[0-9.e+-]+)',
    "mass": r'(body name="ball" [^>]*>\s*<inertial mass=")([0-9.e+-]+)',
    "gravity": r'(gravity="[0-9.e+-]+ [0-9.e+-]+ )(-[0-9.e+-]+)',
    "damping": r'(joint name="x" [^>]* damping=")([0-9.e+-]+)',
    "shapes": r'(geom name="ball[^>]* size=")([0-9.e+-]+)',
}


def measure(seed: int, count: int) -> list[Figure]:
    with tempfile.TemporaryDirectory() as folder:
        return _measured(np.random.default_rng(seed), count, Path(folder))


def _measured(random, count, folder):
    said = {True: [0, 0], False: [0, 0]}  # by the truth: right verdicts, all verdicts
    for _ in range(count):
        truth, held = fallen(random, folder)
        if truth is not None:
            said[truth][0] += held == truth
            said[truth][1] += 1
    told, motions, wrong, right = [0, 0], [0, 0], 0, 0
    for k in range(max(count // 2, 1)):
        quantity = [*NUMBERS, ""][k % (len(NUMBERS) + 1)]
        truth, row = slid(random, quantity, folder)
        if quantity:
            told[0] += any(c.where.startswith(f"{quantity}: ") for c in unlike(row)) and not row.holds
            told[1] += 1
        else:
            wrong += bool(unlike(row))
            right += 1
        if truth is not None:
            motions[0] += all(c.passes for c in row.checks if c.what != "model") == truth
            motions[1] += 1
    return [
        Figure("plans that do not hold in continuous time, told", *said[False], 0.99, True),
        Figure("plans that hold in continuous time, told", *said[True], 0.95, True),
        Figure("simulators one of whose numbers is 20 % off, told with its name", *told, 1.0, True),
        Figure("right simulators said to be others", wrong, right, 0.0, False),
        Figure(
            "slides in a simulator, right or not, judged by their motion as their formula says", *motions, 0.99, True
        ),
    ]


def unlike(row):
    """Return the checks for differences between a simulator's model and Drake's."""
    return [c for c in row.checks if c.what == "model"]


def given(model, x0, steps, goal):
    xs = dd.rollout(model, x0, num_steps=steps).xs
    end = xs[-1] if goal is None else np.array(goal)
    keep = np.isfinite(end) if goal is not None else np.array([False, True, False, False])
    asked = {"x_goal": np.where(keep, end, FREE), "optimize": "initial_state", "final_cost": lambda x: x[0]}
    problem = dd.Problem(model, x0=x0, num_steps=steps, **asked)
    return Solution(problem, "given", "none", Status.CONVERGED, "given", xs, np.zeros((steps, 0)))


def fallen(random, folder):
    """Return whether a plan holds in continuous time (None if near the tolerance), and the toolkit's verdict."""
    k, tau = 10 ** random.uniform(4.3, 6), float(random.choice([0.0, 10 ** random.uniform(-4, -2)]))
    h, fall = float(random.choice([0.005, 0.01, 0.02, 0.05])), random.uniform(0.02, 0.15)
    model = ball_on_ground(folder, time_step=h, stiffness=k, relaxation_time=tau)
    x0 = np.array([0.0, RADIUS + fall, 0.0, 0.0])
    steps = max(2, round(random.uniform(1.2, 3.0) * np.sqrt(2 * fall / G) / h))
    solution = given(model, x0, steps, None)
    height = by_formula(k / 2, 2 * tau, fall, steps * h)
    miss = abs(height + RADIUS - solution.xs[-1, 1])
    part = miss / (STATE_TOLERANCE * solution.plan.scale[1])
    rows = follower_of(solution.plan).in_continuous_time()
    return (None if CLEAR < part < 1 / CLEAR else bool(part <= 1)), any(row.holds for row in rows)


def by_formula(k, tau, fall, duration):
    """Return the height [m] of a 1 kg ball after a fall on a spring that never pulls: f = k (d + tau d')+, d > 0."""

    def rates(_, state):
        z, v = state
        push = max(0.0, k * (-z - tau * v)) if z < 0 else 0.0
        return [v, push - G]

    step = min(1e-4, 0.02 / np.sqrt(k))
    found = solve_ivp(rates, (0, duration), [fall, 0.0], method="RK45", max_step=step, rtol=1e-8, atol=1e-10)
    return found.y[0, -1]


def slid(random, quantity, folder):
    """Return whether a slide ends at its goal (None if near the tolerance or without a formula), and the replay."""
    mu, speed, h = random.uniform(0.2, 0.8), random.uniform(0.5, 2.0), float(random.choice([0.005, 0.01]))
    model = ball_on_ground(folder, time_step=h, stiffness=2e4, relaxation_time=0.01, friction=mu)
    steps = round(1.3 * speed / (mu * G) / h)
    distance = speed**2 / (2 * mu * G)
    x0 = [0.0, RADIUS - G / 1e4, speed, 0.0]
    solution = given(model, x0, steps, [distance, FREE, 0.0, FREE])
    engine = load_engine("mujoco", model, time_step=0.001)
    off = 1 + OFF * float(random.choice([-1, 1]))
    if quantity:
        text = planted(engine.mjcf, quantity, off)
        (folder / "other.xml").write_text(text)
        engine = load_engine("mujoco", model, path=folder / "other.xml")
    row = replays_in(follower_of(solution.plan), engine)[0]
    if quantity not in ("", "friction", "mass"):
        return None, row
    miss = abs(distance / (off if quantity == "friction" else 1.0) - distance)
    part = miss / (WIDER * STATE_TOLERANCE * solution.plan.scale[0])
    return (None if CLEAR < part < 1 / CLEAR else bool(part <= 1)), row


def planted(text, quantity, off):
    """Return the MJCF with a number 20 % off. A damping of 0 becomes OFF."""

    def changed(found):
        numbers = [float(number) for number in found.groups()[1:]]
        return found.group(1) + " ".join(repr(off * number if number else OFF) for number in numbers)

    text, times = re.subn(NUMBERS[quantity], changed, text)
    assert times == 1, quantity
    return text
