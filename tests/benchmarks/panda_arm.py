"""A Panda with seven joints, and random states near the middle of the joint limits, for several benchmarks."""

import re
from importlib.metadata import files
from pathlib import Path

import numpy as np

import drake_diff as dd

MODELS = Path(__file__).parents[2] / "models"


def robot(name: str) -> Path:
    return next(Path(f.locate()) for f in files("example-robot-data") or () if str(f).endswith("/" + name))


def panda_arm(folder: Path) -> Path:
    """Write a Panda with seven actuated joints, fixed fingers and no meshes, and return the path."""
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
    """Return a random moving state near the middle of the joint limits, and random inputs."""
    lower, upper = model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()
    limited = np.isfinite(lower) & np.isfinite(upper)
    x = model.default_state
    x[: model.nq][limited] = (lower[limited] + upper[limited]) / 2 + 0.05 * random.standard_normal(int(limited.sum()))
    x[model.nq :] = 0.5 * random.standard_normal(model.nv)
    return x, 0.1 * random.standard_normal(model.nu)
