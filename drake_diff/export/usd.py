"""Drake's plant as USD with UsdPhysics, in the float32 of its schemas; the frames are those of `urdf`.

USD has joint angles, limits and damping in degrees. Joint damping is a drive to velocity 0, which PhysX integrates
implicitly. Armature and contact stiffness are PhysX's own attributes.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from drake_diff.engines.formats import AtZero
from drake_diff.engines.interface import principal, shape_of
from drake_diff.exceptions import MissingDependencyError, ModelError
from drake_diff.mechanics.description import Description, Follower, Geometry, Link

try:
    from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade
except ImportError as error:
    raise MissingDependencyError("USD needs usd-core: pip install 'drake-diff[usd]'") from error

ROOT, GROUND, MATERIALS = "/robot", "/fixed_to_the_world", "/materials"
SHAPES = ("Sphere", "Box", "Cylinder", "Capsule", "HalfSpace")
MIMIC = "NewtonMimicAPI"  # a schema of newton-usd-schemas, which Newton and Isaac Sim read


def usd(description: Description) -> str:
    """Return the text of a .usda file, with the friction of each shape and the contact pairs; `lost` lists the rest.

    Raises ModelError if a link has no mass or moment of inertia (USD would compute it from shapes), if a name is not
    valid in USD, or if a joint follows a joint of another type.
    """
    anchored = _anchored(description)
    moving = [link for link in description.links if link.body not in anchored]
    _refuse(moving, description.followers)
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
        form = UsdGeom.Xform.Define(stage, f"{ROOT}/{link.body}")
        _set_pose(form, zero.frames[link.body])
        if link.body not in anchored:
            _add_inertia(form.GetPrim(), link, zero)
    for link in moving:
        if link.kind != "quaternion_floating":
            _add_joint(stage, link, zero, anchored)
    for follower in description.followers:
        _add_follower(stage, follower, _unit_of(moving, follower.joint))
    prims = {}
    for i, geometry in enumerate(description.geometries):
        if shape_of(geometry)[0] in SHAPES:
            prims[geometry.name] = _add_geometry(stage, i, geometry, zero.in_frame(geometry.body) @ geometry.pose)
            _add_material(stage, i, geometry, prims[geometry.name])
    _filter_pairs(description, prims)
    return str(stage.GetRootLayer().ExportToString())


def _refuse(moving: Sequence[Link], followers: Sequence[Follower]) -> None:
    """Raise ModelError for models that USD cannot represent."""
    kinds = {link.joint: link.kind for link in moving}
    for follower in followers:
        if kinds[follower.joint] != kinds[follower.leader]:
            raise ModelError(
                f"{follower.joint} follows {follower.leader}: in USD a hinge cannot follow a slide, nor a slide a hinge"
            )
    for link in moving:
        if link.mass <= 0 or np.any(principal(link.inertia)[0] <= 0):
            raise ModelError(f"link {link.body}: USD does not support a mass or moment of inertia of 0")
        for name in (link.body, link.joint):
            if not Tf.IsValidIdentifier(name):
                raise ModelError(f"{name!r} is not a valid name in USD")


def lost(description: Description) -> tuple[str, ...]:
    """Return the properties of contact and actuators that the file lacks, with names."""
    kinds = {g.name: shape_of(g)[0] or type(g.shape).__name__ for g in description.geometries}
    losses = [f"the shape of {name} ({kind})" for name, kind in kinds.items() if kind not in SHAPES]
    sides = {g.name: g.material for g in description.geometries}
    for pair in description.pairs:
        a, b = (sides[name].get("friction") for name in pair.names)
        if a != b:
            losses.append(
                f"friction of {' with '.join(pair.names)}: {pair.friction}, in PhysX the average of {a} and {b}"
            )
    if any(pair.dissipation or pair.relaxation_time for pair in description.pairs):
        losses.append("dissipation of contacts")
    limited = [x for x, e in zip(description.inputs, description.effort_limits, strict=True) if np.isfinite(e)]
    return (*losses, *(["effort limits of " + ", ".join(limited)] if limited else []))


def _vector(values: Any) -> Any:
    return Gf.Vec3f(*(float(value) for value in values))


def _quaternion(wxyz: Any) -> Any:
    return Gf.Quatf(*(float(value) for value in wxyz))


def _set_pose(shape: Any, X: RigidTransform) -> None:
    w, *xyz = (float(value) for value in X.rotation().ToQuaternion().wxyz())
    shape.AddTranslateOp().Set(Gf.Vec3d(*(float(p) for p in X.translation())))
    shape.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, *xyz))


def _anchored(description: Description) -> set[str]:
    """Return the world and the bodies welded to it, which in USD are static shapes without mass or joint."""
    bodies = {"world"}
    for link in description.links:
        if link.kind == "weld" and link.parent in bodies:
            bodies.add(link.body)
    return bodies


def _add_inertia(prim: Any, link: Link, zero: AtZero) -> None:
    UsdPhysics.RigidBodyAPI.Apply(prim)
    center, inertia = zero.inertia(link)
    moments, turn = principal(inertia)
    mass = UsdPhysics.MassAPI.Apply(prim)
    mass.CreateMassAttr(link.mass)
    mass.CreateCenterOfMassAttr(_vector(center))
    mass.CreateDiagonalInertiaAttr(_vector(moments))
    mass.CreatePrincipalAxesAttr(_quaternion(turn))


def _add_joint(stage: Any, link: Link, zero: AtZero, anchored: set[str]) -> None:
    name = {"weld": "FixedJoint", "revolute": "RevoluteJoint", "prismatic": "PrismaticJoint"}[link.kind]
    joint = getattr(UsdPhysics, name).Define(stage, f"{ROOT}/joints/{link.joint}")
    if link.parent not in anchored:
        joint.CreateBody0Rel().SetTargets([f"{ROOT}/{link.parent}"])
    joint.CreateBody1Rel().SetTargets([f"{ROOT}/{link.body}"])
    pose = zero.frames[link.body] if link.parent in anchored else zero.in_parent(link)
    joint.CreateLocalPos0Attr(_vector(pose.translation()))
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


def _unit_of(links: Sequence[Link], joint: str) -> float:
    """Return 1 rad or 1 m of this joint in USD's unit of position."""
    return 180 / np.pi if any(x.joint == joint and x.kind == "revolute" for x in links) else 1.0


def _add_follower(stage: Any, follower: Follower, unit: float) -> None:
    prim = stage.GetPrimAtPath(f"{ROOT}/joints/{follower.joint}")
    prim.AddAppliedSchema(MIMIC)
    prim.CreateRelationship("newton:mimicJoint", custom=False).SetTargets([f"{ROOT}/joints/{follower.leader}"])
    for name, value in (("mimicCoef0", follower.offset * unit), ("mimicCoef1", follower.ratio)):
        prim.CreateAttribute(f"newton:{name}", Sdf.ValueTypeNames.Float, custom=False).Set(float(value))


def _add_geometry(stage: Any, number: int, geometry: Geometry, X: RigidTransform) -> Any:
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
        form = UsdGeom.Plane.Define(stage, path)
        form.CreateAxisAttr("Z")
    _set_pose(form, X)
    if kind == "Box":
        form.AddScaleOp().Set(_vector(sizes["size"]))
    UsdPhysics.CollisionAPI.Apply(form.GetPrim())
    return form.GetPrim()


def _add_material(stage: Any, number: int, geometry: Geometry, prim: Any) -> None:
    """Add a material with restitution 0; friction is averaged, which agrees with Drake for equal coefficients."""
    material = UsdShade.Material.Define(stage, f"{MATERIALS}/material_{number}")
    physics = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    physics.CreateRestitutionAttr(0.0)
    if "friction" in geometry.material:
        physics.CreateStaticFrictionAttr(geometry.material["friction"])
        physics.CreateDynamicFrictionAttr(geometry.material["friction"])
    of_physx, kinds = material.GetPrim(), Sdf.ValueTypeNames
    of_physx.AddAppliedSchema("PhysxMaterialAPI")
    of_physx.CreateAttribute("physxMaterial:frictionCombineMode", kinds.Token).Set("average")
    if (stiffness := geometry.material.get("stiffness")) is not None:
        of_physx.CreateAttribute("physxMaterial:compliantContactStiffness", kinds.Float).Set(stiffness)
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")


def _filter_pairs(description: Description, prims: Mapping[str, Any]) -> None:
    """Exclude the contact pairs that Drake excludes."""
    touching = {frozenset(pair.names) for pair in description.pairs}
    body = {g.name: g.body for g in description.geometries}
    for i, name in enumerate(prims):
        others = [n for n in list(prims)[i + 1 :] if body[name] != body[n] and frozenset((name, n)) not in touching]
        if others:
            filtered = UsdPhysics.FilteredPairsAPI.Apply(prims[name])
            filtered.CreateFilteredPairsRel().SetTargets([prims[other].GetPath() for other in others])
