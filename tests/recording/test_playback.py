"""Logs feed a DPS and drive a world again: what comes out is what was recorded, to the last bit."""

from __future__ import annotations

import pickle
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from pydrake.multibody.plant import MultibodyPlantConfig

from tests.control.scripted import PERIOD
from tests.recording.servo import Servo
from vtbdrake.control.bridge import BridgeError
from vtbdrake.control.clock import Clock, ScaledClock, SimulatedClock
from vtbdrake.control.guards import Guards
from vtbdrake.control.runtime import Runtime
from vtbdrake.optimization import Parameter, Problem
from vtbdrake.recording.export import export
from vtbdrake.recording.log import Log, Series
from vtbdrake.recording.log_format import LogError
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.playback import DrivenScenario, LogBridge
from vtbdrake.recording.recorder import Recorder
from vtbdrake.recording.table_reader import read_table
from vtbdrake.rollout import Quality
from vtbdrake.testbed import DpsAlone, Scenario, ScenarioError
from vtbdrake_diagrams.cart_pole import CartPoleScenario

# Where the cart-pole begins, by joint; and its plan of forces.
STANDING = {"cart_slider": 0.3, "pole_pin": 3.0}
PLAN = 50.0 * np.sin(np.arange(10.0))


@pytest.fixture(scope="module")
def servo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Servo, Path]:
    """A loop in lock-step that was recorded, and its log."""
    servo = Servo()
    path = tmp_path_factory.mktemp("log") / "run.lcm"
    with Recorder(servo.runtime, path):
        servo.runtime.run(cycles=200)
    return servo, path


def fed_again(log: Log, servo: Servo, clock: Clock) -> tuple[LogBridge, np.ndarray]:
    """Return the bridge and the commands of another DPS, which the log feeds."""
    dps = DpsAlone(servo.scenario)
    bridge = LogBridge(log, dps.interface, clock)
    bridge.open()
    commands: list[np.ndarray] = []
    with Runtime(dps, bridge, period=PERIOD, clock=clock, guards=Guards(dps.interface, PERIOD)) as runtime:
        runtime.cycle()  # A switch needs samples. The clock stands still meanwhile.
        runtime.switch("real")
        runtime.watch(lambda cycle: commands.append(cycle.actuation["velocity"]))
        runtime.run(until=lambda: bridge.finished)
    return bridge, np.array(commands)


@pytest.mark.parametrize("stranger", [False, True])
def test_log_feeds_the_dps_to_the_same_commands(servo: tuple[Servo, Path], stranger: bool, tmp_path: Path) -> None:
    recorded = read_log(servo[1])
    log = recorded.signals
    if stranger:
        export(recorded, tmp_path / "run.csv")
        columns = {name: [f"sense.{name}[{i}]" for i in (0, 1)] for name in ("position", "speed")}
        log = read_table(tmp_path / "run.csv", sense=columns)
    # From a cycle on in which both signals came.
    begin = log.sense["position"].times[10]
    cycle = round((begin - log.sense["speed"].times[0]) / PERIOD)
    bridge, commands = fed_again(log.between(begin, np.inf), servo[0], SimulatedClock())
    assert np.array_equal(commands, recorded.actuation["velocity"][cycle:])
    assert bridge.sensed["speed"].count == 200 - cycle


def test_recording_runs_at_any_multiple_of_real_time(servo: tuple[Servo, Path]) -> None:
    log = read_log(servo[1]).signals
    begin = time.monotonic()
    bridge, commands = fed_again(log, servo[0], ScaledClock(0.5))
    # Half as fast: a lower limit, however busy the computer is.
    assert time.monotonic() - begin >= 2.0 * 198 * PERIOD
    assert bridge.finished and bridge.sensed["speed"].count == 200
    assert ScaledClock(1e-3).now() == pytest.approx(1e-3 * time.monotonic(), abs=1e-3)
    for bad in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="the speed of a clock is positive and finite"):
            ScaledClock(bad)


def test_samples_come_at_their_own_times() -> None:
    interface, clock = Servo().scenario.interface(), SimulatedClock(start=7.0)
    position = Series(np.array([100.0, 100.4, 100.41]), np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]))
    bridge = LogBridge(Log("a", {"position": position}, {}), interface, clock)
    with pytest.raises(BridgeError, match="polled before it is open"):
        bridge.poll()
    bridge.open()
    received = bridge.sensed["position"]
    assert bridge.poll() == 1 and (received.value[0], received.arrived, received.sent) == (1.0, 7.0, 100.0)
    assert bridge.poll() == 0
    assert bridge.poll(0.1) == 0 and clock.now() == pytest.approx(7.1)  # It waits no longer than it may,
    assert bridge.poll(10.0) == 1 and clock.now() == pytest.approx(7.4)  # nor than it must.
    clock.advance(0.5)
    assert bridge.poll() == 1 and received.arrived == pytest.approx(7.41) and bridge.finished
    assert bridge.poll(1.0) == 0 and received.count == 3 and bridge.sensed["speed"].count == 0
    assert bridge.publish({"velocity": np.zeros(2)}) == ()


def simulated(scenario: Scenario, **values: ArrayLike) -> dict[str, np.ndarray]:
    """Return times, states and commands at the multiples of 20 ms of a simulation that begins with some values."""
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {f"sim.sys.cart_pole.{name}.position": value for name, value in STANDING.items()})
    testbed.write(context, {f"u.{name}": value for name, value in values.items()})
    simulator, samples = testbed.simulator(context), []
    for k in range(100):
        simulator.AdvanceTo(0.02 * k)
        simulator.AdvancePendingEvents()
        joints = (testbed.read(context, f"sim.sys.cart_pole.{name}.position") for name in STANDING)
        samples.append([context.get_time(), *joints, *testbed.read(context, "dps.force")])
    return dict(zip(("time", *STANDING, "force"), np.array(samples).T, strict=True))


@pytest.mark.slow_cases
@pytest.mark.parametrize("scheme", ["discrete", "continuous"])
@pytest.mark.parametrize("begin", [0.0, 123.4])
def test_log_drives_the_world_along_the_same_motion(scheme: str, begin: float) -> None:
    step = 0.0 if scheme == "continuous" else 0.005
    config = MultibodyPlantConfig(time_step=step, use_sampled_output_ports=False)
    scenario = CartPoleScenario(plant_config=config)
    motion = simulated(scenario, plan=[0.0, *PLAN])
    assert np.ptp(motion["force"]) > 50.0
    log = read_table({**motion, "time": begin + motion["time"]}, sense={}, act={"force": "force"})
    driven = simulated(DrivenScenario(scenario=scenario, log=log))
    for name in ("force", *STANDING):
        assert np.array_equal(driven[name], motion[name]), name


def test_driven_scenario_is_sent_to_other_processes_and_refuses_what_does_not_fit() -> None:
    scenario, log = CartPoleScenario(), Log("a.csv", {}, {"torque": Series(np.arange(2.0), np.zeros((2, 1)))})
    with pytest.raises(LogError, match="a.csv has no commands of force, but of torque"):
        DrivenScenario(scenario=scenario, log=log).build()
    with pytest.raises(ScenarioError, match="DrivenScenario.log is a Log, see read_table"):
        DrivenScenario(scenario=scenario).build()
    with pytest.raises(ScenarioError, match="DrivenScenario.scenario is a scenario, not None"):
        DrivenScenario(log=log).build()
    log = Log("a.csv", {}, {"force": Series(np.arange(2.0), np.ones((2, 1)))})
    copied = pickle.loads(pickle.dumps(DrivenScenario(scenario=scenario, log=log, period=0.5)))
    assert [signal.name for signal in copied.build().interface.commands] == ["plan"]
    assert len(copied.log.act["force"]) == 2
    logs = [Log("a.csv", {}, {"force": Series(np.arange(2.0), value * np.ones((2, 1)))}) for value in (1.0, 2.0)]
    same, other = (DrivenScenario(scenario=scenario, log=log, period=0.5) for log in logs)
    assert copied == same != other
    assert copied.record() == same.record() != other.record()


@pytest.mark.slow_cases
@pytest.mark.parametrize("executor", ["serial", "threads", "processes", "compiled"])
def test_sweep_of_a_driven_world(executor: str) -> None:
    times = 0.02 * np.arange(10)
    log = Log("a.csv", {}, {"force": Series(times, 20.0 * np.sin(times[:, np.newaxis]))})
    problem = Problem(
        scenario=DrivenScenario(scenario=CartPoleScenario(), log=log),
        parameters=[Parameter("sim.sys.cart_pole.pole.mass", 0.5, 1.0)],
        quality=Quality(lambda state: state[0] ** 2, of="plant.state", reading="end"),
        horizon=0.2,
    )
    values = [rollout.value for rollout in problem.sweep(2, executor=executor, progress=False).rollouts]
    heavy = DrivenScenario(scenario=CartPoleScenario(), log=log).build()
    context = heavy.default_context()
    heavy.write(context, {"sim.sys.cart_pole.pole.mass": 1.0})
    heavy.simulator(context).AdvanceTo(0.2)
    assert values[1] == pytest.approx(heavy.read(context, "plant.state")[0] ** 2, rel=1e-11)
    assert values[0] > values[1] > 0.0


@pytest.mark.parametrize(
    ("log", "message"),
    [
        (Log("a.csv", {"elbow": Series(np.zeros(1), np.zeros((1, 2)))}, {}), "feeds no sensor signal.*but elbow"),
        (
            Log("a.csv", {"speed": Series(np.zeros(1), np.zeros((1, 3)))}, {}),
            "3 entries of speed, but the signal has 2",
        ),
    ],
)
def test_log_that_does_not_fit_is_refused(log: Log, message: str) -> None:
    with pytest.raises(LogError, match=message):
        LogBridge(log, Servo().scenario.interface(), SimulatedClock())
