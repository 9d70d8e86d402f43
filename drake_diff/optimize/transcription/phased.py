"""Problems in phases as one sparse program: theirs side by side, z = [z_0, z_1, ...], and rows that link their ends.

    x_first of the phase after - reset(x_last of the phase before) = 0,    lower <= sum of the durations <= upper

Its Jacobian and Hessian are those of the phases on the diagonal, and those of the links between and on them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.optimize.problem.phases import PhasedProblem, duration_of
from drake_diff.optimize.program import Iterate
from drake_diff.optimize.transcription.coupled import CoupledRows
from drake_diff.optimize.transcription.expressions import KnotFunction, KnotFunctions, constraint_function
from drake_diff.optimize.transcription.program import SparseSum, TranscribedProgram


@dataclass(frozen=True, eq=False)
class PhasedFunctions:
    """Those of the phases, and of the links between them."""

    names: Sequence[str]
    phases: Sequence[KnotFunctions]
    links: Sequence[KnotFunction]

    @property
    def why_not(self) -> str:
        """Which of them has no second derivative and why, "" where all have."""
        named = [(f"{name}, ", f.why_not) for name, f in zip(self.names, self.phases, strict=True)]
        named += [("a reset: ", f.why_not) for f in self.links]
        return next((name + why for name, why in named if why), "")

    @property
    def error(self) -> Exception | None:
        """The first error that one of them raised."""
        every = [f.error for f in self.phases] + [getattr(f, "error", None) for f in self.links]
        return next((error for error in every if error is not None), None)


def link_functions(problem: PhasedProblem) -> tuple[KnotFunction, ...]:
    """What each switch asks of the two states side by side, symbolic if it can be."""
    return tuple(constraint_function(s.link, len(s.columns), s.probe) for s in problem.switches)


class PhasedProgram:
    """The program of the phases' `programs`, in their order, with the links of `problem`."""

    def __init__(self, problem: PhasedProblem, programs: Sequence[TranscribedProgram], links: Sequence[KnotFunction]):
        self.programs = programs
        self.functions = PhasedFunctions(problem.names, [program.functions for program in programs], links)
        self.starts = np.concatenate([[0], np.cumsum([program.z.numel() for program in programs])]).tolist()
        self.z = ca.MX.sym("z", self.starts[-1])
        self.lower, self.upper = (
            np.concatenate([getattr(program, side) for program in programs]) for side in ("lower", "upper")
        )
        self.links: list[CoupledRows] = []
        for s, function in zip(problem.switches, links, strict=True):
            program = programs[s.before]
            last = self.starts[s.before] + program.every[-1] * program.width + np.arange(len(s.columns))
            first = self.starts[s.after] + np.arange(len(s.rows))
            columns = np.concatenate([last, first])[None]
            self.links.append(CoupledRows(s.label, function, columns, s.link.lower, s.link.upper))
        self._whole = () if problem.horizon is None else problem.horizon
        self._given = sum(duration_of(p.task.problem)[0] for p in programs if not p.free)

    def split(self, z: Array) -> list[Array]:
        """The decision variables of each phase."""
        return np.split(z, self.starts[1:-1])

    def iterates(self, z: Array) -> tuple[Iterate, ...]:
        """The motion of each phase at z, for callbacks."""
        return tuple(
            iterate
            for program, variables in zip(self.programs, self.split(z), strict=True)
            for iterate in program.iterates(variables)
        )

    @cached_property
    def sides(self) -> tuple[Array, Array]:
        """(lower, upper) of g: the phases', those of the links, and what the free durations may sum to."""
        parts = [*(p.sides for p in self.programs), *(link.sides for link in self.links)]
        if self._whole:
            least, most = self._whole
            parts.append((np.array([least - self._given]), np.array([most - self._given])))
        lower, upper = zip(*parts, strict=True)
        return np.concatenate(lower), np.concatenate(upper)

    @cached_property
    def nlp(self) -> dict[str, Any]:
        """x, f and g as CasADi's nlpsol takes them."""
        functions = [ca.Function("phase", [p.z], [p.nlp["f"], p.nlp["g"]]) for p in self.programs]
        pairs = [function(z) for function, z in zip(functions, self._parts, strict=True)]
        g = [*(rows for _, rows in pairs), *(link.values(self.z) for link in self.links)]
        g += [ca.mtimes(self._durations, self.z)] * bool(self._whole)
        return {"x": self.z, "f": sum(f for f, _ in pairs), "g": ca.vertcat(*g)}

    def derivatives(self, exact: bool) -> dict[str, Any]:
        """CasADi Functions by the names of nlpsol's options, "hess_lag" only where `exact`."""
        p, sigma = ca.MX.sym("p", 0), ca.MX.sym("sigma")
        multipliers = ca.MX.sym("multipliers", self.nlp["g"].numel())
        pairs = list(zip([program.derivatives(exact) for program in self.programs], self._parts, strict=True))
        slope = ca.vertcat(*[phase_functions["grad_f"](z, p)[1] for phase_functions, z in pairs])
        rows = [phase_functions["jac_g"](z, p)[1] for phase_functions, z in pairs]
        ends = np.cumsum([0, *(block.size1() for block in rows)]).tolist()
        linked = SparseSum((sum(link.count for link in self.links), self.z.numel()))
        first = 0
        for link in self.links:
            (positions, columns, index), source = link.jacobian(self.z)
            linked.add(first + positions, columns, 1.0, source, index)
            first += link.count
        jacobian = [ca.diagcat(*rows), linked.matrix(), *[ca.MX(self._durations)] * bool(self._whole)]
        functions = {
            "grad_f": ca.Function("grad_f", [self.z, p], [self.nlp["f"], slope]),
            "jac_g": ca.Function("jac_g", [self.z, p], [self.nlp["g"], ca.vertcat(*jacobian)]),
        }
        if exact:
            within = zip(pairs, ends[:-1], ends[1:], strict=True)
            hessian = ca.diagcat(
                *[phase_functions["hess_lag"](z, p, sigma, multipliers[a:b]) for (phase_functions, z), a, b in within]
            )
            bent, first = SparseSum((self.z.numel(), self.z.numel())), ends[-1]
            for link in self.links:
                (positions, columns, index), source = link.hessian(self.z, multipliers[first : first + link.count])
                bent.add(positions, columns, 1.0, source, index)
                first += link.count
            functions["hess_lag"] = ca.Function("hess_lag", [self.z, p, sigma, multipliers], [hessian + bent.matrix()])
        return functions

    @cached_property
    def _parts(self) -> list[Any]:
        """The variables of each phase."""
        return [self.z[a:b] for a, b in zip(self.starts[:-1], self.starts[1:], strict=True)]

    @cached_property
    def _durations(self) -> Any:
        """(1, n) 1 at each free duration."""
        places = [end - 1 for program, end in zip(self.programs, self.starts[1:], strict=True) if program.free]
        return ca.DM.triplet([0] * len(places), places, ca.DM.ones(len(places)), 1, self.z.numel())
