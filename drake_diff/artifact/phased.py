"""Write the directory of a solve in phases: phases.json, and in phase_0, phase_1, ... a directory of each phase."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff.optimize.phased import Chain, PhasedSolution
from drake_diff.optimize.problem.held import Impact
from drake_diff.optimize.problem.phases import PhasedProblem, Switch
from drake_diff.optimize.program import FEASIBILITY_TOLERANCE
from drake_diff.optimize.solution import Solution
from drake_diff.record.directory import name_of
from drake_diff.record.parts import ModelInput
from drake_diff.record.phases import ChainEvidence, LinkEvidence, PhaseEvidence, PhasesRecord
from drake_diff.record.provenance import gradient_evidence, provenance_of, written_now
from drake_diff.record.sealed import Passed, WallClock
from drake_diff.record.solve import Claim, Solver

LIMITATIONS = ["of the model in simulation only: nothing here was measured on a robot"]
AT_THEIR_TIMES = (
    "resets happen at the times of the plan, also in the chain of all phases: an event that comes early is not tried"
)
WHERE_GAPS_CLOSE = (
    "rigid impacts come where their own gaps close, also in the chain of all phases: other contacts on the way are not "
    "tried"
)


def directory_of(i: int) -> str:
    """The directory of a phase."""
    return f"phase_{i}"


def save_phases(solution: PhasedSolution, folder: Path, save_phase: Callable[[Solution, Path], Any]) -> PhasesRecord:
    """Write the solution in phases into `folder`; `save_phase` writes that of one."""
    for i, phase in enumerate(solution.phases):
        save_phase(phase, folder / directory_of(i))
    return _record(folder, solution).write(folder)


def phases_record(folder: Path, problem: PhasedProblem, verdict: Passed, sentence: str) -> PhasesRecord:
    """The record of a run without a solution."""
    return PhasesRecord(
        name=name_of(folder), verdict=verdict, sentence=sentence, search=None, initial_guess=None, **_asked(problem)
    )


def _asked(problem: PhasedProblem) -> dict[str, Any]:
    names = ", then ".join(problem.names)
    repeated = " and again from the start" if problem.periodic is not False else ""
    rigid = [isinstance(switch.reset, Impact) and switch.reset.has_gap for switch in problem.switches]
    limitations = [*LIMITATIONS, *([] if all(rigid) else [AT_THEIR_TIMES]), *([WHERE_GAPS_CLOSE] if any(rigid) else [])]
    statement = (
        f"{problem.name} in {len(problem.phases)} phases ({names}{repeated}), linked by resets, each as its record"
    )
    return {
        "model": ModelInput(file=None, options=None),  # each phase has its own
        "provenance": provenance_of(),
        "wall_clock": WallClock(written_utc=written_now()),
        "claim": Claim(statement=f"{statement} says", limitations=limitations),
        "horizon_s": None if problem.horizon is None else list(problem.horizon),
        "counts_steps": problem.is_map,
    }


def _record(folder: Path, solution: PhasedSolution) -> PhasesRecord:
    given = None if solution.search is None else solution.search.guess
    options = json.loads(json.dumps(solution.options, default=str), parse_constant=str)
    asked = _asked(solution.problem)
    asked["wall_clock"] = WallClock(written_utc=written_now(), duration_s=solution.wall_time)
    return PhasesRecord(
        name=name_of(folder),
        verdict="pass" if solution.success else "fail",
        sentence=solution.message,
        search=None if solution.search is None else solution.search.arguments,
        initial_guess=None if given is None else type(given).__name__,
        solver=Solver(
            method="collocation",
            solver="ipopt",
            scheme=solution.phases[0].scheme,
            status=solution.status.value,
            message=solution.message,
            solver_message=solution.solver_message,
            options=options,
            iterations=len(solution.iterations),
        ),
        cost=finite(solution.cost),
        phases=[
            PhaseEvidence(
                name=name,
                directory=directory_of(i),
                status=phase.status.value,
                cost=finite(phase.cost),
                duration=phase.horizon,
            )
            for i, (name, phase) in enumerate(zip(solution.problem.names, solution.phases, strict=True))
        ],
        links=[_link(solution, i, switch) for i, switch in enumerate(solution.problem.switches)],
        chain=chain_evidence(solution.chain),
        **asked,
    )


def _link(solution: PhasedSolution, i: int, switch: Switch) -> LinkEvidence:
    certificates = {c.subject: gradient_evidence(c) for c in solution.link_certificates}
    return LinkEvidence(
        before=switch.before,
        after=switch.after,
        told=switch.told,
        reset=_reset(switch, solution.problem),
        errors=[finite(error) for error in solution.link_errors[switch.label]],
        tolerance=FEASIBILITY_TOLERANCE,
        certificate=certificates.get(switch.label),
    )


def _reset(switch: Switch, problem: PhasedProblem) -> dict[str, Any] | None:
    if switch.matrix is not None:
        same = switch.told == "the state goes on"
        return {"identity": {}} if same else {"matrix": {"rows": np.asarray(switch.matrix).tolist()}}
    return {"impact": switch.reset.to_dict()} if isinstance(switch.reset, Impact) else None


def chain_evidence(chain: Chain) -> ChainEvidence:
    """The chain of all phases as it stands in a record."""
    return ChainEvidence(holds=chain.holds, control=chain.control, told=chain.told, worst=finite(chain.worst))


def finite(value: float) -> float | None:
    """`value`, None where it is none that JSON has."""
    return float(value) if np.isfinite(value) else None
