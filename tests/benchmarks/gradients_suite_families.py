"""The families of the suite of gradients: each system in words, its random numbers, and its final state.

`Family.end(p, T, tolerance)` returns the final state and the times of events. Each variable in `p` is an array (m,) of
complex numbers with the same real part, so that a branch depends on real parts alone.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

MARGIN = 0.05  # relative distance from the boundary between sliding and sticking
MOST = 5  # impacts
PARTS = 20  # steps at least: an event within a step must not be missed


class NearSwitchError(Exception):
    """The draw has no clear slope, as it is close to another kind of motion."""


@dataclass(frozen=True)
class Family:
    """A kind of system: `state`, `inputs` and `constants` are names of variables with units."""

    name: str
    group: str  # "impact" or "step"
    count: int
    statement: str
    state: dict[str, str]
    inputs: dict[str, str]
    constants: dict[str, str]
    draw: Callable
    end: Callable
    events: tuple[int, int] = (0, 0)  # the least and the largest number
    is_integrated: bool = False

    @property
    def units(self):
        return self.state | self.inputs | self.constants


FAMILIES = {}


def family(group, count, state, inputs, constants, statement, **options):
    """Register the decorated function as the end of a family, with its draw as the function of the same name."""

    def register(end):
        name, draw = end.__name__, DRAWS[end.__name__]
        units = [dict(pair.split(":") for pair in words.split()) for words in (state, inputs, constants)]
        FAMILIES[name] = Family(name, group, count, " ".join(statement.split()), *units, draw, end, **options)
        return end

    return register


def size(x):
    """The real part that all columns of a variable share."""
    return float(np.real(np.ravel(x)[0]))


def flow(modes, y, T, tolerance, mode=0):
    """Integrate y (n, m) through modes: `modes[i]` is (rates, exits), an exit (switch, next mode, reset).

    An exit is taken when its switch falls to 0. The first order correction by the complex time of the event is exact.
    """
    shape, t, times = np.shape(y), 0.0, []
    y = np.array(y, dtype=complex)
    while True:
        rates, exits = modes[mode]

        def integrate(y, t, end, events, rates=rates):
            f, step = lambda _, y: np.ravel(rates(y.reshape(shape))), T / PARTS if events else np.inf
            exactly = {"method": "DOP853", "rtol": tolerance, "atol": 1e-3 * tolerance, "max_step": step}
            return solve_ivp(f, (t, end), y.ravel(), events=events, **exactly)

        watched = [lambda _, y, g=g: size(g(y.reshape(shape))) for g, _, _ in exits]
        for each in watched:
            each.terminal, each.direction = True, -1
        found = integrate(y, t, T, watched or None)
        if found.status == 0:
            return found.y[:, -1].reshape(shape), times
        index = next(i for i, at in enumerate(found.t_events) if len(at))
        switch, mode, reset = exits[index]
        y = integrate(y, t, found.t[-1], None).y[:, -1].reshape(shape)  # more exact than the interpolant of the event
        t = found.t[-1]
        rate = np.array(rates(y))
        ahead = (switch(y.real + 1e-30j * rate.real) - switch(y.real + 0j)).imag / 1e-30  # a constant may be moved
        delay = -switch(y) / ahead
        y = reset(y + rate * delay)
        y = y - np.array(modes[mode][0](y)) * delay
        times.append(t)


def keep(y):
    return y


def near(share):
    """Raise an error if a share is close to 1."""
    if abs(abs(size(share)) - 1) < MARGIN:
        raise NearSwitchError


def sign(x):
    return 1.0 if size(x) > 0 else -1.0


DRAWS = {}


def draws(name, change=lambda numbers, random: {}, **ranges):
    """Register a family's uniform draws from (low, high). `change` returns further numbers; `T` is the duration."""

    def draw(random):
        numbers = {key: float(random.uniform(*each)) for key, each in ranges.items()}
        numbers |= change(numbers, random)
        return numbers, numbers.pop("T")

    DRAWS[name] = draw


def fall_time(n):
    return (n["vz"] + np.sqrt(n["vz"] ** 2 + 2 * n["g"] * (n["z"] - n["r"]))) / n["g"]


def bounce_time(n, random):
    return {"T": fall_time(n) * random.uniform(1.1, 5)}


draws("bounce", bounce_time, z=(0.1, 1.0), vz=(-3, 2), g=(2, 15), e=(0.4, 0.95), r=(0.01, 0.09))


@family(
    "impact", 20, "z:m vz:m/s", "", "g:m/s^2 e:1 r:m",
    """A ball of radius r moves along the vertical z under gravity g (downward). It strikes the rigid floor z = 0 with
    its lowest point, that is at z = r, and leaves it with -e times its speed, one or more times. z is the center.""",
    events=(1, MOST),
)  # fmt: skip
def bounce(p, T, tolerance):
    z, v, g, e, r = (p[k] for k in ("z", "vz", "g", "e", "r"))
    t, times = 0.0, []
    while True:
        speed = np.sqrt(v * v + 2 * g * (z - r))
        fall = (v + speed) / g
        if size(t + fall) > T:
            times.append(t + fall)  # the next one, which must be clear of the end
            break
        if len(times) == MOST:  # there may be infinitely many
            raise NearSwitchError
        z, v, t = r, e * speed, t + fall
        times.append(t)
    s = T - t
    return (z + v * s - g * s * s / 2, v - g * s), times


def disk_inertia(n, random):
    return {"I": random.uniform(0.3, 1.0) * n["m"] * n["r"] ** 2}


draws(
    "wall", disk_inertia, x=(0.3, 1), z=(-0.3, 0.3), q=(-1, 1), vx=(-4, -1.5), vz=(-2, 2), w=(-20, 20), m=(0.1, 3),
    r=(0.03, 0.1), g=(0, 10), e=(0, 1), mu=(0.05, 0.8), a=(-0.5, 0.5), d=(-0.1, 0.1), T=(0.3, 1.2),
)  # fmt: skip


@family(
    "impact", 20, "x:m z:m q:rad vx:m/s vz:m/s w:rad/s", "", "m:kg I:kg*m^2 r:m g:m/s^2 e:1 mu:1 a:rad d:m",
    """A disk of mass m, radius r and moment of inertia I about its center (x, z) moves in the vertical plane, x to the
    right and z up, under gravity g along -z. q is its angle and w its rate, both counterclockwise (from x to z). It
    strikes the rigid line n . (x, z) = d, with n = (cos a, sin a), once, at n . (x, z) = d + r. The impact is
    instantaneous: the velocity of the center along n is multiplied by -e, which takes the normal impulse P. With
    t = (-sin a, cos a) the contact point slips by u = t . (vx, vz) - r w. The impulse along t stops u if it is at most
    mu P in magnitude; otherwise it is mu P, against u.""",
    events=(1, 1),
)  # fmt: skip
def wall(p, T, tolerance):
    m, inertia, r, g, e, mu, a, d = (p[k] for k in ("m", "I", "r", "g", "e", "mu", "a", "d"))
    x, z, q, vx, vz, w = (p[k] for k in ("x", "z", "q", "vx", "vz", "w"))
    c, s = np.cos(a), np.sin(a)
    gap, rate, fall = c * x + s * z - d - r, c * vx + s * vz, s * g
    root = rate * rate + 2 * fall * gap  # gap + rate t - fall t^2 / 2 = 0
    if size(root) < 0.1 or size(rate) > -0.3 or size(gap) < 0.05:
        raise NearSwitchError
    t = 2 * gap / (np.sqrt(root) - rate)
    x, z, q, vz = x + vx * t, z + vz * t - g * t * t / 2, q + w * t, vz - g * t
    rate, slip = c * vx + s * vz, -s * vx + c * vz - r * w
    P = -(1 + e) * m * rate
    along = -slip / (1 / m + r * r / inertia)
    near(along / (mu * P))
    if abs(size(along)) > size(mu * P):
        along = -sign(slip) * mu * P
    vx, vz, w = vx + (c * P - s * along) / m, vz + (s * P + c * along) / m, w - r * along / inertia
    s = T - t
    gap = np.cos(a) * (x + vx * s) + np.sin(a) * (z + vz * s - g * s * s / 2) - d - r
    if size(gap) < 0.01 or size(T - t) < 0:  # it may come back
        raise NearSwitchError
    return (x + vx * s, z + vz * s - g * s * s / 2, q + w * s, vx, vz - g * s, w), [t]


draws(
    "balls", x1=(-1, -0.4), z1=(-0.1, 0.1), x2=(0.2, 0.8), z2=(-0.1, 0.1), vx1=(0.5, 3), vz1=(-0.2, 0.2),
    vx2=(-2, 0.3), vz2=(-0.2, 0.2), m1=(0.1, 3), m2=(0.1, 3), r1=(0.05, 0.2), r2=(0.05, 0.2), e=(0, 1), T=(0.5, 2),
)  # fmt: skip


@family(
    "impact", 20, "x1:m z1:m x2:m z2:m vx1:m/s vz1:m/s vx2:m/s vz2:m/s", "", "m1:kg m2:kg r1:m r2:m e:1",
    """Two balls without rotation and friction, of masses m1 and m2 and radii r1 and r2, move freely in the plane (x, z)
    without gravity. They collide once, when their centers' distance is r1 + r2. The impulse is along the line of
    centers, and their relative velocity along this line is multiplied by -e.""",
    events=(1, 1),
)  # fmt: skip
def balls(p, T, tolerance):
    one, two, v, u = (np.array([p[f"{k}x{i}"], p[f"{k}z{i}"]]) if k else np.array([p[f"x{i}"], p[f"z{i}"]])
                      for k, i in (("", 1), ("", 2), ("v", 1), ("v", 2)))  # fmt: skip
    gap, rate, reach = two - one, u - v, p["r1"] + p["r2"]
    a, b, c = sum(rate * rate), sum(gap * rate), sum(gap * gap) - reach**2
    root = b * b - a * c
    if size(root) < 0.3 * size(a * reach**2) or size(b) > 0 or size(c) < 0:  # they miss or nearly miss
        raise NearSwitchError
    t = (-b - np.sqrt(root)) / a
    n = (gap + rate * t) / reach
    P = -(1 + p["e"]) * sum(rate * n) / (1 / p["m1"] + 1 / p["m2"])
    one, two, v, u = one + v * t, two + u * t, v - P * n / p["m1"], u + P * n / p["m2"]
    return np.concatenate([one + v * (T - t), two + u * (T - t), v, u]), [t]


def hanging(p, u):
    """Rates of a pendulum under a torque u(q, v) about its pivot."""
    m, l, g = p["m"], p["l"], p["g"]  # noqa: E741
    return lambda y: np.array([y[1], u(*y) / (m * l * l) - g / l * np.sin(y[0])])


PENDULUM = "m:kg l:m g:m/s^2 b:N*m*s/rad"
A_PENDULUM = """A pendulum: a point mass m on a massless rod of length l, which hangs down at the angle q = 0, under
    gravity g, with viscous friction of torque -b v at its pivot and a constant torque u."""


draws(
    "pendulum_stop", q=(-0.4, 0.3), v=(0.5, 4), u=(-0.5, 0.5), m=(0.2, 2), l=(0.2, 1), g=(3, 12), b=(0, 0.1),
    s=(0.4, 0.9), e=(0, 0.95), T=(0.3, 2),
)  # fmt: skip


@family(
    "impact", 15, "q:rad v:rad/s", "u:N*m", PENDULUM + " s:rad e:1",
    A_PENDULUM + """ At q = s it strikes a rigid stop, which multiplies v by -e, one or more times.""",
    events=(1, 3), is_integrated=True,
)  # fmt: skip
def pendulum_stop(p, T, tolerance):
    rates = hanging(p, lambda q, v: p["u"] - p["b"] * v)
    stop = (lambda y: p["s"] - y[0], 0, lambda y: np.array([y[0], -p["e"] * y[1]]))
    return flow([(rates, [stop])], (p["q"], p["v"]), T, tolerance)


def press_time(n, random):
    """Draw the half period of the contact, and an end within the contact or after it."""
    k = n["m"] * (np.pi / random.uniform(0.005, 0.1)) ** 2
    share = random.uniform(0.2, 0.8) if random.uniform() < 0.4 else random.uniform(1.2, 6)
    return {"k": k, "T": fall_time(n) + share * np.pi * np.sqrt(n["m"] / k)}


draws("spring_contact", press_time, z=(0.2, 0.6), vz=(-3, 0.5), m=(0.1, 5), g=(0.5, 12), r=(0.03, 0.1))
draws("damped_contact", press_time, z=(0.15, 0.5), vz=(-3, 0), m=(0.1, 5), c=(0.05, 0.6), g=(2, 12), r=(0.03, 0.1))


@family(
    "impact", 10, "z:m vz:m/s", "", "m:kg k:N/m g:m/s^2 r:m",
    """A ball of mass m and radius r moves along the vertical z under gravity g (downward). z is the center. While
    z < r the ground pushes up with the force k (r - z), without friction and dissipation: a half period of about
    pi sqrt(m / k). The motion ends within the contact or after it.""",
    events=(1, 4),
)  # fmt: skip
def spring_contact(p, T, tolerance):
    z, v, g, r = p["z"], p["vz"], p["g"], p["r"]
    w, t, times = np.sqrt(p["k"] / p["m"]), 0.0, []
    while True:
        speed = np.sqrt(v * v + 2 * g * (z - r))
        touch = t + (v + speed) / g
        times.append(touch)
        if size(touch) > T:
            s = T - t
            return (z + v * s - g * s * s / 2, v - g * s), times
        leave = touch + 2 / w * (np.pi - np.arctan(speed * w / g))
        times.append(leave)
        if size(leave) > T:
            s = w * (T - touch)
            depth = g / w**2 * (1 - np.cos(s)) + speed / w * np.sin(s)
            return (r - depth, -(g / w * np.sin(s) + speed * np.cos(s))), times
        z, v, t = r, speed, leave


@family(
    "impact", 15, "z:m vz:m/s", "", "m:kg k:N/m c:s/m g:m/s^2 r:m",
    """A ball of mass m and radius r moves along the vertical z under gravity g (downward). z is the center. While its
    depth d = r - z is positive, the ground pushes up with the force k d (1 + c d') of Hunt and Crossley, at least 0.
    The motion ends within the contact or after it.""",
    events=(1, 4), is_integrated=True,
)  # fmt: skip
def damped_contact(p, T, tolerance):
    def contact(y):
        return np.array([y[1], p["k"] / p["m"] * (p["r"] - y[0]) * (1 - p["c"] * y[1]) - p["g"]])

    air = (lambda y: np.array([y[1], -p["g"] + 0 * y[1]]), [(lambda y: y[0] - p["r"], 1, keep)])
    return flow([air, (contact, [(lambda y: p["r"] - y[0], 0, keep)])], (p["z"], p["vz"]), T, tolerance)
