"""The fields of certification.json.

Certify a whole model: its step's derivatives at seeded states, in free motion and in contact, as one record.
"""

import time
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from drake_diff._base.arrays import positive_int
from drake_diff._base.files import write_whole
from drake_diff.certificates.certify import certify
from drake_diff.derivatives.step import check_method
from drake_diff.exceptions import GradientError, InputError, SimulationError
from drake_diff.model.contact import active_modes
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, select
from drake_diff.model.sampling import SampledState, sample_states
from drake_diff.model.step import advance
from drake_diff.record.parts import Certified, FiniteTable, ModelInput, Part, Provenance, WallClock
from drake_diff.record.provenance import gradient_evidence, model_input, provenance_of, written_now
from drake_diff.record.run_record import canonical

CERTIFICATION_VERSION = "1.0.0"


class StateEvidence(Part):
    """The certificate of one sampled state of a model."""

    kind: Literal["free", "contact"]
    x: list[float]
    u: list[float]
    gradient: Certified | None
    refusal: str | None = None  # why there is no certificate
    largest: float | None = None  # the largest entry of the derivative
    contact_modes: dict[str, str] = Field(default_factory=dict)  # of the pairs that push each other
    mode_changes: list[str] = Field(default_factory=list)  # within 1e-4 of the state

    @property
    def verdict(self) -> str:
        """The certificate's, or "refused"."""
        return self.gradient.verdict if self.gradient else "refused"


class CertificationRecord(Part):
    """Certificates of a model at sampled states."""

    schema_version: str = CERTIFICATION_VERSION
    name: str
    verdict: Literal["pass", "fail", "incomplete"]
    sentence: str
    seed: int
    parameters: list[str]
    model: ModelInput
    contract: FiniteTable
    states: list[StateEvidence]
    provenance: Provenance
    wall_clock: WallClock

    def to_json(self) -> str:
        """The record as canonical JSON: the same record gives the same bytes."""
        return canonical(self.model_dump(mode="json"))


RECORD = "certification.json"


def certify_model(
    model: Model,
    *,
    states: int = 20,
    seed: int = 0,
    parameters: Parameters = (),
    method: str = "auto",
    directory: str | Path | None = None,
) -> CertificationRecord:
    """Certify the step at `states` sampled states, every other one in contact where the model can touch.

    The same seed gives the same states. The record passes where every certificate agrees; given a `directory`,
    it is written there as certification.json, which says "incomplete" until the last state is done.
    """
    start = time.monotonic()
    check_method(method)
    positive_int("states", states)
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError("seed", got=repr(seed), expected="a whole number of at least 0")
    names = [p.name for p in select(model, parameters).parameters]
    found: list[StateEvidence] = []

    def record(verdict: Literal["pass", "fail", "incomplete"], sentence: str) -> CertificationRecord:
        now = written_now()
        made = CertificationRecord(
            name=model.name,
            verdict=verdict,
            sentence=sentence,
            seed=int(seed),
            parameters=names,
            model=model_input(model),
            contract=model.contract.to_dict(),
            states=found,
            provenance=provenance_of(),
            wall_clock=WallClock(written_utc=now, solve_s=time.monotonic() - start),
        )
        if directory is not None:
            Path(directory).mkdir(parents=True, exist_ok=True)
            write_whole(Path(directory) / RECORD, made.to_json().encode())
        return made

    record("incomplete", "the run has begun and not ended: it is under way, or it was killed")
    found += [_certify_state(model, state, parameters, method) for state in sample_states(model, states, int(seed))]
    agree = sum(state.verdict == "agree" for state in found)
    sentence = f"{agree} of {len(found)} sampled states have a certified derivative"
    return record("pass" if agree == len(found) else "fail", sentence)


def _certify_state(model: Model, state: SampledState, parameters: Parameters, method: str) -> StateEvidence:
    modes: dict[str, str] = {}
    point = {"kind": state.kind, "x": state.x.tolist(), "u": state.u.tolist()}
    try:
        advance(model.double, state.x, state.u)
        modes = {" - ".join(pair): mode for pair, mode in sorted(active_modes(model).items())}
        certificate = certify(model, state.x, state.u, parameters=parameters, method=method)
    except (GradientError, SimulationError) as error:
        return StateEvidence(**point, gradient=None, refusal=str(error), contact_modes=modes)
    return StateEvidence(
        **point,
        gradient=gradient_evidence(certificate),
        largest=float(np.abs(certificate.derivative).max(initial=0.0)),
        contact_modes=modes,
        mode_changes=[str(change) for change in certificate.mode_changes],
    )
