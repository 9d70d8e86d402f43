"""A contact table as a few lines per engine and as JSON."""

import json
from dataclasses import asdict

from drake_diff.engines.contact_table import ContactRow, ContactTable


def lines_of(table: ContactTable, engine: str) -> tuple[str, ...]:
    """Which values and gradients of `engine` are the rigid answer's, which its own law's, which neither, and why."""
    rows = [row for row in table.rows if row.engine == engine]
    values = _grouped(rows, {row.case: row.verdict for row in rows})
    gradients = _grouped(rows, {row.case: row.gradient_verdict for row in rows})
    reasons = [f"{row.case}: {row.why}" for row in rows if row.verdict in ("own law's", "off")]
    reasons += [row.why for row in rows if row.verdict in ("falls through", "broke off")][:1]
    reasons += [f"gradient of {row.case}: {row.gradient_why}" for row in rows if row.gradient_verdict in NOT_TO_TRUST]
    reasons += [f"no gradient: {row.gradient_why}" for row in rows if row.gradient_verdict == "none"][:1]
    return (f"values: {values}; gradients: {gradients}", *reasons)


def as_json(table: ContactTable) -> str:
    """Every field of every row, and the engines that have none."""
    return json.dumps(asdict(table), indent=1, allow_nan=False)


NOT_TO_TRUST = ("wrong", "zero")


def _grouped(rows: list[ContactRow], verdicts: dict[str, str]) -> str:
    kinds = list(dict.fromkeys(verdicts.values()))
    return ", ".join(
        f"{verdict} ({', '.join(row.case for row in rows if verdicts[row.case] == verdict)})" for verdict in kinds
    )
