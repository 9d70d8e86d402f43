"""Which record a directory holds, and how to read it."""

import os
from pathlib import Path

from drake_diff.exceptions import ArtifactError
from drake_diff.record.certification import CertificationRecord
from drake_diff.record.comparison import ComparisonRecord
from drake_diff.record.identification import IdentificationRecord
from drake_diff.record.panel import PanelRecord, PanelTrialRecord, is_trial_file
from drake_diff.record.phases import PhasesRecord
from drake_diff.record.robustness import RobustnessRecord
from drake_diff.record.rollout import RolloutRecord
from drake_diff.record.sealed import SealedRecord, read_fields
from drake_diff.record.solve import EvidenceRecord

KINDS: tuple[type[SealedRecord], ...] = (
    EvidenceRecord,
    ComparisonRecord,
    RobustnessRecord,
    CertificationRecord,
    PhasesRecord,
    RolloutRecord,
    IdentificationRecord,
    PanelRecord,
)


def kind_of(directory: str | Path) -> type[SealedRecord] | None:
    """The class of the record in `directory`, by the record's file name; None where there is none.

    What has that name need not be a plain file: reading it says so.
    """
    return next((kind for kind in KINDS if os.path.lexists(Path(directory) / kind.FILE)), None)


def load_record(directory: str | Path) -> SealedRecord:
    """Read the record in a directory that a solve, a comparison, trials, a certification, an identification, a panel or
    `save_rollout` wrote, or of one trial of a panel.

    It is read, not verified: see `verify`.

    Args:
        directory: The directory that holds record.json, phases.json, comparison.json, robustness.json,
            certification.json, rollout.json, identification.json or panel.json; or trials/ID.json of a panel.

    Returns:
        An `EvidenceRecord`, `PhasesRecord`, `ComparisonRecord`, `RobustnessRecord`, `CertificationRecord`,
        `RolloutRecord`, `IdentificationRecord`, `PanelRecord` or `PanelTrialRecord`.

    Raises:
        ArtifactError: There is no such record, or it does not follow its schema.

    Example:
        >>> record = dd.load_record("artifacts/pendulum_swing_up")
        >>> record.kind, record.verdict, record.solver.method
        ('solve', 'pass', 'shooting')
    """
    if is_trial_file(Path(directory)):
        return PanelTrialRecord.parse(Path(directory), read_fields(Path(directory)))
    kind = kind_of(directory)
    if kind is None:
        names = ", ".join(known.FILE for known in KINDS)
        raise ArtifactError(f"{directory}: no such record; expected a directory with one of {names}")
    return kind.read(directory)
