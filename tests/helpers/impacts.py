"""Rigid impacts of a point of a robot with a floor, from Drake's mass matrix and Jacobian alone: a referee.

Impulses by proximal iteration on Coulomb's cone (Alart and Curnier, 1991): nothing of the toolkit is in it.
"""

import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable

FLOOR = np.array([0.0, 0.0, 1.0])


class Floor:
    """The lowest point of a ball of that radius [m] at a point of a body, against the plane z = 0."""

    def __init__(self, plant, body, radius=0.0, at=(0.0, 0.0, 0.0)):
        self.plant, self.context = plant, plant.CreateDefaultContext()
        self.body, self.radius = plant.GetBodyByName(body), radius
        self.at = np.array(at, dtype=float)
        self.nq = plant.num_positions()

    def terms(self, x):
        """M (nv, nv), J (3, nv) and the gap [m]."""
        plant, world = self.plant, self.plant.world_frame()
        plant.SetPositionsAndVelocities(self.context, x)
        pose = plant.EvalBodyPoseInWorld(self.context, self.body)
        down = self.at + pose.rotation().matrix().T @ (-self.radius * FLOOR)
        J = plant.CalcJacobianTranslationalVelocity(
            self.context, JacobianWrtVariable.kV, self.body.body_frame(), down, world, world
        )
        return plant.CalcMassMatrix(self.context), J, (pose @ self.at)[2] - self.radius

    def after(self, x, restitution, friction, *, poisson=False):
        """(nx,) the state after an impact."""
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
        """(nx, nx) central differences of `after`."""
        ends = [
            [self.after(x + s * width * e, restitution, friction, poisson=poisson) for e in np.eye(len(x))]
            for s in (1, -1)
        ]
        return (np.array(ends[0]) - np.array(ends[1])).T / (2 * width)


def impulse(W, w, speed, least, friction):
    """(3,) of the cone |P_t| <= friction P_n that makes the normal velocity `speed`, at least `least` along z."""
    P, step = np.zeros(3), 1.0 / np.max(np.linalg.eigvalsh(W))
    for _ in range(200_000):
        u = w + W @ P
        new = P.copy()
        new[2] = max(least, P[2] - step * (u[2] - speed))
        along = P[:2] - step * u[:2]
        most, size = friction * new[2], np.linalg.norm(along)
        new[:2] = along if size <= most else along * (most / size)
        if np.max(np.abs(new - P)) <= 1e-17 + 1e-15 * np.max(np.abs(P)):
            return new
        P = new
    return np.full(3, np.nan)
