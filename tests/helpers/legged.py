"""Robots, most of them from example-robot-data, on spherical feet whose stiffness is chosen for their weight."""

import re
import tempfile
import warnings
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import numpy as np

import drake_diff as dd
from drake_diff.exceptions import ModelWarning
from drake_diff.legs.feet import Legs
from drake_diff.legs.motion import posture
from drake_diff.model.step import advance

from .models import robot_file

# SINK times a foot's radius times a step in seconds is its depth [m] under an even share of the weight. A radius above
# SMALL [m] gives at most the depth of SMALL, or DEEPEST [m] in short steps. The contact relaxes in RELAXES steps.
SINK, SMALL, DEEPEST, RELAXES = 3.9, 0.016, 1.25e-3, 2.5
DISSIPATION, FRICTION = 0.5, 0.7  # [s/m]
DRAWN, TURNED = 0.08, 0.05  # random offsets of feet and centre of mass, relative to the base's height; [rad]
SETTLES, SETTLE_STEP = 0.6, 0.002  # [s] duration and step of a PD controller that brings a posture to rest


@dataclass(frozen=True)
class Legged:
    """Data that the robot's file does not contain: its feet and their radius [m], its postures and its weight [N].

    Postures are joint positions in the model's order. The gains are those of a PD controller that holds a posture.
    """

    file: str
    feet: tuple[str, ...]
    radius: float
    high: tuple[float, ...]
    low: tuple[float, ...]
    weight: float
    gains: tuple[float, float]
    base: str = "base_link"
    package: str = "example-robot-data"
    soles: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),)  # [m] centres of spheres in a foot's own frame
    drawn: float = DRAWN
    held: str = ""  # a pattern for the start of the names of joints that are fixed
    rotor: tuple[float, float] = (0.0, 1.0)  # [kg m^2] inertia of each motor, and its gear ratio

    @property
    def is_flat(self):
        return len(self.soles) > 1

    @property
    def is_installed(self):
        try:
            self.path()
        except PackageNotFoundError:
            return False
        return True

    def path(self):
        return robot_file(self.file, self.package)

    def depth(self, time_step):
        """Return the depth [m] of a foot on which the robot stands."""
        return min(SINK * self.radius * time_step, max(DEEPEST, SINK * SMALL * time_step))


def _legs(hip, knee, *, hind=1, count=4):
    """Return hips and knees of `count` legs; the legs after the first two are bent `hind` times as much."""
    return tuple(v for leg in range(count) for v in (0.0, *(np.array([hip, knee]) * (hind if leg >= 2 else 1))))


SOLO_FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
GO2_FEET = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")
ANYMAL_FEET = ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT")
CHEETAH_FEET = ("toe_fr", "toe_fl", "toe_hr", "toe_hl")
LEGGED = {
    "solo12": Legged(
        "solo12.urdf", SOLO_FEET, 0.016, _legs(0.8, -1.6, hind=-1), _legs(1.2, -2.4, hind=-1), 24.5, (5.0, 0.1)
    ),
    "go2": Legged("go2.urdf", GO2_FEET, 0.022, _legs(0.8, -1.6), _legs(1.2, -2.4), 158.0, (80.0, 2.0), base="base"),
    "anymal": Legged(
        "anymal_b_simple_description/robots/anymal.urdf", ANYMAL_FEET, 0.031, _legs(0.5, -1.0, hind=-1),
        _legs(1.0, -2.0, hind=-1), 299.0, (300.0, 8.0), base="base",
    ),
    "cheetah": Legged(  # the only package that has it
        "mini_cheetah/mini_cheetah.urdf", CHEETAH_FEET, 0.015, _legs(-0.8, 1.6), _legs(-1.2, 2.4), 86.8, (40.0, 1.0),
        base="body", package="pybullet",
    ),
    "talos": Legged(  # soles of 20 x 12 cm, as specified by its maker; rotors as in talos.srdf
        "talos_reduced.urdf", ("leg_left_6_link", "leg_right_6_link"), 0.016, (0.0, 0.0, -0.45, 0.9, -0.45, 0.0) * 2,
        (0.0, 0.0, -0.65, 1.3, -0.65, 0.0) * 2, 885.0, (4000.0, 40.0), drawn=0.02, held="torso|arm|gripper|head",
        soles=tuple((x, y, -0.091) for x in (-0.1, 0.1) for y in (-0.06, 0.06)), rotor=(1e-5, 100.0),
    ),
}  # fmt: skip


@cache
def robot_on_feet(name, time_step):
    """Write a file of the robot whose feet are spheres, as soft as plans with this step require. All other collision
    shapes are removed."""
    robot = LEGGED[name]
    tree = ElementTree.parse(robot.path())
    root = tree.getroot()
    root.set("xmlns:drake", "http://drake.mit.edu")
    for joint in root.findall("joint"):
        if robot.held and re.match(robot.held, joint.get("name")):
            joint.set("type", "fixed")
    for actuator in root.iter("actuator") if robot.rotor[0] else ():
        for quantity, value in zip(("rotor_inertia", "gear_ratio"), robot.rotor, strict=True):
            ElementTree.SubElement(actuator, f"drake:{quantity}", value=str(value))
    for link in root.findall("link"):
        for kind in ("collision", "visual"):
            for old in link.findall(kind):
                link.remove(old)
        for centre in robot.soles if link.get("name") in robot.feet else ():
            collision = ElementTree.SubElement(link, "collision")
            ElementTree.SubElement(collision, "origin", xyz=" ".join(map(str, centre)))
            ElementTree.SubElement(ElementTree.SubElement(collision, "geometry"), "sphere", radius=str(robot.radius))
            depth, carriers = robot.depth(time_step), len(robot.feet) * len(robot.soles)
            properties = ElementTree.SubElement(collision, "drake:proximity_properties")
            for quantity, value in {
                "point_contact_stiffness": robot.weight / carriers / depth,
                "hunt_crossley_dissipation": RELAXES * time_step / depth if robot.is_flat else DISSIPATION,
                "relaxation_time": RELAXES * time_step,
                "mu_dynamic": FRICTION,
                "mu_static": FRICTION,
            }.items():
                ElementTree.SubElement(properties, f"drake:{quantity}", value=str(value))
    path = Path(tempfile.mkdtemp(prefix="drake_diff_legged_")) / Path(robot.file).name
    tree.write(path)
    return path


@cache
def legged_model(name, time_step=0.02):
    """Return the robot on its feet on a ground, with a motor in each joint."""
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
    """Return a state (nx,) at rest, in which a PD controller holds the joints near `joints`.

    With a `random` generator, the feet, the centre of mass and the base's rotation have random offsets. The centre of
    mass of a robot on flat feet is moved over the middle of the feet first.
    """
    robot, fine = LEGGED[name], model.at_time_step(SETTLE_STEP)
    nq, count, sink = model.nq, len(joints), robot.depth(model.time_step)
    x = np.array(model.default_state)
    x[:nq] = 0.0
    x[0], x[nq - count : nq] = 1.0, joints
    legs = Legs.named(model, robot.feet, x[:nq])
    legs.put(x[:nq])
    x[6] -= np.mean(legs.points()[:, 2]) + sink
    legs.put(x[:nq])
    places, mass, size = legs.points(), legs.center_of_mass(), robot.drawn * x[6]
    if robot.is_flat:
        mass[:2] = np.mean(places[:, :2], axis=0)
    turn = np.zeros(model.nv)
    if random is not None:
        places[:, :2] += size * random.uniform(-1, 1, (len(robot.feet), 2))[legs.owners]
        turn[:3] = TURNED * random.uniform(-1, 1, 3)
        mass += size * random.uniform(-1, 1, 3)
    if random is not None or robot.is_flat:
        places[:, 2] = -sink
        x[:nq] = posture(legs, x[:nq], legs.moved(x[:nq], turn), mass, places)
    kp, kd = robot.gains
    drive, held = model.actuation[-count:], x[nq - count : nq].copy()
    still = _that_hold(legs, x[:nq], count) if robot.is_flat else 0.0
    for _ in range(round(SETTLES / SETTLE_STEP)):
        torque = still + kp * (held - x[nq - count : nq]) - kd * x[-count:]
        x = np.array(advance(fine.double, x, np.linalg.solve(drive, torque)))
    x[nq:] = 0.0
    return x


def _that_hold(legs, q, count):
    """Return the joint torques (count,) that hold posture q (nq,), with the least forces at the soles."""
    legs.put(q)
    needed, by_force = (
        legs.twin.inverse_dynamics(np.zeros(legs.model.nv)),
        legs.jacobian().reshape(-1, legs.model.nv).T,
    )
    base = slice(legs.base_v, legs.base_v + 6)
    forces = np.linalg.lstsq(by_force[base], needed[base], rcond=None)[0]
    return (needed - by_force @ forces)[-count:]
