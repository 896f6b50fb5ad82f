"""Inverse-dynamics regression against closed forms, Drake's own inverse dynamics, and hidden truths."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces, SpatialInertia, UnitInertia

from vtbdrake.calibration import (
    CalibrationError,
    DriveModel,
    JointRecording,
    TorqueRegressor,
    base_parameters,
    equations,
    friction,
    regress,
)
from vtbdrake.calibration.joint_model import log_cholesky
from vtbdrake.testbed.inertia import inertia_of
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario
from vtbdrake_diagrams.recorded_arms import plants

PERIOD = 0.002
TRUTH = {
    "shoulder.viscous": 0.05, "shoulder.coulomb": 0.2, "shoulder.offset": 0.03, "shoulder.rotor": 0.01,
    "elbow.viscous": 0.02, "elbow.coulomb": 0.1, "elbow.offset": -0.02, "elbow.rotor": 0.005,
}  # fmt: skip


@pytest.fixture(scope="module")
def double() -> TorqueRegressor:
    plant = DoublePendulumScenario().build().plant
    assert plant is not None
    return TorqueRegressor(plant)


def recorded(
    model: TorqueRegressor, seed: int, *, seconds: float = 20.0, noise: float = 1e-4, disturbance: float = 0.05
) -> JointRecording:
    """Return a motion with the torques that it takes, in which a disturbance (AR(1), 50 ms) acts that is not logged."""
    generator = np.random.default_rng(seed)
    times = PERIOD * np.arange(round(seconds / PERIOD))
    q, v, a = np.zeros((3, len(times), model.nq))
    for _ in range(5):
        w, phase = 2.0 * np.pi * generator.uniform(0.1, 1.0, model.nq), generator.uniform(0.0, 6.0, model.nq)
        size, angle = generator.uniform(0.2, 0.5, model.nq), np.outer(times, w) + phase
        q += size * np.sin(angle)
        v += size * w * np.cos(angle)
        a -= size * w**2 * np.sin(angle)
    decay, walk = np.exp(-PERIOD / 0.05), np.zeros((len(times), model.nq))
    for k in range(1, len(times)):
        walk[k] = decay * walk[k - 1] + np.sqrt(1.0 - decay**2) * generator.normal(size=model.nq)
    tau = model.matrix(q, v, a) @ model.vector(TRUTH) + disturbance * walk
    return JointRecording(f"seed {seed}", times, q + noise * generator.normal(size=q.shape), tau)


def drake_inverse_dynamics(plant: MultibodyPlant, context, q, v, a):
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    forces = MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, forces)
    return plant.CalcInverseDynamics(context, a, forces)


def test_regressor_is_the_closed_form_of_two_links(double: TorqueRegressor) -> None:
    # Links that hang from y axes, l1 = 0.2 m (Spong, Hutchinson and Vidyasagar, "Robot Modeling and Control", 6.4).
    generator = np.random.default_rng(1)
    q, v, a = generator.normal(size=(3, 50, 2))
    l1, g = 0.2, 9.81
    m1r1, m2, m2r2, I1, I2 = 0.11, 0.7, 0.16, 0.02, 0.05
    c2, s2, end = np.cos(q[:, 1]), np.sin(q[:, 1]), np.sin(q[:, 0] + q[:, 1])
    first = (I1 + m2 * l1**2) * a[:, 0] + I2 * a.sum(axis=1)
    first += l1 * m2r2 * (c2 * (2.0 * a[:, 0] + a[:, 1]) - s2 * (2.0 * v[:, 0] * v[:, 1] + v[:, 1] ** 2))
    first += g * ((m1r1 + m2 * l1) * np.sin(q[:, 0]) + m2r2 * end)
    second = I2 * a.sum(axis=1) + l1 * m2r2 * (c2 * a[:, 0] + s2 * v[:, 0] ** 2) + g * m2r2 * end
    p = double.vector(dict.fromkeys(double.names, 0.0))
    values = {"upper.mz": -m1r1, "lower.m": m2, "lower.mz": -m2r2, "upper.Iyy": I1, "lower.Iyy": I2}
    for name, value in values.items():
        p[double.names.index(name)] = value
    np.testing.assert_allclose(double.matrix(q, v, a) @ p, np.stack([first, second], axis=1), atol=1e-12)


def test_base_parameters_of_two_links_are_those_of_the_textbook(double: TorqueRegressor) -> None:
    names = base_parameters(double).names
    assert names[:6] == (
        "upper.mx",
        "upper.mz - 0.2 lower.m",
        "upper.Iyy + 0.04 lower.m + shoulder.rotor",
        "lower.mx",
        "lower.mz",
        "lower.Iyy",
    )
    assert len(names) == 13  # and seven of friction


@pytest.mark.parametrize("make", [plants.panda, plants.tiago, plants.kr300, plants.go2_leg], ids=lambda f: f.__name__)
def test_regressor_is_drakes_inverse_dynamics_for_any_inertia(make) -> None:
    plant = make()
    model, context = TorqueRegressor(plant, drives={}), plant.CreateDefaultContext()
    base, generator = base_parameters(model), np.random.default_rng(2)
    for _ in range(5):
        p = []
        for name in model.bodies:
            masses, points = generator.uniform(0.1, 1.0, 5), generator.normal(size=(5, 3))
            about_origin = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(masses, points, strict=True))
            moments, products, m = about_origin.diagonal(), about_origin[[0, 0, 1], [1, 2, 2]], masses.sum()
            G = UnitInertia(*moments / m, *products / m)
            body = plant.GetBodyByName(name)
            body.SetSpatialInertiaInBodyFrame(context, SpatialInertia(m, masses @ points / m, G))
            p += [m, *(masses @ points), *moments, *products]
        q, v, a = generator.normal(size=(3, model.nq))
        Y = model.matrix(q[np.newaxis], v[np.newaxis], a[np.newaxis])[0]
        expected = drake_inverse_dynamics(plant, context, q, v, a)
        np.testing.assert_allclose(Y @ p, expected, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(Y[:, list(base.columns)] @ (base.B @ p), expected, rtol=1e-6, atol=1e-6)


def test_panda_has_as_many_base_parameters_as_published() -> None:
    # C. Gaz and others, RA-L 2019: 43 dynamic coefficients, without friction.
    assert len(base_parameters(TorqueRegressor(plants.panda(), drives={})).names) == 43


@pytest.mark.slow
def test_intervals_cover_hidden_parameters(double: TorqueRegressor) -> None:
    base = base_parameters(double)
    truth, covered = base.B @ double.vector(TRUTH), []
    for seed in range(25):
        fit = regress(double, equations(double, recorded(double, seed, seconds=15.0), cutoff=30.0, band=8.0))
        covered.append((fit.lower <= truth) & (truth <= fit.upper))
    # 25 trials x 13 parameters under a correlated disturbance.
    assert 0.88 <= np.mean(covered) <= 0.995


def test_condition_is_that_of_the_weighted_equations(double: TorqueRegressor) -> None:
    base, each = base_parameters(double), equations(double, recorded(double, 3), cutoff=30.0, band=8.0)
    fit = regress(double, each)
    weighted = (each.Y[:, :, list(base.columns)] / fit.residual[:, np.newaxis]).reshape(-1, len(base.columns))
    assert fit.condition == pytest.approx(np.linalg.cond(weighted / np.linalg.norm(weighted, axis=0)), rel=1e-2)


def test_gain_of_a_current_is_found_beside_a_known_one(double: TorqueRegressor) -> None:
    log = recorded(double, 3)
    currents = JointRecording(log.source, log.times, log.q, log.u / [1.0, 1.3])
    each = equations(double, currents, cutoff=30.0, band=8.0)
    fit = regress(double, each, gains=[1])
    assert fit.gains == pytest.approx([1.0, 1.3], rel=0.03)
    np.testing.assert_allclose(fit.torques(each), each.tau, atol=0.2)
    with pytest.raises(CalibrationError, match="all gains are unknown"):
        regress(double, each, gains=[0, 1])


def test_consistent_parameters_are_those_of_bodies(double: TorqueRegressor) -> None:
    log = recorded(double, 4, seconds=3.0, disturbance=0.3)
    each = equations(double, log, cutoff=30.0, band=8.0)
    free, fit = regress(double, each), regress(double, each, consistent=True)
    for body in ("upper", "lower"):
        mass, com, inertia = fit.inertia(body)
        # It would refuse a body that has no positive masses, and is the start of an `Inertia`.
        z = log_cholesky(mass, com, inertia)
        assert float(inertia_of(z)[0]) == pytest.approx(mass)
    assert all(fit.parameters[double.names.index(f"{joint}.coulomb")] >= -1e-6 for joint in ("shoulder", "elbow"))
    held_out = equations(double, recorded(double, 5, disturbance=0.0), cutoff=30.0, band=8.0)
    errors = [np.sqrt(np.mean((each.torques(held_out) - held_out.tau) ** 2)) for each in (fit, free)]
    assert errors[0] < errors[1]


def test_own_numbers_count_where_a_recording_says_little(double: TorqueRegressor) -> None:
    each = equations(double, recorded(double, 6, seconds=1.5, disturbance=0.5), cutoff=30.0, band=8.0)
    close = regress(double, each, consistent=True, prior=0.001).parameters[:20]
    np.testing.assert_allclose(close, double.nominal[:20], atol=0.02)


def test_motor_coupled_to_two_joints_has_one_friction(double: TorqueRegressor) -> None:
    plant = DoublePendulumScenario().build().plant
    assert plant is not None
    both = DriveModel(np.array([1.0, 1.0]), friction(offset=False))
    model = TorqueRegressor(plant, drives={"both": both})
    v = np.array([[0.5, -0.2]])
    Y = model.matrix(np.zeros((1, 2)), v, np.zeros((1, 2)))[0]
    np.testing.assert_allclose(Y[:, model.names.index("both.viscous")], [0.3, 0.3])


def test_joint_that_stands_still_leaves_its_parameters_undetermined(double: TorqueRegressor) -> None:
    log = recorded(double, 7)
    q = log.q * [1.0, 0.0]
    v = np.gradient(q, log.times, axis=0)
    tau = double.matrix(q, v, np.gradient(v, log.times, axis=0)) @ double.vector(TRUTH)
    still = JointRecording("elbow at rest", log.times, q, tau + np.random.default_rng(0).normal(size=q.shape))
    fit = regress(double, equations(double, still, cutoff=30.0, band=8.0))
    unknown = {name for name, deviation in zip(fit.names, fit.deviations, strict=True) if np.isinf(deviation)}
    assert {"elbow.viscous", "elbow.coulomb", "elbow.rotor"} <= unknown
    # The torque of the elbow tells the moment of the link that it carries.
    assert not unknown & {"shoulder.viscous", "shoulder.coulomb", "lower.Iyy"}
    assert any("not determined" in remark for remark in fit.remarks)


def test_torques_of_the_other_sign_are_those_of_no_body(double: TorqueRegressor) -> None:
    log = recorded(double, 8)
    turned = equations(double, JointRecording("turned", log.times, log.q, -log.u), cutoff=30.0, band=8.0)
    # The base parameters fit as well as ever, with negative masses.
    assert np.max(regress(double, turned).residual) < 0.1
    assert any("wrong signs" in remark for remark in regress(double, turned, consistent=True).remarks)
    right = regress(double, equations(double, log, cutoff=30.0, band=8.0), consistent=True)
    assert not right.remarks


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q": np.zeros((500, 3))}, "positions .* the model 2 joints"),
        ({"u": np.zeros((400, 2))}, "torques"),
        ({"times": np.r_[np.arange(250), np.arange(250)] * PERIOD}, "clock"),
        ({"times": np.arange(500) * 0.1}, "cannot be filtered"),
        ({"u": np.full((500, 2), np.nan)}, "not finite"),
    ],
)
def test_recordings_that_do_not_fit_are_refused(double: TorqueRegressor, change, message: str) -> None:
    parts = {"times": PERIOD * np.arange(500), "q": np.zeros((500, 2)), "u": np.zeros((500, 2))} | change
    with pytest.raises(CalibrationError, match=message):
        equations(double, JointRecording("log", **parts), cutoff=30.0, band=16.0)


def test_values_of_no_parameter_are_refused(double: TorqueRegressor) -> None:
    with pytest.raises(CalibrationError, match=r"shoulder\.viscos is no parameter"):
        double.vector({"shoulder.viscos": 1.0})
    with pytest.raises(CalibrationError, match="direction"):
        TorqueRegressor(plants.pendulum(), drives={"motor": DriveModel(np.ones(2), friction())})
