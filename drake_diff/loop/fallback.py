"""What a loop does where its controller cannot be followed: hold, damp or stop, until it can be again."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from drake_diff.arrays import Array
from drake_diff.exceptions import UnknownNameError
from drake_diff.loop.checks import count
from drake_diff.model import Model
from drake_diff.policy import PD

MODES = ("hold", "damp", "stop")


@dataclass(frozen=True, eq=False)
class Fallback:
    """It takes over where the controller fails, or nothing was seen for more than `patience` steps.

    hold: the last command; damp: -damping v at the actuated joints [N s/m or N m s/rad], of the estimate; stop: no
    effort.
    """

    mode: Literal["hold", "damp", "stop"] = "stop"
    patience: int = 10
    damping: ArrayLike = 1.0

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise UnknownNameError("Fallback.mode", got=self.mode, known=MODES)
        count("Fallback.patience", self.patience, 0)

    def command(self, model: Model, estimate: Array, last: Array) -> Array:
        """(nu,) in place of the controller's."""
        if self.mode == "hold":
            return last
        if self.mode == "stop" or not model.nu:
            return np.zeros(model.nu)
        at_rest = np.concatenate([estimate[: model.nq], np.zeros(model.nv)])
        return np.asarray(PD(model, 0.0, self.damping, x_ref=at_rest)(estimate, 0.0))
