"""A panel evaluated: from its file to its table, taken up again where it was left."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

from drake_diff._base.arrays import positive_int
from drake_diff.panels.journal import journal
from drake_diff.panels.panel_file import Panel, expand, load_panel
from drake_diff.panels.table import PanelTable, write_table
from drake_diff.panels.trial_row import TrialFunction
from drake_diff.panels.workers import check_engine, evaluate_all
from drake_diff.record.provenance import provenance_of

Progress = Callable[[int, int, int], None]


def run_panel(
    path: str | Path,
    *,
    out: str | Path | None = None,
    workers: int | None = None,
    engine: str = "local",
    address: str | None = None,
    progress: Progress | None = None,
) -> PanelTable:
    """Evaluate all trials of the panel file at `path` and write `table.csv` and `summary.json` into `out`.

    Each finished trial is a line of `trials.jsonl` there: after a kill the same call evaluates what is missing, and the
    table is the same to the byte, as it is for any number of `workers` (processes; all cores where None) and for both
    engines, "local" and "ray" (the cluster at `address` "HOST:PORT", or one of this machine). `out` is
    artifacts/<name of the file> where not given. `progress` is called with the numbers of finished trials, of all, and
    of errors. A script calls this below `if __name__ == "__main__":`, as every worker imports it.

    Raises InputError for a panel that cannot be right, ArtifactError where `out` holds another panel or a damaged
    journal, MissingDependencyError where Ray is not there.
    """
    path = Path(path)
    count = None if workers is None else positive_int("workers", workers)
    check_engine(engine, address)
    panel = load_panel(path)
    trials = expand(panel)
    function = TrialFunction(panel.evaluate, str(path.resolve().parent))
    function.load()
    made = _made(panel, function)
    directory = Path(out) if out is not None else Path("artifacts") / path.stem
    with journal(directory, made, {trial.id for trial in trials}) as book:
        errors = sum("error" in row for row in book.rows.values())
        left = [trial for trial in trials if trial.id not in book.rows]
        with closing(evaluate_all(left, function, count, engine, address)) as finished:
            for trial, row in finished:
                book.add(trial.id, row)
                errors += "error" in row
                if progress:
                    progress(len(book.rows), len(trials), errors)
        return write_table(directory, trials, book.rows, made)


def _made(panel: Panel, function: TrialFunction) -> dict[str, Any]:
    """What must be the same for two trials to stand in one table."""
    used = provenance_of()
    versions = {name: used.packages.get(name) for name in ("drake", "drake-diff", "numpy")}
    return {
        "sha256": panel.sha256,
        "evaluate": panel.evaluate,
        "function_sha256": function.sha256(),
        "fixed": panel.fixed,
        "python": used.python,
        "platform": used.platform,
        **versions,
    }
