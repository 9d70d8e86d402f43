"""A table of cases as one test. Every row is checked, and each row that fails is named."""

import contextlib
import functools
import inspect

import pytest

KEYWORD = inspect.Parameter.KEYWORD_ONLY


def each_row(names, rows, *, ids=None):
    """Return a decorator like `pytest.mark.parametrize`, for one test of all rows; two tables form their product.

    The rows share the test's fixtures, but each has its own directory (`tmp_path`) and patches (`monkeypatch`).
    """
    table = named_rows([name.strip() for name in names.split(",")], list(rows), ids)

    def decorate(function):
        check, inner = getattr(function, "table", (function, [("", {})]))
        product = [(f"{a}; {b}" if b else a, outer | of_inner) for a, outer in table for b, of_inner in inner]
        parameters = inspect.signature(check).parameters
        if missing := set(product[0][1]) - set(parameters):
            raise TypeError(f"{check.__name__} takes no {sorted(missing)}")

        @functools.wraps(check)
        def test(subtests, **fixtures):
            for number, (name, values) in enumerate(product):
                with subtests.test(msg=name), fixtures_of_a_row(fixtures, number) as own:
                    check(**own, **values)

        fixtures = ["subtests", *[name for name in parameters if name not in product[0][1]]]
        test.__signature__ = inspect.Signature([inspect.Parameter(name, KEYWORD) for name in fixtures])
        test.table = check, product
        return test

    return decorate


def slow_after(count, rows):
    """Return rows for `pytest.mark.parametrize`; those after the first `count` are slow tests."""
    cells = [row if isinstance(row, tuple) else (row,) for row in rows]
    return [pytest.param(*row, marks=[pytest.mark.slow] if i >= count else []) for i, row in enumerate(cells)]


def named_rows(columns, rows, ids):
    """Return the name of each row and its values by column."""
    if not rows:
        raise ValueError("a table without rows checks nothing")
    if ids and not callable(ids) and len(ids) != len(rows):
        raise ValueError(f"{len(rows)} rows have {len(ids)} names")
    if any(hasattr(row, "marks") for row in rows):
        raise TypeError("a row with marks is a test of its own: use pytest.mark.parametrize")
    cells = [row if len(columns) > 1 else (row,) for row in rows]
    if callable(ids):
        names = ["-".join(str(ids(cell)) for cell in row) for row in cells]
    else:
        names = ids or [f"{number}: {', '.join(map(repr, row)):.200}" for number, row in enumerate(cells)]
    return [(name, dict(zip(columns, row, strict=True))) for name, row in zip(names, cells, strict=True)]


@contextlib.contextmanager
def fixtures_of_a_row(fixtures, number):
    own = dict(fixtures)
    with contextlib.ExitStack() as stack:
        if "tmp_path" in fixtures:
            own["tmp_path"] = fixtures["tmp_path"] / f"row_{number}"
            own["tmp_path"].mkdir()
        if "monkeypatch" in fixtures:
            own["monkeypatch"] = stack.enter_context(fixtures["monkeypatch"].context())
        yield own
