"""Derivatives of bounces by Newton's own tape, as in its example of a ball that is thrown at a wall.

    pip install -e '.[forward]'
    python tests/benchmarks/impact_newton.py OUT.json [--seed 0] [--count 100]

A ball on rails is a particle of its mass and radius over a ground plane: SolverSemiImplicit in steps of 1/480 s, single
precision, contacts found once, as in newton/examples/diffsim/example_diffsim_ball.py. Stiffness and friction are the
pair's, damping is a thousandth of the stiffness, as there. Its law is a spring and, while they close, a damper; what
the slope should be is that of the height under this law in double precision, by Runge-Kutta 4 in steps of 20 us and
central differences over +-1e-3 and +-1e-4, where they agree to 5 %. Losses in the height alone are taken.
"""

import argparse
import json
import logging
from pathlib import Path

import numpy as np
import warp as wp
from impact_cases import Case, case

wp.config.log_level = wp.LOG_ERROR

import newton  # noqa: E402

STEP, FINE = 1 / 480, 2e-5  # [s]
WIDTHS, AGREE = (1e-3, 1e-4), 0.05


class Particle:
    """The motion of a case's ball in steps of `h`."""

    def __init__(self, one: Case, h: float):
        self.case, self.h, self.count = one, h, round(one.duration / h)
        ball, scene = one.movers[0], newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=one.gravity)
        material = ball.material
        k, mu = material.stiffness / 2, material.friction
        scene.add_particle(pos=wp.vec3(0.0, 0.0, 1.0), vel=wp.vec3(0.0, 0.0, 0.0), mass=ball.mass, radius=ball.radius)
        scene.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(ke=k, kf=0.0, kd=1e-3 * k, mu=mu))
        self.model = scene.finalize(device="cpu", requires_grad=True)
        self.model.soft_contact_ke, self.model.soft_contact_kd = k, 1e-3 * k
        self.model.soft_contact_kf, self.model.soft_contact_mu = 0.0, mu
        self.solver, self.control = newton.solvers.SolverSemiImplicit(self.model), self.model.control()
        self.pipeline = newton.CollisionPipeline(
            self.model, broad_phase="explicit", soft_contact_gap=10.0, requires_grad=True
        )

    def first(self, x0):
        """Its first state; numbers of the case are x, z or both, and their rates."""
        state, n = self.model.state(requires_grad=True), len(x0) // 2
        q, v = np.zeros(3), np.zeros(3)
        q[3 - n :: 3 - n], v[3 - n :: 3 - n] = x0[:n], x0[n:]
        if n == 2:
            q[:], v[:] = (x0[0], 0, x0[1]), (x0[2], 0, x0[3])
        state.particle_q.assign(np.array([q], dtype=np.float32))
        state.particle_qd.assign(np.array([v], dtype=np.float32))
        return state

    def roll(self, state, states=None):
        """The state at the end; all are kept where there is room for them."""
        contacts = self.pipeline.contacts()
        self.pipeline.collide(state, contacts)
        other = self.model.state(requires_grad=True)
        for k in range(self.count):
            state.clear_forces()
            after = other if states is None else states[k]
            self.solver.step(state, after, self.control, contacts, self.h)
            state, other = after, state
        return state

    def drakes(self, state):
        q, v = (array.numpy()[0].astype(float) for array in (state.particle_q, state.particle_qd))
        return np.array([q[2], v[2]] if len(self.case.x0) == 2 else [q[0], q[2], v[0], v[2]])

    def taped(self, column: int) -> float:
        """By the tape, backwards from the last state."""
        state = self.first(self.case.x0)
        states = [self.model.state(requires_grad=True) for _ in range(self.count)]
        tape = wp.Tape()
        with tape:
            last = self.roll(state, states)
        at, h = self.drakes(last), 1e-6
        by = [(self.case.loss(at + e) - self.case.loss(at - e)) / (2 * h) for e in h * np.eye(len(at))]
        n = len(at) // 2
        q, v = np.zeros(3), np.zeros(3)
        for array, numbers in ((q, by[:n]), (v, by[n:])):
            array[2], array[0] = numbers[-1], numbers[0] if n == 2 else 0.0
        grads = {
            array: wp.array(np.array([numbers], dtype=np.float32), dtype=wp.vec3, device="cpu")
            for array, numbers in ((last.particle_q, q), (last.particle_qd, v))
        }
        tape.backward(grads=grads)
        found = (state.particle_q if column < n else state.particle_qd).grad.numpy()[0]
        return float(found[2] if n == 1 or column % n else found[0])


def limit(one: Case, x0) -> float:
    """The loss at the end under Newton's law in small steps."""
    ball, n, g = one.movers[0], len(x0) // 2, one.gravity[2]
    k, m, r = ball.material.stiffness / 2, ball.mass, ball.radius
    z, v = x0[n - 1], x0[-1]

    def mode(z, v):
        return z < r, v < 0

    def ahead(z, v, h, touches, closes):
        def rate(z, v):
            return g + k * ((r - z) - 1e-3 * v * closes) / m * touches

        a = rate(z, v)
        b = rate(z + h / 2 * v, v + h / 2 * a)
        c = rate(z + h / 2 * (v + h / 2 * a), v + h / 2 * b)
        d = rate(z + h * (v + h / 2 * b), v + h * c)
        return z + h * v + h * h / 6 * (a + b + c), v + h / 6 * (a + 2 * b + 2 * c + d)

    left, on = one.duration, mode(z, v)
    while left > 0:
        h = min(FINE, left)
        if mode(*ahead(z, v, h, *on)) != on:  # up to just past where the force has a kink
            low, high = 0.0, h
            for _ in range(50):
                middle = (low + high) / 2
                low, high = (middle, high) if mode(*ahead(z, v, middle, *on)) == on else (low, middle)
            h = high
        z, v = ahead(z, v, h, *on)
        left, on = left - h, mode(z, v)
    x = np.zeros(len(x0))
    x[n - 1], x[-1] = z, v
    return float(one.loss(x))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=100)
    options = parser.parse_args()
    logging.getLogger("drake").setLevel(logging.ERROR)
    found = {}
    for one in (case(options.seed, number) for number in range(options.count)):
        n = len(one.x0) // 2
        if one.family == "bounce" and (one.weights[n - 1] or one.weights[-1]):
            column, slopes = one.columns[0], []
            for width in WIDTHS:
                ends = [limit(one, one.changed(column, sign * width).x0) for sign in (1, -1)]
                slopes.append((ends[0] - ends[1]) / (2 * width))
            settles = np.ptp(slopes) <= AGREE * np.max(np.abs(slopes))
            wanted = slopes[1] if settles else None
            found[one.name] = {"slope": Particle(one, STEP).taped(column), "wanted": wanted, "slopes": slopes}
            print(one.name, found[one.name], flush=True)
            options.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
