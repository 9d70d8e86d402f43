"""Check comparisons of engines: equal engines are found to be equal, and differences are found and explained."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.contracts import arms
from helpers.engines import Doctored, engine_of, needs
from helpers.table import each_row

import drake_diff as dd
from drake_diff.comparison.result import JACOBIAN_TOLERANCE, STEP_TOLERANCE
from drake_diff.engines.load import load_spec
from drake_diff.exceptions import (
    InputError,
    MissingDependencyError,
    NotOfferedError,
    ShapeError,
    SimulationError,
    UnknownNameError,
)
from drake_diff.model.tangent import tangent_space

pytestmark = pytest.mark.solve

G = 9.81


def by_name(comparison):
    return {e.engine: e for e in comparison.engines}


def test_a_free_model_is_the_same_in_every_engine(load):
    for name in ("mujoco", "pinocchio"):
        needs(name)
    model = load("cart_pole.urdf")
    found = dd.compare(model, ("numpy", "mujoco", "pinocchio", "drake:lagged:implicit"), num_steps=50)
    assert found.holds
    assert [e.engine for e in found.engines] == [
        "drake (sap, autodiff)", "numpy", "mujoco", "pinocchio", "drake (lagged, implicit)",
    ]  # fmt: skip
    for e in found.engines:
        assert (e.verdict, e.first_apart, e.gradient) == ("same", None, "its own step's")
        assert e.step_gaps.shape == (50,)
        assert e.step_gaps.max() < 1e-13
        assert e.jacobian_gaps.max() < 1e-10
        assert e.motion.xs.shape == (51, model.nx)
        # The rollout Jacobian is a product of 50 Jacobians, each accurate to 1e-11 of its largest entry.
        np.testing.assert_allclose(e.rollout_jacobian, found.reference.rollout_jacobian, atol=1e-8)
        assert e.seconds_per_step > 0
        assert e.seconds_per_jacobian > 0


def test_the_motion_is_the_closed_form_of_a_throw(load):
    """z_k = z0 + v0 h k - g h^2 k (k + 1) / 2, E_k = E_0 - m g^2 h^2 k / 2, d z_N / d v0 = h N, in every engine."""
    needs("mujoco")
    needs("pinocchio")
    model = load("projectile.sdf", time_step=0.01)
    x0 = np.array([1.0, 0, 0, 0, 0, 0, 5, 0, 0, 0, 1, 0, 2])
    found = dd.compare(model, ("numpy", "mujoco", "pinocchio"), x0=x0, num_steps=40)
    k = np.arange(41)
    mass = model.plant.CalcTotalMass(model.double.context)
    for e in found.engines:
        np.testing.assert_allclose(e.motion.xs[:, 6], 5 + 0.02 * k - G * 1e-4 * k * (k + 1) / 2, atol=1e-12)
        np.testing.assert_allclose(e.motion.energy - e.motion.energy[0], -mass * G**2 * 1e-4 * k / 2, atol=1e-11)
        row, column = (tangent_space(model).names.index(name) for name in ("ball_z", "ball_vz"))
        np.testing.assert_allclose(e.rollout_jacobian[row, column], 0.4, atol=1e-8)


@pytest.mark.slow
def test_contact_laws_are_told_apart_and_the_free_part_is_not(load):
    needs("mujoco")
    needs("pinocchio")
    model = load("sphere_on_ground.sdf")
    x0 = np.array(model.default_state)
    x0[6] = 0.4
    compared = dd.compare(model, ("drake:lagged", "mujoco", "pinocchio"), x0=x0, num_steps=60)
    found = by_name(compared)
    fall = int(np.sqrt(2 * 0.3 / G) / model.time_step)
    for name in ("drake (lagged, autodiff)", "mujoco", "pinocchio"):
        e = found[name]
        assert e.verdict == ("other model" if name == "pinocchio" else "other law")
        assert abs(e.first_apart - fall) <= 2
        assert e.largest.responsible == "contact law"
        assert "contact law" in [line.quantity for line in e.told]
        assert max(e.step_gaps[: fall - 2]) < STEP_TOLERANCE["float64"]
    # Pinocchio has no contact pairs, as its contract says, so it is not the same model.
    assert not compared.holds
    assert [line.quantity for line in found["pinocchio"].broken] == ["contact pairs"]
    assert found["pinocchio"].motion.xs[-1, 6] < 0
    assert found["pinocchio"].motion.depth.max() == 0
    assert 0 < found["drake (sap, autodiff)"].motion.depth.max() < 0.05


@pytest.mark.parametrize("name", ["mujoco", "pinocchio"])
def test_another_model_is_no_other_law(tmp_path, name):
    """A mass that is 1 % larger breaks the contract, even if the gap has an explanation."""
    heavier = engine_of(name, arms(tmp_path, mass=1.3 * 1.01))
    e = by_name(dd.compare(arms(tmp_path), (heavier,), num_steps=20))[name]
    assert e.verdict == "other model"
    assert {"mass", "M(q)", "bias(q, v)"} == {line.quantity for line in e.broken}
    assert e.first.responsible in ("inertia", "bias")


def test_what_no_contract_tells_of_is_unexplained(load):
    model = load("pendulum.urdf")
    drake = engine_of("drake", model)
    pushed = Doctored(drake, name="pushed", step=lambda x, u: drake.step(x, u) + 1e-6)
    e = by_name(dd.compare(model, (pushed,), num_steps=10))["pushed"]
    assert (e.verdict, e.first_apart, e.largest.responsible) == ("unexplained", 0, "unexplained")
    assert e.told == ()


def test_a_wrong_jacobian_is_found_where_every_step_is_right(load):
    """One entry is off by 1e-4, so the Jacobian is neither the reference's nor that of the engine's own step."""
    model = load("pendulum.urdf")
    drake = engine_of("drake", model)

    def wrong(x, u):
        found = drake.differentiate_step(x, u)
        A = np.array(found.A)
        A[1, 0] += 1e-4
        return found._replace(A=A)

    found = dd.compare(model, (Doctored(drake, name="wrong", differentiate_step=wrong),), num_steps=10)
    e = by_name(found)["wrong"]
    assert e.step_gaps.max() == 0
    assert (e.verdict, e.gradient) == ("unexplained", "not its own step's")
    assert e.jacobian_gaps.max() > JACOBIAN_TOLERANCE["float64"]
    assert not found.holds


def test_without_derivatives_differences_of_the_steps_are_compared(load):
    model = load("cart_pole.urdf")
    drake = engine_of("drake", model)

    def none(x, u):
        raise NotOfferedError("forward only")

    e = by_name(dd.compare(model, (Doctored(drake, name="blind", differentiate_step=none),), num_steps=10))["blind"]
    assert (e.verdict, e.gradient, e.rollout_jacobian, e.seconds_per_jacobian) == ("same", "none", None, None)
    assert e.jacobians[0].method.startswith("central differences")
    assert e.jacobian_gaps.max() < 1e-9


def test_an_engine_that_breaks_off_is_told_with_the_time(load):
    model = load("pendulum.urdf")
    drake = engine_of("drake", model)
    x0 = np.array([0.5, 0.0])

    def breaks(x, u):
        if x[1] < -0.5:
            raise SimulationError("the solver gave up")
        return drake.step(x, u)

    e = by_name(dd.compare(model, (Doctored(drake, name="weak", step=breaks),), x0=x0, num_steps=100))["weak"]
    assert e.verdict == "unexplained"
    assert "the solver gave up" in e.motion.status
    assert len(e.motion.xs) < 100
    assert e.motion.xs[-1, 1] < -0.5 <= e.motion.xs[-2, 1]


def test_missing_and_impossible_engines_are_listed_with_the_reason(load, monkeypatch):
    from drake_diff.engines import load as loading

    monkeypatch.setitem(loading.ENGINES, "absent", ("absent_engine", "AbsentEngine"))

    def missing(module):
        raise MissingDependencyError("needs it: pip install 'drake-diff[absent]'")

    real = loading.import_module
    monkeypatch.setattr(loading, "import_module", lambda m: missing(m) if "absent" in m else real(m))
    found = dd.compare(load("acrobot.xml"), ("absent", "numpy"), num_steps=5)
    told = {r.engine: r for r in found.refused}
    assert not told["absent"].installed
    assert "drake-diff[absent]" in told["absent"].reason
    assert told["numpy"].installed
    assert "no hand calculation" in told["numpy"].reason
    assert not found.holds  # no engine was compared


def test_bad_input_is_named(load):
    model = load("pendulum.urdf")
    with pytest.raises(UnknownNameError, match="mujoco"):
        dd.compare(model, ("bullet",))
    with pytest.raises(InputError, match="drake:CONTACT"):
        load_spec("mujoco:lagged", model)
    with pytest.raises(ShapeError):
        dd.compare(model, (), x0=np.zeros(3))
    with pytest.raises(InputError):
        dd.compare(model, (), us=np.zeros((5, 2)))


def test_a_float32_engine_has_its_own_tolerance(load):
    model = load("pendulum.urdf")
    drake = engine_of("drake", model)
    contract = replace(drake.contract, precision="float32")
    for push, verdict in ((3e-6, "same"), (3e-4, "unexplained")):
        other = Doctored(drake, contract=contract, step=lambda x, u, push=push: drake.step(x, u) + push)
        other.name = "single"
        assert by_name(dd.compare(model, (other,), num_steps=5))["single"].verdict == verdict


@pytest.mark.slow
@each_row("name, verdict", [("pinocchio", "other model"), ("mujoco", "other law")])
def test_another_jacobian_in_contact_is_not_unexplained(load, name, verdict):
    """The motion has no contact. At the sampled contact state, Pinocchio has no contact and MuJoCo another law."""
    needs(name)
    model = load("sphere_on_ground.sdf")
    x0 = np.array(model.default_state)
    x0[6] = 3.0
    e = by_name(dd.compare(model, (name,), x0=x0, num_steps=5, seed=4))[name]
    assert e.first_apart is None
    assert e.verdict == verdict
    of_states = {e.jacobians[i].state: e.laws[i] for i in e.other_states}
    # MuJoCo integrates rotations with the exponential map.
    assert of_states == {"contact": "contact law"} | ({} if name == "pinocchio" else {"free": "integrator"})


@pytest.mark.parametrize(("factor", "verdict"), [(1.0, "its own step's"), (1.05, "undecided")])
def test_single_precision_is_never_called_wrong_by_differences_of_itself(load, factor, verdict):
    model = load("double_pendulum.urdf")
    drake = engine_of("drake", model)

    def rounded(x, u):
        return np.float64(np.float32(drake.step(x, u)))

    def scaled(x, u):
        found = drake.differentiate_step(x, u)
        return found._replace(A=factor * found.A)

    contract = replace(drake.contract, precision="float32")
    single = Doctored(drake, name="single", contract=contract, step=rounded, differentiate_step=scaled)
    e = by_name(dd.compare(model, (single,), num_steps=5))["single"]
    assert e.gradient == verdict
    assert all(j.certificate is None for j in e.jacobians)
