"""Compiled functions agree with differences for a tree, and with AutoDiffXd for a step."""

import importlib
import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.robots import example_robot, state_in_contact, state_in_range
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base.compiled import compiled
from drake_diff.derivatives.contact import kernel
from drake_diff.mechanics import tree as of_trees
from drake_diff.mechanics import tree_kernel
from drake_diff.mechanics.description import describe_tree
from drake_diff.mechanics.tree import compiled_tree


def _largest(a, b):
    return float(np.abs(a - b).max() / np.abs(b).max())


def test_the_slope_of_a_trees_inertia_is_its_difference():
    model, random = example_robot("panda.urdf"), np.random.default_rng(2)
    tree, q = compiled_tree(describe_tree(model)), state_in_range(model, random)[None, : model.nq]
    still = np.zeros((1, model.nv))
    slope = tree(q, still, still).slope[0]
    for j in range(model.nv):
        move = 1e-5 * np.eye(model.nv)[j]
        ahead, behind = (np.diag(tree(q + m, still, still).mass[0]) for m in (move, -move))
        assert slope[:, j] == pytest.approx((ahead - behind) / 2e-5, abs=1e-9)  # differences with an error of 1e-10


@pytest.mark.solve
@pytest.mark.parametrize("approximation", ["sap", "similar", "lagged"])
@pytest.mark.parametrize("time_step", [0.005, 0.05])
def test_steps_with_impulses_are_autodiffs(approximation, time_step):
    """The states are in contact, and joints with high speeds reach their limits."""
    model, random = (
        example_robot("go2.urdf", time_step, approximation=approximation, feet=True),
        np.random.default_rng(3),
    )
    xs = np.array([state_in_contact(model, random, speed=speed) for speed in (0.0, 0.2, 0.2, 2.0, 2.0)])
    us, seen = random.uniform(-2, 2, (5, model.nu)), 0
    for x, u in zip(xs, us, strict=True):
        ours = dd.differentiate_step(model, x, u)
        if ours.method == "analytic":
            seen += 1
            exact = dd.differentiate_step(model, x, u, method="autodiff")
            # The matrix of the step's equation may be a thousand times stiffer along a contact than across.
            assert max(_largest(ours.A, exact.A), _largest(ours.B, exact.B)) < 1e-8
    assert seen >= 3


@pytest.mark.solve
@each_row("table", ["mass", "center", "moves"])
def test_a_wrong_number_in_the_tables_is_found_out(table, monkeypatch):
    """Drake's solution does not satisfy the wrong equation, or AutoDiffXd's Jacobian differs."""
    model, random = example_robot("solo12.urdf", feet=True), np.random.default_rng(4)
    x, u = state_in_contact(model, random), random.uniform(-1, 1, model.nu)
    if table in ("mass", "center"):
        right = of_trees.compile_links
        monkeypatch.setattr(
            of_trees, "compile_links", lambda *a: replace(right(*a), tables=_off(right(*a).tables, table))
        )
    else:
        right_plant = kernel.Plant
        monkeypatch.setattr(kernel, "Plant", lambda *a: _off(right_plant(*a), table))
    assert dd.differentiate_step(model, x, u).method != "analytic"


def _off(tables, name):
    """Return `tables` with one table 0.1 % too large or, for `moves`, set to 0."""
    wrong = 0.0 if name == "moves" else 1.001
    return tables._replace(**{name: wrong * getattr(tables, name)})


def test_nothing_is_compiled_for_more_than_one_kind_of_arguments():
    """Read-only and non-contiguous arrays would be further kinds, each of which takes seconds to compile."""
    model, random = example_robot("solo12.urdf", feet=True), np.random.default_rng(6)
    xs = np.array([state_in_contact(model, random) for _ in range(3)])
    us = np.zeros((3, model.nu))
    functions = kernel.overlapping, kernel.touch, kernel.step_jacobians, tree_kernel.differentiate_tree
    dd.linearize(model, xs, us)
    compiled = [len(function.signatures) for function in functions]  # other kernels also call the last function
    assert min(compiled) > 0
    xs.setflags(write=False)
    dd.linearize(model, xs, us)
    dd.linearize(model, xs[:1], us[:1])
    dd.linearize(model, np.asfortranarray(xs), us)
    dd.differentiate_step(model, xs[0], us[0])
    assert [len(function.signatures) for function in functions] == compiled


def test_a_function_without_a_folder_for_its_cache_is_compiled_all_the_same(monkeypatch, tmp_path):
    """This occurs in a read-only installation, for a user without a home folder."""
    from numba.core import caching

    def refuses(self):
        raise OSError("read-only")

    monkeypatch.setattr(caching._CacheLocator, "ensure_cache_path", refuses)
    path = tmp_path / "kernel_without_cache.py"
    path.write_text("def double(x):\n    return 2 * x\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    double = compiled(importlib.import_module("kernel_without_cache").double)
    assert (double(1.5), double.stats.cache_path) == (3.0, None)


def test_another_version_of_numba_has_cache_files_of_its_own(tmp_path, monkeypatch):
    """Otherwise, a process that reads while another one writes loads machine code of the other version."""
    from numba.core import caching

    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "kernel_of_two_versions.py").write_text("def double(x):\n    return 2 * x\n")
    double = importlib.import_module("kernel_of_two_versions").double
    written = []
    for version in ("0.60.0", "0.61.0"):
        monkeypatch.setattr(caching.numba, "__version__", version)
        assert compiled(double)(1.5) == 3.0
        written.append({f.name for f in (tmp_path / "__pycache__").iterdir() if f.suffix in (".nbi", ".nbc")})
    assert len(written[0]) == 2
    assert len(written[1]) == 4
    assert written[0] < written[1]


@pytest.mark.solve
def test_a_cache_that_names_a_class_of_an_older_version_is_compiled_anew(tmp_path, monkeypatch):
    """Numba unpickles the index of a cache, with the classes of its signatures, before it compares the source."""
    monkeypatch.syspath_prepend(str(tmp_path))
    text = (
        "from typing import NamedTuple\nfrom drake_diff._base.compiled import compiled\n"
        "class {0}(NamedTuple):\n    x: float\n@compiled\ndef double(bounds):\n    return 2 * bounds.x\n"
    )
    for name in ("Limits", "Range"):
        (tmp_path / "upgraded_kernel.py").write_text(text.format(name))
        importlib.invalidate_caches()
        sys.modules.pop("upgraded_kernel", None)
        module = importlib.import_module("upgraded_kernel")
        assert module.double(getattr(module, name)(1.5)) == 3.0
