"""Reference for rigid impacts of a robot's point with a floor, from Drake's mass matrix and Jacobian alone.

The impulse of a sliding contact is found by a search for the sliding angle. No code of the toolkit is used.
"""

import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable
from scipy.optimize import brentq

FLOOR = np.array([0.0, 0.0, 1.0])


class Floor:
    """The plane z = 0 and the lowest point of a ball with this radius [m], centered at a point of a body."""

    def __init__(self, plant, body, radius=0.0, at=(0.0, 0.0, 0.0)):
        self.plant, self.context = plant, plant.CreateDefaultContext()
        self.body, self.radius = plant.GetBodyByName(body), radius
        self.at = np.array(at, dtype=float)
        self.nq = plant.num_positions()

    def terms(self, x):
        """Return M (nv, nv), J (3, nv) and the gap [m]."""
        plant, world = self.plant, self.plant.world_frame()
        plant.SetPositionsAndVelocities(self.context, x)
        pose = plant.EvalBodyPoseInWorld(self.context, self.body)
        down = self.at + pose.rotation().matrix().T @ (-self.radius * FLOOR)
        J = plant.CalcJacobianTranslationalVelocity(
            self.context, JacobianWrtVariable.kV, self.body.body_frame(), down, world, world
        )
        return plant.CalcMassMatrix(self.context), J, (pose @ self.at)[2] - self.radius

    def after(self, x, restitution, friction, *, poisson=False):
        """Return the state (nx,) after an impact."""
        M, J, _ = self.terms(x)
        v, pushed = x[self.nq :], np.linalg.solve(M, J.T)
        W, w = J @ pushed, J @ v
        if not poisson:
            P = impulse(W, w, -restitution * w[2], 0.0, friction)
        else:
            first = impulse(W, w, 0.0, 0.0, friction)
            P = first + impulse(W, w + W @ first, 0.0, restitution * first[2], friction)
        return np.concatenate([x[: self.nq], v + pushed @ P])

    def slopes(self, x, restitution, friction, *, poisson=False, width=1e-6):
        """Return central differences (nx, nx) of `after` with respect to the state."""
        ends = [
            [self.after(x + s * width * e, restitution, friction, poisson=poisson) for e in np.eye(len(x))]
            for s in (1, -1)
        ]
        return (np.array(ends[0]) - np.array(ends[1])).T / (2 * width)


def impulse(W, w, speed, least, friction):
    """Return P (3,) with |P_t| <= friction P_n for a normal velocity `speed`, or a larger one if P_n = `least`.

    The contact sticks if the cone contains this impulse. Otherwise it slides along an angle without transverse slip.
    """
    for parts in (False, True):  # separation with `speed`, or faster with the normal impulse `least`
        P = _sticking(W, w, speed, least, parts)
        if np.hypot(*P[:2]) > friction * P[2] + 1e-14 or P[2] < 0:
            P = _sliding(W, w, speed, least, friction, parts)
        if P is not None and P[2] >= least - 1e-14 and (w + W @ P)[2] >= speed - 1e-12:
            return P
    return np.full(3, np.nan)


def _sticking(W, w, speed, least, parts):
    A, b = W.copy(), np.array([-w[0], -w[1], speed - w[2]])
    if parts:
        A[2], b[2] = [0, 0, 1], least
    return np.linalg.lstsq(A, b, rcond=1e-12)[0]  # W is singular for a planar body, which stays in its plane


def _sliding(W, w, speed, least, friction, parts):
    def at(angle):
        """Return the slip across and along the angle and P, each multiplied by `size`, and `size`."""
        d = np.array([np.cos(angle), np.sin(angle), 0.0])
        way = FLOOR - friction * d
        push, size = (least, 1.0) if parts else (speed - w[2], W[2] @ way)
        u = size * w + push * (W @ way)
        return d[0] * u[1] - d[1] * u[0], d @ u, push * way, size

    if friction == 0:
        return at(0.0)[2] / at(0.0)[3]
    angles = np.linspace(-0.123, 2 * np.pi - 0.123, 25)
    across = [at(angle)[0] for angle in angles]
    for low, high, one, other in zip(angles[:-1], angles[1:], across[:-1], across[1:], strict=True):
        if one * other <= 0:
            _, along, P, size = at(brentq(lambda angle: at(angle)[0], low, high, xtol=1e-15))
            is_known = abs(size) > 1e-9 * (1.0 if parts else np.trace(W))  # otherwise 0 is divided by 0
            if is_known and along * size > 0 and P[2] * size >= 0:
                return P / size
    return None
