"""Run a panel: from its file to its table, going on where an earlier run was stopped."""

import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from drake_diff._base.arrays import positive_int
from drake_diff.panels.evaluation import TrialFunction, check_engine, evaluate
from drake_diff.panels.panel_file import expand, load_panel
from drake_diff.panels.results import PanelTable, begun_record, ended_record, journal, write_table
from drake_diff.runs.provenance import provenance_of

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
    r"""Evaluate every trial of a panel file in parallel, and write the table and summary of what was found.

    Each finished trial is at once a line of `trials.jsonl`. After a kill or Ctrl-C the same call evaluates only what
    is missing. Table and summary are the same to the byte as without the interruption, for any number of workers and
    for both engines. A trial that raises is a row with the column `error`. `dd.load_record`, `dd.verify` and
    `drake-diff list` take the directory, and the record of each trial in it.

    Args:
        path: the panel, a TOML file; `drake_diff.panels.panel_file` says what stands in it.
        out: the directory to write; artifacts/<name of the file> where None.
        workers: how many processes; None means one for each core.
        engine: "local" (processes of this machine) or "ray".
        address: "HOST:PORT" of a running Ray cluster; None starts one on this machine.
        progress: called with the numbers of finished trials, of all trials and of errors.

    Returns:
        The rows and the summary, as in `table.csv` and `summary.json`.

    Raises:
        InputError: the panel file is wrong, its function cannot be loaded, or `out` holds what no panel wrote.
        ArtifactError: `out` holds another panel or a damaged journal, or another process is writing there.
        MissingDependencyError: Ray is asked for and not installed.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import mkdtemp
        >>> folder = Path(mkdtemp())
        >>> _ = (folder / "trials.py").write_text("def square(trial): return {'cost': trial['x'] ** 2}")
        >>> _ = (folder / "panel.toml").write_text('evaluate = "trials.py:square"\n[axes]\nx = [1, 2, 3]')
        >>> [row["cost"] for row in dd.panels.run_panel(folder / "panel.toml", out=folder / "out", workers=1).rows]
        [1, 4, 9]
    """
    path = Path(path)
    count = None if workers is None else positive_int("workers", workers)
    check_engine(engine, address)
    panel = load_panel(path)
    trials = expand(panel)
    function = TrialFunction(panel.evaluate, str(path.resolve().parent))
    function.load()
    used = provenance_of()
    # What must be the same for two trials to stand in one table.
    made = {
        "sha256": panel.sha256,
        "evaluate": panel.evaluate,
        "function_sha256": function.sha256(),
        "fixed": panel.fixed,
        "python": used.python,
        "platform": used.platform,
        **{name: used.packages.get(name) for name in ("drake", "drake-diff", "numpy")},
    }
    directory = Path(out) if out is not None else Path("artifacts") / path.stem
    start = time.monotonic()
    with journal(directory, made) as book:
        begun = begun_record(directory, len(trials), made)
        begun.begin(directory)
        errors = sum("error" in row for row in book.rows.values())
        left = [trial for trial in trials if trial.id not in book.rows]
        with closing(evaluate(left, function, count, engine, address)) as finished:
            for trial, row in finished:
                book.add(trial.id, row)
                errors += "error" in row
                if progress:
                    progress(len(book.rows), len(trials), errors)
        table = write_table(directory, trials, book.rows, made)
        ended_record(begun, table, time.monotonic() - start).write(directory)
        return table
