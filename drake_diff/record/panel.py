"""The fields of panel.json, and of the record of each trial in trials/ID.json."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field, model_validator

from drake_diff.record.parts import FiniteTable, ModelInput, Provenance
from drake_diff.record.sealed import SealedRecord, WallClock

PACKAGES = ("drake", "drake-diff", "numpy")  # whose versions two trials of one table share
TRIALS = "trials"  # the directory of the records of trials, in that of their panel
NOT_JUDGED = "it ran, and does not say whether it is a success"


class PanelTrialRecord(SealedRecord):
    """One trial of a panel: what it was given, what came out, of which panel.

    It is the same, byte for byte, whichever engine, worker and call of the panel evaluated it: no time is in it.
    `id` is the start of the SHA-256 of `inputs`. The verdict is "fail" of an error and of a `success` that is false.
    """

    FILE: ClassVar[str] = "trial.json"  # of the schema alone: trials are ID.json

    kind: Literal["trial"] = "trial"
    id: str
    cell: FiniteTable
    inputs: FiniteTable
    result: FiniteTable
    panel: FiniteTable

    @model_validator(mode="after")
    def _is_judged_by_its_result(self) -> "PanelTrialRecord":
        verdict, sentence = judged(self.result)
        if (self.verdict, self.sentence) != (verdict, sentence):
            raise ValueError(
                f'a verdict "{self.verdict}, {self.sentence}" where the result says "{verdict}, {sentence}"'
            )
        return self

    def facts(self) -> dict[str, str]:
        """What came out."""
        return {name: str(value) for name, value in self.result.items()}


class PanelRecord(SealedRecord):
    """Many trials from one file; "pass" where none ended in an error. Each trial has a record of its own in trials/."""

    FILE: ClassVar[str] = "panel.json"

    kind: Literal["panel"] = "panel"
    panel: FiniteTable  # what must be the same for two trials to stand in one table
    trials: int
    errors: int | None  # null while trials are missing
    ranked_by: str = ""
    ranking: list[FiniteTable] = Field(default_factory=list)  # a row for each cell, the best first

    @model_validator(mode="after")
    def _passes_only_without_errors(self) -> "PanelRecord":
        if self.verdict == "pass" and self.errors != 0:
            raise ValueError(f'a verdict "pass" with {self.errors} errors')
        return self

    def facts(self) -> dict[str, str]:
        """How many trials, and the best cell."""
        best = {"best": str(self.ranking[0]["name"])} if self.ranking else {}
        return {"trials": f"{self.trials}, {self.errors} errors", **best, **super().facts()}


def judged(result: Mapping[str, Any]) -> tuple[Literal["pass", "fail"], str]:
    """The verdict of a trial by its row, and why."""
    if "error" in result:
        return "fail", f"it ended in an error: {result['error']}"
    if isinstance(result.get("success"), bool):
        return ("pass", "it is a success") if result["success"] else ("fail", "it is no success")
    return "pass", NOT_JUDGED


def no_model() -> ModelInput:
    """Of a panel: its function makes the models."""
    return ModelInput(file=None, options=None)


def trial_record(
    trial: str, name: str, cell: FiniteTable, inputs: FiniteTable, result: FiniteTable, panel: Mapping[str, Any]
) -> PanelTrialRecord:
    """The sealed record of one trial; of the versions it has those that `panel` has."""
    verdict, sentence = judged(result)
    packages = {key: str(panel[key]) for key in PACKAGES if panel.get(key)}
    return PanelTrialRecord(
        name=name,
        verdict=verdict,
        sentence=sentence,
        id=trial,
        cell=cell,
        inputs=inputs,
        result=result,
        panel=dict(panel),
        model=no_model(),
        provenance=Provenance(
            python=str(panel["python"]), platform=str(panel["platform"]), packages=packages, git=None, command=[]
        ),
        wall_clock=WallClock(written_utc=""),
    ).sealed()


def is_trial_file(path: Path) -> bool:
    """Whether `path` can be the record of a trial of a panel: ID.json in trials/."""
    return path.parent.name == TRIALS and re.fullmatch(r"[0-9a-f]{16}\.json", path.name) is not None and path.is_file()
