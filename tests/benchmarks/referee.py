"""Judge a plan with pydrake alone: a Simulator with error control or finer steps, and a separate TVLQR.

A plan is accepted if the plant, under its inputs or with feedback about them, clipped at their limits, ends at the goal
and stays within the bounds. The tolerance is a part of a state's range (at least a fifth of the largest of its kind).
Further requirements are `asks`, (name, function of times and states, largest allowed value), and the inputs' `rate`.
"""

import numpy as np
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import BasicVector, DiagramBuilder, LeafSystem, OutputPortSelection
from pydrake.systems.primitives import FirstOrderTaylorApproximation


class Control(LeafSystem):
    def __init__(self, plan, times, gains):  # u(t) + K(t) (x(t) - x) - l(t), clipped at the limits
        LeafSystem.__init__(self)
        self.plan, self.times, self.gains = plan, times, gains
        self.DeclareVectorInputPort("x", BasicVector(len(plan["goal"])))
        self.DeclareVectorOutputPort("u", BasicVector(len(plan["u_lower"])), self.output)

    def output(self, context, u):
        t, plan, wanted = context.get_time() + 1e-9, self.plan, self.plan["u"](context.get_time() + 1e-9)
        if self.gains is not None:
            k = min(np.searchsorted(self.times, t, side="right") - 1, len(self.gains) - 1)
            K, offset = self.gains[k]
            wanted = wanted + K @ (plan["x"](t) - self.EvalVectorInput(context, 0).value()) - offset
        u.SetFromVector(np.clip(wanted, plan["u_lower"], plan["u_upper"]))


def state_of(context):
    names = "get_mutable_discrete_state_vector", "get_mutable_continuous_state_vector"
    return getattr(context, names[context.has_only_continuous_state()])()


def simulate(plan, step, times, gains, start=None):  # times (S,) [s] and states (S, nx), continuous if `step` is 0
    builder, seen, (system, port_in, port_out) = DiagramBuilder(), [], plan["build"](step)
    system, control = builder.AddSystem(system), builder.AddSystem(Control(plan, times, gains))
    builder.Connect(control.get_output_port(), system.get_input_port(port_in))
    builder.Connect(system.get_output_port(port_out), control.get_input_port())
    simulator = Simulator(builder.Build())
    own = system.GetMyContextFromRoot(simulator.get_mutable_context())
    state_of(own).SetFromVector(plan["x"](0.0) if start is None else start)
    ResetIntegratorFromFlags(simulator, "runge_kutta3", times[1]).set_target_accuracy(1e-7)
    simulator.set_monitor(lambda root: seen.append([root.get_time(), *state_of(own).CopyToVector()]) and None)
    simulator.AdvanceTo(times[-1] - step / 2)  # a step begins at each multiple of `step`
    return np.array(seen)[:, 0], np.array(seen)[:, 1:]


def slopes(system, context, port_in):  # A, B, constant term at the context; by differences without AutoDiffXd
    if system.ToAutoDiffXdMaybe() is not None:
        found = FirstOrderTaylorApproximation(system, context, port_in, OutputPortSelection.kNoOutput)
        return found.A(), found.B(), found.f0()
    x, u, h = state_of(context).CopyToVector(), system.get_input_port(port_in).Eval(context), 1e-6

    def rates(at):
        state_of(context).SetFromVector(at[: len(x)])
        system.get_input_port(port_in).FixValue(context, at[len(x) :])
        return system.EvalTimeDerivatives(context).CopyToVector()

    at = np.concatenate([x, u])
    found = np.array([(rates(at + h * e) - rates(at - h * e)) / (2 * h) for e in np.eye(len(at))]).T
    return found[:, : len(x)], found[:, len(x) :], None  # in continuous time, which does not use the constant


def regulator(plan, step, times, scale):  # gains and offsets at `times` by a Riccati recursion
    system, port_in, _ = plan["build"](step)
    context, h, Q, gains = system.CreateDefaultContext(), times[1], np.diag(1 / scale**2), []
    R, P = 0.1 * np.diag(1 / np.maximum(np.ptp([plan["u"](t) for t in times], axis=0), 1e-3) ** 2), 100 * Q
    p = np.zeros(len(Q))
    for t, after in zip(times[-2::-1], times[::-1], strict=False):
        state_of(context).SetFromVector(plan["x"](t))
        system.get_input_port(port_in).FixValue(context, plan["u"](t + 1e-9))
        A, B, constant = slopes(system, context, port_in)
        A, B = (A, B) if step else (np.eye(len(A)) + h * A + h * h / 2 * A @ A, h * (B + h / 2 * A @ B))
        defect = A @ plan["x"](t) + B @ plan["u"](t + 1e-9) + constant - plan["x"](after) if step else 0 * p
        r, inverse = P @ defect + p, np.linalg.inv(h * R + B.T @ P @ B)
        K = inverse @ B.T @ P @ A
        gains.append((K, inverse @ B.T @ r))
        P, p = h * Q + A.T @ P @ (A - B @ K), (A - B @ K).T @ r
    return gains[::-1]


def scale_of(plan, times):  # (nx,) scales of the errors of states, and (nu,) ranges of the inputs
    nq = plan["nq"]
    ranges, us = (np.ptp([plan[name](t) for t in times], axis=0) for name in ("x", "u"))
    least = np.repeat([ranges[:nq].max(initial=0), ranges[nq:].max(initial=0)], [nq, len(ranges) - nq]) / 5
    return np.maximum(np.maximum(ranges, least), 1e-3), us


def input_excess(plan, us):  # largest excess of an input beyond its bound, relative to its range
    applied = [plan["u"](t) for t in np.linspace(0, plan["T"], 999)]
    return np.max(np.maximum(plan["u_lower"] - applied, applied - plan["u_upper"]) / np.maximum(us, 1e-2))


def misses(plan, at, xs, scale, tolerance):  # (the largest relative error, a message or "" if all are allowed)
    excess = np.maximum(plan["x_lower"] - xs, xs - plan["x_upper"])[1:].max(axis=0)
    missed = np.where(np.isnan(plan["goal"]), 0, np.abs(xs[-1] - plan["goal"]))
    worst = float(np.nan_to_num(np.maximum(missed, excess) / scale, nan=np.inf).max())
    found = [(name, miss(at, xs), allowed) for name, miss, allowed in plan.get("asks", ())]
    lacking = [f"{name}: {miss:.4g}, {allowed:g} allowed" for name, miss, allowed in found if not miss <= allowed]
    told = [f"{missed.round(4)} off, {excess.round(4)} beyond bounds"] * (not worst <= tolerance) + lacking
    return max(worst, bool(lacking) * 1.0), "; ".join(told)


def judge(plan, step, tolerance):
    """Return why the plan is wrong in the plant with `step` [s], "" if it is right, and the largest relative error."""
    times = np.linspace(0, plan["T"], round(plan["T"] / step) + 1 if step else 201)
    scale, us = scale_of(plan, times)
    if (beyond := input_excess(plan, us)) > 1e-3:
        return f"input beyond its bound by {beyond:.2g} of its range", np.inf
    if "rate" in plan:  # [per s], and the interval in which a piecewise constant input changes
        most, while_ = plan["rate"]
        starts = np.linspace(0, plan["T"] - while_, 999)
        changes = [np.abs(plan["u"](t + while_) - plan["u"](t)).max() / while_ for t in starts + 1e-9]
        if max(changes) > 1.01 * most:
            return f"an input changes by {max(changes):.4g} per s, {most:g} allowed", np.inf
    best = np.inf, "no motion"
    for control in ("open loop", "TVLQR"):
        at, xs = simulate(plan, step, times, None if control == "open loop" else regulator(plan, step, times, scale))
        worst, told = misses(plan, at, xs, scale, tolerance)
        if not told:
            return "", worst
        best = min(best, (worst, f"{control}, {step:g} s: {told}"))
    return best[1], best[0]


def judge_phases(plans, resets, closes, tolerance):
    """Judge successive phases. Each starts from the last state of the previous phase, mapped by its reset.

    If `closes` is true, the last reset must lead back to the first state.
    """
    parts = []
    for plan in plans:
        times = np.linspace(0, plan["T"], 201)
        scale, us = scale_of(plan, times)
        if (beyond := input_excess(plan, us)) > 1e-3:
            return f"input beyond its bound by {beyond:.2g} of its range", np.inf
        parts.append((plan, times, scale))
    best = np.inf, "no motion"
    for control in ("open loop", "TVLQR"):
        x, worst, told = parts[0][0]["x"](0.0), 0.0, []
        for i, ((plan, times, scale), reset) in enumerate(zip(parts, resets, strict=True)):
            gains = regulator(plan, 0.0, times, scale) if control == "TVLQR" else None
            at, xs = simulate(plan, 0.0, times, gains, x)
            off, why = misses(plan, at, xs, scale, tolerance)
            worst, x = max(worst, off), reset(xs[-1])
            told += [f"phase {i}: {why}"] * bool(why)
        if closes:
            off = float((np.abs(x - parts[0][0]["x"](0.0)) / parts[0][2]).max())
            worst = max(worst, off)
            told += [f"it comes back {off:.2g} of its range away"] * (not off <= tolerance)
        if not told:
            return "", worst
        best = min(best, (worst, f"{control}: {'; '.join(told)}"))
    return best[1], best[0]
