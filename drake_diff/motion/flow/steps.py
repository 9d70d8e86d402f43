"""The flow over a model's intervals: its ends, their derivatives, and contacts and work along its steps.

Within a step the motion is taken to be the polynomial of degree 5 that has the states at its ends, their rates and how
these change.

In a step the change Phi of the motion follows Phi' = A(t) Phi + B(t), A and B being the slopes of the rates on the way,
by the collocation method of three points of order 5 (Radau IIA; Hairer and Wanner, "Solving Ordinary Differential
Equations II", 1996, IV.5). It is stable at any length of step: a motion that rests does not show how stiff the friction
is that holds it, and small changes of it do.

Where a switch turns at an event that the motion meets under way, the time of the event moves with the state, and where
the rates jump there from f- to f+,

    dx+ = (1 + (f+ - f-) g' / (g' f-)) dx-,

g' being the slope of the switch: the saltation matrix (Leine and Nijmeijer, "Dynamics and Bifurcations of Non-Smooth
Mechanical Systems", 2004). The step before it ends at the event, so that its own length does not count.

Work is the power at three points of each step by Gauss' quadrature of order 6.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff.derivatives.contact.laws import QUANTITIES, material_change
from drake_diff.derivatives.step import StepDerivatives
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.model.contact import ContactPoint
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector
from drake_diff.model.step import stepped
from drake_diff.motion.flow.integrate import TOLERANCE, Flow, FlowEvent, Integrator, on_arrays, pushing_of
from drake_diff.motion.flow.plant import FlowPart, FlowPlant, flow_plant, material_of, numbers_of


class Slopes:
    """Rates where a given set of pairs pushes, and their slopes by state, input and n parameters.

    `by_parameters` (4 pairs that push, n) is the derivative of their materials.
    """

    def __init__(self, equations: FlowPart, materials: Array, by_parameters: Array):
        nx, nu = equations.slopes.size1_in(0), equations.slopes.size1_in(1)
        self.by_parameters, self.width = by_parameters, nx + nu
        self._x, self._u = np.empty(nx), np.empty(nu)
        self._rates, self._slopes = np.empty(nx), np.empty((nx + nu, nx))
        self._by_materials = np.empty((equations.material_slopes.size2_out(0), nx))
        given = self._x, self._u, materials
        self._kept, self._run = on_arrays(equations.slopes, given, (self._rates, self._slopes))
        self._kept_too, self._run_materials = on_arrays(equations.material_slopes, given, (self._by_materials,))

    def __call__(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """(M, nx) the rates at xs (M, nx), us (M, nu), and (M, nx, nx + nu + n) their slopes."""
        n = self.by_parameters.shape[1]
        rates, slopes = np.empty(xs.shape), np.empty((*xs.shape, self.width + n))
        for k in range(len(xs)):
            self._x[:], self._u[:] = xs[k], us[k]
            self._run()
            rates[k], slopes[k, :, : self.width] = self._rates, self._slopes.T
            if n:
                self._run_materials()
                slopes[k, :, self.width :] = self._by_materials.T @ self.by_parameters
        return rates, slopes

    def at_ends(self, starts: Array, ends: Array, us: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """The same at the starts (M, nx) and the ends of steps; an end at which the next step starts is taken once."""
        points = np.concatenate([starts, ends])
        same = np.all(starts[1:] == ends[:-1], axis=1) & np.all(us[1:] == us[:-1], axis=1)
        count, distinct = len(starts), np.ones(2 * len(starts), dtype=bool)
        distinct[count:-1] = ~same
        where = np.empty(2 * count, dtype=int)
        where[distinct] = np.arange(np.sum(distinct))
        where[count:-1][same] = where[1:count][same]
        rates, slopes = self(points[distinct], np.concatenate([us, us])[distinct])
        first, last = where[:count], where[count:]
        return (rates[first], slopes[first]), (rates[last], slopes[last])


def between(share: float, starts: Array, ends: Array, hs: Array, at_start: Any, at_end: Any) -> Array:
    """(M, nx) at a `share` of steps of lengths hs (M,), from what `Slopes.at_ends` has there."""
    c, d, h = share, 1 - share, hs[:, None]
    (f0, A0), (f1, A1) = at_start, at_end
    j0, j1 = ((A[:, :, : f.shape[1]] @ f[:, :, None])[:, :, 0] for f, A in ((f0, A0), (f1, A1)))
    of_gap = c**3 * (10 - 15 * c + 6 * c**2)
    of_f0, of_f1 = c * d**3 * (1 + 3 * c), -(c**3) * d * (4 - 3 * c)
    of_j0, of_j1 = c**2 * d**3 / 2, c**3 * d**2 / 2
    states = starts + of_gap * (ends - starts) + h * (of_f0 * f0 + of_f1 * f1) + h**2 * (of_j0 * j0 + of_j1 * j1)
    return np.asarray(states)


ROOT_6 = np.sqrt(6.0)
NODES = (4 - ROOT_6) / 10, (4 + ROOT_6) / 10  # and the end
WEIGHTS = np.array(
    [
        [(88 - 7 * ROOT_6) / 360, (296 - 169 * ROOT_6) / 1800, (-2 + 3 * ROOT_6) / 225],
        [(296 + 169 * ROOT_6) / 1800, (88 + 7 * ROOT_6) / 360, (-2 - 3 * ROOT_6) / 225],
        [(16 - ROOT_6) / 36, (16 + ROOT_6) / 36, 1 / 9],
    ]
)
SWING = 0.5  # of a part's length times the frequency that its stiffest entry would swing at
ALONG = 1e-9  # of the sizes of a switch's slope and of the rates: less is no crossing
AT_ONCE = 1_000_000  # numbers of the equations that are solved in one call


@dataclass(frozen=True, eq=False)
class Transitions:
    """Of M steps: (M, nx, nx), (M, nx, nu) and (M, nx, n) by state, input and parameters, jumps at events included."""

    by_x: Array
    by_u: Array
    by_parameters: Array


def transitions(plant: FlowPlant, flow: Flow, materials: Array, by_parameters: Array) -> Transitions:
    """The derivatives of the steps of `flow`, those of the materials by n parameters being `by_parameters` (4 P, n)."""
    xs, us, hs = np.array(flow.xs), np.array(flow.us), np.array(flow.hs)
    nx, nu = xs.shape[1], us.shape[1]
    changes = np.empty((len(hs), nx, nx + nu + by_parameters.shape[1]))
    sets: dict[tuple[int, ...], list[int]] = {}
    for i, modes in enumerate(flow.modes):
        sets.setdefault(pushing_of(modes), []).append(i)
    for pushing, chosen in sets.items():
        rows_of_materials = [4 * i + j for i in pushing for j in range(4)]
        slopes = Slopes(plant.part(pushing), materials, by_parameters[rows_of_materials])
        at_once = max(1, AT_ONCE // (9 * nx * changes.shape[2]))
        for first in range(0, len(chosen), at_once):
            rows = np.array(chosen[first : first + at_once])
            changes[rows] = _changes(slopes, plant.model.nq, xs[rows], xs[rows + 1], us[rows], hs[rows])
    for m in flow.deep:
        plant.check_normals(xs[m], xs[m + 1], pushing_of(flow.modes[m]))
    modes_now: dict[int, Array] = {}
    for event in flow.events:
        if event.step:  # one that it begins with is none on the way
            now = modes_now.setdefault(event.step, flow.modes[event.step - 1].copy())
            _jump(plant, event, flow.us[event.step - 1], now, materials, by_parameters, changes[event.step - 1])
    return Transitions(changes[:, :, :nx], changes[:, :, nx : nx + nu], changes[:, :, nx + nu :])


def _changes(slopes: Slopes, nq: int, starts: Array, ends: Array, us: Array, hs: Array) -> Array:
    """(M, nx, width) of steps of lengths hs (M,) from `starts` (M, nx) to `ends`.

    A motion that rests does not show how fast it would swing either: steps that are long for that are taken in parts.
    """
    count, nx = starts.shape
    at_start, at_end = slopes.at_ends(starts, ends, us)
    stiffness = np.max(np.abs(at_start[1][:, nq:, :nq]), axis=(1, 2), initial=0.0)
    parts = np.ceil(np.maximum(hs * np.sqrt(stiffness) / SWING, 1.0)).astype(int)
    changes = np.empty((count, nx, at_end[1].shape[2]))
    for number in np.unique(parts).tolist():
        rows = np.flatnonzero(parts == number)
        here = starts[rows], ends[rows], hs[rows]
        near = [(rates[rows], by_all[rows]) for rates, by_all in (at_start, at_end)]
        for j in range(number):
            points = [(j + c) / number for c in NODES] + [(j + 1) / number] * (j + 1 < number)
            on_the_way = [slopes(between(point, *here, *near), us[rows])[1] for point in points]
            on_the_way += [near[1][1]] * (j + 1 == number)
            change = _collocated(np.stack(on_the_way, axis=1), hs[rows] / number)
            if j:
                total = change[:, :, :nx] @ changes[rows]
                total[:, :, nx:] += change[:, :, nx:]
                change = total
            changes[rows] = change
    return changes


def _collocated(slopes: Array, hs: Array) -> Array:
    """(M, nx, width) from the slopes (M, 3, nx, width) at the three points of steps of lengths hs (M,)."""
    count, _, nx, _ = slopes.shape
    parts = hs[:, None, None, None, None] * WEIGHTS[None, :, :, None, None] * slopes[:, None]
    left = -parts[..., :nx].transpose(0, 1, 3, 2, 4).reshape(count, 3 * nx, 3 * nx)
    diagonal = np.arange(3 * nx)
    left[:, diagonal, diagonal] += 1.0
    right = np.sum(parts, axis=2)
    right[..., :nx] = np.eye(nx)
    return np.asarray(np.linalg.solve(left, right.reshape(count, 3 * nx, -1))[:, 2 * nx :])


def _jump(
    plant: FlowPlant, event: FlowEvent, u: Array, modes: Array, materials: Array, by_parameters: Array, step: Array
) -> None:
    """Put the jump at an event onto the derivative of the `step` that ended there, and turn its switch in `modes`.

    Several at once are taken one after the other.
    """
    nx, nu = len(event.x), len(u)
    before = np.asarray(plant.part(pushing_of(modes)).rates(event.x, u, materials)).ravel()
    pair = event.switch // 2
    modes[2 * pair : 2 * pair + 2] = event.modes
    jump = np.asarray(plant.part(pushing_of(modes)).rates(event.x, u, materials)).ravel() - before
    row = np.asarray(plant.switch_slope(event.switch)(event.x, u, materials)).ravel()
    rate = float(row[:nx] @ before)
    steep = abs(rate) / max(float(np.linalg.norm(row[:nx]) * np.linalg.norm(before)), 1e-300)
    if np.any(jump) and steep > ALONG:
        by = row[:nx] @ step
        by[nx : nx + nu] += row[nx : nx + nu]
        by[nx + nu :] += row[nx + nu :] @ by_parameters
        step += np.outer(jump / rate, by)


METHOD = "continuous"
Chooser = Callable[[Array, int], Array]  # the state (nx,) and the number of the interval -> the input (nu,)


class FlowSteps:
    """The flow of a model, to which a vector of contact parameters is applied; ModelError where it has none."""

    def __init__(self, model: Model, vector: ParameterVector, tolerance: float = TOLERANCE):
        for parameter in vector.parameters:
            if parameter.kind.quantity not in QUANTITIES:
                raise ModelError(
                    f'method="continuous" takes no {parameter.name}: of parameters it takes contact\'s '
                    f"{', '.join(QUANTITIES)}"
                )
        self.model, self.vector, self.plant = model, vector, flow_plant(model)
        self.material, self._limits = material_of(self.plant), model.position_limits
        self.integrator = Integrator(self.plant, numbers_of(self.plant, self.material), tolerance)

    def roll(self, x0: Array, choose: Chooser, count: int) -> tuple[Array, Array, Flow]:
        """xs (N+1, nx) at the ends of the intervals, us (N, nu), and the flow."""
        model, flow = self.model, self.integrator.begin(x0)
        xs, us = np.empty((count + 1, model.nx)), np.empty((count, model.nu))
        xs[0] = x0
        for k in range(count):
            us[k] = choose(xs[k], k)
            begin = len(flow.hs)
            stepped()
            xs[k + 1] = self.integrator.advance(flow, us[k], model.time_step)
            self._check_limits(np.array(flow.xs[begin:]))
        return xs, us, flow

    def _check_limits(self, xs: Array) -> None:
        lower, upper = self._limits
        qs = xs[:, : self.model.nq]
        beyond = np.flatnonzero(np.any((qs < lower) | (qs > upper), axis=0))
        if len(beyond):
            name = self.model.state_names[beyond[0]]
            raise SimulationError(f"{name} reaches a joint limit, whose motion in continuous time is not known here")

    def derivatives(self, flow: Flow) -> list[StepDerivatives]:
        """Of the intervals of a flow."""
        nu, names = self.model.nu, self.vector.names
        material = self.integrator.materials
        by_parameters = np.zeros((len(material), len(names)))
        if names:
            change = material_change(self.plant.pairs, self.material, self.vector, self.model.double)
            by_parameters = numbers_of(self.plant, change)
        changes = transitions(self.plant, flow, material, by_parameters)
        steps, begin = [], 0
        for end in flow.ends:
            A, B = np.eye(self.model.nx), np.zeros((self.model.nx, nu))
            C = np.zeros((self.model.nx, len(names)))
            for m in range(begin, end):
                by_x = changes.by_x[m]
                A, B = by_x @ A, by_x @ B + changes.by_u[m]
                C = by_x @ C + changes.by_parameters[m]
            x_next = frozen(flow.xs[end])
            reason = f"the flow by {end - begin} steps"
            steps.append(
                StepDerivatives(x_next, frozen(A), frozen(B), frozen(C), names, (METHOD,) * len(names), METHOD, reason)
            )
            begin = end
        return steps


class FlowIntervals:
    """`Intervals` in continuous time."""

    def __init__(self, model: Model, vector: ParameterVector, tolerance: float = TOLERANCE):
        self.steps, self.model = FlowSteps(model, vector, tolerance), model

    def _flow(self, x: Array, u: Array) -> Flow:
        return self.steps.roll(x, lambda _x, _k: u, 1)[2]

    def end(self, x: Array, u: Array) -> Array:
        return self._flow(x, u).xs[-1]

    def derivatives(self, x0: Array, us: Array, xs: Array | None = None) -> list[StepDerivatives]:
        flows: list[Flow] = []
        for k, u in enumerate(us):
            begin = xs[k] if xs is not None else flows[-1].xs[-1] if flows else x0
            flows.append(self._flow(begin, u))
        if all(np.array_equal(a.xs[-1], b.xs[0]) for a, b in pairwise(flows)):
            return self.steps.derivatives(_joined(flows))  # at once, which costs less
        return [by_interval for flow in flows for by_interval in self.steps.derivatives(flow)]

    def jacobians(self, xs: Array, us: Array, ends: Array | None = None) -> Array:
        derivatives = self.derivatives(xs[0], us, xs[: len(us)])
        return np.array([np.hstack([d.A, d.B]) for d in derivatives])

    def touching(self, x: Array, u: Array) -> tuple[tuple[str, str], ...]:
        pairs = self.steps.plant.pairs
        pushing = sorted({i for modes in self._flow(x, u).modes for i in pushing_of(modes)})
        names = ((pairs.bodies[side[i]].name() for side in (pairs.sphere_body, pairs.other_body)) for i in pushing)
        return tuple((a, b) for a, b in names)


def _joined(flows: list[Flow]) -> Flow:
    """Flows over an interval each, every one from where the one before ends, as one.

    Switches that are found turned where an interval begins turned at the end of the one before.
    """
    whole = Flow([0.0], [flows[0].xs[0]])
    for flow in flows:
        done, since = len(whole.hs), whole.times[-1]
        whole.times += [since + time for time in flow.times[1:]]
        whole.xs += flow.xs[1:]
        for name in ("hs", "us", "modes"):
            getattr(whole, name).extend(getattr(flow, name))
        whole.events += [replace(e, time=since + e.time, step=done + e.step) for e in flow.events if e.step]
        whole.deep += [done + m for m in flow.deep]
        whole.ends.append(len(whole.hs))
    return whole


GAUSS_NODES = 0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)
GAUSS_WEIGHTS = 5 / 18, 8 / 18, 5 / 18


def measured_flow(
    model: Model, vector: ParameterVector, x0: Array, choose: Chooser, count: int
) -> tuple[Array, Array, Array, Array, Array, tuple[tuple[ContactPoint, ...], ...]]:
    """The flow of a model, to which the vector is applied, over `count` (N) of its intervals.

    xs (N+1, nx), us (N, nu), efforts (N, nu), the work (N+1, 3) [J] of actuators, damping and contact since the start,
    the largest penetration (N+1,) [m] since the end before, and the contacts of each interval where they are deepest.
    """
    steps = FlowSteps(model, vector)
    xs, us, flow = steps.roll(x0, choose, count)
    materials, ends = steps.integrator.materials, [0, *flow.ends]
    depths = _depths(steps.plant, flow, materials)
    deepest = np.array([depths[0], *(np.max(depths[begin : end + 1]) for begin, end in pairwise(ends))])
    limits = steps.plant.description.effort_limits
    work, contacts = _work(steps.plant, flow, materials)[ends], _contacts(steps.plant, flow, materials)
    return xs, us, np.clip(us, -limits, limits), work, deepest, contacts


def _depths(plant: FlowPlant, flow: Flow, materials: Array) -> Array:
    """(M+1,) [m] how deep the pairs overlap at the ends of the steps, at most; 0 where none does."""
    if not plant.num_pairs:
        return np.zeros(len(flow.xs))
    nothing = np.zeros(plant.model.nu)
    depths = [np.asarray(plant.switches(x, nothing, materials)).ravel()[::2] for x in flow.xs]
    return np.maximum(np.max(depths, axis=1), 0.0)


def _work(plant: FlowPlant, flow: Flow, materials: Array) -> Array:
    """(M+1, 3) [J] what actuators did, what damping took and what contact did since the start."""
    xs, us, hs = np.array(flow.xs), np.array(flow.us), np.array(flow.hs)
    done = np.zeros((len(xs), 3))
    sets: dict[tuple[int, ...], list[int]] = {}
    for m, modes in enumerate(flow.modes):
        sets.setdefault(pushing_of(modes), []).append(m)
    for pushing, chosen in sets.items():
        rows, powers = np.array(chosen), _powers(plant, pushing)
        slopes = Slopes(plant.part(pushing), materials, np.zeros((4 * len(pushing), 0)))
        starts, ends = xs[rows], xs[rows + 1]
        at_start, at_end = slopes.at_ends(starts, ends, us[rows])
        for share, weight in zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True):
            states = between(share, starts, ends, hs[rows], at_start, at_end)
            watts = [np.asarray(powers(x, u, materials)).ravel() for x, u in zip(states, us[rows], strict=True)]
            done[rows + 1] += weight * hs[rows, None] * np.array(watts)
    return np.asarray(np.cumsum(done, axis=0))


def _powers(plant: FlowPlant, pushing: tuple[int, ...]) -> Any:
    """(x, u, materials) -> (3,) [W] of actuators, damping and contact."""
    description, tree = plant.description, plant.tree
    driven = ca.DM(description.actuation) @ plant.effort
    push = ca.SX.zeros(plant.model.nv)
    for i in pushing:
        push += plant.touches[i].force
    damping = ca.DM(description.by_velocity("damping"))
    power = ca.vertcat(ca.dot(tree.v, driven), ca.dot(damping * tree.v, tree.v), ca.dot(tree.v, push))
    return ca.Function("powers", [plant.x, plant.u, plant.materials], [ca.densify(power)])


def _contacts(plant: FlowPlant, flow: Flow, materials: Array) -> tuple[tuple[ContactPoint, ...], ...]:
    """Of each interval the pairs that push in it, at that end of a step where they are deepest."""
    if not plant.num_pairs:
        return ((),) * len(flow.ends)
    of_all = [ca.horzcat(t.point, t.normal, t.push, ca.vertcat(t.depth, t.speed, 0)) for t in plant.touches]
    read = ca.Function("contacts", [plant.x, plant.u, plant.materials], [ca.horzcat(*of_all)])
    nothing, contacts = np.zeros(plant.model.nu), []
    for begin, end in pairwise([0, *flow.ends]):
        deepest: dict[int, tuple[float, Array]] = {}
        for m in range(begin, end):
            pushing = pushing_of(flow.modes[m])
            for x in flow.xs[m : m + 2] if pushing else ():
                values = np.asarray(read(x, nothing, materials)).reshape(3, -1, 4)
                for i in pushing:
                    depth = float(values[0, i, 3])
                    if depth > deepest.get(i, (0.0,))[0]:
                        deepest[i] = depth, values[:, i]
        contacts.append(tuple(_contact(plant, i, values) for i, (_, values) in sorted(deepest.items())))
    return tuple(contacts)


def _contact(plant: FlowPlant, i: int, values: Array) -> ContactPoint:
    """Of pair `i`, from its point, its normal, the force on the sphere, and (depth, speed of slip, 0)."""
    point, normal, force, sizes = values.T
    a, b = plant.pairs.bodies[plant.pairs.sphere_body[i]], plant.pairs.bodies[plant.pairs.other_body[i]]
    if plant.model.plant.IsAnchored(a):  # the force is the one on what can move
        a, b, normal, force = b, a, -normal, -force
    where = frozen(point), frozen(normal), frozen(force)
    return ContactPoint(a.name(), b.name(), *where, float(sizes[0]), float(sizes[1]))
