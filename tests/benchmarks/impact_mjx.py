"""Derivatives of rollouts by MJX's own automatic differentiation, in an environment of its own.

    python -m venv mjx && mjx/bin/pip install mujoco-mjx jax
    mjx/bin/python tests/benchmarks/impact_mjx.py IN.json OUT.json

IN has what `impact_peers.for_mjx` writes: MJCF, first state, the direction in which it is moved, steps, and which
number of the last state is the loss. OUT has of each the loss, its derivative by jax.jvp through mjx.step in double
precision, and the seconds of compilation and run. Where that is no number under the elliptic cone of friction, which
has no derivative at rest, it is taken again under the pyramidal one, MuJoCo's default. Nothing of drake_diff is needed.
"""

import json
import math
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

jax.config.update("jax_enable_x64", True)


def derivative(given: dict) -> dict:
    """Of one rollout."""
    model = mjx.put_model(mujoco.MjModel.from_xml_string(given["mjcf"]))
    start = mjx.make_data(model)
    ctrl = jnp.array(given["ctrl"])

    def end(s):
        qpos = jnp.array(given["qpos"]) + s * jnp.array(given["qpos_direction"])
        qvel = jnp.array(given["qvel"]) + s * jnp.array(given["qvel_direction"])
        data = start.replace(qpos=qpos, qvel=qvel, ctrl=ctrl)
        data, _ = jax.lax.scan(lambda d, _: (mjx.step(model, d), None), data, None, length=given["steps"])
        along = jnp.concatenate([data.qpos, data.qvel]) @ jnp.array(given["loss"]) + given["constant"]
        return along if given["target"] is None else 0.5 * (along - given["target"]) ** 2

    begin = time.perf_counter()
    run = jax.jit(lambda s: jax.jvp(end, (s,), (1.0,))).lower(0.0).compile()
    compiled = time.perf_counter()
    value, slope = (float(one) for one in run(0.0))
    return {"loss": value, "slope": slope, "compile": compiled - begin, "run": time.perf_counter() - compiled}


def main() -> None:
    given, out = (Path(argument) for argument in sys.argv[1:])
    found = {}
    for name, one in json.loads(given.read_text()).items():
        try:
            found[name] = derivative(one)
            if math.isnan(found[name]["slope"]):
                pyramids = one | {"mjcf": one["mjcf"].replace('cone="elliptic"', 'cone="pyramidal"')}
                found[name] = derivative(pyramids) | {"cone": "pyramidal"}
        except Exception as error:  # of whatever kind: it is what is reported of the case
            found[name] = {"error": f"{type(error).__name__}: {str(error)[:200]}"}
        print(name, found[name], flush=True)
        out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
