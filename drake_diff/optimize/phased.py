"""Problems in phases: solved as one program, each phase judged as a solution, and their links and their chain as well.

A chain is the motion that the dynamics make from the first state of all, through the resets at the times of the plan,
open loop or under TVLQR whose cost to go is led back through the resets too. An `Impact` with a gap comes where that
closes, by Drake's mass matrix, and the cost to go is led back through its saltation matrix.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen, positive_float, positive_int
from drake_diff._base.clock import StoppedError, noted_interrupts, now, until_set
from drake_diff._base.values import PicklesItsFields, ShowsItsRepr
from drake_diff.certificates.certificate import Certificate, certify_jacobian
from drake_diff.exceptions import GradientError, InputError, SimulationError, UnknownNameError
from drake_diff.optimize.certified import certify_equations
from drake_diff.optimize.checks import Check, Checks, check
from drake_diff.optimize.guess import Guess, another_guess, first_guess, sampled
from drake_diff.optimize.measure import INTEGRATION_TOLERANCE, derivative_check
from drake_diff.optimize.messages import under
from drake_diff.optimize.problem.fixed_contacts import Impact
from drake_diff.optimize.problem.phases import PhasedProblem, Switch
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE, Iteration, Limits, NlpResult, Report, heard
from drake_diff.optimize.replay import FEEDBACK, OPEN_LOOP
from drake_diff.optimize.solution import Search, Solution, Status
from drake_diff.optimize.transcription.between import violation_between_nodes
from drake_diff.optimize.transcription.collocation import (
    FOUND,
    SUBSTEPS,
    Collocated,
    Transcribed,
    Transcription,
    finer_mesh,
)
from drake_diff.optimize.transcription.task import MAP, SCHEMES, default_scheme
from drake_diff.optimize.verification import ended, judged, may_be_too_coarse, status_of, unmeasured

OTHER_GUESSES = 8  # where no motion is found from the first
FINER_ROUNDS = 6  # of meshes whose plan does not hold
NOT_FOUND = (Status.INFEASIBLE, Status.ITERATION_LIMIT, Status.DIVERGED, Status.FAILED)
LATE = 0.1  # of a phase's time: so long after it an impact is waited for
HALVES = 50  # of a step in which a gap closes
PLANS = (Status.CONVERGED, Status.CONVERGED_NOT_VERIFIED)


@dataclass(frozen=True, eq=False, repr=False)
class PhasedSolution(PicklesItsFields, ShowsItsRepr):
    """The motion that `solve` found for a `PhasedProblem`, and what it measures.

    Each phase is a `Solution` with its own measures and status. `link_errors` and `chain` are computed from the states
    when they are first asked for, and never taken from the solver. `success` holds where the solver converged and all
    of that holds.

    Attributes:
        problem: What was asked.
        status, message: How it ended, as a `Status` and in words.
        phases: A `Solution` of each phase, from its own time 0 on.
        iterations: The solver's own table.
        link_certificates: Of the derivatives of the resets, at the states of the plan.
        options: What was asked of the solver, and what it chose.
        wall_time: [s] what the solve took.
        search: The arguments of `solve`.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        >>> effort = dd.QuadraticCost(R=[[1.0]])
        >>> way = dict(num_steps=5, horizon=0.5, running_cost=effort)
        >>> parts = [dd.Problem(block, x0=[0, 0], **way), dd.Problem(block, x0=[0.5, 0], x_goal=[1, 0], **way)]
        >>> solution = dd.solve(dd.optimize.PhasedProblem(parts))
        >>> solution.status.value, round(solution.cost, 6), solution.starts.tolist()
        ('converged', 12.0, [0.0, 0.5])
    """

    problem: PhasedProblem
    status: Status
    message: str
    phases: tuple[Solution, ...]
    iterations: tuple[Iteration, ...] = ()
    link_certificates: tuple[Certificate, ...] = ()
    options: dict[str, Any] = field(default_factory=dict)
    solver_message: str = ""
    wall_time: float = 0.0
    search: Search | None = None

    def __str__(self) -> str:
        return f"{self.problem.name} in {len(self.phases)} phases: {self.status.value}, cost {self.cost:.6g}"

    def __repr__(self) -> str:
        lines = [f"PhasedSolution of {self.problem.name}: {self.status.value}", self.message]
        lines.append(f"cost {self.cost:.6g}, link error {self.link_error:.2g}")
        for name, phase in zip(self.problem.names, self.phases, strict=True):
            lasts = f"{len(phase.us)} steps" if phase.problem.is_map else f"{phase.horizon:.4g} s"
            lines.append(f"{name}: {lasts}, cost {phase.cost:.6g}, defect {phase.defect:.2g}, {phase.status.value}")
        return "\n  ".join(lines)

    @property
    def success(self) -> bool:
        """Whether the solver converged and everything measured again holds."""
        return self.status is Status.CONVERGED

    @property
    def cost(self) -> float:
        """The sum of the phases' costs; inf where one is not finite."""
        return sum(phase.cost for phase in self.phases)

    @property
    def horizon(self) -> float:
        """[s] from the first state to the last, or steps."""
        return sum(phase.horizon for phase in self.phases)

    @property
    def starts(self) -> Array:
        """(P,) [s] when each phase begins, or steps."""
        return np.cumsum([0.0, *(phase.horizon for phase in self.phases[:-1])])

    @cached_property
    def link_errors(self) -> dict[str, Array]:
        """By the name of each reset: (n,) how far the first state after it is from where it leads; inf if unknown."""
        errors = {}
        for s in self.problem.switches:
            before, after = self.phases[s.before].xs[-1], self.phases[s.after].xs[0]
            with np.errstate(all="ignore"):
                errors[s.label] = np.nan_to_num(np.abs(s.link(before, after)), nan=np.inf)
        return errors

    @property
    def link_error(self) -> float:
        """The largest of all, in its state's unit."""
        return max((float(np.max(errors)) for errors in self.link_errors.values()), default=0.0)

    @cached_property
    def chain(self) -> Check:
        """Where the dynamics lead from the first state of all through all phases: open loop, and else under TVLQR.

        The value is the largest distance from the plan or beyond a bound, as a part of the state's range in its phase.
        """
        return _chain_check(self)

    @cached_property
    def link_checks(self) -> Checks:
        """What is checked of resets, their derivatives and the sum of all durations."""
        return Checks(_link_checks(self))

    @property
    def checks(self) -> Checks:
        """Everything that was checked, the worst first: of each phase, the links and the chain."""
        named = zip(self.problem.names, self.phases, strict=True)
        rows = [replace(c, where=f"{name}: {c.where}") for name, phase in named for c in phase.checks]
        return Checks([*rows, *self.link_checks, self.chain])


def _chain_check(solution: PhasedSolution) -> Check:
    motions = [phase.transcribed for phase in solution.phases]
    if any(motion is None for motion in motions):
        return check("chain", "a phase has entries that are no numbers", np.inf, INTEGRATION_TOLERANCE)
    rows = list[Check]()
    for feedback in (None, FEEDBACK):
        worst, where = _led_through(solution, [m for m in motions if m is not None], feedback or OPEN_LOOP)
        row = check("chain", where, worst, INTEGRATION_TOLERANCE)
        rows.append(replace(row, plant="continuous time", feedback=feedback))
        if rows[-1].passes:
            return rows[-1]
    return min(rows, key=lambda row: row.value)


def _led_through(solution: PhasedSolution, motions: Sequence[Collocated], control: str) -> tuple[float, str]:
    """The largest distance from the plan, or beyond a bound, as a part of the state's range, and where it is."""
    problem = solution.problem
    gains = [None] * len(motions) if control == OPEN_LOOP else _gains(problem, motions)
    x, worst, where = np.asarray(motions[0].xs[0]), -1.0, ""
    for i, (name, motion) in enumerate(zip(problem.names, motions, strict=True)):
        b, ranges, names = motion.task.bounds, motion.task.problem.ranges(motion.xs), motion.task.dynamics.state_names
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
                ranges = np.concatenate([ranges, motions[0].task.problem.ranges(motions[0].xs)])
        for k, (sentence, values) in enumerate(deviations):
            scale = ranges[-len(values) :] if k == 2 else ranges[: len(values)]
            fractions = np.nan_to_num(values / scale, nan=np.inf)
            j = int(np.argmax(fractions))
            if fractions[j] > worst:
                label = names[j] if k < 2 else motions[0].task.dynamics.state_names[j]
                worst, where = float(fractions[j]), f"{label} is {sentence.format(values[j])}"
    return worst, where


def _until_it_touches(motion: Collocated, xs: Array, gains: Array | None, impact: Impact) -> Array | None:
    """(S, nx) where a motion leads, ten steps an interval, until the gap closes that closes at the end of the plan.

    `xs` is where it leads to the end; from there it goes on for a tenth of its time. A gap that the plan itself closes
    earlier, such as of a foot that swings through, does not count. None where none closes.
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
    """TVLQR's gains of each phase, whose cost to go at its end is that of the next phase through the reset."""
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
    """The impact of a switch that comes where a gap closes."""
    return switch.reset if isinstance(switch.reset, Impact) and switch.reset.has_gap else None


def _across(switch: Switch, before: Collocated, after: Collocated) -> Array:
    """(n, m) the derivative of a first state by the last one before; of a rigid impact the saltation matrix."""
    x = before.xs[-1]
    impact = _impact_of(switch)
    if impact is None:
        return switch.jacobian(x)
    last, first = (np.concatenate([m.xs[k], m.us[k]])[None] for m, k in ((before, -1), (after, 0)))
    rates = before.task.moved(last, np.array([len(before.mesh) - 2]))[0]
    return impact.saltation(x, rates, after.task.moved(first, np.array([0]))[0])


def solve_phased(
    problem: PhasedProblem,
    arguments: dict[str, Any],
    given: Any,
    report: Report,
    on_start: Callable[[], None] | None,
) -> PhasedSolution:
    """See `solve`, whose other `arguments` are given by name."""
    limits, scheme = _checked(problem, arguments)
    guesses = _first_guesses(problem, given, arguments["seed"])
    run = _PhasedRun(problem, scheme, limits, arguments, report, given is None)
    with noted_interrupts() as interrupted:
        if on_start is not None:
            on_start()
    if interrupted.is_set():
        return replace(run.not_begun(guesses), search=Search(arguments, given))
    solutions, chain = [], []
    for number, begun in enumerate(_guesses(problem, guesses, given, arguments["seed"])):
        solutions.append(run.attempt(begun, other=number > 0))
        reason = "a straight line" if given is None else "given"
        chain.append({"guess": reason if number == 0 else f"random {number}", "ended": solutions[-1].status.value})
        report.say(f"from the guess {chain[-1]['guess']}: {solutions[-1].status.value}")
        if not _may_mend(solutions[-1], arguments["refine"]):
            break
    best = min(solutions, key=_preference)
    message = best.message
    if len(solutions) > 1 and best.status not in PLANS:
        message += f"; from none of {len(solutions)} first guesses was a plan found"
    return replace(best, message=message, options={**best.options, "chain": chain}, search=Search(arguments, given))


def _may_mend(solution: PhasedSolution, refine: bool | None) -> bool:
    """Whether another first guess may do better: nothing was found, or a plan that no mesh made hold."""
    if solution.status is not Status.CONVERGED_NOT_VERIFIED or refine is False:
        return solution.status in NOT_FOUND
    agree = all(c.verdict == "agree" for phase in solution.phases for c in phase.certificates)
    return agree and all(c.verdict == "agree" for c in solution.link_certificates)


def _preference(solution: PhasedSolution) -> tuple[int, float]:
    order = (*PLANS, Status.INTERRUPTED, Status.TIME_LIMIT)
    rank = order.index(solution.status) if solution.status in order else len(order)
    return rank, solution.link_error + sum(phase.defect + phase.goal_error for phase in solution.phases)


def _checked(problem: PhasedProblem, asked: dict[str, Any]) -> tuple[Limits, str]:
    """The limits and the scheme; refuses what phases cannot be asked."""
    if asked["method"] not in ("auto", "collocation"):
        expected = '"auto" or "collocation" for a PhasedProblem'
        raise InputError("method", got=repr(asked["method"]), expected=expected)
    if asked["solver"] not in (None, "ipopt"):
        raise InputError("solver", got=repr(asked["solver"]), expected='"ipopt" for a PhasedProblem')
    for name, none in (("continuation", None),):
        if asked[name] != none:
            raise InputError(name, got=repr(asked[name]), expected="none for a PhasedProblem")
    scheme = default_scheme(problem.phases[0]) if asked["scheme"] is None else asked["scheme"]
    if scheme not in SCHEMES:
        raise UnknownNameError("scheme", got=scheme, known=[name for name in SCHEMES if name != MAP])
    if scheme == "drake" or (scheme == MAP) != problem.is_map:
        expected = repr(MAP) if problem.is_map else '"hermite_simpson" or "trapezoid" for a PhasedProblem in time'
        raise InputError("scheme", got=repr(scheme), expected=expected)
    if problem.is_map and asked["refine"]:
        raise InputError("refine", got=True, expected="None or False: a DiscreteMap has no intervals to split")
    most = positive_int("max_iterations", asked["max_iterations"])
    seconds = np.inf if asked["time_limit"] is None else positive_float("time_limit [s]", asked["time_limit"])
    return Limits(most, seconds, positive_float("tolerance", asked["tolerance"])), scheme


def _first_guesses(problem: PhasedProblem, given: Any, seed: int) -> list[Guess]:
    """One for each phase: of `given`, a PhasedSolution or one of each, or straight lines."""
    parts: Sequence[Any] = [None] * len(problem.phases)
    if isinstance(given, PhasedSolution):
        parts = given.phases
    elif given is not None:
        parts = given if isinstance(given, (tuple, list)) else [given]
    if len(parts) != len(problem.phases):
        expected = f"None, a PhasedSolution, or {len(problem.phases)} guesses, one for each phase"
        raise InputError("initial_guess", got=f"{len(parts)} guesses", expected=expected)
    pairs = zip(_aimed(problem), parts, strict=True)
    return [first_guess(phase, "collocation", sampled(phase, "collocation", guess), seed) for phase, guess in pairs]


def _aimed(problem: PhasedProblem) -> list[Problem]:
    """The phases, for guesses alone: one that has no goal ends where the next one's first guess begins.

    That is its state before a linear reset; before another it is the same state, where there are as many.
    """
    phases = list(problem.phases)
    for switch in problem.switches:
        phase, other = phases[switch.before], problem.phases[switch.after]
        if switch.after == 0 or (switch.matrix is None and phase.nx != other.nx):
            continue
        end = other.x0 if switch.matrix is None else np.linalg.lstsq(switch.matrix, other.x0, rcond=None)[0]
        end = np.clip(end, phase.bounds.x_lower, phase.bounds.x_upper)
        phases[switch.before] = replace(phase, x_goal=np.where(np.isnan(phase.goal), end, phase.goal))
    return phases


def _guesses(problem: PhasedProblem, first: list[Guess], given: Any, seed: int) -> Iterator[list[Guess]]:
    """The first guesses, and where they are not given others, by `seed`."""
    yield first
    for number in range(1, OTHER_GUESSES + 1) if given is None else ():
        every = enumerate(_aimed(problem))
        others = [another_guess(phase, seed * len(problem.phases) + i, number) for i, phase in every]
        pairs = zip(problem.phases, others, strict=True)
        yield [first_guess(phase, "collocation", other, seed) for phase, other in pairs]


@dataclass(frozen=True, eq=False)
class _PhasedRun:
    """One solve: certify at the guess, search, refine for as long as the plan does not hold, measure, judge."""

    problem: PhasedProblem
    scheme: str
    limits: Limits
    asked: dict[str, Any]
    report: Report
    by_default: bool
    start: float = field(default_factory=now)
    begun: float = field(default_factory=time.monotonic)

    @cached_property
    def transcriptions(self) -> list[Transcription]:
        return [Transcription(phase, self.scheme) for phase in self.problem.phases]

    @cached_property
    def links(self) -> Any:
        from drake_diff.optimize.transcription.phased import link_functions  # loads CasADi

        return link_functions(self.problem)

    def attempt(self, guesses: list[Guess], *, other: bool) -> PhasedSolution:
        """From one guess of each phase."""
        most = min(self.limits.max_iterations, 200) if other else self.limits.max_iterations
        with noted_interrupts() as interrupted:  # one that comes before the search ends it at its start
            try:
                with until_set(interrupted):
                    meshes = [t.mesh for t in self.transcriptions]
            except StoppedError:
                return self.not_begun(guesses)
            horizons = [t.problem.start_horizon if g.horizon is None else g.horizon for t, g in self._with(guesses)]
            begun = []
            for t, guess in self._with(guesses):
                us_end = guess.us[-1:] if guess.u_final is None else guess.u_final[None]
                begun.append(t.nodes_at(t.mesh, guess.motion or (guess.xs, np.vstack([guess.us, us_end]))))
            result, motions, derivatives = self._solve_on(meshes, begun, horizons, most)
            result = heard(result, interrupted)
        solution = self._judged(result, motions, derivatives)
        rounds = [[len(motion.mesh) - 1 for motion in motions]]
        while len(rounds) <= FINER_ROUNDS and self.asked["refine"] is not False:
            finer = self._finer(solution, motions)
            if finer is None:
                break
            rounds.append([len(mesh) - 1 for mesh in finer])
            self.report.say(f"what is found does not hold: refined to {rounds[-1]} intervals")
            nodes = [t.nodes_at(mesh, m) for t, mesh, m in zip(self.transcriptions, finer, motions, strict=True)]
            again = self._solve_on(finer, nodes, [motion.horizon for motion in motions], most)
            if again[0].outcome not in FOUND:
                counts = (
                    f"on {rounds[-1]} intervals no motion was found ({again[0].message}): that on {rounds[-2]} is kept"
                )
                solution = replace(solution, message=f"{solution.message}; {counts}")
                del rounds[-1]
                break
            result, motions, derivatives = again
            solution = self._judged(result, motions, derivatives)
        return replace(solution, options={**solution.options, "refinements": rounds}) if len(rounds) > 1 else solution

    def not_begun(self, guesses: list[Guess]) -> PhasedSolution:
        """The guesses, where a signal comes before the search."""
        phases = []
        for problem, guess in zip(self.problem.phases, guesses, strict=True):
            last = guess.us[-1] if guess.u_final is None else np.ravel(guess.u_final)
            at_end: dict[str, Any] = {} if problem.is_map else {"u_final": frozen(last)}
            by = problem, "collocation", "ipopt", Status.FAILED, ""
            draft = Solution(*by, frozen(guess.xs), frozen(guess.us), scheme=self.scheme, **at_end)
            phases.append(ended(draft, Status.INTERRUPTED, "the search had not begun"))
        solution = PhasedSolution(self.problem, Status.INTERRUPTED, phases[0].message, tuple(phases))
        self.report.found(solution)
        return solution

    def _with(self, guesses: list[Guess]) -> Iterator[tuple[Transcription, Guess]]:
        return zip(self.transcriptions, guesses, strict=True)

    def _solve_on(
        self, meshes: list[Array], nodes: list[Array], horizons: list[float], most: int
    ) -> tuple[NlpResult, list[Transcribed], str]:
        from drake_diff.optimize.transcription.phased import PhasedProgram
        from drake_diff.optimize.transcription.program import NOT_FINITE, TranscribedProgram, solve_ipopt

        parts = zip(self.transcriptions, meshes, strict=True)
        programs = [TranscribedProgram(t.task, mesh, t.functions) for t, mesh in parts]
        program = PhasedProgram(self.problem, programs, self.links)
        inside = [float(np.clip(T, *t.task.horizon)) for T, t in zip(horizons, self.transcriptions, strict=True)]
        guess = np.concatenate([p.pack(z, T) for p, z, T in zip(programs, nodes, inside, strict=True)])
        left = max(0.0, self.limits.time_limit - (now() - self.start))
        limits, why = replace(self.limits, time_limit=left, max_iterations=most), program.functions.why_not
        derivatives = f"first derivatives, limited-memory Hessian: {why}" if why else "symbolic, exact Hessian"
        result = solve_ipopt(program, guess, limits, self.report, exact=not why, motions=program.iterates)
        if not why and result.message == NOT_FINITE:
            again = solve_ipopt(program, guess, limits, self.report, exact=False, motions=program.iterates)
            if again.message != NOT_FINITE:  # then it was the Hessian
                derivatives, result = (
                    "symbolic, limited-memory Hessian: the exact one is not finite at an iterate",
                    again,
                )
        motions = []
        for p, mesh, z in zip(programs, meshes, program.split(result.z), strict=True):
            node_values, horizon = p.unpack(z)
            motions.append(Transcribed(p.task, frozen(mesh), frozen(node_values), horizon, result, derivatives))
        return result, motions, derivatives

    def _finer(self, solution: PhasedSolution, motions: list[Transcribed]) -> list[Array] | None:
        """The meshes to try next; None where the plan holds, or where finer ones cannot mend it."""
        until, most = self.asked["error_tolerance"], self.asked["max_num_steps"]
        if self.problem.is_map or solution.status not in PLANS:
            return None
        coarse = [motion.largest_error > until for motion in motions]
        if not self.asked["refine"]:
            of_phases = [may_be_too_coarse(phase) for phase in solution.phases]
            drifts = solution.status is not Status.CONVERGED and not any(of_phases) and not solution.chain.passes
            exceeded = [bool(violation_between_nodes(motion).intervals) for motion in motions]
            every = zip(of_phases, coarse, exceeded, strict=True)
            coarse = [(wanted or drifts) and (far or beyond) for wanted, far, beyond in every]
        if not any(coarse):
            return None
        meshes = []
        for motion, wanted in zip(motions, coarse, strict=True):
            mesh = finer_mesh(motion, violation_between_nodes(motion).intervals, most) if wanted else motion.mesh
            if mesh is None:
                return None
            meshes.append(mesh)
        return meshes

    def _judged(self, result: NlpResult, motions: list[Transcribed], derivatives: str) -> PhasedSolution:
        error: Exception | None = None
        options = {"derivatives": derivatives, "initial_guess": "default" if self.by_default else "given"}
        drafts = [self._draft(t, m, options) for t, m in zip(self.transcriptions, motions, strict=True)]
        self._offer(drafts, result, options)
        for i, (t, plan) in enumerate(zip(self.transcriptions, list(drafts), strict=True)):
            if np.all(np.isfinite(plan.xs)):
                try:
                    certificates = certify_equations(t.problem, t.jacobian, plan.xs, plan.us, t.task)
                    drafts[i] = replace(plan, certificates=certificates)
                except (GradientError, SimulationError) as refusal:
                    error = refusal
        phases, links = tuple(judged(draft, result) for draft in drafts), tuple[Certificate, ...]()
        try:
            links = self._certified_links(motions)
        except (GradientError, SimulationError) as refusal:
            error = refusal
        draft = PhasedSolution(
            self.problem,
            Status.FAILED,
            "",
            phases,
            iterations=result.iterations,
            link_certificates=links,
            options=options | {"seed": self.asked["seed"]},
            solver_message=result.message,
            wall_time=time.monotonic() - self.begun,
        )
        solution = judged_phases(draft, result)
        if error is not None and solution.status in PLANS:
            return _ended(solution, Status.NO_GRADIENT, [str(error)])
        return solution

    def _draft(self, t: Transcription, motion: Transcribed, options: dict[str, Any]) -> Solution:
        fields = {name: value for name, value in _arrays(motion).items() if value is not None}
        fields |= {"scheme": self.scheme, "options": dict(options)}
        by = t.problem, "collocation", "ipopt", Status.FAILED, ""
        return Solution(*by, frozen(motion.xs), frozen(motion.us[:-1]), **fields)

    def _offer(self, drafts: Sequence[Solution], result: NlpResult, options: dict[str, Any]) -> None:
        """Hand on what a search came to; what it claims is not looked at yet."""
        phases = tuple(unmeasured(draft, result) for draft in drafts)
        summary = phases[0].status, phases[0].message, phases
        self.report.found(PhasedSolution(self.problem, *summary, iterations=result.iterations, options=options))

    def _certified_links(self, motions: list[Transcribed]) -> tuple[Certificate, ...]:
        """GradientError where a derivative is refused."""
        certificates = []
        for s, function in zip(self.problem.switches, self.links, strict=True):
            point, count = np.concatenate([motions[s.before].xs[-1], motions[s.after].xs[0]]), len(s.columns)
            if not np.all(np.isfinite(point)):
                continue
            with np.errstate(all="ignore"):
                certificate = certify_jacobian(
                    lambda x, s=s, count=count: s.link(x[:count], x[count:]),
                    point,
                    function.jacobian_of,
                    rows=s.rows,
                    columns=[*(f"last {name}" for name in s.columns), *(f"first {name}" for name in s.rows)],
                    method="reset",
                    subject=s.label,
                )
            certificates.append(certificate)
        return tuple(certificates)


def _arrays(motion: Transcribed) -> dict[str, Any]:
    """Those of a Solution that are beside its states and inputs."""
    problem = motion.task.problem
    refined = len(motion.mesh) - 1 > problem.num_steps
    return {
        "u_final": None if problem.is_map else frozen(motion.us[-1]),
        "us_mid": motion.us_mid,
        "mesh": motion.mesh if refined else None,
        "free_horizon": motion.horizon if problem.horizon else None,
    }


def judged_phases(draft: PhasedSolution, result: NlpResult) -> PhasedSolution:
    """The draft, whose phases are judged, with the status that they, the links and the chain allow."""
    statuses, complaints = [phase.status for phase in draft.phases], [str(c) for c in draft.link_checks.failing]
    details = [
        f"{name}: {phase.message.removeprefix(phase.status.sentence).removeprefix(': ')}"
        for name, phase in zip(draft.problem.names, draft.phases, strict=True)
        if phase.status is not Status.CONVERGED
    ]
    failed = next((status for status in statuses if status not in PLANS), None)
    if failed is None and complaints and result.outcome not in FOUND:
        failed = status_of(result.outcome)
    if failed is not None:
        return _ended(draft, failed, [*complaints, *details] or [result.message])
    if complaints or details:
        return _ended(draft, Status.CONVERGED_NOT_VERIFIED, [*complaints, *details])
    status = Status.CONVERGED if draft.chain.passes else Status.CONVERGED_NOT_VERIFIED
    return _ended(draft, status, [f"integrated {under(draft.chain.feedback or OPEN_LOOP)} {draft.chain}"])


def _link_checks(draft: PhasedSolution) -> Iterator[Check]:
    """Resets that the plan keeps, derivatives that agree, and a sum of durations."""
    for s in draft.problem.switches:
        errors = draft.link_errors[s.label]
        i = int(np.argmax(errors))
        yield check("link", f"{s.label} at {s.rows[i]}", errors[i], FEASIBILITY_TOLERANCE)
        impact = _impact_of(s)
        if impact is not None:
            for rule in impact.broken_rules(draft.phases[s.before].xs[-1]):
                yield check("impact", f"{s.label}: {rule}", np.inf, 0.0)
    if draft.problem.horizon is not None:
        lower, upper = draft.problem.horizon
        beyond = max(lower - draft.horizon, draft.horizon - upper, 0.0)
        yield check("horizon", "all phases", beyond, FEASIBILITY_TOLERANCE, "s")
    for certificate in draft.link_certificates:
        row = derivative_check(certificate)
        yield replace(row, where=f"{certificate.subject}: {row.where}")


def _ended(draft: PhasedSolution, status: Status, details: Sequence[str]) -> PhasedSolution:
    sentences = "; ".join(detail for detail in details if detail)
    return replace(draft, status=status, message=f"{status.sentence}: {sentences}" if sentences else status.sentence)
