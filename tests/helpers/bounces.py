"""The motion of a ball that bounces on a floor, event by event: free flight in closed form, contact by a law.

    m x'' = m g - f,   x the depth,   f = k (x + tau x')+ for sap,   f = k x (1 + d x')+ for similar and lagged

This is the reference for gradients through a bounce. It has no time step and does not use the package.
"""

from dataclasses import dataclass
from math import sqrt

import drake_diff as dd

RADIUS = 0.1
FILE = """<sdf version="1.9"><model name="bouncer"><link name="ball"><inertial><mass>{mass!r}</mass>
<inertia><ixx>1</ixx><iyy>1</iyy><izz>1</izz></inertia></inertial><collision name="skin">
<geometry><sphere><radius>0.1</radius></sphere></geometry>{material}</collision></link>
<link name="floor"><collision name="top"><geometry><plane><normal>0 0 1</normal></plane></geometry>{material}
</collision></link><joint name="weld" type="fixed"><parent>world</parent><child>floor</child></joint>
<joint name="slide" type="prismatic"><parent>world</parent><child>ball</child>
<axis><xyz>0 0 1</xyz><limit><effort>{effort!r}</effort></limit></axis></joint></model></sdf>"""
MATERIAL = """<drake:proximity_properties xmlns:drake="http://drake.mit.edu">
<drake:point_contact_stiffness>{k!r}</drake:point_contact_stiffness>
<drake:hunt_crossley_dissipation>{d!r}</drake:hunt_crossley_dissipation>
<drake:relaxation_time>{tau!r}</drake:relaxation_time></drake:proximity_properties>"""


@dataclass(frozen=True)
class Bounce:
    """A ball of radius 0.1 m on a vertical slide over a floor. k, d and tau are parameters of the pair."""

    stiffness: float  # k [N/m]
    relaxation_time: float = 0.0  # tau [s], only for sap
    dissipation: float = 0.0  # d [s/m], only for similar and lagged
    mass: float = 1.0
    gravity: float = 9.81

    def model(self, path, approximation, time_step, effort=0.0):
        """Write a file of the ball to `path` and load it: x = [height of the centre, its rate]."""
        # Two materials in series have half the stiffness, the mean dissipation and the sum of the relaxation times.
        material = MATERIAL.format(k=2 * self.stiffness, d=self.dissipation, tau=self.relaxation_time / 2)
        path.write_text(FILE.format(mass=self.mass, material=material, effort=effort))
        gravity = (0, 0, -self.gravity)
        return dd.load_model(path, time_step=time_step, contact_approximation=approximation, gravity=gravity)

    def end(self, approximation, start, duration):
        """Return (height of the centre, its rate) `duration` [s] after the `start` (height, rate)."""
        k, tau, d = self.stiffness, self.relaxation_time, self.dissipation
        m, g, is_sap = self.mass, self.gravity, approximation == "sap"
        piece = 0.01 * min(sqrt(m / k), m / (k * tau) if is_sap and tau else 1.0)

        def pushes(x, v):
            return x + tau * v > 0 if is_sap else 1 + d * v > 0

        def after(x, v, dt, on):
            def rate(x, v):
                force = (k * (x + tau * v) if is_sap else k * x * (1 + d * v)) if on else 0.0
                return g - force / m

            a = rate(x, v)
            b = rate(x + dt / 2 * v, v + dt / 2 * a)
            c = rate(x + dt / 2 * (v + dt / 2 * a), v + dt / 2 * b)
            e = rate(x + dt * (v + dt / 2 * b), v + dt * c)
            return x + dt * v + dt * dt / 6 * (a + b + c), v + dt / 6 * (a + 2 * b + 2 * c + e)

        x, v, left = RADIUS - start[0], start[1] * -1.0, duration
        while left > 0:
            if x < 0 or (x == 0 and v < 0):  # in the air, until x is 0 again or the time ends
                # x + v t + g t^2 / 2 = 0: the later root
                t = (-v + sqrt(max(0.0, v * v - 2 * g * x))) / g if g else (-x / v if v > 0 else left)
                if t >= left:
                    return RADIUS - (x + v * left + g * left * left / 2), -(v + g * left)
                x, v, left = 0.0, v + g * t, left - t
            on, dt = pushes(max(x, 1e-12), v), min(piece, left)

            def stays(dt, x=x, v=v, on=on):
                ahead = after(x, v, dt, on)
                return ahead[0] > 0 and pushes(*ahead) == on

            if not stays(dt):
                low, high = 0.0, dt
                for _ in range(60):
                    middle = (low + high) / 2
                    low, high = (middle, high) if stays(middle) else (low, middle)
                dt = high
            x, v = after(x, v, dt, on)
            left -= dt
        return RADIUS - x, -v

    def slopes(self, approximation, start, duration, loss=lambda z, v: z, width=1e-5):
        """Return d loss(height, rate) / d (height, rate) of the start, and its change for ten times the `width`."""

        def end(z, v):
            return loss(*self.end(approximation, (z, v), duration))

        (z, v), found = start, []
        for w in (width, 10 * width):
            found.append(((end(z + w, v) - end(z - w, v)) / (2 * w), (end(z, v + w) - end(z, v - w)) / (2 * w)))
        return found[0], max(abs(a - b) for a, b in zip(*found, strict=True))
