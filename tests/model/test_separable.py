"""Tests of shapes that overlap in every posture: their detection, the finding of `audit`, and the contact filter."""

import numpy as np
import pytest

import drake_diff as dd
from drake_diff.model.contact_geometry import inseparable_pairs
from drake_diff.model.step import set_state

# Three links in series, hinged about z. On the last link are a ball that always overlaps the first link's disc, a
# second ball that meets the post at small angles only, and in some tests a box flush with the disc's top.
ROBOT = """
<robot name="overlapping">
  <link name="root"/>
  <link name="first">
    <inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision name="disc"><geometry><cylinder radius="0.3" length="0.2"/></geometry></collision>
    <collision name="post"><origin xyz="0.6 0 0"/><geometry><sphere radius="0.1"/></geometry></collision>
  </link>
  <link name="middle">
    <inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="last">
    <inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision name="inside"><origin xyz="0.25 0 0"/><geometry><sphere radius="0.1"/></geometry></collision>
    <collision name="arm"><origin xyz="0.6 0 0"/><geometry><sphere radius="0.1"/></geometry></collision>
    {more}
  </link>
  <joint name="hold" type="fixed"><parent link="root"/><child link="first"/></joint>
  <joint name="one" type="continuous"><parent link="first"/><child link="middle"/><axis xyz="0 0 1"/></joint>
  <joint name="two" type="revolute"><parent link="middle"/><child link="last"/><axis xyz="0 0 1"/>
    <origin rpy="{tilt} 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>
"""
FLUSH = """<collision name="flush"><origin xyz="0.15 0 {height}"/>
      <geometry><box size="0.1 0.1 0.2"/></geometry></collision>"""


@pytest.fixture
def load(tmp_path):
    def loaded(more="", tilt=0.0, base="weld", **options):
        file = tmp_path / "overlapping.urdf"
        file.write_text(ROBOT.format(more=more, tilt=tilt))
        return dd.load_model(file, time_step=0.01, base=base, **options)

    return loaded


def names(model, pairs):
    inspector = model.double.inspector
    return {tuple(sorted(inspector.GetName(g).split("::")[-1] for g in pair)) for pair in pairs}


def test_what_overlaps_in_every_posture_and_nothing_else_is_found(load):
    model = load()
    assert names(model, inseparable_pairs(model.plant, model.diagram)) == {("disc", "inside")}


def test_faces_that_slide_on_each_other_are_found_too(load):
    """A tilt of 1e-10 rad lifts the box by 1e-11 m in half of the postures, as rounding can."""
    found = {}
    for tilt, height in ((1e-10, 0.2), (1e-10, 0.2001), (1e-3, 0.2)):
        model = load(FLUSH.format(height=height), tilt)
        found[tilt, height] = names(model, inseparable_pairs(model.plant, model.diagram))
    assert found[1e-10, 0.2] == {("disc", "inside"), ("disc", "flush")}
    assert found[1e-10, 0.2001] == found[1e-3, 0.2] == {("disc", "inside")}  # 0.1 mm apart; in some postures only


def test_the_filter_is_asked_for_told_and_leaves_every_other_contact(load):
    model = load(contact="separable")
    assert [note for note in model.notes if "pass" in note] == [
        "One pair of shapes passes through each other, as they overlap at all joint positions: first - last."
    ]
    apart, touching = np.zeros(model.nx), np.zeros(model.nx)
    apart[0] = 2.0
    set_state(model.double, apart)
    assert not model.double.overlaps()
    set_state(model.double, touching)
    assert model.double.overlaps()  # the arm overlaps the post
    set_state((other := load()).double, apart)
    assert other.double.overlaps()
    assert not [note for note in other.notes if "pass" in note]
    assert model.changed(time_step=0.02).notes == model.notes
    *_, methods = dd.linearize(model, apart[None], np.zeros((1, model.nu)))
    assert methods == ("analytic",)


def test_the_twin_in_autodiff_has_the_filter(load):
    model = load(contact="separable")
    x = np.array([2.0, 0.1, 0.3, -0.2])
    by_autodiff = dd.differentiate_step(model, x, method="autodiff").A
    # both axes and both centres of mass lie on one vertical line, and no contact acts: gravity has no moment about the
    # axes, so the speeds are constant
    np.testing.assert_allclose(by_autodiff, [[1, 0, 0.01, 0], [0, 1, 0, 0.01], [0, 0, 1, 0], [0, 0, 0, 1]], atol=1e-12)


def test_a_floating_robot_in_its_ground_is_not_filtered(load):
    model = load(base=None, ground=True, contact="separable")
    assert [n.split(": ")[-1] for n in model.notes if "pass" in n] == ["first - last."]
    x = model.default_state.copy()
    set_state(model.double, x)
    assert model.double.overlaps()


def test_audit_names_the_links_and_the_remedy(load):
    findings = [f for f in dd.audit(load()) if f.code == "never_apart"]
    assert [(f.severity, f.subject, f.arguments) for f in findings] == [
        ("warning", "first - last", {"contact": "separable"})
    ]
    assert not [f for f in dd.audit(load(contact="separable")) if f.code == "never_apart"]
    assert not [f for f in dd.audit(load(contact=False)) if f.code == "never_apart"]
