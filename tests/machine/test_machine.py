"""A machine, cycle by cycle, without a bus."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from drake import lcmt_iiwa_status, lcmt_point_cloud
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem, State

from tests.machine.robot import COMMAND, ELBOW, PERIOD, STATUS, RobotScenario, state, torque
from tests.testbeds import AcrobotScenario
from vtbdrake.common.scan import Scan
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.iiwa_messages import iiwa_command, iiwa_status
from vtbdrake.lcm.protocol import Protocol, ProtocolError, protocol_of
from vtbdrake.lcm.sensor_messages import scan_map
from vtbdrake.machine import (
    PERTURBED,
    Delay,
    Drop,
    InjectedFaultError,
    Machine,
    MachineConfig,
    NoBrake,
    OwnStop,
    perturbed_values,
)
from vtbdrake.testbed import Interface, Signal, VirtualTestbedBuilder, WorldAlone

SHOULDER_RATE, ELBOW_RATE = "sim.sys.Acrobot.shoulder.velocity", "sim.sys.Acrobot.elbow.velocity"
PUSHED = {ELBOW: 0.3, ELBOW_RATE: 1.0}


def machine(**options: Any) -> Machine:
    return Machine(RobotScenario(), MachineConfig(**{"values": PUSHED, **options}))


def run(robot: Machine, cycles: int, *, command: float | None = None) -> list[bytes]:
    """Return the messages of the machine after each of some cycles."""
    told = []
    for _ in range(cycles):
        if command is not None:
            robot.receive(COMMAND, torque(command, robot.cycle + 1))
        robot.advance()
        told += [data for _, data in robot.messages()]
    return told


def recorded(cycles: int) -> tuple[list[float], list[np.ndarray]]:
    """Commands and states of the testbed, whose DPS commands its simulated world."""
    testbed = RobotScenario().build()
    context = testbed.default_context()
    testbed.write(context, PUSHED)
    simulator = testbed.simulator(context)
    simulator.Initialize()
    commands, states = [], []
    for k in range(cycles):
        commands.append(float(testbed.read(context, "dps.torque")[0]))
        states.append(testbed.read(context, "plant.state"))
        simulator.AdvanceTo((k + 1) * PERIOD)
    assert np.ptp(commands) > 0.5
    return commands, states


# -- cycles


def test_machine_and_simulation_agree_bit_for_bit() -> None:
    commands, states = recorded(300)
    robot = machine()
    for k, command in enumerate(commands):
        [(channel, data)] = robot.messages()
        assert channel == STATUS
        np.testing.assert_array_equal(state(data), states[k])
        assert lcmt_iiwa_status.decode(data).utime == k * 1000
        robot.receive(COMMAND, torque(command, k + 1))
        robot.advance()


def test_newest_command_acts() -> None:
    twice, once = machine(), machine()
    for value, utime in ((5.0, 1), (-1.0, 2)):
        twice.receive(COMMAND, torque(value, utime))
    once.receive(COMMAND, torque(-1.0, 2))
    assert run(twice, 3) == run(once, 3)


@dataclass
class SlowScenario(RobotScenario):
    def deployment(self) -> Deployment:
        protocol = Protocol(
            sense=[
                iiwa_status({"position": "joint_position_measured"}, channel="FAST"),
                iiwa_status({"velocity": "joint_velocity_estimated"}, channel="SLOW"),
            ],
            act=[iiwa_command({"torque": "joint_torque"})],
            periods={"SLOW": 0.005},
        )
        return Deployment(protocol=protocol)


def test_channel_with_a_period_of_its_own() -> None:
    robot = Machine(SlowScenario())
    told = {}
    for _ in range(11):
        told[robot.cycle] = [channel for channel, _ in robot.messages()]
        robot.advance()
    assert [cycle for cycle, channels in told.items() if "SLOW" in channels] == [0, 1, 6]
    assert all("FAST" in channels for channels in told.values())


def test_slow_message_follows_when_its_cycle_is_skipped() -> None:
    robot = Machine(SlowScenario())
    robot.messages()
    for _ in range(8):
        robot.advance()
    assert [channel for channel, _ in robot.messages()] == ["FAST", "SLOW"]
    robot.advance()
    assert [channel for channel, _ in robot.messages()] == ["FAST"]


class Laser(LeafSystem):
    """Every 10 ms, a scan that was complete 4 ms before.

    .. pydrake_system::

        name: Laser
        output_ports:
        - scan
    """

    def __init__(self) -> None:
        super().__init__()
        self._scan = self.DeclareAbstractState(Value(Scan.empty()))
        self.DeclareStateOutputPort("scan", self._scan)
        self.DeclarePeriodicUnrestrictedUpdateEvent(0.01, 0.0, self._update)

    def _update(self, context: Context, state: State) -> None:
        scan = Scan(np.eye(3), np.ones(3), np.array([-0.002, -0.001, 0.0]), context.get_time() - 0.004)
        state.get_mutable_abstract_state(self._scan).set_value(scan)


@dataclass
class LaserScenario(RobotScenario):
    def interface(self) -> Interface:
        known = super().interface()
        return replace(known, sense=[*known.sense, Signal("scan", model_value=Scan.empty())])

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        super().add_world(builder)
        builder.sim_sensor("scan", builder.add("sense", "laser", Laser()).get_output_port())

    def deployment(self) -> Deployment:
        sense = [*PROTOCOL.sense, scan_map("SCAN", "scan")]
        return Deployment(protocol=replace(PROTOCOL, sense=sense, periods={"SCAN": 0.01}))


def test_message_of_a_scan_has_the_time_of_the_scan() -> None:
    robot = Machine(LaserScenario(), epoch=5_000_000)
    sent = []
    for cycle in range(32):
        scans = [data for name, data in robot.messages() if name == "SCAN"]
        sent += [(cycle, lcmt_point_cloud.decode(data).utime) for data in scans]
        robot.advance()
    assert sent == [(0, 5_000_000), (1, 4_996_000), (11, 5_006_000), (21, 5_016_000), (31, 5_026_000)]


def test_epoch_is_the_time_of_cycle_0() -> None:
    robot = Machine(RobotScenario(), epoch=1_700_000_000_000_000)
    [data] = run(robot, 1)
    assert lcmt_iiwa_status.decode(data).utime == 1_700_000_000_001_000


# -- differences from the simulated world


def test_noise_has_its_deviation_and_seed() -> None:
    def errors(**options: Any) -> np.ndarray:
        noisy, quiet = machine(**options), machine()
        return np.array([state(a) - state(b) for a, b in zip(run(noisy, 1000), run(quiet, 1000), strict=True)])

    found = errors(noise={"position": 0.02}, seed=1)
    assert not found[:, 2:].any()
    np.testing.assert_allclose(found[:, :2].std(axis=0), 0.02, rtol=0.1)  # five standard errors are 0.11
    np.testing.assert_allclose(found[:, :2].mean(axis=0), 0.0, atol=0.003)
    assert abs(np.corrcoef(found[:, 0], found[:, 1])[0, 1]) < 0.15
    np.testing.assert_array_equal(errors(noise={"position": 0.02}, seed=1), found)
    assert (errors(noise={"position": 0.02}, seed=2)[:, :2] != found[:, :2]).all()


def test_faults_do_not_change_the_noise() -> None:
    noise = {"position": 0.02}
    faulty, healthy = machine(noise=noise), machine(noise=noise)
    faulty.begin(Drop(fraction=0.5))
    told = run(faulty, 100)
    assert 20 < len(told) < 80
    assert set(told) < set(run(healthy, 100))


def test_perturbation_is_relative_and_uniform() -> None:
    world = WorldAlone(RobotScenario())
    context = world.default_context()
    ratios = []
    for seed in range(200):
        changed = perturbed_values(world, context, 0.05, np.random.default_rng(seed))
        assert {address.rpartition(".")[2] for address in changed} <= set(PERTURBED)
        assert changed.keys() >= {"sim.sys.Acrobot.upper_link.mass", "sim.sys.Acrobot.elbow.damping"}
        nominal = world.variables().read(context, list(changed))
        ratios += [changed[a] / nominal[a] for a in changed if nominal[a] > 0.0]
    assert 0.95 <= min(ratios) < 0.951
    assert 1.049 < max(ratios) <= 1.05
    np.testing.assert_allclose(np.std(ratios), 0.05 / np.sqrt(3.0), rtol=0.1)


def test_other_values_are_not_perturbed() -> None:
    robot, nominal = machine(perturb=0.05, seed=3), machine()
    for address, variable in robot.world.variables().items():
        if address in robot.perturbed:
            np.testing.assert_allclose(robot.read(address), robot.perturbed[address], rtol=1e-12)
        elif not variable.derived and not address.endswith((".inertia", "_by_geometry")):  # with mass and friction
            np.testing.assert_array_equal(robot.read(address), nominal.read(address), address)
    assert robot.perturbed == machine(perturb=0.05, seed=3).perturbed
    assert robot.perturbed != machine(perturb=0.05, seed=4).perturbed
    assert run(robot, 5) != run(nominal, 5)


def test_set_values_are_not_perturbed() -> None:
    mass = "sim.sys.Acrobot.lower_link.mass"
    assert machine(values={mass: 1.5}, perturb=0.5).read(mass) == 1.5


def test_values_set_while_running_act_from_the_next_cycle() -> None:
    mass = "sim.sys.Acrobot.lower_link.mass"
    robot, heavy = machine(), machine(values={**PUSHED, mass: 1.5})
    assert robot.messages() == heavy.messages()
    robot.write({mass: 1.5})
    assert run(robot, 5, command=0.5) == run(heavy, 5, command=0.5) != run(machine(), 5, command=0.5)
    assert robot.perturbed == heavy.perturbed
    with pytest.raises(ValueError, match="must lie in"):
        robot.write({mass: -1.0})
    assert robot.read(mass) == 1.5


def test_delayed_state_is_that_of_earlier_cycles() -> None:
    late, prompt = run(machine(sense_latency=0.003), 20), run(machine(), 20)
    assert late == prompt[:-3]


def test_delayed_command_acts_later() -> None:
    late, prompt = machine(act_latency=0.003), machine()
    late.receive(COMMAND, torque(5.0, 1))
    run(prompt, 3)
    prompt.receive(COMMAND, torque(5.0, 1))
    run(late, 3)
    assert run(late, 10) == run(prompt, 10)


# -- safety


def test_machine_brakes_without_commands() -> None:
    robot = machine(timeout=0.01, brake="idle")
    run(robot, 1)
    assert robot.braking
    run(robot, 1, command=1.0)
    assert not robot.braking
    run(robot, 10)  # the last command is 10 cycles old, and no older than the timeout
    assert not robot.braking
    assert robot.status().silent == []
    run(robot, 1)
    assert robot.braking
    assert robot.status().silent == [COMMAND]
    run(robot, 1, command=1.0)
    assert not robot.braking


@pytest.mark.parametrize("timeout", [0.005, 10.0])
def test_late_command_is_rejected(timeout: float) -> None:
    robot, spared = (machine(timeout=timeout, max_latency=0.001) for _ in range(2))
    robot.reject_late(True)
    begin, clock = time.monotonic(), 5_000_000  # us, of the sender: its zero is another one
    for each in (robot, spared):
        each.receive(COMMAND, torque(1.0, clock))
    while robot.cycle < 20 or time.monotonic() < begin + 0.002:
        assert run(robot, 1) == run(spared, 1)
    robot.receive(COMMAND, torque(5.0, clock + 1))
    assert run(robot, 10) == run(spared, 10)
    assert robot.braking is (timeout < 0.02)
    assert robot.status().rejected == {"torque": {"late": 1}}
    robot.receive(COMMAND, torque(5.0, clock + 1_000_000))
    assert run(robot, 10) != run(spared, 10)
    assert robot.status().rejected == {"torque": {"late": 1}}


@pytest.mark.parametrize("in_lock_step", [True, False])
def test_command_after_a_gap_in_lock_step_is_not_ahead_of_time(in_lock_step: bool) -> None:
    """A loop and its machine that are faster than real time lose ten seconds of commands in no time."""
    robot = machine(max_latency=np.inf)
    if not in_lock_step:
        robot.reject_late(True)
    for sent in (1_000_000, 11_000_000):  # us
        robot.receive(COMMAND, torque(1.0, sent))
        run(robot, 1)
    assert robot.status().rejected["torque"] == ({} if in_lock_step else {"ahead of time": 1})


def test_brake_locks_joints_with_actuators() -> None:
    robot = machine(timeout=0.01)
    run(robot, 5, command=0.0)
    moved = robot.read(ELBOW)
    assert robot.read(ELBOW_RATE) != 0.0
    run(robot, 11)
    stopped = robot.read(ELBOW)
    assert stopped != moved
    run(robot, 20)
    assert robot.read(ELBOW) == stopped
    assert robot.read(ELBOW_RATE) == 0.0
    assert robot.read(SHOULDER_RATE) != 0.0
    run(robot, 5, command=2.0)
    assert robot.read(ELBOW_RATE) != 0.0


@pytest.mark.parametrize(("brake", "expected"), [("idle", 0.0), ("hold", 3.0)])
def test_actuation_while_braking(brake: str, expected: float) -> None:
    robot, reference = machine(timeout=0.01, brake=brake), machine(timeout=100.0)
    assert run(robot, 11, command=3.0) == run(reference, 11, command=3.0)
    assert run(robot, 10) == run(reference, 10)
    run(reference, 10, command=expected)
    run(robot, 10)
    assert robot.braking
    np.testing.assert_array_equal(robot.read("plant.state"), reference.read("plant.state"))


@pytest.mark.parametrize(("value", "reason"), [(np.nan, "not finite"), (10.5, "limits")])
def test_rejected_commands_do_not_release_the_brake(value: float, reason: str) -> None:
    robot = machine(timeout=0.01)
    run(robot, 1, command=1.0)
    run(robot, 11, command=value)
    assert robot.braking
    status = robot.status()
    assert (status.accepted, status.rejected) == ({"torque": 1}, {"torque": {reason: 11}})


def test_machine_without_brake_repeats_commands() -> None:
    robot, reference = machine(timeout=0.01), machine()
    robot.begin(NoBrake())
    robot.receive(COMMAND, torque(2.0, 1))
    assert run(robot, 50) == run(reference, 50, command=2.0)
    assert not robot.braking
    robot.end_faults()
    run(robot, 1)
    assert robot.braking


@pytest.mark.parametrize("brake", ["lock", "idle", "hold"])
def test_stopped_machine_takes_no_commands_and_brakes_until_it_gets_one(brake: str) -> None:
    robot, reference = machine(brake=brake), machine(brake=brake)
    for each in (robot, reference):
        run(each, 5, command=2.0)
    robot.begin(OwnStop())
    run(robot, 50, command=2.0)
    assert robot.stopped and robot.braking
    assert robot.status().faults == [{"fault": "own_stop", "side": "sense", "channels": []}]
    if brake == "lock":
        np.testing.assert_array_equal(state(run(robot, 1)[-1])[3], 0.0)  # The elbow, which has the motor, is locked.
    else:
        run(reference, 51, command=0.0)
        run(robot, 1)
        np.testing.assert_array_equal(robot.read("plant.state"), reference.read("plant.state"))
    robot.end_faults()
    run(robot, 1)
    assert not robot.stopped and robot.braking
    run(robot, 1, command=2.0)
    assert not robot.braking


def test_continuous_plant_cannot_be_locked() -> None:
    continuous = RobotScenario(time_step=0.0)
    Machine(continuous)
    with pytest.raises(ValueError, match="only the joints of a discrete plant can be locked"):
        Machine(continuous, MachineConfig(brake="lock"))


# -- faults on either side


def test_faults_of_commands() -> None:
    robot, reference = machine(timeout=0.01), machine(timeout=0.01)
    robot.begin(Delay(side="act", seconds=0.005))
    robot.receive(COMMAND, torque(1.0, 1))
    assert run(robot, 5) == run(reference, 5)
    reference.receive(COMMAND, torque(1.0, 1))
    assert run(robot, 5) == run(reference, 5)


def test_equal_seeds_give_equal_faults() -> None:
    def told(seed: int) -> list[bytes]:
        robot = machine(seed=seed)
        robot.begin(Drop(fraction=0.5))
        return run(robot, 50)

    assert told(1) == told(1)
    assert told(1) != told(2)


def test_fault_of_an_unknown_channel_is_refused() -> None:
    with pytest.raises(InjectedFaultError, match="no sense channel 'IIWA'; it has: IIWA_STATUS"):
        machine().begin(Drop(channels=["IIWA"]))


# -- what does not fit


PROTOCOL = protocol_of(RobotScenario())


def test_scenario_without_protocol_is_refused() -> None:
    with pytest.raises(ProtocolError, match=r"AcrobotScenario has no protocol .* give it a method deployment\(\)"):
        Machine(AcrobotScenario())


def test_protocol_that_lacks_a_signal_is_refused() -> None:
    @dataclass
    class Mute(RobotScenario):
        def deployment(self) -> Deployment:
            return Deployment(protocol=replace(PROTOCOL, act=[]))

    with pytest.raises(ProtocolError, match="actuator signal torque needs a map"):
        Machine(Mute())


def test_period_of_an_unknown_channel_is_refused() -> None:
    @dataclass
    class Odd(RobotScenario):
        def deployment(self) -> Deployment:
            return Deployment(protocol=replace(PROTOCOL, periods={"IMU": 0.1}))

    with pytest.raises(ProtocolError, match="not 'IMU' to 0.1 s"):
        Machine(Odd())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"period": 0.0}, "MachineConfig.period must be a finite number above 0 s or None, not 0.0"),
        ({"perturb": 1.0}, "perturb must be a number from 0 to below 1, not 1.0"),
        ({"noise": {"position": -1.0}}, r"noise.position. must be a finite number of at least 0, not -1.0"),
        ({"noise": {"torque": 1.0}}, "vector sensor signals \\(position, velocity\\), not to 'torque'"),
        ({"brake": "soft"}, "brake must be one of empty, hold, idle, lock, not 'soft'"),
        ({"act_latency": -1.0}, "act_latency must be a finite number of at least 0 s, not -1.0"),
        (
            {"max_latency": 0.0},
            "max_latency must be a number above 0 s, not 0.0",
        ),
        ({"values": {"sim.sys.Acrobot.elbow.pos": 1.0}}, "did you mean sim.sys.Acrobot.elbow.position"),
        ({"seed": -1}, "seed must be a whole number of at least 0, not -1"),
    ],
)
def test_config_that_does_not_fit_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        machine(**options)
