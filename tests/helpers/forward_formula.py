"""The step of engines without derivatives, in double precision, from Drake's mass matrix and bias."""

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.multibody.tree import SpatialInertia

import drake_diff as dd
from helpers.models import Plant


def free_box(center=(0.0, 0.0, 0.0), time_step=0.01, *, mass=2.0):
    plant = Plant(time_step)
    about_origin = SpatialInertia.SolidBoxWithMass(mass, 0.1, 0.2, 0.3).Shift(-np.array(center))
    plant.plant.AddRigidBody("box", about_origin)
    return plant.model()


def formula(model, x, u, *, exponential=False):
    """Return a step from Drake's M and bias: explicit damping, free bodies by their centres, quaternions by rates."""
    drake, h, nq = dd.engines.load_engine("drake", model), model.time_step, model.nq
    q, v = np.asarray(x)[:nq], np.asarray(x)[nq:]
    force = drake.description.actuation @ u - drake.bias(q, v) - drake.description.by_velocity("damping") * v
    v_next = v + h * np.linalg.solve(drake.mass_matrix(q), force)
    q_next = q + h * drake.description.coordinates.rate(q) @ v_next
    for link in drake.description.moving:
        if link.kind == "quaternion_floating":
            i, j = link.q_start, link.v_start
            q_next[i : i + 4] /= np.linalg.norm(q_next[i : i + 4])
            if exponential:
                half = model.time_step * v_next[j : j + 3] / 2
                s = np.sinc(np.linalg.norm(half) / np.pi) * half
                turn = Quaternion(np.array([np.cos(np.linalg.norm(half)), *s]))
                q_next[i : i + 4] = turn.multiply(Quaternion(q[i : i + 4] / np.linalg.norm(q[i : i + 4]))).wxyz()
            arms = [turned(p[i : i + 4]) @ link.center_of_mass for p in (q, q_next)]
            w, a = v[j : j + 3], (v_next - v)[j : j + 6] / h
            by_center = v[j + 3 : j + 6] + np.cross(w, arms[0])
            by_center += h * (a[3:] + np.cross(a[:3], arms[0]) + np.cross(w, np.cross(w, arms[0])))
            q_next[i + 4 : i + 7] = q[i + 4 : i + 7] + arms[0] + h * by_center - arms[1]
            v_next[j + 3 : j + 6] = by_center - np.cross(v_next[j : j + 3], arms[1])
    return np.concatenate([q_next, v_next])


def turned(quaternion):
    return Quaternion(quaternion / np.linalg.norm(quaternion)).rotation()
