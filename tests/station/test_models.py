"""An arm's model and signals are what Drake's own driver computes with and what the model's file says."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.primitives import ConstantVectorSource

import vtbdrake as vtb
from benchmarks import hardware_sim_loop
from vtbdrake.control.fallback import gravity_compensation
from vtbdrake_diagrams.station import FILE, ArmStation, JointControl


def gravity(file: Path) -> np.ndarray:
    """Return the torques (10, 7) with which Drake's driver carries the arm, compared with the torques of its model."""
    urls = {"iiwa": "memq://null", "wsg": "memq://wsg"}
    sim = hardware_sim_loop.build(file, "Torque", urls=urls, sources={"torque": ConstantVectorSource(np.zeros(7))})
    context = sim.simulator.get_mutable_context()
    plant_context = sim.plant.GetMyMutableContextFromRoot(context)
    driver = sim.simulator.get_system().GetSubsystemByName("iiwa")
    arm, commanded = sim.plant.GetModelInstanceByName("iiwa"), driver.GetOutputPort("torque_commanded")
    weight = gravity_compensation(ArmStation(f"{file}#Torque").arm_model("iiwa"))
    expected = []
    for q in np.random.default_rng(5).uniform(-1.5, 1.5, (10, 7)):
        sim.plant.SetPositions(plant_context, arm, q)
        expected.append(commanded.Eval(driver.GetMyContextFromRoot(context)))
        np.testing.assert_allclose(weight(q), expected[-1], atol=1e-9)
    return np.array(expected)


def test_gravity_of_the_arm_is_that_of_drakes_driver(tmp_path: Path) -> None:
    alone = gravity(FILE)
    assert np.abs(alone).max() > 5.0
    # A block that is welded to the forearm, and one to the base.
    welded = "".join(
        f"""
  - add_model: {{ name: {name}, file: package://vtbdrake_station/models/block.sdf }}
  - add_weld: {{ parent: "iiwa::{link}", child: "{name}::block", X_PC: {{ translation: [0.1, 0.2, 0] }} }}"""
        for name, link in (("tool", "iiwa_link_4"), ("box", "iiwa_link_0"))
    )
    text = FILE.read_text()
    shutil.copytree(FILE.parent, tmp_path, dirs_exist_ok=True)
    end = text.index("  cameras: &cameras")
    (tmp_path / FILE.name).write_text(text[:end].rstrip() + welded + "\n" + text[end:])
    more = np.abs(gravity(tmp_path / FILE.name) - alone)
    assert more[:, :4].max() > 0.1 and more[:, 4:].max() < 1e-9


def test_measured_values_are_plausible_as_fast_and_strong_as_a_gripper_is() -> None:
    sense = {signal.name: signal for signal in ArmStation().signals().values()}
    velocity, force = sense["wsg_velocity_measured"], sense["wsg_force_measured"]
    assert (velocity.lower, velocity.upper) == (-10.0, 10.0)
    # A force has no sign; ten times the force of both fingers is impossible.
    assert (force.lower, force.upper) == (0.0, 10.0 * 160.0)
    assert {velocity.max_age, force.max_age, sense["wsg_position_measured"].max_age} == {10 * 0.05}  # ten messages


def test_commands_have_the_limits_of_the_models_file() -> None:
    act = {signal.name: signal for signal in ArmStation(f"{FILE}#PositionAndTorque").signals().values()}
    np.testing.assert_allclose(act["iiwa_torque"].upper, [320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0])
    position = act["iiwa_position"]
    np.testing.assert_allclose(np.asarray(position.upper)[:2], [2.96705972839, 2.09439510239])
    np.testing.assert_allclose(position.rate, [1.4835, 1.4835, 1.7453, 1.309, 2.2689, 2.3562, 2.3562])
    np.testing.assert_allclose(position.acceleration, 2.0 * np.asarray(position.rate))
    np.testing.assert_allclose(position.idle, [0.0, 0.6, 0.0, -1.2, 0.0, 1.0, 0.0])
    assert (act["wsg_position"].upper, act["wsg_position"].idle, act["wsg_force_limit"].upper) == (0.11, 0.04, 160.0)


def test_station_survives_file_and_fields(tmp_path) -> None:  # type: ignore[no-untyped-def]
    station = ArmStation(f"{FILE}#Position", speed_time=1.0)
    station.save(tmp_path / "saved.yaml")
    saved = vtb.load_scenario(tmp_path / "saved.yaml")
    assert saved == station
    np.testing.assert_array_equal(saved.interface().act[0].acceleration, station.interface().act[0].rate)
    assert vtb.load_scenario(f"vtbdrake_diagrams.station:ArmStation@{FILE}#Position") == ArmStation(f"{FILE}#Position")
    assert ArmStation() == ArmStation(f"{FILE}#Torque") != ArmStation(f"{FILE}#Position")


def test_function_is_named_in_the_record() -> None:
    station = vtb.Station(f"{FILE}#Torque", dps=ArmStation.make_impl, commands=ArmStation().commands)
    assert station.record()["dps"] == "vtbdrake_diagrams.station.scenario:ArmStation.make_impl"
    assert repr(station.interface()) == repr(ArmStation().interface())
    by_name = vtb.Station(f"{FILE}#Torque", dps=station.dps, commands=ArmStation().commands)
    assert isinstance(by_name.make_impl(), JointControl)


def test_field_that_is_none_is_told() -> None:
    with pytest.raises(ValueError, match="Station has no field 'command'; did you mean commands"):
        vtb.Station(f"{FILE}#Torque", command={})
