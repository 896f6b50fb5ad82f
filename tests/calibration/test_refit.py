"""A load that nobody announced: an alarm, a calibration beside the loop, an offer, and the same again in a replay."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from pydrake.systems.framework import System

import vtbdrake as vtb
from tests.monitoring.residuals.line import Together
from tests.monitoring.residuals.pendulum import MASS, PAYLOAD, PERIOD, DrivenPendulum, Rhythm, machine
from vtbdrake.calibration import Calibration, ModelRefit
from vtbdrake.monitoring import ResidualConfig, ResidualMonitor
from vtbdrake.recording import Recorder
from vtbdrake.recording.replay import replay
from vtbdrake.state import Quantity
from vtbdrake.testbed import VirtualTestbedBuilder
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.studies.pick_up import STIFFNESS, Load, arm_loop, pick_up, reasoner, watched

pytestmark = pytest.mark.one_python

TOLERANCE = {"sense.position": 1e-3, "sense.velocity": 1e-2, "act.torque": 1e-3}
CONFIG = ResidualConfig(period=PERIOD, tolerance=TOLERANCE)
KNOWN = "dps.mass"
HEAVY = 1.3 * MASS
PATIENCE = 120.0  # s


@dataclass
class KnowingPendulum(DrivenPendulum):
    """A pendulum whose DPS knows the mass; its command does not use it."""

    def make_dps(self) -> System:
        rhythm = Rhythm(PERIOD)
        rhythm.declare_parameters(mass=Quantity(MASS, "kg"))
        return rhythm

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        builder.believe(PAYLOAD, of=[KNOWN])


class Rig:
    """A pendulum of a mass, with what watches its loop."""

    def __init__(self, mass: float, **options: Any) -> None:
        scenario = KnowingPendulum(time_step=0.0)
        self.together = Together(scenario, machine(scenario, values={PAYLOAD: mass}, noise={"position": 1e-4}))
        self.loop = self.together.driver
        self.monitor = ResidualMonitor(self.loop, "twin", config=CONFIG, worker=False, keep=30.0)
        self.refit = ModelRefit(
            self.loop,
            self.monitor,
            scenario,
            [vtb.Parameter(PAYLOAD, 0.1, 2.0)],
            known_as={PAYLOAD: KNOWN},
            position="position",
            **{"torque": "torque", "seconds": 20.0, "settle": 0.5, "segment": 5.0, **options},
        )

    def known(self) -> float:
        return float(self.loop.read(KNOWN))

    def run_until_calibrated(self) -> None:
        end = time.monotonic() + PATIENCE
        while not (self.refit.refits or self.refit.error):
            assert time.monotonic() < end, "no calibration"
            assert self.refit.wait(PATIENCE)
            self.together.run(10)


@contextmanager
def rig(mass: float = HEAVY, **options: Any) -> Iterator[Rig]:
    pendulum = Rig(mass, **options)
    with pendulum.refit, pendulum.monitor:
        yield pendulum


@pytest.mark.slow
def test_accepted_model_ends_the_alarm_and_replays(tmp_path: Path) -> None:
    with rig() as pendulum:
        with Recorder(pendulum.loop, tmp_path / "log") as recorder:
            recorder.wait_until_ready()
            pendulum.run_until_calibrated()
            pendulum.together.run(800)
            known = pendulum.known()
        (refit,) = pendulum.refit.refits
        number = refit.calibration.parameters[PAYLOAD]
        assert refit.accepted and known == number.value
        assert abs(known - HEAVY) < max(3.0 * number.deviation, 1e-3) and number.deviation < 0.02 * HEAVY
        assert refit.alarm.began + 20.5 <= refit.offered
        assert not pendulum.monitor.active() and pendulum.monitor.alarms
        # The commands do not use the mass, so that none has changed; the log has the write, and repeats it.
        report = replay(tmp_path / "log", record=[KNOWN])
        assert report.cycles == pendulum.loop.cycles and set(report.record[KNOWN]) == {MASS, known}
        assert replay(tmp_path / "log").identical


def test_user_decides_what_is_taken() -> None:
    offers: list[Calibration] = []
    with rig(seconds=8.0, segment=2.0, accept=lambda calibration: bool(offers.append(calibration))) as pendulum:
        pendulum.run_until_calibrated()
        pendulum.together.run(100)
        (refit,) = pendulum.refit.refits
        assert not refit.accepted and pendulum.known() == MASS and offers == [refit.calibration]
        assert pendulum.monitor.active()
        # The same alarm is not calibrated for ever.
        assert not pendulum.refit.pending and len(offers) == 1


def test_nothing_is_calibrated_without_an_alarm() -> None:
    with rig(MASS) as pendulum:
        pendulum.together.run(400)
        assert not (pendulum.monitor.alarms or pendulum.refit.refits or pendulum.refit.pending)


@pytest.mark.slow
def test_calibration_that_fails_is_told_and_changes_nothing(caplog: pytest.LogCaptureFixture) -> None:
    with rig(torque="no_signal") as pendulum:
        pendulum.run_until_calibrated()
        assert "no signal no_signal" in pendulum.refit.error and "could not be calibrated" in caplog.text
        assert not pendulum.refit.refits and pendulum.known() == MASS


def test_worker_that_dies_is_told() -> None:
    with rig() as pendulum:
        while not pendulum.refit.calibrating:
            pendulum.together.run(10)
        os.kill(pendulum.refit.pid, signal.SIGKILL)
        pendulum.run_until_calibrated()
        assert pendulum.refit.error == "its worker process has ended" and not pendulum.refit.pending


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"known_as": {"sim.x": KNOWN}}, "known_as names sim.x, but the parameters are"),
        ({"known_as": {PAYLOAD: PAYLOAD}}, "is written to a variable of the DPS"),
        ({"known_as": {PAYLOAD: "dps.weight"}}, "dps.weight"),
        ({"seconds": 40.0}, "keeps the samples of 30 s, but 40.5 s are needed"),
    ],
)
def test_what_cannot_be_refitted_is_refused(options: dict[str, Any], message: str) -> None:
    scenario = KnowingPendulum(time_step=0.0)
    loop = Together(scenario, machine(scenario)).driver
    monitor = ResidualMonitor(loop, "twin", config=CONFIG, worker=False, keep=30.0)
    arguments = {"known_as": {PAYLOAD: KNOWN}, "position": "position", "torque": "torque", "settle": 0.5, **options}
    with pytest.raises(ValueError, match=message):
        ModelRefit(loop, monitor, scenario, [vtb.Parameter(PAYLOAD, 0.1, 2.0)], **arguments)


@pytest.mark.slow  # A calibration of seven joints, and mental rollouts of the arm.
def test_arm_picks_up_a_load_and_decides_with_the_new_model(tmp_path: Path) -> None:
    scenario = ManipulatorScenario(law="joint_impedance", knows_tool=True)
    values = {"u.motion": 2.0, "dps.impl.home_duration": 0.5, "dps.impl.swing_duration": 3.0}
    load = Load(0.4)
    with (
        arm_loop(scenario, values, record=tmp_path / "log") as (loop, arm),
        watched(loop, scenario) as (monitor, refit),
    ):
        with reasoner(scenario) as before:
            softest = before.decide(loop.target, loop.context)
        outcome = pick_up(loop, arm, load, monitor, refit)
        with reasoner(scenario, outcome.refit) as after:
            stiffer = after.decide(loop.target, loop.context)
    # The published errors of payloads are about 1 %; the interval must be honest, too.
    deviation = outcome.refit.calibration.parameters["sim.sys.arm.tool.mass"].deviation
    assert abs(outcome.mass_error) < max(3.0 * deviation, 0.004) < 0.02 and outcome.center_error < 0.01
    assert outcome.to_alarm < 0.1 and outcome.refit.accepted
    assert outcome.alarms[0] > 0 == outcome.alarms[1]
    assert replay(tmp_path / "log").identical
    # With the load, joint 2 sags too far unless it is stiffer.
    assert softest.values == {STIFFNESS: 800.0} and stiffer.values == {STIFFNESS: 1600.0}
    assert stiffer.candidates[0].status == "violates" and len(stiffer.starts) == 3
