"""Equations of motion x' = f(x, u, math, **constants) by hand, for peers in environments of their own.

`math` has sin, cos and tan of what x and u are. Nothing is imported. Angles of 0 hang down.
"""

GRAVITY = 9.81


def bicycle(x, u, math):
    """Position, heading, speed; acceleration and steering; 1 m between the axles."""
    return [x[3] * math.cos(x[2]), x[3] * math.sin(x[2]), x[3] * math.tan(u[1]), u[0]]


def dubins(x, u, math):
    return [math.cos(x[2]), math.sin(x[2]), u[0]]


def planar(x, u, math):
    """Drake's planar quadrotor."""
    m, r, inertia = 0.486, 0.25, 0.00383
    push = (u[0] + u[1]) / m
    return [x[3], x[4], x[5], -push * math.sin(x[2]), push * math.cos(x[2]) - 9.81, r * (u[0] - u[1]) / inertia]


def block(x, u, math, mass, damping):
    return [x[1], (u[0] - damping * x[1]) / mass]


def pendulum(x, u, math):
    """models/pendulum.urdf: 1 kg, 0.5 m, damping 0.1."""
    return [x[1], (u[0] - 0.1 * x[1] - GRAVITY * 0.5 * math.sin(x[0])) / 0.25]


def cart_pole(x, u, math):
    """models/cart_pole.urdf, by the formulas of Kelly's paper."""
    l, m1, m2, g = 0.5, 1.0, 0.3, GRAVITY  # noqa: E741
    s, c, rate = math.sin(x[1]), math.cos(x[1]), x[3]
    cart = (l * m2 * s * rate**2 + u[0] + m2 * g * c * s) / (m1 + m2 * s**2)
    pole = -(l * m2 * c * s * rate**2 + u[0] * c + (m1 + m2) * g * s) / (l * m1 + l * m2 * s**2)
    return [x[2], x[3], cart, pole]


def two_links(x, u, math, first, second, damping, motors):
    """Each link is (mass, length, distance of its centre, inertia about it); `motors` are the joints that have one."""
    (m1, l1, c1, i1), (m2, _, c2, i2) = first, second
    q1, q2, v1, v2 = x[0], x[1], x[2], x[3]
    torque = [0.0, 0.0]
    for motor, value in zip(motors, [u[k] for k in range(len(motors))]):  # noqa: B905
        torque[motor] = value
    a = i1 + i2 + m1 * c1**2 + m2 * (l1**2 + c2**2 + 2 * l1 * c2 * math.cos(q2))
    b, c = i2 + m2 * (c2**2 + l1 * c2 * math.cos(q2)), i2 + m2 * c2**2
    h, low = m2 * l1 * c2 * math.sin(q2), m2 * GRAVITY * c2 * math.sin(q1 + q2)
    r1 = torque[0] - damping * v1 + h * (2 * v1 * v2 + v2**2) - low - (m1 * c1 + m2 * l1) * GRAVITY * math.sin(q1)
    r2 = torque[1] - damping * v2 - h * v1**2 - low
    determinant = a * c - b * b
    return [v1, v2, (c * r1 - b * r2) / determinant, (a * r2 - b * r1) / determinant]
