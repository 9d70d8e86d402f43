"""A controller on the discrete plant: through a sensor, an estimator and an actuator, pushed, and with a fallback.

    x_k -> sensor -> estimator -> controller -> actuator -> plant -> x_(k+1)

The controller has its own period, a whole number of the plant's steps. All randomness comes from one seed. How long
the controller takes is measured and told; what is simulated does not depend on it.

Controllers that need no more than a plan: its inputs as they are, or TVLQR about it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.tree import JacobianWrtVariable

from drake_diff._base.arrays import Array, count, finite_array, frozen, positive_float, positive_int
from drake_diff.exceptions import DrakeDiffError, InputError, NonFiniteError, SimulationError, UnknownNameError
from drake_diff.loop.parts import Actuator, Estimator, Fallback, Hold, Sensor
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies
from drake_diff.model.step import advance, set_state
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.rollout import Meter, Policy, Rollout
from drake_diff.optimize.replay import track
from drake_diff.optimize.solution import Solution

Controller = Callable[[Array, float], Any]  # u (nu,) = controller(x (nx,), t [s])
OK = "ok"


@dataclass(frozen=True, eq=False)
class Push:
    """A blow of `impulse` (3,) [N s] in world at the centre of mass of `body`, at time `at` [s]."""

    body: str
    impulse: ArrayLike
    at: float


class LoopEvent(NamedTuple):
    """Something that happened at simulated time `t` [s]: fallback, recovery, push or failure."""

    t: float
    kind: str
    message: str


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """What happened; arrays are read-only, rows of the controller's steps unless said otherwise.

    `motion` is the plant's, step by step of the plant, with its measures. `ended` is "" or why the run broke off.
    """

    motion: Rollout
    times: Array  # (N,) [s] of the controller's steps
    observations: Array  # (N, nx), NaN where nothing arrived
    estimates: Array  # (N, nx)
    commands: Array  # (N, nu)
    applied: Array  # (N, nu)
    controller_status: tuple[str, ...]  # "ok", or why the fallback was in charge
    events: tuple[LoopEvent, ...]
    latencies: Array  # (N,) [s] that the controller took, on this machine
    latency_budget: float | None
    ended: str

    @property
    def late(self) -> int:
        """How many of the controller's answers took longer than the budget; 0 without one."""
        return 0 if self.latency_budget is None else int(np.sum(self.latencies > self.latency_budget))


@dataclass(frozen=True, eq=False)
class Loop:
    """What stands around a controller. `substeps` of the plant are taken in each step of the controller."""

    sensor: Sensor = field(default_factory=Sensor)
    estimator: Estimator = field(default_factory=Hold)
    actuator: Actuator = field(default_factory=Actuator)
    fallback: Fallback | None = None
    pushes: Sequence[Push] = ()
    substeps: int = 1
    latency_budget: float | None = None  # [s]


def closed_loop(
    model: Model, controller: Controller, x0: ArrayLike, num_steps: int, loop: Loop | None = None, *, seed: int = 0
) -> ClosedLoop:
    """Run `controller` on the plant `model` for `num_steps` of its steps from `x0` (nx,).

    A controller with an attribute `start` has it called first, with `x0`; one with an attribute `status` is asked
    for it after each step. Raises ShapeError, NonFiniteError, InputError, UnknownNameError for bad input; a step that
    cannot be taken, or a controller that fails without a fallback, ends the run, and `ended` says so.
    """
    x0, steps = finite_array("x0", x0, (model.nx,)), positive_int("num_steps", num_steps)
    run = _Run(model, controller, loop or Loop(), np.random.default_rng(seed))
    return run.result(x0, steps)


class _Run:
    def __init__(self, model: Model, controller: Controller, loop: Loop, random: np.random.Generator):
        self.model, self.controller, self.loop = model, controller, loop
        self.period = count("Loop.substeps", loop.substeps, 1) * model.time_step
        self.read = loop.sensor.start(tangent_space(model), random)
        self.drive = loop.actuator.start(model.nu, self.period)
        self.pushes = [
            (_step_of(p, model), _body(model, p), finite_array("impulse", p.impulse, (3,))) for p in loop.pushes
        ]
        self.rows: list[tuple[Array, Array, Array, Array, str, float]] = []
        self.events: list[LoopEvent] = []
        self.unseen, self.in_charge, self.ended = 0, True, ""

    def result(self, x0: Array, num_steps: int) -> ClosedLoop:
        self.loop.estimator.start(x0)
        if hasattr(self.controller, "start"):
            self.controller.start(x0)
        meter, xs = Meter(self.model), [x0]
        us: list[Array] = []
        for k in range(num_steps):
            u = self._decide(k, xs[-1])
            if u is None:
                break
            for _ in range(self.loop.substeps):
                x = self._pushed(len(us), xs[-1])
                try:
                    after = np.asarray(advance(self.model.double, x, u))
                except SimulationError as error:
                    self._end(k, f"the plant could not be stepped: {error}")
                    break
                meter.measure_step(x, after)
                xs.append(after)
                us.append(u)
            if self.ended:
                break
        set_state(self.model.double, xs[-1])
        meter.measure_state(xs[-1])
        return self._told(meter.result(np.array(xs), np.array(us).reshape(len(us), self.model.nu)))

    def _decide(self, k: int, x: Array) -> Array | None:
        """What the actuator applies in step k; None where the run ends."""
        t = k * self.period
        seen = self.read(k, x)
        self.unseen = 0 if seen is not None else self.unseen + 1
        last = self.rows[-1][2] if self.rows else None
        estimate = self.loop.estimator.estimate(seen, last)
        command, status, taken = self._command(estimate, t)
        if command is None:
            if self.loop.fallback is None:
                self._end(k, status)
                return None
            command = self.loop.fallback.command(
                self.model, estimate, np.zeros(self.model.nu) if last is None else last
            )
        self._change(t, status)
        applied = self.drive(k, command)
        shown = np.full(self.model.nx, np.nan) if seen is None else seen
        self.rows.append((shown, estimate, command, applied, status, taken))
        return applied

    def _command(self, estimate: Array, t: float) -> tuple[Array | None, str, float]:
        """The controller's answer, None with the reason where there is none to be followed; and its time [s]."""
        fallback = self.loop.fallback
        if fallback is not None and self.unseen > fallback.patience:
            return None, f"nothing was seen for {self.unseen} steps", 0.0
        start = perf_counter()
        try:
            command = finite_array("the controller's command", self.controller(np.array(estimate), t), (self.model.nu,))
        except (DrakeDiffError, ArithmeticError, np.linalg.LinAlgError) as error:
            told = "it is not finite" if isinstance(error, NonFiniteError) else f"{type(error).__name__}: {error}"
            return None, f"the controller failed: {told}", perf_counter() - start
        return command, str(getattr(self.controller, "status", OK)), perf_counter() - start

    def _change(self, t: float, status: str) -> None:
        """Events where the fallback takes over and where the controller recovers."""
        followed = not status.startswith(("nothing was seen", "the controller failed"))
        if followed != self.in_charge:
            mode = "" if self.loop.fallback is None else self.loop.fallback.mode
            kind, told = (
                ("recovery", "the controller is followed again") if followed else ("fallback", f"{mode}: {status}")
            )
            self.events.append(LoopEvent(t, kind, told))
        self.in_charge = followed

    def _end(self, k: int, why: str) -> None:
        self.ended = f"at t = {k * self.period:.4g} s: {why}"
        self.events.append(LoopEvent(k * self.period, "failure", why))

    def _pushed(self, k: int, x: Array) -> Array:
        """The state with the velocity that pushes at plant step k give it: M dv = J' p."""
        plant, context = self.model.plant, self.model.double.context
        for at, body, impulse in self.pushes:
            if at == k:
                set_state(self.model.double, x)
                J = plant.CalcJacobianTranslationalVelocity(
                    context, JacobianWrtVariable.kV, body.body_frame(), body.CalcCenterOfMassInBodyFrame(context),
                    plant.world_frame(), plant.world_frame(),
                )  # fmt: skip
                dv = np.linalg.solve(plant.CalcMassMatrix(context), J.T @ impulse)
                x = np.concatenate([x[: self.model.nq], x[self.model.nq :] + dv])
                told = f"{body.name()} is pushed by {np.linalg.norm(impulse):.3g} N s"
                self.events.append(LoopEvent(k * self.model.time_step, "push", told))
        return x

    def _told(self, motion: Rollout) -> ClosedLoop:
        nx, nu, count = self.model.nx, self.model.nu, len(self.rows)
        columns = list(zip(*self.rows, strict=True)) or [()] * 6
        seen, estimates, commands, applied = (
            frozen(np.array(column, dtype=float).reshape(count, size))
            for column, size in zip(columns, (nx, nx, nu, nu), strict=False)
        )
        return ClosedLoop(
            motion=motion,
            times=frozen(self.period * np.arange(count)),
            observations=seen,
            estimates=estimates,
            commands=commands,
            applied=applied,
            controller_status=tuple(str(status) for status in columns[4]),
            events=tuple(self.events),
            latencies=frozen(np.array(columns[5], dtype=float)),
            latency_budget=self.loop.latency_budget,
            ended=self.ended,
        )


def _body(model: Model, push: Push) -> Any:
    plant = model.plant
    if not plant.HasBodyNamed(push.body):
        raise UnknownNameError("Push.body", got=push.body, known=tuple(b.name() for b in bodies(plant)))
    return plant.GetBodyByName(push.body)


def _step_of(push: Push, model: Model) -> int:
    if not (np.isfinite(push.at) and push.at >= 0):
        raise InputError("Push.at", got=push.at, expected="a time [s] of at least 0")
    return round(push.at / model.time_step)


class OpenLoop:
    """u = us[k], k = round(t / time_step) within 0..N-1, whatever x is: the last input is held after the end.

    `us` (N, nu), `time_step` [s].
    """

    def __init__(self, us: ArrayLike, time_step: float):
        self.us, self.time_step = finite_array("us", us, ("N", "nu")), positive_float("time_step [s]", time_step)
        if not len(self.us):
            raise InputError("us", got="0 steps", expected="at least one step")

    def __call__(self, x: Any, t: float) -> Any:
        return self.us[min(max(round(t / self.time_step), 0), len(self.us) - 1)]


def tracking(solution: Solution, parts: int = 1) -> Policy:
    """TVLQR about `solution` in steps of a `parts`-th of its own, clipped to the problem's input bounds.

    A collocated motion may need 2 to 16 parts before the plant's steps follow it. The weights are those of the
    solution's own replays (`replay.regulator_weights`). Raises GradientError or ModelError where the plant cannot be
    linearized along the plan or built at that time step.
    """
    plan = solution.plan
    return track(plan, plan.model_at(parts), *plan.sample(positive_int("parts", parts)))
