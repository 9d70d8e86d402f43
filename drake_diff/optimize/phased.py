"""Problems in phases, solved as one program. Each phase is judged as a solution, as are the links and the chain.

The chain is the motion of the dynamics from the very first state, through the resets at the plan's times, open loop or
under TVLQR. The cost-to-go of TVLQR is propagated backward through the resets as well. An `Impact` with a gap occurs
when the gap closes. It uses Drake's mass matrix, and the cost-to-go is propagated through its saltation matrix.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff.certificates.certificate import Certificate, certify_jacobian
from drake_diff.exceptions import ModelError
from drake_diff.optimize.checks import Check, Checks, check
from drake_diff.optimize.knots import PointFunction
from drake_diff.optimize.measure import INTEGRATION_TOLERANCE, derivative_check
from drake_diff.optimize.messages import under
from drake_diff.optimize.problem.fixed_contacts import Impact
from drake_diff.optimize.problem.phases import PhasedProblem, Switch
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE, NlpResult
from drake_diff.optimize.replay import FEEDBACK, OPEN_LOOP, Replay
from drake_diff.optimize.solution import PLANS, Solution, Status, Trajectories
from drake_diff.optimize.transcription.collocation import (
    FOUND,
    Collocated,
    Transcription,
)
from drake_diff.optimize.transcription.lead import SUBSTEPS
from drake_diff.optimize.verification import ended, status_of

NOT_FOUND = (Status.INFEASIBLE, Status.ITERATION_LIMIT, Status.DIVERGED, Status.FAILED)
LATE = 0.1  # fraction of a phase's duration by which an impact may be late
HALVES = 50  # bisections of the step in which a gap closes


@dataclass(frozen=True, eq=False, repr=False)
class PhasedSolution(Solution):
    """The motion that `solve` found for a `PhasedProblem`, and its measures.

    Every phase is a `Solution` with its own measures and status. Costs and horizons are sums over the phases, and
    errors are the largest of all phases. `link_errors` and `chain` measure the resets between phases, and
    `certificates` verify the derivatives of the resets. `xs` and `us` have the rows of all phases, with NaN where a
    phase has fewer states or inputs than another. `success` is true if the solver converged and all checks pass.

    Attributes:
        phases: A `Solution` for each phase, whose times start at 0.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        >>> effort = dd.QuadraticCost(R=[[1.0]])
        >>> way = dict(num_steps=5, horizon=0.5, running_cost=effort)
        >>> parts = [dd.Problem(block, x0=[0, 0], **way), dd.Problem(block, x0=[0.5, 0], x_goal=[1, 0], **way)]
        >>> solution = dd.solve(dd.optimize.PhasedProblem(parts))
        >>> solution.status.value, round(solution.cost, 6), solution.starts.tolist()
        ('converged', 12.0, [0.0, 0.5])
    """

    problem: Any  # a PhasedProblem
    phases: tuple[Solution, ...] = ()

    @classmethod
    def joined(cls, problem: PhasedProblem, phases: Sequence[Solution], **fields: Any) -> "PhasedSolution":
        """Assemble the solution of `problem` from the solutions of its phases."""
        first, rows = phases[0], ([phase.xs for phase in phases], [phase.us for phase in phases])
        whole: dict[str, Any] = {"status": Status.FAILED, "message": "", "scheme": first.scheme} | fields
        return cls(
            problem,
            first.method,
            first.solver,
            xs=_stacked(rows[0]),
            us=_stacked(rows[1]),
            phases=tuple(phases),
            **whole,
        )

    def __repr__(self) -> str:
        lines = [f"PhasedSolution of {self.problem.name}: {self.status.value}", self.message, *self.notes]
        lines.append(f"cost {self.cost:.6g}, link error {self.link_error:.2g}")
        for name, phase in zip(self.problem.names, self.phases, strict=True):
            lasts = f"{len(phase.us)} steps" if phase.problem.is_map else f"{phase.horizon:.4g} s"
            lines.append(f"{name}: {lasts}, cost {phase.cost:.6g}, defect {phase.defect:.2g}, {phase.status.value}")
        return "\n  ".join(lines)

    def told(self, **fields: Any) -> "PhasedSolution":
        """Return the same motion with other `fields`. A new status also applies to phases without a message."""
        news = {name: fields[name] for name in ("status", "message") if name in fields}
        phases = (p if p.message or "status" not in news else p.told(**news) for p in self.phases)
        changed: Any = super().told(**fields)
        vars(changed)["phases"] = tuple(phases)
        return changed

    transcribed = None  # each phase has its own motion

    def trajectory(self) -> Trajectories:
        """Raise ModelError, because each of `phases` has its own trajectory."""
        raise ModelError(
            f"{self.problem.name}: expected a phase, got all phases: each of `phases` has its own trajectory"
        )

    @property
    def defects(self) -> Array:
        """The defects of all phases, followed by the errors of all links."""
        return np.concatenate([*(phase.defects for phase in self.phases), *self.link_errors.values()])

    @property
    def integration_errors(self) -> Array:
        """The integration errors of all phases, concatenated."""
        return np.concatenate([phase.integration_errors for phase in self.phases])

    @property
    def goal_error(self) -> float:
        """The largest distance of a phase's last state from its goal."""
        return max(phase.goal_error for phase in self.phases)

    @property
    def initial_state_error(self) -> float:
        """The distance of the very first state from the given initial state."""
        return self.phases[0].initial_state_error

    @property
    def bound_excess(self) -> dict[str, tuple[float, int]]:
        """The excesses over bounds in all phases, by the phase's and the entry's name."""
        return {f"{name}: {key}": row for name, phase in self._named for key, row in phase.bound_excess.items()}

    @property
    def constraint_excess(self) -> dict[str, tuple[float, int]]:
        """The excesses over constraints in all phases, by the phase's and the constraint's name."""
        return {f"{name}: {key}": row for name, phase in self._named for key, row in phase.constraint_excess.items()}

    @property
    def cost(self) -> float:
        """The sum of the phases' costs, or inf if one is not finite."""
        return sum(phase.cost for phase in self.phases)

    @property
    def cost_error(self) -> float:
        """The sum of the phases' cost errors."""
        return sum(phase.cost_error for phase in self.phases)

    @property
    def horizon(self) -> float:
        """The duration from the first state to the last, in [s] or in steps."""
        return sum(phase.horizon for phase in self.phases)

    @property
    def starts(self) -> Array:
        """(P,) the start time of each phase, in [s] or in steps."""
        return np.cumsum([0.0, *(phase.horizon for phase in self.phases[:-1])])

    @property
    def times(self) -> Array:
        """The times [s] of the rows of `xs`."""
        return np.concatenate([start + phase.times for start, phase in zip(self.starts, self.phases, strict=True)])

    @cached_property
    def link_errors(self) -> dict[str, Array]:
        """For each reset, (n,) the distance of the next phase's first state from the reset's result; inf if unknown."""
        errors = {}
        for s in self.problem.switches:
            before, after = self.phases[s.before].xs[-1], self.phases[s.after].xs[0]
            with np.errstate(all="ignore"):
                errors[s.label] = np.nan_to_num(np.abs(s.link(before, after)), nan=np.inf)
        return errors

    @property
    def link_error(self) -> float:
        """The largest of `link_errors`, in its state's unit."""
        return max((float(np.max(errors)) for errors in self.link_errors.values()), default=0.0)

    @cached_property
    def chain(self) -> Check:
        """The check of the dynamics from the very first state through all phases, open loop or else under TVLQR.

        The value is the largest distance from the plan or beyond a bound, relative to the state's range in its phase.
        """
        return _chain_check(self)

    @property
    def following(self) -> list[Check]:
        """The check of the chain."""
        return [self.chain]

    @cached_property
    def link_checks(self) -> Checks:
        """Checks of the resets, their derivatives and the sum of all durations."""
        return Checks(_link_checks(self))

    @property
    def plan_checks(self) -> Checks:
        """Checks of the states and inputs of all phases, and of the links."""
        rows = [replace(c, where=f"{name}: {c.where}") for name, phase in self._named for c in phase.plan_checks]
        return Checks([*rows, *self.link_checks])

    @property
    def replays(self) -> tuple[Replay, ...]:
        """The replays of all phases, concatenated."""
        return tuple(replay for phase in self.phases for replay in phase.replays)

    @property
    def checks(self) -> Checks:
        """All checks of the phases, the links and the chain, the worst first."""
        rows = [replace(c, where=f"{name}: {c.where}") for name, phase in self._named for c in phase.checks]
        return Checks([*rows, *self.link_checks, self.chain])

    @property
    def _named(self) -> list[tuple[str, Solution]]:
        return list(zip(self.problem.names, self.phases, strict=True))


def _stacked(arrays: Sequence[Array]) -> Array:
    """Stack the rows of all arrays, with NaN in the columns that an array does not have."""
    width = max(array.shape[1] for array in arrays)
    rows = [np.pad(a, ((0, 0), (0, width - a.shape[1])), constant_values=np.nan) for a in arrays]
    return frozen(np.vstack(rows))


def _chain_check(solution: PhasedSolution) -> Check:
    motions = [phase.transcribed for phase in solution.phases]
    if any(motion is None for motion in motions):
        return check("chain", "a phase has entries that are not finite", np.inf, INTEGRATION_TOLERANCE)
    rows = list[Check]()
    for feedback in (None, FEEDBACK):
        worst, where = _led_through(solution, [m for m in motions if m is not None], feedback or OPEN_LOOP)
        row = check("chain", where, worst, INTEGRATION_TOLERANCE)
        rows.append(replace(row, plant="continuous time", feedback=feedback))
        if rows[-1].passes:
            return rows[-1]
    return min(rows, key=lambda row: row.value)


def _led_through(solution: PhasedSolution, motions: Sequence[Collocated], control: str) -> tuple[float, str]:
    """Return the largest distance from the plan or beyond a bound, relative to the state's range, and its place.

    If all phases have the same states, the range is the largest over the phases.
    """
    problem, scales = solution.problem, [m.task.problem.state_scales(m.xs) for m in motions]
    if len({tuple(m.task.dynamics.state_names) for m in motions}) == 1:
        scales = [np.max(scales, axis=0)] * len(motions)
    gains = [None] * len(motions) if control == OPEN_LOOP else _gains(problem, motions)
    x, worst, where = np.asarray(motions[0].xs[0]), -1.0, ""
    for i, (name, motion) in enumerate(zip(problem.names, motions, strict=True)):
        b, ranges, names = motion.task.bounds, scales[i], motion.task.dynamics.state_names
        xs, wanted = motion.led_from(x, gains[i]), motion.xs
        switch = next((s for s in problem.switches if s.before == i), None)
        impact = None if switch is None else _impact_of(switch)
        if impact is not None:
            late = _until_it_touches(motion, xs, gains[i], impact)
            if late is None:
                return float("inf"), f"{', '.join(impact.contacts.rows)} do not touch at the end of {name}"
            xs, wanted = late, np.vstack([wanted[: (len(late) - 2) // SUBSTEPS + 1], wanted[-1:]])
        beyond = np.max(np.maximum(np.maximum(b.x_lower - xs, xs - b.x_upper), 0.0)[1:], axis=0)
        at_knots = xs[::SUBSTEPS] if impact is None else np.vstack([xs[:-1:SUBSTEPS][: len(wanted) - 1], xs[-1:]])
        apart = np.max(np.abs(at_knots - wanted), axis=0)
        deviations = [
            (f"at most {{:.2g}} from the plan in {name}", apart),
            (f"{{:.2g}} beyond its bound in {name}", beyond),
        ]
        if switch is not None:
            with np.errstate(all="ignore"):
                x = switch(xs[-1]) if impact is None else impact.by_drake(xs[-1])
            if switch.after == 0:
                deviations.append((f"{{:.2g}} from its first value after {name}", np.abs(x - motions[0].xs[0])))
                ranges = np.concatenate([ranges, scales[0]])
        for k, (sentence, values) in enumerate(deviations):
            scale = ranges[-len(values) :] if k == 2 else ranges[: len(values)]
            fractions = np.nan_to_num(values / scale, nan=np.inf)
            j = int(np.argmax(fractions))
            if fractions[j] > worst:
                label = names[j] if k < 2 else motions[0].task.dynamics.state_names[j]
                worst, where = float(fractions[j]), f"{label} is {sentence.format(values[j])}"
    return worst, where


def _until_it_touches(motion: Collocated, xs: Array, gains: Array | None, impact: Impact) -> Array | None:
    """Return (S, nx) the motion, ten steps per interval, until the gap closes that the plan closes at its end, or None.

    `xs` is the motion up to the plan's end. It continues for at most a tenth of its duration. A gap that the plan
    itself closes earlier, as with a foot that swings through, does not count.
    """
    per, count, T = SUBSTEPS, len(motion.mesh) - 1, motion.horizon
    parts = np.linspace(0, 1, per + 1)[:-1]
    times = T * np.append((motion.mesh[:-1, None] + parts * np.diff(motion.mesh)[:, None]).ravel(), 1.0)
    planned = np.array([impact.first_gap(x) for x in motion.at(times)[0]])
    early = np.flatnonzero(planned[: (count - 1) * per] <= 0)
    k = 1 + (int(early[-1]) + 1 if len(early) else 0)
    step = times[-1] - times[-2]

    def rate(x: Array, t: float) -> Array:
        moment = np.array([min(t, T)])
        plan, u = (a[0] for a in motion.at(moment))
        j = min(int(np.searchsorted(T * motion.mesh, moment[0], side="right")) - 1, count - 1)
        if gains is not None:
            b = motion.task.bounds
            u = np.clip(u + gains[j] @ (plan - x), b.u_lower, b.u_upper)
        limits = motion.task.dynamics.bounds
        knot = np.concatenate([x, np.clip(u, limits.u_lower, limits.u_upper)])[None]
        return np.asarray(motion.task.moved(knot, np.array([j]))[0])

    def ahead(x: Array, t: float, h: float) -> Array:
        k1 = rate(x, t)
        k2 = rate(x + h / 2 * k1, t + h / 2)
        k3 = rate(x + h / 2 * k2, t + h / 2)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + h * k3, t + h))

    states = list(xs[:k])
    while True:
        t = times[k - 1] if k <= len(times) else T + (k - len(times)) * step
        h = times[k] - t if k < len(times) else step
        if t > T * (1 + LATE):
            return None
        x = xs[k] if k < len(xs) else ahead(states[-1], t, h)
        if impact.first_gap(x) <= 0 < impact.first_gap(states[-1]):
            low, high = 0.0, h
            for _ in range(HALVES):
                middle = (low + high) / 2
                low, high = (middle, high) if impact.first_gap(ahead(states[-1], t, middle)) > 0 else (low, middle)
            return np.array([*states, ahead(states[-1], t, high)])
        states.append(x)
        k += 1


def _gains(problem: PhasedProblem, motions: Sequence[Collocated]) -> list[Array | None]:
    """Return TVLQR's gains of each phase, whose final cost-to-go is the next phase's, mapped through the reset."""
    gains: list[Array | None] = [None] * len(motions)
    at_end: Array | None = None
    for i in range(len(motions) - 1, -1, -1):
        gains[i], P = motions[i].gains(at_end)
        for switch in problem.switches:
            if switch.after == i and switch.before == i - 1:
                slope = _across(switch, motions[i - 1], motions[i])
                at_end = slope.T @ P @ slope
    return gains


def _impact_of(switch: Switch) -> Impact | None:
    """Return the impact of a switch that occurs when a gap closes, or None."""
    return switch.reset if isinstance(switch.reset, Impact) and switch.reset.has_gap else None


def _across(switch: Switch, before: Collocated, after: Collocated) -> Array:
    """Return (n, m) the derivative of the state after a switch, for a rigid impact the saltation matrix."""
    x = before.xs[-1]
    impact = _impact_of(switch)
    if impact is None:
        return switch.jacobian(x)
    last, first = (np.concatenate([m.xs[k], m.us[k]])[None] for m, k in ((before, -1), (after, 0)))
    rates = before.task.moved(last, np.array([len(before.mesh) - 2]))[0]
    return impact.saltation(x, rates, after.task.moved(first, np.array([0]))[0])


def certified_links(transcription: Transcription, motions: Sequence[Collocated]) -> tuple[Certificate, ...]:
    """Certify the derivatives of the links. Raises GradientError if a derivative does not exist."""
    certificates = []
    switches = transcription.problem.switches if transcription.links else ()
    for s, function in zip(switches, transcription.links, strict=True):
        point, count = np.concatenate([motions[s.before].xs[-1], motions[s.after].xs[0]]), len(s.columns)
        if not np.all(np.isfinite(point)):
            continue
        with np.errstate(all="ignore"):
            certificate = certify_jacobian(
                lambda x, s=s, count=count: s.link(x[:count], x[count:]),
                point,
                partial(_jacobian_of, function),
                rows=s.rows,
                columns=[*(f"last {name}" for name in s.columns), *(f"first {name}" for name in s.rows)],
                method="reset",
                subject=s.label,
            )
        certificates.append(certificate)
    return tuple(certificates)


def _jacobian_of(function: PointFunction, z: Array) -> Array:
    return np.asarray(function.linearize(z[None])[1][0])


def judged_phases(draft: PhasedSolution, result: NlpResult) -> Any:
    """Return the draft, whose phases are judged, with the status that the phases, the links and the chain allow."""
    statuses, complaints = [phase.status for phase in draft.phases], [str(c) for c in draft.link_checks.failing]
    details = [
        f"{name}: {sentence}"
        for name, phase in zip(draft.problem.names, draft.phases, strict=True)
        if phase.status is not Status.CONVERGED
        for sentence in (phase.message.removeprefix(f"{phase.status.words}: "), *phase.notes)
    ]
    failed = next((status for status in statuses if status not in PLANS), None)
    if failed is None and complaints and result.outcome not in FOUND:
        failed = status_of(result.outcome)
    if failed is not None:
        return ended(draft, failed, *([*complaints, *details] or [result.message]))
    if complaints or details:
        return ended(draft, Status.CONVERGED_NOT_VERIFIED, *complaints, *details)
    control = under(draft.chain.feedback)
    if draft.chain.passes:
        return ended(draft, Status.CONVERGED, f"holds {control} in continuous time", str(draft.chain))
    return ended(draft, Status.CONVERGED_NOT_VERIFIED, f"in continuous time {control}, {draft.chain}")


def _link_checks(draft: PhasedSolution) -> Iterator[Check]:
    """Check the resets, their derivatives and the sum of durations."""
    for s in draft.problem.switches:
        errors = draft.link_errors[s.label]
        after = draft.phases[s.after]
        limits = FEASIBILITY_TOLERANCE * after.problem.state_scales(np.asarray(after.xs))
        i = int(np.argmax(errors / limits))
        yield check("link", f"{s.label} at {s.rows[i]}", errors[i], limits[i])
        impact = _impact_of(s)
        if impact is not None:
            for rule in impact.broken_rules(draft.phases[s.before].xs[-1]):
                yield check("impact", f"{s.label}: {rule}", np.inf, 0.0)
    if draft.problem.horizon is not None:
        lower, upper = draft.problem.horizon
        beyond = max(lower - draft.horizon, draft.horizon - upper, 0.0)
        yield check("horizon", "all phases", beyond, FEASIBILITY_TOLERANCE * draft.problem.horizon[1], "s")
    for certificate in draft.certificates:
        row = derivative_check(certificate)
        yield replace(row, where=f"{certificate.subject}: {row.where}")
