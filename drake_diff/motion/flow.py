"""The flow over a model's intervals: its end states, their derivatives, and the contacts and work along its steps.

Within a step the motion is interpolated by the polynomial of degree 5 that matches the states, their rates and the time
derivatives of the rates at both ends.

The sensitivity Phi within a step solves Phi' = A(t) Phi + B(t), where A and B are the derivatives of the rates along
the motion. It is integrated by the three-point collocation method of order 5 (Radau IIA; Hairer and Wanner, "Solving
Ordinary Differential Equations II", 1996, IV.5). This method is stable for any step length: a resting motion allows
long steps, but the stiff friction that keeps it at rest makes its sensitivity stiff.

If a switch changes sign at an event within the motion, the time of the event changes with the state. If the rates jump
at the event from f- to f+,

    dx+ = (1 + (f+ - f-) g' / (g' f-)) dx-,

where g' is the gradient of the switch. This is the saltation matrix (Leine and Nijmeijer, "Dynamics and Bifurcations of
Non-Smooth Mechanical Systems", 2004). The step before ends at the event, so the derivative of its length is not needed.

Work is integrated from the power at three points of each step by Gauss quadrature of order 6.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff.derivatives.contact.laws import QUANTITIES, material_change
from drake_diff.derivatives.step import Linearization, StepDerivatives
from drake_diff.exceptions import GradientError, ModelError, SimulationError
from drake_diff.model.contact import ContactPoint
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector
from drake_diff.model.step import stepped
from drake_diff.motion.flow_plant import FlowPlant, flow_plant, material_of, numbers_of
from drake_diff.motion.integrate import TOLERANCE, Flags, Integrator, Pairs, Step, System, deepest_contacts

METHOD = "continuous"
EDGE = 1e-9  # [m] slack of edge switches: a body that moves along an edge crosses it repeatedly by less
Chooser = Callable[[Array, int], Array]  # the state (nx,) and the number of the interval -> the input (nu,)


class FlowSystem(System):
    """A `FlowPlant` with the contact materials (4 P,) and the input `u` (nu,), evaluated in preallocated arrays."""

    per_pair = 2
    most = 10_000_000

    def __init__(self, plant: FlowPlant, materials: Array):
        model, watched = plant.model, 2 * plant.num_pairs + len(plant.edge_pairs)
        nx, nu = model.nx, model.nu
        self.plant, self.num_pairs, self.time_step = plant, plant.num_pairs, model.time_step
        self.materials, self.u, self._x, self._h = (
            np.array(materials, dtype=float),
            np.zeros(nu),
            np.zeros(nx),
            np.zeros(1),
        )
        self._ahead, self._rates, self._summary, self._moving = np.zeros(nx), np.zeros(nx), np.zeros(2), np.zeros(nx)
        self._slopes, self._values, self._changes = np.zeros((nx + nu, nx)), np.zeros(watched), np.zeros(watched)
        self.slack = np.append(np.zeros(2 * plant.num_pairs), np.full(len(plant.edge_pairs), EDGE))
        self._point = self._x, self.u, self.materials
        self._contacts = np.zeros((self.num_pairs, 4, 3))
        self._run_contacts = _bind(plant.contacts, (self._x, self.materials), (self._contacts,))
        self.lower, self.upper = model.position_limits
        self._watch = _bind(plant.watched, (*self._point, self._moving), (self._values, self._changes))
        self._parts: dict[Pairs, tuple[Any, ...]] = {}
        self.push(())

    def push(self, pairs: Pairs) -> None:
        super().push(pairs)
        if pairs not in self._parts:
            functions = self.plant.part(pairs)
            self._parts[pairs] = (
                _bind(functions.rates, self._point, (self._rates,)),
                _bind(functions.slopes, self._point, (self._rates, self._slopes)),
                _bind(functions.step, (*self._point, self._h), (self._ahead, self._rates, self._summary)),
            )
        self._run_rates, self._run_slopes, self._run_step = self._parts[pairs]

    def rates(self, x: Array) -> Array:
        self.used += 1
        self._x[:] = x
        self._run_rates()
        return self._rates.copy()

    def slopes(self, x: Array, rates: Array) -> Array:
        return self.all_slopes(x)[1][:, : len(x)]

    def all_slopes(self, x: Array) -> tuple[Array, Array]:
        """Return the rates (nx,) and their derivatives (nx, nx + nu) with respect to state and input."""
        self._x[:] = x
        self._run_slopes()
        return self._rates.copy(), self._slopes.T.copy()

    def explicit(self, x: Array, rates: Array, h: float) -> tuple[Array, Array, float, float]:
        self.used += 6
        self._x[:], self._h[0] = x, h
        self._run_step()
        return self._ahead.copy(), self._rates.copy(), float(self._summary[0]), float(self._summary[1])

    def watch(self, x: Array, rates: Array) -> tuple[Array, Array]:
        self._x[:], self._moving[:] = x, rates
        self._watch()
        return self._values.copy(), self._changes.copy()

    def pushing_where(self, on: Flags) -> Pairs:
        count = 2 * self.num_pairs
        return tuple(np.flatnonzero(on[:count:2] & on[1:count:2]).tolist())

    def relevant(self, on: Flags) -> Flags:
        """Select the brackets of overlapping pairs and the edges of pairs with a contact force."""
        relevant, count = np.ones(len(on), dtype=bool), 2 * self.num_pairs
        relevant[1:count:2] = on[:count:2]
        relevant[count:] = (on[:count:2] & on[1:count:2])[self.plant.edge_pairs]
        return relevant

    def check(self, x: Array) -> None:
        beyond = (x[: len(self.lower)] < self.lower) | (x[: len(self.lower)] > self.upper)
        if beyond.any():
            name = self.plant.model.state_names[int(np.argmax(beyond))]
            raise SimulationError(f"{name} reaches a joint limit, which is not supported in continuous time")
        self.plant.check(x)

    def contacts(self, x: Array) -> Array:
        """Return, for each pair (P, 4, 3), the contact point, the normal, the force, and (depth, slip speed, 0)."""
        self._x[:] = x
        self._run_contacts()
        return self._contacts.copy()

    def points_at(self, x: Array, pairs: Pairs) -> list[tuple[int, ContactPoint]]:
        plant, values, points = self.plant, self.contacts(x), []
        for i in pairs:
            point, normal, force, (depth, speed, _) = values[i]
            a, b = (plant.pairs.bodies[side[i]] for side in (plant.pairs.sphere_body, plant.pairs.other_body))
            if plant.model.plant.IsAnchored(a):  # report the force on the movable body
                a, b, normal, force = b, a, -normal, -force
            where = frozen(point), frozen(normal), frozen(force)
            points.append((i, ContactPoint(a.name(), b.name(), *where, float(depth), float(speed))))
        return points


def _bind(function: Any, arguments: Sequence[Array], results: Sequence[Array]) -> Any:
    """Return a callable that runs a CasADi function on fixed arrays."""
    buffer, run = function.buffer()
    for i, a in enumerate(arguments):
        if a.size:
            buffer.set_arg(i, a.data)
    for i, a in enumerate(results):
        if a.size:
            buffer.set_res(i, a.data)
    run.buffer = buffer  # keeps the buffer alive as long as `run`
    return run


def _between(share: float, starts: Array, ends: Array, hs: Array, at_start: Any, at_end: Any) -> Array:
    """Interpolate (M, nx) at the fraction `share` of steps of lengths hs (M,), from the ends' rates and Jacobians."""
    c, d, h = share, 1 - share, hs[:, None]
    (f0, A0), (f1, A1) = at_start, at_end
    j0, j1 = ((A[:, :, : f.shape[1]] @ f[:, :, None])[:, :, 0] for f, A in ((f0, A0), (f1, A1)))
    of_gap = c**3 * (10 - 15 * c + 6 * c**2)
    of_f0, of_f1 = c * d**3 * (1 + 3 * c), -(c**3) * d * (4 - 3 * c)
    of_j0, of_j1 = c**2 * d**3 / 2, c**3 * d**2 / 2
    states = starts + of_gap * (ends - starts) + h * (of_f0 * f0 + of_f1 * f1) + h**2 * (of_j0 * j0 + of_j1 * j1)
    return np.asarray(states)


ROOT_6 = np.sqrt(6.0)
NODES = (4 - ROOT_6) / 10, (4 + ROOT_6) / 10  # the third node is the end of the step
WEIGHTS = np.array(
    [
        [(88 - 7 * ROOT_6) / 360, (296 - 169 * ROOT_6) / 1800, (-2 + 3 * ROOT_6) / 225],
        [(296 + 169 * ROOT_6) / 1800, (88 + 7 * ROOT_6) / 360, (-2 - 3 * ROOT_6) / 225],
        [(16 - ROOT_6) / 36, (16 + ROOT_6) / 36, 1 / 9],
    ]
)
SWING = 0.5  # maximum of a part's length times the frequency of its stiffest entry
SAME_WAY = 0.5  # smallest cosine of a normal's rotation in a step: error control keeps it near 1 unless it jumps
ALONG = 1e-9  # relative to the norms of a switch's gradient and of the rates: a smaller rate is not a crossing
AT_ONCE = 1_000_000  # numbers in the equations that are solved in one call


@dataclass(frozen=True, eq=False)
class Flow:
    """`intervals` are N lists of steps, from xs[k] under us[k] to xs[k + 1] unless other start states were given."""

    xs: Array
    us: Array
    intervals: list[list[Step]]

    @property
    def steps(self) -> list[tuple[Step, Array]]:
        """All steps with their inputs."""
        return [(step, u) for steps, u in zip(self.intervals, self.us, strict=True) for step in steps]


class FlowSteps:
    """The `Intervals` in continuous time of a model to which a vector of contact parameters is applied.

    Raises ModelError if continuous time does not support the model or a parameter.
    """

    def __init__(self, model: Model, vector: ParameterVector, tolerance: float = TOLERANCE):
        for parameter in vector.parameters:
            if parameter.kind.quantity not in QUANTITIES:
                raise ModelError(
                    f'method="continuous" does not support {parameter.name}, only contact\'s {", ".join(QUANTITIES)}'
                )
        self.model, self.vector, self.plant = model, vector, flow_plant(model)
        self.material = material_of(self.plant)
        self.system = FlowSystem(self.plant, numbers_of(self.plant, self.material))
        self.integrator = Integrator(self.system, tolerance)

    def roll(self, x0: Array, choose: Chooser, count: int) -> Flow:
        """Integrate the motion from `x0` (nx,) over `count` (N) intervals."""
        xs, us, intervals = np.empty((count + 1, self.model.nx)), np.empty((count, self.model.nu)), []
        xs[0] = x0
        for k in range(count):
            us[k] = choose(xs[k], k)
            intervals.append(self._advance(us[k], xs[0] if k == 0 else None))
            xs[k + 1] = intervals[-1][-1].ahead
        return Flow(xs, us, intervals)

    def _advance(self, u: Array, start: Array | None = None) -> list[Step]:
        """Integrate an interval from `start` (nx,), or from the end of the last interval, and return its steps."""
        stepped()
        self.system.u[:] = u
        if start is not None:
            self.integrator.start(start)
        return self.integrator.advance(self.model.time_step)

    def end(self, x: Array, u: Array) -> Array:
        return self._advance(u, x)[-1].ahead

    def derivatives(self, x0: Array, us: Array, xs: Array | None = None) -> list[StepDerivatives]:
        intervals = list[list[Step]]()
        for k, u in enumerate(us):
            start = xs[k] if xs is not None else intervals[-1][-1].ahead if intervals else x0
            intervals.append(self._advance(u, start))
        return self.differentiate(Flow(np.array([x0, *(steps[-1].ahead for steps in intervals)]), us, intervals))

    def jacobians(self, xs: Array, us: Array, ends: Array | None = None) -> Array:
        return np.array([np.hstack([d.A, d.B]) for d in self.derivatives(xs[0], us, xs[: len(us)])])

    def touching(self, x: Array, u: Array) -> tuple[tuple[str, str], ...]:
        pairs = self.plant.pairs
        pushing = sorted({i for step in self._advance(u, x) for i in step.pushing})
        names = ((pairs.bodies[side[i]].name() for side in (pairs.sphere_body, pairs.other_body)) for i in pushing)
        return tuple((a, b) for a, b in names)

    def differentiate(self, flow: Flow) -> list[StepDerivatives]:
        """Return the derivatives of a flow's intervals."""
        nx, nu, linearization, derivatives = self.model.nx, self.model.nu, self.linearize(flow), []
        for steps, total in zip(flow.intervals, linearization.jacobians, strict=True):
            A, B, C = (frozen(block) for block in np.split(total, [nx, nx + nu], axis=1))
            reason = f"the flow by {len(steps)} steps"
            names, sources = linearization.parameters, linearization.sources
            derivatives.append(StepDerivatives(frozen(steps[-1].ahead), A, B, C, names, sources, METHOD, reason))
        return derivatives

    def linearize(self, flow: Flow) -> Linearization:
        """Return the Jacobians of a flow's intervals."""
        nx, nu, names = self.model.nx, self.model.nu, self.vector.names
        by_parameters = np.zeros((4 * self.plant.num_pairs, len(names)))
        if names:
            change = material_change(self.plant.pairs, self.material, self.vector, self.model.double)
            by_parameters = numbers_of(self.plant, change)
        changes = iter(self._changes(flow, by_parameters))
        totals = np.empty((len(flow.intervals), nx, nx + nu + len(names)))
        for i, steps in enumerate(flow.intervals):
            total = np.hstack([np.eye(nx), np.zeros((nx, nu + len(names)))])
            for change in (next(changes) for _ in steps):
                total = change[:, :nx] @ total
                total[:, nx:] += change[:, nx:]
            totals[i] = total
        return Linearization(flow.xs[1:], totals, names, (METHOD,) * len(names), (METHOD,))

    def _changes(self, flow: Flow, by_parameters: Array) -> Array:
        """Return all steps' derivatives (M, nx, nx + nu + n) with respect to (x, u, parameters), events included."""
        steps, nx = flow.steps, self.model.nx
        changes = np.empty((len(steps), nx, nx + self.model.nu + by_parameters.shape[1]))
        at_once = max(1, AT_ONCE // (9 * nx * changes.shape[2]))
        for first in range(0, len(steps), at_once):
            _Slopes(self.system, steps[first : first + at_once], by_parameters).integrate(
                changes[first : first + at_once]
            )
        for change, (step, u) in zip(changes, steps, strict=True):
            self._check_normals(step)
            if step.events:
                self._jump(step, u, by_parameters, change)
        return changes

    def _check_normals(self, step: Step) -> None:
        """Raise GradientError if the normal of a pair with a contact force jumps within a step."""
        if not step.pushing:
            return
        pairs = list(step.pushing)
        first, last = (self.system.contacts(x)[pairs, 1] for x in (step.x, step.ahead))
        for i in np.flatnonzero(np.sum(first * last, axis=1) < SAME_WAY):
            inspector = self.model.double.inspector
            names = " and ".join(inspector.GetName(j) for j in self.plant.pairs.ids[pairs[i]])
            raise GradientError(
                f"{names} overlap so deeply that their contact normal jumps, and the derivative of that motion "
                "is not known: use stiffer contact"
            )

    def _jump(self, step: Step, u: Array, by_parameters: Array, change: Array) -> None:
        """Apply the saltation matrices of the events that ended a step to its derivative, one after the other."""
        (nx, nu), x, pushing = (self.model.nx, self.model.nu), step.ahead, step.pushing
        for event in step.events:
            before, after = (self._rates(pairs, x, u) for pairs in (pushing, event.pushing))
            row = np.asarray(self.plant.switch_slope(event.switch)(x, u, self.system.materials)).ravel()
            rate, pushing = float(row[:nx] @ before), event.pushing
            steep = abs(rate) / max(float(np.linalg.norm(row[:nx]) * np.linalg.norm(before)), 1e-300)
            if np.any(after != before) and steep > ALONG:
                by = row[:nx] @ change
                by[nx : nx + nu] += row[nx : nx + nu]
                by[nx + nu :] += row[nx + nu :] @ by_parameters
                change += np.outer((after - before) / rate, by)

    def _rates(self, pushing: Pairs, x: Array, u: Array) -> Array:
        return np.asarray(self.plant.part(pushing).rates(x, u, self.system.materials)).ravel()


class _Slopes:
    """Rates along some steps, and their derivatives with respect to state, input and n parameters."""

    def __init__(self, system: FlowSystem, steps: Sequence[tuple[Step, Array]], by_parameters: Array):
        self.system, self.steps, self.by_parameters = system, steps, by_parameters
        self.starts, self.ends = (np.array([getattr(step, end) for step, _ in steps]) for end in ("x", "ahead"))
        self.hs = np.array([step.h for step, _ in steps])
        every = range(len(steps))
        self.at_start, self.at_end = self(self.starts, every), self(self.ends, every)

    def __call__(self, xs: Array, rows: Any) -> tuple[Array, Array]:
        """Return the rates (M, nx) at xs (M, nx) in the steps `rows`, and their derivatives (M, nx, nx + nu + n)."""
        system, n = self.system, self.by_parameters.shape[1]
        (count, nx), nu = xs.shape, len(system.u)
        rates, slopes = np.empty((count, nx)), np.empty((count, nx, nx + nu + n))
        for k, i in enumerate(rows):
            step, system.u[:] = self.steps[i]
            if step.pushing != system.pushing:
                system.push(step.pushing)
            rates[k], slopes[k, :, : nx + nu] = system.all_slopes(xs[k])
            if n:
                of_pushing = [4 * pair + j for pair in step.pushing for j in range(4)]
                by_materials = system.plant.part(step.pushing).material_slopes(xs[k], system.u, system.materials)
                slopes[k, :, nx + nu :] = np.asarray(by_materials) @ self.by_parameters[of_pushing]
        return rates, slopes

    def between(self, share: float, rows: Any) -> Array:
        """Return the states (M, nx) at the fraction `share` of the steps `rows`."""
        at_ends = ((rates[rows], slopes[rows]) for rates, slopes in (self.at_start, self.at_end))
        return _between(share, self.starts[rows], self.ends[rows], self.hs[rows], *at_ends)

    def integrate(self, changes: Array) -> None:
        """Fill `changes` (M, nx, nx + nu + n) with the sensitivities of the steps.

        A resting motion does not show the frequency of oscillations around it. Steps that are long relative to this
        frequency are divided into parts.
        """
        nx, nq = self.starts.shape[1], self.system.plant.model.nq
        stiffness = np.max(np.abs(self.at_start[1][:, nq:, :nq]), axis=(1, 2), initial=0.0)
        parts = np.ceil(np.maximum(self.hs * np.sqrt(stiffness) / SWING, 1.0)).astype(int)
        for number in np.unique(parts).tolist():
            rows = np.flatnonzero(parts == number)
            for j in range(number):
                points = [(j + c) / number for c in NODES] + [(j + 1) / number] * (j + 1 < number)
                slopes = [self(self.between(point, rows), rows)[1] for point in points]
                slopes += [self.at_end[1][rows]] * (j + 1 == number)
                change = _collocated(np.stack(slopes, axis=1), self.hs[rows] / number)
                if j:
                    total = change[:, :, :nx] @ changes[rows]
                    total[:, :, nx:] += change[:, :, nx:]
                    change = total
                changes[rows] = change


def _collocated(slopes: Array, hs: Array) -> Array:
    """Solve for sensitivities (M, nx, width) of steps with lengths hs (M,); `slopes` (M, 3, nx, width) at 3 points."""
    count, _, nx, _ = slopes.shape
    parts = hs[:, None, None, None, None] * WEIGHTS[None, :, :, None, None] * slopes[:, None]
    left = -parts[..., :nx].transpose(0, 1, 3, 2, 4).reshape(count, 3 * nx, 3 * nx)
    diagonal = np.arange(3 * nx)
    left[:, diagonal, diagonal] += 1.0
    right = np.sum(parts, axis=2)
    right[..., :nx] = np.eye(nx)
    return np.asarray(np.linalg.solve(left, right.reshape(count, 3 * nx, -1))[:, 2 * nx :])


GAUSS_NODES = 0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)
GAUSS_WEIGHTS = 5 / 18, 8 / 18, 5 / 18


def measured_flow(
    model: Model, vector: ParameterVector, x0: Array, choose: Chooser, count: int
) -> tuple[Array, Array, Array, Array, list[tuple[ContactPoint, ...]]]:
    """Compute the arguments of `continuous_rollout` for a model with `vector` applied, over `count` intervals."""
    steps = FlowSteps(model, vector)
    flow = steps.roll(x0, choose, count)
    limits, ends = steps.plant.description.effort_limits, np.cumsum([0, *map(len, flow.intervals)])
    contacts = [deepest_contacts(steps.system, interval) for interval in flow.intervals]
    return flow.xs, flow.us, np.clip(flow.us, -limits, limits), _work(steps.system, flow.steps)[ends], contacts


def _work(system: FlowSystem, steps: Sequence[tuple[Step, Array]]) -> Array:
    """Return the work of actuators, dissipation by damping and work of contact (M+1, 3) [J] since the start."""
    slopes, rows = _Slopes(system, steps, np.zeros((4 * system.num_pairs, 0))), np.arange(len(steps))
    done = np.zeros((len(steps) + 1, 3))
    for share, weight in zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True):
        for k, (x, (step, u)) in enumerate(zip(slopes.between(share, rows), steps, strict=True)):
            watts = system.plant.powers(step.pushing)(x, u, system.materials)
            done[k + 1] += weight * step.h * np.asarray(watts).ravel()
    return np.asarray(np.cumsum(done, axis=0))
