"""The page of figures of the documentation, whose sections benchmarks write."""

import csv
import subprocess
import time
from pathlib import Path

LONGEST_TABLE = 12  # rows that a page shows


def write_section(page: Path, name: str, text: str) -> None:
    """Replace the section between `<!-- name -->` and `<!-- end of name -->` of a page.

    A table of more than `LONGEST_TABLE` rows becomes the file `measured/<name>_<number>.csv` beside the page, to which
    the section links.
    """
    begin, end = f"<!-- {name} -->\n", f"\n<!-- end of {name} -->"
    before, has_begin, rest = page.read_text().partition(begin)
    _, has_end, after = rest.partition(end)
    if not (has_begin and has_end):
        raise SystemExit(f"{page} has no section {name}")
    page.write_text(f"{before}{begin}{with_files(page.parent / 'measured', name, text)}{end}{after}")


def with_files(folder: Path, name: str, text: str) -> str:
    """The text with its long tables as files in the folder."""
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
    """The commit and the day of a measurement."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    return {"commit": commit or "not known", "date": time.strftime("%Y-%m-%d", time.gmtime())}
