"""Call `dd.solve` with arguments and options together, for each measured version of drake_diff."""

from dataclasses import fields

import drake_diff as dd


def solve_with(problem, **asked):
    kind = getattr(dd.optimize, "Options", None)
    if kind is None:  # a version before `options=`
        return dd.solve(problem, **asked)
    names = {f.name for f in fields(kind)}
    options = {name: asked.pop(name) for name in [*asked] if name in names}
    return dd.solve(problem, options=kind(**options), **asked)
