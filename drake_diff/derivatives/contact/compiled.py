"""The Jacobians of `jacobian` by compiled functions: the same equation, for steps without parameters."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, cross
from drake_diff._base.compiled import kernel
from drake_diff.derivatives import joint_impulses
from drake_diff.derivatives.contact import laws
from drake_diff.derivatives.contact.material import Material
from drake_diff.derivatives.contact.touching import AllPairs, Placed
from drake_diff.derivatives.couplers import Couplers
from drake_diff.derivatives.smooth_step import SmoothStep
from drake_diff.derivatives.steps import Steps
from drake_diff.mechanics.compiled_tree import CompiledTree, compiled_tree
from drake_diff.mechanics.description import Description
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, labelled

KERNEL = "drake_diff.derivatives.contact.kernel"
LAWS = {"sap": 0, "similar": 1, "lagged": 2}


@dataclass(frozen=True, eq=False)
class CompiledForm:
    """What of a model does not change from step to step, as the compiled functions take it."""

    tree: CompiledTree
    plant: tuple[object, ...]  # of kernel.Plant
    carriers: NDArray[np.intp]  # (bodies,) the link of each body of the pairs, -1 of the world
    by_body: Array  # (bodies, nv)

    def __call__(
        self, smooth: SmoothStep, steps: Steps, pairs: AllPairs, material: Material
    ) -> tuple[Array, Array, dict[int, str], Placed]:
        """(N, nx, nx + nu), sizes (N, 3) of `kernel.step_jacobians`, and as `jacobian.contact_jacobians`."""
        nq, compiled, N = smooth.coordinates.nq, kernel(KERNEL), len(steps)
        parts = steps.xs[:, :nq], steps.xs[:, nq:], steps.x_next[:, nq:]
        q, v, v_next = (np.ascontiguousarray(part) for part in parts)
        moved = self.tree(q, v, (v_next - v) / smooth.time_step)
        placed = pairs.place(steps, self._poses(moved.poses))
        contacts, unknown = self._contacts(pairs, placed, moved.S, material)
        force, clipped = smooth.force_of(q, v, steps.us)
        if clipped is None:
            clipped = np.zeros(steps.us.shape, dtype=bool)
        jacobians, sizes = np.empty((N, steps.model.nx, steps.model.nx + steps.model.nu)), np.empty((N, 3))
        compiled.step_jacobians(
            compiled.Plant(*self.plant),
            compiled.Touching(*contacts),
            q,
            v,
            v_next,
            steps.xs[:, smooth.positions],
            force,
            clipped,
            moved.S,
            moved.mass,
            moved.slope,
            moved.tau,
            moved.by_q,
            moved.by_v,
            jacobians,
            sizes,
        )
        return jacobians, sizes, unknown, placed

    def _contacts(
        self, pairs: AllPairs, placed: Placed, S: Array, material: Material
    ) -> tuple[tuple[Array, ...], dict[int, str]]:
        """What kernel.Touching has, and the states with contacts of which it is not known how they change, and why."""
        touch = pairs.touching(placed)
        first, second = self.by_body[pairs.sides[touch.pair].T]
        unknown: dict[int, str] = {}
        if len(placed.found):
            angular, linear = S[touch.state, :, :3], S[touch.state, :, 3:]
            twists = np.concatenate([linear + cross(angular, touch.middle[:, None, :]), angular], axis=-1)
            unknown = pairs.complete(touch, placed, (first - second)[..., None] * twists)
        pair = touch.pair
        point, change = touch.at(material.other_part[pair])
        of_material = (material.friction, material.stiffness, material.time, material.dissipation)
        parts = [first, second, point, touch.normal, touch.phi, change, *(of[pair] for of in of_material)]
        if len(placed.found):  # which come after those of spheres
            order = np.argsort(touch.state, kind="stable")
            parts = [part[order] for part in parts]
        begins = np.searchsorted(np.sort(touch.state), np.arange(len(S) + 1))
        return (begins, *parts), unknown

    def _poses(self, links: Array) -> Array:
        """(N, bodies, 3, 4) of the bodies of the pairs."""
        poses = links[:, self.carriers]
        poses[:, self.carriers < 0] = np.eye(3, 4)
        return poses


def compiled_form(
    model: Model,
    smooth: SmoothStep,
    description: Description,
    *,
    pairs: AllPairs,
    by_body: Array,
    moves: Array,
    controlled: Array,
    couplers: Couplers,
    near_rigid: float,
) -> CompiledForm | None:
    """None where Numba is not installed, or the tree is none that is compiled."""
    tree = compiled_tree(description)
    if tree is None:
        return None
    labels = {body.index(): label for label, body in labelled(bodies(model.plant)).items()}
    carriers = [tree.links.get(labels.get(body.index(), ""), -1) for body in pairs.bodies]
    of = smooth.coordinates
    places = (np.array(found, dtype=np.int64).reshape(-1, 2) for found in (of.free, of.single))
    plant = (
        smooth.time_step,
        LAWS[model.contract.contact.approximation],
        near_rigid,
        (laws.SIGMA, laws.SOFT_NORM, laws.STICTION_TOLERANCE),
        (joint_impulses.NEAR_RIGID, joint_impulses.LIMIT_STIFFNESS, joint_impulses.LIMIT_WINDOW),
        moves,
        smooth.dynamics.armature,
        controlled,
        smooth.stiffness,
        smooth.damping,
        smooth.form.actuation,
        smooth.limits,
        couplers.direction,
        couplers.offset,
        *places,
    )
    whole = tuple(np.ascontiguousarray(part) if isinstance(part, np.ndarray) else part for part in plant)
    return CompiledForm(tree, whole, np.array(carriers, dtype=np.intp), np.ascontiguousarray(by_body))
