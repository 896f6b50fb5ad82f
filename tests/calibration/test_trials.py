"""Self-tests: machines in processes of their own, whose numbers the calibration does not know."""

from __future__ import annotations

import logging
import signal

import numpy as np
import pytest

from vtbdrake.calibration import CalibrationError, Inertia, JointModel, JointRecording, Noise, machine_log, self_test
from vtbdrake.machine import MachineConfig
from vtbdrake.optimization import Parameter
from vtbdrake_diagrams.manipulator.arm import JOINTS, Arm
from vtbdrake_diagrams.manipulator.studies.excited import PLAN, ExcitedArmScenario

SCENARIO = ExcitedArmScenario(knots=11, duration=1.0)
POSITION, TORQUE, DELAY = "joint_position", "joint_torque", "sim.act.drives.delay"
FRICTION, PAYLOAD = "sim.act.drives.coulomb[1]", "sim.sys.arm.tool.mass"
KNOTS = np.tile(Arm().home, (11, 1))
KNOTS[3:-3] += 0.15 * np.array([[1.0], [-1.0], [0.5], [1.0], [-1.0]])
PLANNED = {PLAN: np.append(0.001, KNOTS.ravel())}


class InterruptAt(logging.Handler):
    """Ctrl-C as soon as a message begins so."""

    def __init__(self, begin: str) -> None:
        super().__init__()
        self._begin = begin

    def emit(self, record: logging.LogRecord) -> None:
        if record.getMessage().startswith(self._begin):
            signal.raise_signal(signal.SIGINT)


@pytest.mark.one_python
def test_model_repeats_the_log_of_a_machine_but_for_predicted_friction() -> None:
    truth = {DELAY: 3.0, FRICTION: 0.7, PAYLOAD: 1.3}
    log = machine_log(SCENARIO, 0.25, machine=MachineConfig(values=truth), values=PLANNED)
    model = JointModel(SCENARIO.build(), [Parameter(address, 0.0, 5.0) for address in truth])
    recording = JointRecording.of(log, model, position=POSITION, torque=TORQUE)
    z = np.array(list(truth.values()))
    q, v = recording.q, log.sense["joint_velocity"].at(recording.times)
    motor, _ = model.motor(recording.times, recording.u, z)
    x = np.hstack([q, v])
    # What the drives held before the log is forgotten by then.
    for k in range(40, len(q) - 1):
        following = model.step(x[k], motor[k], 0.001, z).full().ravel()
        np.testing.assert_allclose(following, x[k + 1], rtol=0.0, atol=5e-4)


@pytest.mark.slow
@pytest.mark.one_python
def test_hidden_truths_are_recovered_and_covered_until_an_interrupt(caplog: pytest.LogCaptureFixture) -> None:
    parameters = [Parameter(PAYLOAD, 0.2, 2.0), Parameter(FRICTION, 0.1, 0.8), Parameter(DELAY, 0.0, 6.0)]
    noise = Noise(np.full(JOINTS, 1e-5), np.full(JOINTS, 0.05), 0.05)
    logger, interrupt = logging.getLogger("vtbdrake.calibration.trials"), InterruptAt("trial 3 of 100")
    caplog.set_level(logging.INFO, logger.name)
    logger.addHandler(interrupt)
    try:
        result = self_test(
            SCENARIO,
            parameters,
            position=POSITION,
            torque=TORQUE,
            seconds=2.0,
            trials=100,
            machine=MachineConfig(noise={POSITION: 1e-5}, disturbance={TORQUE: 0.05}),
            values=PLANNED,
            noise=noise,
        )
    finally:
        logger.removeHandler(interrupt)
    assert "interrupted: 3 of 100 trials are done" in caplog.text
    truths = [trial.truth for trial in result.trials]
    assert len({truth[PAYLOAD] for truth in truths}) == 3 and all(truth[DELAY].is_integer() for truth in truths)
    assert abs(result.errors(PAYLOAD)).max() < 0.02 and abs(result.errors(DELAY)).max() < 0.5
    # Of 9 intervals of 95 %, fewer than 7 contain the truth with a probability of 0.8 %.
    assert result.coverage >= 7 / 9 and "3 hidden truths" in str(result)


@pytest.mark.one_python
def test_a_log_of_no_duration_and_no_trial_are_refused() -> None:
    with pytest.raises(CalibrationError, match="positive time in s, not 0"):
        machine_log(SCENARIO, 0.0)
    with pytest.raises(CalibrationError, match="at least one trial, not 0"):
        self_test(SCENARIO, inertias=[Inertia("sim.sys.arm.tool")], position=POSITION, torque=TORQUE, trials=0)
