"""The Jacobian of a step with contact or at joint limits from its own equation, without differentiating Drake's solver.

Drake's step solves A (v' - v*) = sum_c J_c' g_c(J_c v'), with A = M + h D, v* the velocity without impulses and g_c the
impulse of contact c (see `laws`), of a joint limit or of a coupler (see `joint_impulses`). PD controllers within their
effort limits are part of D. At Drake's own v', the step is a smooth step under a known force A (v' - v*) / h. Its
inverse dynamics are differentiated, and the effect of the impulses is computed from

    (A + sum_c J_c' G_c J_c) dv' = A dv'|_g + sum_c d(J_c' g_c)|_v',   G_c = -dg_c / d(J_c v').

The residual of the equation at v' is checked in the norm of Drake's solver and to its tolerance. Missing forces, such
as those of an unsupported shape, are detected by this check. `kernel` implements the arithmetic.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, cross, own_array
from drake_diff._base.values import Refusal
from drake_diff.derivatives import joint_impulses
from drake_diff.derivatives.contact import kernel, laws
from drake_diff.derivatives.contact.active_contacts import AllPairs, Placed, read_all_pairs, topology_of
from drake_diff.derivatives.contact.laws import Material, read_material
from drake_diff.derivatives.joint_impulses import couplers_of
from drake_diff.derivatives.smooth_step import SmoothStep
from drake_diff.derivatives.steps import Flags, Steps
from drake_diff.mechanics.description import describe_tree
from drake_diff.mechanics.tree import CompiledTree, compiled_tree
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, labelled

# Relative to the momentum: Drake's solver stops at 1e-6, in the same norm.
OPTIMALITY = 2e-6
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class ContactForm:
    """The data of a model with contact or joint limits that does not change from step to step, for the kernel."""

    pairs: AllPairs
    unknown: str  # why no contact of the model is supported; "" if some contact is
    tree: CompiledTree
    plant: tuple[Any, ...]  # the fields of kernel.Plant
    sides: NDArray[np.int64]  # (P, 2) body indices of the pairs
    by_body: Array  # (bodies, nv) 1 where a degree of freedom moves the body
    carriers: NDArray[np.intp]  # (bodies,) the link of each body of the pairs, -1 for the world

    def poses(self, links: Array) -> Array:
        """Return the poses (N, bodies, 3, 4) of the bodies of the pairs, from the poses of the links."""
        poses = own_array(links[:, self.carriers])
        poses[:, self.carriers < 0] = np.eye(3, 4)
        return poses

    def contacts(self, of_pairs: Any, placed: Placed, S: Array, material: Material) -> tuple[Any, dict[int, str]]:
        """Return the kernel.Touching of all pairs, and the states with unknown derivatives of SceneGraph's contacts."""
        spheres = self.pairs.spheres.overlapping(of_pairs, placed.poses)
        if not len(placed.found):
            return spheres, {}
        touch = self.pairs.of_scene_graph(placed)
        first, second = self.by_body[self.pairs.sides[touch.pair].T]
        angular, linear = S[touch.state, :, :3], S[touch.state, :, 3:]
        twists = np.concatenate([linear + cross(angular, touch.middle[:, None, :]), angular], axis=-1)
        unknown = self.pairs.complete(touch, placed, (first - second)[..., None] * twists)
        point, change = touch.contact_points(material.other_part[touch.pair])
        state = np.concatenate([np.repeat(np.arange(len(S)), np.diff(spheres.first)), touch.state])
        order = np.argsort(state, kind="stable")
        parts = zip(spheres[1:], (touch.pair, point, touch.normal, touch.phi, change), strict=True)
        begins = np.searchsorted(state[order], np.arange(len(S) + 1))
        return type(spheres)(own_array(begins), *(own_array(np.concatenate(array)[order]) for array in parts)), unknown


def contact_form(model: Model, smooth: SmoothStep) -> ContactForm | Refusal:
    """Return the form of a model, cached, or a Refusal if it describes no step in which impulses act."""
    return model.cache("contact form", lambda: _read(model, smooth), of_structure=True)


def _read(model: Model, smooth: SmoothStep) -> ContactForm | Refusal:
    contact, description = model.contract.contact, describe_tree(model)
    couplers, tree = couplers_of(model), compiled_tree(description)
    if isinstance(couplers, Refusal):
        return couplers
    if model.file_facts.held_points:
        return Refusal("loops are closed")
    if tree is None:
        return Refusal("a free body is not joined to the world by its own frame")
    pairs, unknown = read_all_pairs(model), ""
    if contact.model != "point":
        unknown = f"the contact model is {contact.model}, not point"
    elif not pairs.ids:
        unknown = "none of its geometries may collide"
    topology = topology_of(description)
    labels = {body.index(): label for label, body in labelled(bodies(model.plant)).items()}
    names = [labels.get(body.index(), "world") for body in pairs.bodies]
    plant = (
        model.time_step,
        laws.LAWS[contact.approximation],
        float(model.plant.get_sap_near_rigid_threshold()),
        (laws.SIGMA, laws.SOFT_NORM, laws.STICTION_TOLERANCE),
        (joint_impulses.NEAR_RIGID, joint_impulses.LIMIT_STIFFNESS, joint_impulses.LIMIT_WINDOW),
        topology.moves,
        smooth.dynamics.armature,
        _of_controllers(smooth),
        smooth.stiffness,
        smooth.damping,
        smooth.form.actuation,
        smooth.limits,
        couplers.direction,
        couplers.offset,
        *smooth.coordinates.starts,
    )
    return ContactForm(
        pairs=pairs,
        unknown=unknown,
        tree=tree,
        plant=tuple(own_array(value) if isinstance(value, np.ndarray) else value for value in plant),
        sides=own_array(pairs.sides),
        by_body=own_array(np.array([topology.bodies[name] for name in names]).reshape(-1, model.nv)),
        carriers=np.array([tree.links.get(name, -1) for name in names], dtype=np.intp),
    )


def _of_controllers(smooth: SmoothStep) -> Array:
    """Return h (kd + h kp) (nv,): a controller within its effort limit acts on v' as a spring and a damper."""
    (kp, kd), h, added = smooth.form.gains(), smooth.time_step, np.zeros(smooth.coordinates.nv)
    np.add.at(added, smooth.form.velocity, h * (kd + h * kp))
    return added


def material_of(model: Model, form: ContactForm) -> Material:
    """Return the model's own material, cached, or the material with the applied parameters."""
    if model.has_other_parameters:
        return read_material(model.double, form.pairs)
    return model.cache("contact material", lambda: read_material(model.double, form.pairs))


def contact_jacobians(
    form: ContactForm, smooth: SmoothStep, steps: Steps, material: Material, change: Material | None
) -> tuple[Array, Flags, dict[int, str], Placed]:
    """Return the Jacobians (N, nx, nx + nu + np), which steps (N,) agree with Drake, reasons, and the bodies' places.

    If a step that does not agree has no reason, its equation differs from Drake's.
    """
    nq, N = smooth.coordinates.nq, len(steps)
    parts = steps.xs[:, :nq], steps.xs[:, nq:], steps.x_next[:, nq:]
    q, v, v_next = (own_array(array) for array in parts)
    moved = form.tree(q, v, (v_next - v) / smooth.time_step)
    placed = form.pairs.locate(steps, form.poses(moved.poses))
    count = 0 if change is None else change.friction.shape[1]
    changes = np.zeros((5, len(form.sides), 0)) if change is None else np.array(change.of_pairs)
    of_pairs = kernel.Pairs(form.sides, form.by_body, *map(own_array, (*material.of_pairs, changes)))
    contacts, unknown = form.contacts(of_pairs, placed, moved.S, material)
    force, clipped = smooth.force_of(q, v, steps.us)
    if clipped is None:
        clipped = np.zeros(steps.us.shape, dtype=bool)
    jacobians, sizes = np.empty((N, steps.model.nx, steps.model.nx + steps.model.nu + count)), np.empty((N, 3))
    kernel.step_jacobians(
        kernel.Plant(*form.plant),
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
    # The residual must be within the tolerance of Drake's solver, in its norm.
    missing, had, given = sizes.T
    known = missing <= OPTIMALITY * np.maximum(had, given) + ROUNDING
    known &= np.isfinite(jacobians).all(axis=(1, 2))
    known[list(unknown)] = False
    return jacobians, known, unknown, placed
