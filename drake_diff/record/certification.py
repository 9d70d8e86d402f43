"""Certify a whole model: its step's derivatives at sampled states, in free motion and in contact, as one record."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from drake_diff._base.arrays import positive_int
from drake_diff._base.files import write_whole
from drake_diff.certificates.certify import certify
from drake_diff.derivatives.sources import check_method
from drake_diff.exceptions import GradientError, InputError, SimulationError
from drake_diff.model.contact import active_modes
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, select
from drake_diff.model.sampling import SampledState, sample_states
from drake_diff.model.step import advance
from drake_diff.record.directory import written_whole
from drake_diff.record.embodiment import embodiment_of
from drake_diff.record.parts import Certified, FiniteTable, Part
from drake_diff.record.provenance import gradient_evidence, model_input, provenance_of, written_now
from drake_diff.record.sealed import Passed, SealedRecord, WallClock


class CertifiedState(Part):
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


class CertificationRecord(SealedRecord):
    """Certificates of a model at sampled states, and all that it takes to take them again."""

    FILE: ClassVar[str] = "certification.json"

    kind: Literal["certification"] = "certification"
    seed: int
    method: str
    parameters: list[str]
    contract: FiniteTable
    states: list[CertifiedState]

    @model_validator(mode="after")
    def _passes_only_what_agrees(self) -> "CertificationRecord":
        if self.verdict == "pass" and not (self.states and all(state.verdict == "agree" for state in self.states)):
            raise ValueError('a verdict "pass" with a state whose certificate does not agree, or with no state at all')
        return self

    def facts(self) -> dict[str, str]:
        """How many states have which verdict."""
        verdicts = [state.verdict for state in self.states]
        counts = ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in dict.fromkeys(verdicts))
        return {"states": counts or "none yet", "seed": str(self.seed), "method": self.method, **super().facts()}


def certify_model(
    model: Model,
    *,
    states: int = 20,
    seed: int = 0,
    parameters: Parameters = (),
    method: str = "auto",
    directory: str | Path | None = None,
) -> CertificationRecord:
    """Certify the derivatives of the step at sampled states, every other one in contact where the model can touch.

    The same seed gives the same states, so that `verify` can take the certificates again.

    Args:
        model: The model to certify.
        states: How many states to sample.
        seed: Seed of the states.
        parameters: Names of parameters whose derivatives are certified too.
        method: How the derivative is taken: "auto", "autodiff", "implicit", "analytic" or "finite_difference".
        directory: Where to write certification.json and a copy of the model file; nothing is written without one. An
            earlier run there is replaced when the last state is done.

    Returns:
        A `CertificationRecord`, whose verdict is "pass" only where every certificate agrees.

    Raises:
        InputError: `states`, `seed`, `parameters` or `method` is not one that can be used, or `directory` holds what
            no run wrote.
        WriteError: The disk is full, or does not let `directory` be written.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> print(dd.record.certify_model(model, states=2))
        pendulum: pass, 2 of 2 sampled states have a certified derivative
    """
    start = time.monotonic()
    check_method(method)
    positive_int("states", states)
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError("seed", got=repr(seed), expected="a whole number of at least 0")
    names = [p.name for p in select(model, parameters).parameters]

    def record(verdict: Passed, sentence: str, found: Sequence[CertifiedState] = ()) -> CertificationRecord:
        return CertificationRecord(
            name=model.name,
            verdict=verdict,
            sentence=sentence,
            seed=int(seed),
            method=method,
            parameters=names,
            model=model_input(model),
            embodiment=embodiment_of(model.contract),
            contract=model.contract.to_dict(),
            states=list(found),
            provenance=provenance_of(),
            wall_clock=WallClock(written_utc=written_now(), duration_s=time.monotonic() - start),
        )

    def certified() -> CertificationRecord:
        found = [_certify_state(model, state, parameters, method) for state in sample_states(model, states, int(seed))]
        agree = sum(state.verdict == "agree" for state in found)
        sentence = f"{agree} of {len(found)} sampled states have a certified derivative"
        return record("pass" if agree == len(found) else "fail", sentence, found)

    if directory is None:
        return certified().sealed()
    with written_whole(directory) as folder:
        sentence = "the run has started and not finished: it is still running, or it was killed"
        record("incomplete", sentence).begin(folder)
        made = certified()
        if model.source is not None and made.model.file is not None:
            write_whole(folder / model.source.name, model.source.read_bytes())  # to certify it again
        return made.write(folder)


def _certify_state(model: Model, state: SampledState, parameters: Parameters, method: str) -> CertifiedState:
    modes: dict[str, str] = {}
    point = {"kind": state.kind, "x": state.x.tolist(), "u": state.u.tolist()}
    try:
        advance(model.double, state.x, state.u)
        modes = {" - ".join(pair): mode for pair, mode in sorted(active_modes(model).items())}
        certificate = certify(model, state.x, state.u, parameters=parameters, method=method)
    except (GradientError, SimulationError) as error:
        return CertifiedState(**point, gradient=None, refusal=str(error), contact_modes=modes)
    return CertifiedState(
        **point,
        gradient=gradient_evidence(certificate),
        largest=float(np.abs(certificate.derivative).max(initial=0.0)),
        contact_modes=modes,
        mode_changes=[str(change) for change in certificate.mode_changes],
    )
