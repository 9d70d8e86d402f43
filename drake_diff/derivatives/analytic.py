"""Jacobians of smooth steps and of steps with impulses from the steps' own equations, certified against AutoDiffXd.

The equation of a model's smooth steps (`smooth_step`) is certified at random states when it is first used. The equation
of its steps with contact (`contact.jacobian`) is certified at the first such steps that occur.
"""

from dataclasses import dataclass

import numpy as np
from pydrake.autodiffutils import InitializeAutoDiff

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import gradient_rows
from drake_diff._base.values import Refusal
from drake_diff.derivatives.contact.active_contacts import JOINT_LIMITS, is_iterated
from drake_diff.derivatives.contact.jacobian import contact_form, contact_jacobians, material_of
from drake_diff.derivatives.contact.laws import QUANTITIES, material_change
from drake_diff.derivatives.refine_step import refine_steps
from drake_diff.derivatives.smooth_step import (
    RESIDUAL_TOLERANCE,
    SmoothStep,
    build_analytic,
    differentiate_equation,
    form_of,
)
from drake_diff.derivatives.steps import FREE, Flags, Jacobians, NotSmoothError, SourceTrial, Steps, take_steps
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.mechanics.coordinates import Coordinates
from drake_diff.mechanics.description import describe_tree
from drake_diff.mechanics.tree import CompiledTree, compiled_tree
from drake_diff.model.model import Model
from drake_diff.model.parameters import select, write_autodiff
from drake_diff.model.repairs import JointCoupling
from drake_diff.model.step import advance, set_state

# Relative to the largest entry: two derivatives of a smooth step differ by rounding, which a mass matrix may magnify.
SAME_JACOBIAN = 1e-9
# For differences of a step solved to rounding: friction changes within 1e-4 m/s, but contact points that SceneGraph
# computes iteratively have noise of up to 1e-8, and may jump on one side.
SAME_DIFFERENCES, SAME_WHERE_ITERATED, DIFFERENCES = 1e-5, 3e-4, (3e-7, 1e-5, 1e-4)
SAME_END = 1e-10  # tolerance of x' with reduced joints: both are Drake's own step, projected by the same matrix
SAME_STEP = 1e-12  # relative to the largest entry of x' (or 1): the same positions, summed in a different order
CERTIFIED_STATES, STATES_TRIED = 3, 60
FAR = 4.0  # [m or rad]
ACTS = "contact, a limit or a constraint acts"
BESIDE = "forces other than contact, joint limits and couplers act"
DIFFERS, STEP_DIFFERENCES = "its Jacobian with impulses differs from", "the differences of the step solved to rounding"


class Analytic:
    """Jacobians of smooth steps and steps with contact of spheres, with respect to state, inputs and contact material.

    A nonsmooth step without contact is detected by its end state, which differs from that of the smooth step.
    """

    name = "analytic"

    def differentiate(self, steps: Steps) -> Jacobians | Refusal:
        """Differentiate all steps in one call."""
        parameters, count = steps.vector.parameters, steps.model.nx + steps.model.nu
        if parameters and any(p.kind.quantity not in QUANTITIES for p in parameters):
            return Refusal("derivatives with respect to parameters other than those of contact are requested")
        if steps.model.coupling is not None:
            return self._of_reduced(steps, steps.model.coupling)
        smooth = analytic_of(steps.model)
        if isinstance(smooth, Refusal):
            return smooth
        impulsive = steps.touching | (steps.model.num_constraints > 0)
        free = np.flatnonzero(~impulsive)
        if len(free) == len(steps) and not parameters:
            values, known = smooth(steps)
            if np.count_nonzero(known) == len(known):  # the usual case
                return Jacobians(values, {})
        else:
            values, known = np.zeros((len(steps), steps.model.nx, steps.width)), np.zeros(len(steps), dtype=bool)
            if len(free):
                values[free, :, :count], known[free] = smooth(steps.subset(free))
        answer = Jacobians(values, {int(k): NotSmoothError(ACTS) for k in np.flatnonzero(~known)}, {})
        pushed = ~known & (impulsive | smooth.at_a_limit(steps))
        if smooth.body_forces:  # their derivatives are not in the equation with impulses
            return answer
        for touch in (True, False):
            which = np.flatnonzero(pushed & (steps.touching == touch))
            if len(which):
                answer.put(which, _with_impulses(smooth, steps.subset(which), touch))
        return answer

    def _of_reduced(self, steps: Steps, coupling: JointCoupling) -> Jacobians | Refusal:
        """Differentiate the steps of a model with reduced mimic joints by those of the whole plant."""
        model = steps.model
        if steps.vector.parameters:
            return Refusal("derivatives with respect to parameters of a model with reduced mimic joints are requested")
        smooth = analytic_of(model.whole)
        if isinstance(smooth, Refusal):
            return smooth
        reduced = model.cache("reduced steps", lambda: ReducedStep.build(model, coupling, smooth), of_structure=True)
        whole, same = reduced.whole(steps)
        of_whole = self.differentiate(whole)
        if isinstance(of_whole, Refusal):
            return of_whole
        values, refused = reduced.jacobians(steps, whole, of_whole.values), dict(of_whole.refused)
        refused |= {int(k): NotSmoothError("the whole plant's step ends differently") for k in np.flatnonzero(~same)}
        trial = model.cache("trial of reduced steps", lambda: SourceTrial(CERTIFIED_STATES), of_structure=True)
        for k in range(len(steps)):
            if k not in refused:
                _certify(steps, k, values[k], [trial], iterated=False)
                if trial.refusal:
                    return Refusal(trial.refusal)
        return Jacobians(values, refused, of_whole.notes)


def analytic_of(model: Model) -> SmoothStep | Refusal:
    """Return the model's smooth step, certified at its first use, or a Refusal."""
    if model.other_quantities.difference(QUANTITIES):
        return Refusal("parameter values other than the model's own are applied")

    def make() -> SmoothStep | Refusal:
        try:
            return certified(model, build_analytic(model))
        except ModelError as error:
            return Refusal(str(error))

    return model.cache("analytic", make, of_structure=True)  # only contact parameters may be applied


def one_smooth_step(model: Model, steps: Steps) -> Array | None:
    """Return the Jacobian (nx, nx + nu) of one step without contact, or None if `SmoothStep.single` returns None."""
    if model.coupling is not None or model.num_constraints:
        return None
    smooth = analytic_of(model)
    return None if isinstance(smooth, Refusal) else smooth.single(steps.xs[0], steps.us[0], steps.x_next[0])


def certified(model: Model, smooth: SmoothStep) -> SmoothStep | Refusal:
    """Return `smooth` if its Jacobian equals AutoDiffXd's of Drake's equation at three random states, or a Refusal.

    The states may have overlaps and violated limits, as whether a step solves this equation is checked at each step.
    """
    here = model.double.state()
    try:
        why = _first_difference(model, smooth)
        return Refusal(why) if why else smooth
    finally:
        set_state(model.double, here)


def _first_difference(model: Model, smooth: SmoothStep) -> str:
    """Describe how a step or its Jacobian differs from Drake's equation, or return "" if all agree."""
    random, left, exact = np.random.default_rng(0), CERTIFIED_STATES, np.empty((model.nx, model.nx + model.nu))
    for _ in range(STATES_TRIED):
        x, u = _random_point(model, smooth.coordinates, random)
        jacobians, ends = smooth.differentiate(x[None], u[None])
        v_next = ends[0, model.nq :]
        if not np.all(smooth.form.effort(x[: model.nq], v_next, u, model.time_step)[1][np.isinf(smooth.limit)]):
            continue  # a controller is at its limit
        steps = Steps(model, select(model, ()), x[None], u[None], ends, FREE, taken=False)
        try:
            missing = differentiate_equation(smooth.form, steps, 0, exact)
        except (SimulationError, ModelError) as error:
            return f"AutoDiffXd cannot certify the analytic step: {error}"
        if not missing <= RESIDUAL_TOLERANCE:
            return f"its step has a residual of {missing:.2g} of the forces in Drake's equation"
        moved = x[: model.nq] + model.time_step * np.asarray(model.double.rates(v_next)) - ends[0, : model.nq]
        if not np.abs(moved).max() <= SAME_STEP * max(1.0, float(np.abs(ends).max())):
            return f"its positions differ from Drake's by {np.abs(moved).max():.2g}"
        gap = float(np.abs(jacobians[0] - exact).max())
        if not gap <= SAME_JACOBIAN * float(np.abs(exact).max()):
            return f"its Jacobian differs from AutoDiffXd's by {gap:.2g}"
        left -= 1
        if not left:
            return ""
    return f"controllers reach their limits at all but {CERTIFIED_STATES - left} of {STATES_TRIED} random states"


def _random_point(model: Model, coordinates: Coordinates, random: np.random.Generator) -> tuple[Array, Array]:
    """Return a state in the middle half of the limits, with unit quaternions, and inputs within half their limits.

    Limits wider than FAR are ignored, as derivatives cannot be checked at states far from 0.
    """
    lower, upper = model.position_limits
    middle = np.clip(0.0, lower, upper)
    lower, upper = np.maximum(lower, middle - FAR), np.minimum(upper, middle + FAR)
    q = lower + random.uniform(0.25, 0.75, model.nq) * (upper - lower)
    for i, _ in coordinates.free:
        q[i : i + 4] = random.standard_normal(4)
        q[i : i + 4] /= np.linalg.norm(q[i : i + 4])
    limit = np.minimum(form_of(model).limit, 2.0)
    return np.concatenate([q, random.standard_normal(model.nv)]), random.uniform(-0.5, 0.5, model.nu) * limit


def _with_impulses(smooth: SmoothStep, steps: Steps, touch: bool) -> Jacobians | Refusal:
    """Differentiate N steps in which impulses act, all with contact or all without contact."""
    model, vector = steps.model, steps.vector
    form = contact_form(model, smooth)
    if isinstance(form, Refusal):
        return form
    if form.unknown and touch:
        return Refusal(form.unknown)
    material = material_of(model, form)
    change = material_change(form.pairs, material, vector, model.double) if vector.parameters else None
    values, known, whys, placed = contact_jacobians(form, smooth, steps, material, change)
    trials: dict[str, SourceTrial] = model.cache("impulse trials", dict, of_structure=True)
    kinds = form.pairs.kinds(placed, len(steps)) if touch else [{JOINT_LIMITS}] * len(steps)
    notes: dict[int, str] = {}

    for k in np.flatnonzero(known).tolist():
        of_step = [trials.setdefault(kind, SourceTrial(CERTIFIED_STATES)) for kind in sorted(kinds[k])]
        _certify(steps, k, values[k], of_step, iterated=any(map(is_iterated, kinds[k])))
        refusal, note = (_joined([getattr(t, name) for t in of_step]) for name in ("refusal", "note"))
        if refusal:
            whys[k] = refusal
        elif note:
            notes[k] = note
    whys = dict.fromkeys(np.flatnonzero(~known).tolist(), BESIDE) | whys
    return Jacobians(values, {k: NotSmoothError(why) for k, why in whys.items()}, notes)


def _joined(texts: list[str]) -> str:
    return "; ".join(dict.fromkeys(filter(None, texts)))


def _certify(steps: Steps, k: int, jacobian: Array, trials: list[SourceTrial], *, iterated: bool) -> None:
    """Compare a step's Jacobian for the trials that are not complete."""
    if still_open := [trial for trial in trials if trial.left and not trial.refusal]:
        refusal, note = _other_jacobian(steps, k, jacobian, iterated=iterated)
        for trial in still_open:
            trial.refusal, trial.note, trial.left = refusal, note, trial.left - 1


def _other_jacobian(steps: Steps, k: int, jacobian: Array, *, iterated: bool) -> tuple[str, str]:
    """Describe how a step's Jacobian with impulses differs from AutoDiffXd's (or return ""), and the reference used.

    If Drake cannot compute the AutoDiffXd step, as for shapes that it does not differentiate, the Jacobian is compared
    with differences of the step solved to rounding.
    """
    model, vector = steps.model, steps.vector
    write_autodiff(vector, model, vector.values)
    variables = InitializeAutoDiff(np.concatenate([steps.xs[k], steps.us[k]])).ravel()
    try:
        exact = advance(model.autodiff, variables[: model.nx], variables[model.nx :])
    except (SimulationError, ModelError):
        return _unlike_differences(steps, k, jacobian, iterated=iterated)
    gap = _gap(jacobian, gradient_rows(exact, model.nx + model.nu))
    return ("", "") if gap <= SAME_JACOBIAN else (f"{DIFFERS} AutoDiffXd's by {gap:.2g} of its largest entry", "")


def _unlike_differences(steps: Steps, k: int, jacobian: Array, *, iterated: bool) -> tuple[str, str]:
    """Compare as `_other_jacobian` does, with finite differences of the size that agrees best.

    The differences are of the step solved to rounding with the momentum residual of Drake's solver as a constant. Where
    impulses change direction quickly, the solver stops so far from the solution that the Jacobian is different. If
    Drake's contact points are `iterated`, the best difference of each column is used, which may be one-sided.
    """
    gaps = []
    for size in DIFFERENCES:
        sides = _differences(steps, k, size)
        if isinstance(sides, Refusal):
            return f"neither AutoDiffXd nor differences can certify the step: {sides}", ""
        forward, backward = sides
        central = (forward + backward) / 2
        if _gap(jacobian, central) <= SAME_DIFFERENCES:
            return "", f"with impulses equal to {STEP_DIFFERENCES}, as AutoDiffXd does not support this step"
        mine = jacobian[:, : central.shape[1]]
        gaps += [np.abs(mine - side).max(axis=0) / np.abs(mine).max() for side in (forward, backward, central)]
    gap = float(np.max(np.min(gaps, axis=0)))
    if iterated and gap <= SAME_WHERE_ITERATED:
        note = f"with impulses within {SAME_WHERE_ITERATED:g} of {STEP_DIFFERENCES}, as Drake iterates contact points"
        return "", note
    return f"{DIFFERS} {STEP_DIFFERENCES} by {gap:.2g} of its largest entry", ""


def _gap(jacobian: Array, other: Array) -> float:
    """Return the largest difference of the first columns relative to the largest entry, or inf for NaN."""
    gap = float(np.abs(jacobian[:, : other.shape[1]] - other).max() / np.abs(other).max())
    return gap if np.isfinite(gap) else np.inf


def _differences(steps: Steps, k: int, width: float) -> tuple[Array, Array] | Refusal:
    """Return forward and backward differences (nx, nx + nu) over `width` of the equation at Drake's own end state."""
    nx, vector, point = steps.model.nx, steps.vector, np.concatenate([steps.xs[k], steps.us[k]])
    size = width * np.maximum(1.0, np.abs(point))
    points = np.concatenate([point + np.diag(size), point - np.diag(size), point[None]])
    left = refine_steps(steps.model, vector, points[-1:, :nx], points[-1:, nx:])
    held = np.repeat(np.nan_to_num(left.missing), len(points), axis=0)
    refined = refine_steps(steps.model, vector, points[:, :nx], points[:, nx:], held=held)
    for why in (*left.refused.values(), *refined.refused.values()):
        return why
    ahead, behind = np.split(refined.x_next[:-1] - refined.x_next[-1], 2)
    return np.asarray((ahead / size[:, None]).T), np.asarray((-behind / size[:, None]).T)


@dataclass(frozen=True, eq=False)
class ReducedStep:
    """The data of a model with reduced mimic joints that does not change from step to step.

    A step is the step of the whole plant from q = r q_own + offset and v = E v_own. Its velocities v' are then
    projected as by an impulse on the joints. With A the mass matrix plus h D,

        E' A (v' - E v_own') = 0,   so   E' A E dv_own' = E' (A dv' + dA (v' - E v_own'))

    and q' = q + h N(q) E v_own'.
    """

    coupling: JointCoupling
    tree: CompiledTree  # of the whole plant
    smooth: SmoothStep

    @classmethod
    def build(cls, model: Model, coupling: JointCoupling, smooth: SmoothStep) -> "ReducedStep":
        """Build from the smooth step of `model.whole`; raise ModelError if its tree is not supported."""
        tree = compiled_tree(describe_tree(model.whole))
        if tree is None:
            raise ModelError("a free body is not joined to the world by its own frame")
        return cls(coupling, tree, smooth)

    def whole(self, steps: Steps) -> tuple[Steps, Flags]:
        """Return the same steps of the whole plant, and which (N,) of them have the same end states."""
        model = steps.model
        xs = self.coupling.state(steps.xs)
        steps_of_whole, same = (
            take_steps(model.whole, steps.vector, xs[0], steps.us, xs),
            np.empty(len(steps), dtype=bool),
        )
        for k, (x, x_next) in enumerate(zip(steps.xs, steps.x_next, strict=True)):
            set_state(model.double, x)
            gap = np.abs(model.double.next_state(steps_of_whole.x_next[k]) - x_next)
            same[k] = bool(np.all(gap <= SAME_END * np.maximum(1.0, np.abs(x_next))))
        return steps_of_whole, same

    def jacobians(self, steps: Steps, whole: Steps, of_whole: Array) -> Array:
        """Return the Jacobians (N, nx, nx + nu) from those of the whole plant."""
        coupling, c, h = self.coupling, self.smooth.coordinates, self.smooth.time_step
        E, nq, nx = coupling.spread, len(coupling.own_q), steps.model.nx
        into = np.zeros((whole.model.nx, nx))  # derivative of the whole state with respect to the own state
        into[np.arange(c.nq), coupling.of_q] = coupling.ratio_q
        into[c.nq :, nq:] = E
        chained = np.concatenate([of_whole[:, :, : whole.model.nx] @ into, of_whole[:, :, whole.model.nx :]], axis=2)
        q, v_next = whole.xs[:, : c.nq], steps.x_next[:, nq:] @ E.T
        slack, still = whole.x_next[:, c.nq :] - v_next, np.zeros((len(q), c.nv))
        moving = self.tree(q, still, slack)
        A = moving.mass + np.diag(self.smooth.dynamics.armature)
        right = A @ chained[:, c.nq :]
        by_motion = moving.by_q - self.tree(q, still, still).by_q  # derivative of M slack
        right[:, :, :nq] += by_motion @ c.motion(q) @ into[: c.nq, :nq]
        velocities = np.linalg.solve(E.T @ A @ E, E.T @ right)
        positions = h * c.rate(q) @ (E @ velocities)
        positions[:, :, :nq] += (np.eye(c.nq) + h * c.rate_by_position(v_next)) @ into[: c.nq, :nq]
        return np.concatenate([positions[:, coupling.own_q], velocities], axis=1)
