"""Drake's discrete step solved to rounding.

If contact, joint limits, PD controllers or couplers act, Drake's step solves a convex problem and stops at

    |D (A (v' - v*) - j)| <= 1e-14 + 1e-6 max(|D A v'|, |D j|),    D = diag(A)^-1/2, j = J' g the impulses

(Castro, Permenter and Han, "An unconstrained convex formulation of compliant contact", 2022). This tolerance causes the
noise of its differences. `refine_steps` builds the same problem with Drake's mass matrix, forces and contacts, checks
that Drake's solution solves it within the same tolerance, and then solves it to rounding. If the check fails, the
problem differs from Drake's, and a Refusal states the difference.

For A = M + h D, v* the velocity without impulses and convex potentials l_c of contacts and joints, v' is the unique
minimum of

    l(v') = (v' - v*)' A (v' - v*) / 2 + sum_c l_c(J_c v'),

where A (v' - v*) = sum_c J_c' g_c(J_c v') with the impulses g_c = -dl_c / d(J_c v') (see `contact.laws` and
`joint_impulses`). A few Newton steps from Drake's solution reach rounding. A line search along each step finds the
minimum of l, for which it needs only the derivative of l along the step.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.tree import JacobianWrtVariable
from scipy.sparse.csgraph import connected_components

from drake_diff._base.arrays import Array, Indices, cross
from drake_diff._base.values import Refusal
from drake_diff.derivatives.contact.active_contacts import weigh
from drake_diff.derivatives.contact.laws import QUANTITIES, ContactLaw, combine
from drake_diff.derivatives.joint_impulses import (
    Controllers,
    Couplers,
    JointImpulses,
    couplers_of,
    gather,
    impulses_of_loops,
    limit_impulses,
    single_joints,
)
from drake_diff.derivatives.smooth_step import Form, form_of
from drake_diff.model.contract import SAP_RELATIVE_TOLERANCE
from drake_diff.model.loops import relative_motion
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied
from drake_diff.model.plant import joints, proximity_property
from drake_diff.model.step import advance, set_state

ROUNDING = 64 * float(np.finfo(float).eps)  # relative rounding error of the sums
SOLVED = 1e-12  # relative to the momentum; below, steps are taken as long as they halve the residual
MAX_STEPS = 60
BISECTIONS = 30


@dataclass(frozen=True, eq=False)
class ContactImpulses:
    """M contacts of N problems; the contacts of each problem are contiguous."""

    problem: Indices  # (M,)
    jacobian: Array  # (M, nv, 3) J'
    law: ContactLaw

    def subset(self, which: Indices) -> "ContactImpulses":
        """Return the contacts of some of the problems, in ascending order."""
        chosen = np.flatnonzero(np.isin(self.problem, which))
        problem = np.searchsorted(which, self.problem[chosen])
        return ContactImpulses(problem, self.jacobian[chosen], self.law.subset(chosen))

    def sums(self, values: Array, count: int) -> Array:
        """Return the sums (count, ...) of values (M, ...) over the contacts of each problem."""
        total = np.zeros((count, *values.shape[1:]))
        if len(values):
            first = np.flatnonzero(np.diff(self.problem, prepend=-1))
            total[self.problem[first]] = np.add.reduceat(values, first)
        return total

    def evaluate(self, v: Array) -> tuple[Array, Array]:
        """Return J' g (N, nv) at the velocities v (N, nv), and d(-J' g)/dv (N, nv, nv)."""
        J = self.jacobian
        impulse, slope = self.law.impulses((v[self.problem][:, None, :] @ J)[:, 0])
        push, stiffness = (J @ impulse[..., None])[..., 0], -J @ slope @ J.swapaxes(-1, -2)
        return self.sums(push, len(v)), self.sums(stiffness, len(v))


@dataclass(frozen=True, eq=False)
class Balance:
    """The residual of the momentum balance of N problems at some velocities."""

    missing: Array  # (N, nv) A (v' - v*) - J' g
    given: Array  # (N, nv) J' g
    curvature: Array  # (N, nv, nv) the second derivative of l


@dataclass(frozen=True, eq=False)
class ConvexSteps:
    """The convex problems of N steps."""

    A: Array  # (N, nv, nv)
    momentum: Array  # (N, nv) A v*, which is more accurate than v* if A is ill-conditioned
    contacts: ContactImpulses
    joints: JointImpulses
    same_tree: NDArray[np.bool_]  # (nv, nv)

    def subset(self, which: Indices) -> "ConvexSteps":
        """Return some of the problems."""
        contacts, joints = self.contacts.subset(which), self.joints.subset(which)
        return ConvexSteps(self.A[which], self.momentum[which], contacts, joints, self.same_tree)

    def taking_part(self) -> NDArray[np.bool_]:
        """Return the degrees of freedom (N, nv) of trees on which an impulse may act, for which Drake solves."""
        by_contacts = self.contacts.sums((self.contacts.jacobian != 0).any(axis=2).astype(float), len(self.A)) > 0
        return np.asarray((self.joints.reach() | by_contacts) @ self.same_tree)

    def evaluate(self, v: Array) -> Balance:
        """Return the balance at v (N, nv)."""
        j, (pull, stiffness) = self.joints.direction, self.joints.evaluate(v)
        by_contacts, curvature = self.contacts.evaluate(v)
        across = j.swapaxes(-1, -2)
        given = (across @ pull[..., None])[..., 0] + by_contacts
        curvature += self.A + across @ (stiffness[..., None] * j)
        had = (self.A @ v[..., None])[..., 0]
        return Balance(had - self.momentum - given, given, curvature)

    def norm(self, momentum: Array) -> Array:
        """Return the norm (N,) of Drake's solver, |diag(A)^-1/2 p|, for p (N, nv)."""
        return np.asarray(np.sqrt((momentum * momentum / np.einsum("kii->ki", self.A)).sum(axis=1)))

    def scale(self, v: Array, given: Array) -> Array:
        """Return the reference momentum (N,) of the relative tolerance in Drake's solver."""
        had = (self.A @ v[..., None])[..., 0]
        return np.asarray(np.maximum(self.norm(had), self.norm(given)))

    def rounding(self, v: Array, balance: Balance) -> Array:
        """Return the rounding error (N,) of the momentum balance at v (N, nv), due to sums and stiff impulses.

        The terms may be much larger than their sum, for example if a heavy tree has a light link.
        """
        of_sums = (np.abs(balance.curvature) @ np.abs(v)[..., None])[..., 0] + np.abs(self.momentum)
        return np.maximum(SOLVED * self.scale(v, balance.given), ROUNDING * self.norm(of_sums)) + np.finfo(float).tiny

    def solve(self, v: Array, balance: Balance) -> tuple[Array, NDArray[np.bool_]]:
        """Solve for v' (N, nv) to rounding from v (N, nv) with its balance; return also which (N,) converged."""
        v, reached = np.array(v), np.zeros(len(v), dtype=bool)
        open_, problems = np.arange(len(v)), self
        for _ in range(MAX_STEPS):
            v_open = v[open_]
            size = problems.norm(balance.missing)
            step = np.array(-np.linalg.solve(balance.curvature, balance.missing[..., None])[..., 0], dtype=float)
            ahead = problems.evaluate(v_open + step)
            ahead_size = problems.norm(ahead.missing)
            near = size <= problems.rounding(v_open, balance)
            last = near & (ahead_size >= size / 2)  # converged to rounding
            slope = (ahead.missing * step).sum(axis=1)
            search = ~near & (slope > 0) & (ahead_size > size / 2)  # the step ends beyond the minimum along it
            if search.any():
                which = np.flatnonzero(search)
                step[which] *= _along(problems.subset(which), v_open[which], step[which])[:, None]
            better = ~last | (ahead_size < size)
            v[open_[better]] = (v_open + step)[better]
            reached[open_[last]] = True
            if last.all():
                break
            if search.any() or last.any():
                open_, problems = open_[~last], problems.subset(np.flatnonzero(~last))
                balance = problems.evaluate(v[open_])
            else:
                balance = ahead
        return v, reached


def _along(problems: ConvexSteps, v: Array, step: Array) -> Array:
    """Return the fraction (N,) of each step (N, nv) that minimizes l along the step, if l increases at its end."""
    lower, upper = np.zeros(len(v)), np.ones(len(v))
    for _ in range(BISECTIONS):
        middle = (lower + upper) / 2
        falls = (problems.evaluate(v + middle[:, None] * step).missing * step).sum(axis=1) < 0
        lower, upper = np.where(falls, middle, lower), np.where(falls, upper, middle)
    return (lower + upper) / 2


# A, v* and J equal Drake's to rounding, and so does the residual that Drake compares with its tolerance.
DRAKES_STOP = SAP_RELATIVE_TOLERANCE * (1 + 1e-3)
AT_REST = 1e-14 / SAP_RELATIVE_TOLERANCE  # [J^1/2] 1e-14 is the solver's absolute tolerance
FREE_STEP = 1e-9  # relative to the momentum: without impulses Drake does not iterate, so only rounding errors remain


@dataclass(eq=False)
class RefinedSteps:
    """N steps solved to rounding; refused steps are NaN."""

    x_next: Array  # (N, nx)
    drake: Array  # (N, nx) end states of Drake's own steps
    acts: NDArray[np.bool_]  # (N,) whether an impulse may act, so that Drake uses its solver
    left: Array  # (N,) relative momentum residual of Drake's own step, at most 1e-6; NaN if not known
    missing: Array  # (N, nv) momentum residual of Drake's own step of the whole plant
    refused: dict[int, Refusal] = field(default_factory=dict)

    @classmethod
    def unknown(cls, xs: Array, nv: int) -> "RefinedSteps":
        """Return steps from xs (N, nx) without results."""
        unknown, N = np.full_like(xs, np.nan), len(xs)
        return cls(unknown, np.array(unknown), np.zeros(N, dtype=bool), np.full(N, np.nan), np.full((N, nv), np.nan))

    def put(self, which: Indices, some: "RefinedSteps") -> None:
        """Store the results of some of the steps."""
        for name in ("x_next", "drake", "acts", "left", "missing"):
            getattr(self, name)[which] = getattr(some, name)
        self.refused |= {int(which[k]): why for k, why in some.refused.items()}


def refine_steps(
    model: Model,
    vector: ParameterVector,
    xs: Array,
    us: Array,
    values: Array | None = None,
    held: Array | None = None,
) -> RefinedSteps:
    """Solve the steps from each of xs (N, nx) under each of us (N, nu); one call is much faster than single calls.

    `values` (N, np) are the parameters of each step, by default those of `vector`, which is applied. `held` (N, nv) is
    a constant momentum residual of each step. With the residual of Drake's solver at a point, the solution at this
    point is Drake's own, and differences around it are those of the equation at the point of the derivative.

    Raises SimulationError if Drake cannot compute a step.
    """
    if values is None or vector.step_entry is None:
        return _refine(model, vector, xs, us, values if vector.parameters else None, held)
    times, refined = np.array([vector.time_step(row) for row in values]), RefinedSteps.unknown(xs, model.whole.nv)
    for h in np.unique(times):
        which = np.flatnonzero(times == h)
        points = xs[which], us[which], values[which], None if held is None else held[which]
        if h == model.time_step:
            refined.put(which, _refine(model, vector, *points))
        else:
            with applied(vector.at(points[2][0])) as other:
                refined.put(which, _refine(other, vector.at(points[2][0]), *points))
    return refined


def solves_the_step(model: Model, x: Array, u: Array, end: Array) -> bool:
    """Check if `end` (nx,) solves the step from x (nx,) under u (nu,) within the tolerance of Drake's solver.

    Returns False if the step's equation is not known or differs from Drake's.
    """
    form, couplers = form_of(model), couplers_of(model)
    if model.coupling is not None or isinstance(couplers, Refusal) or form.driven:
        return False  # with reduced coordinates, the solver's residual in the others is not known from `end`
    drake = advance(model.double, x, u)
    read = _read(model, _Settings(np.asarray(model.double.damping()), *form.gains(), {}))
    if isinstance(read, Refusal):
        return False
    v_next = np.array([drake[model.nq :], end[model.nq :]])
    problems = _problems(model, form, [read, read], np.array([x, x]), np.array([u, u]), couplers)
    _, _, _, refused = _solved(problems, np.array([x, x])[:, model.nq :], v_next)
    moved = _states(model, x[None], v_next[1:])[0] - end
    return not refused and bool(np.all(np.abs(moved) <= FREE_STEP * np.maximum(1.0, np.abs(end))))


@contextmanager
def _written(model: Model, vector: ParameterVector, values: Array | None) -> Iterator[Callable[[int], None]]:
    """Provide a function that applies the parameters of a step, and restore those of the vector at the end."""
    if values is None:
        yield lambda k: None
        return
    try:
        yield lambda k: vector.write(model.double, values[k])
    finally:
        vector.write(model.double, vector.values)


def _refine(
    model: Model, vector: ParameterVector, xs: Array, us: Array, values: Array | None, held: Array | None
) -> RefinedSteps:
    """Solve steps of the same time step. Reduced coordinates are read from the whole plant's step, as in `advance`."""
    if model.coupling is None:
        return _refine_whole(model, vector, xs, us, values, held, couplers_of(model))
    refined = _refine_whole(model.whole, vector, model.coupling.state(xs), us, values, held, couplers_of(model))
    drake, x_next = np.empty_like(xs), np.full_like(xs, np.nan)
    with _written(model, vector, values) as write:
        for k, x in enumerate(xs):
            write(k)
            set_state(model.double, x)
            drake[k] = model.double.next_state(refined.drake[k])
            if k not in refined.refused:
                x_next[k] = model.double.next_state(refined.x_next[k])
    return replace(refined, drake=drake, x_next=x_next)


def _refine_whole(
    model: Model,
    vector: ParameterVector,
    xs: Array,
    us: Array,
    values: Array | None,
    held: Array | None,
    couplers: Couplers | Refusal,
) -> RefinedSteps:
    """Solve the steps in all coordinates of the plant."""
    form, refined = form_of(model), RefinedSteps.unknown(xs, model.nv)
    why = couplers.reason if isinstance(couplers, Refusal) else form.driven
    read: list[_Read] = []
    which: list[int] = []
    with _written(model, vector, values) as write:
        for k, (x, u) in enumerate(zip(xs, us, strict=True)):
            write(k)
            refined.drake[k] = advance(model.double, x, u)
            if not read or values is not None:
                settings = _Settings(np.asarray(model.double.damping()), *form.gains(), {})
            answer = Refusal(why) if why else _read(model, settings)
            if isinstance(answer, Refusal):
                refined.refused[k] = answer
            else:
                read.append(answer)
                which.append(k)
    if read:
        problems = _problems(model, form, read, xs[which], us[which], couplers)
        refined.acts[which] = problems.taking_part().any(axis=1)
        ends, refined.missing[which], refined.left[which], whys = _solved(
            problems, xs[which, model.nq :], refined.drake[which, model.nq :], None if held is None else held[which]
        )
        refined.x_next[which] = _states(model, xs[which], ends)
        refined.refused |= {which[i]: Refusal(reason) for i, reason in whys.items()}
        refined.x_next[list(refined.refused)] = np.nan
    return refined


@dataclass(frozen=True, eq=False)
class _Settings:
    """The data that parameters may change between steps."""

    damping: Array  # (nv,)
    kp: Array  # (nu,)
    kd: Array
    material: dict[Any, Array]  # by geometry, read at its first contact


@dataclass(frozen=True, eq=False)
class _Read:
    """The data of one step read from Drake."""

    settings: _Settings
    mass: Array  # (nv, nv)
    bias: Array  # (nv,) inverse dynamics at zero acceleration, minus applied forces
    contacts: list[tuple[Array, ...]]  # `_motions` of both bodies, then point, normal, phi, and material (2, 4)
    held: tuple[Array, Array]  # `relative_motion` of the points with loop constraints


def _read(model: Model, settings: _Settings) -> _Read | Refusal:
    """Read the data of the last step of the double twin."""
    contacts = _contacts(model, settings) if model.contract.contact.collision_pairs else []
    if isinstance(contacts, Refusal):
        return contacts
    mass = model.plant.CalcMassMatrix(model.double.context)
    held = relative_motion(model.plant, model.double.context, model.file_facts.held_points)
    return _Read(settings, mass, model.double.inverse_dynamics(np.zeros(model.nv)), contacts, held)


def _contacts(model: Model, settings: _Settings) -> list[tuple[Array, ...]] | Refusal:
    """Read each contact point in Drake's last step. See `_Read`."""
    plant, context = model.plant, model.double.context
    results = plant.get_contact_results_output_port().Eval(context)
    if results.num_hydroelastic_contacts():
        return Refusal("hydroelastic contact acts")
    motions: dict[Any, tuple[Array, Array]] = {}
    contacts: list[tuple[Array, ...]] = []
    for i in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(i)
        pair = info.point_pair()
        sides = [_material(model, settings, geometry) for geometry in (pair.id_A, pair.id_B)]
        for side in sides:
            if isinstance(side, Refusal):
                return side
        moves: list[Array] = []
        for index in (info.bodyA_index(), info.bodyB_index()):
            if index not in motions:
                motions[index] = _motions(model, plant.get_body(index))
            moves += motions[index]
        contacts.append((*moves, info.contact_point(), pair.nhat_BA_W, np.array(-pair.depth), np.array(sides)))
    return contacts


def _motions(model: Model, body: Any) -> tuple[Array, Array]:
    """Return the Jacobian (6, nv) of a body's spatial velocity [angular; linear] at its origin, and the origin (3,)."""
    plant, context = model.plant, model.double.context
    if body.index() == plant.world_body().index():
        return np.zeros((6, model.nv)), np.zeros(3)
    frame, world = body.body_frame(), plant.world_frame()
    moves = plant.CalcJacobianSpatialVelocity(context, JacobianWrtVariable.kV, frame, np.zeros(3), world, world)
    return moves, plant.EvalBodyPoseInWorld(context, body).translation()


def _material(model: Model, settings: _Settings, geometry: Any) -> Array | Refusal:
    """Return the QUANTITIES (4,) of a geometry, or a Refusal that names the missing one."""
    if geometry not in settings.material:
        inspector = model.double.inspector
        read = [proximity_property(inspector, geometry, quantity) for quantity in QUANTITIES]
        for quantity, value in zip(QUANTITIES, read, strict=True):
            if value is None:
                return Refusal(f"geometry {inspector.GetName(geometry)} has no {quantity} of its own")
        settings.material[geometry] = np.array(read, dtype=float)
    return settings.material[geometry]


def _problems(
    model: Model, form: Form, read: list[_Read], xs: Array, us: Array, couplers: Couplers | Refusal
) -> ConvexSteps:
    """Build the convex problems of N steps."""
    h, nq, diagonal = model.time_step, model.nq, np.arange(model.nv)
    controlled = np.full(model.nu, False)
    if form.pd:
        controlled[:] = [a.has_controller() for a in form.actuators]
    A = np.array([r.mass for r in read])
    A[:, diagonal, diagonal] += h * np.array([r.settings.damping for r in read])
    inputs = np.where(controlled, 0.0, np.clip(us, -form.limit, form.limit))  # a controller clips its total effort
    force = inputs @ form.actuation.T - np.array([r.bias for r in read])
    v, weights = xs[:, nq:], A[:, diagonal, diagonal]
    momentum = (A @ v[..., None])[..., 0] + h * force
    free = np.linalg.solve(A, momentum[..., None])[..., 0]
    positions, limits, _ = single_joints(model)
    q = xs[:, positions]
    parts = limit_impulses(limits, q, v, free, weights, h)
    if controlled.any():
        which = np.flatnonzero(controlled)
        kp, kd = (np.array([getattr(r.settings, name)[which] for r in read]) for name in ("kp", "kd"))
        command = np.where(form.commanded[which], us[:, which], 0.0)
        reference = form.reference[:, None, which] + np.stack([command, np.zeros_like(command)])
        pd = Controllers(form.velocity[which], kp, kd, reference, form.limit[which])
        parts.append(pd.impulses(q, us[:, which] - command, weights, h))
    if isinstance(couplers, Couplers) and len(couplers.offset):
        parts.append(couplers.impulses(q, weights, h))
    if model.file_facts.held_points:
        jacobians, differences = (np.array([r.held[i] for r in read]) for i in (0, 1))
        parts.append(impulses_of_loops(jacobians, differences, weights, h))
    return ConvexSteps(A, momentum, _contact_impulses(model, read, v, weights), gather(parts), _same_tree(model))


def _same_tree(model: Model) -> NDArray[np.bool_]:
    """Return whether two degrees of freedom belong to the same tree (nv, nv): Drake solves for whole trees only."""

    def read() -> NDArray[np.bool_]:
        count, tree = model.plant.num_bodies(), np.empty(model.nv, dtype=np.intp)
        world, linked = int(model.plant.world_body().index()), np.zeros((count, count), dtype=bool)
        ends = [(int(j.parent_body().index()), int(j.child_body().index())) for j in joints(model.plant)]
        for parent, child in ends:
            linked[parent, child] = world not in (parent, child)
        _, of_body = connected_components(linked, directed=False)
        for joint, (parent, child) in zip(joints(model.plant), ends, strict=True):
            start = joint.velocity_start()
            tree[start : start + joint.num_velocities()] = of_body[parent if child == world else child]
        return np.asarray(tree[:, None] == tree)

    return model.cache("same tree", read, of_structure=True)


def _contact_impulses(model: Model, read: list[_Read], v: Array, weights: Array) -> ContactImpulses:
    """Return the impulses of all contacts with relative motion; overlaps of two shapes of one body have no effect."""
    problem = np.repeat(np.arange(len(read)), [len(r.contacts) for r in read])
    shapes = (6, model.nv), (3,), (6, model.nv), (3,), (3,), (3,), (), (2, 4)
    columns = ([contact[i] for r in read for contact in r.contacts] for i in range(len(shapes)))
    moves_a, origin_a, moves_b, origin_b, point, normal, phi, sides = (
        np.array(column, dtype=float).reshape(-1, *shape) for column, shape in zip(columns, shapes, strict=True)
    )
    jacobian = _at_point(moves_a, point - origin_a) - _at_point(moves_b, point - origin_b)
    material, contact = combine(sides), model.contract.contact
    law = ContactLaw(
        approximation=contact.approximation,
        time_step=model.time_step,
        near_rigid=float(model.plant.get_sap_near_rigid_threshold()),
        before=((v[problem][:, None, :] @ jacobian)[:, 0] * normal).sum(axis=1),
        normal=normal,
        phi=phi,
        weight=weigh(jacobian, weights[problem]),
        friction=material.friction,
        stiffness=material.stiffness,
        time=material.time,
        dissipation=material.dissipation,
    )
    moving = np.flatnonzero((jacobian != 0).any(axis=(1, 2)))
    return ContactImpulses(problem[moving], jacobian[moving], law.subset(moving))


def _at_point(motions: Array, from_origin: Array) -> Array:
    """Return the transposed Jacobians (M, nv, 3) of the velocity of bodies' points, from `_motions` (M, 6, nv)."""
    moves = motions.swapaxes(1, 2)
    return np.asarray(moves[..., 3:] + cross(moves[..., :3], from_origin[:, None, :]))


def _solved(
    problems: ConvexSteps, before: Array, drake: Array, held: Array | None = None
) -> tuple[Array, Array, Array, dict[int, str]]:
    """Return v' (N, nv) to rounding, the momentum residual of `drake` (N, nv), this relative (N,), and refusals.

    `held` (N, nv) is a constant residual. Without impulses the step is a sum with the rounding error of its largest
    term, as a step from `before` (N, nv) may end at rest.
    """
    balance, solved = problems.evaluate(drake), problems.taking_part()
    missing = problems.norm(balance.missing * solved), problems.norm(balance.missing * ~solved)
    moving = np.maximum(problems.scale(before, balance.given), problems.scale(drake, balance.given))
    had = problems.scale(drake * solved, balance.given) + AT_REST, moving
    left, elsewhere = (np.divide(m, p, out=np.zeros_like(m), where=m > 0) for m, p in zip(missing, had, strict=True))
    if held is None:
        v_next, reached = problems.solve(drake, balance)
    else:
        problems_held = replace(problems, momentum=problems.momentum + held)
        v_next, reached = problems_held.solve(drake, replace(balance, missing=balance.missing - held))
    whys = {}
    for i in np.flatnonzero(~(left <= DRAKES_STOP)):
        whys[int(i)] = (
            f"Drake's step leaves {left[i]:.2g} of the momentum in the equation of drake_diff, but Drake's solver "
            f"stops at {SAP_RELATIVE_TOLERANCE:g}: the equation is not Drake's"
        )
    for i in np.flatnonzero(~(elsewhere <= FREE_STEP)):
        whys[int(i)] = f"Drake's step without impulses differs by {elsewhere[i]:.2g} of the momentum"
    for i in np.flatnonzero(~reached):
        whys.setdefault(int(i), "Newton's method does not solve the step to rounding")
    return v_next, balance.missing, left, whys


def _states(model: Model, xs: Array, v_next: Array) -> Array:
    """Return q' = q + h N(q) v' and v' (N, nx)."""
    if model.plant.IsVelocityEqualToQDot():
        rates = v_next
    else:
        rates = np.empty((len(xs), model.nq))
        for k, (x, v) in enumerate(zip(xs, v_next, strict=True)):
            set_state(model.double, x)
            rates[k] = model.double.rates(v)
    return np.concatenate([xs[:, : model.nq] + model.time_step * rates, v_next], axis=1)
