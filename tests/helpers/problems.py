"""Problems with known optima, and pushes through contact."""

import math

import numpy as np

import drake_diff as dd
from helpers.models import MODELS
from helpers.plants import block

DOUBLE_INTEGRATOR = (0.1, 20, np.eye(2), 0.1, 10 * np.eye(2))
OTHERS = [
    DOUBLE_INTEGRATOR,
    (0.05, 33, np.diag([3.0, 0.5]), 0.7, np.diag([2.0, 0.1])),
    (0.2, 7, np.array([[2.0, 0.5], [0.5, 1.0]]), 3.0, np.array([[4.0, -1.0], [-1.0, 9.0]])),
]


def lqr(h, count, Q, R, Qf, **fields):
    """Return an LQR problem. The running cost is a rate, so that weights divided by h give sums without h."""
    costs = {"running_cost": dd.QuadraticCost(Q=Q / h, R=[[R / h]]), "final_cost": dd.QuadraticCost(Q=Qf)}
    return dd.Problem(block(time_step=h), **{"x0": [1, 0], "num_steps": count, **costs, **fields})


def riccati(h, count, Q, R, Qf):
    """Return (P0, gains K_0 ... K_N-1) of the double integrator with symplectic Euler steps."""
    A, B = np.array([[1, h], [0, 1]]), np.array([[h**2], [h]])
    P, gains = np.array(Qf, dtype=float), []
    for _ in range(count):
        gains.append(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A))
        P = Q + A.T @ P @ (A - B @ gains[-1])
    return P, gains[::-1]


SOFT = {
    "running_cost": dd.QuadraticCost(Q=np.diag([0.1, 0.01]), R=[[0.1]], x_ref=[np.pi, 0]),
    "final_cost": dd.QuadraticCost(Q=np.diag([50, 5]), x_ref=[np.pi, 0]),
}


def pendulum(**changes):
    fields = {"x0": [0, 0], "num_steps": 100, **SOFT, **changes}
    return dd.Problem(dd.load_model(MODELS / "pendulum.urdf", time_step=0.02), **fields)


FREE = math.nan


def push(model, *, gap, goal, num_steps=50, **more):
    given = {"x_goal": [FREE, goal, FREE, FREE]} | more
    effort = dd.QuadraticCost(Q=np.zeros((4, 4)), R=[[1e-3]])
    return dd.Problem(model, x0=[0, 0.2 + gap, 0, 0], num_steps=num_steps, running_cost=effort, **given)
