"""With what a record was made: packages, commit, command, model file; and what it says of a certificate."""

import platform
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

from drake_diff.certificate import VERDICTS, Certificate
from drake_diff.model import Model
from drake_diff.named_files import file_evidence, named_files
from drake_diff.record_parts import Certified, ModelInput, Provenance

PACKAGES = (
    "drake",
    "drake-diff",
    "numpy",
    "casadi",
    "mcap",
    "mcap-protobuf-support",
    "protobuf",
    "foxglove-schemas-protobuf",
    "pydantic",
)


def gradient_evidence(certificate: Certificate) -> Certified:
    """A certificate as it stands in a record."""
    return Certified(
        subject=certificate.subject,
        method=certificate.method,
        verdict=certificate.verdict,
        entries=int(certificate.codes.size),
        counts={v: certificate.count(v) for v in VERDICTS},
        worst=str(certificate.worst) if certificate.codes.size else None,
    )


def model_input(model: Model) -> ModelInput:
    """The model file with what it names, and the options it was loaded with."""
    source, options = model.source, model.options
    if source is None or options is None:
        return ModelInput(file=None, options=None)
    plain = {key: v if v is None or isinstance(v, str) else np.asarray(v).tolist() for key, v in options.items()}
    return ModelInput(file=file_evidence(source, source.name), named=named_files(source), options=plain)


def written_now() -> str:
    """The wall clock, for the part of a record that differs from run to run."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def provenance_of() -> Provenance:
    """With which versions, from which commit and by which command something is made."""
    return Provenance(
        python=platform.python_version(),
        platform=f"{platform.system()} {platform.machine()}",
        packages={name: found for name in PACKAGES if (found := _version(name))},
        git=_git(),
        command=[_text(word) for word in (Path(sys.argv[0]).name, *sys.argv[1:])],
    )


def _text(word: str) -> str:
    """Without the bytes of a file name that are no text."""
    return word.encode("utf-8", "replace").decode()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _git() -> dict[str, str | bool] | None:
    """Commit and dirty flag of the working directory, None where it is no git checkout or there is no git."""
    try:
        run = [
            subprocess.run(["git", *words], capture_output=True, text=True, timeout=10, check=True).stdout.strip()
            for words in (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"])
        ]
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": run[0], "dirty": bool(run[1])}
