"""Check that the cause of a difference between two engines' steps is named, for changes of model, scheme and law."""

import numpy as np
import pytest
from helpers.contracts import arms
from helpers.engines import engine_of
from helpers.table import each_row

from drake_diff.comparison.attribution import SCHEMES, Terms, attribute, euler
from drake_diff.engines.formats import mjcf
from drake_diff.exceptions import NotOfferedError
from drake_diff.mechanics.coordinates import Coordinates, exponential_turn, rotation
from drake_diff.mechanics.description import describe

H, M, D, K = 0.01, 2.0, 3.0, 50.0


def of(one, two, x, u):
    coordinates = describe(one.model).coordinates
    return attribute(coordinates, one, two, x, u, (one.step(x, u), two.step(x, u)))


def arm_state(model):
    random = np.random.default_rng(4)
    return random.uniform(-1, 1, model.nx), random.uniform(5, 10, model.nu)


@pytest.mark.parametrize(
    ("scheme", "v_next", "moved"),
    [
        # M = 2, D = 3, force -K q. Implicit: (M + h D) a = -K q - D v. Explicit: M a = -K q - D v. q = 0.1, v = 0.5.
        ("damping implicit, positions by v'", 0.5 + H * (-K * 0.1 - D * 0.5) / (M + H * D), "new"),
        ("damping explicit, positions by v'", 0.5 + H * (-K * 0.1 - D * 0.5) / M, "new"),
        ("damping explicit, positions by v,", 0.5 + H * (-K * 0.1 - D * 0.5) / M, "old"),
    ],
)
def test_a_scheme_is_its_formula(scheme, v_next, moved):
    chosen = next(s for s in SCHEMES if str(s).startswith(scheme))
    terms = Terms(np.array([[M]]), np.array([K * 0.1]), np.zeros(1), np.array([D]), H)
    after = euler(Coordinates((), ((0, 0),)), np.array([0.1, 0.5]), terms, chosen)
    np.testing.assert_allclose(after, [0.1 + H * (v_next if moved == "new" else 0.5), v_next], rtol=1e-15)


def test_an_exponential_turn_is_rodrigues_formula():
    quaternion, angle = np.array([0.5, -0.5, 0.1, 0.7]), np.array([0.3, -1.2, 0.4])
    size = np.linalg.norm(angle)
    K = np.cross(np.eye(3), angle / size)
    turned = np.eye(3) + np.sin(size) * K + (1 - np.cos(size)) * K @ K
    np.testing.assert_allclose(rotation(exponential_turn(quaternion, angle)), turned @ rotation(quaternion), atol=1e-15)
    np.testing.assert_allclose(exponential_turn(quaternion, np.zeros(3)), quaternion, atol=0)


# A change of the model for the tested engine, and the terms that may be named as responsible.
CHANGES = {
    "mass": ({"mass": 1.3 * 1.01}, {"inertia", "bias"}),
    "frame": ({"rpy": "0.3 0.2 0.15"}, {"inertia", "bias"}),
    "damping": ({"damping": 2.0}, {"damping"}),
    "armature": ({"rotor": 1.5e-4}, {"inertia"}),
    "gravity": ({"gravity": (0, 0, 9.81)}, {"bias"}),
    "time step": ({"time_step": 0.001}, {"time step"}),
    "effort limit": ({"effort": 4}, {"actuation"}),
}


@pytest.mark.slow
@each_row("change", CHANGES)
@each_row("name", ["drake", "mujoco", "pinocchio"])
def test_the_term_that_was_changed_is_found(tmp_path, name, change):
    changes, terms = CHANGES[change]
    plain = engine_of("drake", arms(tmp_path))
    other = engine_of(name, arms(tmp_path, **changes))
    found = of(plain, other, *arm_state(plain.model))
    assert found.responsible in terms
    assert found.gap > 1e-6
    # The other terms are equal, and the unexplained part is rounding.
    assert found.effects["unexplained"] < 1e-9 * max(1.0, found.gap / 1e-6)
    assert next(iter(found.effects.values())) == max(found.effects.values())


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ('<flag warmstart="disable" eulerdamp="disable"/>', "damping explicit"),
        ('<flag warmstart="disable"/>', "damping implicit"),
    ],
)
def test_mujocos_explicit_damping_is_found(tmp_path, options, told):
    model = arms(tmp_path, damping=5.0)
    path = tmp_path / "own.xml"
    text = mjcf(describe(model), model.time_step)
    assert '<flag warmstart="disable" />' in text
    path.write_text(text.replace('<flag warmstart="disable" />', options))
    drake, mujoco = engine_of("drake", model), engine_of("mujoco", model, path=path)
    found = of(drake, mujoco, *arm_state(model))
    assert str(found.schemes[1]).startswith(told)
    assert found.responsible == "integrator" if "explicit" in told else found.gap < 1e-10


def test_a_turning_body_differs_by_the_exponential(load):
    model = load("sphere_on_ground.sdf")
    drake, mujoco = engine_of("drake", model), engine_of("mujoco", model)
    x = np.array([1.0, 0, 0, 0, 0, 0, 2.0, 3.0, -4.0, 5.0, 0.1, 0.2, 0.3])
    found = of(drake, mujoco, x, np.zeros(0))
    assert found.responsible == "integrator"
    assert [scheme.turn for scheme in found.schemes] == ["first term", "exponential"]
    # From the identity: (cos a, sin a n) against the normalized (1, a n), with half angle a and axis n.
    w = drake.step(x, np.zeros(0))[7:10]
    a = model.time_step * np.linalg.norm(w) / 2
    along = np.abs(w / np.linalg.norm(w)).max()
    assert found.gap == pytest.approx((np.sin(a) - np.sin(np.arctan(a))) * along, rel=1e-6)


def test_contact_and_limits_are_told_apart_from_the_free_step(load):
    model = load("sphere_on_ground.sdf")
    drake, pinocchio = engine_of("drake", model), engine_of("pinocchio", model)
    x = np.array(model.default_state)
    x[6] = 0.1 - 1e-3
    assert of(drake, pinocchio, x, np.zeros(0)).responsible == "contact law"
    cart = load("cart_pole.urdf")
    upper = cart.plant.GetPositionUpperLimits()
    assert np.isfinite(upper[0])
    x = np.array([upper[0] - 1e-4, 0.3, 2.0, 0.0])
    assert of(engine_of("drake", cart), engine_of("pinocchio", cart), x, np.zeros(1)).responsible == "limit law"


class Doctored:
    """An engine whose step differs from its terms by `push`, and which offers no mass matrix if `offers` is False."""

    def __init__(self, engine, push=0.0, offers=True):
        self.engine, self.push, self.offers = engine, push, offers
        self.contract, self.name = engine.contract, "doctored"
        self.bias, self.contact_depth = engine.bias, engine.contact_depth

    def step(self, x, u):
        return self.engine.step(x, u) + self.push

    def mass_matrix(self, q):
        if not self.offers:
            raise NotOfferedError("none")
        return self.engine.mass_matrix(q)


def test_what_nothing_tells_of_is_unexplained(tmp_path):
    drake = engine_of("drake", arms(tmp_path))
    found = of(drake, Doctored(drake, push=1e-3), *arm_state(drake.model))
    assert found.responsible == "unexplained"
    assert found.effects["unexplained"] == pytest.approx(1e-3, rel=1e-9)


def test_what_is_not_offered_is_assumed_and_said(tmp_path):
    drake = engine_of("drake", arms(tmp_path))
    heavier = engine_of("drake", arms(tmp_path, rotor=2e-4))
    found = of(drake, Doctored(heavier, offers=False), *arm_state(drake.model))
    assert found.assumed == ("M(q) of doctored",)
    assert found.effects["inertia"] == 0
    assert found.responsible == "unexplained"
