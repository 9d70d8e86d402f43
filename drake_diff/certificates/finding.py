"""What an audit tells: a finding, and the list of them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from drake_diff._base.jupyter import ShowsItsRepr

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")


@dataclass(frozen=True, repr=False)
class Finding(ShowsItsRepr):
    """Something to know before a model is differentiated.

    `severity` is "error" if Drake throws here or the derivative is wrong, "warning" if it may be or a number was not
    chosen, and "info" if it is taken care of or a limit to know. `code` is a stable name of the kind of finding,
    `subject` the part of the model, `message` says what is found and `remedy` what to change. `arguments` are those of
    `load_model` with which the same file has no such finding; empty where the file, x or u has to change.

    Example:
        >>> dd.certificates.Finding("info", "locked_joint", "elbow", "is locked", "unlock it")
        info locked_joint (elbow): is locked
          -> unlock it
    """

    severity: Severity
    code: str
    subject: str
    message: str
    remedy: str
    arguments: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __str__(self) -> str:
        return f"{self.severity} {self.code} ({self.subject}): {self.message}\n  -> {self.remedy}"

    __repr__ = __str__


class Findings(list[Finding], ShowsItsRepr):
    """What an audit found, the worst first: a list that prints one finding below the other."""

    def __str__(self) -> str:
        return "\n".join(map(str, self)) or "nothing found"

    __repr__ = __str__
