"""Check that differences of shapes, poses and contact parameters fail, and that the contact law's form may differ."""

import re

import numpy as np
import pytest
from helpers.contracts import different
from helpers.engines import engine_of, needs
from helpers.models import MODELS
from helpers.table import each_row

import drake_diff as dd
from drake_diff.engines.contract import LAWS
from drake_diff.engines.drake import DrakeEngine
from drake_diff.exceptions import ModelError
from drake_diff.export.export import export_model, written
from drake_diff.mechanics.description import describe

pytestmark = pytest.mark.solve

G, H = 9.81, 0.005


@pytest.fixture
def ball(load):
    needs("mujoco")
    return load("sphere_on_ground.sdf", time_step=H)


def own(tmp_path, model, *edits):
    """Load MuJoCo with the exported MJCF, after replacing the first match of each pattern."""
    text = written("mjcf", describe(model), model.time_step)
    for pattern, new in edits:
        text, count = re.subn(pattern, new, text, count=1)
        assert count == 1, pattern
    path = tmp_path / "own.xml"
    path.write_text(text)
    return dd.engines.load_engine("mujoco", model, path=path)


def resting(model):
    x = np.array(model.default_state)
    x[6] = 0.1
    return x


FLOOR = r'pos="0.0 0.0 0.0"( quat="[^"]*" />\s*</body>\s*<body name="ball")'
# The edit of the MJCF (pattern, replacement), the line that must fail, and a word of its detail.
CHANGED = {
    "friction": (r'friction="0.5 0.5', 'friction="0.01 0.01', "friction", "0.01"),
    "friction across": (r'friction="0.5 0.5', 'friction="0.5 0.3', "other contact terms", "0.3"),
    "no friction": (r'condim="3"', 'condim="1"', "friction", "0.0"),
    "torsion": (r'condim="3"([^/]*)friction="0.5 0.5 0.0', r'condim="4"\1friction="0.5 0.5 0.02', "other contact terms",
                "torsional"),
    "radius": (r'size="0.1"', 'size="0.11"', "shapes", "0.11"),
    "box": (r'type="sphere" size="0.1"', 'type="box" size="0.1 0.1 0.1"', "shapes", "Box"),
    "floor 1 cm up": (FLOOR, r'pos="0.0 0.0 0.01"\1', "poses", "0.01"),
    "floor tilted": (r'quat="[^"]*"( />\s*</body>\s*<body name="ball")', r'euler="0.1 0 0"\1', "poses", "directions"),
    "no pair": (r"<pair [^>]*>", "", "contact pairs", "ball"),
    "no floor": (r'(?s)<geom name="ground[^>]*>(.*)<pair [^>]*>', r"\1", "contact pairs", "ground"),
    "solref": (r'solref="-\S+', 'solref="-800.0', "stiffness", "8000"),
    "MuJoCo's own solref": (r'solref="[^"]*"', "", "stiffness", "25000"),
    "solimp": (r'solimp="0.9 0.9', 'solimp="0.9 0.95', "other contact terms", "solimp"),
    "damping": (r'(solref="-\S+) -\S+"', r'\1 -30"', "dissipation", "0.03"),
    "margin": (r"<pair ", '<pair margin="0.01" ', "contact margin", "0.01"),
    "gap": (r"<pair ", '<pair gap="0.01" ', "other contact terms", "gap"),
}  # fmt: skip


@pytest.mark.slow
@each_row("change", CHANGED)
def test_a_changed_contact_is_another_model_and_its_line_says_so(ball, tmp_path, change):
    pattern, new, quantity, word = CHANGED[change]
    found = dd.compare(ball, [own(tmp_path, ball, (pattern, new))], x0=resting(ball), num_steps=5)
    e = found.engines[1]
    assert (e.verdict, found.holds) == ("other model", False)
    broken = {line.quantity: line.detail for line in e.broken}
    assert word in broken[quantity], broken
    assert word in e.sentence


@pytest.mark.slow
def test_the_same_contact_holds_under_another_law_and_by_other_names(ball, tmp_path):
    names = (r'name="ground::ground#0"', 'name="floor"'), (r'name="sphere::ball#1"', 'name="my ball"')
    pair = (r'geom1="[^"]*" geom2="[^"]*"', 'geom1="floor" geom2="my ball"')
    for engine in (engine_of("mujoco", ball), own(tmp_path, ball), own(tmp_path, ball, *names, pair)):
        found = dd.compare(ball, [engine], x0=resting(ball), num_steps=5)
        assert (found.engines[1].verdict, found.holds) == ("other law", True)
        assert {line.quantity for line in found.engines[1].different} <= set(LAWS)


def test_the_filters_of_a_model_written_by_hand_are_read(tmp_path):
    """Drake and MuJoCo read the same MJCF and agree on the contact pairs, unless one of the texts excludes a pair."""
    needs("mujoco")
    text = """<mujoco model="two"><option timestep="0.01"/><worldbody><geom name="floor" type="plane" size="0 0 1"/>
    <body name="ball" pos="0 0 1"><freejoint name="ball"/><geom name="shell" size=".1" mass="1"/></body>
    <body name="arm" pos="1 0 1"><joint name="hip" axis="0 1 0"/>
      <geom name="upper" type="capsule" size=".05 .2" pos="0 0 -.2" mass="1"/>
      <body name="shin" pos="0 0 -.5"><joint name="knee" axis="0 1 0"/>
        <geom name="lower" type="box" size=".05 .04 .2" pos="0 0.1 -.2" euler="10 20 30" mass="1"/></body></body>
    </worldbody>%s</mujoco>"""
    path = tmp_path / "two.xml"
    path.write_text(text % "")
    model = dd.load_model(path, time_step=0.01)
    drake = DrakeEngine(model)
    found = different(drake, dd.engines.load_engine("mujoco", model, path=path))
    assert not found.keys() & {"shapes", "poses", "contact pairs", "friction", "contact margin"}
    assert "stiffness" in found  # MuJoCo's default stiffness scales with the mass, unlike Drake's
    for change, word in (
        ('<contact><exclude body1="ball" body2="arm"/></contact>', "upper"),
        ('<contact><pair geom1="upper" geom2="lower"/></contact>', "lower"),
    ):
        other = tmp_path / "other.xml"
        other.write_text(text % change)
        assert word in different(drake, dd.engines.load_engine("mujoco", model, path=other))["contact pairs"]
    other.write_text((text % "").replace('name="shell"', 'name="shell" contype="0" conaffinity="0"'))
    assert "shell" in different(drake, dd.engines.load_engine("mujoco", model, path=other))["contact pairs"]


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
@pytest.mark.parametrize("condim", [1, 3, 4, 6])
@pytest.mark.parametrize("solref", ["-900 -60", "0.03 1", "0.001 1"])
def test_the_stiffness_that_is_read_is_that_on_which_a_weight_rests_in_mujoco(cone, condim, solref):
    """The weight rests at depth m g / k for all cones, dimensions and solrefs. MuJoCo raises 0.001 s to two steps."""
    mujoco = pytest.importorskip("mujoco")
    from drake_diff.engines.mujoco_contract import read_pairs

    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep="0.002" cone="{cone}"/>
    <default><geom solref="{solref}" solimp="0.9 0.9 0.001" condim="{condim}" friction="0.5 0.01 0.01"/></default>
    <worldbody><geom type="plane" size="0 0 1"/><body pos="0 0 .1"><freejoint/><geom size=".1" mass="1.3"/></body>
    </worldbody></mujoco>""")
    data = mujoco.MjData(model)
    for _ in range(2000):  # 4 s are sixty time constants
        mujoco.mj_step(model, data)
    (pair,) = read_pairs(model)
    assert -data.contact[0].dist == pytest.approx(1.3 * G / pair.stiffness, rel=1e-6)
    assert pair.friction == (0.5 if condim > 1 else 0.0)


def test_the_exported_mjcf_is_the_one_that_was_compared_and_rests_at_m_g_over_k(ball, tmp_path):
    export_model(ball, tmp_path / "out", target="mjcf", states=2)
    text = (tmp_path / "out" / "model.xml").read_text()
    assert text == engine_of("mujoco", ball).mjcf
    engine = dd.engines.load_engine("mujoco", ball, path=tmp_path / "out" / "model.xml")
    x = resting(ball)
    for _ in range(600):  # 3 s, with critical damping at 30 rad/s
        x = engine.step(x, [])
    assert engine.contact_depth(x) == pytest.approx(1.0 * G / 1e4, rel=1e-6)


@each_row("option, said", [
    ('integrator="RK4"', "expected one of EULER, IMPLICIT, IMPLICITFAST.*got RK4"),
    ('integrator="discrete"', "expected one of EULER, IMPLICIT, IMPLICITFAST.*got"),
    ('density="1"', "a fluid"), ('wind="1 0 0"', "a fluid"),
])  # fmt: skip
def test_an_option_that_the_contract_does_not_know_is_refused(ball, tmp_path, option, said):
    with pytest.raises(ModelError, match=said):
        own(tmp_path, ball, (r'integrator="Euler"', option))


@each_row("flag", ["contact", "constraint", "limit", "gravity", "spring", "damper", "clampctrl", "actuation"])
def test_what_is_disabled_is_refused_by_name(ball, tmp_path, flag):
    with pytest.raises(ModelError, match=rf"disabled parts of the physics \({flag}\)"):
        own(tmp_path, ball, (r'warmstart="disable"', f'{flag}="disable"'))


@each_row("option, said", [
    ('cone="pyramidal"', "pyramidal"), ('cone="elliptic" noslip_iterations="3"', "noslip"),
    ('cone="elliptic" solver="PGS"', "PGS"),
])  # fmt: skip
def test_the_form_of_the_law_is_named(ball, tmp_path, option, said):
    lines = dd.engines.match_contracts(DrakeEngine(ball), own(tmp_path, ball, (r'cone="elliptic"', option)))
    told = {line.quantity: line.detail for line in lines if line.verdict == "different"}
    assert said in told["contact law"] + told["solver tolerance"]
    assert ("stiffness" in told) == ("pyramidal" in option)  # the edges of a pyramidal cone share the force


@pytest.mark.slow
def test_another_plant_in_drake_is_another_model(ball, tmp_path):
    text = (MODELS / "sphere_on_ground.sdf").read_text()
    for old, new, quantity in (
        ("<radius>0.1<", "<radius>0.11<", "shapes"),
        ("mu_dynamic>0.5", "mu_dynamic>0.1", "friction"),
        ("dissipation>1", "dissipation>2", "dissipation"),
        ("relaxation_time>0.001", "relaxation_time>0.1", "dissipation"),
    ):
        assert old in text, old
        path = tmp_path / "other.sdf"
        path.write_text(text.replace(old, new))
        engine = DrakeEngine(dd.load_model(path, time_step=H))
        found = dd.compare(ball, [engine], x0=resting(ball), num_steps=5)
        assert not found.holds
        assert quantity in [line.quantity for line in found.engines[1].broken]


def test_without_names_engines_that_have_no_contact_are_not_compared_with_a_model_that_has(ball):
    needs("pinocchio")
    found = dd.compare(ball, x0=resting(ball), num_steps=3)
    assert found.holds
    refused = {r.engine: r.reason for r in found.refused}
    assert "has no contact here" in refused["pinocchio"]
    assert "has no contact here" not in refused.get("mujoco", "")


@pytest.mark.parametrize("name", ["mujoco", "pinocchio"])
def test_a_limit_ahead_is_the_limits_doing(load, name):
    """Drake slows the cart down up to two steps before its limit, and neither engine has passed the limit yet."""
    needs(name)
    cart = load("cart_pole.urdf")
    upper = cart.plant.GetPositionUpperLimits()[0]
    speed = 1.0
    x = np.array([upper - 1.5 * cart.time_step * speed, 0.3, speed, 0.0])
    after = DrakeEngine(cart).step(x, [0.0])
    assert after[0] < upper
    assert after[2] < 0.9 * speed  # Drake slows the cart down before the limit
    e = dd.compare(cart, [name], x0=x, num_steps=1).engines[1]
    assert (e.verdict, e.first.responsible) == ("other law", "limit law")
    assert "limit" in e.sentence


def test_a_push_beside_a_limit_is_not_the_limits_doing(load):
    """The cart is at its limit, and the pole is pushed. No limit can cause this difference."""
    from helpers.engines import Doctored

    cart = load("cart_pole.urdf")
    drake = DrakeEngine(cart)
    upper = cart.plant.GetPositionUpperLimits()[0]
    pushed = Doctored(drake, name="pushed", step=lambda x, u: drake.step(x, u) + np.array([0, 0, 0, 1e-3]))
    e = dd.compare(cart, [pushed], x0=[upper - 1e-3, 0.3, 0.5, 0.0], num_steps=3).engines[1]
    assert e.verdict == "unexplained"
