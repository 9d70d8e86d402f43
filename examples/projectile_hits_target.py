"""Find the launch velocity of a projectile that lands at x = 6, by hand and through Drake.

300 steps of 0.01 s of semi-implicit Euler, v+ = v - g h, p+ = p + h v+. The loss is (x_T - 6)^2 / 2, and since
x_T = x_0 + 3 v_x, its derivative by hand is d loss / d v_x = (x_T - 6) * 3.0.

    drake-diff run examples/projectile_hits_target.py   writes artifacts/projectile_hits_target
    python examples/projectile_hits_target.py           compares the gradients
"""

from pathlib import Path

import numpy as np

import drake_diff as dd

MODEL = Path(__file__).parent.parent / "models" / "projectile.sdf"
TIME_STEP, NUM_STEPS, TARGET, GRAVITY = 0.01, 300, 6.0, 9.81
X, VX, VZ = 4, 10, 12  # in Drake's state: quaternion, position, angular velocity, velocity


def launch(vx: float) -> np.ndarray:
    """Return the state at x = z = 0 with a vertical velocity that leads back to z = 0 at the last step."""
    x = np.zeros(13)
    x[0] = 1
    x[VX], x[VZ] = vx, GRAVITY * TIME_STEP * (NUM_STEPS + 1) / 2
    return x


def loss(x_final: np.ndarray) -> float:
    return (x_final[X] - TARGET) ** 2 / 2


def problem() -> dd.Problem:
    model = dd.load_model(MODEL, time_step=TIME_STEP)
    free = np.zeros(13, dtype=bool)
    free[VX] = True
    return dd.Problem(
        model,
        x0=launch(vx=1.0),
        num_steps=NUM_STEPS,
        final_cost=loss,
        optimize=("initial_state",),
        initial_state_mask=free,
    )


def hand_built(vx: float) -> tuple[float, float, np.ndarray]:
    """Return (loss, d loss / d vx, final x and z) of the same motion in NumPy, with the derivative by hand."""
    p, v = np.zeros(2), launch(vx)[[VX, VZ]]
    for _ in range(NUM_STEPS):
        v = v + TIME_STEP * np.array([0.0, -GRAVITY])
        p = p + TIME_STEP * v
    miss = p[0] - TARGET
    return miss**2 / 2, miss * NUM_STEPS * TIME_STEP, p


def main() -> None:
    model = dd.load_model(MODEL, time_step=TIME_STEP)
    print("  vx    x_T by hand  x_T in Drake   dloss/dvx by hand   AutoDiffXd       central difference")
    for vx in (1.0, 1.5, 2.5):
        _, by_hand, end = hand_built(vx)
        gradient = dd.differentiate_rollout(model, launch(vx), None, loss, num_steps=NUM_STEPS)
        ends = [dd.rollout(model, launch(vx + d), num_steps=NUM_STEPS).xs[-1] for d in (1e-4, -1e-4)]
        difference = (loss(ends[0]) - loss(ends[1])) / 2e-4
        print(
            f"  {vx:.1f} {end[0]:12.6f} {gradient.xs[-1][X]:13.6f}"
            f" {by_hand:19.12f} {gradient.by_x0[VX]:19.12f} {difference:19.12f}"
        )
    print(dd.certify_rollout(model, launch(1.0), None, loss, num_steps=NUM_STEPS))
    vx = 1.0
    for _ in range(20):  # plain gradient descent; the exact step is 1 / 3.0^2
        vx -= 0.1 * hand_built(vx)[1]
    solution = dd.solve(problem())
    print(f"gradient descent by hand: vx = {vx:.9f}; through Drake: vx = {solution.xs[0][VX]:.9f} (exact: 2)")
    print(f"{solution.message}")


if __name__ == "__main__":
    main()
