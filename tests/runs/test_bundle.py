"""Check that a run includes its robot's files, is verified without the originals, and that changed files are found."""

import json
import shutil
import warnings
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.table import each_row, slow_after

import drake_diff as dd
from drake_diff.exceptions import ModelError
from drake_diff.model.named_files import lay_out, named_files
from drake_diff.runs.fields import canonical, files_below, own_sha256
from drake_diff.runs.measurement import measure
from drake_diff.runs.provenance import write_bundle
from drake_diff.runs.save import record_of, write_files
from drake_diff.runs.view import scene_of_run

pytestmark = pytest.mark.solve

LINK = """<link name="{0}"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="{1}"/></geometry></visual>
<collision><geometry><mesh filename="{1}"/></geometry></collision></link>"""
URDF = """<robot name="arm"><link name="base"/>{}{}
<joint name="j" type="revolute"><parent link="base"/><child link="a"/>
<axis xyz="1 0 0"/><limit effort="9" lower="-9" upper="9" velocity="99"/></joint>
<joint name="k" type="fixed"><parent link="a"/><child link="b"/></joint></robot>"""
SDF = """<sdf version="1.7"><model name="{0}"><link name="{0}"/>
<link name="l"><visual name="v"><geometry><mesh><uri>{1}</uri></mesh></geometry></visual></link>{2}</model></sdf>"""
HINGE = '<joint name="j" type="revolute"><parent>world</parent><child>l</child><axis><xyz>1 0 0</xyz></axis></joint>'
INCLUDE = "<include><uri>{}</uri></include>"
MJCF = """<mujoco model="m"><include file="sub/more.xml"/><worldbody><body><joint name="j" type="hinge"/>
<geom type="mesh" mesh="a"/></body></worldbody></mujoco>"""
FREE = "Everybody may use it.\n"


def robots(root):
    """Write a package, a world, MJCF with assets, and directives into the folder `root`."""
    robot = root / "robot"
    for folder in (robot / "meshes", robot / "urdf", root / "mj" / "assets", root / "mj" / "sub", root / "world"):
        folder.mkdir(parents=True)
    for folder in (robot / "meshes", root / "mj" / "assets"):
        for name, size in (("a", 0.1), ("b", 0.2)):
            box = trimesh.creation.box((size, 0.1, 0.1))
            (folder / f"{name}.obj").write_text("mtllib red.mtl\nusemtl red\n" + trimesh.exchange.obj.export_obj(box))
            box.export(folder / f"{name}.stl")
        (folder / "red.mtl").write_text("newmtl red\nKd 1 0 0\n")
    for path, text in {
        robot / "package.xml": "<package/>",
        robot / "LICENSE": FREE,
        robot / "urdf" / "far.urdf": URDF.format(
            LINK.format("a", "package://robot/meshes/a.obj"), LINK.format("b", "package://robot/meshes/b.stl")
        ),
        robot / "urdf" / "near.urdf": URDF.format(
            LINK.format("a", "../meshes/A.STL"), LINK.format("b", "../meshes/gone.stl")
        ),
        root / "world" / "inner.sdf": SDF.format("inner", "../robot/meshes/b.obj", ""),
        root / "world" / "model.config": '<model><sdf version="1.7">inner.sdf</sdf></model>',
        root / "world" / "world.sdf": SDF.format(
            "outer", "model://robot/meshes/a.obj", HINGE + INCLUDE.format("model://world/inner.sdf")
        ),
        root / "world" / "folder.sdf": SDF.format("outer", "model://robot/meshes/a.obj", HINGE).replace(
            "</model>", INCLUDE.format("package://all/world") + "</model>"
        ),
        root / "mj" / "robot.xml": MJCF,
        root / "mj" / "sub" / "more.xml": '<mujoco><compiler meshdir="assets"/><include file="last.xml"/></mujoco>',
        root / "mj" / "last.xml": '<mujoco><asset><mesh name="a" file="a.stl"/></asset></mujoco>',
        root / "two.dmd.yaml": "directives:\n- add_model: {name: one, file: package://robot/urdf/far.urdf}\n"
        "- add_model: {name: two, file: package://all/mj/robot.xml}\n",
    }.items():
        path.write_text(text)
    return root


def load(path, root, **options):
    packages = {"robot": root / "robot", "world": root / "world", "all": root}
    given = {"time_step": 0.02, "actuators": ["j"], "packages": packages, **options}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return dd.load_model(path, **given)


def solved(model):
    problem = dd.Problem(model, x0=model.default_state, num_steps=4, running_cost=dd.QuadraticCost(R=np.eye(model.nu)))
    return dd.solve(problem, method="shooting", max_iterations=2)


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    root = robots(tmp_path_factory.mktemp("robots"))
    return solved(load(root / "robot" / "urdf" / "far.urdf", root, base="weld", meshes="convex"))


@pytest.fixture(scope="module")
def run(arm, tmp_path_factory):
    directory = tmp_path_factory.mktemp("runs") / "arm"
    dd.save(arm, directory)
    return directory


KINDS = [
    "robot/urdf/far.urdf",
    "robot/urdf/near.urdf",
    "world/world.sdf",
    "world/folder.sdf",
    "mj/robot.xml",
    "two.dmd.yaml",
]


@each_row("name", KINDS)
def test_a_copy_of_a_robot_file_and_all_that_it_names_is_the_same_model(tmp_path, name):
    root, path = robots(tmp_path / "there"), tmp_path / "there" / name
    model = load(path, root, actuators=None)
    files = named_files(path, model.options["packages"])
    content = {file.name: None if file.path is None else file.path.read_bytes() for file in files}
    data = path.read_bytes()
    (tmp_path / "here").mkdir()
    shutil.move(root, tmp_path / "gone")
    there, packages = lay_out(tmp_path / "here", path.name, data, content, content.get)
    copy = load(there, tmp_path / "gone", packages=packages, actuators=None)
    assert {file.name: file.path and file.path.read_bytes() for file in named_files(there, packages)} == content
    assert any(text == FREE.encode() for text in content.values()) == (name != "mj/robot.xml")
    contracts = [{**m.contract.to_dict(), "source": "", "notes": ""} for m in (model, copy)]
    assert contracts[0] == contracts[1]
    counts = [m.diagram.GetSubsystemByName("scene_graph").model_inspector().num_geometries() for m in (model, copy)]
    assert counts[0] == counts[1] > 0


@pytest.mark.parametrize("name", slow_after(1, KINDS))
def test_a_run_is_verified_and_shown_where_the_robot_is_not(tmp_path, name):
    root, run = robots(tmp_path / "there"), tmp_path / "run"
    floats = name.startswith("robot/")
    dd.save(
        solved(
            load(root / name, root, base="weld" if floats else None, actuators=["one::j"] if "two" in name else ["j"])
        ),
        run,
    )
    shutil.move(root, tmp_path / "gone")
    verification = dd.verify(run).require()
    assert (verification.complaints, verification.rounded) == ((), ())
    assert scene_of_run(run).shapes


def test_each_content_is_stored_once_and_meshes_only_where_they_are_wanted(arm, run, tmp_path):
    record = dd.load_record(run)
    hashes = {file.path: file.sha256 for file in record.model.named}
    assert set(hashes) == {
        f"package://robot/{name}" for name in ("LICENSE", "meshes/a.obj", "meshes/a.obj: red.mtl", "meshes/b.stl")
    }
    assert {path.name for path in (run / "model").iterdir()} == set(hashes.values())
    assert all(sha256(path.read_bytes()).hexdigest() == path.name for path in (run / "model").iterdir())
    assert "4 files that the model names" in record.file_names[-1]
    less = dd.save(arm, tmp_path / "run", meshes=False)
    assert [path.read_text() for path in (tmp_path / "run" / "model").iterdir()] == [FREE]
    assert less.model == record.model
    root = arm.problem.model.source.parents[2]
    assert dd.verify(tmp_path / "run").verdict == "undecided"
    assert dd.verify(tmp_path / "run", models=root).holds


def test_a_record_is_the_same_wherever_the_model_lies_and_however_its_path_is_written(tmp_path, monkeypatch):
    records = []
    for i, folder in enumerate(("one", "an other/place")):
        root = robots(tmp_path / folder)
        monkeypatch.chdir(root)
        for j, path in enumerate((root / "robot" / "urdf" / "near.urdf", Path("robot/urdf/near.urdf"))):
            dd.save(solved(load(path, root, base="weld")), tmp_path / f"run{i}{j}" / "run")
            records.append(json.loads((tmp_path / f"run{i}{j}" / "run" / "record.json").read_text()))
            assert records[-1]["provenance"].pop("model_file") == str(path)
    skipped = ("provenance", "wall_clock", "files", "record_sha256")
    texts = {canonical({key: value for key, value in record.items() if key not in skipped}) for record in records}
    assert len(texts) == 1
    assert str(tmp_path) not in texts.pop()
    shutil.rmtree(tmp_path / "one")
    assert dd.verify(tmp_path / "run01" / "run").require().complaints == ()


def forged(arm, folder, change):
    """Verify a run whose record has changed model files, with correct hashes."""
    folder.mkdir()
    measurement = measure(arm)
    honest = record_of(measurement, folder)
    write_bundle(folder, arm.problem.model)
    named = {file.path: file for file in honest.model.named}
    named = change(named, folder / "model") or named
    record = honest.model_copy(update={"model": honest.model.model_copy(update={"named": list(named.values())})})
    write_files(folder, measurement, record.content())
    record.write(folder)
    return dd.verify(folder)


A, B = "package://robot/meshes/a.obj", "package://robot/meshes/b.stl"


def altered(named, bundle):
    (bundle / named[A].sha256).write_bytes((bundle / named[A].sha256).read_bytes() + b"\n")


def replaced(named, bundle):
    data = (bundle / named[A].sha256).read_bytes().replace(b"0.05", b"0.06")
    (bundle / named[A].sha256).unlink()
    (bundle / sha256(data).hexdigest()).write_bytes(data)
    return {**named, A: named[A].model_copy(update={"sha256": sha256(data).hexdigest(), "bytes": len(data)})}


def exchanged(named, bundle):
    other = {"sha256": named[A].sha256, "bytes": named[A].bytes}
    return {**named, B: named[B].model_copy(update=other)}


def added(named, bundle):
    (bundle / ("0" * 64)).write_text("v 0 0 0\n")


def added_and_named(named, bundle):
    data = b"v 0 0 0\n"
    (bundle / sha256(data).hexdigest()).write_bytes(data)
    return {
        **named,
        "c.obj": named[A].model_copy(update={"path": "c.obj", "sha256": sha256(data).hexdigest(), "bytes": 8}),
    }


def left_out(named, bundle):
    return {name: file for name, file in named.items() if name != A}


def outside(named, bundle):
    return {**named, A: named[A].model_copy(update={"sha256": "../record.json"})}


def linked(named, bundle):
    (bundle / named[A].sha256).rename(bundle.parent.parent / "mesh")
    (bundle / named[A].sha256).symlink_to(bundle.parent.parent / "mesh")


def missing(named, bundle):
    (bundle / named[A].sha256).unlink()


@pytest.mark.slow
@each_row(
    "change, verdict, words",
    [
        (altered, "broken", "does not"),
        (replaced, "broken", ""),
        (exchanged, "broken", ""),
        (added, "broken", "0000: the model does not name this file"),
        (added_and_named, "broken", "it does not list the files that far.urdf names: c.obj"),
        (left_out, "broken", "it does not list the files that far.urdf names"),
        (outside, "broken", "'../record.json' is not the hash of a file"),
        (linked, "broken", "a link, or not a regular file"),
        (missing, "undecided", "which the artifact does not contain"),
    ],
)
def test_a_changed_file_of_the_model_is_found_although_all_seals_are_right(arm, tmp_path, change, verdict, words):
    verification = forged(arm, tmp_path / "run", change)
    assert (verification.verdict, words in str(verification)) == (verdict, True), verification.lines


def test_another_mesh_in_a_whole_run_is_another_claim(run, tmp_path):
    root = robots(tmp_path / "there")
    mesh = root / "robot" / "meshes" / "a.obj"
    mesh.write_text(mesh.read_text().replace("0.05", "0.06"))
    other = load(root / "robot" / "urdf" / "far.urdf", root, base="weld", meshes="convex")
    dd.save(solved(other), tmp_path / "run")
    lines = [
        next(line for line in dd.verify(d).claimed if line.startswith("of the model")) for d in (run, tmp_path / "run")
    ]
    assert lines[0] != lines[1]
    assert all("far.urdf" in line and "with 4 files (" in line for line in lines)


def test_a_mesh_that_is_named_by_its_path_stays_where_it_is(tmp_path):
    root = robots(tmp_path / "there")
    path = root / "robot" / "urdf" / "far.urdf"
    path.write_text(path.read_text().replace("package://robot", str(root / "robot")))
    dd.save(solved(load(path, root, base="weld")), tmp_path / "run")
    assert f"needs {root}/robot/meshes/a.obj and 2 more, which the artifact" in str(dd.verify(tmp_path / "run"))
    assert dd.verify(tmp_path / "run", models=root).holds


@each_row("name", ["/etc/robots/a.obj", "file:///etc/robots/a.obj", "../" * 40 + "etc/a.obj"])
def test_no_name_leads_out_of_the_copy(tmp_path, name):
    data = URDF.format(LINK.format("a", name), LINK.format("b", name)).encode()
    with pytest.raises(ModelError, match="which is not below its own folder or a package"):
        lay_out(tmp_path, "m.urdf", data, [name], lambda label: b"v 0 0 0\n")
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["m.urdf"]


def test_a_package_called_as_a_folder_above_is_not_looked_for_there(tmp_path):
    (tmp_path / "secret.obj").write_text("v 0 0 0\n")
    (tmp_path / "copy").mkdir()
    name = f"package://{tmp_path.name}/secret.obj"
    data = URDF.format(LINK.format("a", name), LINK.format("b", name)).encode()
    path, packages = lay_out(tmp_path / "copy", "m.urdf", data, [name], lambda label: None)
    assert [(file.path, file.reason) for file in named_files(path, packages)] == [(None, "no such file")]
    with pytest.raises(ModelError, match="which is not below its own folder or a package"):
        lay_out(tmp_path / "other", "m.urdf", data, [], lambda label: None)


def test_a_run_written_before_has_no_copy_and_is_verified_with_the_folder_of_its_model(arm, tmp_path):
    """Version 4.0 had paths in the contract and its notes, and neither OBJ materials nor licenses in the artifact."""
    model, folder = arm.problem.model, tmp_path / "run"
    dd.save(arm, folder)
    shutil.rmtree(folder / "model")
    fields = json.loads((folder / "record.json").read_text())
    where = {key: fields["provenance"].pop(key) for key in ("model_file", "model_packages")}
    fields["model"]["named"] = [f for f in fields["model"]["named"] if f["path"] in (A, B)]
    fields["model"]["options"]["packages"] = where["model_packages"]
    fields["contract"] |= {"source": where["model_file"], "notes": [str(note) for note in model.contract.notes]}
    fields["schema_version"] = "4.0.0"
    write_files(folder, measure(arm), fields)
    fields["files"] = {name: file.model_dump() for name, file in files_below(folder, "record.json").items()}
    (folder / "record.json").write_text(canonical({**fields, "record_sha256": own_sha256(fields)}))
    verification = dd.verify(folder)
    assert (verification.verdict, "models=FOLDER" in str(verification)) == ("undecided", True)
    verification = dd.verify(folder, models=model.source.parents[2])
    assert (verification.holds, verification.notes) == (True, ()), verification.lines
