"""A panel file in TOML, and the trials that it stands for. It may say:

evaluate = "trials.py:balance"   # a file beside this one, or "package.module:function"
seed = 0
seeds = 20                       # trials of each cell

[axes]                           # every combination of their values is a cell
method = ["ilqr", "shooting"]
level = [0.0, 0.1]

[fixed]                          # the same in all trials
model = "models/pendulum.urdf"

[[cells]]                        # one more cell
method = "none"
"""

import json
import tomllib
from dataclasses import dataclass, field
from hashlib import sha256
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from drake_diff.exceptions import InputError
from drake_diff.runs.fields import FiniteTable

# Names of what drake_diff itself gives each trial; an axis, cell or fixed value cannot have them.
OURS = ("id", "repeat", "seed")
Row = dict[str, Any]  # what came of a trial, in JSON's types


class Panel(BaseModel):
    """What a panel file says."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    evaluate: Annotated[str, Field(pattern=r"^[^:]+:[A-Za-z_]\w*$")]
    seed: Annotated[int, Field(ge=0)] = 0
    seeds: Annotated[int, Field(ge=1)] = 1
    axes: Annotated[FiniteTable, Field(default_factory=dict)]
    fixed: Annotated[FiniteTable, Field(default_factory=dict)]
    cells: Annotated[list[FiniteTable], Field(default_factory=list)]

    @field_validator("axes")
    @classmethod
    def _are_lists(cls, axes: FiniteTable) -> FiniteTable:
        for name, values in axes.items():
            if not isinstance(values, list) or not values:
                raise ValueError(f"axis {name}: expected a list of at least one value, got {values!r}")
        return axes

    @model_validator(mode="after")
    def _names_are_told_apart(self) -> "Panel":
        if not self.axes and not self.cells:
            raise ValueError("expected at least one axis or one of [[cells]], got neither")
        for name in {*self.axes, *(name for cell in self.cells for name in cell)} & {*self.fixed, *OURS}:
            why = "it is in [fixed], or drake_diff gives it to each trial"
            raise ValueError(f"axes and cells: {name} cannot be used: {why}")
        for name in self.fixed.keys() & set(OURS):
            raise ValueError(f"fixed: {name} cannot be used: drake_diff gives it to each trial")
        return self

    @property
    def sha256(self) -> str:
        """The hash of what the file says; comments and the order of its tables do not change it."""
        return sha256(canonical(self.model_dump())).hexdigest()


@dataclass(frozen=True)
class PanelTrial:
    """One trial of a panel: its `cell` (its values on the axes) and `fields`, all that its function is given.

    `fields` are the cell, the fixed values, `repeat` (its number within the cell, from 0) and its own `seed` of 53
    bits, drawn from the panel's seed and all other fields, so that a new value on an axis changes no other trial.
    `id` is the start of the SHA-256 of the fields.
    """

    cell: dict[str, Any]
    fields: dict[str, Any]
    id: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "id", sha256(canonical(self.fields)).hexdigest()[:16])

    @property
    def name(self) -> str:
        """As people read it: `method=ilqr level=0.1 repeat=3`."""
        return f"{cell_name(self.cell)} repeat={self.fields['repeat']}"


def canonical(value: Any) -> bytes:
    """The same value always gives the same JSON: sorted keys, no spaces, no NaN."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def cell_name(cell: dict[str, Any]) -> str:
    """A cell in one line."""
    return " ".join(f"{k}={v if isinstance(v, str) else canonical(v).decode()}" for k, v in cell.items())


def load_panel(path: Path) -> Panel:
    """The panel in the TOML file at `path`; InputError names every wrong entry."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(str(path), got=f"{type(error).__name__}: {error}", expected="a panel in TOML") from error
    try:
        return Panel.model_validate(document)
    except ValidationError as error:
        wrong = []
        for issue in error.errors():
            location = ".".join(str(key) for key in issue["loc"])
            if issue["type"] == "extra_forbidden":
                wrong.append(f"{location}, which is not one of them")
            elif issue["type"] == "missing":
                wrong.append(f"no {location}")
            else:
                got = "" if issue["type"] == "value_error" else f", got {issue['input']!r:.80}"
                wrong.append(f"{location or 'panel'}: {issue['msg'].removeprefix('Value error, ')}{got}")
        expected = f"the fields {', '.join(Panel.model_fields)}"
        raise InputError(str(path), got="; ".join(wrong), expected=expected) from error


def expand(panel: Panel) -> tuple[PanelTrial, ...]:
    """Every trial: the axes' combinations (the last axis fastest), then the cells, each `panel.seeds` times."""
    axes: dict[str, Any] = panel.axes
    combinations = product(*axes.values()) if axes else ()
    cells = [*(dict(zip(axes, values, strict=True)) for values in combinations), *panel.cells]
    trials: dict[str, PanelTrial] = {}
    for cell, repeat in product(cells, range(panel.seeds)):
        fields = {**panel.fixed, **cell, "repeat": repeat}
        words = np.frombuffer(sha256(canonical(fields)).digest(), "<u4")
        state = np.random.SeedSequence([panel.seed, *words.tolist()]).generate_state(1, np.uint64)
        trial = PanelTrial(cell, {**fields, "seed": int(state[0]) >> 11})
        if trial.id in trials:
            raise InputError("axes and cells", got=f"{cell_name(cell)} twice", expected="each cell once")
        trials[trial.id] = trial
    return tuple(trials.values())
