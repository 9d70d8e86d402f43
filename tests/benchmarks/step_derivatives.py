"""How long the Jacobian of one step takes from each source, side by side, as a ratio to AutoDiffXd.

    python tests/benchmarks/step_derivatives.py

Medians of calls in blocks that take turns, so that a machine that slows down slows all of them.
"""

import re
import statistics
import tempfile
import time
import warnings
from importlib.metadata import files
from pathlib import Path

import numpy as np

import drake_diff as dd
from drake_diff.exceptions import ModelWarning

MODELS = Path(__file__).parents[2] / "models"
METHODS = ("autodiff", "implicit", "finite_difference", "auto")
BLOCKS, CALLS = 12, 25


def robot(name: str) -> Path:
    return next(Path(f.locate()) for f in files("example-robot-data") or () if str(f).endswith("/" + name))


def panda_arm(folder: Path) -> Path:
    """The Panda's seven joints with actuators, its fingers fixed, without meshes."""
    text = re.sub(r"<mimic[^>]*/>|<(visual|collision)>.*?</\1>", "", robot("panda.urdf").read_text(), flags=re.S)
    text = re.sub(r'(<joint name="panda_finger_joint\d" type=")prismatic', r"\1fixed", text)
    motors = "".join(
        f'<transmission name="t{i}"><type>transmission_interface/SimpleTransmission</type>'
        f'<joint name="panda_joint{i}"><hardwareInterface>EffortJointInterface</hardwareInterface></joint>'
        f'<actuator name="motor{i}"/></transmission>'
        for i in range(1, 8)
    )
    path = folder / "panda_arm.urdf"
    path.write_text(text.replace("</robot>", motors + "</robot>"))
    return path


def state(model: dd.Model, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Near the middle of the joints' limits, moving."""
    lower, upper = model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()
    limited = np.isfinite(lower) & np.isfinite(upper)
    x = model.default_state
    x[: model.nq][limited] = (lower[limited] + upper[limited]) / 2 + 0.05 * random.standard_normal(int(limited.sum()))
    x[model.nq :] = 0.5 * random.standard_normal(model.nv)
    return x, 0.1 * random.standard_normal(model.nu)


def medians(model: dd.Model) -> tuple[dict[str, float], str]:
    """[us] by method, and what "auto" chose."""
    x, u = state(model, np.random.default_rng(0))
    times: dict[str, list[float]] = {method: [] for method in METHODS}
    chosen = dd.differentiate_step(model, x, u).method
    for _ in range(BLOCKS):
        for method in METHODS:
            dd.differentiate_step(model, x, u, method=method)  # the first after another method allocates anew
            for _ in range(CALLS):
                start = time.perf_counter()
                dd.differentiate_step(model, x, u, method=method)
                times[method].append(1e6 * (time.perf_counter() - start))
    return {method: statistics.median(values) for method, values in times.items()}, chosen


def main() -> None:
    warnings.simplefilter("ignore", ModelWarning)
    with tempfile.TemporaryDirectory() as folder:
        models = {
            "pendulum": MODELS / "pendulum.urdf",
            "acrobot": MODELS / "acrobot.xml",
            "UR5": robot("ur5_robot.urdf"),
            "Panda arm": panda_arm(Path(folder)),
            "Solo12": robot("solo12.urdf"),
        }
        print(f"{'model':12}{'joints':>7}" + "".join(f"{method:>19}" for method in METHODS) + "  auto chose")
        for name, path in models.items():
            weld = "panda_link0" if name == "Panda arm" else None
            model = dd.load_model(path, time_step=0.005, weld_base=weld)
            found, chosen = medians(model)
            cells = "".join(f"{value:10.0f} us {found['autodiff'] / value:4.2f}x".rjust(19) for value in found.values())
            print(f"{name:12}{model.nv:7}{cells}  {chosen}")


if __name__ == "__main__":
    main()
