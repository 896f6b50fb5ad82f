"""Replay: the DPS repeats what it did to the last bit, and every difference is found."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import lcm
import numpy as np
import pytest
from pydrake.systems.framework import Context, System

from tests.control.scripted import PERIOD, ScriptedBridge, ServoScenario
from tests.control.scripted import Servo as ServoSystem
from tests.control.slow import SlowScenario, chaotic, picky
from tests.lcm.bus import handled, wait
from tests.recording.seeing import HEIGHT, WIDTH, SeeingScenario, brightness, picture
from tests.recording.servo import Servo
from tests.testbed.test_dps_state import PlannedScenario
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.lcm.hub import Hub
from vtbdrake.lcm.lcm_bridge import LcmBridge
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.recording.recorder import Recorder
from vtbdrake.recording.replay import replay
from vtbdrake.state import AddressError
from vtbdrake.testbed import DpsAlone


def recorded(tmp_path: Path, servo: Servo, act: Callable[[], None] = lambda: None, *, cycles: int = 30) -> ControlLog:
    """Return the log of ``cycles``, of ``act``, and of as many cycles, with a digest after each."""
    with Recorder(servo.runtime, tmp_path / "run.lcm", digest_period=PERIOD, overwrite=True):
        servo.runtime.run(cycles=cycles)
        act()
        servo.runtime.run(cycles=cycles)
    return read_log(tmp_path / "run.lcm")


@pytest.mark.slow_cases
@pytest.mark.parametrize("alone", [True, False], ids=["dps", "testbed"])
def test_replay_is_identical(tmp_path: Path, alone: bool) -> None:
    servo = Servo(alone=alone)
    log = recorded(tmp_path, servo, partial(servo.runtime.write, {"u.target": [0.3, 1.0 / 3.0], "dps.gain": 4.7}))
    report = replay(log)
    assert report.outcome == "identical" and report.identical, report
    assert (report.cycles, report.digests) == (60, 60)
    assert np.array_equal(report.actuation["velocity"], servo.commands[1:])
    assert len(np.unique(report.actuation["velocity"], axis=0)) >= 30


def test_testbed_replays_every_switch(tmp_path: Path) -> None:
    """The DPS is fed by the simulated world, by the machine, and again by the world, set to its belief."""
    servo = Servo(alone=False, begun=False)
    with Recorder(servo.runtime, tmp_path / "run.lcm", digest_period=PERIOD):
        for mode in ("sim", "shadow", "real", "twin", "sim", "real"):
            servo.runtime.switch(mode)
            servo.runtime.run(cycles=10)
    report = replay(tmp_path / "run.lcm", record=["sim.sys.axes.discrete_state_0"])
    assert report.identical, report
    assert np.isnan(report.actuation["velocity"]).any(axis=1).tolist() == [
        *[True] * 20, *[False] * 20, *[True] * 10, *[False] * 10,
    ]  # fmt: skip
    world = report.record["sim.sys.axes.discrete_state_0"]
    assert np.array_equal(world[-1], servo.runtime.target.read(servo.runtime.context, "sim.sys.axes.discrete_state_0"))


@pytest.mark.slow_cases
@pytest.mark.parametrize("before", [18, 19])
def test_recording_begun_later_is_replayed(tmp_path: Path, before: int) -> None:
    """Values at the real ports count: the position comes in every other cycle only."""
    servo = Servo()
    servo.runtime.run(cycles=before)
    report = replay(recorded(tmp_path, servo))
    assert report.identical and report.times[0] == servo.cycles[before + 1].time


class Prepared(ServoSystem):
    """A DPS that is initialized to count from 100 on; it has the ports of `ServoSystem`."""

    def __init__(self) -> None:
        super().__init__()
        self.DeclareInitializationDiscreteUpdateEvent(lambda context, discrete: discrete.set_value(1, [100.0]))


@dataclass
class PreparedScenario(ServoScenario):
    """A scenario with a DPS that must be initialized."""

    def make_dps(self) -> System:
        return Prepared()


@pytest.mark.slow_cases
@pytest.mark.parametrize("begun", [False, True], ids=["before", "after"])
def test_recorded_initialization_is_replayed(tmp_path: Path, begun: bool) -> None:
    servo = Servo(begun=begun, scenario=PreparedScenario(rate=0.0))
    if begun:
        servo.runtime.run(cycles=5)
    else:
        servo.runtime.cycle()
        servo.runtime.switch("real")
    report = replay(recorded(tmp_path, servo), record=["dps.ticks"])
    assert report.identical, report
    assert report.record["dps.ticks"][0] == (101.0 + 5 * begun)


def test_idle_dps_is_idle_in_replay(tmp_path: Path) -> None:
    servo = Servo(begun=False)
    report = replay(recorded(tmp_path, servo, lambda: servo.runtime.switch("real")))
    assert report.identical
    assert report.times[29] == 0.0 and report.times[30] == PERIOD


def test_exceptions_of_the_dps_are_replayed(tmp_path: Path) -> None:
    servo = Servo()

    def trouble() -> None:
        servo.runtime.write({"dps.trouble": 1.0})
        servo.runtime.run(cycles=3)
        servo.runtime.write({"dps.trouble": 0.0})

    report = replay(recorded(tmp_path, servo, trouble))
    assert report.identical, report
    assert list(report.errors) == [31, 32, 33]
    assert all(
        re.fullmatch(r"RuntimeError: out of ideas \(scripted\.py, line \d+\)", text) for text in report.errors.values()
    )
    assert report.times[33] - report.times[29] == pytest.approx(PERIOD)


def test_nan_actuation_is_compared(tmp_path: Path) -> None:
    servo = Servo()
    log = recorded(tmp_path, servo, lambda: servo.runtime.write({"dps.trouble": 2.0}))
    assert np.isnan(log.actuation["velocity"][30:, 0]).all() and log.commanded["velocity"].all()
    assert replay(log).identical


def test_dps_alone_replays_log_of_testbed(tmp_path: Path) -> None:
    servo = Servo(alone=False)
    servo.runtime.run(cycles=5)
    log = recorded(tmp_path, servo, lambda: servo.runtime.switch("shadow"))
    report = replay(log, DpsAlone(servo.scenario))
    assert report.identical and report.digests == 60, report
    assert not np.isnan(report.actuation["velocity"]).any(), "in the shadow it commands as well"


def test_testbed_replays_log_of_dps_alone(tmp_path: Path) -> None:
    servo = Servo(begun=False)
    servo.runtime.write({"u.target": [0.7, 0.1]})
    log = recorded(tmp_path, servo, lambda: servo.runtime.switch("real"))
    report = replay(log, servo.scenario.build(), record=["sim.sys.axes.discrete_state_0"])
    assert report.identical and report.digests == 60, report
    assert (report.record["sim.sys.axes.discrete_state_0"] == 0.0).all(), "the simulated world is idle"


def test_testbed_replays_log_of_dps_that_had_been_started(tmp_path: Path) -> None:
    servo = Servo()
    servo.runtime.run(cycles=19)
    log = recorded(tmp_path, servo)
    assert not log.changes
    report = replay(log, servo.scenario.build())
    assert report.identical and report.digests == 60, report


def test_dps_alone_rejects_simulated_sensors(tmp_path: Path) -> None:
    servo = Servo(alone=False)
    log = recorded(tmp_path, servo, lambda: servo.runtime.switch(sense={"speed": "sim"}))
    with pytest.raises(LogError, match="sense.speed came from the simulated world .* replay it through the testbed"):
        replay(log, DpsAlone(servo.scenario))


# -- other values and recorded addresses


def test_replay_records_variables_and_ports(tmp_path: Path) -> None:
    servo = Servo()
    report = replay(recorded(tmp_path, servo), record=["dps.ticks", "dps.velocity", "u.target"])
    assert report.record["dps.ticks"].tolist() == list(range(1, 61))
    assert np.array_equal(report.record["dps.velocity"], report.actuation["velocity"])
    assert report.record["u.target"].shape == (60, 2)


def test_other_values_override_the_log(tmp_path: Path) -> None:
    servo = Servo()
    log = recorded(tmp_path, servo, lambda: servo.runtime.write({"dps.gain": 9.0, "u.target": [0.1, 0.1]}))
    report = replay(log, values={"dps.gain": 2.5})
    assert report.outcome == "not compared" and not report.identical and report.first_difference is None
    position = log.fed["position"]
    target = np.where(np.arange(60)[:, None] < 30, 0.0, 0.1)
    assert np.array_equal(report.actuation["velocity"], 2.5 * (target - position))


def test_unknown_address_is_rejected(tmp_path: Path) -> None:
    log = recorded(tmp_path, Servo())
    with pytest.raises(AddressError, match="did you mean dps.velocity"):
        replay(log, record=["dps.velocit"])
    with pytest.raises(AddressError, match="did you mean dps.gain"):
        replay(log, values={"dps.gai": 1.0})


# -- differences


class Worse(ServoSystem):
    """A DPS that changes the last bit of its actuator command in one cycle; it has the ports of `ServoSystem`."""

    def _update(self, context: Context, discrete: object) -> None:
        super()._update(context, discrete)
        if round(context.get_time() / PERIOD) == 20:
            velocity = discrete.value(0)  # type: ignore[attr-defined]
            discrete.set_value(0, np.nextafter(velocity, np.inf))  # type: ignore[attr-defined]


class Altered(DpsAlone):
    """A target of the recorded scenario with another DPS."""

    def __init__(self, scenario: ServoScenario) -> None:
        class Other(ServoScenario):
            def make_dps(self) -> System:
                return Worse()

        super().__init__(Other(rate=scenario.rate))
        self.scenario = scenario


def test_one_bit_of_actuation_is_found(tmp_path: Path) -> None:
    servo = Servo()
    report = replay(recorded(tmp_path, servo), Altered(servo.scenario))
    assert report.outcome == "different" and report.first_difference is not None
    assert (report.first_difference.subject, report.first_difference.cycle) == ("velocity", 21)
    assert 0.0 < report.max_difference["velocity"] < 1e-15
    assert "velocity in cycle 21 (t = 0.021 s)" in str(report)


def test_hidden_state_is_found_by_digest(tmp_path: Path) -> None:
    servo = Servo()
    log = recorded(tmp_path, servo)
    # As if the DPS had had another state when it was recorded.
    object.__setattr__(log, "digests", [(i, bytes(16) if i >= 40 else digest) for i, digest in log.digests])
    report = replay(log)
    assert report.outcome == "different" and report.first_difference is not None
    assert (report.first_difference.subject, report.first_difference.cycle) == ("state", 41)


def test_another_scenario_is_rejected(tmp_path: Path) -> None:
    log = recorded(tmp_path, Servo())
    with pytest.raises(LogError, match="rate: 0.0 in the log, 2.0 here"):
        replay(log, DpsAlone(ServoScenario(rate=2.0)))
    with pytest.raises(LogError, match="scenario: '.*ServoScenario' in the log, '.*SlowScenario' here"):
        replay(log, DpsAlone(SlowScenario()))


def test_another_scenario_version_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = recorded(tmp_path, Servo())

    @dataclass
    class Newer(ServoScenario):
        rate: float = 2.0
        lag: float = 0.1

    Newer.__module__, Newer.__qualname__ = ServoScenario.__module__, ServoScenario.__qualname__
    monkeypatch.setattr("tests.control.scripted.ServoScenario", Newer)
    with pytest.raises(LogError, match="another version of it .lag: 'nothing' in the log, 0.1 here"):
        replay(log)


def test_missing_scenario_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = recorded(tmp_path, Servo())
    monkeypatch.delattr("tests.control.scripted.ServoScenario")
    with pytest.raises(LogError, match="cannot be loaded in this version: .* has no scenario 'ServoScenario'"):
        replay(log)


def test_other_library_version_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = recorded(tmp_path, Servo())
    monkeypatch.setitem(log.header.versions, "drake", "0.9")  # type: ignore[arg-type]
    report = replay(log)
    assert report.identical
    assert report.versions[0].startswith("recorded with drake 0.9, replayed with 1.")


# -- slow parts


def rushing(t: float) -> Mapping[str, list[float]]:
    return {"position": [np.sin(300.0 * t), np.cos(170.0 * t)]}


@pytest.mark.slow_cases
@pytest.mark.parametrize("function", [chaotic, picky], ids=["results", "missing results"])
def test_results_of_slow_parts_are_replayed(tmp_path: Path, function: Callable[..., object]) -> None:
    """They are not computed again: missing results are missing again."""
    more: dict[str, object] = {} if function is picky else {"memory": np.array([0.3, 0.6])}
    scenario = SlowScenario(function=function, period=0.004, latency=0.003, more=more)
    clock = SimulatedClock()
    bridge = ScriptedBridge(scenario.interface(), clock, rushing)
    runtime = Runtime(DpsAlone(scenario), bridge, period=PERIOD, clock=clock)
    runtime.cycle()
    runtime.switch("real")
    with Recorder(runtime, tmp_path / "run.lcm", digest_period=PERIOD):
        for _ in range(60):
            clock.advance(PERIOD)
            runtime.slow_parts.wait(60.0)
            runtime.cycle()
    runtime.close()
    log = read_log(tmp_path / "run.lcm")
    results = [change for _, change in log.changes if change.kind == "result"]
    missing = [change for change in results if len(change.values["dps.perception"]) == 1]
    assert len(results) >= 14 and (len(missing) > 3) == (function is picky)

    report = replay(log, DpsAlone(scenario))
    assert report.identical and report.digests == 60, report
    assert len(np.unique(report.actuation["velocity"], axis=0)) > 10


def test_slow_part_that_samples_the_dps_is_replayed(tmp_path: Path) -> None:
    scenario = PlannedScenario(period=0.004, latency=0.003)
    clock = SimulatedClock()
    bridge = ScriptedBridge(scenario.interface(), clock, lambda t: {"position": [np.sin(300.0 * t)]})
    runtime = Runtime(DpsAlone(scenario), bridge, period=PERIOD, clock=clock)
    runtime.cycle()
    runtime.switch("real")
    with Recorder(runtime, tmp_path / "run.lcm", digest_period=PERIOD):
        for _ in range(40):
            runtime.slow_parts.wait(60.0)
            runtime.cycle()
            clock.advance(PERIOD)
    runtime.close()
    log = read_log(tmp_path / "run.lcm")
    results = [change.values["dps.planner"] for _, change in log.changes if change.kind == "result"]
    # The planner has seen its own last decision: the digest of the state differs from sample to sample.
    assert len({result["seen"][1] for result in results if "seen" in result}) >= 8
    for target in (None, DpsAlone(scenario)):
        report = replay(log, target)
        assert report.identical and report.digests == 40, report


SCENARIO = SeeingScenario()


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    with Hub(port=0) as running:
        yield running


class Seeing:
    """A loop with a camera on its bus."""

    def __init__(self, hub: Hub) -> None:
        self.bridge: LcmBridge = protocol_of(SCENARIO).bridge(SCENARIO.interface(), hub.url)
        self.runtime = Runtime(DpsAlone(SCENARIO), self.bridge, period=PERIOD, clock=SimulatedClock())
        self._camera = lcm.LCM(hub.url)
        self._random = np.random.default_rng(0)
        self._utime = 0

    def show(self, *, late: bool = False) -> np.ndarray:
        """Send a new image and return it when it has arrived; a late one is rejected."""
        pixels, image = self._random.integers(0, 256, (HEIGHT, WIDTH)), self.bridge.sensed["image"]
        before = handled(image)
        self._utime += 1000
        self._camera.publish("CAMERA", picture(self._utime - 5000 * late, pixels))
        assert wait(self.bridge, lambda: handled(image) > before)  # The hub's status messages are polled, too.
        return pixels


def test_images_are_replayed_from_raw_messages(hub: Hub, tmp_path: Path) -> None:
    """The last accepted one of several images in a cycle counts."""
    loop = Seeing(hub)
    shown = []
    with Recorder(loop.runtime, tmp_path / "run.lcm", digest_period=PERIOD):
        loop.bridge.open()
        for i in range(30):
            if i % 3 == 0:
                loop.show()
                shown.append(loop.show())
                if i:
                    loop.show(late=True)
            if i == 0:
                loop.runtime.switch("real")
            loop.runtime.cycle()
        loop.bridge.close()
    log = read_log(tmp_path / "run.lcm")
    assert sum(1 for _ in log.messages("CAMERA")) == 29
    assert (log.sources["image"] != 0).tolist() == [i % 3 == 0 for i in range(30)]
    report = replay(log)
    assert report.identical and report.digests == 30, report
    assert report.actuation["velocity"][:, 0].tolist() == [brightness(shown[i // 3]) for i in range(30)]


def test_unrecorded_present_image_is_rejected(hub: Hub, tmp_path: Path) -> None:
    loop = Seeing(hub)
    loop.bridge.open()
    loop.show()
    with pytest.raises(ValueError, match="signal image is abstract, .* start to record before the bridge is opened"):
        Recorder(loop.runtime, tmp_path / "run.lcm")
    loop.bridge.close()
    assert not (tmp_path / "run.lcm").exists()


def test_bridge_without_raw_messages_is_rejected(tmp_path: Path) -> None:
    clock = SimulatedClock()
    bridge = ScriptedBridge(SCENARIO.interface(), clock, lambda t: {})
    runtime = Runtime(DpsAlone(SCENARIO), bridge, clock=clock)
    with pytest.raises(ValueError, match="by its raw messages, which ScriptedBridge does not have"):
        Recorder(runtime, tmp_path / "run.lcm")
