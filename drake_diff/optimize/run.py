"""One solve by one method: certify at the guess, search, certify at the result, measure, judge."""

import dataclasses
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.clock import StoppedError, TimeIsUpError, noted_interrupts, now, until, until_set
from drake_diff.certificates.certificate import Certificate
from drake_diff.certificates.certify import certify_steps
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.model.parameters import TIME_STEP
from drake_diff.motion.intervals import roll
from drake_diff.motion.rollout import STEPS
from drake_diff.optimize.continuation import Stages, solve_continuation
from drake_diff.optimize.guess import Guess
from drake_diff.optimize.ilqr.ilqr import solve_ilqr, takes
from drake_diff.optimize.ilqr.through_contact import moves_shapes, solve_through_jumps
from drake_diff.optimize.knots import costs_of
from drake_diff.optimize.measure import certify_equations, first_knots, telling_knots
from drake_diff.optimize.optimality import HOLDS, doubt_of_the_slope, out_of_reach, why_blind
from drake_diff.optimize.options import Options
from drake_diff.optimize.phased import PhasedSolution, certified_links, judged_phases
from drake_diff.optimize.problem.cost import QuadraticCost, TrackingCost
from drake_diff.optimize.problem.design import ShootingVariables
from drake_diff.optimize.problem.goals import in_words
from drake_diff.optimize.problem.obstacles import SelfCollision, lacking_between, swept
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Limits, NlpResult, Outcome, Report, heard
from drake_diff.optimize.solution import PLANS, Solution, Status
from drake_diff.optimize.transcription.between import violation_between_nodes
from drake_diff.optimize.transcription.collocation import (
    FOUND,
    Collocated,
    Initial,
    Transcribed,
    Transcription,
    kept,
)
from drake_diff.optimize.transcription.drake import solve_collocation
from drake_diff.optimize.transcription.steps import solve_shooting
from drake_diff.optimize.verification import ended, judged, may_be_too_coarse, refused, status_of, unmeasured

NEAR = "a motion near the collocated optimum, but not an optimum in these steps"
GRACE = 0.05  # of the time limit, beyond it: for measures of what a search found that the limit ended
# What a solve is made of, in this order; a time limit names what it cut.
STAGES = ("certificates of the guess", "the search", "certificates of the result", "replays and other measures")

Searcher = Callable[[Problem, Array, Array, Array], tuple[NlpResult, Array, Array]]


@dataclass(eq=False)
class SoFar:
    """What a run has when the clock ends it, and the stage that it is in; see STAGES."""

    stage: int
    draft: Solution
    result: NlpResult | None = None
    judged: Solution | None = None  # where a finer mesh is tried


@dataclass(frozen=True, eq=False)
class Run:
    """One solve by one method: certify at the guess, search, certify at the result, measure, judge."""

    problem: Any  # a Problem, or for collocation a PhasedProblem
    method: str
    scheme: str
    solver: str
    limits: Limits
    asked: Options
    options: dict[str, Any]  # what the record says of the solver
    report: Report | None
    searched: Problem | None = None  # what is solved where that is more than what is asked
    closest: bool = False  # whether any motion near the guess will do, an optimum or not
    start: float = field(default_factory=now)
    started: float = field(default_factory=time.monotonic)
    certified: dict[bytes, Certificate] = field(default_factory=dict)  # by state, input and parameters
    reached: list[SoFar] = field(default_factory=list)  # the last is where it is

    def within_time(self, search: Callable[[], Any], guess: Any, begin: Callable[[], None]) -> Any:
        """What `search`, one of the three below, gives; where the time limit comes first, what there is by then.

        `begin` is called before it; a signal that comes meanwhile leaves the guess, as one that comes later does.
        """
        self.reached.append(SoFar(0, self._of_guess(guess)))
        with noted_interrupts() as interrupted:
            begin()
        if interrupted.is_set():
            return self._cut(self.reached[-1], interrupted=True)
        try:
            with until(self.start + (1 + GRACE) * self.limits.time_limit):
                return search()
        except TimeIsUpError as error:
            return self._cut(self.reached[-1], interrupted=isinstance(error, StoppedError))

    def _of_guess(self, guesses: Sequence[Guess]) -> Solution:
        """The draft of a solve that found nothing: its guess, by collocation with an input at the last knot."""
        drafts = []
        for problem, guess in zip(self.problem.phases, guesses, strict=True):
            last = guess.us[-1] if guess.u_final is None else np.ravel(guess.u_final)
            has_last = self.scheme != "step" and not problem.is_map
            drafts.append(self._draft(guess.xs, guess.us, problem, u_final=last if has_last else None))
        return self._joined(drafts)

    def _joined(self, drafts: Sequence[Solution], **fields: Any) -> Solution:
        """The draft of all phases."""
        if not isinstance(self.problem, PhasedProblem):
            return drafts[0]
        fields |= {"options": self.options, "wall_time": time.monotonic() - self.started}
        return PhasedSolution.joined(self.problem, drafts, **fields)

    def _cut(self, reached: SoFar, *, interrupted: bool) -> Solution:
        if reached.judged is not None:
            why = Status.INTERRUPTED.sentence if interrupted else "the time limit came first"
            return reached.judged.noted(f"no finer mesh: {why}")
        result, cut = reached.result, f"not made within the time limit: {', '.join(STAGES[reached.stage :])}"
        if interrupted:  # which is looked for before a search alone
            plan = ended(reached.draft, Status.INTERRUPTED, cut.replace("within the time limit", "before that"))
            if self.report is not None:
                self.report.found(plan)
            return plan
        if result is None:
            return ended(reached.draft, Status.TIME_LIMIT, cut)
        status, table = status_of(result.outcome) or Status.TIME_LIMIT, result.iterations
        fields = {"iterations": table, "solver_message": result.message}
        return ended(reached.draft, status, result.message, cut, **fields)

    def _left(self) -> Limits:
        """The limits of a search that begins now."""
        left = self.limits.time_limit - (now() - self.start)
        return dataclasses.replace(self.limits, time_limit=max(left, 0.0))

    def collocate(self, guesses: Sequence[Guess]) -> Solution:
        """In CasADi; SNOPT, which that does not carry, in Drake's own DirectCollocation.

        The mesh is refined where `refine` is True; where it is None, for as long as the plan does not hold.
        """
        refine = self.asked.refine
        if self.solver == "snopt":
            return self._collocate_in_drake(guesses)
        with noted_interrupts() as interrupted:  # one that comes before the search ends it at its start
            try:
                with until_set(interrupted):
                    transcription = Transcription(self.searched or self.problem, self.scheme)
                    before = self._certify_guess(transcription, guesses)
            except (GradientError, SimulationError) as error:
                return refused(self._of_guess(guesses), error)
            self._reach(1)
            starts = [self._begin(transcription, i, guess) for i, guess in enumerate(guesses)]
            refinement = self.asked if refine else None
            motion = transcription.solve(starts, limits=self._left(), report=self.report, refinement=refinement)
            motion = dataclasses.replace(motion, result=heard(motion.result, interrupted))
        if refine:
            self.options["refinements"] = [list(row) for row in motion.refinements]
        if motion.cleared:
            self.options["clearance_rounds"] = [list(row) for row in motion.cleared]
        solution = self._judge_collocated(transcription, motion, before)
        return solution if refine is not None else self._refined(transcription, motion, solution, before)

    def _certify_guess(self, transcription: Transcription, guesses: Sequence[Guess]) -> tuple[Certificate, ...]:
        """Of a problem in phases the result alone is certified."""
        if isinstance(self.problem, PhasedProblem):
            return ()
        guess, task = guesses[0], transcription.tasks[0]
        costs_of(self.problem, guess.xs, guess.us).expand(guess.xs, guess.us)
        point = transcription.jacobian, guess.xs, guess.us, task
        return certify_equations(self.problem, *point, knots=first_knots(guess.us))

    def _begin(self, transcription: Transcription, phase: int, guess: Guess) -> Initial:
        """Where a phase begins: a motion by the same scheme and in as many steps on its mesh, with its multipliers."""
        fields: dict[str, Any] = {"horizon": guess.horizon, "parameters": guess.parameters, "far": guess.line}
        task, motion = transcription.tasks[phase], guess.motion
        if motion is None:
            us_end = guess.us[-1:] if guess.u_final is None else guess.u_final
            return transcription.begin(phase, (guess.xs, np.vstack([guess.us, us_end])), **fields)
        steps = task.problem.num_steps
        is_equal = len(motion.mesh) == steps + 1 or self.asked.refine is not False
        if motion.task.scheme is task.scheme and motion.task.problem.num_steps == steps and is_equal:
            fields |= {"mesh": np.asarray(motion.mesh), "multipliers": guess.multipliers}
        return transcription.begin(phase, motion, **fields)

    def _refined(
        self, transcription: Transcription, motion: Transcribed, solution: Solution, before: tuple[Certificate, ...]
    ) -> Solution:
        """`solution`, or that on a mesh which is made finer for as long as the plan does not hold."""
        rounds, first = list(motion.refinements), motion.count
        for _ in range(self.asked.mesh_rounds):
            finer = self._finer(transcription, motion, solution)
            if finer is None:
                break
            if finer.result.outcome not in FOUND:
                last = kept(motion, finer).result
                if last.outcome not in FOUND:
                    return self._judge(solution, last)
                return solution.noted(last.note)
            motion = finer
            rounds.append(finer.row)
            self.options["refinements"] = [list(row) for row in rounds]
            solution = self._judge_collocated(transcription, motion, before)
        if motion.count == first:
            return solution
        return solution.noted(f"the mesh was refined from {first} to {motion.count} intervals")

    def _finer(self, transcription: Transcription, motion: Transcribed, solution: Solution) -> Transcribed | None:
        """The motion on finer meshes; None where the plan holds, or where what does not hold is not a mesh's."""
        if solution.status not in PLANS:
            return None
        coarse = [may_be_too_coarse(phase) for phase in solution.phases]
        if isinstance(solution, PhasedSolution) and not solution.success and not any(coarse):
            coarse = [not solution.chain.passes] * len(coarse)
        exceeded: list[Sequence[int] | None] = []
        for phase, is_coarse in zip(motion.phases, coarse, strict=True):
            beyond = violation_between_nodes(phase).intervals if is_coarse else ()
            errs = is_coarse and phase.largest_error > self.asked.error_tolerance
            exceeded.append(beyond if errs or beyond else None)
        if all(beyond is None for beyond in exceeded):
            return None
        self.reached.append(SoFar(1, solution, judged=solution))
        return transcription.finer(motion, exceeded, self.asked.max_num_steps, self._left(), self.report)

    def _collocate_in_drake(self, guesses: Sequence[Guess]) -> Solution:
        """By Drake's own DirectCollocation."""
        guess = guesses[0]
        jacobian = EquationsOfMotion(self.problem.model).jacobian
        with noted_interrupts() as interrupted:
            try:
                with until_set(interrupted):
                    first = first_knots(guess.us)
                    certificates = certify_equations(self.problem, jacobian, guess.xs, guess.us, knots=first)
            except (GradientError, SimulationError) as error:
                return refused(self._of_guess(guesses), error)
            self._reach(1)
            result, xs, us, u_final = solve_collocation(
                self.problem, guess.xs, guess.us, limits=self._left(), report=self.report
            )
        self._offer(self._draft(xs, us, u_final=u_final), result)
        self._reach(2, self._draft(xs, us, u_final=u_final, certificates=certificates), result)
        if np.all(np.isfinite(xs)):
            certificates += certify_equations(self.problem, jacobian, xs, us)
        return self._judge(self._draft(xs, us, u_final=u_final, certificates=certificates), result)

    def _judge_collocated(
        self, transcription: Transcription, motion: Transcribed, before: tuple[Certificate, ...]
    ) -> Solution:
        result, problems = motion.result, self.problem.phases
        self.options["derivatives"] = motion.derivatives
        drafts = []
        for phase, problem in zip(motion.phases, problems, strict=True):
            multipliers = result.multipliers if len(problems) == 1 else None
            fields = arrays_of(phase) | {"multipliers": multipliers, "certificates": before}
            drafts.append(self._draft(phase.xs, phase.us[:-1], problem, **fields))
        self._offer(self._joined(drafts), result)
        self._reach(2, self._joined(drafts), result)
        links, error = tuple[Certificate, ...](), None
        try:
            for i, (task, plan) in enumerate(zip(transcription.tasks, drafts, strict=True)):
                if np.all(np.isfinite(plan.xs)):
                    jacobian = partial(transcription.jacobian, phase=i)
                    task = motion.phases[i].task if task.varied else task
                    equations = certify_equations(plan.problem, jacobian, plan.xs, plan.us, task)
                    drafts[i] = dataclasses.replace(plan, certificates=before + equations)
            links = certified_links(transcription, motion.phases)
        except (GradientError, SimulationError) as refusal:
            error = refusal
        for plan, phase in zip(drafts, motion.phases, strict=True):
            if self.searched is None and plan.transcribed is not None:  # else it was measured under another cost
                plan.transcribed.measured_as(phase)
        solution = self._judge(self._joined(drafts, certificates=links), result)
        if error is not None and solution.status in PLANS:
            return ended(solution, Status.NO_GRADIENT, str(error))
        return solution

    def sweep(self, guesses: Sequence[Guess], *, given: bool, stages: Stages) -> Solution:
        """iLQR; from the states of a `given` guess, which need not be a rollout, else from the rollout of `us`.

        With `stages` it need not have a gradient.
        """
        guess = guesses[0]
        xs, us = guess.xs, guess.us
        report, first = self.report, iter([xs] if given else [])

        def search(problem: Problem, rolled: Array, us: Array, values: Array) -> tuple[NlpResult, Array, Array]:
            limits = self._left()
            if stages:
                result, xs_found, us, logs = solve_continuation(problem, xs, us, stages, limits=limits, report=report)
                self.options["continuation"] = [asdict(log) for log in logs]
                return result, xs_found, us
            touches = problem.model.contract.contact.collision_pairs and not moves_shapes(problem)
            touches = touches and problem.motion == STEPS  # in continuous time a touch is no jump
            begin = next(first, rolled)
            if touches:
                return solve_through_jumps(problem, begin, us, limits=limits, report=report, values=values)
            known = guess.multipliers
            return solve_ilqr(problem, begin, us, limits=limits, report=report, values=values, multipliers=known)

        around = given and not stages  # a robot that falls open loop says nothing of the motion that was given
        return self._through_steps(xs, us, search, guess, may_be_blind=bool(stages), around=around)

    def shoot(self, guesses: Sequence[Guess], *, given: bool) -> Solution:
        """The sparse program through the steps, from the states of the guess.

        Where no guess is `given`, a few steps of iLQR come first, from the rollout of the inputs and without couplings,
        which iLQR does not take. If they converge, the program starts from their motion, else from the default guess.
        Where the problem has inputs, or the motion is in continuous time, the program starts from what iLQR reached in
        any case. A design that is optimized with the inputs goes without iLQR, which far from its goal leads a jumping
        leg to a short one, of half the height.
        """
        problem, guess = self.problem, guesses[0]
        co_design = problem.optimizes_controls and problem.optimizes_parameters
        multipliers = guess.multipliers if given else None
        rolled = not given and (not problem.optimizes_controls or bool(np.any(problem.us)) or problem.motion != STEPS)

        def search(problem: Problem, xs: Array, us: Array, values: Array) -> tuple[NlpResult, Array, Array]:
            swept = None if given or co_design else self._few_sweeps(problem, xs[0], us, values)
            if swept is not None and swept[0].outcome in (Outcome.INTERRUPTED, Outcome.TIME_LIMIT):
                return swept
            if swept is not None and (rolled or swept[0].outcome is Outcome.SOLVED):
                result, xs, us = swept
                self.options["initial_guess"] = f"default, then {result.message}"
                values = values if result.parameters is None else result.parameters
            options: dict[str, Any] = {"values": values, "multipliers": multipliers}
            return solve_shooting(problem, xs, us, limits=self._left(), report=self.report, **options)

        return self._through_steps(guess.xs, guess.us, search, guess, around=not rolled)

    def _few_sweeps(
        self, problem: Problem, x0: Array, us: Array, values: Array
    ) -> tuple[NlpResult, Array, Array] | None:
        """A few iterations of iLQR from the rollout of `us` (N, nu); None if iLQR does not apply or cannot step."""
        problem = dataclasses.replace(problem, couplings=())
        if not takes(problem):
            return None
        few = dataclasses.replace(self._left(), max_iterations=min(self.asked.sweeps, self.limits.max_iterations))
        try:
            with problem.intervals(problem.design.vector.at(values)) as intervals:
                rolled = roll(intervals, x0, us)
            return solve_ilqr(problem, rolled, us, limits=few, report=self.report, values=values)
        except (GradientError, SimulationError):
            return None

    def _through_steps(
        self,
        xs: Array,
        us: Array,
        search: Searcher,
        guess: Guess,
        *,
        may_be_blind: bool = False,
        around: bool = False,
    ) -> Solution:
        """See `_searched`; a signal that comes before the search ends that at its start, with what it begins with."""
        options = {"may_be_blind": may_be_blind, "around": around}
        with ExitStack() as until_found:
            interrupted = until_found.enter_context(noted_interrupts())
            return self._searched(xs, us, search, guess, interrupted, until_found.close, **options)

    def _searched(
        self,
        xs: Array,
        us: Array,
        search: Searcher,
        guess: Guess,
        interrupted: threading.Event,
        after_search: Callable[[], None],
        *,
        may_be_blind: bool,
        around: bool,
    ) -> Solution:
        """Certify, search, call `after_search`, certify again, on Drake's own steps: at the states that a search gives.

        Of the guess at its rollout, or `around` its states as they are.
        """
        values, first_states = self._first_values(guess), xs
        try:
            with until_set(interrupted):
                ends = self._with_its_end(xs, us, values) if around else None
        except SimulationError:  # what no input can hold says nothing of the goal
            ends = xs
        variables = ShootingVariables(self.problem, around=ends)
        try:
            with until_set(interrupted):
                xs, us, before, blindness = self._look_at(variables, variables.pack(xs[0], us, values), solved=False)
        except (GradientError, SimulationError) as error:
            return refused(self._draft(xs, us), error)
        xs = first_states if around else xs
        if blindness and not may_be_blind:
            return ended(self._draft(xs, us, certificates=before), Status.NO_GRADIENT, blindness)
        self._reach(1, self._draft(xs, us, certificates=before))
        try:
            result, xs, us = self._keeping_clear(search, xs, us, values)
            self._reach(2, self._draft(xs, us, certificates=before, multipliers=result.multipliers), result)
            variables = ShootingVariables(self.problem, around=xs if self.method == "shooting" else None)
            z = variables.pack(xs[0], us, result.parameters)
            result = heard(result, interrupted)
            if self.report is not None and self.report.plan is not None:  # else it need not be rolled out
                drawn = variables.states(z), variables.unpack(z)[1]
                self._offer(self._draft(*drawn, **self._design_of(variables, z)), result)
            after_search()
            xs, us, after, blindness = self._look_at(variables, z, solved=True)
        except (GradientError, SimulationError) as error:
            return refused(self._draft(xs, us, certificates=before), error)
        if result.note:
            self.options["contact_sequence"] = result.note
        fields = {"certificates": before + after, **self._design_of(variables, z)}
        solution = self._judge(self._draft(xs, us, multipliers=result.multipliers, **fields), result)
        return ended(solution, Status.NO_GRADIENT, blindness) if blindness and solution.success else solution

    def _with_its_end(self, xs: Array, us: Array, values: Array) -> Array:
        """(N+1, nx) the states of a guess with the last one where its inputs lead: its own may be the goal itself."""
        with self.problem.intervals(self.problem.design.vector.at(values)) as intervals:
            return np.vstack([xs[:-1], roll(intervals, xs[0], us)[-1:]])

    def _design_of(self, variables: ShootingVariables, z: Array) -> dict[str, Any]:
        """The parameters and the horizon in z."""
        design, values, horizon = self.problem.design, variables.parameters(z).values, None
        if self.problem.horizon is not None:
            horizon = float(np.clip(design.time_step(values) * self.problem.num_steps, *self.problem.horizon))
        return {"parameters": frozen(design.own(values)), "free_horizon": horizon}

    def _offer(self, draft: Solution, result: NlpResult) -> None:
        """Hand on what a search came to; what it claims is not looked at yet."""
        if self.report is not None:
            self.report.found(unmeasured(draft, result))

    def _first_values(self, guess: Guess) -> Array:
        """(np,) those of the problem's `design` where a search begins."""
        problem, design = self.problem, self.problem.design
        parameters = problem.parameters.values if guess.parameters is None else guess.parameters
        first = problem.start_horizon if guess.horizon is None else guess.horizon
        h = (first if problem.horizon is None else float(np.clip(first, *problem.horizon))) / problem.num_steps
        return np.clip(design.whole(parameters, h), design.lower, design.upper)

    def _keeping_clear(self, search: Searcher, xs: Array, us: Array, values: Array) -> tuple[NlpResult, Array, Array]:
        """What `search` finds; where it comes too near to an obstacle between two states, again with these in view."""
        problem, rounds, guess = self.searched or self.problem, list[list[float]](), (xs, us)
        result, xs, us = search(problem, xs, us, values)
        for parts in self.asked.clearance_parts:
            lacking, enters = lacking_between(problem.kept, xs)
            if not lacking or result.outcome not in (Outcome.SOLVED, Outcome.INACCURATE, Outcome.ITERATION_LIMIT):
                break
            if self.report is not None:
                self.report.say(f"{in_words(lacking, 'm')} too near to an obstacle within a step: {parts} parts")
            last = self._values_of(result, values)
            more = swept(self.problem.kept, problem.design.time_step(last), parts)
            wider = dataclasses.replace(problem, constraints=(*problem.constraints, *more))
            result, xs, us = search(wider, *((*guess, values) if enters else (xs, us, last)))
            rounds.append([parts, lacking])
        if rounds:
            self.options["clearance_rounds"] = rounds
        return result, xs, us

    def _values_of(self, result: NlpResult, first: Array) -> Array:
        """(np,) what a search found, that began at `first`."""
        return first if result.parameters is None else result.parameters

    def _reach(self, stage: int, draft: Solution | None = None, result: NlpResult | None = None) -> None:
        """Note the stage that begins, and what there is by then."""
        last = self.reached[-1]
        last.stage = stage
        last.draft, last.result = draft or last.draft, result or last.result

    def _judge(self, draft: Solution, result: NlpResult) -> Solution:
        """`judged`, and no success where the cost asks for a motion that nothing here could have begun."""
        if self.closest:
            outcome = Outcome.SOLVED if result.outcome is Outcome.INACCURATE else result.outcome
            result = dataclasses.replace(result, outcome=outcome, note=NEAR)
        self._reach(3, draft, result)
        if isinstance(draft, PhasedSolution):
            phases = tuple(judged(phase, result) for phase in draft.phases)
            fields: dict[str, Any] = {
                "phases": phases,
                "iterations": result.iterations,
                "solver_message": result.message,
            }
            return judged_phases(dataclasses.replace(draft, **fields), result)
        solution, problem = judged(draft, result), draft.problem
        if solution.status not in PLANS or not problem.has_model:
            return solution
        if problem.motion != STEPS and solution.success:
            doubt = doubt_of_the_slope(problem, solution.step_vector, solution.xs[0], solution.us)
            if doubt is not None:
                return ended(solution, Status(doubt[0]), doubt[1])
            solution = solution.noted(HOLDS)
        xs, us = solution.plan.sample(1)
        variables = ShootingVariables(problem, around=xs)
        try:
            reach = out_of_reach(problem, variables, variables.pack(xs[0], us, solution.step_vector.values))
        except (GradientError, SimulationError) as error:
            detail = f"the check for costs that no variable can reduce fails: {error}"
            return ended(solution, Status.CONVERGED_NOT_VERIFIED, detail)
        if reach.silent:
            return ended(solution, Status.NO_GRADIENT, reach.silent)
        return solution.noted(reach.constant) if reach.constant else solution

    def _draft(self, xs: Array, us: Array, problem: Problem | None = None, **fields: Any) -> Solution:
        arrays = ("u_final", "us_mid", "mesh")
        fields |= {name: frozen(fields[name]) for name in arrays if fields.get(name) is not None}
        fields |= {"scheme": self.scheme, "options": self.options, "wall_time": time.monotonic() - self.started}
        by = problem or self.problem, self.method, self.solver, Status.FAILED, ""
        return Solution(*by, frozen(xs), frozen(us), **fields)

    def _look_at(
        self, variables: ShootingVariables, z: Array, *, solved: bool
    ) -> tuple[Array, Array, tuple[Certificate, ...], str]:
        """xs and us of z, certificates of some of its steps, and why the goal or cost is out of its reach.

        Where z was `solved` for, these are the steps that tell most.
        """
        us = variables.unpack(z)[1]
        xs, parameters = variables.states(z), variables.parameters(z).to_dict()
        model, design = self.problem.model, self.problem.design
        if design.has_step and not design.moves_step:
            model = model.at_time_step(float(parameters.pop(TIME_STEP)[0]))

        keys: dict[int, bytes] = {}
        if self.problem.motion == STEPS:  # else see `slope`, of the whole plan
            knots = telling_knots(self.problem, xs[: len(us) + 1]) if solved else first_knots(us)
            keys = {k: xs[k].tobytes() + us[k].tobytes() + repr(parameters).encode() for k in knots.tolist()}
        # That of a search which ends where it began is known.
        new = [k for k, key in keys.items() if key not in self.certified]
        if new:
            taken = certify_steps(model, xs[new], us[new], parameters=parameters)
            self.certified.update(zip([keys[k] for k in new], taken, strict=True))
        certificates = tuple(self.certified[key] for key in keys.values())
        return xs, us, certificates, why_blind(self.problem, variables, z)


def arrays_of(motion: Collocated) -> dict[str, Any]:
    """What a Solution has beside its states and inputs."""
    task, problem = motion.task, motion.task.problem
    return {
        "u_final": None if problem.is_map else frozen(motion.us[-1]),
        "us_mid": None if task.scheme.input_is_linear else motion.us_mid,
        "free_horizon": motion.horizon if problem.horizon else None,
        "mesh": motion.mesh if len(motion.mesh) > problem.num_steps + 1 else None,
        "parameters": frozen(task.parameters),
    }


def kept_apart(problem: Problem) -> Problem:
    """`problem` in which links keep clear of each other too, but those that are near each other at its ends.

    Raises:
        ModelError: where the links are has no formula.
    """
    goal = np.array(problem.goal)
    ends = [problem.x0] + [goal] * (not np.any(np.isnan(goal[: problem.model.nq])))
    more = SelfCollision().rows_away_from(problem.model, np.nan_to_num(np.array(ends)))
    return dataclasses.replace(problem, constraints=(*problem.constraints, *more))


def closest_to(problem: Problem, plan: Solution) -> Problem:
    """`problem` with the squared distance from `plan`, each value for its range, in place of its costs."""
    xs, us = plan.plan.sample(1)
    Q = np.diag(1 / plan.plan.scale**2)
    R = np.diag(1 / problem.input_scales(us) ** 2)
    reference = plan.time_step * np.arange(len(xs)), xs, np.vstack([us, us[-1:]])
    values, sizes = plan.step_vector.values, np.ones(len(plan.step_vector.values))
    for _, entries in plan.step_vector.pairs:
        largest = np.max(np.abs(values[entries]))
        sizes[entries] = largest if largest > 0 else 1.0  # as in the coordinates in which the solver moves it
    weights = plan.time_step * len(us) / sizes**2
    return dataclasses.replace(
        problem,
        parameter_cost=(lambda p: weights @ (p - values) ** 2) if problem.optimizes_parameters else None,
        running_cost=TrackingCost(reference, Q=Q, R=R),
        final_cost=QuadraticCost(Q=plan.time_step * Q, x_ref=xs[-1]),
        goals=tuple(goal for goal in problem.goals if goal.weight is None),
    )


def is_kept_apart(problem: Problem) -> bool:
    """Whether a goal of `problem` keeps links apart already."""
    return any(isinstance(goal, SelfCollision) and goal.weight is None for goal in problem.goals)
