"""Designed motions: limits on a dense grid of the simulated testbed, and the covariance of actual calibrations."""

from __future__ import annotations

import numpy as np
import pytest

from tests.calibration.pendulum import ARM, DRIVES, PERIOD, PendulumScenario
from vtbdrake.calibration import CalibrationError, Excitation, Noise, calibrate, excitation
from vtbdrake.common.spline import Spline
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.optimization import Parameter
from vtbdrake.recording import Log, Series
from vtbdrake_diagrams.manipulator.arm import JOINTS, Arm
from vtbdrake_diagrams.manipulator.studies.excited import PLAN, ExcitedArmScenario

PAYLOAD, DISTURBANCE = "sim.sys.arm.tool.mass", 0.05
NOISE = Noise(np.full(JOINTS, 1e-5), np.full(JOINTS, DISTURBANCE), 0.05)
PARAMETERS = [
    Parameter(PAYLOAD, 0.1, 2.0),
    Parameter("sim.act.drives.coulomb[1]", 0.05, 0.8),
    Parameter("sim.act.drives.viscous[1]", 0.1, 1.6),
    Parameter("sim.act.drives.viscous[3]", 0.1, 1.6),
    Parameter("sim.sys.arm.joint_4.rotor_inertia", 1e-5, 8e-5),
]
SCENARIO = ExcitedArmScenario(knots=11, duration=4.0, position_errors=ErrorModel(quantization=6e-6))


def driven(knots: np.ndarray, *, seed: int = 0) -> tuple[Log, dict[str, np.ndarray]]:
    """Return the log of the testbed that follows a motion, disturbed, and its true states, every millisecond."""
    testbed = SCENARIO.build()
    context = testbed.default_context()
    testbed.write(context, {PLAN: np.append(0.001, knots.ravel())})
    simulator, random = testbed.simulator(context), np.random.default_rng(seed)
    names = ("sim.sense.joint_position.joint_encoders", "dps.impl.torque", "sim.act.drives.torque")
    readers = {name: testbed.reader(name) for name in names}
    plant = testbed.plant
    assert plant is not None
    offset, decay = np.zeros(JOINTS), np.exp(-0.001 / 0.05)
    rows: dict[str, list[np.ndarray]] = {"q": [], "u": [], "tau": [], "x": []}
    for k in range(round(1e3 * SCENARIO.duration)):
        simulator.AdvanceTo(0.001 * k)
        for row, name in zip(("q", "u", "tau"), names, strict=True):
            rows[row].append(np.array(readers[name](context)))
        rows["x"].append(plant.GetPositionsAndVelocities(plant.GetMyContextFromRoot(context)).copy())
        # A disturbance beside the command: what acts in the next period, and no controller knows of.
        offset = decay * offset + np.sqrt(1.0 - decay**2) * DISTURBANCE * random.normal(size=JOINTS)
        actuator = testbed.read(context, "sim.act.drives.torque")
        testbed.write(context, {"sim.act.drives.torque": actuator + offset})
    true = {name: np.array(values) for name, values in rows.items()}
    times = 0.001 * np.arange(len(true["q"]))
    return Log("motion", {"joint_position": Series(times, true["q"])}, {"joint_torque": Series(times, true["u"])}), true


@pytest.fixture(scope="module")
def motion() -> Excitation:
    return excitation(SCENARIO, PARAMETERS, spline=SCENARIO.spline, noise=NOISE, starts=1, iterations=25)


@pytest.fixture(scope="module")
def designed(motion: Excitation) -> tuple[Log, dict[str, np.ndarray]]:
    return driven(motion.knots)


@pytest.mark.slow
@pytest.mark.one_python
def test_limits_hold_between_the_knots_of_the_simulated_arm(
    motion: Excitation, designed: tuple[Log, dict[str, np.ndarray]]
) -> None:
    arm, (_, true) = Arm(), designed
    q, v = true["x"][:, :JOINTS], true["x"][:, JOINTS:]
    assert (q > arm.lower).all() and (q < arm.upper).all()
    assert (abs(v) < arm.speeds).all() and (abs(true["u"]) < np.array(arm.torques)).all()
    # It moves as far as that allows: some joint comes near its limit of rates.
    assert (
        max((abs(v) / arm.speeds).max(), (2.0 * q - arm.lower - arm.upper).max() / np.ptp([arm.lower, arm.upper])) > 0.7
    )
    # It ends where it began, at rest.
    np.testing.assert_allclose(motion.knots[[0, -1]], np.tile(arm.home, (2, 1)), atol=1e-9)


@pytest.mark.slow
@pytest.mark.one_python
def test_calibration_with_the_designed_motion_leaves_less_than_with_a_naive_one(
    motion: Excitation, designed: tuple[Log, dict[str, np.ndarray]]
) -> None:
    # The arm's own swing and back, as a plan.
    naive = np.tile(Arm().home, (11, 1))
    naive[3:-3] += np.array([0.6, 0.3, -0.4, 0.4, 0.5, -0.3, 0.6]) * np.array([[0.5], [1.0], [1.0], [1.0], [0.5]])
    deviations = []
    for log, _ in (designed, driven(naive)):
        result = calibrate(SCENARIO, log, PARAMETERS, position="joint_position", torque="joint_torque", noise=NOISE)
        deviations.append([result.parameters[parameter.address].deviation for parameter in PARAMETERS])
    ratios = np.array(deviations[1]) / np.array(deviations[0])
    # D-optimal: the product counts. A single number may be told as well by another motion.
    assert np.exp(np.log(ratios).mean()) > 1.5, ratios
    predicted = motion.information.together
    assert (np.array(deviations[0]) < 3.0 * predicted).all() and (np.array(deviations[0]) > predicted / 3.0).all()


@pytest.mark.slow_cases
@pytest.mark.one_python
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"criterion": "trace"}, "one of determinant, smallest, not 'trace'"),
        ({"spline": Spline("cubic", 12, 4.0)}, "order bspline with 9 knots at least"),
        ({"spline": Spline("bspline", 8, 4.0)}, "order bspline with 9 knots at least, not 8"),
        ({"margin": 1.0}, "a share from 0 to below 1, not 1.0"),
        ({"starts": 0}, "one start at least, not 0"),
        ({"upper": 0.1}, "begins where the scenario stands"),
        ({"torque": np.inf}, "no finite torque limit"),
        ({"torque": 1.0}, "no motion within the limits"),
    ],
)
def test_what_cannot_be_designed_is_refused(change: dict[str, object], message: str) -> None:
    arguments = {"spline": SCENARIO.spline, **change}
    with pytest.raises(CalibrationError, match=message):
        excitation(SCENARIO, PARAMETERS[:1], starts=int(str(arguments.pop("starts", 1))), **arguments)


@pytest.mark.one_python
def test_a_delay_and_a_lag_of_a_drive_are_told_alike() -> None:
    """A torque that comes later, by a small time, is the same torque whatever delays it."""
    parameters = [Parameter(f"{DRIVES}.delay", 0.0, 4.0), Parameter(f"{DRIVES}.time_constant", 0.0, 0.02)]
    noise = Noise(np.full(1, 1e-4), np.full(1, 0.05), 0.05)
    told = excitation(
        PendulumScenario(), parameters, spline=Spline("bspline", 9, 4.0), noise=noise, rate=3.0, lower=-1.0, upper=1.0,
        starts=1, iterations=2,
    ).information  # fmt: skip
    delay, lag = told.alone
    assert 0.0 < lag < 0.02 and PERIOD * delay == pytest.approx(lag)


@pytest.mark.one_python
def test_a_joint_without_limits_needs_them_as_arguments() -> None:
    parameters = [Parameter(f"{ARM}.link.mass", 0.1, 5.0), Parameter(f"{DRIVES}.viscous[0]", 0.0, 0.5)]
    spline = Spline("bspline", 12, 4.0)
    with pytest.raises(CalibrationError, match="no finite lower limit of every joint: give lower="):
        excitation(PendulumScenario(), parameters, spline=spline)
    motion = excitation(
        PendulumScenario(), parameters, spline=spline, lower=-2.0, upper=2.0, rate=5.0, criterion="smallest"
    )
    assert np.abs(spline.extremes(motion.knots)).max() <= 2.0 and np.abs(spline.extremes(motion.knots, 1)).max() <= 5.0
    assert motion.torques[0] <= 20.0 and "viscous" in str(motion)
