"""Write the results of benchmarks into sections of a documentation page."""

import csv
import subprocess
import time
from pathlib import Path

LONGEST_TABLE = 12  # largest number of rows in a page


def write_section(page: Path, name: str, text: str) -> None:
    """Replace the section between `<!-- name -->` and `<!-- end of name -->` of a page.

    A table of more than `LONGEST_TABLE` rows is written to `measured/<name>_<number>.csv` in the page's folder, and the
    section links to this file.
    """
    begin, end = f"<!-- {name} -->\n", f"\n<!-- end of {name} -->"
    before, has_begin, rest = page.read_text().partition(begin)
    _, has_end, after = rest.partition(end)
    if not (has_begin and has_end):
        raise SystemExit(f"{page} has no section {name}")
    page.write_text(f"{before}{begin}{with_files(page.parent / 'measured', name, text)}{end}{after}")


def with_files(folder: Path, name: str, text: str) -> str:
    """Write the long tables of a text to files in the folder, and return the text with links to them."""
    blocks, number = text.strip("\n").split("\n\n"), 0
    for index, block in enumerate(blocks):
        rows = [[cell.strip() for cell in line.strip().strip("|").split(" | ")] for line in block.strip().splitlines()]
        if block.startswith("| ") and len(rows) > LONGEST_TABLE + 2:
            number += 1
            file = folder / f"{name}_{number}.csv"
            folder.mkdir(exist_ok=True)
            with file.open("w", newline="") as stream:
                csv.writer(stream, lineterminator="\n").writerows([rows[0], *rows[2:]])
            blocks[index] = f"[Table of {len(rows) - 2} rows]({folder.name}/{file.name}): {', '.join(rows[0])}."
    return "\n\n".join(blocks)


def marked() -> dict[str, str]:
    """Return the current commit and date, to record them with a measurement."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    return {"commit": commit or "not known", "date": time.strftime("%Y-%m-%d", time.gmtime())}
