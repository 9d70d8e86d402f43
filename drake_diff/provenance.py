"""With what a record was made: packages, commit, command, model file; and what it says of a file or a certificate."""

import platform
import subprocess
import sys
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from drake_diff.certificate import VERDICTS, Certificate
from drake_diff.model import Model
from drake_diff.record import FileEvidence, GradientEvidence, Provenance

PACKAGES = ("drake", "drake-diff", "numpy", "mcap", "protobuf", "foxglove-schemas-protobuf", "pydantic")


def file_evidence(path: Path, name: str) -> FileEvidence:
    """Size and hash of the file at `path`, under the name it has in the record."""
    data = path.read_bytes()
    return FileEvidence(path=name, bytes=len(data), sha256=sha256(data).hexdigest())


def gradient_evidence(certificate: Certificate) -> GradientEvidence:
    """A certificate as it stands in a record."""
    return GradientEvidence(
        subject=certificate.subject,
        method=certificate.method,
        verdict=certificate.verdict,
        entries=int(certificate.codes.size),
        counts={v: certificate.count(v) for v in VERDICTS},
        worst=str(certificate.worst) if certificate.codes.size else None,
    )


def provenance_of(model: Model) -> Provenance:
    """With which versions, from which commit, model file and command something is made."""
    source = model.source
    return Provenance(
        python=platform.python_version(),
        platform=f"{platform.system()} {platform.machine()}",
        packages={name: found for name in PACKAGES if (found := _version(name))},
        git=_git(),
        command=[Path(sys.argv[0]).name, *sys.argv[1:]],
        model_file=file_evidence(source, source.name) if source is not None else None,
    )


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
