"""The joint model against Drake's own plant, against `JointDrives`, and inertias against their definition."""

from __future__ import annotations

import casadi
import numpy as np
import pytest

from tests.calibration.pendulum import ARM, DRIVES, PERIOD, PendulumScenario, recorded
from vtbdrake.calibration import CalibrationError, Inertia, JointModel
from vtbdrake.calibration.filtering import Noise
from vtbdrake.calibration.joint_model import log_cholesky
from vtbdrake.calibration.joint_recording import JointRecording
from vtbdrake.optimization import Parameter
from vtbdrake.testbed.inertia import inertia_of

MASS = Parameter(f"{ARM}.link.mass", 0.1, 5.0)


def test_ten_numbers_are_a_body_of_positive_masses_and_come_back() -> None:
    symbol = casadi.SX.sym("z", 10)
    convert = casadi.Function("f", [symbol], list(inertia_of(symbol)))
    generator = np.random.default_rng(0)
    for _ in range(50):
        # Points of mass define mass, centre and moments.
        masses, points = generator.uniform(0.1, 1.0, 6), generator.normal(size=(6, 3))
        mass, center = masses.sum(), masses @ points / masses.sum()
        r = points - center
        tensor = np.einsum(
            "k,kij->ij", masses, (r**2).sum(1)[:, None, None] * np.eye(3) - np.einsum("ki,kj->kij", r, r)
        )
        moments = tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        for expected, value in zip((mass, center, moments), convert(log_cholesky(mass, center, moments)), strict=True):
            np.testing.assert_allclose(value.full().ravel(), np.ravel(expected), rtol=1e-9, atol=1e-10)
    # Whatever the ten numbers are, the triangle inequality of moments holds.
    for _ in range(50):
        mass, _, moments = (value.full().ravel() for value in convert(generator.normal(size=10)))
        xx, yy, zz, xy, xz, yz = moments
        principal = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert mass[0] > 0.0 and principal[0] > 0.0 and principal[2] < principal[0] + principal[1]
    with pytest.raises(CalibrationError, match="is no body"):
        log_cholesky(1.0, [0.0, 0.0, 0.0], [1.0, 1.0, 3.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("time_step", [0.0, PERIOD])
def test_steps_are_those_of_drake(time_step: float) -> None:
    # A continuous plant without friction, which the drives sample once in several of its steps.
    coulomb, viscous = (0.3, 0.05) if time_step else (0.0, 0.0)
    scenario = PendulumScenario(time_step=time_step)
    truth = {f"{ARM}.link.mass": 1.7, f"{DRIVES}.coulomb[0]": coulomb, f"{DRIVES}.viscous[0]": viscous}
    log = recorded(truth, 3, seconds=2.0, noise=0.0, scenario=scenario)
    model = JointModel(
        scenario.build(),
        [MASS, Parameter(f"{DRIVES}.coulomb[0]", 0.0, 1.0), Parameter(f"{DRIVES}.viscous[0]", 0.0, 1.0)],
    )
    q, u = log.sense["position"].values[:, 0], log.act["torque"].values
    z = np.array([1.7, coulomb, viscous])
    motor, _ = model.motor(log.sense["position"].times, u, z)
    x, positions, substeps = np.array([q[0], 0.0]), [q[0]], 1 if time_step else 4
    for m in motor[:-1]:
        for _ in range(substeps):
            x = model.step(x, m, PERIOD / substeps, z).full().ravel()
        positions.append(x[0])
    # A continuous plant is integrated by Drake to its accuracy of 1e-3; the drives predict the end of a step.
    np.testing.assert_allclose(positions, q, rtol=0.0, atol=3e-4 if time_step else 1e-5)


def test_motor_is_that_of_the_drives_and_its_derivatives_those_of_differences() -> None:
    parameters = [Parameter(f"{DRIVES}.delay", 0.0, 8.0), MASS, Parameter(f"{DRIVES}.time_constant", 0.0, 0.1)]
    model = JointModel(PendulumScenario().build(), parameters)
    times, u = PERIOD * np.arange(200), np.random.default_rng(1).normal(size=(200, 1))
    m, _ = model.motor(times, u, np.array([3.0, 1.0, 0.02]))
    # The current loop of `JointDrives`, step by step.
    expected, motor = [], u[0, 0]
    for k in range(200):
        # One period later, because the drives are sampled.
        motor += (1.0 - np.exp(-PERIOD / 0.02)) * (u[max(k - 4, 0), 0] - motor)
        expected.append(motor)
    np.testing.assert_allclose(m[:, 0], expected, atol=1e-12)
    for k, index in enumerate((0, 2)):
        z, step = np.array([2.6, 1.0, 0.02]), 1e-6
        ends = [model.motor(times, u, z + s * step * np.eye(3)[index])[0] for s in (-1.0, 1.0)]
        np.testing.assert_allclose(
            model.motor(times, u, z)[1][:, k], (ends[1] - ends[0]) / (2.0 * step), rtol=1e-4, atol=1e-6
        )


@pytest.mark.parametrize(
    ("parameters", "inertias", "message"),
    [
        ([Parameter("sim.sense.position.noise", 0.0, 1.0)], [], "is no parameter of a plant"),
        ([Parameter(f"{ARM}.link.mass", 2.0, 3.0)], [], "begins at 1, outside its range"),
        ([MASS, MASS], [], "given twice"),
        ([Parameter(f"{DRIVES}.limit[0]", 0.0, 50.0)], [], "is no parameter of a plant"),
    ],
)
def test_what_is_no_parameter_of_the_model_is_refused(parameters, inertias, message) -> None:
    with pytest.raises(CalibrationError, match=message):
        JointModel(PendulumScenario().build(), parameters, inertias)


def test_a_whole_inertia_begins_where_the_body_is() -> None:
    model = JointModel(PendulumScenario().build(), inertias=[Inertia(f"{ARM}.link")])
    symbol = casadi.SX.sym("z", 10)
    mass, center, moments = casadi.Function("f", [symbol], list(inertia_of(symbol)))(model.start)
    assert float(mass) == pytest.approx(1.0)
    np.testing.assert_allclose(center.full().ravel(), [0.0, 0.0, -0.3], atol=1e-12)
    np.testing.assert_allclose(moments.full().ravel(), [0.02, 0.02, 0.02, 0.0, 0.0, 0.0], atol=1e-12)


def test_noise_of_a_smooth_motion_is_guessed_from_its_differences() -> None:
    times, rng = np.arange(0.0, 20.0, 0.005), np.random.default_rng(0)
    deviation = np.array([1e-3, 4e-3])
    q = np.stack([np.sin(times), np.cos(2.0 * times)], axis=1) + deviation * rng.normal(size=(len(times), 2))
    recording = JointRecording("drawn", times, q, np.zeros((len(times), 2)))
    np.testing.assert_allclose(Noise.guess([recording], np.zeros((1, 2))).measurement, deviation, rtol=0.05)
