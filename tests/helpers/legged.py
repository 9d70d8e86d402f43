"""Robots of example-robot-data that stand on spheres: their feet, as soft as their weight asks for."""

import tempfile
import warnings
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

import drake_diff as dd
from drake_diff.exceptions import ModelWarning
from drake_diff.model.step import advance
from drake_diff.optimize.scheduled.legs import Legs

from .models import robot_file

# How deep a foot is under an even share of the weight, of its radius times a step in seconds; steps.
SINK, RELAXES = 3.9, 2.5
DISSIPATION, FRICTION = 0.5, 0.7  # [s/m]
DRAWN, TURNED = 0.08, 0.05  # of the base's height, how far feet and centre of mass are drawn; [rad]
SETTLES, SETTLE_STEP = 0.6, 0.002  # [s] of a PD controller that brings a posture to rest


@dataclass(frozen=True)
class Legged:
    """What its file does not tell: which bodies are feet, of which radius [m], its postures and its weight [N].

    Postures are those of the joints in the order of the model, gains those of a PD controller that holds them.
    """

    file: str
    feet: tuple[str, ...]
    radius: float
    high: tuple[float, ...]
    low: tuple[float, ...]
    weight: float
    gains: tuple[float, float]
    base: str = "base_link"

    @property
    def sinks(self):
        """[m/s] times a step: how deep a foot is where the robot stands."""
        return SINK * self.radius


def _legs(hip, knee, *, hind=1, count=4):
    """Hips and knees of so many legs; those behind the first two are bent `hind` times as much."""
    return tuple(v for leg in range(count) for v in (0.0, *(np.array([hip, knee]) * (hind if leg >= 2 else 1))))


SOLO_FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
GO2_FEET = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")
ANYMAL_FEET = ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT")
LEGGED = {
    "solo12": Legged(
        file="solo12.urdf",
        feet=SOLO_FEET,
        radius=0.016,
        high=_legs(0.8, -1.6, hind=-1),
        low=_legs(1.2, -2.4, hind=-1),
        weight=24.5,
        gains=(5.0, 0.1),
    ),
    "go2": Legged(
        file="go2.urdf",
        feet=GO2_FEET,
        radius=0.022,
        high=_legs(0.8, -1.6),
        low=_legs(1.2, -2.4),
        weight=158.0,
        gains=(80.0, 2.0),
        base="base",
    ),
    "anymal": Legged(
        file="anymal_b_simple_description/robots/anymal.urdf",
        feet=ANYMAL_FEET,
        radius=0.031,
        high=_legs(0.5, -1.0, hind=-1),
        low=_legs(1.0, -2.0, hind=-1),
        weight=299.0,
        gains=(300.0, 8.0),
        base="base",
    ),
}


@cache
def robot_on_feet(name, time_step):
    """A file of that robot in which its feet are spheres, as soft as plans in such steps are found with; all else that
    can touch is left out."""
    robot = LEGGED[name]
    tree = ElementTree.parse(robot_file(robot.file))
    root = tree.getroot()
    root.set("xmlns:drake", "http://drake.mit.edu")
    for link in root.findall("link"):
        for kind in ("collision", "visual"):
            for old in link.findall(kind):
                link.remove(old)
        if link.get("name") in robot.feet:
            collision = ElementTree.SubElement(link, "collision")
            ElementTree.SubElement(ElementTree.SubElement(collision, "geometry"), "sphere", radius=str(robot.radius))
            properties = ElementTree.SubElement(collision, "drake:proximity_properties")
            for quantity, value in (
                ("point_contact_stiffness", robot.weight / len(robot.feet) / (robot.sinks * time_step)),
                ("hunt_crossley_dissipation", DISSIPATION),
                ("relaxation_time", RELAXES * time_step),
                ("mu_dynamic", FRICTION),
                ("mu_static", FRICTION),
            ):
                ElementTree.SubElement(properties, f"drake:{quantity}", value=str(value))
    path = Path(tempfile.mkdtemp(prefix="drake_diff_legged_")) / Path(robot.file).name
    tree.write(path)
    return path


@cache
def legged_model(name, time_step=0.02):
    """The robot on its feet on a ground, a motor in each joint."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        return dd.load_model(
            robot_on_feet(name, time_step),
            time_step=time_step,
            base="free",
            actuators="all",
            ground=FRICTION,
            contact="ground",
            near_rigid=0.1,
        )


def rest(name, model, joints, random=None):
    """(nx,) a state at rest, the joints held at about `joints` by a PD controller.

    With a `random` generator the feet are drawn from about where they are, and the centre of mass and the base's turn.
    """
    robot, fine = LEGGED[name], model.at_time_step(SETTLE_STEP)
    nq, count, sink = model.nq, len(joints), robot.sinks * model.time_step
    x = np.array(model.default_state)
    x[:nq] = 0.0
    x[0], x[nq - count : nq] = 1.0, joints
    legs = Legs(model, robot.feet, x[:nq])
    legs.put(x[:nq])
    x[6] -= np.mean(legs.points()[:, 2]) + sink
    if random is not None:
        legs.put(x[:nq])
        places, mass, size = legs.points(), np.array(legs.center_of_mass()[0]), DRAWN * x[6]
        places[:, :2] += size * random.uniform(-1, 1, (len(places), 2))
        places[:, 2] = -sink
        turn = np.zeros(model.nv)
        turn[:3] = TURNED * random.uniform(-1, 1, 3)
        mass += size * random.uniform(-1, 1, 3)
        x[:nq] = legs.posture(x[:nq], legs.moved(x[:nq], turn), mass, places, np.zeros(len(places), dtype=bool))
    kp, kd = robot.gains
    drive, held = model.actuation[-count:], x[nq - count : nq].copy()
    for _ in range(round(SETTLES / SETTLE_STEP)):
        torque = kp * (held - x[nq - count : nq]) - kd * x[-count:]
        x = np.array(advance(fine.double, x, np.linalg.solve(drive, torque)))
    x[nq:] = 0.0
    return x
