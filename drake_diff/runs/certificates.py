"""Certify the derivatives of a model's step at sampled states and write a record."""

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drake_diff._base.arrays import LARGEST_SEED, count, positive_int
from drake_diff._base.files import write_whole
from drake_diff.certificates.certify import certify
from drake_diff.derivatives.sources import check_method
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.model.contact import active_modes
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, select
from drake_diff.model.step import advance
from drake_diff.model.tangent import SampledState, sample_states
from drake_diff.runs.directory import written_whole
from drake_diff.runs.fields import Passed
from drake_diff.runs.plan_record import CertificationSection, CertifiedState, PlanRecord
from drake_diff.runs.provenance import contract_of, gradient_evidence, header, write_bundle


def certify_model(
    model: Model,
    *,
    states: int = 20,
    seed: int = 0,
    parameters: Parameters = (),
    method: str = "auto",
    directory: str | Path | None = None,
) -> PlanRecord:
    """Certify the step's derivatives at sampled states; every second state is in contact if contact is possible.

    The same seed gives the same states, so `verify` can repeat the certificates.

    Args:
        model: The model to certify.
        states: Number of sampled states.
        seed: Seed of the states.
        parameters: Names of the parameters whose derivatives are certified too.
        method: Derivative method: "auto", "autodiff", "implicit", "analytic" or "finite_difference".
        directory: Directory for record.json and a copy of the model's files; nothing is written if it is None. An
            earlier run in it is replaced after the last state.

    Returns:
        A `PlanRecord`. Its verdict is "pass" only if every certificate agrees.

    Raises:
        InputError: `states`, `seed`, `parameters` or `method` is invalid, or `directory` contains files that no run
            wrote.
        WriteError: `directory` cannot be written, for example because the disk is full.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> from drake_diff.runs import certify_model
        >>> print(certify_model(model, states=2))
        pendulum: pass, 2 of 2 sampled states have a certified derivative
    """
    start = time.monotonic()
    check_method(method)
    positive_int("states", states)
    seed = count("seed", seed, 0, LARGEST_SEED)
    names = [p.name for p in select(model, parameters).parameters]

    def record(verdict: Passed, sentence: str, certified: Sequence[CertifiedState] = ()) -> PlanRecord:
        section = CertificationSection(seed=seed, method=method, parameters=names, states=list(certified))
        fields = header(model.name, model, time.monotonic() - start)
        contract = contract_of(model)
        return PlanRecord(verdict=verdict, sentence=sentence, certification=section, contract=contract, **fields)

    def certified() -> PlanRecord:
        rows = [_certify_state(model, state, parameters, method) for state in sample_states(model, states, seed)]
        agree = sum(row.verdict == "agree" for row in rows)
        sentence = f"{agree} of {len(rows)} sampled states have a certified derivative"
        return record("pass" if agree == len(rows) else "fail", sentence, rows)

    if directory is None:
        return certified().sealed()
    with written_whole(directory) as folder:
        sentence = "the run has started and not finished: it is still running, or it was killed"
        record("incomplete", sentence).begin(folder)
        made = certified()
        if model.source is not None and made.model.file is not None:
            write_whole(folder / model.source.name, model.source.read_bytes())  # for repeated certification
            write_bundle(folder, model)
        return made.write(folder)


def _certify_state(model: Model, state: SampledState, parameters: Parameters, method: str) -> CertifiedState:
    modes: dict[str, str] = {}
    point = {"kind": state.kind, "x": state.x.tolist(), "u": state.u.tolist()}
    try:
        advance(model.double, state.x, state.u)
        modes = {" - ".join(pair): mode for pair, mode in sorted(active_modes(model).items())}
        certificate = certify(model, state.x, state.u, parameters=parameters, method=method, thorough=True)
    except (GradientError, SimulationError) as error:
        return CertifiedState(**point, gradient=None, refusal=str(error), contact_modes=modes)
    return CertifiedState(
        **point,
        gradient=gradient_evidence(certificate),
        largest=float(np.abs(certificate.derivative).max(initial=0.0)),
        contact_modes=modes,
        mode_changes=[str(change) for change in certificate.mode_changes],
    )
