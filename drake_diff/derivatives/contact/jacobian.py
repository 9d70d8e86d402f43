"""The Jacobian of a step with contact or at joint limits from its own equation, without differentiating Drake's solver.

Drake's step solves A (v' - v*) = sum_c J_c' g_c(J_c v'), with A = M + h D, v* the velocity without impulses and g_c the
impulse of contact c (see `laws`), of a joint's limit or of a coupler (see `joint_impulses`). PD controllers
within their effort limits are part of D. At Drake's own v' it is a
smooth step under a known force A (v' - v*) / h, which Pinocchio differentiates (see `smooth_step`); what the impulses
change is solved for:

    (A + sum_c J_c' G_c J_c) dv' = A dv'|_g + sum_c d(J_c' g_c)|_v',   G_c = -dg_c / d(J_c v').

That v' solves the equation is checked, in the norm and to the tolerance of Drake's solver. What is left out here, as a
shape that is not known, shows there.
"""

from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array, cross
from drake_diff._base.refusal import Refusal
from drake_diff.derivatives.contact import laws
from drake_diff.derivatives.contact.compiled import CompiledForm, compiled_form
from drake_diff.derivatives.contact.kinematics import (
    Contacts,
    Topology,
    Weight,
    diagonal_slope,
    mass_matrix,
    topology_of,
)
from drake_diff.derivatives.contact.laws import Cone, HuntCrossley, HuntCrossleyImpulse, Impulse, StateChange
from drake_diff.derivatives.contact.material import Material, MaterialChange, read_material
from drake_diff.derivatives.contact.pairs import Indices
from drake_diff.derivatives.contact.touching import AllPairs, Placed, read_all_pairs
from drake_diff.derivatives.couplers import Couplers, couplers_of
from drake_diff.derivatives.joint_impulses import JointImpulses, gather, limit_impulses
from drake_diff.derivatives.smooth_step import Native, SmoothStep
from drake_diff.derivatives.steps import Flags, Steps
from drake_diff.mechanics.description import describe_tree
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, labelled

# Of the momentum: Drake's solver ends at 1e-6 of it, in the same norm.
OPTIMALITY = 2e-6
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class ContactForm:
    """What of a model with contact or joint limits does not change from step to step."""

    pairs: AllPairs
    unknown: str  # why no contact of the model is known here; empty where some is
    topology: Topology
    by_body: Array  # (bodies, nv) 1 where a degree of freedom moves the body
    armature: Array  # (nv, nv) of reflected inertia and h D, a diagonal; D is of PD controllers too
    controlled: Array  # (nv,) what of it is of PD controllers, which Drake counts among the impulses
    approximation: str
    time_step: float
    near_rigid: float
    couplers: Couplers
    compiled: CompiledForm | None  # the same for compiled functions; None where there are none of the model


def contact_form(model: Model, smooth: SmoothStep) -> ContactForm | Refusal:
    """Read once; else why the form describes no step of the model in which impulses act."""
    return model.cache("contact form", lambda: _read(model, smooth), of_structure=True)


def _read(model: Model, smooth: SmoothStep) -> ContactForm | Refusal:
    contact = model.contract.contact
    couplers = couplers_of(model)
    if isinstance(couplers, Refusal):
        return couplers
    pairs, unknown = read_all_pairs(model), ""
    if contact.model != "point":
        unknown = f"the contact model is {contact.model}, not point"
    elif not pairs.ids:
        unknown = "nothing of it may touch"
    description = describe_tree(model)
    topology = topology_of(description)
    labels = {body.index(): label for label, body in labelled(bodies(model.plant)).items()}
    found = [topology.bodies[labels.get(body.index(), "world")] for body in pairs.bodies]
    by_body, controlled = np.array(found).reshape(-1, model.nv), _of_controllers(smooth)
    near_rigid = float(model.plant.get_sap_near_rigid_threshold())
    return ContactForm(
        pairs=pairs,
        unknown=unknown,
        topology=topology,
        by_body=by_body,
        armature=np.diag(smooth.dynamics.armature),
        controlled=controlled,
        approximation=contact.approximation,
        time_step=model.time_step,
        near_rigid=near_rigid,
        couplers=couplers,
        compiled=compiled_form(
            model,
            smooth,
            description,
            pairs=pairs,
            by_body=by_body,
            moves=topology.moves,
            controlled=controlled,
            couplers=couplers,
            near_rigid=near_rigid,
        ),
    )


def _of_controllers(smooth: SmoothStep) -> Array:
    """(nv,) h (kd + h kp): a controller within its effort limit is a spring and a damper that act on v'."""
    (kp, kd), h, found = smooth.form.gains(), smooth.time_step, np.zeros(smooth.coordinates.nv)
    np.add.at(found, smooth.form.velocity, h * (kd + h * kp))
    return found


def material_of(model: Model, form: ContactForm) -> Material:
    """The model's own, read once, or with the parameters that are applied."""
    if model.has_other_parameters:
        return read_material(model.double, form.pairs)
    return model.cache("contact material", lambda: read_material(model.double, form.pairs))


@dataclass(frozen=True, eq=False)
class Solved:
    """N steps with M contacts, and impulses on joints, at Drake's own solution."""

    native: Native
    v_next: Array  # (N, nv)
    A: Array  # (N, nv, nv)
    contacts: Contacts
    speeds: tuple[Array, Array]  # v and v' (M, nv) of each contact's state
    diagonal: Array  # (N, nv) of A, but for controllers
    diagonal_slope: Array  # (N, nv, nv)
    weight: Weight
    impulse: Impulse | HuntCrossleyImpulse
    joints: JointImpulses
    push: Array  # (N, nv) sum_c J_c' g_c
    gained: Array  # (N, nv) A (v' - v*)

    def total(self, of_contacts: Array) -> Array:
        """(N, ...) the sums of what each contact adds (M, ...)."""
        return _sum(self.contacts.touch.state, of_contacts, len(self.v_next))


def contact_jacobians(
    form: ContactForm, smooth: SmoothStep, steps: Steps, material: Material, change: MaterialChange | None
) -> tuple[Array, Flags, dict[int, str], Placed]:
    """(N, nx, nx + nu + np) of steps, which (N,) are as Drake took them, why some are not, and where the bodies are.

    Where nothing is said of one that is not, its equation is not Drake's.
    """
    if form.compiled is None or change is not None:
        return numpy_jacobians(form, smooth, steps, material, change)
    jacobians, sizes, unknown, placed = form.compiled(smooth, steps, form.pairs, material)
    known = _is_solved(*sizes.T) & np.isfinite(jacobians).all(axis=(1, 2))
    known[list(unknown)] = False
    return jacobians, known, unknown, placed


def _is_solved(missing: Array, had: Array, given: Array) -> Flags:
    """Whether the momentum that the impulses do not account for is what Drake's solver leaves, in its norm."""
    return np.asarray(missing <= OPTIMALITY * np.maximum(had, given) + ROUNDING)


def numpy_jacobians(
    form: ContactForm, smooth: SmoothStep, steps: Steps, material: Material, change: MaterialChange | None
) -> tuple[Array, Flags, dict[int, str], Placed]:
    """`contact_jacobians` without compiled functions; the context is left at the last state."""
    placed = form.pairs.place(steps)
    at, nv = _at_the_solution(form, smooth, steps, placed, material), smooth.coordinates.nv
    right = at.A @ smooth.pushed(at.native, steps.us, at.gained / smooth.time_step)
    right[:, :, :nv] += at.total(_by_motion(at))
    if isinstance(at.impulse, HuntCrossleyImpulse):
        J, normal = at.contacts.jacobian, at.contacts.touch.normal[..., None]
        by_v = (J @ at.impulse.by_before()[..., None]) @ np.swapaxes(J @ normal, -1, -2)
        right[:, :, nv : 2 * nv] += at.total(by_v)
    if change is not None:
        right = np.concatenate([right, at.total(_by_material(at, change.part(at.contacts.touch.pair)))], axis=2)
    J = at.contacts.jacobian
    left = at.A - at.total(J @ at.impulse.by_velocity() @ J.swapaxes(-1, -2))
    joints = at.joints
    if len(joints.problem):
        slope = joints.at(at.v_next)[1]
        by_motion = joints.by_motion(at.v_next, at.diagonal, at.diagonal_slope, smooth.time_step)
        right[:, :, :nv] += _sum(joints.problem, joints.direction[:, :, None] * by_motion[:, None, :], len(steps))
        stiff = (slope[:, None] * joints.direction)[:, :, None] * joints.direction[:, None, :]
        left += _sum(joints.problem, stiff, len(steps))
    velocities = np.asarray(np.linalg.solve(left, right), dtype=float)
    jacobians, _ = smooth.assemble(at.native, velocities, at.v_next)
    momentum = (at.A @ at.v_next[..., None])[..., 0]
    known = _is_solved(*(np.sqrt((p * p / at.diagonal).sum(axis=1)) for p in (at.gained - at.push, momentum, at.push)))
    known[list(at.contacts.unknown)] = False
    return jacobians, known, at.contacts.unknown, placed


def _at_the_solution(form: ContactForm, smooth: SmoothStep, steps: Steps, placed: Placed, material: Material) -> Solved:
    nq = smooth.coordinates.nq
    native, v_next = smooth.into_native(steps.xs[:, :nq], steps.xs[:, nq:]), steps.x_next[:, nq:]
    S, inertia, v_star = smooth.motions(native, steps.us)
    A = mass_matrix(S, inertia, form.topology) + form.armature
    contacts = _contacts(form, placed, S, material)
    state = contacts.touch.state
    diagonal, speeds = np.einsum("kii->ki", A) - form.controlled, (native.v[state], v_next[state])
    weight = contacts.weight(diagonal[state])
    impulse = _law(form, contacts, material, weight, *speeds).solve()
    q = steps.xs[:, smooth.positions]
    joints = limit_impulses(smooth.limits, q, native.v, v_star, diagonal, smooth.time_step)
    if len(form.couplers.offset):
        joints.append(form.couplers.impulses(q, diagonal, smooth.time_step))
    on_joints = gather(joints, v_next.shape[1])
    push = _sum(state, (contacts.jacobian @ impulse.impulse[..., None])[..., 0], len(v_next))
    push += _sum(on_joints.problem, on_joints.direction * on_joints.at(v_next)[0][:, None], len(v_next))
    return Solved(
        native=native,
        v_next=v_next,
        A=A,
        contacts=contacts,
        speeds=speeds,
        diagonal=diagonal,
        diagonal_slope=diagonal_slope(S, inertia, form.topology),
        weight=weight,
        impulse=impulse,
        joints=on_joints,
        push=push,
        gained=(A @ (v_next - v_star)[..., None])[..., 0],
    )


def _by_motion(at: Solved) -> Array:
    """(M, nv, nv) the change of J' g with the degrees of freedom, v' being fixed."""
    contacts, (v, v_next) = at.contacts, at.speeds
    point, normal, phi = contacts.displacement()
    velocity = contacts.velocity_change(v_next, point)
    state = contacts.touch.state
    weight = contacts.weight_change(at.weight, at.diagonal[state], at.diagonal_slope[state], point)
    before = np.zeros(v.shape)
    if isinstance(at.impulse, HuntCrossleyImpulse):  # the only law that knows the normal velocity before the step
        along = contacts.velocity_change(v, point) @ contacts.touch.normal[:, :, None]
        before = (along + normal @ np.swapaxes(v[:, None, :] @ contacts.jacobian, -1, -2))[..., 0]
    changed = at.impulse.by_state(StateChange(velocity, normal, phi, weight, before))
    return contacts.force_change(at.impulse.impulse, point) + contacts.jacobian @ changed.swapaxes(-1, -2)


def _by_material(at: Solved, change: MaterialChange) -> Array:
    """(M, nv, np) the change of J' g by parameters: through the law, and through where on the normal p is."""
    contacts, touch, nothing = at.contacts, at.contacts.touch, np.zeros((*change.friction.shape, 3))
    point = -(touch.phi[:, None] * change.other_part)[..., None] * touch.normal[:, None]
    before, after = (contacts.velocity_change(v, point, moves=False) for v in at.speeds)
    weight = contacts.weight_change(at.weight, at.diagonal[touch.state], None, point)
    moved = StateChange(after, nothing, nothing[..., 0], weight, (before @ touch.normal[:, :, None])[..., 0])
    changed = np.swapaxes(at.impulse.by_material(change) + at.impulse.by_state(moved), -1, -2)
    return np.asarray(contacts.force_change(at.impulse.impulse, point, moves=False) + contacts.jacobian @ changed)


def _law(
    form: ContactForm, contacts: Contacts, material: Material, weight: Weight, v: Array, v_next: Array
) -> Cone | HuntCrossley:
    touch, pair, J = contacts.touch, contacts.touch.pair, contacts.jacobian
    before, after = ((u[:, None, :] @ J)[:, 0] for u in (v, v_next))
    friction, stiffness, h = material.friction[pair], material.stiffness[pair], form.time_step
    if form.approximation == "sap":
        time = material.time[pair]
        return Cone(after, touch.normal, touch.phi, weight.value, friction, stiffness, time, h, form.near_rigid)
    approach, n, phi, w = (before * touch.normal).sum(axis=-1), touch.normal, touch.phi, weight.value
    dissipation, lagged = material.dissipation[pair], form.approximation == "lagged"
    material_and_step = friction, stiffness, dissipation, h, laws.STICTION_TOLERANCE, lagged
    return HuntCrossley(after, approach, n, phi, w, *material_and_step)


def _contacts(form: ContactForm, placed: Placed, S: Array, material: Material) -> Contacts:
    pairs = form.pairs
    touch = pairs.touching(placed)
    own, (first, second) = S[touch.state], form.by_body[pairs.sides[touch.pair].T]
    linear, angular = own[..., :3], own[..., 3:]
    side, twists = (first - second)[..., None], linear + cross(angular, touch.middle[:, None, :])
    unknown = pairs.complete(touch, placed, side * np.concatenate([twists, angular], axis=-1))
    point, change = touch.at(material.other_part[touch.pair])
    return Contacts(
        touch=touch,
        moves=form.topology.moves,
        sphere=first,
        other=second,
        angular=angular,
        point=point,
        at_point=linear + cross(angular, point[:, None, :]),
        change=change,
        unknown=unknown,
    )


def _sum(at: Indices, of_contacts: Array, count: int) -> Array:
    """(N, ...) of contributions (M, ...) of contacts, each of one of N = `count` states."""
    total = np.zeros((count, *of_contacts.shape[1:]))
    np.add.at(total, at, of_contacts)
    return total
