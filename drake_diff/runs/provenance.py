"""The provenance of a record: packages, commit, command, and the model file with all files that it names.

The named files (meshes, included models, licences) are copied into the run directory under the hashes of their
contents. A record refers to them by the model file's names. Only its provenance contains the original paths.
"""

import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from drake_diff._base.files import make_folder, write_whole
from drake_diff._base.sandbox import LARGEST_ANSWER
from drake_diff.certificates.certificate import VERDICTS, Certificate
from drake_diff.exceptions import InputError
from drake_diff.model.model import Model, stated_options
from drake_diff.model.named_files import LAID_OUT, NamedFile, is_portable, named_files
from drake_diff.runs.fields import (
    BUNDLE,
    Certified,
    FileEvidence,
    ModelInput,
    Provenance,
    WallClock,
    evidence,
    file_evidence,
)

MOST_BUNDLED = LARGEST_ANSWER  # [bytes] largest file to copy: the limit of the child process, which writes it again
WRITERS = ("mcap", "mcap-protobuf-support", "protobuf", "foxglove-schemas-protobuf", "pydantic")
TRACKED = ("--porcelain", "--untracked-files=no", "--ignore-submodules=all")
LONGEST_PATH = 4096
PACKAGES = ("drake", "drake-diff", "numpy", "casadi", "pin", "numba", "mujoco", *WRITERS)


def gradient_evidence(certificate: Certificate) -> Certified:
    """Convert a certificate to a section of a record."""
    return evidence(
        Certified,
        certificate,
        entries=int(certificate.codes.size),
        counts={v: certificate.count(v) for v in VERDICTS},
        worst=str(certificate.worst) if certificate.codes.size else None,
    )


def header(name: str, model: Model | None = None, seconds: float | None = None, **clock: Any) -> dict[str, Any]:
    """Return the fields of every record: its name and model, the versions, the time of writing, and the duration.

    Raises:
        InputError: A name cannot be encoded in UTF-8, the encoding of a run's files and pages.
    """
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {
        "name": _checked_name("name", name),
        "model": model_input(model),
        "provenance": provenance_of(model),
        "wall_clock": WallClock(written_utc=now, duration_s=seconds, **clock),
    }


def model_input(model: Model | None) -> ModelInput:
    """Return the model file with the files that it names, and the options with which it was loaded."""
    if model is None or model.source is None or model.options is None:
        return ModelInput(file=None, options=None)
    options = {name: value for name, value in model.options.items() if name != "packages"}
    return ModelInput(
        file=file_evidence(model.source, _checked_name("model file", model.source.name)),
        named=evidence_of(model.source, model.options["packages"]),
        options=stated_options(options),
    )


def _checked_name(subject: str, name: str) -> str:
    try:
        name.encode()
    except UnicodeEncodeError as error:
        raise InputError(subject, got=ascii(name), expected="a name in UTF-8") from error
    return name


def contract_of(model: Model | None) -> dict[str, Any]:
    """Return the contract of a model for a record, with names of files instead of their paths."""
    if model is None:
        return {}
    contract = model.contract.to_dict()
    if model.source is None:
        return contract
    paths = [model.source, *(file.path for file in _files_of(model) if file.path)] if contract["notes"] else []
    names = {str(location): path.name for path in paths for location in (path, path.absolute(), path.resolve())}
    notes = [_with_names(str(note), names) for note in contract["notes"]]
    return {**contract, "source": model.source.name, "notes": notes}


def _with_names(note: str, names: dict[str, str]) -> str:
    for location in sorted(names, key=lambda location: (-len(location), location)):
        note = note.replace(location, names[location])
    return note


def _files_of(model: Model) -> list[NamedFile]:
    if model.source is None or model.options is None:
        return []
    return named_files(model.source, model.options["packages"])


def evidence_of(path: Path, packages: Mapping[str, str] | None) -> list[FileEvidence]:
    """Return the files that the model file at `path` names, sorted by name; `packages` is as in `load_model`."""
    return [_evidence(file) for file in named_files(path, packages)]


def _evidence(file: NamedFile) -> FileEvidence:
    try:
        if file.path is not None:
            return file_evidence(file.path, file.name)
        reason = file.reason
    except OSError as error:
        reason = f"it cannot be read: {error.strerror}"
    return FileEvidence(path=file.name, bytes=None, sha256=None, reason=reason)


def write_bundle(folder: Path, *models: Model | None, meshes: bool = True) -> None:
    """Copy the files that `models` name into the run directory `folder`; meshes only if `meshes` is true.

    Files that are larger than MOST_BUNDLED, or are named by an absolute path, are not copied.
    """
    for file in (file for model in models if model is not None for file in _files_of(model)):
        described = _evidence(file)
        size, target = described.bytes, folder / BUNDLE / str(described.sha256)
        if file.path is None or size is None or size > MOST_BUNDLED or not is_portable(file.name):
            continue
        if not target.exists() and (meshes or not file.is_mesh):
            make_folder(target.parent)
            write_whole(target, file.path.read_bytes())


def packages_here() -> dict[str, str]:
    """Return the versions of the installed packages."""
    packages = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            packages[name] = version(name)
    return packages


def provenance_of(model: Model | None = None) -> Provenance:
    """Return the versions, the commit and the command of this process, and the path of its model."""
    words = (Path(sys.argv[0]).name, *sys.argv[1:])
    source, options = (None, None) if model is None else (model.source, model.options)
    if source is not None and any(name.startswith(LAID_OUT) for name in source.parts):
        source, options = None, None  # the temporary files of a run that was recalled
    return Provenance(
        model_file=None if source is None else _text(str(source)),
        model_packages=dict((options or {}).get("packages") or {}),
        python=platform.python_version(),
        platform=f"{platform.system()} {platform.machine()}",
        packages=packages_here(),
        git=_git(),
        command=[_text(word) for word in words],
    )


def _text(word: str) -> str:
    return word.encode("utf-8", "replace").decode()  # file names may contain bytes that are not UTF-8


def _git() -> dict[str, str | bool] | None:
    """Return the commit of the working directory, and whether tracked files differ; None if git cannot be read.

    Settings of a checkout can name commands (`core.fsmonitor`, filters, hooks). Git therefore reads the references and
    objects through a folder with our own settings, and ignores all other settings.
    """
    here = Path.cwd()
    root = next((folder for folder in (here, *here.parents) if (folder / ".git").exists()), None)
    if root is None:
        return None
    try:
        with tempfile.TemporaryDirectory(prefix="drake_diff_") as name:
            git = _git_folder(root, Path(name))
            return {"commit": git("rev-parse", "HEAD"), "dirty": bool(git("status", *TRACKED))}
    except (OSError, subprocess.SubprocessError):
        return None


def _git_folder(root: Path, folder: Path) -> Callable[..., str]:
    """Make `folder` a git folder of the checkout `root` without its settings, and return a function that runs git."""
    source = root / ".git"
    if source.is_file():
        source = root / _short_text(source).removeprefix("gitdir:").strip()  # of a worktree or a submodule
    common = source / _short_text(source / "commondir")
    for name in ("objects", "refs", "packed-refs"):
        (folder / name).symlink_to((common / name).absolute())
    (folder / "index").symlink_to((source / "index").absolute())
    (folder / "HEAD").write_text(f"{_short_text(source / 'HEAD')}\n")
    (folder / "config").write_text("[core]\nrepositoryformatversion = 0\nbare = false\n")
    environment = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    environment |= {"GIT_CONFIG_GLOBAL": os.devnull, "GIT_CONFIG_SYSTEM": os.devnull}

    def run(*words: str) -> str:
        command = ["git", "--no-optional-locks", f"--git-dir={folder}", f"--work-tree={root}", *words]
        options: dict[str, Any] = {"capture_output": True, "text": True, "errors": "replace", "env": environment}
        return subprocess.run(command, cwd=root, timeout=10, check=True, **options).stdout.strip()

    return run


def _short_text(path: Path) -> str:
    """Return the text of a small file without line ends, or "" if it is not a regular file."""
    if not path.is_file():
        return ""
    with path.open(errors="replace") as file:
        return file.read(LONGEST_PATH).strip()
