"""Analytic derivatives of steps with contact equal closed forms, AutoDiffXd and differences."""

import numpy as np
import pytest
from helpers.robots import example_robot, state_in_contact
from helpers.table import each_row

import drake_diff as dd
from drake_diff.derivatives import analytic
from drake_diff.derivatives.contact import laws, nearest_points
from drake_diff.derivatives.contact.active_contacts import read_pairs
from drake_diff.derivatives.steps import take_step
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.model import contact_modes
from drake_diff.model.parameters import select
from drake_diff.model.step import set_state

pytestmark = pytest.mark.solve

MATERIAL = (
    "<drake:proximity_properties><drake:point_contact_stiffness>{k}</drake:point_contact_stiffness>"
    "<drake:relaxation_time>{tau}</drake:relaxation_time>"
    "<drake:hunt_crossley_dissipation>{d}</drake:hunt_crossley_dissipation><drake:mu_static>{mu}</drake:mu_static>"
    "<drake:mu_dynamic>{mu}</drake:mu_dynamic></drake:proximity_properties>"
)
SHAPES = {
    "ground": "<plane><normal>0 0 1</normal></plane>",
    "box": "<box><size>0.4 0.3 0.2</size></box>",
    "capsule": "<capsule><radius>0.06</radius><length>0.3</length></capsule>",
    "ball": "<sphere><radius>0.15</radius></sphere>",
    "cylinder": "<cylinder><radius>0.1</radius><length>0.2</length></cylinder>",
}


def _collision(name, shape, pose="0 0 0 0 0 0", k=2e4, tau=0.01, mu=0.6, d=0.7):
    material = MATERIAL.format(k=k, tau=tau, mu=mu, d=d)
    return f'<collision name="{name}"><pose>{pose}</pose><geometry>{shape}</geometry>{material}</collision>'


def _sphere(name, at, radius=0.04, **material):
    return _collision(name, f"<sphere><radius>{radius}</radius></sphere>", f"{at} 0 0 0", **material)


def _link(name, collisions="", mass=1.0, moments=(0.01, 0.02, 0.025), com="0 0 0", pose="0 0 0 0 0 0"):
    ixx, iyy, izz = moments
    return (
        f'<link name="{name}"><pose>{pose}</pose><inertial><pose>{com} 0.2 0.1 0.3</pose><mass>{mass}</mass>'
        f"<inertia><ixx>{ixx}</ixx><iyy>{iyy}</iyy><izz>{izz}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>{collisions}</link>"
    )


def _joint(name, kind, parent, child, axis, damping=0.0, limit=1e9, effort=0):
    return (
        f'<joint name="{name}" type="{kind}"><parent>{parent}</parent><child>{child}</child><axis><xyz>{axis}</xyz>'
        f"<limit><lower>{-limit}</lower><upper>{limit}</upper><effort>{effort}</effort></limit>"
        f"<dynamics><damping>{damping}</damping></dynamics></axis></joint>"
    )


def _load(tmp_path, ground, moving, time_step=0.005, **options):
    file = tmp_path / "scene.sdf"
    file.write_text(
        '<sdf version="1.9" xmlns:drake="drake.mit.edu"><world name="w"><model name="fixed"><static>true</static>'
        f'<link name="fixed">{ground}</link></model><model name="robot">{moving}</model></world></sdf>'
    )
    return dd.load_model(file, time_step=time_step, **options)


def _walker(tmp_path, **options):
    """Load a free trunk with a hinged leg, a foot sliding on the leg and a tail, over tilted ground, all off centre."""
    ground = _collision("ground", SHAPES["ground"], "0 0 0 0.1 -0.2 0.3", k=3e4, tau=0.02, mu=0.5, d=1.5)
    feet = _sphere("toe", "0.02 0.01 -0.2", k=1e4) + _sphere("heel", "-0.05 0 -0.2", 0.03, mu=0.3)
    links = [
        _link("trunk", _sphere("belly", "0.1 0.05 -0.1", 0.05), 2.0, (0.03, 0.05, 0.06), "0.02 -0.01 0.03"),
        _link("leg", mass=0.5, com="0 0.01 -0.1", pose="0.15 0.1 -0.05 0.1 0 0"),
        _link("foot", feet, 0.2, (1e-3, 2e-3, 2.5e-3), "0.01 0 -0.15", "0.15 0.1 -0.1 0 0.1 0"),
        _link(
            "tail", _sphere("tip", "0 0 -0.25", 0.05, tau=0.03), 0.3, (2e-3, 2e-3, 1e-3), "0 0 -0.1", "-0.15 0 0 0 0 0"
        ),
    ]
    joints = [
        _joint("hip", "revolute", "trunk", "leg", "0 1 0.2", 0.2, effort=50),
        _joint("shin", "prismatic", "leg", "foot", "0.1 0 1", 1.5, effort=50),
        _joint("root", "revolute", "trunk", "tail", "1 0.3 0"),
    ]
    return _load(tmp_path, ground, "".join(links + joints), **options)


def _by_both(model, x, u):
    """Return the analytic derivatives, and the Jacobians [A, B] by the analytic method and by AutoDiffXd."""
    ours = dd.differentiate_step(model, x, u, method="analytic")
    exact = dd.differentiate_step(model, x, u, method="autodiff")
    return ours, np.hstack([ours.A, ours.B]), np.hstack([exact.A, exact.B])


def _agree(model, x, u):
    ours, found, exact = _by_both(model, x, u)
    assert ours.method == "analytic", ours.reason
    # Both are accurate to rounding, which near-rigid contact and the inverse of a mass matrix magnify.
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-9 * np.abs(exact).max())


def _contacts(model):
    results = model.plant.get_contact_results_output_port().Eval(model.double.context)
    return [results.point_pair_contact_info(i) for i in range(results.num_point_pair_contacts())]


def _touching_states(model, count, seed, spread=1.0):
    """Return states and inputs of a tumbling robot at which the step has contact. Quaternions are not normalized."""
    random, found = np.random.default_rng(seed), []
    while len(found) < count:
        x = model.default_state
        x[:4] = random.standard_normal(4)
        x[4:7] = [0, 0, 0.45]
        x[7 : model.nq] = 0.2 * random.standard_normal(model.nq - 7)
        x[model.nq :] = spread * random.standard_normal(model.nv)
        for _ in range(random.integers(20, 80)):
            u = 2 * random.standard_normal(model.nu)
            x = dd.step(model, x, u)
        dd.step(model, x, u)
        if _contacts(model):
            found.append((x, u))
    return found


@pytest.mark.parametrize("approximation", ["sap", "similar", "lagged"])
def test_a_tumbling_robots_steps_are_autodiffs(tmp_path, approximation):
    model = _walker(tmp_path, contact_approximation=approximation)
    states, modes = _touching_states(model, 25, seed=3), set()
    for x, u in states:
        _agree(model, x, u)
        modes |= set(contact_modes(model, x, u).values())
    assert modes == {"sticking", "sliding", "separated"}


def test_many_steps_in_one_call_are_the_same(tmp_path):
    model = _walker(tmp_path)
    states = _touching_states(model, 8, seed=5)
    free = (model.default_state, np.zeros(model.nu))
    free[0][6] = 2.0
    points = [*states[:4], free, *states[4:]]
    xs, us = (np.array(part) for part in zip(*points, strict=True))
    A, B, methods = dd.linearize(model, xs, us)
    assert set(methods) == {"analytic"}
    for k, (x, u) in enumerate(points):
        one = dd.differentiate_step(model, x, u, method="autodiff")
        size = np.abs(one.A).max()
        np.testing.assert_allclose(A[k], one.A, rtol=0, atol=1e-9 * size)
        np.testing.assert_allclose(B[k], one.B, rtol=0, atol=1e-9 * size)


def test_what_rests_on_a_fixed_sphere(tmp_path):
    """The sphere of a contact pair may belong to the fixed body."""
    post = _sphere("post", "0 0 0.2", 0.2)
    links = _link("x", mass=0.3) + _link("z", _collision("plate", SHAPES["box"]), 0.2)
    joints = _joint("along", "prismatic", "world", "x", "1 0 0") + _joint("up", "prismatic", "x", "z", "0 0 1")
    model = _load(tmp_path, post, links + joints)
    for x in ([0.05, 0.499, 0.3, -0.1], [0.21, 0.45, -0.2, 0.1]):  # on the face of the box, and at its edge
        _agree(model, x, np.zeros(0))
        assert _contacts(model)


@pytest.mark.parametrize("other", ["box", "capsule", "ball"])
def test_spheres_meet_moving_shapes(tmp_path, other):
    """A sphere on a free body overlaps faces, edges, corners and the inside of a shape on another free body."""
    moving = _link("a", _collision("shape", SHAPES[other], "0.05 0 0.02 0.3 0.2 0.1", k=5e3, mu=0.9), 1.5)
    moving += _link("b", _sphere("probe", "0.03 -0.02 0.01", 0.12, tau=0.005), 0.7)
    model = _load(tmp_path, "", moving)
    random, seen = np.random.default_rng(11), 0
    for _ in range(300):
        x = np.concatenate(
            [*(np.r_[random.standard_normal(4), random.uniform(-0.22, 0.22, 3)] for _ in "ab"), np.zeros(12)]
        )
        x[[4, 11]] += 3.0
        x[model.nq :] = 0.5 * random.standard_normal(12)
        set_state(model.double, x)
        if model.double.overlaps():
            seen += 1
            _agree(model, x, np.zeros(0))
    assert seen > 40


OTHERS = {
    **SHAPES,
    "ellipsoid": "<ellipsoid><radii>0.05 0.1 0.08</radii></ellipsoid>",
    "foot": "<box><size>0.11 0.07 0.05</size></box>",
    "wheel": "<cylinder><radius>0.05</radius><length>0.04</length></cylinder>",
}
MEETINGS = [
    *((shape, "ground") for shape in ("box", "capsule", "cylinder", "ellipsoid")),
    ("ball", "cylinder"),
    ("foot", "box"),
]


@pytest.mark.slow
@each_row("mine, other", MEETINGS)
def test_other_shapes_meet_as_drake_lets_them(tmp_path, mine, other):
    """Two free bodies, or one on the ground, in random poses agree with differences of the step solved to rounding."""
    fixed = _collision("shape", OTHERS[other], "0 0 0 0.1 -0.2 0.3", mu=0.9) if other == "ground" else ""
    moving = "" if fixed else _link("a", _collision("shape", OTHERS[other], "0.05 0 0.02 0.3 0.2 0.1", mu=0.9), 1.5)
    moving += _link("b", _collision("probe", OTHERS[mine], "0.03 -0.02 0.01 0.1 0.2 0.3", k=5e3, tau=0.005), 0.7)
    model, random, seen = _load(tmp_path, fixed, moving), np.random.default_rng(11), 0
    bodies = model.nq // 7
    for _ in range(200):
        place = (np.r_[random.standard_normal(4), random.uniform(-0.15, 0.15, 3)] for _ in range(bodies))
        x = np.concatenate([*place, 0.5 * random.standard_normal(model.nv)])
        set_state(model.double, x)
        if not model.double.overlaps():
            continue
        A, _, (method,) = dd.linearize(model, x[None], np.zeros((1, 0)))
        exact = dd.differentiate_step(model, x, method="finite_difference")
        if method == "analytic":
            seen += 1
            # Differences over 3e-7 of a step solved to rounding, next to friction that reverses within 1e-4 m/s.
            np.testing.assert_allclose(A[0], exact.A, rtol=0, atol=1e-5 * np.abs(exact.A).max())
        else:  # boxes that meet at an edge of a face, where Drake's contact point jumps
            assert (mine, other) == ("foot", "box")
        if seen == 12:
            break
    assert seen == 12


@each_row("wrong", ["normal", "point", "swapped"])
def test_a_wrong_motion_of_the_contact_is_refused(tmp_path, monkeypatch, wrong):
    """The derivative of the contact normal or point has an error of 1 %, or the bodies are swapped."""
    right = nearest_points.overlap_change

    def changed(a, b, of):
        change, known = right(a, b, of)
        if wrong == "swapped":
            return -change, known
        change[:, {"normal": slice(3, 6), "point": slice(3)}[wrong]] *= 1.01
        return change, known

    fixed = _collision("post", OTHERS["cylinder"], "0 0 0 0.1 -0.2 0.3", mu=0.9)
    model = _load(tmp_path, fixed, _link("b", _sphere("probe", "0.03 -0.02 0.01", 0.06), 0.7))
    x = np.r_[1.0, 0.1, 0.2, 0.3, 0.1, 0.06, 0.07, 0.4, -0.3, 0.5, 0.2, -0.1, 0.3]
    assert dd.differentiate_step(model, x, method="analytic").method == "analytic"
    assert _contacts(model)
    monkeypatch.setattr(nearest_points, "overlap_change", changed)
    model = _load(tmp_path, fixed, _link("b", _sphere("probe", "0.03 -0.02 0.01", 0.06), 0.7))
    with pytest.raises(GradientError, match="differs from AutoDiffXd's"):
        dd.differentiate_step(model, x, method="analytic")


@each_row("other", ["ground", "box", "capsule", "ball"])
def test_distances_and_normals_are_drakes(tmp_path, other):
    fixed = _collision("shape", SHAPES[other], "0.1 -0.2 0.05 0.4 -0.3 0.2")
    model = _load(tmp_path, fixed, _link("b", _sphere("probe", "0.01 0.02 0.03", 0.08)))
    pairs, random = read_pairs(model), np.random.default_rng(2)
    port, seen = model.plant.get_geometry_query_input_port(), 0
    for _ in range(400):
        x = model.default_state
        x[:4], x[4:7] = random.standard_normal(4), np.array([0.1, -0.2, 0.05]) + random.uniform(-0.3, 0.3, 3)
        set_state(model.double, x)
        poses = [model.plant.EvalBodyPoseInWorld(model.double.context, b).GetAsMatrix34() for b in pairs.bodies]
        touch = pairs.touching(np.array(poses)[None])
        exact = port.Eval(model.double.context).ComputePointPairPenetration()
        assert len(touch.phi) == len(exact)
        for pair in exact:
            seen += 1
            to_sphere = 1 if pair.id_A == pairs.ids[0][0] else -1  # Drake's normal points into A
            np.testing.assert_allclose(touch.phi[0], -pair.depth, atol=1e-14)
            np.testing.assert_allclose(touch.normal[0], to_sphere * pair.nhat_BA_W, atol=1e-12)
    assert seen > 30


def _puck(tmp_path, **options):
    """Load a ball of 0.5 kg on slides along x and z, over level ground."""
    links = _link("x", mass=0.3) + _link("z", _sphere("tip", "0 0 0", 0.1, k=1e4, tau=0.02, mu=0.4), 0.2)
    joints = _joint("along", "prismatic", "world", "x", "1 0 0") + _joint("up", "prismatic", "x", "z", "0 0 1")
    ground = _collision("ground", SHAPES["ground"], k=3e4, tau=0.03, mu=0.6)
    return _load(tmp_path, ground, links + joints, time_step=0.004, **options)


def test_a_sticking_balls_step_in_closed_form(tmp_path):
    """In both directions m (v' - v*) = g, with g_n = (-phi / (h + tau) - v') / R_n and g_t = -v' / R_t."""
    model, h = _puck(tmp_path), 0.004
    k, soft, z = 1e4 * 3e4 / 4e4, h + 0.05, 0.1 - 1e-3
    m_x, m_z = 0.5, 0.2
    R_n, R_t = 1 / (h * k * soft), 1e-3 * np.hypot(1 / m_x, 1 / m_z) / 3
    d = dd.differentiate_step(model, [0.0, z, 1e-4, -0.02], method="analytic")
    assert d.method == "analytic", d.reason
    to_x, to_z = R_t * m_x / (1 + R_t * m_x), R_n * m_z / (1 + R_n * m_z)
    by_phi = -1 / (soft * (1 + R_n * m_z))
    v_z = to_z * (-0.02 - 9.81 * h) + 1e-3 / (soft * (1 + R_n * m_z))
    np.testing.assert_allclose(d.x_next[2:], [to_x * 1e-4, v_z], rtol=1e-6)  # SAP stops at 1e-6 of the momentum
    exact = np.array([[0, 0, to_x, 0], [0, by_phi, 0, to_z]])
    np.testing.assert_allclose(d.A[2:], exact, atol=1e-10)
    np.testing.assert_allclose(d.A[:2], [[1, 0, 0, 0], [0, 1, 0, 0]] + h * exact, atol=1e-12)


def test_a_sliding_balls_friction_in_closed_form(tmp_path):
    """g_n D = a + mu v_x, a = -phi / (h + tau) - v*, D = R_n + mu^2 (R_t + 1 / m_x) + 1 / m_z.

    Both follow from v_x' > 0 and from y_n and y_t in `laws`, without the soft norm.
    """
    model, h = _puck(tmp_path), 0.004
    mu, soft, v_x, v_z = 2 * 0.4 * 0.6 / (0.4 + 0.6), h + 0.05, 1.0, -0.02 - 9.81 * h
    R_n, R_t = 1 / (h * 7.5e3 * soft), 1e-3 * np.hypot(1 / 0.5, 1 / 0.2) / 3
    d = dd.differentiate_step(model, [0.0, 0.1 - 1e-3, 1.0, -0.02], parameters=["z.friction", "z.stiffness"])
    assert d.sources == ("analytic", "analytic"), d.reason
    a, D, by_mu = 1e-3 / soft - v_z, R_n + mu**2 * (R_t + 2) + 5, 2 * mu * (R_t + 2)
    g_n = (a + mu * v_x) / D
    g_mu = v_x / D - g_n * by_mu / D
    g_k = g_n * R_n / 7.5e3 / D
    mu_s, k_s = 2 * 0.6**2, 0.75**2  # d mu / d mu_s = 2 mu_o^2 / (mu_s + mu_o)^2, and half of it for the stiffness
    exact = [[-(g_n + mu * g_mu) / 0.5 * mu_s, -mu * g_k / 0.5 * k_s], [g_mu / 0.2 * mu_s, g_k / 0.2 * k_s]]
    np.testing.assert_allclose(d.x_next[2:], [v_x - mu * g_n / 0.5, v_z + g_n / 0.2], rtol=1e-6)
    # The soft norm of 1e-7 N s has no effect next to impulses y_t of v_x / R_t = 1e3 N s.
    np.testing.assert_allclose(d.C[2:], exact, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("approximation", ["sap", pytest.param("similar", marks=pytest.mark.slow), "lagged"])
def test_columns_by_the_material_are_differences_of_the_step(tmp_path, approximation):
    model = _walker(tmp_path, contact_approximation=approximation)
    wanted = ["fixed.friction", "fixed.stiffness", "fixed.relaxation_time", "foot/toe.stiffness", "foot/heel.friction"]
    wanted += ["tail.relaxation_time", "trunk.stiffness", "trunk.dissipation", "fixed.dissipation"]
    for x, u in _touching_states(model, 6, seed=8):
        ours = dd.differentiate_step(model, x, u, parameters=wanted)
        differences = dd.differentiate_step(model, x, u, parameters=wanted, method="finite_difference")
        assert set(ours.sources) == {"analytic"}
        assert set(differences.sources) == {"finite_difference"}
        # SAP leaves a residual of 1e-6 of the momentum, which affects differences, and lagged contact magnifies it.
        allowed = 2e-4 * np.abs(differences.C).max(axis=0) + {"lagged": 5e-5}.get(approximation, 1e-6) / _values(
            model, wanted
        )
        assert (np.abs(ours.C - differences.C) <= allowed).all()


def _values(model, names):
    """Return the parameters' values (np,), the units of derivatives with respect to them."""
    values = {p.name: float(p.value[0]) for p in dd.list_parameters(model)}
    return np.array([values[name] for name in names])


def test_values_of_the_material_that_are_given_are_those_of_the_derivative(tmp_path):
    model = _puck(tmp_path)
    x = [0.0, 0.1 - 1e-3, 1.0, -0.02]
    given = {"z.friction": 0.9, "fixed.stiffness": 5e4}
    ours = dd.differentiate_step(model, x, parameters=given)
    exact = dd.differentiate_step(model, x, parameters=given, method="autodiff")
    assert ours.method == "analytic"
    assert exact.method == "autodiff"
    np.testing.assert_allclose(ours.A, exact.A, atol=1e-10)
    assert not np.allclose(ours.A, dd.differentiate_step(model, x, method="analytic").A)


def test_what_is_taken_for_a_single_step_with_contact_follows_the_models_size(tmp_path):
    small, x = _puck(tmp_path), [0.0, 0.1 - 1e-3, 1.0, -0.02]
    assert dd.differentiate_step(small, x).method == "autodiff"
    assert dd.differentiate_step(small, x, parameters=["z.friction"]).method == "analytic"
    assert set(dd.linearize(small, [x], np.zeros((1, 0)))[2]) == {"analytic"}
    large = _walker(tmp_path)
    ((x, u),) = _touching_states(large, 1, seed=3)
    assert dd.differentiate_step(large, x, u).method == "analytic"


def test_another_law_is_found_out(tmp_path, monkeypatch):
    """A wrong constant changes v' from the solution or, if this change is small, the Jacobian from AutoDiffXd's."""
    x = [0.0, 0.1 - 1e-3, 1e-4, -0.02]
    monkeypatch.setattr(laws, "SIGMA", 1.1e-3)
    with pytest.raises(GradientError, match="no analytic derivative of this step is known"):
        dd.differentiate_step(_puck(tmp_path), x, method="analytic")
    assert analytic.SAME_JACOBIAN == 1e-9


def test_a_joint_limit_beside_contact_is_known(tmp_path):
    links = _link("x", mass=0.3) + _link("z", _sphere("tip", "0 0 0", 0.1), 0.2)
    joints = _joint("along", "prismatic", "world", "x", "1 0 0", limit=0.01) + _joint(
        "up", "prismatic", "x", "z", "0 0 1"
    )
    model = _load(tmp_path, _collision("ground", SHAPES["ground"]), links + joints)
    free = dd.differentiate_step(model, [0.0, 0.099, 0.5, 0.0], method="analytic")
    assert free.method == "analytic", free.reason
    point = [0.0095, 0.099, 0.5, 0.0]
    held = dd.differentiate_step(model, point, method="analytic")
    assert held.method == "analytic", held.reason
    other = dd.differentiate_step(model, point, method="autodiff")
    assert np.abs(held.A - other.A).max() <= 1e-11 * np.abs(other.A).max()
    assert np.abs(held.A - free.A).max() > 1e-3


@pytest.mark.parametrize("approximation", ["sap", "lagged"])
def test_controllers_beside_contact_are_known_within_their_effort_limits(approximation):
    """A robot with PD controllers has contact, at 20 ms. If an effort limit is reached, AutoDiffXd is used."""
    model = example_robot("go2.urdf", 0.02, approximation=approximation, feet=True, gains=(60.0, 3.0))
    random = np.random.default_rng(0)
    for _ in range(3):
        x = state_in_contact(model, random)
        x[7 : model.nq] *= 0.2  # near the targets, which are 0
        _agree(model, x, random.uniform(-2.0, 2.0, model.nu))
    beyond = np.full(model.nu, 200.0)  # the effort limits are 23.7 and 45 N m
    assert dd.linearize(model, x[None], beyond[None])[2] == ("autodiff",)


def test_what_autodiff_does_not_step_is_certified_by_differences(tmp_path, monkeypatch):
    """A slide is at its limit. Its tilted cylinder is so close to another that AutoDiffXd queries the pair."""
    tilted = _collision("rod", SHAPES["cylinder"], "0.22 0 0.22 0 0.7854 0")
    moving = _link("x", tilted) + _joint("along", "prismatic", "world", "x", "1 0 0", limit=0.01)
    moving += _link("pole", com="0 0 0.3") + _joint("hinge", "revolute", "x", "pole", "0 1 0")
    post, x = _collision("post", SHAPES["cylinder"], "0 0 0 0 0.7854 0"), np.array([0.0099, 0.4, 0.5, -0.3])

    def refused_by_autodiff():
        model = _load(tmp_path, post, moving)
        with pytest.raises(SimulationError, match="Cylinder"):
            dd.differentiate_step(model, x, method="autodiff")
        return model

    model = refused_by_autodiff()
    d, by_differences = (dd.differentiate_step(model, x, method=m) for m in ("analytic", "finite_difference"))
    assert d.method == "analytic", d.reason
    assert "equal to the differences of the step solved to rounding, as AutoDiffXd does not support" in d.reason
    assert np.abs(d.A - by_differences.A).max() <= 1e-6 * np.abs(d.A).max()
    steps, J = take_step(model, select(model, ()), x, np.zeros(0)), np.hstack([d.A, d.B])
    for off, agrees in ((0.0, True), (1e-4, False)):
        why, note = analytic._unlike_differences(steps, 0, (1 + off) * J, iterated=False)
        assert bool(note) == agrees == (not why)
    right = analytic.contact_jacobians

    def wrong(*arguments):
        jacobians, *rest = right(*arguments)
        return 1.001 * jacobians, *rest

    monkeypatch.setattr(analytic, "contact_jacobians", wrong)
    with pytest.raises(GradientError, match="differs from the differences of the step solved to rounding"):
        dd.differentiate_step(refused_by_autodiff(), x, method="analytic")


def test_what_the_form_does_not_describe_is_an_error_where_it_is_asked_for_by_name(tmp_path):
    links = _link("x", mass=0.3) + _link("z", _sphere("tip", "0 0 0", 0.1), 0.2)
    joints = _joint("along", "prismatic", "world", "x", "1 0 0") + _joint("up", "prismatic", "x", "z", "0 0 1")
    ground = _collision("ground", SHAPES["ground"])
    model = _load(tmp_path, ground, links + joints, contact_model="hydroelastic_with_fallback")
    x, wanted = [0.0, 0.099, 0.5, 0.0], "the contact model is hydroelastic_with_fallback, not point"
    for ask in (dd.differentiate_step, lambda *a, method: dd.linearize(a[0], [a[1]], np.zeros((1, 0)), method)):
        with pytest.raises(GradientError, match=wanted):
            ask(model, x, method="analytic")
    d = dd.differentiate_step(model, x)
    assert d.method == "autodiff"
    with pytest.raises(GradientError, match="parameters other than those of contact"):
        dd.differentiate_step(model, x, parameters=["z.mass"], method="analytic")


def test_other_parameters_than_of_contact_are_left_to_autodiff(tmp_path):
    d = dd.differentiate_step(_puck(tmp_path), [0.0, 0.099, 0.5, 0.0], parameters=["z.mass", "z.friction"])
    assert d.method != "analytic"
    assert d.sources == ("autodiff", "finite_difference")


def test_parameters_of_contact_do_nothing_where_nothing_touches(tmp_path):
    d = dd.differentiate_step(_puck(tmp_path), [0.0, 0.5, 0.5, 0.0], parameters=["z.friction", "fixed.stiffness"])
    assert d.sources == ("analytic", "analytic")
    np.testing.assert_array_equal(d.C, 0.0)
