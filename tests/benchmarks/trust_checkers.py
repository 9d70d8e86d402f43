"""Compare checks of derivatives: which single errors of 1 % in the Jacobian of a Drake step each of them detects.

The states are those of `trust_certificate`. The error is in an entry of at least 1e-3 of the largest of its row, with
positions in 0.1 and velocities and inputs in 1 SI unit. Each check gets the same step, as a function of displacements
on the tangent space, and uses its own default steps and tolerances. Checks that are not installed are left out. In
contact, Drake's solver leaves an error of 1e-6, for which a check of Drake's own steps may not accept the exact one.
"""

import contextlib
import io
import warnings
from collections import Counter

import numpy as np
from trust import Figure
from trust_certificate import APPROXIMATIONS, KINDS, build

import drake_diff as dd
from drake_diff.certificates.certify import StepAround
from drake_diff.derivatives.step import step_jacobians
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.model.parameters import applied, select

COUNT = 120
ERRORS = 5  # planted errors at each state
MATTERS, POSITION = 1e-3, 0.1


class DrakeDiff:
    """`certify_function` of this project, on Drake's own steps."""

    name = "certify_function"

    def accepts(self, f, jacobian):
        return dd.certify_function(f, np.zeros(jacobian.shape[1]), jacobian=jacobian, scales=1.0).verdict == "agree"


class Torch:
    """`torch.autograd.gradcheck`, in double precision."""

    name = "torch gradcheck"

    def __init__(self):
        import torch

        class Step(torch.autograd.Function):
            @staticmethod
            def forward(context, z, f, jacobian):
                context.jacobian = torch.as_tensor(jacobian)
                return torch.as_tensor(f(z.detach().numpy()))

            @staticmethod
            def backward(context, gradient):
                return gradient @ context.jacobian, None, None

        self.torch, self.step = torch, Step

    def accepts(self, f, jacobian):
        z = self.torch.zeros(jacobian.shape[1], dtype=self.torch.double, requires_grad=True)
        call = lambda z: self.step.apply(z, f, jacobian)  # noqa: E731
        return self.torch.autograd.gradcheck(call, (z,), raise_exception=False)


class Jax:
    """`jax.test_util.check_grads` of order 1 and both modes, in double precision."""

    name = "JAX check_grads"

    def __init__(self):
        import jax
        from jax.test_util import check_grads

        jax.config.update("jax_enable_x64", True)
        self.jax, self.check = jax, check_grads

    def accepts(self, f, jacobian):
        jax, size = self.jax, jacobian.shape
        shape = jax.ShapeDtypeStruct(size[:1], float)

        @jax.custom_jvp
        def step(z):
            return jax.pure_callback(lambda z: np.asarray(f(np.asarray(z))), shape, z)

        step.defjvp(lambda primals, tangents: (step(*primals), jacobian @ tangents[0]))
        try:
            self.check(step, (np.zeros(size[1]),), order=1)
        except AssertionError:
            return False
        return True


class Mujoco:
    """`check_jacobian` of mujoco.minimize, with the step size that `least_squares` passes to it."""

    name = "MuJoCo minimize"

    def __init__(self):
        from mujoco import minimize

        self.check = minimize.check_jacobian

    def accepts(self, f, jacobian):
        z = np.zeros((jacobian.shape[1], 1))

        def many(points):
            return np.stack([f(point) for point in points.T], axis=1)

        try:
            self.check(many, z, many(z), jacobian, np.sqrt(np.finfo(float).eps), 0)
        except ValueError:
            return False
        return True


class Warp:
    """`warp.autograd.gradcheck`, in double precision."""

    name = "Warp gradcheck"

    def __init__(self):
        import warp
        from warp.autograd import gradcheck

        warp.config.quiet = True
        self.warp, self.check = warp, gradcheck

    def accepts(self, f, jacobian):
        wp, rows = self.warp, len(jacobian)

        def step(z):
            out = wp.array(f(z.numpy()), dtype=wp.float64, device="cpu", requires_grad=True)
            if (tape := wp._src.context.runtime.tape) is not None:
                back = lambda: z.grad.assign(out.grad.numpy() @ jacobian)  # noqa: E731
                tape.record_func(back, [z, out])
            return out

        z = wp.zeros(jacobian.shape[1], dtype=wp.float64, device="cpu", requires_grad=True)
        out = wp.zeros(rows, dtype=wp.float64, device="cpu", requires_grad=True)
        return self.check(step, inputs=[z], outputs=[out], raise_exception=False, show_summary=False)


def installed():
    """Return the checks whose libraries are installed."""
    checks = []
    for kind in (DrakeDiff, Torch, Jax, Mujoco, Warp):
        with contextlib.suppress(ImportError), contextlib.redirect_stdout(io.StringIO()):
            checks.append(kind())
    return checks


def planted(a, positions, random):
    """Return Jacobians with one entry of `a` 1 % off each."""
    scaled = np.abs(a) * np.where(np.arange(a.shape[1]) < positions, POSITION, 1.0)
    entries = np.argwhere(scaled >= MATTERS * scaled.max(axis=1, keepdims=True))
    for i, j in entries[random.choice(len(entries), min(ERRORS, len(entries)), replace=False)]:
        wrong = a.copy()
        wrong[i, j] *= 1.01 if random.uniform() < 0.5 else 0.99
        yield wrong


class Certify:
    """`certify` of this project: directions first, and every entry in case of doubt."""

    name = "certify"

    def __init__(self, case, step, vector):
        self.case, self.step, self.vector, self.whole = case, step, vector, None

    def verdict(self, a):
        if not self.step.screened(a)[2]:
            return "agree"
        if self.whole is None:
            case = self.case
            self.whole = dd.certify(case.model, case.x, case.u, parameters=case.parameters, thorough=True)
        return self.whole.of(a / self.step.scale).verdict


def measure(seed, count):
    random, tally, checks = np.random.default_rng(seed), Counter(), installed()
    for k in range(count):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            case = build(KINDS[k % len(KINDS)], random)
        vector = select(case.model, case.parameters)
        method = "analytic" if case.kind in APPROXIMATIONS else "auto"
        with applied(vector) as model, warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            try:
                d = step_jacobians(model, vector, case.x, case.u, method)
            except (GradientError, SimulationError):
                continue
            if "finite" in d.method or "finite_difference" in d.sources:
                continue
            step = StepAround.of_point(model, vector, case.x, case.u)
            a, centre = step.jacobian(d, case.x), step.drake(np.zeros(len(step.scale)))

            def change(z, step=step, centre=centre):
                return np.asarray(step.space.minus(step.drake(np.asarray(z, dtype=float).ravel()), centre))

            ours, errors = Certify(case, step, vector), list(planted(a, step.space.size - model.nv, random))
            tally["states"] += 1
            tally["errors"] += len(errors)
            verdict = ours.verdict(a)
            tally["certify", "alarms"] += verdict in ("disagree", "discontinuous")
            tally["certify", "undecided"] += verdict == "undecided"
            rejected = sum(ours.verdict(wrong) != "agree" for wrong in errors)
            tally["certify", "seen"] += rejected
            tally["certify", "apart"] += rejected * (verdict == "agree")
            for check in checks:
                right = check.accepts(change, a)
                rejected = sum(not check.accepts(change, wrong) for wrong in errors)
                tally[check.name, "alarms"] += not right
                tally[check.name, "seen"] += rejected
                tally[check.name, "apart"] += rejected * right
    figures = [
        Figure("certify: an exact Jacobian is undecided", tally["certify", "undecided"], tally["states"], 0.03, False)
    ]
    for name in ("certify", *(check.name for check in checks)):
        ours = name == "certify"
        seen, apart, alarms = (tally[name, what] for what in ("seen", "apart", "alarms"))
        wrongly = "called wrong" if ours else "not accepted"
        figures += [
            Figure(f"{name}: an entry 1 % off is not accepted", seen, tally["errors"], 0.995 if ours else None, True),
            Figure(f"{name}: ... while the exact Jacobian is", apart, tally["errors"], 0.97 if ours else None, True),
            Figure(f"{name}: an exact Jacobian is {wrongly}", alarms, tally["states"], 0.005 if ours else None, False),
        ]
    return figures
