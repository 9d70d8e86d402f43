"""Switching and friction by nosnoc (finite elements with switch detection), a second referee, in its own environment.

    python -m venv nosnoc && nosnoc/bin/pip install nosnoc
    nosnoc/bin/python tests/benchmarks/impact_nosnoc.py OUT.json
    python tests/benchmarks/impact_nosnoc.py OUT.json        # adds ours, and the closed forms

A block slides to its stop by Coulomb's law; a block on a spring slips, turns and sticks; a ball bounces on a floor of
Kelvin and Voigt, k (x + tau x')+, whose force jumps at touch. nosnoc solves each as a piecewise smooth system
(Nurkanovic et al., 2022), with Coulomb's friction as it is; ours has a stiction speed, which goes to 0. Slopes of
nosnoc are central differences of whole solutions.
"""

import json
import sys
from math import atan2, exp, pi, sin, sqrt
from pathlib import Path

WIDTH = 1e-3
MU, G = 0.5, 9.81
SLIDE = {"v0": 1.0, "T": 0.6}
SPRING = {"k": 100.0, "x0": 0.2, "T": 1.2}  # omega = 10 1/s of 1 kg, half a period 0.314 s
BOUNCE = {"k": 1e3, "tau": 0.01, "z0": 0.6, "v0": -2.0, "T": 0.5}  # 1 kg, radius 0.1 m, no gravity
SPEEDS = (1e-2, 1e-3, 1e-4)  # [m/s] our stiction speed


def theirs() -> dict:
    """{case: (value, slope)} by nosnoc."""
    import casadi as ca
    import nosnoc
    import numpy as np

    x = ca.SX.sym("x", 2)

    def simulate(x0, c, S, F, T, stages):
        opts = nosnoc.NosnocOpts()
        opts.irk_scheme, opts.n_s, opts.N_stages, opts.N_finite_elements = nosnoc.IrkSchemes.RADAU_IIA, 4, 1, 3
        opts.pss_mode, opts.print_level, opts.comp_tol = nosnoc.PssMode.STEWART, 0, 1e-10
        opts.terminal_time = T / stages
        model = nosnoc.NosnocModel(x=x, F=[F], S=[np.array(S)], c=[c], x0=np.array(x0), name="case")
        looper = nosnoc.NosnocSimLooper(nosnoc.NosnocSolver(opts, model), model.x0, stages)
        looper.run()
        return float(looper.get_results()["X_sim"][-1][0])

    def both(run, at):
        return run(at), (run(at + WIDTH) - run(at - WIDTH)) / (2 * WIDTH)

    def coulomb(pull):
        return ca.horzcat(ca.vertcat(x[1], pull - MU * G), ca.vertcat(x[1], pull + MU * G))

    k, tau = BOUNCE["k"], BOUNCE["tau"]
    depth = 0.1 - x[0]
    bracket = depth - tau * x[1]
    free = ca.vertcat(x[1], 0)
    floor = ca.horzcat(ca.vertcat(x[1], k * bracket), free, free, free)
    sides = [[1, 1], [1, -1], [-1, 1], [-1, -1]]  # it pushes where it overlaps and the bracket is above 0
    return {
        "slide": both(lambda v: simulate([0, v], x[1], [[1], [-1]], coulomb(0), SLIDE["T"], 12), SLIDE["v0"]),
        "spring": both(
            lambda z: simulate([z, 0], x[1], [[1], [-1]], coulomb(-SPRING["k"] * x[0]), SPRING["T"], 24), SPRING["x0"]
        ),
        "bounce": both(
            lambda v: simulate([BOUNCE["z0"], v], 100 * ca.vertcat(depth, bracket), sides, floor, BOUNCE["T"], 50),
            BOUNCE["v0"],
        ),
    }


def exact() -> dict:
    """{case: (value, slope)} in closed form."""
    v0, reach = SLIDE["v0"], MU * G / SPRING["k"]
    x, sign, swings = SPRING["x0"], 1.0, 0
    while abs(x) > reach:  # half a swing about where the friction holds the spring
        x, swings = 2 * (reach if x > 0 else -reach) - x, swings + 1
        sign = -sign
    assert swings * pi / sqrt(SPRING["k"]) < SPRING["T"]
    k, tau, start, T = BOUNCE["k"], BOUNCE["tau"], -BOUNCE["v0"], BOUNCE["T"]
    zeta, omega = tau * sqrt(k) / 2, sqrt(k)
    damped = omega * sqrt(1 - zeta**2)
    # x = V exp(-zeta omega t) sin(damped t) / damped, and it leaves where x + tau x' = 0:
    # x' / x = damped / tan(damped t) - zeta omega = -1 / tau
    angle = atan2(damped, zeta * omega - 1 / tau)
    t = angle / damped
    a = exp(-zeta * omega * t) * sin(angle) / damped  # depth there by the speed of touch
    e = a / tau  # and minus its rate
    t_0 = (BOUNCE["z0"] - 0.1) / start
    left = T - t_0 - t
    end = 0.1 - start * a + start * e * left
    by_start = -a + e * left + start * e * t_0 / start
    return {
        "slide": (v0**2 / (2 * MU * G), v0 / (MU * G)),
        "spring": (x, sign),
        "bounce": (end, -by_start),
    }


def ours() -> dict:
    """{case: {stiction speed: (value, slope)}} by the package."""
    root = Path(__file__).parents[1]
    sys.path.insert(0, str(root))
    import logging

    import numpy as np
    from helpers.models import Plant, contact_properties
    from pydrake.multibody.tree import PrismaticSpring

    import drake_diff as dd
    from drake_diff.motion.flow import plant as flow

    logging.getLogger("drake").setLevel(logging.ERROR)

    def block(approximation, stiffness, gravity, friction, relaxation, spring=0.0):
        made = Plant(0.01, approximation, gravity=gravity)
        properties = contact_properties(2 * stiffness, 10.0, friction, relaxation / 2)
        made.ball("block", 1.0, 0.1, properties, "x", "z")
        made.ground(properties)
        if spring:
            made.plant.AddForceElement(PrismaticSpring(made.plant.GetJointByName("block_x"), 0.0, spring))
        return made.model()

    def along(model, x0, number, column, T):
        found = dd.differentiate_rollout(
            model, x0, None, lambda x: x[number], num_steps=round(T / 0.01), method="continuous"
        )
        return found.loss, float(found.by_x0[column])

    rest, results = 0.1 - G / 1e4, {"slide": {}, "spring": {}, "bounce": {}}
    for speed in SPEEDS:
        flow.STICTION_SPEED = speed
        model = block("lagged", 1e4, G, MU, 0.0)
        results["slide"][speed] = along(model, np.array([0, rest, SLIDE["v0"], 0]), 0, 2, SLIDE["T"])
        model = block("lagged", 1e4, G, MU, 0.0, SPRING["k"])
        results["spring"][speed] = along(model, np.array([SPRING["x0"], rest, 0, 0]), 0, 0, SPRING["T"])
    model = block("sap", BOUNCE["k"], 0.0, 0.0, BOUNCE["tau"])
    x0 = np.array([0, BOUNCE["z0"], 0, BOUNCE["v0"]])
    results["bounce"][0.0] = along(model, x0, 1, 3, BOUNCE["T"])
    return results


def main() -> None:
    out = Path(sys.argv[1])
    if not out.exists():
        out.write_text(json.dumps({"theirs": theirs()}, indent=1) + "\n")
    else:
        found = json.loads(out.read_text()) | {"exact": exact()}
        found["ours"] = {name: {f"{v:g}": pair for v, pair in by.items()} for name, by in ours().items()}
        out.write_text(json.dumps(found, indent=1) + "\n")
    print(out.read_text())


if __name__ == "__main__":
    main()
