"""Rollouts of many steps, with energy, contact, penetration and constraint violation along them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, broadcast_shapes, finite_array, frozen, number_of_steps
from drake_diff._base.autodiff import called
from drake_diff._base.values import ShowsItsRepr, stacked
from drake_diff.exceptions import InputError, SimulationError, UnknownNameError
from drake_diff.model.contact import ContactPoint, contacts_of_the_step, penetration
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied, select
from drake_diff.model.plant import instances, joints
from drake_diff.model.step import advance, set_state
from drake_diff.model.tangent import tangent_space

Policy = Callable[[Array, float], ArrayLike]
STEPS, CONTINUOUS = MOTIONS = "steps", "continuous"  # Drake's steps, or the continuous motion that they approximate


@dataclass(frozen=True, eq=False)
class Rollout(ShowsItsRepr):
    """N steps of the double plant and the quantities measured along them, returned by `rollout`. Arrays are read-only.

    With method="continuous", these are states and measurements of the continuous motion at the ends of N intervals.
    For a batch, all arrays except `times` and the results of the properties have its leading dimensions. `contacts` has
    an entry for each rollout, in the order of `xs.reshape(-1, N+1, nx)`.

    The energy balance of the discrete plant is `energy_error` = energy - energy[0] - work + dissipation
    - contact_work - limit_work. The work of a force f in a step is h f (v + v') / 2, which is exact if M is constant.
    The remaining energy error is the error of the time stepping and the work of constraints (couplers, balls, welds).

    Example:
        >>> dd.rollout(dd.load_model("models/pendulum.urdf", time_step=0.01), [0.5, 0], np.zeros((100, 1)))
        Rollout of 100 steps, 1 s: energy ... to ... J, of which ... J are unaccounted for
          deepest penetration 0 m, largest constraint violation 0, 0 steps with contact
    """

    times: Array  # (N+1,) [s]
    xs: Array  # (N+1, nx)
    us: Array  # (N, nu), as commanded
    efforts: Array  # (N, actuators), as applied: clipped at the effort limits, PD control included
    kinetic_energy: Array  # (N+1,) [J]
    potential_energy: Array  # (N+1,) [J], gravity and springs
    work: Array  # (N+1,) [J], done by actuators, body forces and a diagram's systems since the start
    dissipation: Array  # (N+1,) [J], dissipated by joint damping since the start
    contact_work: Array  # (N+1,) [J], done by contact, normal forces and friction, since the start
    limit_work: Array  # (N+1,) [J], done by joint limits since the start
    penetration: Array  # (N+1,) [m], the largest overlap of two geometries
    # (N+1,) violation of joint limits [m or rad], or of a quaternion's unit norm [1]; inf for a plant with constraints
    # (couplers, balls, welds, distances), whose violation pydrake does not expose.
    constraint_violation: Array
    contacts: tuple[tuple[ContactPoint, ...], ...]  # N tuples: the contacts of each step

    def __repr__(self) -> str:
        energy, error, batch = self.energy, float(np.abs(self.energy_error).max()), self.xs.shape[:-2]
        times = f"{len(self.times) - 1} steps, {self.times[-1]:g} s"
        changes = f"energy {energy[0]:.4g} to {energy[-1]:.4g} J, of which {error:.2g} J" if not batch else ""
        steps = [step for rollout in self.contacts for step in rollout] if batch else self.contacts
        return (
            (f"{batch} rollouts of {times}: up to {error:.2g} J" if batch else f"Rollout of {times}: {changes}")
            + f" are unaccounted for\n  deepest penetration {np.max(self.penetration):.3g} m, largest constraint "
            f"violation {np.max(self.constraint_violation):.3g}, {sum(map(bool, steps))} steps with contact"
        )

    @property
    def energy(self) -> Array:
        """Kinetic plus potential energy (N+1,) [J]."""
        return frozen(self.kinetic_energy + self.potential_energy)

    @property
    def energy_error(self) -> Array:
        """Energy (N+1,) [J] not accounted for by inputs, systems, damping, contact or limits."""
        given = self.work - self.dissipation + self.contact_work + self.limit_work
        return frozen(self.energy - self.energy[..., :1] - given)

    @property
    def energy_drift(self) -> Any:
        """The drift of `energy_error` [J] without its oscillation (see `drift`)."""
        return drift(self.energy_error)

    @property
    def energy_exchanged(self) -> Any:
        """The sum of the ranges [J] of kinetic and potential energy and of the work of each type of force."""
        flows = (self.work, self.dissipation, self.contact_work, self.limit_work)
        return sum(np.ptp(flow, axis=-1) for flow in (self.kinetic_energy, self.potential_energy, *flows))

    @property
    def energy_oscillation(self) -> Any:
        """The largest distance [J] of `energy_error` from its drift line."""
        error, drift = self.energy_error, np.asarray(self.energy_drift)[..., None]
        line = drift * np.linspace(-0.5, 0.5, error.shape[-1])
        return np.abs(error - np.asarray(smooth_mean(error))[..., None] - line).max(axis=-1)


def rollout(
    model: Model,
    x0: ArrayLike,
    us: ArrayLike | None = None,
    *,
    policy: Policy | None = None,
    num_steps: int | None = None,
    parameters: Mapping[str, Any] | None = None,
    method: str = STEPS,
) -> Rollout:
    """Take many steps of the double plant; measure energy, contact, penetration and constraint violation.

    Args:
        model: The discrete model.
        x0: (nx,) the initial state, or (..., nx) those of a batch of rollouts.
        us: (N, nu) the inputs [N or N m], or (..., N, nu); may be omitted if the model has no actuators. Leading
            dimensions of `x0` and `us` are broadcast.
        policy: `policy(x, t)` (nu,) of the state and the time [s], in place of `us`.
        num_steps: N, if `us` is not given.
        parameters: Names (see `list_parameters`) and values that replace the model's own.
        method: "steps", or "continuous". With "continuous", the motion in continuous time that the steps approximate
            is integrated with error control, contact included. The results are those at the ends of the same intervals.
            Only contact parameters are supported. Work is integrated along the motion, `penetration` is the largest
            since the previous end, and `contacts` are those of largest depth in each interval.

    Returns:
        The states `xs` (N+1, nx), and the quantities measured at each state. Those of a batch have its dimensions.

    Raises:
        ShapeError, NonFiniteError, InputError: An argument or an output of the policy is invalid.
        ModelError: Continuous time does not support the model.
        SimulationError: Drake cannot compute a step, or the integration in continuous time fails.

    Example:
        >>> model = dd.load_model("models/projectile.sdf", time_step=0.01)
        >>> motion = dd.rollout(model, model.default_state, num_steps=100)
        >>> float(motion.times[-1]), motion.xs.shape
        (1.0, (101, 13))
        >>> ball = dd.load_model("models/sphere_on_ground.sdf", time_step=0.01)
        >>> dd.rollout(ball, ball.default_state, np.zeros((50, ball.nu)), method="continuous")
        Rollout of 50 steps, 0.5 s: energy ... to ... J, of which ... J are unaccounted for
          deepest penetration ... m, largest constraint violation 0, ... steps with contact
    """
    if method not in MOTIONS:
        raise UnknownNameError("method", got=method, known=MOTIONS)
    if us is not None and policy is not None:
        raise InputError("rollout", got="us and policy", expected="one of them")
    if batch := batch_of(model, x0, us):
        rows = rows_of_batch(model, batch, x0, us)
        more: Any = {"policy": policy, "num_steps": num_steps, "parameters": parameters, "method": method}
        rollouts = [rollout(model, x, u, **more) for x, u in rows]
        contacts: Any = tuple(motion.contacts for motion in rollouts)
        return stacked(rollouts, batch, times=rollouts[0].times, contacts=contacts)
    inputs = check_inputs(model, us, num_steps) if policy is None else policy
    count = len(inputs) if policy is None else number_of_steps(num_steps)  # type: ignore[arg-type]
    vector = select(model, parameters or ())
    with applied(vector) as set_model:
        if method == CONTINUOUS:
            return _in_continuous_time(set_model, vector, model.finite_state("x0", x0), inputs, count)
        h, meter = set_model.time_step, Meter(set_model)
        xs, us = np.empty((count + 1, model.nx)), np.empty((count, model.nu))
        xs[0] = model.finite_state("x0", x0)
        for k in range(count):
            us[k] = _asked(inputs, xs[k].copy(), k * h, model.nu) if callable(inputs) else inputs[k]
            xs[k + 1] = advance(set_model.double, xs[k], us[k])
            meter.measure_step(xs[k], xs[k + 1])
        set_state(set_model.double, xs[-1])
        meter.measure_state(xs[-1])
        return meter.result(xs, us)


def _in_continuous_time(
    model: Model, vector: ParameterVector, x0: Array, inputs: Array | Policy, count: int
) -> Rollout:
    """Roll out a model, to which `vector` is applied, by its flow."""
    from drake_diff.motion.flow import measured_flow  # loads CasADi

    def choose(x: Array, k: int) -> Array:
        return finite_array("u", inputs(x.copy(), k * model.time_step), (model.nu,)) if callable(inputs) else inputs[k]

    return continuous_rollout(model, *measured_flow(model, vector, x0, choose, count))


def continuous_rollout(
    model: Model, xs: Array, us: Array, efforts: Array, work: Array, contacts: Sequence[tuple[ContactPoint, ...]]
) -> Rollout:
    """Make the Rollout of a motion in continuous time from its states at the ends of N intervals.

    `work` (N+1, 3) [J] is the work of actuators, damping and contact since the start. `contacts` are the contact points
    of largest depth in each interval.
    """
    meter = Meter(model)
    for x in xs:
        set_state(model.double, x)
        meter.measure_state(x)
    _, kinetic, potential, at_ends = (np.array(column) for column in zip(*meter.states, strict=True))
    between = [max((point.depth for point in points), default=0.0) for points in contacts]
    deepest = np.maximum(np.maximum(at_ends, [0.0, *between]), [0.0, *at_ends[:-1]])
    return Rollout(
        times=frozen(model.time_step * np.arange(len(xs))),
        xs=frozen(xs),
        us=frozen(us),
        efforts=frozen(efforts),
        kinetic_energy=frozen(kinetic),
        potential_energy=frozen(potential),
        work=frozen(work[:, 0]),
        dissipation=frozen(work[:, 1]),
        contact_work=frozen(work[:, 2]),
        limit_work=frozen(np.zeros(len(xs))),  # a motion that reaches a limit is refused
        penetration=frozen(deepest),
        constraint_violation=frozen(meter.violations(xs[:, : model.nq])),
        contacts=tuple(contacts),
    )


def _asked(policy: Policy, x: Array, t: float, nu: int) -> Array:
    """Return the policy's input (nu,), validated; the fast check of the common case takes a tenth of the time."""
    u = called("policy", policy, x, t, shape=(nu,))
    if type(u) is np.ndarray and u.dtype == float and u.shape == (nu,) and math.isfinite(u.dot(u)):
        return u
    return finite_array("u", u, (nu,))


def check_inputs(model: Model, us: ArrayLike | None, num_steps: int | None = None) -> Array:
    """Return `us` as a finite (N, nu) array. A model without actuators needs only `num_steps`."""
    if us is None and model.nu == 0:
        us = np.zeros((number_of_steps(num_steps), 0))
    checked = finite_array("us", us, ("N", model.nu))
    if len(checked) == 0:
        raise InputError("us", got="0 steps", expected="at least one step")
    if num_steps is not None and num_steps != len(checked):
        raise InputError("num_steps", got=num_steps, expected=f"{len(checked)}, the length of us")
    return checked


def batch_of(model: Model, x0: Any, us: Any) -> tuple[int, ...]:
    """Return the leading dimensions that x0 (..., nx) and us (..., N, nu) share, () for a single rollout."""
    try:
        shapes = [np.shape(values) for values in (x0, us) if values is not None]
    except ValueError:  # rows of different lengths, which the checks of a single rollout refuse
        return ()
    if all(len(shape) <= i + 1 for i, shape in enumerate(shapes)):
        return ()
    return broadcast_shapes({"x0": (model.nx,), "us": ("N", model.nu)}, shapes)[0][:-1]


def rows_of_batch(model: Model, batch: tuple[int, ...], x0: Any, us: Any) -> Iterator[tuple[Array, Array | None]]:
    """Return the initial state (nx,) and the inputs (N, nu) of each rollout of a batch."""
    count = math.prod(batch)
    starts = np.broadcast_to(finite_array("x0", x0, np.shape(x0)), (*batch, model.nx)).reshape(count, model.nx)
    if us is None:
        return ((x, None) for x in starts)
    us = finite_array("us", us, np.shape(us))
    return zip(starts, np.broadcast_to(us, (*batch, *us.shape[-2:])).reshape(count, *us.shape[-2:]), strict=True)


def roll_states(model: Model, x0: Array, us: Array) -> Array:
    """Return the states (N+1, nx) of a rollout without measurements; shapes are not checked."""
    xs = np.empty((len(us) + 1, model.nx))
    xs[0] = x0
    for k, u in enumerate(us):
        xs[k + 1] = advance(model.double, xs[k], u)
    return xs


class Meter:
    """Measurement of energies, efforts and contacts in the double context after each `advance`."""

    def __init__(self, model: Model):
        self.model, self.plant, self.context = model, model.plant, model.double.context
        inspector = model.double.inspector
        self.can_touch = inspector is not None and bool(inspector.GetCollisionCandidates())
        self.damping = model.double.damping()
        self.actuation = model.by_effort
        self.net_actuation, self.forces = self.plant.get_net_actuation_output_port(), model.double.forces
        self.still = np.zeros(model.nv)
        self.states: list[tuple[Array, float, float, float]] = []
        self.ends: list[Array] = []
        self.efforts: list[Array] = []
        self.applied: list[Array] = []  # (nv,) generalized forces of body forces and the diagram's systems
        self.pushes: list[tuple[Array, Array]] = []  # forces of contact and of joint limits, (nv,) each
        lower, upper = model.position_limits
        # Indices in q and v of the joints with limits, and the limits.
        limited = [(i, j) for i, j in _single(model) if np.isfinite(lower[i]) or np.isfinite(upper[i])]
        self.limited = np.array(limited, dtype=np.intp).reshape(-1, 2).T
        self.limits = lower[self.limited[0]], upper[self.limited[0]]
        self.contacts: list[tuple[ContactPoint, ...]] = []

    def measure_state(self, x: Array) -> None:
        """Measure the state `x` (nx,), which the context has."""
        kinetic = self.plant.CalcKineticEnergy(self.context)
        potential = self.plant.CalcPotentialEnergy(self.context)
        if self.forces:
            potential += sum(f.potential(self.plant, self.context) for f in self.forces)
        self.states.append((x, kinetic, potential, penetration(self.model) if self.can_touch else 0.0))

    def measure_step(self, x: Array, x_next: Array) -> None:
        """Measure the last step, from `x` to `x_next` (nx,), and the state `x`."""
        self.measure_state(x)
        self.ends.append(x_next)
        self.efforts.append(np.array(self.net_actuation.Eval(self.context))[: self.actuation.shape[1]])
        self.applied.append(self.model.double.applied_force() if self.model.inputs.fed else self.still)
        self.contacts.append(contacts_of_the_step(self.model) if self.can_touch else ())
        contact = self._contact_force() if self.contacts[-1] else self.still
        self.pushes.append((contact, self._limit_force(x, x_next, contact)))

    def _contact_force(self) -> Array:
        """Return the generalized force (nv,) of all contacts in the last step."""
        force_of_contact = np.zeros(self.plant.num_velocities())
        for i in instances(self.plant):
            if self.plant.num_velocities(i):
                force = self.plant.get_generalized_contact_forces_output_port(i).Eval(self.context)
                if not np.all(np.isfinite(force)):  # Drake 1.51 aborts the process in this case
                    raise SimulationError("the contact forces of the step are not finite")
                self.plant.SetVelocitiesInArray(i, force, force_of_contact)
        return np.asarray(self.model.double.own_force(force_of_contact))

    def _limit_force(self, x: Array, x_next: Array, contact: Array) -> Array:
        """Return the limits' force (nv,): the force for the step at joints near a limit, minus all other forces."""
        (i, j), (lower, upper) = self.limited, self.limits
        if not len(i):
            return self.still
        nq, h, force = self.model.nq, self.model.time_step, np.zeros(self.model.nv)
        v, after = x[nq:], x_next[nq:]
        reach = 2 * h * np.maximum(np.abs(v[j]), np.abs(after[j]))  # Drake's limits begin to act two steps ahead
        inside = (lower <= np.minimum(x[i], x_next[i]) - reach) & (np.maximum(x[i], x_next[i]) + reach <= upper)
        near = j[~inside]
        if len(near):
            needed = self.model.double.inverse_dynamics((after - v) / h) + self.damping * (after - v)
            driven = self.actuation @ self.efforts[-1]
            if self.model.inputs.fed_actuators:  # inverse dynamics already includes these forces
                driven += self.applied[-1] - self.model.double.systems_force()
            force[near] = (needed - driven - contact)[near]
        return force

    def result(self, xs: Array, us: Array) -> Rollout:
        """Return the rollout with states xs (N+1, nx) and inputs us (N, nu)."""
        states, kinetic, potential, deepest = (np.array(column) for column in zip(*self.states, strict=True))
        nq, h = self.model.nq, self.model.time_step
        efforts = np.array(self.efforts).reshape(len(us), self.actuation.shape[1])
        after = np.array(self.ends).reshape(len(us), self.model.nx)[:, nq:]
        middle = (states[:-1, nq:] + after) / 2
        applied = np.array(self.applied).reshape(len(us), self.model.nv)
        work = h * np.einsum("ki,ki->k", middle, efforts @ self.actuation.T + applied)
        dissipation = h * np.einsum("ki,ki->k", middle, self.damping * after)
        pushes = np.array(self.pushes).reshape(len(us), 2, self.model.nv)
        by_contact, by_limits = h * np.einsum("ki,kfi->fk", middle, pushes)
        return Rollout(
            times=frozen(self.model.time_step * np.arange(len(xs))),
            xs=frozen(xs),
            us=frozen(us),
            efforts=frozen(efforts),
            kinetic_energy=frozen(kinetic),
            potential_energy=frozen(potential),
            work=frozen(np.append(0.0, np.cumsum(work))),
            dissipation=frozen(np.append(0.0, np.cumsum(dissipation))),
            contact_work=frozen(np.append(0.0, np.cumsum(by_contact))),
            limit_work=frozen(np.append(0.0, np.cumsum(by_limits))),
            penetration=frozen(deepest),
            constraint_violation=frozen(self.violations(states[:, :nq])),
            contacts=tuple(self.contacts),
        )

    def violations(self, qs: Array) -> Array:
        """Return the constraint violations (N+1,) at the positions qs (N+1, nq)."""
        if self.model.num_constraints:
            return np.full(len(qs), np.inf)  # pydrake does not expose the violation of constraints
        lower, upper = self.model.position_limits
        violation = np.maximum(lower - qs, qs - upper).max(axis=1, initial=0.0)
        for start in tangent_space(self.model).quaternions:
            violation = np.maximum(violation, np.abs(np.linalg.norm(qs[:, start : start + 4], axis=1) - 1))
        return np.asarray(violation)


def _single(model: Model) -> list[tuple[int, int]]:
    """Return the indices in q and v of each joint with one degree of freedom."""
    places = [model.places(joint) for joint in joints(model.plant)]
    return [(q.start, v.start) for q, v in places if len(q) == len(v) == 1]


def smooth_mean(series: Array) -> Any:
    """Return the mean of `series` (..., n) with the weight exp(-1 / (s (1 - s))), s from 0 to 1 along the series.

    The weight vanishes with all its derivatives at both ends, so the contribution of an oscillation of more than a few
    periods is negligible (Das, Saiki, Sander and Yorke, "Quantitative quasiperiodicity", 2017).
    """
    s = (np.arange(series.shape[-1]) + 0.5) / series.shape[-1]
    weight = np.exp(-1 / (s * (1 - s)))
    return series @ weight / weight.sum()


def drift(series: Array) -> Any:
    """Return the change of `series` (..., n) from its start to its end without its oscillation.

    This is twice the difference between the smooth means of the second and the first half. It is exact for a straight
    line and negligible for an oscillation of many periods. For fewer than four values, it is the last minus the first.
    """
    count = series.shape[-1]
    if count < 4:
        return series[..., -1] - series[..., 0]
    half = count // 2
    rise = smooth_mean(series[..., -half:]) - smooth_mean(series[..., :half])
    return rise * (count - 1) / (count - half)
