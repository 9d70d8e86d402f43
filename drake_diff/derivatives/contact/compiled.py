"""The Jacobians of `jacobian` by compiled functions: the same equation, for steps without parameters."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, cross, own_array
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
    spheres: tuple[Array, ...]  # of kernel.Spheres
    sides: NDArray[np.int64]  # (P, 2)
    by_body: Array  # (bodies, nv)
    carriers: NDArray[np.intp]  # (bodies,) the link of each body of the pairs, -1 of the world

    def __call__(
        self, smooth: SmoothStep, steps: Steps, pairs: AllPairs, material: Material
    ) -> tuple[Array, Array, dict[int, str], Placed]:
        """(N, nx, nx + nu), sizes (N, 3) of `kernel.step_jacobians`, and as `jacobian.contact_jacobians`."""
        nq, compiled, N = smooth.coordinates.nq, kernel(KERNEL), len(steps)
        parts = steps.xs[:, :nq], steps.xs[:, nq:], steps.x_next[:, nq:]
        q, v, v_next = (own_array(part) for part in parts)
        moved = self.tree(q, v, (v_next - v) / smooth.time_step)
        placed = pairs.place(steps, self._poses(moved.poses))
        of = (material.friction, material.stiffness, material.time, material.dissipation, material.other_part)
        of_pairs = compiled.Pairs(self.sides, self.by_body, *(own_array(part) for part in of))
        contacts, unknown = self._of_spheres(of_pairs, placed.poses), dict[int, str]()
        if len(placed.found):
            contacts, unknown = self._with_others(contacts, pairs, placed, moved.S, material)
        force, clipped = smooth.force_of(q, v, steps.us)
        if clipped is None:
            clipped = np.zeros(steps.us.shape, dtype=bool)
        jacobians, sizes = np.empty((N, steps.model.nx, steps.model.nx + steps.model.nu)), np.empty((N, 3))
        compiled.step_jacobians(
            compiled.Plant(*self.plant),
            of_pairs,
            contacts,
            q,
            v,
            v_next,
            own_array(steps.xs[:, smooth.positions]),
            own_array(force),
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

    def _of_spheres(self, of_pairs: Any, poses: Array) -> Any:
        """The kernel.Touching of the pairs with a sphere."""
        compiled, N = kernel(KERNEL), len(poses)
        spheres, first = compiled.Spheres(*self.spheres), np.empty(N + 1, dtype=np.int64)
        pair = np.empty(N * len(spheres.radius), dtype=np.int64)
        M = compiled.overlapping(spheres, self.sides, poses, first, pair)
        parts = np.empty((M, 3)), np.empty((M, 3)), np.empty(M), np.empty((M, 7, 6))
        contacts = compiled.Touching(first, pair[:M], *parts)
        compiled.touch(spheres, of_pairs, poses, contacts)
        return contacts

    def _with_others(
        self, spheres: Any, pairs: AllPairs, placed: Placed, S: Array, material: Material
    ) -> tuple[Any, dict[int, str]]:
        """The contacts of spheres and those that SceneGraph found; in which states it is not known how these change."""
        touch = pairs.found(placed)
        first, second = self.by_body[pairs.sides[touch.pair].T]
        angular, linear = S[touch.state, :, :3], S[touch.state, :, 3:]
        twists = np.concatenate([linear + cross(angular, touch.middle[:, None, :]), angular], axis=-1)
        unknown = pairs.complete(touch, placed, (first - second)[..., None] * twists)
        point, change = touch.at(material.other_part[touch.pair])
        state = np.concatenate([np.repeat(np.arange(len(S)), np.diff(spheres.first)), touch.state])
        order = np.argsort(state, kind="stable")
        parts = zip(spheres[1:], (touch.pair, point, touch.normal, touch.phi, change), strict=True)
        begins = np.searchsorted(state[order], np.arange(len(S) + 1))
        return type(spheres)(own_array(begins), *(own_array(np.concatenate(part)[order]) for part in parts)), unknown

    def _poses(self, links: Array) -> Array:
        """(N, bodies, 3, 4) of the bodies of the pairs."""
        poses = own_array(links[:, self.carriers])
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
    whole = tuple(own_array(part) if isinstance(part, np.ndarray) else part for part in plant)
    of_spheres = pairs.spheres
    spheres = (
        of_spheres.center,
        of_spheres.radius,
        of_spheres.rotation,
        of_spheres.position,
        of_spheres.lower,
        of_spheres.upper,
        of_spheres.rounding,
    )
    return CompiledForm(
        tree=tree,
        plant=whole,
        spheres=tuple(own_array(part) for part in spheres),
        sides=own_array(pairs.sides),
        by_body=own_array(by_body),
        carriers=np.array(carriers, dtype=np.intp),
    )
