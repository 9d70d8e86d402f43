"""Tasks of `benchmarks/contact_plans.py`, for tests of the modules that have them."""

import zlib

import numpy as np

import drake_diff as dd


def drawn_task(tasks, name, start=0):
    """The task of that name from a start of seed 0, as the benchmark draws it."""
    return tasks[name](np.random.default_rng([0, zlib.crc32(name.encode()), start]))


def assert_solved_and_found(task):
    """It is solved, and Drake alone finds what is asked."""
    from contact_plans import referee

    solution = dd.solve(task.problem, **task.options)
    assert solution.success, solution.message
    wrong, _ = referee(task, solution)
    assert not wrong
