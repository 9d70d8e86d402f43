"""One trial of a saved run, as the function that panels call: "drake_diff.trials.panel_trial:evaluate"."""

import atexit
from collections.abc import Mapping
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from typing import Any

from drake_diff.exceptions import InputError
from drake_diff.runs.verify import recalled
from drake_diff.trials.perturbation import perturbation_named
from drake_diff.trials.trial import Task, run_trial
from drake_diff.trials.trial_files import result_of

FIELDS = {"run": str, "controller": str, "perturbation": str, "level": (int, float), "seed": int}
_open = ExitStack()  # keeps the models of the runs as long as the process lives
atexit.register(_open.close)


def evaluate(trial: Mapping[str, Any]) -> dict[str, Any]:
    """Run the plan of the run directory `trial["run"]` once and judge it; the same fields give the same row.

    `trial` has run, controller ("tvlqr", "mpc", "open_loop"), perturbation, level (0: unperturbed) and seed. Other
    fields are ignored, so that a trial.json will do. The row is JSON: success, label (None for a success), goal_error,
    displacement of the last state (None where it is not finite or the run broke off), failures and ended. The run is
    read once per process. Raises InputError, UnknownNameError, and ArtifactError where the run is damaged.
    """
    for name, kind in FIELDS.items():
        value = trial.get(name)
        if not isinstance(value, kind) or isinstance(value, bool):  # type: ignore[arg-type]
            raise InputError(f"trial: {name}", got=repr(value), expected=f"one of the fields {', '.join(FIELDS)}")
    name, level, seed = trial["perturbation"], trial["level"], trial["seed"]
    perturbation_named(name)
    if seed < 0:
        raise InputError("trial: seed", got=seed, expected="a whole number of at least 0")
    task = _task(str(Path(trial["run"]).resolve()), trial["controller"])
    return result_of(run_trial(task, {name: level}, seed))


@cache
def _task(run: str, controller: str) -> Task:
    # The panel file is the user's, and so is the run that it names.
    return Task(_open.enter_context(recalled(run, models="/", trusted=True)).plan, controller)
