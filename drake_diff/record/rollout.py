"""The certificate of a rollout's gradient as one record, with the truth in continuous time where it was asked for."""

from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from drake_diff._base.arrays import finite_array
from drake_diff.certificates.rollout import RolloutCertificate, SampledCertificate
from drake_diff.certificates.truth import TrueSlope, Truth
from drake_diff.exceptions import InputError
from drake_diff.model.model import Model
from drake_diff.record.directory import written_whole
from drake_diff.record.embodiment import embodiment_of
from drake_diff.record.parts import Certified, Part
from drake_diff.record.provenance import gradient_evidence, model_input, provenance_of, written_now
from drake_diff.record.sealed import SealedRecord, WallClock


class SlopeEvidence(Part):
    """One column beside the slope of the motion in continuous time; null is what is not known, or is not there."""

    column: str
    ours: float
    exists: bool | None
    value: float | None
    error: float | None
    sign_agrees: bool | None
    agrees: bool | None
    widths: list[float]  # to both sides
    slopes: list[float]  # over them
    reason: str
    by_other_law: float | None  # what the other law adds to the slope

    @model_validator(mode="after")
    def _has_a_value_where_it_exists(self) -> "SlopeEvidence":
        if bool(self.exists) != (self.value is not None and self.error is not None):
            raise ValueError(f"{self.column}: expected value and error where the slope exists, and only there")
        if not self.exists and not self.reason:
            raise ValueError(f"{self.column}: expected a reason where there is no slope, or none is known")
        return self


class TruthEvidence(Part):
    """The loss and its slopes in continuous time, in `seconds` of work; null is what was not measured in them."""

    law: str
    touches: bool
    loss: float | None
    error: float | None
    ours: float
    other_law: str
    by_other_law: float | None  # what it adds to the loss
    other_reason: str
    notes: list[str]
    seconds: float
    slopes: list[SlopeEvidence]


class RolloutRecord(SealedRecord):
    """The certificate of the gradient of a rollout's loss, with where it was taken."""

    FILE: ClassVar[str] = "rollout.json"

    kind: Literal["rollout"] = "rollout"
    x0: list[float]
    us: list[list[float]]
    loss: float
    columns: list[str]
    derivative: list[float]
    verdicts: list[str]
    certificate: Certified
    truth: TruthEvidence | None = None
    no_truth: str = Field(default="")  # why there is none

    @model_validator(mode="after")
    def _passes_only_what_agrees(self) -> "RolloutRecord":
        if self.verdict == "pass" and not all(v == "agree" for v in (*self.verdicts, self.certificate.verdict)):
            raise ValueError('a verdict "pass" with an entry that does not agree')
        if not len(self.columns) == len(self.derivative) == len(self.verdicts):
            raise ValueError("expected a derivative and a verdict for each column")
        return self

    def facts(self) -> dict[str, str]:
        """How many slopes are the truth."""
        told = {True: "the truth", False: "not the truth", None: "not known, or without a slope"}
        slopes = [told[one.agrees] for one in self.truth.slopes] if self.truth else []
        counts = ", ".join(f"{slopes.count(name)} {name}" for name in dict.fromkeys(slopes))
        return {"columns": counts or self.no_truth or "not compared with the truth", **super().facts()}


def save_rollout(
    certificate: RolloutCertificate | SampledCertificate, model: Model, directory: str | Path
) -> RolloutRecord:
    """Write the certificate of a rollout's gradient, with its truth, as rollout.json.

    Args:
        certificate: What `certify_rollout` gave, not `sampled`.
        model: The model that was rolled out.
        directory: Where to write rollout.json and its schema; an earlier run there is replaced.

    Returns:
        A `RolloutRecord`, whose verdict is "pass" only where every entry agrees.

    Raises:
        InputError: It is no certificate of a whole rollout, the rollout is of another model, or `directory` holds
            what no run wrote.
        WriteError: The disk is full, or does not let `directory` be written.

    Example:
        >>> import tempfile
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> certificate = dd.certify_rollout(model, [0.5, 0], np.zeros((20, 1)), lambda x: x[0], refine=True)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     record = dd.record.save_rollout(certificate, model, folder)
        >>> record.verdict, [slope.sign_agrees for slope in record.truth.slopes]
        ('pass', [True, True, True])
    """
    if not isinstance(certificate, RolloutCertificate):
        expected = "what certify_rollout gives, not sampled"
        raise InputError("certificate", got=type(certificate).__name__, expected=expected)
    motion, count = certificate.gradient, len(certificate.columns)
    finite_array("the certificate's x0", motion.xs[0], (model.nx,))
    agree = certificate.count("agree")
    record = RolloutRecord(
        name=model.name,
        verdict="pass" if certificate.verdict == "agree" else "fail",
        sentence=f"{agree} of {count} entries of the gradient agree",
        x0=_plain(motion.xs[0]),
        us=[_plain(u) for u in motion.us],
        loss=motion.loss,
        columns=list(certificate.columns),
        derivative=_plain(certificate.derivative[0]),
        verdicts=[certificate.entry(0, j).verdict for j in range(count)],
        certificate=gradient_evidence(certificate),
        truth=None if certificate.truth is None else truth_evidence(certificate.truth),
        no_truth=certificate.no_truth,
        model=model_input(model),
        embodiment=embodiment_of(model.contract),
        provenance=provenance_of(),
        wall_clock=WallClock(written_utc=written_now()),
    )
    with written_whole(directory) as folder:
        return record.write(folder)


def truth_evidence(truth: Truth) -> TruthEvidence:
    """A truth as it stands in a record."""
    return TruthEvidence(
        law=truth.law,
        touches=truth.touches,
        loss=_known(truth.loss),
        error=_known(truth.error),
        ours=truth.ours,
        other_law=truth.other_law,
        by_other_law=_known(truth.by_other_law),
        other_reason=truth.other_reason,
        notes=list(truth.notes),
        seconds=truth.seconds,
        slopes=[_slope(one) for one in truth.slopes],
    )


def _slope(one: TrueSlope) -> SlopeEvidence:
    return SlopeEvidence(
        column=one.column,
        ours=one.ours,
        exists=one.exists,
        value=_known(one.value),
        error=_known(one.error),
        sign_agrees=one.sign_agrees,
        agrees=one.agrees,
        widths=list(one.widths),
        slopes=list(one.slopes),
        reason=one.reason,
        by_other_law=_known(one.by_other_law),
    )


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _plain(values: ArrayLike) -> list[float]:
    return [float(value) for value in np.asarray(values, dtype=float).ravel()]
