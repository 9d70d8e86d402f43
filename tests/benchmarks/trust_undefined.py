"""Count gradients in continuous time that are reported as undefined although a slope exists, and the converse.

The motions are difficult by design: a ball that may touch the ground just before the end, or pass another ball by 1e-5
to 1e-1 m or graze it; a rod and a box that fall flat or nearly flat. Boxes tumble, balls bounce many times, a slide
comes to rest close to the end, two balls collide centrally or off-centre, and the friction of a rolling ball reverses.
The truth is Drake's own continuous plant with error-controlled Runge-Kutta 3 (impact_truth.py). A slope exists if the
slopes over +-1e-2, 1e-3 and 1e-4 agree to 0.1 %. If only the last two agree, both a derivative within 1 % and
`undefined` are right.

Smoothed slopes are those of a ball that may touch the ground at the end. Their truth is an integral over the motions
event by event of helpers.bounces, which have no time step.
"""

import warnings
from math import pi, sqrt
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from helpers.bounces import RADIUS, Bounce
from impact_cases import INTERVAL, Case, Material, Mover, Obstacle
from impact_truth import FINER, NEARLY, WIDTHS, Motion, Slopes, slope
from pydrake.math import RollPitchYaw
from trust import Figure

import drake_diff as dd
from drake_diff.exceptions import DrakeDiffError, GradientError, GradientWarning
from drake_diff.motion.gradient import RolloutGradient

COUNT = 64
RIGHT = 0.01  # relative to the slope
SMALL = 1e-5  # [loss per unit of a column] slope that differences cannot distinguish from 0
TINY = 1e-3  # [loss per unit of a column] error of the integration over many bounces
SMOOTHED, SAMPLES = 2, 100  # every second case also has a smoothed slope
QUANTILE = 1.96
INTEGRAL = 1e-4  # error of the trapezoidal rule relative to a smoothed slope, if the loss has kinks
NODES = np.linspace(-6, 6, 801)  # nodes of the integral [standard deviations]


def material(random, mass, *, friction=None):
    """Return the material of each side of a contact. A pair is half as stiff."""
    return Material(
        random.uniform(0.1, 0.9) if friction is None else friction,
        2 * mass * 10 ** random.uniform(3, 4.7),
        float(random.choice([0.0, random.uniform(0, 1)])),
        random.uniform(0, 2.5e-3),
    )


def case(random, law, movers, x0, duration, of, columns, *, g=9.81, post=None):
    weights = tuple(float(i == of) for i in range(len(x0)))
    ground = Obstacle("ground", (), (0, 0, 0), (0, 0, 0), movers[0].material)
    obstacles = () if len(movers) == 2 else (post or ground,)
    steps = max(5, round(duration / INTERVAL))
    chosen = tuple(int(c) for c in random.choice(columns, min(2, len(columns)), replace=False))
    x0 = tuple(float(x) for x in x0)
    return Case(0, 0, "", law, movers, obstacles, (0.0, 0.0, -g), x0, steps, weights, None, chosen)


def law_of(random):
    return str(random.choice(["sap", "lagged", "similar"]))


def softer_law_of(random):
    """Return a law for long bouncing or tumbling, whose truth with sap takes minutes."""
    return str(random.choice(["lagged", "similar"]))


def gap_of(random):
    return float(random.choice([-1, 1]) * 10 ** random.uniform(-5, -1))


def touch(random):
    """Return a ball that is a random gap [m] above or below its contact at the end."""
    mass = 10 ** random.uniform(-1, 0.5)
    ball = Mover("ball", mass, (0.1,), 0.1, ((0, 0, 0),), material(random, mass), "xz")
    duration, vz = INTERVAL * int(random.integers(15, 60)), random.uniform(-2, 2)
    z = 0.1 + gap_of(random) - vz * duration + 9.81 * duration**2 / 2
    if z < 0.12:
        return touch(random)
    x0 = (0, z, random.uniform(-1, 1), vz)
    return case(random, law_of(random), (ball,), x0, duration, random.choice([0, 1, 3]), (1, 2, 3))


def passing(random):
    """Return a ball that passes or hits a fixed ball."""
    mass = 10 ** random.uniform(-1, 0.5)
    own = material(random, mass)
    ball = Mover("ball", mass, (0.1,), 0.1, ((0, 0, 0),), own, "xz")
    post = Obstacle("sphere", (0.1,), (0, 0, 0), (0, 0, 0), own)
    x0 = (-0.5, 0.2 + gap_of(random), random.uniform(1, 2), 0)
    return case(random, "lagged", (ball,), x0, 0.8, random.choice([0, 1, 2, 3]), (0, 1, 2, 3), g=0.0, post=post)


def many(random):
    mass = 10 ** random.uniform(-1, 0.5)
    ball = Mover("ball", mass, (0.1,), 0.1, ((0, 0, 0),), material(random, mass), "xz")
    x0 = (0, random.uniform(0.11, 0.2), random.uniform(-1, 1), 0)
    duration = random.uniform(0.8, 1.6)
    return case(random, softer_law_of(random), (ball,), x0, duration, random.choice([0, 1, 2]), (1, 2, 3))


def slide(random):
    """Return a block that comes to rest before, after or at the end."""
    mass = 10 ** random.uniform(-1, 0.5)
    own = material(random, mass)
    block = Mover("block", mass, (0.1,), 0.1, ((0, 0, 0),), own, "xz")
    duration, stop = 0.3, own.friction * 9.81 * 0.3
    v = stop * random.uniform(0.3, 1.5) if random.random() < 0.4 else stop + gap_of(random)
    x0 = (0, 0.1 - mass * 9.81 / (own.stiffness / 2), v, 0)
    return case(random, law_of(random), (block,), x0, duration, random.choice([0, 2]), (2, 0))


def flat(random):
    """Return a rod whose ends strike at nearly the same time, so that their order can change."""
    mass = 10 ** random.uniform(-0.5, 0.5)
    ends = ((-0.2, 0.0, 0.0), (0.2, 0.0, 0.0))
    rod = Mover("rod", mass, (0.4, 0.04, 0.04), 0.02, ends, material(random, mass))
    q = RollPitchYaw(0.0, float(random.choice([gap_of(random), random.uniform(-1, 1)])), 0.0).ToQuaternion().wxyz()
    spin = (0, float(random.choice([0.0, random.uniform(-2, 2)])), 0)
    x0 = (*q, 0, 0, random.uniform(0.25, 0.4), *spin, random.uniform(-0.5, 0.5), 0, random.uniform(-1, 0))
    law = law_of(random) if random.random() < 0.3 else softer_law_of(random)
    return case(random, law, (rod,), x0, random.uniform(0.3, 0.6), random.choice([4, 6, 8]), (6, 8, 10, 12))


def tumble(random):
    """Return a box, that of ORACLES D01 and others, with gravity from that of the Moon to that of the Earth."""
    mass, side = 10 ** random.uniform(-1, 0), random.uniform(0.08, 0.15)
    own = material(random, mass, friction=0.5)
    far = 0.49 * side
    corners = tuple((x, y, z) for x in (-far, far) for y in (-far, far) for z in (-far, far))
    box = Mover("box", mass, (side,) * 3, 0.01 * side, corners, own)
    angle = random.uniform(0, pi)
    spin = 3 * random.standard_normal(3) if random.random() < 0.5 else np.zeros(3)
    start = (0, 0, random.uniform(0.12, 0.25), *spin, 0, random.uniform(-0.5, 0.5), random.uniform(-2, 0))
    x0 = (np.cos(angle / 2), np.sin(angle / 2), 0, 0, *start)
    law, g = softer_law_of(random), random.uniform(1.5, 9.81)
    return case(random, law, (box,), x0, random.uniform(0.3, 0.9), random.choice([5, 6, 11]), (6, 7, 11, 12), g=g)


def hit(random):
    """Return two balls that collide centrally or off-centre, or just pass each other."""
    masses = 10 ** random.uniform(-0.5, 0.5, 2)
    own = material(random, float(min(masses)))
    balls = tuple(
        Mover(name, float(m), (0.1,), 0.1, ((0, 0, 0),), own, "xz") for name, m in zip("ab", masses, strict=True)
    )
    kind = random.integers(3)
    aside = (0.0, random.uniform(-0.19, 0.19), 0.2 + gap_of(random))[kind]
    x0 = (-0.4, aside, 0.0, 0.0, random.uniform(0.7, 2), 0, 0, 0)
    law = str(random.choice(["lagged", "similar"]))
    of = random.choice([0, 1, 4, 5, 7])
    return case(random, law, balls, x0, random.uniform(0.4, 0.8), of, (0, 1, 4, 5), g=0.0)


def roll(random):
    """Return a rolling ball whose spin reverses its motion, or nearly reverses it."""
    mass = 10 ** random.uniform(-0.5, 0.5)
    own = material(random, mass)
    ball = Mover("ball", mass, (0.1,), 0.1, ((0, 0, 0),), own)
    v = random.uniform(0.1, 1.0)
    spin = -v / 0.1 * (2.5 * random.uniform(0.5, 1.5))
    z = 0.1 - mass * 9.81 / (own.stiffness / 2)
    x0 = (1, 0, 0, 0, 0, 0, z, 0, spin, 0, v, 0, 0)
    return case(random, law_of(random), (ball,), x0, random.uniform(0.1, 0.5), random.choice([4, 8, 10]), (8, 10, 6))


KINDS = (touch, passing, many, slide, flat, tumble, hit, roll)


def slopes_of(one: Case) -> list[Slopes]:
    """Return the true slopes of the columns, with a finer integration if its error may cause a disagreement."""
    motion, found = Motion(one), []
    for column in one.columns:
        each = Slopes(column, 1.0, tuple(slope(one, motion, column, width) for width in WIDTHS))
        apart = abs(each.slopes[2] - each.slopes[1])
        if each.kind == "none" and apart < max(NEARLY * abs(each.slopes[1]), TINY):
            exact = Motion(one, FINER)
            each = Slopes(column, 1.0, tuple(slope(one, exact, column, width) for width in WIDTHS))
        found.append(each)
    return found


def judged(one: Case) -> tuple[RolloutGradient, set[int]]:
    """Return the gradient and the undefined columns of the case, and check that there is a warning."""
    model = one.model()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", GradientWarning)
        found = dd.differentiate_rollout(model, one.x0, None, one.loss, num_steps=one.num_steps, method="continuous")
    said = [str(each.message) for each in told if issubclass(each.category, GradientWarning)]
    assert bool(said) == bool(found.undefined)
    names = {each.column for each in found.undefined}
    return found, {c for c in one.columns if f"{model.state_names[c]}[0]" in names}


def smoothed(random, folder):
    """Return whether the 95 % interval of a smoothed slope covers the truth, or None without such a slope."""
    approximation = str(random.choice(["lagged", "sap"]))
    ball = Bounce(
        10 ** random.uniform(3, 4.5),
        relaxation_time=random.uniform(0, 5e-3) if approximation == "sap" else 0.0,
        dissipation=random.uniform(0, 0.5) if approximation == "lagged" else 0.0,
    )
    duration, v = 0.3, random.uniform(-1, 0.5)
    gap = random.choice([-1, 1]) * 10 ** random.uniform(-5, -2.5)
    start = np.array([RADIUS + gap - v * duration + 9.81 * duration**2 / 2, v])
    model = ball.model(folder / "bouncer.sdf", approximation, 0.01)
    with warnings.catch_warnings(action="ignore", category=GradientWarning):
        g = dd.differentiate_rollout(model, start, np.zeros((30, 0)), lambda x: x[1], method="continuous")
    if not g.undefined:
        return None
    one = g.undefined[int(random.integers(len(g.undefined)))]
    try:
        found = one.smooth(SAMPLES, seed=int(random.integers(1000)))
    except GradientError:
        return None
    width, unit = (
        float(np.asarray(found.noise.sigma)),
        np.eye(2)[[f"{n}[0]" for n in model.state_names].index(one.column)],
    )
    ends = np.array([ball.end(approximation, start + width * z * unit, duration)[1] for z in NODES])
    density = np.exp(-(NODES**2) / 2) / sqrt(2 * pi)
    exact = float(np.trapezoid(ends * NODES * density, NODES)) / width
    return abs(found.jacobian.item() - exact) <= QUANTILE * sqrt(found.variance.item()) + INTEGRAL * abs(exact)


def measure(seed, count):
    random, tally = np.random.default_rng(seed), {}

    def add(name, found, bound, at_least=False):
        tally.setdefault((name, bound, at_least), []).append(bool(found))

    with TemporaryDirectory() as folder:
        for i in range(count):
            one = KINDS[i % len(KINDS)](random)
            try:
                found, undefined = judged(one)
            except DrakeDiffError as error:
                print(f"  {KINDS[i % len(KINDS)].__name__}: {type(error).__name__}: {error}")
                add("cases that fail", True, 0.0)
                continue
            add("cases that fail", False, 0.0)
            for each in slopes_of(one):
                count_column(i, one, found, each, each.column in undefined, add)
            if i % SMOOTHED == 0:
                covers = smoothed(random, Path(folder))
                if covers is not None:
                    add("smoothed slopes within 1.96 standard errors of the truth", covers, 0.9, at_least=True)
    return [Figure(name, sum(found), len(found), bound, at_least) for (name, bound, at_least), found in tally.items()]


def count_column(i, one, found, each, is_undefined, add):
    number = float(found.by_x0[each.column])
    is_right = abs(number - each.best) <= RIGHT * abs(each.best) + each.doubt + SMALL
    kind = KINDS[i % len(KINDS)].__name__
    wrong = ""
    if each.kind == "exists":
        add("slopes that exist and are called undefined", is_undefined, 0.0)
        add("slopes that exist, given within 1 %", not is_undefined and is_right, 0.99, at_least=True)
        wrong = "called undefined" if is_undefined else "" if is_right else "wrong"
    elif each.kind == "none":
        add("columns without a slope that are called undefined", is_undefined, 0.99, at_least=True)
        wrong = "" if is_undefined else "given"
    else:
        add(
            "slopes below +-1e-2 alone, given within 1 % or called undefined",
            is_undefined or is_right,
            0.99,
            at_least=True,
        )
        wrong = "" if is_undefined or is_right else "wrong"
    if wrong:
        slopes, of = ", ".join(f"{s:.5g}" for s in each.slopes), one.weights.index(1.0)
        print(f"  {wrong}: {i} {kind} ({one.law}) column {each.column} of {of}: {number:.5g}, truth {slopes}")
