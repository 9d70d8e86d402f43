"""Show the effect of contact on a gradient: certificates of a ball before, at and after touchdown.

In free motion and lasting contact, finite differences confirm the derivative. Exactly at touchdown it does not exist,
and the certificate is "discontinuous". Through a bounce, the derivative is that of the discrete, compliant contact. It
differs from the derivative of a rigid bounce: see the last table.

    drake-diff run examples/sphere_on_ground.py         writes artifacts/sphere_on_ground
    python examples/sphere_on_ground.py                 prints the certificates
"""

from pathlib import Path

import numpy as np

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "sphere_on_ground.sdf"
RADIUS, GRAVITY = 0.1, 9.81
X, Z, VX, VZ = 4, 6, 10, 12  # in Drake's state: quaternion, position, angular velocity, velocity


def ball(z: float, vx: float = 0.0, vz: float = 0.0) -> np.ndarray:
    x = np.zeros(13)
    x[0] = 1
    x[Z], x[VX], x[VZ] = z, vx, vz
    return x


def problem() -> dd.Problem:
    """Find the horizontal velocity with which a ball from a height of 0.2 m is at x = 1 m after 1 s."""
    model = dd.load_model(MODEL, time_step=0.005)
    free = np.zeros(13, dtype=bool)
    free[VX] = True
    return dd.Problem(
        model,
        x0=ball(0.2, vx=0.5),
        num_steps=200,
        final_cost=lambda x: 10 * (x[X] - 1.0) ** 2,
        optimize=("initial_state",),
        initial_state_mask=free,
    )


def main() -> None:
    model = dd.load_model(MODEL, time_step=0.005)
    print(model.contract)
    static = 1.0 * GRAVITY / 1e4  # m g / k of the pair: penetration of the ball at rest
    cases = {
        "in flight": ball(0.3, vx=1, vz=-1),
        "resting": ball(RADIUS - static),
        "sliding": ball(RADIUS - static, vx=1),
        "landing": ball(RADIUS - 0.003, vx=1, vz=-1),
        "touching": ball(RADIUS, vx=1, vz=-1),
    }
    print("\none step: what the certificate says of d x+ / d x")
    for name, x in cases.items():
        certificate = dd.certify(model, x)
        gradient = dd.differentiate_step(model, x)
        print(f"  {name:10s} max |A| {np.abs(gradient.A).max():8.3g}  {certificate}")
    print("\na drop from 0.6 m, 0.5 s: d v_z(T) / d z_0 of the discrete contact, and of a rigid bounce that keeps as")
    print("much speed (the same at every time step)")
    for time_step in (0.005, 0.0025, 0.00125, 0.000625):
        finer = dd.load_model(MODEL, time_step=time_step)
        start, steps = ball(0.6), round(0.5 / time_step)
        bounce = dd.differentiate_rollout(finer, start, None, lambda x: x[VZ], num_steps=steps)
        xs = bounce.xs
        fall = np.sqrt(2 * GRAVITY * (0.6 - RADIUS))
        restitution = (xs[-1, VZ] + GRAVITY * (0.5 - fall / GRAVITY)) / fall
        rigid = (1 + restitution) * GRAVITY / fall
        print(
            f"  h = {time_step:8.6f} s  discrete {bounce.by_x0[Z]:10.4f}  rigid {rigid:8.4f}  "
            f"largest |dloss/dx_k| {np.max(bounce.state_gradient_norms):9.3g}"
        )


if __name__ == "__main__":
    main()
