"""What the contact laws of Drake and MuJoCo give in the cases of `contact_cases`, by formulas and not by their code.

Each is the rigid answer and what the law adds to it. Sliding friction is mu N in all of them, so that v_x + mu v_z is
the rigid block's whatever N does. What should stick creeps. A bounce is that of a spring and a damper.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import sqrt
from typing import Protocol

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.engines.closed_form import SlidingBlock, SphereOnGround
from drake_diff.engines.mujoco.mjcf import FRICTION_IMPEDANCE_RATIO, IMPEDANCE
from drake_diff.studies.contact_cases import RAILS, ContactCase, rolling_factor, slid, sliding_speed

STICTION_TOLERANCE = 1e-4  # Drake's default [m/s]
SIGMA = 1e-3  # of SAP's friction regularization
PIECES = 100  # of a contact's 1 / omega are one step of Runge-Kutta: its error is below 1e-9
Force = Callable[[float, float], float]  # [N] by depth [m] and its rate [m/s], while it is above 0


@dataclass(frozen=True)
class Answer:
    """What a law gives in a case, and which of its terms makes it differ from the rigid answer."""

    value: float
    gradient: float | None
    why: str
    why_gradient: str


class Ran(Protocol):
    """What a law takes from the engine's own run: how the ball moved up and down as it slid."""

    xs: Array

    def row(self, name: str, n: int) -> Array | None:
        """(size,) derivative of x, z, vx or vz after `n` steps by the start; None where none is offered."""
        ...


@dataclass(frozen=True)
class Law:
    """One contact law on one case."""

    case: ContactCase
    normal: str  # the force in words
    sticking: str
    force: Force
    stepped: Force  # what it amounts to in steps of h, to the first order
    creep: float  # speed at which it holds on the slope [m/s]
    creep_gradient: float  # of the way that a start's speed makes it creep [s]
    tail: float = 0.0  # how far it goes on when friction is no longer mu N, by its speed there [s]

    def answer(self, ran: Ran) -> Answer:
        """The law's own answer, given how `ran` moved along the normal."""
        ball = self.case
        match ball.kind:
            case "rest":
                return Answer(ball.resting_depth, 0.0, "at rest the spring alone carries m g", "it forgets its start")
            case "stop":
                return self._stop(ran)
            case "slide":
                return self._slide(ran)
            case "hold":
                return Answer(self.creep, self.creep_gradient, self.sticking, self.sticking)
            case "roll":
                factor = rolling_factor(ball.radius, ball.radius - ball.resting_depth / 2)
                why = "it rolls on the point half way down the overlap, by a smaller radius"
                return Answer(factor * ball.slope_gravity * ball.duration, factor, why, why)
            case _:
                return self._bounce()

    def _slide(self, ran: Ran) -> Answer:
        """v_x + mu v_z = v_0 + g (sin a - mu cos a) t, summed over the steps."""
        case, N = self.case, self.case.num_steps
        rigid = sliding_speed(case.speed, case.slope, case.friction, case.gravity, case.duration)
        rises, by = float(ran.xs[-1][case.place("vz")]), ran.row("vz", N)
        gradient = None if by is None else 1 - case.friction * float(by[case.place("vx")])
        why = f"friction is mu N, and {self.normal} moves the ball at {rises:.2g} m/s along the normal: -mu v_z"
        return Answer(rigid - case.friction * rises, gradient, why, "-mu d v_z / d v_0")

    def _stop(self, ran: Ran) -> Answer:
        """The same sum up to the last step that slips; then the tail."""
        case, h = self.case, self.case.time_step
        vx, mu = case.place("vx"), case.friction
        # How many steps, on level rails and from the first on, have friction mu N, to 1e-3.
        dv = np.diff(ran.xs[:, [vx, case.place("vz")]], axis=0)
        limit = mu * (dv[:, 1] + case.gravity * h)
        slips = np.abs(dv[:, 0] + limit) <= 1e-3 * np.maximum(limit, mu * case.gravity * h)
        n = len(slips) if slips.all() else int(np.argmin(slips))
        z, vz = (ran.xs[n][case.place(name)] - ran.xs[0][case.place(name)] for name in ("z", "vz"))
        speed = case.speed - mu * case.gravity * h * n - mu * float(vz)
        value = slid(case.speed, mu * case.gravity, h, n) - mu * float(z) + self.tail * speed
        by_z, by_vz, gradient = ran.row("z", n), ran.row("vz", n), None
        if by_z is not None and by_vz is not None:
            gradient = h * n - mu * float(by_z[vx]) + self.tail * (1 - mu * float(by_vz[vx]))
        why = f"friction is mu N, and {self.normal} lifts the ball as it slides: -mu dz for {n} steps"
        if self.tail:
            why += f"; {self.sticking}"
        return Answer(value, gradient, why, "-mu d z / d v_0" + (", and the damper" if self.tail else ""))

    def _bounce(self) -> Answer:
        case, speed = self.case, sqrt(2 * self.case.gravity * self.case.height)
        left = case.duration - speed / case.gravity
        _, x, rate, free = impact(self.force, case, 0.0, speed, left)
        height = max(0.0, rate**2 / (2 * case.gravity) - x) if free else 0.0
        does = f"has restitution {sqrt(height / case.height):.3g}" if free else "does not leave the ground"
        gradient, _ = impact_gradients(self.force, case)
        _, seen = impact_gradients(self.stepped, case)
        by = "by its damper" if self.force is self.stepped else "by its damper and by the step's own, k h v"
        missed = f"at touch the force jumps {by}; products of step Jacobians miss the jump and give {seen:.3g}"
        return Answer(height, gradient, f"m z'' = -m g + {self.normal} {does}", missed)


def impact(force: Force, case: ContactCase, x: float, rate: float, duration: float) -> tuple[float, float, float, bool]:
    """Where contact that begins at depth `x` [m] with `rate` [m/s] ends: time [s], depth, rate, and whether it ended.

    It is followed for `duration` [s] at most: m x'' = m g - f by Runge-Kutta, the last piece cut where f = 0.
    """

    def acceleration(x: float, rate: float) -> float:
        return case.gravity - force(x, rate) / case.mass

    def after(x: float, v: float, dt: float) -> tuple[float, float]:
        a = acceleration(x, v)
        b = acceleration(x + dt / 2 * v, v + dt / 2 * a)
        c = acceleration(x + dt / 2 * (v + dt / 2 * a), v + dt / 2 * b)
        d = acceleration(x + dt * (v + dt / 2 * b), v + dt * c)
        return x + dt * v + dt**2 / 6 * (a + b + c), v + dt / 6 * (a + 2 * b + 2 * c + d)

    time, piece = 0.0, sqrt(case.mass / case.stiffness) / PIECES
    while time < duration:
        dt = min(piece, duration - time)
        ahead = after(x, rate, dt)
        if ahead[1] < 0 and force(*ahead) <= 0:
            low, high = 0.0, dt
            for _ in range(50):
                middle = (low + high) / 2
                low, high = (middle, high) if force(*after(x, rate, middle)) > 0 else (low, middle)
            return time + high, *after(x, rate, high), True
        time, (x, rate) = time + dt, ahead
    return duration, x, rate, False


def impact_gradients(force: Force, case: ContactCase) -> tuple[float, float]:
    """d z(T) / d z_0 of the drop: with the saltation matrix of touching, and without it.

    A force that jumps to f_0 as the depth passes 0 at speed v adds -f_0 / (m v) times the change of the depth to that
    of the speed: the saltation matrix I + (f+ - f-) n' / (n' f-) with f- = (v, g), f+ = (v, g - f_0 / m), n = (1, 0).
    A product of step Jacobians knows nothing of it.
    """
    speed = sqrt(2 * case.gravity * case.height)
    left = case.duration - speed / case.gravity

    def end(x: float, rate: float) -> float:
        time, x, rate, _ = impact(force, case, x, rate, left)
        free = left - time
        return -(x + rate * free + case.gravity * free**2 / 2)

    e = 1e-6  # central differences of a smooth function of size 0.1 to 1, computed to 1e-12
    by_x, by_rate = (end(e, speed) - end(-e, speed)) / (2 * e), (end(0, speed + e) - end(0, speed - e)) / (2 * e)
    jump = force(0.0, speed) / (case.mass * speed)
    return -(by_x - jump * by_rate), -by_x  # a higher start is a lesser depth at the time of touching


def law_of(contact_law: str, case: ContactCase) -> Law | None:
    """The law that an engine's contract calls `contact_law`; None where there is no formula for it here."""
    if contact_law in ("point, sap", SphereOnGround.contact_law):
        return _sap(case)
    if contact_law in ("point, similar", "point, lagged"):
        return _hunt_crossley(case)
    mujocos = f"soft constraint, elliptic cone, impratio {FRICTION_IMPEDANCE_RATIO:g}"
    return _mujoco(case) if contact_law == mujocos else None


def _spring(stiffness: float, relaxation_time: float, dissipation: float) -> Force:
    return lambda x, rate: stiffness * (x + relaxation_time * rate) * max(0.0, 1 + dissipation * rate)


def _sap(case: ContactCase) -> Law:
    """f = k (x + tau x'), and mu v more of it as it slides; what sticks has the compliance R_t = sigma w / h."""
    per_axis = sqrt(len(case.axes) or 3) / (3 * case.mass)  # Frobenius norm of the contact's inverse inertia, over 3
    return Law(
        case,
        normal=f"k (x + tau x') with tau = {case.relaxation_time:g} s",
        sticking="friction that sticks is a damper of SAP's own, sigma = 1e-3",
        force=_spring(case.stiffness, case.relaxation_time, 0.0),
        stepped=_spring(case.stiffness, case.relaxation_time + case.time_step, 0.0),
        creep=SIGMA * per_axis * case.time_step * case.mass * case.slope_gravity,
        # A step leaves r / (1 + r) of a speed, r = sigma w m, and the sum of its powers is r.
        creep_gradient=case.time_step * SIGMA * per_axis * case.mass,
    )


def _hunt_crossley(case: ContactCase) -> Law:
    """f = k x (1 + d x'), friction mu N v / sqrt(v^2 + s^2): implicit in v', explicit in nothing else."""
    creep, creep_gradient = 0.0, 0.0
    if case.kind == "hold":  # by the block calculated by hand
        same = {name: getattr(case, name) for name in ("mass", "friction", "slope", "gravity")}
        block = SlidingBlock(stiction_tolerance=STICTION_TOLERANCE, **same)
        h, v, left = case.time_step, np.array([case.speed]), 1.0
        for _ in range(case.num_steps):
            a, by = block.acceleration(h, np.zeros(1), v, np.zeros(1))
            v, left = v + h * a, left * (1 + h * float(by[0, 1]))
            creep_gradient += h * left
        creep = float(v[0])
    return Law(
        case,
        normal=f"k x (1 + d x') with d = {case.dissipation:g} s/m",
        sticking=f"friction is regularized below {STICTION_TOLERANCE:g} m/s",
        force=_spring(case.stiffness, 0.0, case.dissipation),
        stepped=_spring(case.stiffness, case.time_step, case.dissipation),
        creep=creep,
        creep_gradient=creep_gradient,
    )


def _mujoco(case: ContactCase) -> Law:
    """a + R f = -b v - K r in each direction, R of friction smaller by impratio.

    With d the impedance, S and 2 sqrt(S) the pair's direct solref, 1 / m_i its inverse weight (1 / m, on two rails
    2 / 3 of it): K = S / d, b = 2 sqrt(S) / d, R = (1 - d) / (d m_i), and S = (1 - d) k / m_i for rest at m g / k.
    """
    inverse = (2 / 3 if case.axes == RAILS else 1) / case.mass
    s = (1 - IMPEDANCE) * case.stiffness * inverse
    K, b, R = s / IMPEDANCE, 2 * sqrt(s) / IMPEDANCE, (1 - IMPEDANCE) / IMPEDANCE * inverse
    along = 1 + case.mass * R / FRICTION_IMPEDANCE_RATIO
    holds = along / b  # [s] in which what sticks loses its speed

    def force(x: float, rate: float) -> float:
        return (K * x + b * rate + case.gravity) / (1 / case.mass + R)

    return Law(
        case,
        normal=f"a damper of {b / (1 / case.mass + R):.3g} N s/m and a spring",
        sticking=f"friction below {case.friction * case.normal_gravity * holds:.2g} m/s or so is a damper, R f = -b v",
        force=force,
        stepped=force,
        creep=case.mass * R / FRICTION_IMPEDANCE_RATIO * case.slope_gravity / b,
        creep_gradient=holds - case.time_step,
        tail=holds - case.time_step,
    )
