"""Finite differences of simulations with SciPy as an engine of the suite of gradients, and an example of an engine.

    python gradients_suite.py --engine gradients_suite_differences:engine --times 100

The simulations share no code with the suite's truth: it also checks the suite. They use Cartesian coordinates, other
coordinates or forces at the position level where the truth uses closed forms. Differences are exact to about 1e-4.
"""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

WIDTH = 1e-4  # relative to a variable, or to 0.1 if it is smaller
PARTS = 60  # steps at least, which miss no event


def simulate(rates, y, T, switch=None, action=None):
    """Integrate y' = rates(y). Where `switch(y)` falls to 0, y becomes `action(y)`."""
    t, y = 0.0, np.array(y, dtype=float)
    events = []
    if switch:
        events = [lambda _, y: switch(y)]
        events[0].terminal, events[0].direction = True, -1
    while True:
        found = solve_ivp(
            lambda _, y: rates(y),
            (t, T),
            y,
            "DOP853",
            rtol=1e-12,
            atol=1e-14,
            events=events or None,
            max_step=T / PARTS,
        )
        t, y = found.t[-1], found.y[:, -1]
        if found.status == 0:
            return y
        y = action(y)


def bounce(p, T):
    return simulate(
        lambda y: [y[1], -p["g"]], [p["z"], p["vz"]], T, lambda y: y[0] - p["r"], lambda y: [p["r"], -p["e"] * y[1]]
    )


def wall(p, T):
    """The impulse along the line ends the slip or is at the limit of friction: the smaller of both."""
    n, t = np.array([np.cos(p["a"]), np.sin(p["a"])]), np.array([-np.sin(p["a"]), np.cos(p["a"])])

    def struck(y):
        v, w = y[3:5], y[5]
        normal = p["m"] * (1 + p["e"]) * -(n @ v)
        J = np.array([*t, -p["r"]])  # of the slip
        W = J @ np.diag([1 / p["m"], 1 / p["m"], 1 / p["I"]]) @ J
        along = np.clip(-J @ [*v, w] / W, -p["mu"] * normal, p["mu"] * normal)
        after = v + (normal * n + along * t) / p["m"]
        return np.array([*y[:3], *after, w - p["r"] * along / p["I"]])

    start = [p[k] for k in ("x", "z", "q", "vx", "vz", "w")]
    gap = lambda y: n @ y[:2] - p["d"] - p["r"]  # noqa: E731
    return simulate(lambda y: [*y[3:], 0, -p["g"], 0], start, T, gap, struck)


def balls(p, T):
    def struck(y):
        n = (y[2:4] - y[:2]) / np.linalg.norm(y[2:4] - y[:2])
        one, two, m1, m2 = y[4:6] @ n, y[6:] @ n, p["m1"], p["m2"]
        mean, apart = (m1 * one + m2 * two) / (m1 + m2), p["e"] * (one - two)
        after_1, after_2 = mean - m2 * apart / (m1 + m2), mean + m1 * apart / (m1 + m2)
        return np.array([*y[:4], *(y[4:6] + (after_1 - one) * n), *(y[6:] + (after_2 - two) * n)])

    start = [p[k] for k in ("x1", "z1", "x2", "z2", "vx1", "vz1", "vx2", "vz2")]
    gap = lambda y: np.linalg.norm(y[2:4] - y[:2]) - p["r1"] - p["r2"]  # noqa: E731
    return simulate(lambda y: [*y[4:], 0, 0, 0, 0], start, T, gap, struck)


def pendulum(p, T, switch=None, action=None):
    def rates(y):
        q, v = y
        drive = p["kp"] * (p["target"] - q) - p["kd"] * v if "kp" in p else p["u"] - p["b"] * v
        return [v, (drive - p["m"] * p["g"] * p["l"] * np.sin(q)) / (p["m"] * p["l"] ** 2)]

    return simulate(rates, [p["q"], p["v"]], T, switch, action)


def pendulum_stop(p, T):
    return pendulum(p, T, lambda y: p["s"] - y[0], lambda y: [p["s"], -p["e"] * y[1]])


def contact(p, T):
    def rates(y):
        depth = max(p["r"] - y[0], 0.0)
        return [y[1], max(p["k"] * depth * (1 - p.get("c", 0.0) * y[1]), 0.0) / p["m"] - p["g"]]

    return simulate(rates, [p["z"], p["vz"]], T)


def projectile(p, T):
    b = p["b"] / p["m"]
    start = [p[k] for k in ("x", "z", "vx", "vz")]
    return simulate(lambda y: [y[2], y[3], -b * y[2], -b * y[3] - p["g"]], start, T)


def double_pendulum(p, T):
    m1, m2, l1, l2, g = (p[k] for k in ("m1", "m2", "l1", "l2", "g"))

    def rates(y):
        q1, q2, v1, v2 = y
        c, s, low = m2 * l1 * l2 * np.cos(q2), m2 * l1 * l2 * np.sin(q2), m2 * g * l2 * np.sin(q1 + q2)
        M = [[(m1 + m2) * l1**2 + m2 * l2**2 + 2 * c, m2 * l2**2 + c], [m2 * l2**2 + c, m2 * l2**2]]
        turn = s * (2 * v1 * v2 + v2**2)
        force = [p["u1"] + turn - (m1 + m2) * g * l1 * np.sin(q1) - low, p["u2"] - s * v1**2 - low]
        return [v1, v2, *np.linalg.solve(M, force)]

    return simulate(rates, [p[k] for k in ("q1", "q2", "v1", "v2")], T)


def cart_pole(p, T):
    M, m, rod = p["M"], p["m"], p["l"]

    def rates(y):
        _, q, v, w = y
        mass = [[M + m, m * rod * np.cos(q)], [m * rod * np.cos(q), m * rod**2]]
        force = [p["u"] + m * rod * w**2 * np.sin(q), -m * p["g"] * rod * np.sin(q)]
        return [v, w, *np.linalg.solve(mass, force)]

    return simulate(rates, [p[k] for k in ("x", "q", "vx", "w")], T)


def rigid_body(p, T):
    """Integrate the rotation matrix under a constant angular momentum."""
    inertia = np.diag([p["I_x"], p["I_y"], p["I_z"]])
    R = Rotation.from_euler("ZYX", [p["yaw"], p["pitch"], p["roll"]]).as_matrix()
    momentum = R @ inertia @ R.T @ [p["wx"], p["wy"], p["wz"]]

    def velocity(R):
        return R @ np.linalg.inv(inertia) @ R.T @ momentum

    end = simulate(lambda y: np.cross(velocity(y.reshape(3, 3)), y.reshape(3, 3).T).T.ravel(), R.ravel(), T).reshape(
        3, 3
    )
    angles = np.arctan2(end[2, 1], end[2, 2]), np.arcsin(-end[2, 0]), np.arctan2(end[1, 0], end[0, 0])
    start = [p["roll"], p["pitch"], p["yaw"]]  # without a jump by full turns
    angles = [a + 2 * np.pi * round((b - a) / (2 * np.pi)) for a, b in zip(angles, start, strict=True)]
    return np.array([*angles, *velocity(end)])


def spring_damper(p, T):
    """In the coordinates of the two masses."""

    def rates(y):
        x1, x2, v1, v2 = y
        pull = p["k2"] * (x2 - x1) + p["c2"] * (v2 - v1) - p["u"]
        return [v1, v2, (pull - p["k1"] * x1 - p["c1"] * v1) / p["m1"], -pull / p["m2"]]

    x1, x2, v1, v2 = simulate(rates, [p["x"], p["x"] + p["y"], p["v"], p["v"] + p["w"]], T)
    return np.array([x1, x2 - x1, v1, v2 - v1])


def block(p, T):
    """A third entry of the state is the direction of sliding, 0 at rest."""
    a = p.get("a", 0.0)
    drive, drag = p["u"] / p["m"] - p["g"] * np.sin(a), p["mu"] * p["g"] * np.cos(a)

    def stopped(y):
        return [y[0], 0.0, np.sign(drive) if abs(drive) > drag else 0.0]

    def rates(y):
        return [y[1], (drive - y[2] * drag) if y[2] else 0.0, 0.0]

    speed = lambda y: y[1] * y[2] if y[2] else 1.0  # noqa: E731
    return simulate(rates, [p["x"], p["v"], np.sign(p["v"])], T, speed, stopped)[:2]


def resting_contact(p, T):
    def rates(y):
        _, z, vx, vz = y
        N = p["k"] * (p["r"] - z) * (1 - p["c"] * vz)
        s = min(abs(vx) / p["vs"], 1.0)
        drag = np.sign(vx) * p["mu"] * N * np.polyval([6, -15, 10, 0, 0, 0], s)
        return [vx, vz, (p["ux"] - drag) / p["m"], (p["uz"] + N) / p["m"] - p["g"]]

    return simulate(rates, [p[k] for k in ("x", "z", "vx", "vz")], T)


FAMILIES = {
    "bounce": bounce,
    "wall": wall,
    "balls": balls,
    "pendulum_stop": pendulum_stop,
    "spring_contact": contact,
    "damped_contact": contact,
    "projectile": projectile,
    "pendulum": pendulum,
    "pd_joint": pendulum,
    "double_pendulum": double_pendulum,
    "cart_pole": cart_pole,
    "rigid_body": rigid_body,
    "spring_damper": spring_damper,
    "block": block,
    "slope": block,
    "resting_contact": resting_contact,
}


def engine(case):
    """Return the final state (n,) and central differences (n, m) of order 4."""
    if case["family"] not in FAMILIES:
        raise NotImplementedError
    end, p = FAMILIES[case["family"]], case["state"] | case["inputs"] | case["constants"]
    columns = []
    for name, value in p.items():
        h = WIDTH * (abs(value) if name in case["constants"] else max(abs(value), 0.1))
        if case["family"] == "resting_contact" and name in case["state"]:
            h *= 1e-2  # the depth and the stiction speed are small
        one, two = (
            (end(p | {name: value + k * h}, case["duration"]) - end(p | {name: value - k * h}, case["duration"]))
            for k in (1, 2)
        )
        columns.append((8 * one - two) / (12 * h))
    return end(p, case["duration"]), np.array(columns).T
