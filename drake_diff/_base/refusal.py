"""An answer that is not an error: what was asked for is not possible here, and why."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Refusal:
    """Returned in place of a result that cannot be had; the caller takes another way and can say why.

    A function that may refuse returns `Result | Refusal`, and its caller asks `isinstance(found, Refusal)`.
    """

    reason: str  # a sentence without its full stop: "joint elbow is of type planar"

    def __str__(self) -> str:
        return self.reason
