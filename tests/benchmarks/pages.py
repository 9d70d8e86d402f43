"""Pages of the documentation that benchmarks write."""

import csv
from pathlib import Path

LONGEST_TABLE = 12  # rows that a page shows


def write_page(path: Path, text: str) -> None:
    """Write a page. A table of more than `LONGEST_TABLE` rows becomes a CSV file, to which the page links.

    The files are in the folder `measured` beside the page: `measured/<page>_<number>.csv`.
    """
    blocks, number = text.split("\n\n"), 0
    for index, block in enumerate(blocks):
        rows = [[cell.strip() for cell in line.strip().strip("|").split(" | ")] for line in block.strip().splitlines()]
        if block.startswith("| ") and len(rows) > LONGEST_TABLE + 2:
            number += 1
            file = path.parent / "measured" / f"{path.stem}_{number}.csv"
            file.parent.mkdir(exist_ok=True)
            with file.open("w", newline="") as stream:
                csv.writer(stream, lineterminator="\n").writerows([rows[0], *rows[2:]])
            blocks[index] = f"[Table of {len(rows) - 2} rows](measured/{file.name}): {', '.join(rows[0])}."
    path.write_text("\n\n".join(blocks).rstrip("\n") + "\n")
