"""The Jacobians of steps with impulses by compiled functions and by NumPy, side by side."""

import numpy as np

from drake_diff.derivatives.analytic import analytic_of
from drake_diff.derivatives.contact.jacobian import contact_form, contact_jacobians, material_of, numpy_jacobians
from drake_diff.derivatives.steps import take_steps
from drake_diff.model.parameters import select


def both_forms(model, xs, us):
    """((Jacobians (N, nx, nx + nu), known (N,)) compiled, the same by NumPy) of the steps from xs (N, nx)."""
    smooth, xs, us = analytic_of(model), np.atleast_2d(xs), np.atleast_2d(us)
    form = contact_form(model, smooth)
    assert form.compiled is not None
    steps, material = take_steps(model, select(model, ()), xs[0], us, xs), material_of(model, form)
    return tuple(f(form, smooth, steps, material, None)[:2] for f in (contact_jacobians, numpy_jacobians))
