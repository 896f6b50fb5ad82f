"""A station is deployed on Drake's hardware_sim of the same file: it takes over and hands back without a kick."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from math import inf
from pathlib import Path

import numpy as np
import pytest

import vtbdrake as vtb
from tests.station.partner import PERIOD, HardwareSim
from vtbdrake.control.switching import SwitchRefusedError
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.testbed import DpsAlone, VirtualTestbed
from vtbdrake_diagrams.station import FILE, HOME, ArmStation


class Session:
    """A deployed station and hardware_sim, cycle by cycle."""

    def __init__(self, runtime: vtb.Runtime, machine: HardwareSim, signal: str) -> None:
        self.runtime, self.machine, self.signal = runtime, machine, signal

    def run(self, cycles: int) -> None:
        for _ in range(cycles):
            self.machine.advance(self.runtime.bridge.sent[self.signal].count)  # type: ignore[attr-defined]
            self.runtime.run(cycles=1)

    def jumps(self) -> np.ndarray:
        """Return the largest jump of each joint's torque from one step of the plant to the next."""
        return np.abs(np.diff(self.machine.actuation, axis=0)).max(axis=0)


@cache
def target(key: str, *, alone: bool) -> DpsAlone | VirtualTestbed:
    scenario = ArmStation(f"{FILE}#{key}")
    return DpsAlone(scenario) if alone else scenario.build()


@contextmanager
def session(
    key: str, *, alone: bool = False, offset: float = 0.0, record: Path | None = None, cameras: bool = False
) -> Iterator[Session]:
    scenario = ArmStation(f"{FILE}#{key}")
    signal = "iiwa_torque" if key == "Torque" else "iiwa_position"
    deployment = vtb.Deployment.of(scenario).in_lock_step("iiwa_position_measured")
    with (
        vtb.Hub(port=0, protect=["IIWA_COMMAND", "SCHUNK_WSG_COMMAND"]) as hub,
        scenario.deploy(hub.url, target=target(key, alone=alone), record=record, deployment=deployment) as runtime,
        HardwareSim(hub.url, key, offset=offset, cameras=cameras) as machine,
    ):
        yield Session(runtime, machine, signal)


def allowed_jumps(key: str) -> np.ndarray:
    """Return by how much the limits let the torques jump: by their rate, or to the limited acceleration."""
    station = ArmStation(f"{FILE}#{key}")
    (signal, _) = station.interface().act
    if key == "Torque":
        return np.asarray(signal.rate) * PERIOD
    arm = station.arm_model("iiwa")
    context = arm.CreateDefaultContext()
    arm.SetPositions(context, HOME)
    return np.abs(arm.CalcMassMatrix(context)) @ np.asarray(signal.acceleration)


def test_station_is_taken_over_without_a_jump() -> None:
    with session("Torque", offset=0.004) as s:
        for position in ("sim", "shadow", "real"):
            s.runtime.switch(position)
            s.run(12)
            assert s.runtime.guards.latched == ()
        assert (s.jumps() < allowed_jumps("Torque")).all()


@pytest.mark.slow
@pytest.mark.parametrize(("key", "offset"), [("Torque", 0.004), ("Position", 0.0005), ("PositionAndTorque", 0.0005)])
def test_station_is_taken_over_and_handed_back_without_a_jump(key: str, offset: float, tmp_path: Path) -> None:
    with session(key, offset=offset, record=tmp_path / "log") as s:
        for position in ("sim", "shadow", "real", "twin", "real", "shadow", "sim", "shadow", "real"):
            s.runtime.switch(position)
            s.run(16)
            assert s.runtime.guards.latched == ()
        assert (s.jumps() < allowed_jumps(key)).all()
        s.runtime.write({"u.target": HOME + 0.02, "u.opening": 0.08})
        s.run(140)
        assert s.runtime.guards.latched == ()
    np.testing.assert_allclose(s.machine.positions[-1], HOME + 0.02, atol=0.005)
    assert s.machine.openings[-1] == pytest.approx(0.08, abs=1e-3)
    assert vtb.replay(vtb.read_log(tmp_path / "log")).identical


@pytest.mark.slow
def test_arm_that_is_elsewhere_is_not_taken_over() -> None:
    with session("Torque", offset=0.05) as s:
        s.run(2)
        s.runtime.switch("shadow")
        s.run(2)
        with pytest.raises(SwitchRefusedError, match=r"iiwa_torque\[0\] is 15 away from iiwa_torque_added\[0\]; 3.2"):
            s.runtime.switch("real")


@pytest.mark.slow
def test_dps_alone_commands_arm_and_gripper(tmp_path: Path) -> None:
    with session("Position", alone=True, record=tmp_path / "log") as s:
        s.run(2)
        s.runtime.switch("real")
        s.runtime.write({"u.opening": 0.06})
        s.run(40)
        assert s.runtime.guards.latched == ()
        measured = s.runtime.bridge.sensed["wsg_position_measured"].value  # type: ignore[attr-defined]
    assert s.machine.openings[-1] == pytest.approx(0.06, abs=1e-3)
    assert measured == pytest.approx(s.machine.openings[-1], abs=1e-3)
    assert vtb.replay(tmp_path / "log").identical


class Watcher(AddressedSystem):
    """Reads the images of the camera, and commands the gripper."""

    def __init__(self, station: vtb.Station) -> None:
        super().__init__()
        for name in ("camera_0_color_image", "camera_0_depth_image"):
            self.DeclareAbstractInputPort(name, station.signals()[name].abstract_value())
        torque = self.declare_discrete_state(torque=Quantity(np.zeros(7), "N m"))
        self.DeclareStateOutputPort("iiwa_torque", torque.index)
        opening = self.declare_discrete_state(opening=Quantity([0.02], "m"))  # kept without commands
        self.DeclareStateOutputPort("wsg_position", opening.index)


@pytest.mark.one_python
def test_loop_is_paced_by_what_every_dps_gets() -> None:
    # Its DPS reads images alone: of the arm and of the gripper, it has only what take-over and fallbacks need.
    scenario = vtb.Station(f"{FILE}#Torque", dps=Watcher)
    deployment, sensed = vtb.Deployment.of(scenario), {signal.name for signal in scenario.interface().sense}
    assert deployment.pace == "iiwa_position_measured" and deployment.pace in sensed
    assert set(deployment.guards["max_delay"]) == {deployment.pace, "wsg_position_measured"} < sensed


@pytest.mark.slow
def test_images_come_from_drakes_camera_as_from_the_simulated_one() -> None:
    scenario = vtb.Station(f"{FILE}#Torque", dps=Watcher)
    deployment = vtb.Deployment.of(scenario).in_lock_step("iiwa_position_measured")
    with (
        vtb.Hub(port=0) as hub,
        scenario.deploy(hub.url, deployment=deployment) as runtime,
        HardwareSim(hub.url, "Torque", cameras=True) as machine,
    ):
        for _ in range(23):
            machine.advance(0)
            runtime.run(cycles=1)
        sensed = runtime.bridge.sensed  # type: ignore[attr-defined]
        received = {name: sensed[name].value.data for name in ("camera_0_color_image", "camera_0_depth_image")}
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(0.1001)
    color = testbed.read(context, "sim.sense.camera_0.color_image").data
    depth = testbed.read(context, "sim.sense.camera_0.depth_image_16u").data
    np.testing.assert_array_equal(received["camera_0_color_image"], color)
    np.testing.assert_array_equal(received["camera_0_depth_image"], depth)
    assert len(np.unique(depth)) > 20


@pytest.mark.slow
def test_station_drives_hardware_sim_in_real_time(tmp_path: Path) -> None:
    scenario = ArmStation(f"{FILE}#Position")
    # On a busy computer the loop misses deadlines, and the machine is slow and reports late, which is not the question.
    deployment = vtb.Deployment.of(scenario)
    patient = {**deployment.guards, "max_missed": 10_000, "acting_latency": 250, "pace_tolerance": inf}
    deployment = replace(deployment, guards=patient, check_age=False)
    with (
        vtb.Hub(port=0) as hub,
        HardwareSim(hub.url, "Position", real_time=True),
        scenario.deploy(hub.url, deployment=deployment, record=tmp_path / "log") as runtime,
    ):
        runtime.take_over(timeout=60.0)
        runtime.write({"u.target": HOME + 0.05, "u.opening": 0.08})
        for _ in range(20):
            runtime.run(seconds=1.5)
            assert runtime.guards.latched == ()
            arm, hand = (runtime.read(f"real.sense.{name}_position_measured") for name in ("iiwa", "wsg"))
            if np.allclose(arm, HOME + 0.05, atol=0.005) and hand == pytest.approx(0.08, abs=0.001):
                break
        np.testing.assert_allclose(arm, HOME + 0.05, atol=0.01)
        assert hand == pytest.approx(0.08, abs=0.002)
    assert vtb.replay(tmp_path / "log").identical
