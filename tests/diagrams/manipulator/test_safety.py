"""Tests of the fallback that carries the arm after a fault, alone and through the guards, against the simulated arm."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

from vtbdrake.control.fallback import NO_COMMAND, NoCommand, Sample
from vtbdrake.control.guards import SOUND, GuardDecision, Guards, LoopCondition
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.testbed import Interface, Signal, WorldAlone
from vtbdrake_diagrams.manipulator.arm import Arm
from vtbdrake_diagrams.manipulator.safety import CARRY, DISAGREEMENT, SLIP, FloatInPlace
from vtbdrake_diagrams.manipulator.scenario import ManipulatorScenario

HOME = np.array(Arm().home)
REST = np.zeros(7)
T = 0.001

SCENARIO = ManipulatorScenario()


@cache
def world() -> WorldAlone:
    return WorldAlone(SCENARIO)


def gravity(q: np.ndarray) -> np.ndarray:
    """By Drake."""
    plant = world().plant
    assert plant is not None
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    return -plant.CalcGravityGeneralizedForces(context)


def torque(
    floating: FloatInPlace, q: np.ndarray, v: np.ndarray = REST, *, age: float = 0.0, fresh: bool = True
) -> np.ndarray | NoCommand:
    """Return the command for a sample of this age."""
    values = {"joint_position": q, "joint_velocity": v}
    known = {name: Sample(value, age) for name, value in values.items()}
    return floating.command(np.zeros(7), values if fresh else {}, known, T)


def test_resting_arm_is_carried() -> None:
    np.testing.assert_allclose(torque(FloatInPlace(), HOME), gravity(HOME), atol=1e-9)


def test_arm_that_moves_is_braked_and_pulled_back() -> None:
    moving, resting = FloatInPlace(), FloatInPlace()
    speed = np.full(7, 0.1)
    torque(moving, HOME, speed), torque(resting, HOME)
    q = HOME + 0.01
    slower = torque(resting, q) - gravity(q)
    pull = torque(moving, q, speed) - gravity(q)
    assert (slower < 0.0).all()
    assert (pull < slower).all()


def test_pose_far_away_is_no_goal() -> None:
    """The arm was moved while somebody else commanded it: the springs pull no harder than at the slip."""
    floating, pushed = FloatInPlace(), FloatInPlace()
    far, near = HOME + 1.0, HOME + SLIP
    torques = []
    for fallback, q in ((floating, far), (pushed, near)):
        torque(fallback, HOME)
        torques.append(torque(fallback, q) - gravity(q))
    np.testing.assert_allclose(torques[0], torques[1], atol=1e-9)


def test_velocity_against_the_positions_counts_as_disagreement() -> None:
    floating, honest = FloatInPlace(), FloatInPlace()
    for fallback in (floating, honest):
        torque(fallback, HOME)
    told = torque(floating, HOME, np.full(7, 9.0))
    np.testing.assert_allclose(told, torque(honest, HOME, np.full(7, DISAGREEMENT)), atol=1e-9)


def test_weight_is_carried_then_left_to_brakes() -> None:
    floating = FloatInPlace()
    np.testing.assert_allclose(torque(floating, HOME, fresh=False, age=0.9 * CARRY), gravity(HOME), atol=1e-9)
    assert torque(floating, HOME, fresh=False, age=1.1 * CARRY) is NO_COMMAND


def test_arm_is_held_where_the_fallback_began() -> None:
    floating = FloatInPlace()
    torque(floating, HOME)
    floating.begin()
    moved = HOME + 0.3
    np.testing.assert_allclose(torque(floating, moved), gravity(moved), atol=1e-9)


def test_arm_that_was_never_seen_is_left_to_its_brakes() -> None:
    assert FloatInPlace().command(np.zeros(7), {}, {}, T) is NO_COMMAND


def test_interface_without_the_arms_positions_is_refused() -> None:
    act = Signal("joint_torque", size=7, unit="N m", idle=0.0)
    with pytest.raises(ValueError, match="from the sensor signals joint_position and joint_velocity"):
        Guards(
            Interface(sense=[Signal("joint_position", size=6)], act=[act]), T, fallback={"joint_torque": FloatInPlace()}
        )


# -- through the guards


@pytest.fixture(autouse=True)
def quiet(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    with caplog.at_level(logging.CRITICAL, logger="vtbdrake.control.guards"):
        yield


class GuardedArm:
    """The simulated arm at rest, in lock-step with guards, and a DPS that carries its weight.

    Attributes:
        heard: gives what arrives of what is measured, by signal; what it leaves out does not arrive.
    """

    def __init__(self) -> None:
        interface = SCENARIO.interface()
        deployment = SCENARIO.deployment()
        self.guards = Guards(interface, T, **deployment.guards)
        self.guards.measured_by = {"joint_torque": "joint_torque_measured"}
        self.context = world().default_context()
        self.simulator = world().simulator(self.context)
        self.simulator.Initialize()
        self.received = {signal.name: ReceivedSignal() for signal in interface.sense}
        self.heard: Callable[[dict[str, Any]], dict[str, Any]] = lambda measured: measured
        self.cycles = 1
        self.simulator.AdvanceTo(T)  # The sensors measure what the arm's brakes hold.
        self.guards.start("joint_torque", gravity(self.pose))
        self.run(5)

    def measured(self, name: str) -> np.ndarray:
        return np.array(world().read(self.context, f"sense.{name}"))

    @property
    def pose(self) -> np.ndarray:
        assert world().plant is not None
        return np.array(world().plant.GetPositions(world().plant.GetMyContextFromRoot(self.context)))

    def cycle(self, condition: LoopCondition = SOUND) -> GuardDecision:
        now = self.cycles * T
        for name, value in self.heard({name: self.measured(name) for name in self.received}).items():
            self.received[name].accept(np.array(value), now, now)
        verdict = self.guards.judge(now, self.received, {"joint_torque": gravity(self.pose)}, condition=condition)
        self.guards.note_unsent(())
        if "joint_torque" in verdict.actuation:
            world().actuate(self.context, "joint_torque", verdict.actuation["joint_torque"])
        self.cycles += 1
        self.simulator.AdvanceTo(self.cycles * T)
        return verdict

    def run(self, cycles: int) -> list[GuardDecision]:
        return [self.cycle() for _ in range(cycles)]

    def reset(self) -> tuple[str, ...]:
        return self.guards.reset(self.cycles * T, self.received)


def test_silent_sensors_leave_arm_to_brakes() -> None:
    arm = GuardedArm()
    before = arm.pose
    arm.heard = lambda measured: {}
    verdicts = arm.run(round((CARRY - T) / T))
    assert arm.guards.latched[0].kind == "stale"
    assert np.abs(arm.pose - before).max() < 0.01
    np.testing.assert_allclose(verdicts[-1].actuation["joint_torque"], gravity(before), atol=0.5)
    arm.run(10)
    assert arm.cycle().actuation == {}


@pytest.mark.slow_cases
@pytest.mark.parametrize("signal", ["joint_position", "joint_velocity", "joint_torque_measured", "wrench"])
def test_arm_is_carried_whichever_of_its_sensors_falls_silent(signal: str) -> None:
    arm = GuardedArm()
    before = arm.pose
    arm.heard = lambda measured: {name: value for name, value in measured.items() if name != signal}
    arm.run(round((CARRY - T) / T))
    assert [(fault.signal, fault.kind) for fault in arm.guards.latched] == [(signal, "stale")]
    assert np.abs(arm.pose - before).max() < 0.01


SPOOFS: dict[str, Callable[[int, np.ndarray], np.ndarray]] = {
    "far away": lambda k, q: q + 1.0,
    "near by": lambda k, q: q + 0.1,
    "now and then": lambda k, q: q + 1.0 * (k % 5 == 0),
    "back and forth": lambda k, q: q + (1.0 if k % 2 else -0.5),
    "frozen elsewhere": lambda k, q: np.zeros(7),
}


@pytest.mark.slow_cases
@pytest.mark.parametrize("spoof", SPOOFS)
def test_false_positions_within_range_do_not_move_the_arm_that_floats(spoof: str) -> None:
    arm = GuardedArm()
    before = arm.pose
    arm.cycle(LoopCondition(error=RuntimeError("a fault of the DPS")))
    arm.heard = lambda measured: {
        **measured,
        "joint_position": SPOOFS[spoof](arm.cycles, measured["joint_position"]),
    }
    for verdict in arm.run(round(CARRY / T) - 10):
        np.testing.assert_allclose(verdict.actuation["joint_torque"], gravity(before), atol=1.0)
    assert np.abs(arm.pose - before).max() < 0.01
    assert any(fault.kind == "jump" for fault in arm.guards.log)


@pytest.mark.slow_cases
@pytest.mark.parametrize("offset", [0.2, 5.0])
def test_false_velocities_within_range_do_not_move_the_arm_that_floats(offset: float) -> None:
    arm = GuardedArm()
    before = arm.pose
    arm.cycle(LoopCondition(error=RuntimeError("a fault of the DPS")))
    arm.heard = lambda measured: {**measured, "joint_velocity": measured["joint_velocity"] + offset}
    arm.run(500)
    assert np.abs(arm.pose - before).max() < 2.0 * SLIP


def test_arm_that_really_is_elsewhere_is_believed_by_a_reset_only() -> None:
    arm = GuardedArm()
    arm.heard = lambda measured: {**measured, "joint_position": measured["joint_position"] + 0.2}
    arm.run(50)
    assert "jumps" in arm.reset()[0]
    arm.run(200)
    assert arm.cycle().actuation == {}
    assert arm.reset() == ()
    assert arm.cycle().ok


def test_arm_idle_for_long_departs_from_the_measured_torque() -> None:
    arm = GuardedArm()
    arm.heard = lambda measured: {}
    arm.run(round(CARRY / T) + 100)
    # Its brakes hold it: no torque acts.
    arm.heard = lambda measured: {**measured, "joint_torque_measured": np.zeros(7)}
    sent = arm.cycle().actuation["joint_torque"]
    assert (np.abs(sent) <= np.array(Arm().torque_rates) * T * (1 + 1e-9)).all()
    assert np.abs(sent).max() > 0.0
