"""Meshes in robot files: their files are searched on the disk, and collision meshes are converted for Drake.

Drake accepts collision meshes only as OBJ, VTK and glTF. For any other mesh, the parser receives a tiny sphere as a
placeholder, so that it reads pose, friction and filters as usual. The sphere is then replaced. No file is written.
"""

import re
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote
from xml.sax.saxutils import escape

import numpy as np
from pydrake import geometry as pg
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import PackageMap
from pydrake.multibody.plant import MultibodyPlant

from drake_diff.exceptions import ModelError
from drake_diff.model.contact_geometry import add_spheres, exclude
from drake_diff.model.file_facts import Mjcf
from drake_diff.model.triangles import (
    OF_MUJOCO,
    READ_BY_TRIMESH,
    CoverSpheres,
    Hull,
    Triangles,
    as_obj,
    fit_spheres,
    hull_of_file,
    read_mesh,
    scaled,
)
from drake_diff.model.xml_text import Element, XmlText

TREATMENTS = ("skip", "convex", "spheres")
NOT_OBJ = tuple(ending for ending in READ_BY_TRIMESH if ending != ".obj")  # Drake reads only .obj in MJCF
USABLE_MESHES = (".obj", ".vtk", ".gltf", ".glb")  # formats that Drake reads
PLACEHOLDER = 1.2345678e-9  # [m] the radius of the first placeholder, unlikely in any file
SAME_MASS = 1e-6  # relative
MOST_TOLD = 12  # maximum number of entries in a note; links with the same file and scale count once

Scale = tuple[float, float, float]
DOWNLOADED = "drake_models"  # the package that Drake would download


@dataclass(frozen=True)
class CollisionMesh:
    """A collision mesh to be converted."""

    link: str
    path: Path
    scale: Scale


@dataclass
class FileMeshes:
    """The meshes of robot files: the replacements of placeholders, and the ignored meshes.

    `wanted` contains the collision meshes of URDF and SDF by the radius of their placeholder [m]. `converted` contains
    MJCF meshes by the OBJ file in `folder` that Drake reads instead, and `whole` the other files that MJCF names.
    """

    treatment: str
    folder: Path
    wanted: dict[float, CollisionMesh] = field(default_factory=dict)
    converted: dict[str, Path] = field(default_factory=dict)
    whole: dict[str, Path] = field(default_factory=dict)
    skipped: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    unusable: list[str] = field(default_factory=list)
    hollow: list[str] = field(default_factory=list)

    def notes(self) -> list[str]:
        """Return a sentence for each kind of mesh that is not used."""
        sentences = {
            f"{len(self.skipped)} collision meshes skipped, Drake uses only {' '.join(USABLE_MESHES)}: "
            f'{_listed(self.skipped)}. meshes="convex" or meshes="spheres" uses them.': self.skipped,
            f"{len(self.missing)} meshes skipped, no file found: {_listed(self.missing)}. Links without a shape "
            "are drawn as a skeleton; packages={name: folder} gives the folder of a package.": self.missing,
            f"{len(self.unusable)} meshes skipped, they cannot be used: {_listed(self.unusable)}.": self.unusable,
            f"{len(self.hollow)} inertias use the exact volume of a mesh, unlike MuJoCo's default rule: "
            f'{_listed(self.hollow)}. With inertia="exact" of the mesh, or an <inertial>, both agree.': self.hollow,
        }
        return [sentence for sentence, names in sentences.items() if names]


def _listed(names: list[str]) -> str:
    more = f"; and {len(names) - MOST_TOLD} more" if len(names) > MOST_TOLD else ""
    return "; ".join(names[:MOST_TOLD]) + more


def read_meshes(meshes: FileMeshes, xml: XmlText, path: Path, packages: PackageMap) -> None:
    """Edit the meshes in `xml`, the text of the robot file at `path`.

    Raises ModelError if a scale is not a number.
    """
    if xml.root.tag == "mujoco":
        _convert_assets(meshes, xml, path)
        _look_for_hollows(meshes, xml, path)
        return
    for element in list(xml.root.iter("visual", "collision")):
        mesh = next(element.iter("mesh"), None)
        if mesh is not None:
            try:
                _change(meshes, xml, element, mesh, resolve_uri(_uri(mesh), path, packages))
            except ModelError as error:
                raise ModelError(f"{path}:{mesh.line}: {error}") from error


def _convert_assets(meshes: FileMeshes, xml: XmlText, path: Path) -> None:
    """Replace each mesh of an MJCF file that Drake does not read by an OBJ file.

    Drake then computes masses from the OBJ, as MuJoCo does; `put_meshes` restores the original meshes afterwards.
    """
    for mesh in assets_of(xml):
        file = in_any_case(asset_of(xml, mesh, path)) if mesh.get("file") else None
        if file is None:
            continue  # Drake will report it
        if file.suffix.lower() not in (*NOT_OBJ, OF_MUJOCO):
            meshes.whole[str(file)] = file
            continue
        try:
            triangles = read_mesh(file)
        except ModelError as error:
            raise ModelError(f"{path}:{mesh.line}: {error}") from error
        obj = meshes.folder / f"mesh_{len(meshes.converted)}" / f"{file.stem}.obj"
        obj.parent.mkdir()
        obj.write_text(as_obj(triangles))
        meshes.converted[str(obj)] = file
        xml.set(mesh, "file", str(obj))


def _look_for_hollows(meshes: FileMeshes, xml: XmlText, path: Path) -> None:
    """Note each geom whose volume by MuJoCo's default rule for meshes differs from the exact volume, with both."""
    mjcf = Mjcf(xml)
    files = {mesh.get("name") or Path(mesh.get("file")).stem: mesh for mesh in assets_of(xml)}
    for body in xml.root.of_world("body"):
        for geom in body.findall("geom") if not body.findall("inertial") else ():
            name, density = mjcf.mesh_and_density(geom)
            mesh = files.get(name)
            if mesh is None or mjcf.attributes(mesh).get("inertia", "legacy") != "legacy":
                continue
            exact, legacy = _volumes_of(xml, mesh, path)
            if abs(legacy - exact) > SAME_MASS * legacy:
                both = f"{density * exact:.4g} kg, MuJoCo {density * legacy:.4g}"
                if not density:
                    both = f"mass as given, {exact:.4g} m^3, MuJoCo {legacy:.4g}"
                meshes.hollow.append(f"{body.get('name', '?')} ({both})")


def _volumes_of(xml: XmlText, mesh: Element, path: Path) -> tuple[float, float]:
    """Return the `volumes` of a mesh in an MJCF file, or 0 if it is unreadable, an error that Drake will report."""
    file = in_any_case(asset_of(xml, mesh, path)) if mesh.get("file") else None
    if file is not None and file.suffix.lower() in READ_BY_TRIMESH:
        with suppress(ModelError):
            return volumes(scaled(read_mesh(file), _scale(mesh, file.name)))
    return 0.0, 0.0


def volumes(mesh: Triangles) -> tuple[float, float]:
    """Return the volume [m^3] of a closed mesh, and the volume by MuJoCo's default inertia="legacy".

    The legacy volume adds all pyramids over the faces, even those that the exact volume subtracts. Their first apex is
    the centre of the faces, and their second apex the centre of mass of the first pyramids.
    """
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    areas, middles = np.linalg.norm(normals, axis=1), np.mean(corners, axis=1)
    with np.errstate(all="ignore"):  # for a flat mesh, neither exists
        top = areas @ middles / np.sum(areas)
        sizes = np.abs(np.sum((middles - top) * normals, axis=1))
        top = sizes @ (0.75 * middles + 0.25 * top) / np.sum(sizes)
    pyramids = np.sum((middles - top) * normals, axis=1) / 3
    return abs(float(np.sum(pyramids))), float(np.sum(np.abs(pyramids)))


def assets_of(xml: XmlText) -> list[Element]:
    """Return the meshes that an MJCF file declares."""
    return xml.root.findall("asset", "mesh")


def asset_of(xml: XmlText, mesh: Element, path: Path) -> Path:
    """Return the path of the file of an MJCF mesh or texture, using the folders in <compiler>."""
    name, folders = mesh.get("file"), dict[str, str]()
    kind = "texturedir" if mesh.tag == "texture" else "meshdir"
    for compiler in xml.root.findall("compiler"):
        folders |= compiler.attributes
    if folders.get("strippath") == "true":
        name = Path(name).name
    return (path.parent / folders.get(kind, folders.get("assetdir", "")) / name).absolute()


def _change(meshes: FileMeshes, xml: XmlText, element: Element, mesh: Element, location: Path | None) -> None:
    """Edit a visual or collision element according to the file of its mesh."""
    uri, link = _uri(mesh), element.parent.get("name", "?") if element.parent else "?"
    if f"//{DOWNLOADED}/" in uri and not location:
        return
    file, label = file_at(location), f"{link} {element.tag} {uri}"
    scale = _scale(mesh, label)
    ending = Path(uri).suffix.lower()
    if ending not in (*USABLE_MESHES, *READ_BY_TRIMESH):
        meshes.unusable.append(f"{label} (an unknown format)")
        xml.remove(element)
    elif file is None:
        meshes.missing.append(label)
        xml.remove(element)
    elif element.tag == "visual" or (meshes.treatment == "skip" and ending in USABLE_MESHES):
        if location is None or not location.is_file() or ":///" in uri.removeprefix("file"):  # Drake would not find it
            set_uri(xml, mesh, f"file://{file}")
    elif meshes.treatment == "skip":
        meshes.skipped.append(label)
        xml.remove(element)
    else:
        wanted = CollisionMesh(link, file, scale)
        try:
            _became(wanted, meshes.treatment)
        except ModelError as error:
            meshes.unusable.append(f"{label} ({error})")
            xml.remove(element)
            return
        radius = PLACEHOLDER * (1 + len(meshes.wanted))
        meshes.wanted[radius] = wanted
        _put_sphere(xml, element, mesh, radius, file.stem)


def _uri(mesh: Element) -> str:
    uri = mesh.find("uri")
    return (mesh.get("filename") or (uri.text if uri else "")).strip()


def _scale(mesh: Element, label: str) -> Scale:
    child = mesh.find("scale")
    text = mesh.get("scale") or (child.text if child else "") or "1"
    try:
        numbers = [float(number) for number in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 3) or not all(np.isfinite(numbers)) or 0 in numbers:
        raise ModelError(f"{label}: expected a scale of one or three numbers that are not 0, got {text!r}")
    return numbers[0], numbers[-1 if len(numbers) == 1 else 1], numbers[-1]


def _put_sphere(xml: XmlText, element: Element, mesh: Element, radius: float, stem: str) -> None:
    """Replace a mesh by a placeholder sphere, in the syntax of the format."""
    of_urdf, of_sdf = f'<sphere radius="{radius!r}"/>', f"<sphere><radius>{radius!r}</radius></sphere>"
    xml.replace(mesh, of_urdf if xml.root.tag == "robot" else of_sdf)
    if not element.get("name") and element.parent is not None:  # Drake would name it after the sphere
        names = {other.get("name") for other in element.parent.findall("collision")}
        name = next(n for n in (stem, *(f"{stem}_{i}" for i in range(len(names) + 1))) if n not in names)
        xml.set(element, "name", name)


def set_uri(xml: XmlText, element: Element, name: str) -> None:
    """Set the file of a mesh or an include."""
    uri = element.find("uri")
    if uri is not None:
        xml.fill(uri, escape(name))
    else:
        xml.set(element, "filename", name)


def make_absolute(xml: XmlText, path: Path) -> None:
    """Make the relative paths of meshes and included models absolute.

    A model that Drake reads from a string has no folder as the base of relative paths.
    """
    if xml.root.tag == "mujoco":
        for mesh in assets_of(xml):
            if mesh.get("file") and not Path(mesh.get("file")).is_absolute():
                xml.set(mesh, "file", str(asset_of(xml, mesh, path)))
        for include in xml.root.iter("include"):  # the remaining includes are missing files
            xml.set(include, "file", str((path.parent / include.get("file")).absolute()))
        return
    for element in xml.root.iter("mesh", "include"):
        uri = _uri(element)
        if uri and "://" not in uri and (path.parent / uri).exists():
            set_uri(xml, element, f"file://{(path.parent / uri).resolve()}")


def file_at(location: Path | None) -> Path | None:
    """Return the file at a path, ignoring case, with or without URL escapes."""
    return None if location is None else in_any_case(location) or in_any_case(Path(unquote(str(location))))


def resolve_uri(uri: str, path: Path, packages: PackageMap) -> Path | None:
    """Return the exact path of `uri`, or None if it is not on this disk."""
    package = re.match(r"(?:package|model)://+([^/]+)/(.*)", uri, re.DOTALL)
    if not package:
        start, name = path.parent.absolute(), uri.removeprefix("file://")
    elif packages.Contains(package[1]):
        start, name = Path(packages.GetPath(package[1])), package[2]
    else:  # package:///NAME/, which `read_into` did not handle
        above = next((p for p in path.resolve().parents if p.name == package[1]), None)
        if above is None:
            return None
        start, name = above, package[2]
    return None if "://" in name or "\0" in name or not name else start / name


def in_any_case(path: Path) -> Path | None:
    """Return the file at an absolute `path`, or the first file whose path differs only in case."""
    try:
        if path.is_file():
            return path.resolve()
        here = Path(path.anchor)
        for component in path.parts[1:]:
            step = here / component
            if component != ".." and not step.exists():
                same = [other.name for other in here.iterdir() if other.name.lower() == component.lower()]
                if not same:
                    return None
                step = here / min(same)
            here = step
        return here.resolve() if here.is_file() else None
    except OSError:  # an unreadable folder, or a name that is too long
        return None


def _became(mesh: CollisionMesh, treatment: str) -> tuple[Hull, CoverSpheres | None]:
    """Return the hull of a mesh, with spheres inside it if requested; raise ModelError if there is no hull."""
    hull = hull_of_file(mesh.path, mesh.scale)
    return hull, fit_spheres(hull, mesh.path.name) if treatment == "spheres" else None


def put_meshes(plant: MultibodyPlant, scene_graph: pg.SceneGraph, meshes: FileMeshes) -> list[str]:
    """Change the placeholders in `plant` to hulls or spheres, and return a sentence on the changes.

    Call it before anything else is added and the plant is finalized. Masses and inertias do not change.
    """
    became_other: list[CollisionMesh] = []
    _put_back(plant, scene_graph, meshes)
    inspector = scene_graph.model_inspector()
    known = list(inspector.GetAllGeometryIds(pg.Role.kProximity))
    for geometry in tuple(known):
        mesh = _meant(plant, inspector, geometry, meshes)
        if mesh is None:
            continue
        try:
            hull, spheres = _became(mesh, meshes.treatment)
        except ModelError as error:  # for URDF and SDF, such meshes were removed earlier
            meshes.unusable.append(f"{mesh.link} collision {mesh.path.name} ({error})")
            scene_graph.RemoveRole(plant.get_source_id(), geometry, pg.Role.kProximity)
            continue
        became_other.append(mesh)
        filtered = [g for g in known if inspector.CollisionFiltered(g, geometry)]
        if spheres is None:
            scene_graph.ChangeShape(plant.get_source_id(), geometry, hull.shape(mesh.path.name))
            became = [geometry]
        else:
            became = _put_spheres(plant, scene_graph, geometry, spheres)
        exclude(scene_graph, became, filtered)  # Drake stores filters by geometry, and drops them when a shape changes
        known += became[1:]
    return [_describe_meshes(became_other, meshes.treatment)] if became_other else []


def _put_back(plant: MultibodyPlant, scene_graph: pg.SceneGraph, meshes: FileMeshes) -> None:
    """Restore the original files of MJCF visual meshes, and remove collision meshes that Drake cannot use."""
    inspector = scene_graph.model_inspector()
    for geometry in inspector.GetAllGeometryIds():
        shape = inspector.GetShape(geometry)
        original = meshes.converted.get(_path_of(shape))
        if original is None:
            continue
        if inspector.GetProximityProperties(geometry) is None:
            scene_graph.ChangeShape(plant.get_source_id(), geometry, pg.Mesh(str(original), shape.scale3()))
        elif meshes.treatment == "skip":
            link = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)).name()
            meshes.skipped.append(f"{link} collision {original.name}")
            scene_graph.RemoveRole(plant.get_source_id(), geometry, pg.Role.kProximity)


def _path_of(shape: Any) -> str:
    return str(shape.source().path()) if isinstance(shape, pg.Mesh) and shape.source().is_path() else ""


def _meant(plant: MultibodyPlant, inspector: Any, geometry: Any, meshes: FileMeshes) -> CollisionMesh | None:
    """Return the collision mesh that a geometry stands for, or None."""
    shape = inspector.GetShape(geometry)
    if isinstance(shape, pg.Sphere):
        return meshes.wanted.get(shape.radius())
    path = (meshes.converted | meshes.whole).get(_path_of(shape))
    if path is None or meshes.treatment == "skip":
        return None
    x, y, z = (float(factor) for factor in shape.scale3())
    return CollisionMesh(plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)).name(), path, (x, y, z))


def _put_spheres(plant: MultibodyPlant, scene_graph: pg.SceneGraph, geometry: Any, spheres: CoverSpheres) -> list[Any]:
    """Replace a placeholder by spheres, and return their ids, including the placeholder's."""
    first, *more = spheres.centres
    X_BG = RigidTransform(scene_graph.model_inspector().GetPoseInFrame(geometry))
    added = add_spheres(plant, scene_graph, geometry, spheres.radius, {f"_{i}": p for i, p in enumerate(more, start=2)})
    scene_graph.ChangeShape(plant.get_source_id(), geometry, pg.Sphere(spheres.radius), X_BG @ RigidTransform(first))
    return [geometry, *added]


def _describe_meshes(meshes: list[CollisionMesh], treatment: str) -> str:
    """Return one sentence for all meshes and one for each kind of link, sorted by decreasing fit error."""
    kinds: dict[tuple[Path, Scale], list[str]] = {}
    for mesh in meshes:
        kinds.setdefault((mesh.path, mesh.scale), []).append(mesh.link)
    became = {kind: _became(CollisionMesh("", *kind), treatment) for kind in kinds}
    lost = max(hull.lost for hull, _ in became.values())
    less = f" Hulls of fine meshes use only some vertices: meshes reach up to {lost:.2g} m farther." if lost else ""
    if treatment == "convex":
        corners = [len(hull.corners) for hull, _ in became.values()]
        return (
            f"{len(meshes)} collision meshes became their convex hulls, of {min(corners)} to {max(corners)} "
            f"corners, which fills hollows. AutoDiffXd refuses point contact with them.{less}"
        )
    fits = sorted(((s, k) for k, (_, s) in became.items() if s is not None), key=lambda f: -f[0].ground_gap)
    count = sum(len(spheres.centres) * len(kinds[kind]) for spheres, kind in fits)
    lines = [
        f"{kind[0].name} ({', '.join(kinds[kind])}): {len(s.centres)} of radius {s.radius:.2g} m, gaps "
        f"{s.ground_gap:.2g} and {s.open_gap:.2g} m"
        for s, kind in fits
    ]
    return (
        f"{len(meshes)} collision meshes became {count} spheres inside their convex hulls. The first gap is the "
        "largest delay of contact with flat ground, the second the largest distance from the hull to the spheres: "
        f"{_listed(lines)}.{less}"
    )
