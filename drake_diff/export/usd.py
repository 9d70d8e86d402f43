"""Drake's plant as USD with UsdPhysics, in the float32 that its schemas have; the frames are those of `urdf`.

Angles of joints are in degrees there, and so are limits and damping. Joint damping is a drive to velocity 0, which
PhysX takes implicitly; the armature is PhysX's own attribute.
"""

from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from drake_diff.engines.common import principal, shape_of
from drake_diff.engines.urdf import AtZero
from drake_diff.exceptions import MissingDependencyError, ModelError
from drake_diff.mechanics.description import Description, Geometry, Link

try:
    from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics
except ImportError as error:
    raise MissingDependencyError("USD needs usd-core: pip install 'drake-diff[usd]'") from error

ROOT, GROUND = "/robot", "/fixed_to_the_world"


def usd(description: Description) -> str:
    """The text of a .usda file. Shapes that are no sphere, box, cylinder or capsule are left out, and friction is.

    ModelError where a link has no mass or moment of inertia, which USD takes for one to be computed from its shapes,
    and where a name is none of USD's.
    """
    for link in description.links:
        if link.mass <= 0 or np.any(principal(link.inertia)[0] <= 0):
            raise ModelError(f"link {link.body}: USD cannot hold a mass or moment of inertia of 0")
        for name in (link.body, link.joint):
            if not Tf.IsValidIdentifier(name):
                raise ModelError(f"{name!r} is not a valid name in USD")
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    scene, size = UsdPhysics.Scene.Define(stage, "/physicsScene"), float(np.linalg.norm(description.gravity))
    scene.CreateGravityDirectionAttr(_vector(description.gravity / size if size else [0, 0, -1]))
    scene.CreateGravityMagnitudeAttr(size)
    root = UsdGeom.Xform.Define(stage, ROOT).GetPrim()
    stage.SetDefaultPrim(root)
    UsdPhysics.ArticulationRootAPI.Apply(root)
    zero = AtZero(description)
    for link in description.links:
        _add_link(stage, link, zero)
    for link in description.links:
        if link.kind != "quaternion_floating":
            _add_joint(stage, link, zero)
    for i, geometry in enumerate(description.geometries):
        _add_geometry(stage, i, geometry, zero.in_frame(geometry.body) @ geometry.pose)
    return str(stage.GetRootLayer().ExportToString())


def _vector(values: Any) -> Any:
    return Gf.Vec3f(*(float(value) for value in values))


def _quaternion(wxyz: Any) -> Any:
    return Gf.Quatf(*(float(value) for value in wxyz))


def _place(shape: Any, X: RigidTransform) -> None:
    w, *xyz = (float(value) for value in X.rotation().ToQuaternion().wxyz())
    shape.AddTranslateOp().Set(Gf.Vec3d(*(float(p) for p in X.translation())))
    shape.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, *xyz))


def _add_link(stage: Any, link: Link, zero: AtZero) -> None:
    form = UsdGeom.Xform.Define(stage, f"{ROOT}/{link.body}")
    _place(form, zero.frames[link.body])
    UsdPhysics.RigidBodyAPI.Apply(form.GetPrim())
    center, inertia = zero.inertia(link)
    moments, turn = principal(inertia)
    mass = UsdPhysics.MassAPI.Apply(form.GetPrim())
    mass.CreateMassAttr(link.mass)
    mass.CreateCenterOfMassAttr(_vector(center))
    mass.CreateDiagonalInertiaAttr(_vector(moments))
    mass.CreatePrincipalAxesAttr(_quaternion(turn))


def _add_joint(stage: Any, link: Link, zero: AtZero) -> None:
    name = {"weld": "FixedJoint", "revolute": "RevoluteJoint", "prismatic": "PrismaticJoint"}[link.kind]
    joint = getattr(UsdPhysics, name).Define(stage, f"{ROOT}/joints/{link.joint}")
    if link.parent != "world":
        joint.CreateBody0Rel().SetTargets([f"{ROOT}/{link.parent}"])
    joint.CreateBody1Rel().SetTargets([f"{ROOT}/{link.body}"])
    joint.CreateLocalPos0Attr(_vector(zero.in_parent(link).translation()))
    joint.CreateLocalPos1Attr(_vector([0, 0, 0]))
    if link.kind == "weld":
        return
    turn = _quaternion(RotationMatrix.MakeFromOneVector(zero.axis(link), 0).ToQuaternion().wxyz())
    joint.CreateAxisAttr("X")
    joint.CreateLocalRot0Attr(turn)
    joint.CreateLocalRot1Attr(turn)
    unit = 180 / np.pi if link.kind == "revolute" else 1.0
    for limit, create in ((link.lower, joint.CreateLowerLimitAttr), (link.upper, joint.CreateUpperLimitAttr)):
        if np.isfinite(limit):
            create(float(limit * unit))
    drive = UsdPhysics.DriveAPI.Apply(joint.GetPrim(), "angular" if link.kind == "revolute" else "linear")
    drive.CreateTypeAttr("force")
    drive.CreateDampingAttr(float(link.damping / unit))
    drive.CreateStiffnessAttr(float(link.stiffness / unit))
    drive.CreateTargetPositionAttr(float(link.rest * unit))
    joint.GetPrim().AddAppliedSchema("PhysxJointAPI")
    joint.GetPrim().CreateAttribute("physxJoint:armature", Sdf.ValueTypeNames.Float).Set(float(link.armature))


def _add_geometry(stage: Any, number: int, geometry: Geometry, X: RigidTransform) -> None:
    kind, sizes = shape_of(geometry)
    parent = GROUND if geometry.body == "world" else f"{ROOT}/{geometry.body}"
    path = f"{parent}/collision_{number}"
    if kind in ("Sphere", "Cylinder", "Capsule"):
        form = getattr(UsdGeom, kind).Define(stage, path)
        form.CreateRadiusAttr(sizes["radius"][0])
        if "length" in sizes:
            form.CreateAxisAttr("Z")
            form.CreateHeightAttr(sizes["length"][0])
    elif kind == "Box":
        form = UsdGeom.Cube.Define(stage, path)
        form.CreateSizeAttr(1.0)
    else:
        return
    _place(form, X)
    if kind == "Box":
        form.AddScaleOp().Set(_vector(sizes["size"]))
    UsdPhysics.CollisionAPI.Apply(form.GetPrim())
