"""The Jacobian of a step in independent coordinates from that of the whole plant.

With mimic joints reduced a step is that of the whole plant, from q = r q_own + offset and v = E v_own, whose velocities
v' are then brought back as an impulse on the joints would: with A the mass matrix and h D,

    E' A (v' - E v_own') = 0,   so   E' A E dv_own' = E' (A dv' + dA (v' - E v_own'))

and q' = q + h N(q) E v_own'.
"""

from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.refusal import Refusal
from drake_diff.derivatives.smooth_step import SmoothStep
from drake_diff.derivatives.steps import Flags, Steps, take_steps
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.tree import TreeDynamics, tree_of
from drake_diff.model.mimic import Coupling
from drake_diff.model.model import Model
from drake_diff.model.step import set_state

SAME_END = 1e-10  # of x': both are of Drake's own step, projected by the same matrix


@dataclass(frozen=True, eq=False)
class Reduced:
    """What of a model with reduced mimic joints does not change from step to step."""

    coupling: Coupling
    tree: TreeDynamics  # of the whole plant
    smooth: SmoothStep

    @classmethod
    def of(cls, model: Model, coupling: Coupling, smooth: SmoothStep) -> "Reduced":
        """Of the smooth step of `model.whole`; raises ModelError where its tree is none of ours."""
        tree = tree_of(model.whole, free=True)
        if isinstance(tree, Refusal):
            raise ModelError(str(tree))
        return cls(coupling, tree, smooth)

    def whole(self, steps: Steps) -> tuple[Steps, Flags]:
        """The same steps of the whole plant, and which (N,) of them lead where these do."""
        model = steps.model
        xs = self.coupling.state(steps.xs)
        found, same = take_steps(model.whole, steps.vector, xs[0], steps.us, xs), np.empty(len(steps), dtype=bool)
        for k, (x, x_next) in enumerate(zip(steps.xs, steps.x_next, strict=True)):
            set_state(model.double, x)
            gap = np.abs(model.double.next_state(found.x_next[k]) - x_next)
            same[k] = bool(np.all(gap <= SAME_END * np.maximum(1.0, np.abs(x_next))))
        return found, same

    def jacobians(self, steps: Steps, whole: Steps, of_whole: Array) -> Array:
        """(N, nx, nx + nu) from those of the whole plant."""
        coupling, c, h = self.coupling, self.smooth.coordinates, self.smooth.time_step
        E, nq, nx = coupling.spread, len(coupling.own_q), steps.model.nx
        into = np.zeros((whole.model.nx, nx))  # of the own state into the whole one
        into[np.arange(c.nq), coupling.of_q] = coupling.ratio_q
        into[c.nq :, nq:] = E
        chained = np.concatenate([of_whole[:, :, : whole.model.nx] @ into, of_whole[:, :, whole.model.nx :]], axis=2)
        q, v_next = whole.xs[:, : c.nq], steps.x_next[:, nq:] @ E.T
        moving = self.tree.moving(self.tree.place_all(whole.model, q), np.zeros((len(q), c.nv)))
        A = moving.mass + np.diag(self.smooth.dynamics.armature)
        right = A @ chained[:, c.nq :]
        slack = whole.x_next[:, c.nq :] - v_next
        by_motion = moving.derivatives(slack)[1] - moving.derivatives(np.zeros_like(slack))[1]  # of M slack
        right[:, :, :nq] += by_motion @ c.motion(q) @ into[: c.nq, :nq]
        velocities = np.linalg.solve(E.T @ A @ E, E.T @ right)
        positions = h * c.rate(q) @ (E @ velocities)
        positions[:, :, :nq] += (np.eye(c.nq) + h * c.rate_by_position(v_next)) @ into[: c.nq, :nq]
        return np.concatenate([positions[:, coupling.own_q], velocities], axis=1)
