"""The suite's families without impacts: free motions, friction that brings a block to rest, and contact at rest."""

from functools import partial

import numpy as np
from gradients_suite_families import A_PENDULUM, PENDULUM, draws, family, flow, hanging, keep, near, sign, size
from scipy.linalg import expm

draws("projectile", x=(-1, 1), z=(-1, 1), vx=(-5, 5), vz=(-5, 5), m=(0.1, 3), g=(0, 15), b=(0.05, 2), T=(0.05, 1.5))


@family(
    "step", 8, "x:m z:m vx:m/s vz:m/s", "", "m:kg g:m/s^2 b:N*s/m",
    """A point mass m moves in the plane (x, z) under gravity g along -z and the drag force -b (vx, vz).""",
)  # fmt: skip
def projectile(p, T, tolerance):
    x, z, vx, vz, g, tau = p["x"], p["z"], p["vx"], p["vz"], p["g"], p["m"] / p["b"]
    left = np.exp(-T / tau)
    above = vz + g * tau  # the speed above the final one
    return (
        x + vx * tau * (1 - left),
        z + above * tau * (1 - left) - g * tau * T,
        vx * left,
        above * left - g * tau,
    ), []


draws("pendulum", q=(-3, 3), v=(-4, 4), u=(-2, 2), m=(0.2, 2), l=(0.2, 1), g=(3, 12), b=(0, 0.2), T=(0.02, 1))


@family("step", 10, "q:rad v:rad/s", "u:N*m", PENDULUM, A_PENDULUM, is_integrated=True)
def pendulum(p, T, tolerance):
    return flow([(hanging(p, lambda q, v: p["u"] - p["b"] * v), [])], (p["q"], p["v"]), T, tolerance)


draws(
    "pd_joint", q=(-3, 3), v=(-4, 4), target=(-1, 1), m=(0.2, 2), l=(0.2, 1), g=(3, 12), kp=(1, 60), kd=(0.05, 2),
    T=(0.02, 1),
)  # fmt: skip


@family(
    "step", 10, "q:rad v:rad/s", "target:rad", "m:kg l:m g:m/s^2 kp:N*m/rad kd:N*m*s/rad",
    """A driven joint: a point mass m on a massless rod of length l, which hangs down at the angle q = 0, under gravity
    g. Its drive applies the torque kp (target - q) - kd v at the pivot, in continuous time, without a limit.""",
    is_integrated=True,
)  # fmt: skip
def pd_joint(p, T, tolerance):
    drive = hanging(p, lambda q, v: p["kp"] * (p["target"] - q) - p["kd"] * v)
    return flow([(drive, [])], (p["q"], p["v"]), T, tolerance)


draws(
    "double_pendulum", q1=(-3, 3), q2=(-2, 2), v1=(-3, 3), v2=(-3, 3), u1=(-2, 2), u2=(-1, 1), m1=(0.2, 2),
    m2=(0.2, 2), l1=(0.3, 1), l2=(0.3, 1), g=(3, 12), T=(0.02, 0.8),
)  # fmt: skip


@family(
    "step", 10, "q1:rad q2:rad v1:rad/s v2:rad/s", "u1:N*m u2:N*m", "m1:kg m2:kg l1:m l2:m g:m/s^2",
    """Two massless rods of lengths l1 and l2 with a point mass at the end of each, m1 and m2, in a vertical plane under
    gravity g. q1 is the angle of rod 1 from hanging down, and q2 the angle of rod 2 relative to rod 1, both
    counterclockwise. The torque u1 acts on rod 1 from the fixed pivot; u2 acts on rod 2 from rod 1, and -u2 on rod 1.
    There is no friction.""",
    is_integrated=True,
)  # fmt: skip
def double_pendulum(p, T, tolerance):
    m1, m2, l1, l2, g, u1, u2 = (p[k] for k in ("m1", "m2", "l1", "l2", "g", "u1", "u2"))

    def rates(y):
        one, two, v1, v2 = y[0], y[0] + y[1], y[2], y[2] + y[3]  # angles from the vertical
        c, s = m2 * l1 * l2 * np.cos(one - two), m2 * l1 * l2 * np.sin(one - two)
        f1 = u1 - u2 - s * v2 * v2 - (m1 + m2) * g * l1 * np.sin(one)
        f2 = u2 + s * v1 * v1 - m2 * g * l2 * np.sin(two)
        a, b = (m1 + m2) * l1 * l1, m2 * l2 * l2
        a1, a2 = (b * f1 - c * f2) / (a * b - c * c), (a * f2 - c * f1) / (a * b - c * c)
        return np.array([y[2], y[3], a1, a2 - a1])

    return flow([(rates, [])], [p[k] for k in ("q1", "q2", "v1", "v2")], T, tolerance)


draws(
    "cart_pole", x=(-1, 1), q=(-3, 3), vx=(-2, 2), w=(-4, 4), u=(-5, 5), M=(0.5, 5), m=(0.1, 1), l=(0.2, 1), g=(3, 12),
    T=(0.02, 1),
)  # fmt: skip


@family(
    "step", 8, "x:m q:rad vx:m/s w:rad/s", "u:N", "M:kg m:kg l:m g:m/s^2",
    """A cart of mass M on a horizontal rail x, pushed by the force u along x. A point mass m hangs from it on a
    massless rod of length l, down at q = 0 and at x + l sin q, under gravity g. There is no friction. vx and w are
    the rates of x and q.""",
    is_integrated=True,
)  # fmt: skip
def cart_pole(p, T, tolerance):
    M, m, rod, g = p["M"], p["m"], p["l"], p["g"]

    def rates(y):
        _, q, v, w = y
        c, s = np.cos(q), np.sin(q)
        a = (p["u"] + m * s * (rod * w * w + g * c)) / (M + m * s * s)
        return np.array([v, w, a, -(a * c + g * s) / rod])

    return flow([(rates, [])], [p[k] for k in ("x", "q", "vx", "w")], T, tolerance)


draws(
    "rigid_body", roll=(-1, 1), pitch=(-0.7, 0.7), yaw=(-2, 2), wx=(-4, 4), wy=(-4, 4), wz=(-4, 4), I_x=(0.6, 1.0),
    I_y=(0.6, 1.0), I_z=(0.6, 1.2), T=(0.02, 0.6),
)  # fmt: skip


@family(
    "step", 10, "roll:rad pitch:rad yaw:rad wx:rad/s wy:rad/s wz:rad/s", "", "I_x:kg*m^2 I_y:kg*m^2 I_z:kg*m^2",
    """A free rigid body without torques, about its center of mass. Its principal axes have the moments of inertia I_x,
    I_y and I_z. Its rotation from principal axes to the world is Rz(yaw) Ry(pitch) Rx(roll), and (wx, wy, wz) is its
    angular velocity in the world's axes.""",
    is_integrated=True,
)  # fmt: skip
def rigid_body(p, T, tolerance):
    inertia = np.array([p["I_x"], p["I_y"], p["I_z"]])

    def rates(y):
        (a, b, c), w = y[:3], y[3:]
        (ca, cb, cc), (sa, sb, sc) = np.cos([a, b, c]), np.sin([a, b, c])
        if abs(size(cb)) < 0.2:  # roll and yaw are nearly about the same axis
            near(1.0)
        R = np.array(
            [
                [cb * cc, sa * sb * cc - ca * sc, ca * sb * cc + sa * sc],
                [cb * sc, sa * sb * sc + ca * cc, ca * sb * sc - sa * cc],
                [-sb, sa * cb, ca * cb],
            ]
        )
        in_body = np.einsum("jim,jm->im", R, w)
        turn = -np.cross(in_body, inertia * in_body, axis=0) / inertia
        roll = (cc * w[0] + sc * w[1]) / cb
        return np.array([roll, cc * w[1] - sc * w[0], w[2] + sb * roll, *np.einsum("ijm,jm->im", R, turn)])

    return flow([(rates, [])], [p[k] for k in ("roll", "pitch", "yaw", "wx", "wy", "wz")], T, tolerance)


draws(
    "spring_damper", x=(-1, 1), y=(-1, 1), v=(-3, 3), w=(-3, 3), u=(-5, 5), m1=(0.2, 3), m2=(0.2, 3), k1=(1, 200),
    k2=(1, 200), c1=(0, 2), c2=(0, 2), T=(0.02, 1.5),
)  # fmt: skip


@family(
    "step", 10, "x:m y:m v:m/s w:m/s", "u:N", "m1:kg m2:kg k1:N/m k2:N/m c1:N*s/m c2:N*s/m",
    """Two masses on a line without gravity: spring k1 and damper c1 connect m1 to a wall, spring k2 and damper c2
    connect m2 to m1, and a drive pushes m2 with the force u and m1 with -u. x is the
    displacement of m1 and y that of m2 relative to m1, both 0 where the springs are relaxed; v and w are the rates
    of x and y.""", )  # fmt: skip
def spring_damper(p, T, tolerance):
    m1, m2, zero = p["m1"], p["m2"], 0 * p["m1"]
    of_1 = np.array([-p["k1"] / m1, p["k2"] / m1, -p["c1"] / m1, p["c2"] / m1, -p["u"] / m1])
    of_2 = np.array([zero, -p["k2"] / m2, zero, -p["c2"] / m2, p["u"] / m2]) - of_1
    A = np.zeros((len(zero), 5, 5), dtype=complex)
    A[:, 0, 2] = A[:, 1, 3] = 1.0
    A[:, 2], A[:, 3] = of_1.T, of_2.T
    start = np.array([p["x"], p["y"], p["v"], p["w"], zero + 1])
    return np.einsum("mij,jm->im", expm(A * T), start)[:4], []


draws(
    "block", x=(-1, 1), v=(-4, 4), u=(-0.5, 0.5), m=(0.2, 3), mu=(0.1, 0.9), g=(5, 12), T=(0.1, 1.5),
)  # fmt: skip


@family(
    "step", 10, "x:m v:m/s", "u:N", "m:kg mu:1 g:m/s^2",
    """A block of mass m slides on a horizontal plane along x under gravity g, the horizontal force u and ideal Coulomb
    friction, mu m g against its velocity. If the block stops it stays at rest, as |u| < mu m g.""",
    events=(0, 1),
)  # fmt: skip
def block(p, T, tolerance):
    if abs(size(p["v"])) < 0.2:
        near(1.0)
    return sliding(p, p["u"] / p["m"], p["mu"] * p["g"], T)


def sliding(p, drive, drag, T):
    """The end of a block's motion with the acceleration `drive`, and `drag` against its velocity."""
    x, v = p["x"], p["v"]
    a = drive - sign(v) * drag
    stop = -v / a
    near(drive / drag)
    if not 0 < size(stop) < T:  # it is faster and faster, or still slides
        return (x + v * T + a * T * T / 2, v + a * T), [stop] if size(stop) > 0 else []
    x, s = x + v * stop / 2, T - stop
    if abs(size(drive)) < abs(size(drag)):
        return (x, 0 * x), [stop]
    a = drive - sign(drive) * drag
    return (x + a * s * s / 2, a * s), [stop]


draws(
    "slope", x=(-1, 1), v=(-4, 4), u=(-2, 2), m=(0.2, 3), mu=(0.1, 0.9), g=(5, 12), a=(0.1, 0.8), T=(0.1, 1.5),
)  # fmt: skip


@family(
    "step", 12, "x:m v:m/s", "u:N", "m:kg mu:1 g:m/s^2 a:rad",
    """A block of mass m slides along x, which points up a plane at the angle a from the horizontal, under gravity g,
    the force u along x and ideal Coulomb friction: mu m g cos a against its velocity. If the block stops, it stays
    at rest if |u - m g sin a| < mu m g cos a; otherwise it slides on in the direction of u - m g sin a.""",
    events=(0, 1),
)  # fmt: skip
def slope(p, T, tolerance):
    if abs(size(p["v"])) < 0.2:
        near(1.0)
    return sliding(p, p["u"] / p["m"] - p["g"] * np.sin(p["a"]), p["mu"] * p["g"] * np.cos(p["a"]), T)


def resting_point(n, random):
    """Draw a stiffness, a start near the rest, and a force that friction can resist."""
    weight, depth = n["m"] * n["g"], random.uniform(1e-4, 2e-3)
    vs = float(random.choice([1e-3, random.uniform(0.005, 0.1)]))  # the first is Drake's default
    return {
        "vs": vs,
        "k": weight / depth,
        "z": n["r"] - depth * random.uniform(0.8, 1.2),
        "vx": vs * random.uniform(-3, 3),
        "vz": random.uniform(-0.3, 0.3) * depth * np.sqrt(n["g"] / depth),
        "ux": random.uniform(-0.6, 0.6) * n["mu"] * weight,
        "uz": random.uniform(-0.3, 0.3) * weight,
    }


draws(
    "resting_contact", resting_point, x=(-1, 1), m=(0.1, 3), r=(0.03, 0.1), g=(5, 12), c=(0.1, 2), mu=(0.2, 1),
    T=(0.005, 0.2),
)  # fmt: skip


@family(
    "step", 12, "x:m z:m vx:m/s vz:m/s", "ux:N uz:N", "m:kg r:m g:m/s^2 k:N/m c:s/m mu:1 vs:m/s",
    """A ball of mass m and radius r, which does not rotate, rests on compliant ground and stays in contact. (x, z) is
    its center. It is under gravity g along -z and the force (ux, uz). At the depth d = r - z > 0 the ground pushes up
    with the force N = k d (1 + c d'). Friction is mu s(|vx| / vs) N against vx, with s(y) = y^3 (10 - 15 y + 6 y^2)
    for y < 1, and 1 beyond.""",
    events=(0, 3),
    is_integrated=True,
)  # fmt: skip
def resting_contact(p, T, tolerance):
    def rates(is_slipping, y):
        _, z, vx, vz = y
        N = p["k"] * (p["r"] - z) * (1 - p["c"] * vz)
        if size(N) <= 0:
            near(1.0)
        r = sign(vx) * vx / p["vs"]
        share = 1.0 if is_slipping or size(r) >= 1 else r**3 * (10 - 15 * r + 6 * r * r)
        drag = sign(vx) * p["mu"] * N * share
        return np.array([vx, vz, (p["ux"] - drag) / p["m"], (p["uz"] + N) / p["m"] - p["g"]])

    def beyond(y):
        return sign(y[2]) * y[2] - p["vs"]

    slipping = (partial(rates, True), [(beyond, 0, keep)])
    below = (partial(rates, False), [(lambda y: -beyond(y), 1, keep)])
    start = [p[k] for k in ("x", "z", "vx", "vz")]
    return flow([below, slipping], start, T, tolerance, int(size(beyond(start)) > 0))
