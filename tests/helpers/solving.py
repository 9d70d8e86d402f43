"""`dd.solve` with arguments and options in one list of keywords, for tables of tests."""

from dataclasses import fields

import drake_diff as dd

OPTIONS = frozenset(f.name for f in fields(dd.optimize.Options))


def solve_with(problem, **asked):
    options = {name: asked.pop(name) for name in [*asked] if name in OPTIONS}
    return dd.solve(problem, options=dd.optimize.Options(**options), **asked)
