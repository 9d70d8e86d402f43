"""The fields of record.json.

`EvidenceRecord` has nothing to do with RFC 4998, which uses the name for archive time stamps.
"""

import json
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

SCHEMA_VERSION = "0.3.0"


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class Quantity(_Part):
    """A number with its unit; `value` is None where there is no finite one, and `reason` says why."""

    value: float | None
    unit: str
    reason: str | None = None


class Check(_Part):
    """Something measured on the plant after the solve. Without a bound it informs, and `passed` is None."""

    name: str
    definition: str
    quantity: Quantity
    bound: float | None = None
    passed: bool | None = None


class GradientEvidence(_Part):
    """One certificate: what was compared, where the derivative came from, and the entry that is worst."""

    subject: str
    method: str
    verdict: str
    entries: int
    counts: dict[str, int]
    worst: str | None


class ParameterEvidence(_Part):
    """One entry of the parameter vector: where it started, what was found, where its derivative came from."""

    name: str
    unit: str
    derivative_source: str
    start: float
    value: float
    optimized: bool
    lower: float | None
    upper: float | None


class ReplayEvidence(_Part):
    """One replay of the plan on the plant; a measure is None where the motion could not be taken."""

    variant: str
    control: str
    time_step_s: float
    contact_approximation: str
    goal_error: float | None  # the largest, in the state's units
    bound_violation: float | None  # the same
    energy_error_J: float | None
    penetration_m: float | None
    holds: bool
    failures: list[str]


class Failure(_Part):
    """Why a run is no success, under one of the five labels."""

    label: Literal["perception_error", "state_error", "planning_error", "control_error", "evaluation_error"]
    code: str
    message: str


class FileEvidence(_Part):
    """A file of the run directory, or one the run was made from."""

    path: str
    bytes: int
    sha256: str


class Solver(_Part):
    """What solved the problem, and how it says it ended."""

    method: str
    solver: str
    status: str
    message: str
    solver_message: str
    options: dict[str, Any]
    iterations: int


class Provenance(_Part):
    """With what the run was made."""

    python: str
    platform: str
    packages: dict[str, str]
    git: dict[str, str | bool] | None
    command: list[str]
    model_file: FileEvidence | None


class WallClock(_Part):
    """What differs from run to run: everything else in the record is the same, byte for byte."""

    written_utc: str
    solve_s: float | None = None


class EvidenceRecord(_Part):
    """Everything a stranger needs to judge the run, except the motion itself, which is in trace.mcap."""

    schema_version: str = SCHEMA_VERSION
    name: str
    state: Literal["incomplete", "complete"]
    verdict: Literal["pass", "fail", "incomplete"]
    sentence: str
    problem: dict[str, Any]
    contract: dict[str, Any]
    solver: Solver | None = None
    parameters: list[ParameterEvidence] = []
    checks: list[Check] = []
    gradients: list[GradientEvidence] = []
    gradient_norms: list[float] = []
    replays: list[ReplayEvidence] = []
    failures: list[Failure] = []
    provenance: Provenance
    wall_clock: WallClock
    files: dict[str, FileEvidence] = {}

    def as_row(self) -> dict[str, str]:
        """The textbook's view of the record: section, tool, observation, action, metric, perturbation."""
        positions = self.contract["positions"] + self.contract["velocities"]
        metrics = [f"{c.name} {c.quantity.value} {c.quantity.unit}" for c in self.checks]
        return {
            "section": "differentiable physics",
            "tool": f"drake {self.provenance.packages.get('drake', '?')}, {self.solver.method if self.solver else '-'}",
            "observation": ", ".join(f"{x['name']} [{x['unit']}]" for x in positions),
            "action": ", ".join(f"{x['name']} [{x['unit']}]" for x in self.contract["inputs"]),
            "metric": "; ".join(metrics),
            "perturbation": "none",
        }

    def to_json(self) -> str:
        """The record as JSON with sorted keys; the same record gives the same bytes."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True, indent=2, allow_nan=False) + "\n"


class StateEvidence(_Part):
    """The certificate of one sampled state of a model."""

    kind: Literal["free", "contact"]
    x: list[float]
    u: list[float]
    gradient: GradientEvidence | None
    refusal: str | None = None  # why there is no certificate
    largest: float | None = None  # the largest entry of the derivative
    contact_modes: dict[str, str] = {}  # of the pairs that push each other
    mode_changes: list[str] = []  # within 1e-4 of the state

    @property
    def verdict(self) -> str:
        """The certificate's, or "refused"."""
        return self.gradient.verdict if self.gradient else "refused"


class CertificationRecord(_Part):
    """Certificates of a model at sampled states."""

    schema_version: str = SCHEMA_VERSION
    name: str
    verdict: Literal["pass", "fail", "incomplete"]
    sentence: str
    seed: int
    parameters: list[str]
    contract: dict[str, Any]
    states: list[StateEvidence]
    provenance: Provenance
    wall_clock: WallClock

    def to_json(self) -> str:
        """The record as JSON with sorted keys; the same record gives the same bytes."""
        return json.dumps(self.model_dump(mode="json"), sort_keys=True, indent=2, allow_nan=False) + "\n"
