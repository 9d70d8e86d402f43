"""How a flow's end changes with its start: the derivative of each accepted step, and the jump at each event.

The derivative of a step is that of its stages, at the step's length and modes. Where a switch turns at an event that
the motion meets under way, the time of the event moves with the state, and where the rates jump there from f- to f+,

    dx+ = (1 + (f+ - f-) g' / (g' f-)) dx-,

g' being the slope of the switch: the saltation matrix (Leine and Nijmeijer, "Dynamics and Bifurcations of Non-Smooth
Mechanical Systems", 2004). The step before it ends at the event, so that its own length does not count.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.motion.dormand_prince import STAGES
from drake_diff.motion.flow.integrate import Flow, FlowEvent, on_arrays, pushing_of
from drake_diff.motion.flow.plant import FlowPart, FlowPlant

STABLE = 2.0  # of a step's length times the largest rate of decay; the method is stable up to 3.3
ALONG = 1e-9  # of the sizes of a switch's slope and of the rates: less is no crossing


@dataclass(frozen=True, eq=False)
class Transitions:
    """Of M steps: (M, nx, nx), (M, nx, nu) and (M, nx, 4 P) by state, input and materials, jumps at events included."""

    by_x: Array
    by_u: Array
    by_materials: Array


def transitions(plant: FlowPlant, flow: Flow, materials: Array, *, by_materials: bool = False) -> Transitions:
    """The derivatives of the steps of `flow`; those by materials have no columns where they are not asked for."""
    xs, us, hs = np.array(flow.xs[:-1]), np.array(flow.us), np.array(flow.hs)
    nx, nu, nm = xs.shape[1], us.shape[1], len(materials) * by_materials
    found = np.empty((len(hs), nx, nx + nu + nm))
    sets: dict[tuple[int, ...], list[int]] = {}
    for i, modes in enumerate(flow.modes):
        sets.setdefault(pushing_of(modes), []).append(i)
    for pushing, rows in sets.items():
        found[rows] = _Steps(plant.part(pushing), us[rows], materials, nx + nu + nm).changes(xs[rows], hs[rows])
    modes_now: dict[int, Array] = {}
    for event in flow.events:
        if event.step:  # one that it begins with is none on the way
            now = modes_now.setdefault(event.step, flow.modes[event.step - 1].copy())
            _jump(plant, event, flow.us[event.step - 1], now, materials, found[event.step - 1])
    return Transitions(found[:, :, :nx], found[:, :, nx : nx + nu], found[:, :, nx + nu :])


@dataclass(frozen=True, eq=False)
class _Steps:
    """M steps under given inputs, and their derivatives by `width` numbers: state, input and materials."""

    part: FlowPart
    us: Array  # (M, nu)
    materials: Array  # (4 P,)
    width: int

    def changes(self, xs: Array, hs: Array) -> Array:
        """(M, nx, width) of steps from xs (M, nx) of lengths hs (M,).

        The method is stable for the motion where its error says so, and yet not for small changes of it: friction that
        holds is a stiff damper, which a motion that rests does not show. Such a step is taken in several for them.
        """
        nx = xs.shape[1]
        slopes = self._values(self.part.slopes, xs, self.us)[:, :, :nx]
        radius = np.max(np.abs(np.linalg.eigvals(slopes)), axis=1)
        parts = np.maximum(np.ceil(hs * radius / STABLE), 1).astype(int)
        change = np.zeros((len(xs), nx, self.width))
        change[:, :, :nx] = np.eye(nx)
        at = xs.copy()
        for j in range(int(np.max(parts))):
            rows = np.flatnonzero(parts > j)
            step, ahead = self._step(at[rows], (hs / parts)[rows], rows)
            total = step[:, :, :nx] @ change[rows]
            total[:, :, nx:] += step[:, :, nx:]
            change[rows], at[rows] = total, ahead
        return change

    def _step(self, xs: Array, hs: Array, rows: Indices) -> tuple[Array, Array]:
        """(M, nx, width) by differentiation of the stages, and (M, nx) where the step ends."""
        nx, us = xs.shape[1], self.us[rows]
        identity = np.zeros((len(xs), nx, self.width))
        identity[:, :, :nx] = np.eye(nx)
        values: list[Array] = []
        changes: list[Array] = []
        at, change = xs, identity
        for weights in STAGES:
            values.append(self._values(self.part.rates, at, us)[:, :, 0])
            slope = self._slopes(at, us)
            total = slope[:, :, :nx] @ change
            total[:, :, nx:] += slope[:, :, nx:]
            changes.append(total)
            at = xs + hs[:, None] * np.tensordot(weights, values, axes=1)
            change = identity + hs[:, None, None] * np.tensordot(weights, changes, axes=1)
        return change, at

    def _slopes(self, xs: Array, us: Array) -> Array:
        """(M, nx, width) of the rates."""
        found = [self._values(self.part.slopes, xs, us)]
        if self.width > xs.shape[1] + us.shape[1]:
            found.append(self._values(self.part.material_slopes, xs, us))
        return np.concatenate(found, axis=2)

    def _values(self, function: Any, xs: Array, us: Array) -> Array:
        """(M, rows, columns) of a function of the part."""
        rows, columns = function.size_out(0)
        x, u, result = np.empty(xs.shape[1]), np.empty(us.shape[1]), np.empty((columns, rows))
        found = np.empty((len(xs), columns, rows))
        _kept, run = on_arrays(function, (x, u, self.materials), (result,))
        for k in range(len(xs)):
            x[:], u[:] = xs[k], us[k]
            run()
            found[k] = result
        return found.transpose(0, 2, 1)


def _jump(plant: FlowPlant, event: FlowEvent, u: Array, modes: Array, materials: Array, step: Array) -> None:
    """Put the jump at an event onto the derivative of the `step` that ended there, and turn its switch in `modes`.

    Several at once are taken one after the other.
    """
    nx = len(event.x)
    before = np.asarray(plant.part(pushing_of(modes)).rates(event.x, u, materials)).ravel()
    pair = event.switch // 2
    modes[2 * pair : 2 * pair + 2] = event.modes
    jump = np.asarray(plant.part(pushing_of(modes)).rates(event.x, u, materials)).ravel() - before
    row = np.asarray(plant.switch_slope(event.switch)(event.x, u, materials)).ravel()
    rate = float(row[:nx] @ before)
    steep = abs(rate) / max(float(np.linalg.norm(row[:nx]) * np.linalg.norm(before)), 1e-300)
    if np.any(jump) and steep > ALONG:
        by = row[:nx] @ step
        by[nx:] += row[nx : step.shape[1]]
        step += np.outer(jump / rate, by)
