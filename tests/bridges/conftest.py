"""The libraries that differentiate, with one interface for the tests."""

import numpy as np
import pytest


class TorchLibrary:
    name = "torch"

    def __init__(self):
        import torch

        import drake_diff.torch

        self.torch, self.functions = torch, drake_diff.torch

    def array(self, value):
        return self.torch.tensor(np.asarray(value), dtype=self.torch.float64)

    def gradients(self, loss, *values):
        """Return the value of a loss, and its gradients by each of the values, as NumPy arrays."""
        tensors = [self.array(value).requires_grad_() for value in values]
        value = loss(*tensors)
        return value.item(), [g.numpy() for g in self.torch.autograd.grad(value, tensors)]

    def check(self, function, values, tolerance, eps=1e-5):
        """Compare all derivatives of a function with differences, by the library's own check."""
        tensors = [self.array(value).requires_grad_() for value in values]
        assert self.torch.autograd.gradcheck(function, tensors, eps=eps, atol=tolerance, rtol=tolerance)

    def tanh(self, x):
        return self.torch.tanh(x)


class JaxLibrary:
    name = "jax"

    def __init__(self):
        import jax

        jax.config.update("jax_enable_x64", True)
        import drake_diff.jax

        self.jax, self.functions = jax, drake_diff.jax

    def array(self, value):
        return self.jax.numpy.asarray(value, dtype=float)

    def gradients(self, loss, *values):
        by_all = self.jax.jit(self.jax.value_and_grad(loss, argnums=tuple(range(len(values)))))
        value, gradients = by_all(*map(self.array, values))
        return float(value), [np.asarray(g) for g in gradients]

    def check(self, function, values, tolerance, eps=1e-5):
        from jax.test_util import check_grads

        values = tuple(map(self.array, values))
        check_grads(self.jax.jit(function), values, 1, modes=["rev"], rtol=tolerance, atol=tolerance, eps=eps)

    def tanh(self, x):
        return self.jax.numpy.tanh(x)


@pytest.fixture(scope="package", params=["torch", "jax"])
def library(request):
    """Return a library and the functions for it; tests of a library that is not installed are skipped."""
    pytest.importorskip(request.param, reason=f"pip install 'drake-diff[{request.param}]'")
    if request.param == "torch":
        yield TorchLibrary()
        return
    import jax

    before = jax.config.jax_enable_x64
    yield JaxLibrary()
    jax.config.update("jax_enable_x64", before)  # the engine MJX is tested with JAX's own setting
