"""How a flow's end changes with its start: the derivative of each accepted step, and the jump at each event.

In a step the change Phi of the motion follows Phi' = A(t) Phi + B(t), A and B being the slopes of the rates on the way,
by the collocation method of three points of order 5 (Radau IIA; Hairer and Wanner, "Solving Ordinary Differential
Equations II", 1996, IV.5). It is stable at any length of step: a motion that rests does not show how stiff the friction
is that holds it, and small changes of it do.

Where a switch turns at an event that the motion meets under way, the time of the event moves with the state, and where
the rates jump there from f- to f+,

    dx+ = (1 + (f+ - f-) g' / (g' f-)) dx-,

g' being the slope of the switch: the saltation matrix (Leine and Nijmeijer, "Dynamics and Bifurcations of Non-Smooth
Mechanical Systems", 2004). The step before it ends at the event, so that its own length does not count.
"""

from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.motion.flow.integrate import Flow, FlowEvent, pushing_of
from drake_diff.motion.flow.plant import FlowPlant
from drake_diff.motion.flow.within import Slopes, between

ROOT_6 = np.sqrt(6.0)
NODES = (4 - ROOT_6) / 10, (4 + ROOT_6) / 10  # and the end
WEIGHTS = np.array(
    [
        [(88 - 7 * ROOT_6) / 360, (296 - 169 * ROOT_6) / 1800, (-2 + 3 * ROOT_6) / 225],
        [(296 + 169 * ROOT_6) / 1800, (88 + 7 * ROOT_6) / 360, (-2 - 3 * ROOT_6) / 225],
        [(16 - ROOT_6) / 36, (16 + ROOT_6) / 36, 1 / 9],
    ]
)
SWING = 0.5  # of a part's length times the frequency that its stiffest entry would swing at
ALONG = 1e-9  # of the sizes of a switch's slope and of the rates: less is no crossing
AT_ONCE = 1_000_000  # numbers of the equations that are solved in one call


@dataclass(frozen=True, eq=False)
class Transitions:
    """Of M steps: (M, nx, nx), (M, nx, nu) and (M, nx, n) by state, input and parameters, jumps at events included."""

    by_x: Array
    by_u: Array
    by_parameters: Array


def transitions(plant: FlowPlant, flow: Flow, materials: Array, by_parameters: Array) -> Transitions:
    """The derivatives of the steps of `flow`, those of the materials by n parameters being `by_parameters` (4 P, n)."""
    xs, us, hs = np.array(flow.xs), np.array(flow.us), np.array(flow.hs)
    nx, nu = xs.shape[1], us.shape[1]
    found = np.empty((len(hs), nx, nx + nu + by_parameters.shape[1]))
    sets: dict[tuple[int, ...], list[int]] = {}
    for i, modes in enumerate(flow.modes):
        sets.setdefault(pushing_of(modes), []).append(i)
    for pushing, chosen in sets.items():
        own = [4 * i + j for i in pushing for j in range(4)]
        slopes = Slopes(plant.part(pushing), materials, by_parameters[own])
        at_once = max(1, AT_ONCE // (9 * nx * found.shape[2]))
        for first in range(0, len(chosen), at_once):
            rows = np.array(chosen[first : first + at_once])
            found[rows] = _changes(slopes, plant.model.nq, xs[rows], xs[rows + 1], us[rows], hs[rows])
    for m in flow.deep:
        plant.check_normals(xs[m], xs[m + 1], pushing_of(flow.modes[m]))
    modes_now: dict[int, Array] = {}
    for event in flow.events:
        if event.step:  # one that it begins with is none on the way
            now = modes_now.setdefault(event.step, flow.modes[event.step - 1].copy())
            _jump(plant, event, flow.us[event.step - 1], now, materials, by_parameters, found[event.step - 1])
    return Transitions(found[:, :, :nx], found[:, :, nx : nx + nu], found[:, :, nx + nu :])


def _changes(slopes: Slopes, nq: int, starts: Array, ends: Array, us: Array, hs: Array) -> Array:
    """(M, nx, width) of steps of lengths hs (M,) from `starts` (M, nx) to `ends`.

    A motion that rests does not show how fast it would swing either: steps that are long for that are taken in parts.
    """
    count, nx = starts.shape
    at_start, at_end = slopes.at_ends(starts, ends, us)
    stiffness = np.max(np.abs(at_start[1][:, nq:, :nq]), axis=(1, 2), initial=0.0)
    parts = np.ceil(np.maximum(hs * np.sqrt(stiffness) / SWING, 1.0)).astype(int)
    found = np.empty((count, nx, at_end[1].shape[2]))
    for number in np.unique(parts).tolist():
        rows = np.flatnonzero(parts == number)
        here = starts[rows], ends[rows], hs[rows]
        near = [(rates[rows], by_all[rows]) for rates, by_all in (at_start, at_end)]
        for j in range(number):
            points = [(j + c) / number for c in NODES] + [(j + 1) / number] * (j + 1 < number)
            on_the_way = [slopes(between(point, *here, *near), us[rows])[1] for point in points]
            on_the_way += [near[1][1]] * (j + 1 == number)
            change = _collocated(np.stack(on_the_way, axis=1), hs[rows] / number)
            if j:
                total = change[:, :, :nx] @ found[rows]
                total[:, :, nx:] += change[:, :, nx:]
                change = total
            found[rows] = change
    return found


def _collocated(slopes: Array, hs: Array) -> Array:
    """(M, nx, width) from the slopes (M, 3, nx, width) at the three points of steps of lengths hs (M,)."""
    count, _, nx, _ = slopes.shape
    parts = hs[:, None, None, None, None] * WEIGHTS[None, :, :, None, None] * slopes[:, None]
    left = -parts[..., :nx].transpose(0, 1, 3, 2, 4).reshape(count, 3 * nx, 3 * nx)
    diagonal = np.arange(3 * nx)
    left[:, diagonal, diagonal] += 1.0
    right = np.sum(parts, axis=2)
    right[..., :nx] = np.eye(nx)
    return np.asarray(np.linalg.solve(left, right.reshape(count, 3 * nx, -1))[:, 2 * nx :])


def _jump(
    plant: FlowPlant, event: FlowEvent, u: Array, modes: Array, materials: Array, by_parameters: Array, step: Array
) -> None:
    """Put the jump at an event onto the derivative of the `step` that ended there, and turn its switch in `modes`.

    Several at once are taken one after the other.
    """
    nx, nu = len(event.x), len(u)
    before = np.asarray(plant.part(pushing_of(modes)).rates(event.x, u, materials)).ravel()
    pair = event.switch // 2
    modes[2 * pair : 2 * pair + 2] = event.modes
    jump = np.asarray(plant.part(pushing_of(modes)).rates(event.x, u, materials)).ravel() - before
    row = np.asarray(plant.switch_slope(event.switch)(event.x, u, materials)).ravel()
    rate = float(row[:nx] @ before)
    steep = abs(rate) / max(float(np.linalg.norm(row[:nx]) * np.linalg.norm(before)), 1e-300)
    if np.any(jump) and steep > ALONG:
        by = row[:nx] @ step
        by[nx : nx + nu] += row[nx : nx + nu]
        by[nx + nu :] += row[nx + nu :] @ by_parameters
        step += np.outer(jump / rate, by)
