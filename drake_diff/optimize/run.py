"""One solve by one method: certify the guess, search, certify the result, verify it and decide its status."""

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
from drake_diff.optimize.verification import NEAR, ended, judged, may_be_too_coarse, refused, status_of, unmeasured

GRACE = 0.05  # extra time, as a fraction of the time limit, for measures of a result that the limit cut off
# The stages of a solve, in order. A message on the time limit names the stages that were skipped.
STAGES = ("certificates of the guess", "the search", "certificates of the result", "replays and other measures")

Searcher = Callable[[Problem, Array, Array, Array], tuple[NlpResult, Array, Array]]


@dataclass(eq=False)
class SoFar:
    """The partial result of a run for the case that time runs out, and the current stage; see STAGES."""

    stage: int
    draft: Solution
    result: NlpResult | None = None
    judged: Solution | None = None  # set while a finer mesh is tried


@dataclass(frozen=True, eq=False)
class Run:
    """One solve by one method: certify the guess, search, certify the result, verify it and decide its status."""

    problem: Any  # a Problem, or for collocation a PhasedProblem
    method: str
    scheme: str
    solver: str
    limits: Limits
    asked: Options
    options: dict[str, Any]  # the record's options of the solver
    report: Report | None
    searched: Problem | None = None  # the problem to solve, if it differs from `problem`
    closest: bool = False  # whether any motion near the guess suffices, an optimum or not
    convert: Callable[[Solution], Solution | None] | None = None  # see `solve._in_steps`
    start: float = field(default_factory=now)
    started: float = field(default_factory=time.monotonic)
    certified: dict[bytes, Certificate] = field(default_factory=dict)  # keyed by state, input and parameters
    reached: list[SoFar] = field(default_factory=list)  # the last entry is the current stage

    def within_time(self, search: Callable[[], Any], guess: Any, begin: Callable[[], None]) -> Any:
        """Return the result of `search`, one of the three below, or the partial result at the time limit.

        `begin` is called before it. A signal during `begin` or later ends the run with the guess.
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
        """Return the draft of a solve without a result: its guess, for collocation with an input at the last knot."""
        drafts = []
        for problem, guess in zip(self.problem.phases, guesses, strict=True):
            last = guess.us[-1] if guess.u_final is None else np.ravel(guess.u_final)
            has_last = self.scheme != "step" and not problem.is_map
            drafts.append(self._draft(guess.xs, guess.us, problem, u_final=last if has_last else None))
        return self._joined(drafts)

    def _joined(self, drafts: Sequence[Solution], **fields: Any) -> Solution:
        """Return the draft of all phases."""
        if not isinstance(self.problem, PhasedProblem):
            return drafts[0]
        fields |= {"options": self.options, "wall_time": time.monotonic() - self.started}
        return PhasedSolution.joined(self.problem, drafts, **fields)

    def _cut(self, reached: SoFar, *, interrupted: bool) -> Solution:
        if reached.judged is not None:
            why = Status.INTERRUPTED.sentence if interrupted else "the time limit came first"
            return reached.judged.noted(f"no finer mesh: {why}")
        result, cut = reached.result, f"not made within the time limit: {', '.join(STAGES[reached.stage :])}"
        if interrupted:  # signals are only checked before a search
            plan = ended(reached.draft, Status.INTERRUPTED, cut.replace("within the time limit", "before that"))
            if self.report is not None:
                self.report.found(plan)
            return plan
        if result is None:
            return ended(reached.draft, Status.TIME_LIMIT, cut)
        status, table = status_of(result.outcome) or Status.TIME_LIMIT, result.iterations
        fields = {"iterations": table, "solver_message": result.message}
        return ended(reached.draft, status, result.message, cut, **fields)

    def collocate(self, guesses: Sequence[Guess]) -> Solution:
        """Solve by collocation in CasADi, or with SNOPT, which CasADi does not include, by Drake's DirectCollocation.

        The mesh is refined if `refine` is True, or, if it is None, for as long as the plan fails its checks.
        """
        refine = self.asked.refine
        if self.solver == "snopt":
            return self._collocate_in_drake(guesses)
        with noted_interrupts() as interrupted:  # a signal before the search ends it at its start
            try:
                with until_set(interrupted):
                    transcription = Transcription(self.searched or self.problem, self.scheme)
                    before = self._certify_guess(transcription, guesses)
            except (GradientError, SimulationError) as error:
                return refused(self._of_guess(guesses), error)
            self._reach(1)
            starts = [self._begin(transcription, i, guess) for i, guess in enumerate(guesses)]
            refinement = self.asked if refine else None
            motion = transcription.solve(
                starts, limits=self.limits.after(self.start), report=self.report, refinement=refinement
            )
            motion = dataclasses.replace(motion, result=heard(motion.result, interrupted))
        if refine:
            self.options["refinements"] = [list(row) for row in motion.refinements]
        if motion.cleared:
            self.options["clearance_rounds"] = [list(row) for row in motion.cleared]
        solution = self._judge_collocated(transcription, motion, before)
        is_final = refine is not None or solution.method != self.method
        return solution if is_final else self._refined(transcription, motion, solution, before)

    def _certify_guess(self, transcription: Transcription, guesses: Sequence[Guess]) -> tuple[Certificate, ...]:
        """Certify the derivatives at the guess. For a problem in phases, only the result is certified."""
        if isinstance(self.problem, PhasedProblem):
            return ()
        guess, task = guesses[0], transcription.tasks[0]
        costs_of(self.problem, guess.xs, guess.us).expand(guess.xs, guess.us)
        point = transcription.jacobian, guess.xs, guess.us, task
        return certify_equations(self.problem, *point, knots=first_knots(guess.us))

    def _begin(self, transcription: Transcription, phase: int, guess: Guess) -> Initial:
        """Return the start of a phase. A motion with the same scheme and steps keeps its mesh and multipliers."""
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
        """Return `solution`, or the solution on a mesh that is refined for as long as the plan fails its checks."""
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
        """Return the motion on finer meshes, or None if the plan holds or its failure does not depend on the mesh."""
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
        return transcription.finer(
            motion, exceeded, self.asked.max_num_steps, self.limits.after(self.start), self.report
        )

    def _collocate_in_drake(self, guesses: Sequence[Guess]) -> Solution:
        """Solve by Drake's own DirectCollocation."""
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
                self.problem, guess.xs, guess.us, limits=self.limits.after(self.start), report=self.report
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
            if self.searched is None and plan.transcribed is not None:  # otherwise it was measured with another cost
                plan.transcribed.measured_as(phase)
        joined = self._joined(drafts, certificates=links)
        if self.convert and error is None and result.outcome in FOUND and not joined.plan_checks.failing:
            converted = self.convert(joined)
            if converted is not None:
                return converted
        solution = self._judge(joined, result)
        if error is not None and solution.status in PLANS:
            return ended(solution, Status.NO_GRADIENT, str(error))
        return solution

    def sweep(self, guesses: Sequence[Guess], *, given: bool, stages: Stages) -> Solution:
        """Solve by iLQR from the states of a `given` guess, which need not be a rollout, or from the rollout of `us`.

        With `stages`, the guess need not have a gradient.
        """
        guess = guesses[0]
        xs, us = guess.xs, guess.us
        report, first = self.report, iter([xs] if given else [])

        def search(problem: Problem, rolled: Array, us: Array, values: Array) -> tuple[NlpResult, Array, Array]:
            limits = self.limits.after(self.start)
            if stages:
                result, xs_found, us, logs = solve_continuation(problem, xs, us, stages, limits=limits, report=report)
                self.options["continuation"] = [asdict(log) for log in logs]
                return result, xs_found, us
            touches = problem.model.contract.contact.collision_pairs and not moves_shapes(problem)
            touches = touches and problem.motion == STEPS  # in continuous time, contact causes no jump
            begin = next(first, rolled)
            if touches:
                return solve_through_jumps(problem, begin, us, limits=limits, report=report, values=values)
            known = guess.multipliers
            return solve_ilqr(problem, begin, us, limits=limits, report=report, values=values, multipliers=known)

        around = given and not stages  # the rollout of a robot that falls open loop does not represent the given motion
        return self._through_steps(xs, us, search, guess, may_be_blind=bool(stages), around=around)

    def shoot(self, guesses: Sequence[Guess], *, given: bool) -> Solution:
        """Solve the sparse program through the steps, from the states of the guess.

        Without a `given` guess, a few steps of iLQR come first, from the rollout of the inputs and without couplings,
        which iLQR does not support. If they converge, the program starts from their motion, and otherwise from the
        default guess. If the problem gives inputs or the motion is in continuous time, the program starts from iLQR's
        last motion in any case. Designs that are optimized together with inputs skip iLQR: far from the goal, it leads
        a jumping leg to a short one, of half the height.
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
            return solve_shooting(problem, xs, us, limits=self.limits.after(self.start), report=self.report, **options)

        return self._through_steps(guess.xs, guess.us, search, guess, around=not rolled)

    def _few_sweeps(
        self, problem: Problem, x0: Array, us: Array, values: Array
    ) -> tuple[NlpResult, Array, Array] | None:
        """Run a few iLQR iterations from the rollout of `us` (N, nu), or return None if iLQR is not possible."""
        problem = dataclasses.replace(problem, couplings=())
        if not takes(problem):
            return None
        few = dataclasses.replace(
            self.limits.after(self.start), max_iterations=min(self.asked.sweeps, self.limits.max_iterations)
        )
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
        """Call `_searched`. A signal before the search ends the search at its start, with the initial motion."""
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
        """Certify, search, call `after_search` and certify again, on Drake's own steps at the states of the result.

        The guess is certified at its rollout, or at its own states if `around` is set.
        """
        values, first_states = self._first_values(guess), xs
        try:
            with until_set(interrupted):
                ends = self._with_its_end(xs, us, values) if around else None
        except SimulationError:  # a state that no input can hold gives no information about the goal
            ends = xs
        variables = ShootingVariables(self.problem, around=ends)
        try:
            with until_set(interrupted):
                xs, us, before, blindness = self._look_at(variables, variables.pack(xs[0], us, values), solved=False)
        except (GradientError, SimulationError) as error:
            if isinstance(error, SimulationError) and not around and self.problem.motion == STEPS:
                options = {"may_be_blind": may_be_blind, "around": True}  # from the guess's own states, step by step
                return self._searched(first_states, us, search, guess, interrupted, after_search, **options)
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
            if self.report is not None and self.report.plan is not None:  # otherwise no rollout is needed
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
        """Return (N+1, nx) the states of a guess, with the end of its rollout: its own may be the goal itself."""
        with self.problem.intervals(self.problem.design.vector.at(values)) as intervals:
            return np.vstack([xs[:-1], roll(intervals, xs[0], us)[-1:]])

    def _design_of(self, variables: ShootingVariables, z: Array) -> dict[str, Any]:
        """Return the parameters and the horizon in z."""
        design, values, horizon = self.problem.design, variables.parameters(z).values, None
        if self.problem.horizon is not None:
            horizon = float(np.clip(design.time_step(values) * self.problem.num_steps, *self.problem.horizon))
        return {"parameters": frozen(design.own(values)), "free_horizon": horizon}

    def _offer(self, draft: Solution, result: NlpResult) -> None:
        """Report the unverified draft to the callback."""
        if self.report is not None:
            self.report.found(unmeasured(draft, result))

    def _first_values(self, guess: Guess) -> Array:
        """Return (np,) the initial values of the problem's `design`."""
        problem, design = self.problem, self.problem.design
        parameters = problem.parameters.values if guess.parameters is None else guess.parameters
        first = problem.start_horizon if guess.horizon is None else guess.horizon
        h = (first if problem.horizon is None else float(np.clip(first, *problem.horizon))) / problem.num_steps
        return np.clip(design.whole(parameters, h), design.lower, design.upper)

    def _keeping_clear(self, search: Searcher, xs: Array, us: Array, values: Array) -> tuple[NlpResult, Array, Array]:
        """Run `search`, and repeat it with finer checks if a step of its motion comes too near to an obstacle."""
        problem, rounds, guess = self.searched or self.problem, list[list[float]](), (xs, us)
        result, xs, us = search(problem, xs, us, values)
        for parts in self.asked.clearance_parts:
            lacking, enters = lacking_between(problem.kept, xs)
            if not lacking or result.outcome not in (Outcome.SOLVED, Outcome.INACCURATE, Outcome.ITERATION_LIMIT):
                break
            if self.report is not None:
                self.report.say(f"{in_words(lacking, 'm')} too near to an obstacle in a step: {parts} parts per step")
            last = self._values_of(result, values)
            more = swept(self.problem.kept, problem.design.time_step(last), parts)
            wider = dataclasses.replace(problem, constraints=(*problem.constraints, *more))
            result, xs, us = search(wider, *((*guess, values) if enters else (xs, us, last)))
            rounds.append([parts, lacking])
        if rounds:
            self.options["clearance_rounds"] = rounds
        return result, xs, us

    def _values_of(self, result: NlpResult, first: Array) -> Array:
        """Return (np,) the values that a search found from `first`."""
        return first if result.parameters is None else result.parameters

    def _reach(self, stage: int, draft: Solution | None = None, result: NlpResult | None = None) -> None:
        """Note the stage that begins and the partial result."""
        last = self.reached[-1]
        last.stage = stage
        last.draft, last.result = draft or last.draft, result or last.result

    def _judge(self, draft: Solution, result: NlpResult) -> Solution:
        """Judge the draft. It is no success if the cost demands a motion that no variable of the plan can start."""
        if self.closest:
            acceptable = Outcome.INACCURATE, Outcome.ITERATION_LIMIT
            outcome = Outcome.SOLVED if result.outcome in acceptable else result.outcome
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
        """Return xs and us of z, certificates of some of its steps, and why the goal or the cost is out of reach.

        If z is `solved`, the certified steps are those of `telling_knots`.
        """
        us = variables.unpack(z)[1]
        xs, parameters = variables.states(z), variables.parameters(z).to_dict()
        model, design = self.problem.model, self.problem.design
        if design.has_step and not design.moves_step:
            model = model.at_time_step(float(parameters.pop(TIME_STEP)[0]))

        keys: dict[int, bytes] = {}
        if self.problem.motion == STEPS:  # otherwise `doubt_of_the_slope` checks the whole plan
            knots = telling_knots(self.problem, xs[: len(us) + 1]) if solved else first_knots(us)
            keys = {k: xs[k].tobytes() + us[k].tobytes() + repr(parameters).encode() for k in knots.tolist()}
        # The certificates of a search that ends at its initial motion are known.
        new = [k for k, key in keys.items() if key not in self.certified]
        if new:
            taken = certify_steps(model, xs[new], us[new], parameters=parameters)
            self.certified.update(zip([keys[k] for k in new], taken, strict=True))
        certificates = tuple(self.certified[key] for key in keys.values())
        return xs, us, certificates, why_blind(self.problem, variables, z)


def arrays_of(motion: Collocated) -> dict[str, Any]:
    """Return the fields of a Solution in addition to its states and inputs."""
    task, problem = motion.task, motion.task.problem
    return {
        "u_final": None if problem.is_map else frozen(motion.us[-1]),
        "us_mid": None if task.scheme.input_is_linear else motion.us_mid,
        "free_horizon": motion.horizon if problem.horizon else None,
        "mesh": motion.mesh if len(motion.mesh) > problem.num_steps + 1 else None,
        "parameters": frozen(task.parameters),
    }


def kept_apart(problem: Problem) -> Problem:
    """Return `problem` with constraints that keep links apart, except links that are close at the ends of the motion.

    Raises:
        ModelError: the positions of the links have no formula.
    """
    goal = np.array(problem.goal)
    ends = [problem.x0] + [goal] * (not np.any(np.isnan(goal[: problem.model.nq])))
    more = SelfCollision().rows_away_from(problem.model, np.nan_to_num(np.array(ends)))
    return dataclasses.replace(problem, constraints=(*problem.constraints, *more))


def closest_to(problem: Problem, plan: Solution) -> Problem:
    """Return `problem` with the squared distance from `plan`, relative to the ranges, in place of its costs."""
    xs, us = plan.plan.sample(1)
    Q = np.diag(1 / plan.plan.scale**2)
    R = np.diag(1 / problem.input_scales(us) ** 2)
    reference = plan.time_step * np.arange(len(xs)), xs, np.vstack([us, us[-1:]])
    values, sizes = plan.step_vector.values, np.ones(len(plan.step_vector.values))
    for _, entries in plan.step_vector.pairs:
        largest = np.max(np.abs(values[entries]))
        sizes[entries] = largest if largest > 0 else 1.0  # as in the coordinates of the solver
    weights = plan.time_step * len(us) / sizes**2
    return dataclasses.replace(
        problem,
        parameter_cost=(lambda p: weights @ (p - values) ** 2) if problem.optimizes_parameters else None,
        running_cost=TrackingCost(reference, Q=Q, R=R),
        final_cost=QuadraticCost(Q=plan.time_step * Q, x_ref=xs[-1]),
        goals=tuple(goal for goal in problem.goals if goal.weight is None),
    )


def is_kept_apart(problem: Problem) -> bool:
    """Return whether a goal of `problem` already keeps links apart."""
    return any(isinstance(goal, SelfCollision) and goal.weight is None for goal in problem.goals)
