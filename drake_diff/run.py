"""One solve by one method: certify at the guess, search, certify at the result, measure, judge."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from drake_diff.arrays import Array, frozen
from drake_diff.certificate import Certificate, certify_jacobian_of_many
from drake_diff.certify import certify
from drake_diff.collocation import solve_collocation
from drake_diff.contact_sequence import solve_through_jumps
from drake_diff.continuation import solve_continuation
from drake_diff.continuous import EquationsOfMotion
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.ilqr import solve_ilqr
from drake_diff.nonlinear_program import Limits, NlpResult, Outcome, Report
from drake_diff.problem import Problem
from drake_diff.shooting import RolloutCost, ShootingVariables
from drake_diff.shooting_program import roll_segments, solve_shooting
from drake_diff.soft_contact import SoftContact
from drake_diff.solution import Solution, Status
from drake_diff.transcription import ProblemTranscription
from drake_diff.verdict import ended, judged, refused, why_blind

CERTIFIED_KNOTS = 5
# Relative; forces are rounded at 1e-16 of their own size, and a wrist's small inertia turns that into accelerations.
ACCELERATION_ROUNDING = 1e-12

Search = Callable[[Array, Array], tuple[NlpResult, Array, Array]]


class Run:
    """One solve: certify at the guess, solve, certify at the result, measure, judge."""

    def __init__(
        self,
        problem: Problem,
        method: str,
        scheme: str,
        solver: str,
        limits: Limits,
        options: dict[str, Any],
        report: Report | None,
    ):
        self.problem, self.method, self.scheme, self.solver = problem, method, scheme, solver
        self.limits, self.options, self.report = limits, options, report
        self.start = time.monotonic()
        self.knots = np.unique(np.linspace(0, problem.num_steps - 1, CERTIFIED_KNOTS).astype(int))

    def collocate(self, xs: Array, us: Array) -> Solution:
        """In CasADi; SNOPT, which that does not carry, in Drake's own DirectCollocation."""
        if self.solver == "snopt":
            equations = EquationsOfMotion(self.problem.model)
            before = self._certify_equations(equations.jacobian, xs, us)
            result, found = self._solve_drakes(xs, us)
            return self._collocated(result, found, before, equations.jacobian)
        transcription = ProblemTranscription(self.problem, self.scheme)
        before = self._certify_equations(transcription.jacobian, xs, us)
        motion = transcription.solve(xs, np.vstack([us, us[-1:]]), limits=self.limits, report=self.report)
        self.options["derivatives"] = motion.derivatives
        found = {"xs": motion.xs, "us": motion.us[:-1], "u_final": motion.us[-1]}
        found |= {"us_mid": None if self.scheme == "drake" else motion.us_mid}
        found |= {"free_horizon": motion.horizon if self.problem.horizon else None}
        result = NlpResult(motion.nodes.ravel(), motion.outcome, motion.message, motion.iterations)
        return self._collocated(result, found, before, transcription.jacobian)

    def _solve_drakes(self, xs: Array, us: Array) -> tuple[NlpResult, dict[str, Any]]:
        result, xs, us, u_final = solve_collocation(
            self.problem, xs, us, solver=self.solver, limits=self.limits, report=self.report
        )
        return result, {"xs": xs, "us": us, "u_final": u_final}

    def _collocated(
        self, result: NlpResult, found: dict[str, Any], before: tuple[Certificate, ...], jacobian: Any
    ) -> Solution:
        finite = bool(np.all(np.isfinite(found["xs"])))
        after = self._certify_equations(jacobian, found["xs"], found["us"]) if finite else ()
        return judged(self._draft(**found, certificates=before + after), result)

    def sweep(self, xs: Array, us: Array, *, given: bool, stages: tuple[SoftContact, ...]) -> Solution:
        """iLQR; from the states of a `given` guess, which need not be a rollout, else from the rollout of `us`.

        With `stages`, which take the inputs of the guess alone, it need not have a gradient.
        """

        def search(rolled: Array, us: Array) -> tuple[NlpResult, Array, Array]:
            if stages:
                limits, report = self.limits, self.report
                result, xs_found, us, logs = solve_continuation(self.problem, us, stages, limits=limits, report=report)
                self.options["continuation"] = [log.to_dict() for log in logs]
                return result, xs_found, us
            solve_method = solve_through_jumps if self.problem.model.contract.contact.collision_pairs else solve_ilqr
            return solve_method(self.problem, xs if given else rolled, us, limits=self.limits, report=self.report)

        return self._through_steps(xs, us, search, may_be_blind=bool(stages))

    def shoot(self, xs: Array, us: Array, *, improve: bool) -> Solution:
        """Shooting; `improve` the guess by iLQR, which gets out of curved valleys that shooting crawls along."""

        def search(xs: Array, us: Array) -> tuple[NlpResult, Array, Array]:
            if improve:
                result, xs, us = solve_ilqr(self.problem, xs, us, limits=self.limits, report=self.report)
                self.options["initial_guess"] = f"default, then {result.message}"
                if result.outcome in (Outcome.INTERRUPTED, Outcome.TIME_LIMIT):
                    return result, xs, us
            return solve_shooting(self.problem, xs, us, solver=self.solver, limits=self.limits, report=self.report)

        return self._through_steps(xs, us, search)

    def shoot_segments(self, xs: Array, us: Array, segments: int) -> Solution:
        """Multiple shooting, looked at around the segments' own states, which defects part."""
        try:
            xs = roll_segments(self.problem, xs, us, segments)
        except SimulationError as error:
            return refused(self._draft(xs, us), error)
        search = partial(solve_shooting, solver=self.solver, limits=self.limits, report=self.report, segments=segments)
        return self._through_steps(xs, us, partial(search, self.problem), segmented=True)

    def _through_steps(
        self, xs: Array, us: Array, search: Search, *, segmented: bool = False, may_be_blind: bool = False
    ) -> Solution:
        """Certify, search, certify again, on Drake's own steps; at rollouts, or at the states as they are."""
        variables = ShootingVariables(self.problem, around=xs if segmented else None)
        try:
            xs, us, before, blindness = self._look_at(variables, variables.pack(xs[0], us))
        except (GradientError, SimulationError) as error:
            return refused(self._draft(xs, us), error)
        if blindness and not may_be_blind:
            return ended(self._draft(xs, us, certificates=before), Status.NO_GRADIENT, blindness)
        try:
            result, xs, us = search(xs, us)
            variables = ShootingVariables(self.problem, around=xs if segmented else None)
            z = result.z if self.method == "shooting" and len(result.z) == variables.size else variables.pack(xs[0], us)
            xs, us, after, blindness = self._look_at(variables, z)
        except (GradientError, SimulationError) as error:
            return refused(self._draft(xs, us, certificates=before), error)
        norms = np.linalg.norm(RolloutCost(self.problem, variables).differentiate(z)[2], axis=1)
        values = variables.parameters(z).values
        found = {"certificates": before + after, "gradient_norms": frozen(norms), "parameters": values}
        if result.note:
            self.options["contact_sequence"] = result.note
        draft = self._draft(xs, us, **found)
        solution = judged(draft, result)
        return ended(solution, Status.NO_GRADIENT, blindness) if blindness and solution.success else solution

    def _draft(self, xs: Array, us: Array, **found: Any) -> Solution:
        found |= {name: frozen(found[name]) for name in ("u_final", "us_mid") if found.get(name) is not None}
        return Solution(
            problem=self.problem,
            method=self.method,
            scheme=self.scheme,
            solver=self.solver,
            status=Status.FAILED,
            message="",
            xs=frozen(xs),
            us=frozen(us),
            options=self.options,
            wall_time=time.monotonic() - self.start,
            **found,
        )

    def _look_at(self, variables: ShootingVariables, z: Array) -> tuple[Array, Array, tuple[Certificate, ...], str]:
        """xs and us of z, certificates of some of its steps, and why the goal or cost is out of its reach."""
        us = variables.unpack(z)[1]
        xs, parameters = variables.states(z), variables.parameters(z).to_dict()
        certificates = tuple(certify(self.problem.model, xs[k], us[k], parameters=parameters) for k in self.knots)
        return xs, us, certificates, why_blind(self.problem, variables, z)

    def _certify_equations(self, jacobian: Any, xs: Array, us: Array) -> tuple[Certificate, ...]:
        """Certificates, at some knots, of the Jacobian that the solver gets against Drake's own equations."""
        model, equations = self.problem.model, EquationsOfMotion(self.problem.model)
        return tuple(
            certify_jacobian_of_many(
                equations.values,
                np.concatenate([xs[k], us[k]]),
                jacobian,
                rows=tuple(f"d({name})/dt" for name in model.state_names),
                columns=model.state_names + model.input_names,
                solver_tolerance=ACCELERATION_ROUNDING,
                method="continuous time",
                subject=f"the equations of motion of {model.name}",
            )
            for k in self.knots
        )
