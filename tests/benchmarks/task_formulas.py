"""Handwritten equations of motion x' = f(x, u, math, **constants), for peers in separate environments.

`math` has sin, cos and tan for the types of x and u. Nothing is imported. Links hang down at an angle of 0.
"""

GRAVITY = 9.81


def bicycle(x, u, math):
    """Return x' of a bicycle, 1 m between its axles. x: position, heading, speed. u: acceleration, steering angle."""
    return [x[3] * math.cos(x[2]), x[3] * math.sin(x[2]), x[3] * math.tan(u[1]), u[0]]


def dubins(x, u, math):
    return [math.cos(x[2]), math.sin(x[2]), u[0]]


def planar(x, u, math):
    """Return x' of Drake's planar quadrotor."""
    m, r, inertia = 0.486, 0.25, 0.00383
    push = (u[0] + u[1]) / m
    return [x[3], x[4], x[5], -push * math.sin(x[2]), push * math.cos(x[2]) - 9.81, r * (u[0] - u[1]) / inertia]


def block(x, u, math, mass, damping):
    return [x[1], (u[0] - damping * x[1]) / mass]


def pendulum(x, u, math):
    """Return x' of models/pendulum.urdf: 1 kg, 0.5 m, damping 0.1."""
    return [x[1], (u[0] - 0.1 * x[1] - GRAVITY * 0.5 * math.sin(x[0])) / 0.25]


def cart_pole(x, u, math, l=0.5, m1=1.0, m2=0.3):  # noqa: E741
    """Return x' of a cart and a pole, by default models/cart_pole.urdf, by the formulas of Kelly's paper."""
    g = GRAVITY
    s, c, rate = math.sin(x[1]), math.cos(x[1]), x[3]
    cart = (l * m2 * s * rate**2 + u[0] + m2 * g * c * s) / (m1 + m2 * s**2)
    pole = -(l * m2 * c * s * rate**2 + u[0] * c + (m1 + m2) * g * s) / (l * m1 + l * m2 * s**2)
    return [x[2], x[3], cart, pole]


def three_masses(x, u, math):
    """Return x' of a chain of three masses: the first is fixed, u (3,) is the velocity of the last.

    x: positions of the second and the last mass, velocity of the second. The springs have 1 N/m and a length of 0.033 m
    at rest, the masses 0.033 kg.
    """
    before, after = [x[i] for i in range(3)], [x[i + 3] - x[i] for i in range(3)]
    pulls = []
    for way in (before, after):
        length = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
        pulls.append([(1 - 0.033 / length) / 0.033 * d for d in way])
    falls = [0.0, 0.0, -GRAVITY]
    return [x[6], x[7], x[8], u[0], u[1], u[2], *[b - a + f for a, b, f in zip(*pulls, falls)]]  # noqa: B905


def two_links(x, u, math, first, second, damping, motors):
    """Return x' of links (mass, length, distance of the centre, inertia about it); `motors` are driven joints."""
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


# ------------------------------------------------------------------------------ textbooks


def sliding_bead(x, u, math):
    """Return x' of the brachistochrone. x: position, depth, speed. u: angle from the vertical."""
    return [x[2] * math.sin(u[0]), x[2] * math.cos(u[0]), GRAVITY * math.cos(u[0])]


def goddard(x, u, math):
    """Return x' of a vertical rocket in scaled units. x: height from the centre, speed, mass. u: thrust."""
    drag = 310 * x[1] ** 2 * math.exp(-500 * (x[0] - 1))
    return [x[1], (u[0] - drag) / x[2] - 1 / x[0] ** 2, -u[0] / 0.5]


def sailing_orbit(x, u, math):
    """Return x' of Bryson and Ho's orbit transfer. x: radius, velocities, mass. u: angle of a constant thrust."""
    push = 0.1405 / x[3]
    radial = x[2] ** 2 / x[0] - 1 / x[0] ** 2 + push * math.sin(u[0])
    return [x[1], radial, -x[1] * x[2] / x[0] + push * math.cos(u[0]), -0.0749]


def chain(x, u, math):
    """Return x' of a hanging chain along the ground. x: height, moment, length. u: slope."""
    along = math.sqrt(1 + u[0] ** 2)
    return [u[0], x[0] * along, along]


def van_der_pol(x, u, math):
    return [(1 - x[1] ** 2) * x[0] - x[1] + u[0], x[0]]


def lander(x, u, math):
    """Return x' of a Moon lander, 3000 m/s exhaust. x: position, velocity, mass. u: thrust, angle from the vertical."""
    push = u[0] / x[4]
    return [x[2], x[3], push * math.sin(u[1]), push * math.cos(u[1]) - 1.62, -u[0] / 3000]


def ball_on_beam(x, u, math):
    """Return x' of a rolling ball. x: position, angle of the beam, their rates. u: the beam's angular acceleration."""
    return [x[2], x[3], 5 / 7 * (x[0] * x[3] ** 2 - GRAVITY * math.sin(x[1])), u[0]]


def trailer(x, u, math, length):
    """Return x' of a unicycle with a trailer. x: position, heading, trailer's heading. u: speed, turning rate."""
    v = u[0]
    return [v * math.cos(x[2]), v * math.sin(x[2]), u[1], v / length * math.sin(x[2] - x[3])]


def hovercraft(x, u, math):
    """Return x' of a hovercraft, 1 kg, drag 0.2. x: position, heading, rates. u: two fans at +-0.3 m that only push."""
    push = u[0] + u[1]
    return [
        x[3],
        x[4],
        x[5],
        push * math.cos(x[2]) - 0.2 * x[3],
        push * math.sin(x[2]) - 0.2 * x[4],
        (0.3 * (u[1] - u[0]) - 0.02 * x[5]) / 0.05,
    ]


def slung_load(x, u, math):
    """Return x' of a planar quadrotor of 0.5 kg with a load of 0.2 kg on a rod of 0.6 m.

    x: position of the load, angle of the rod, angle of the body, their rates. u: forces of two rotors.
    """
    m, load, length, arm, inertia = 0.5, 0.2, 0.6, 0.25, 0.004
    force = u[0] + u[1]
    along = -force * math.cos(x[2] - x[3]) - m * length * x[6] ** 2
    rod = -force * math.sin(x[2] - x[3]) / (m * length)
    return [
        x[4],
        x[5],
        x[6],
        x[7],
        along * math.sin(x[2]) / (m + load),
        -along * math.cos(x[2]) / (m + load) - GRAVITY,
        rod,
        arm * (u[0] - u[1]) / inertia,
    ]


def hang_glider(x, u, math):
    """Return x' of the COPS hang glider, updraft at 250 m. x: position, height, velocity. u: lift coefficient."""
    r = (x[0] / 100 - 2.5) ** 2
    rise = x[3] - 2.5 * (1 - r) * math.exp(-r)
    speed = math.sqrt(x[2] ** 2 + rise**2)
    q = 0.5 * 1.13 * 14 * speed
    drag, lift = (0.034 + 0.069662 * u[0] ** 2) * q, u[0] * q
    return [x[2], x[3], (-lift * rise - drag * x[2]) / 100, (lift * x[2] - drag * rise) / 100 - 9.80665]
