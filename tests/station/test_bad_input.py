"""Mistakes in the file of a station, in its models or in its DPS are told, with the place and what to do."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder, System
from pydrake.systems.primitives import ConstantVectorSource, PassThrough

import vtbdrake as vtb
from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.station import FILE, ArmStation, JointControl


def written(folder: Path, file: str, old: str, new: str) -> Path:
    """Copy the station, with a change in one of its files."""
    copy = folder / "station"
    shutil.copytree(FILE.parent, copy)
    text = (copy / file).read_text()
    assert old in text
    (copy / file).write_text(text.replace(old, new, 1))
    return copy / "station.yaml"


WSG = "wsg: !SchunkWsgDriver {}"
ARM = "models/iiwa14.urdf"
LIMIT = '<limit lower="-2.09439510239" upper="2.09439510239" effort="176" velocity="1.309"/>'
SPRING = '"iiwa_joint_3" type="spring"'
TRANSMISSION = (
    '<transmission name="iiwa_joint_1_transmission"><type>transmission_interface/SimpleTransmission</type>'
    '<joint name="iiwa_joint_1"/><actuator name="iiwa_joint_1"/></transmission>'
)
FINGER = "<mass>0.05</mass><inertia><ixx>2e-5</ixx><iyy>1e-5</iyy><izz>2e-5</izz>"
MASSLESS = "<mass>0</mass><inertia><ixx>0</ixx><iyy>0</iyy><izz>0</izz>"
CASE = "<box><size>0.146 0.073 0.05</size></box>"
MESH = "<mesh><uri>case.obj</uri></mesh>"


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        (
            "station.yaml",
            "!SchunkWsg",
            "!Robotiq",
            "line 49: model_drivers.wsg is one of !IiwaDriver, .* not !RobotiqD",
        ),
        ("station.yaml", WSG, f"{WSG}\n    wsg: !ZeroForceDriver {{}}", "key 'wsg' twice, in lines 49 and 50: remove"),
        ("station.yaml", WSG, "gripper: !SchunkWsgDriver {}", "line 49: .* 'gripper', which no add_model .* iiwa, wsg"),
        ("station.yaml", "name: wsg\n      control", "name: hand\n      control", "line 47: .*'hand', which no add_mo"),
        (
            "station.yaml",
            "torque_only",
            "velocity",
            "line 46: control_mode of iiwa is one of position_only,.*'velocity'",
        ),
        (
            "station.yaml",
            "control_mode",
            "controll_mode",
            "line 48: .*'model_drivers.iiwa.controll_mode'; did you mean",
        ),
        (
            "station.yaml",
            WSG,
            "wsg: !SchunkWsgDriver {lcm_bus: b}",
            "line 49: there is no bus 'b' in lcm_buses, but: d",
        ),
        (
            "station.yaml",
            WSG,
            "table: !SchunkWsgDriver {}",
            "line 49: .*table.sdf.*two actuated fingers, not 0 positions",
        ),
        ("station.yaml", "models/wsg.sdf", "models/no.sdf", "line 7: .*no.sdf' which does not exist.*correct the path"),
        (
            "station.yaml",
            "//vtbdrake_station/models/wsg",
            "//other/wsg",
            "unknown package 'other'; correct .*package.xml",
        ),
        ("models/wsg.sdf", CASE, MESH, r"wsg.sdf:5: error: URI 'case.obj' .* does not exist.*put the mesh"),
        (
            "models/wsg.sdf",
            FINGER,
            MASSLESS,
            "line 49: the joint left_finger_.*wsg.sdf.* moves no inertia .* <inertial>",
        ),
        (ARM, '"iiwa_joint_3" type="revolute"', SPRING, "iiwa14.urdf:17: .*unrecognized type: 'spring'; Drake knows"),
        (
            ARM,
            '"iiwa_joint_ee" type="fixed"',
            '"ee" type="floating"',
            "joint iiwa_link_ee .*6 degrees of freedom: make",
        ),
        (
            ARM,
            TRANSMISSION,
            "",
            "iiwa_joint_1 .*iiwa14.urdf.* has no actuator: give it an effort",
        ),
    ],
)
def test_error_names_place_and_remedy(tmp_path: Path, file: str, old: str, new: str, message: str) -> None:
    path = written(tmp_path, file, old, new)
    with pytest.raises(ScenarioError, match=message) as error:
        ArmStation(f"{path}#Torque").build()
    assert str(path) in str(error.value)


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("iiwa_joint_4: [-1.2]", "iiwa_joint_4: [-2.5]", 13),
        ("  model_drivers:", "  initial_position: {iiwa: {iiwa_joint_4: [-2.5]}}\n  model_drivers:", 45),
    ],
)
def test_default_position_outside_its_limits_is_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, old: str, new: str, line: int
) -> None:
    path = written(tmp_path, "station.yaml", old, new)
    for _ in range(2):
        ArmStation(f"{path}#Torque").build()
    warning = (
        f"{path}, line {line}: the default position of iiwa_joint_4 of iiwa is -2.5 rad, outside its limits, "
        "-2.094395 to 2.094395 rad"
    )
    assert [record.getMessage()[: len(warning)] for record in caplog.records if "outside" in record.message] == [
        warning
    ]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "control_mode: torque_only",
            "control_mode: torque_only\n      lcm_status_period: 0",
            "line 49: the lcm_status_p",
        ),
        ("control_mode: torque_only", "control_mode: torque_only\n      lcm_status_period: -1", "not -1"),
        ("width: 64", "width: 64\n      fps: 0", "line 40: the fps of overview is a positive number .* not 0"),
    ],
)
def test_impossible_period_is_told_with_its_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = written(tmp_path, "station.yaml", old, new)
    with pytest.raises(ScenarioError, match=message) as error:
        ArmStation(f"{path}#Torque").interface()
    assert str(error.value).startswith(f"{path}, line ")


@pytest.mark.slow_cases
@pytest.mark.parametrize("limit", ["position", "velocity", "effort"])
def test_missing_limits_are_told_once(tmp_path: Path, caplog: pytest.LogCaptureFixture, limit: str) -> None:
    path = written(tmp_path, ARM, LIMIT, "")
    station = ArmStation(f"{path}#Torque")
    station.build()
    vtb.Deployment.of(station)
    warning = (
        f"{path}, line 46: the joints iiwa_joint_4 of iiwa ({path.with_name('models')}/iiwa14.urdf) have no {limit}"
    )
    assert sum(warning in record.getMessage() for record in caplog.records) == 1


def ports(*, inputs: dict[str, int], outputs: dict[str, int]) -> System:
    builder = DiagramBuilder()
    for name, size in inputs.items():
        end = builder.AddNamedSystem(f"{name}_end", PassThrough(size))
        builder.ExportInput(end.get_input_port(), name)
    for name, size in outputs.items():
        source = builder.AddNamedSystem(f"{name}_source", ConstantVectorSource(np.zeros(size)))
        builder.ExportOutput(source.get_output_port(), name)
    return builder.Build()


FINE = {"iiwa_torque": 7, "wsg_position": 1}


@pytest.mark.parametrize(
    ("inputs", "outputs", "message"),
    [
        (
            {},
            {"iiwa_position": 7, "wsg_position": 1},
            r"'iiwa_position', .*line 45, iiwa \(torque_only\), wsg \(position",
        ),
        ({}, {"iiwa_torque": 7}, "no output port wsg_position, which wsg .*line 49.* needs .*ZeroForceDriver"),
        ({"iiwa_position": 7}, FINE, "input port 'iiwa_position', .* did you mean iiwa_position_.*commands="),
        ({"iiwa_position_measured": 6}, FINE, "iiwa_position_measured has 7 entries, but the port .* has 6"),
        ({}, {**FINE, "iiwa_torque": 6}, "iiwa_torque has 7 entries, but the port .* has 6"),
    ],
)
def test_dps_that_does_not_fit_is_told(inputs: dict[str, int], outputs: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        vtb.Station(f"{FILE}#Torque", dps=lambda station: ports(inputs=inputs, outputs=outputs)).build()


def test_control_mode_that_the_dps_does_not_fit_is_told() -> None:
    with pytest.raises(ScenarioError, match=r"'iiwa_torque', .*, iiwa \(position_only\), .*change the control_mode"):
        vtb.Station(f"{FILE}#Position", dps=lambda station: JointControl(torque=True)).build()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (vtb.StationCommand([0.0]), "no input port for the command 'goal'; it has: none. Add it, or leave the command"),
        ([0.0], r"the command 'goal' is a StationCommand\(default=\[...\]\), not \[0.0\]"),
    ],
)
def test_command_that_the_dps_does_not_take_is_told(command: object, message: str) -> None:
    station = vtb.Station(
        f"{FILE}#Torque", dps=lambda station: ports(inputs={}, outputs=FINE), commands={"goal": command}
    )
    with pytest.raises(ScenarioError, match=message):
        station.build()


def test_station_without_a_dps_is_told() -> None:
    with pytest.raises(ValueError, match=r"is called with 1 value \(the station\), but <lambda> takes \(\)"):
        vtb.Station(f"{FILE}#Torque", dps=lambda: ports(inputs={}, outputs=FINE)).build()
    with pytest.raises(ScenarioError, match="has no DPS: give it dps=, a function"):
        vtb.Station(f"{FILE}#Torque").build()
    with pytest.raises(ScenarioError, match="returns a new System for a station, not 3"):
        vtb.Station(f"{FILE}#Torque", dps=lambda station: 3).build()
    with pytest.raises(ScenarioError, match="runs its code: if .*, import no_module first, or add --trust no_m"):
        vtb.Station(f"{FILE}#Torque", dps="no_module:make").build()


def test_two_arms_on_one_channel_are_told(tmp_path: Path) -> None:
    path = written(tmp_path, "station.yaml", "  - add_model: { name: table", SECOND + "  - add_model: { name: table")
    path.write_text(path.read_text().replace(WSG, "left: !IiwaDriver { control_mode: torque_only, lcm_bus: BUS }", 1))
    outputs = {"iiwa_torque": 7, "left_torque": 7}

    def deployment(bus: str) -> vtb.Deployment:
        text = path.read_text().replace("BUS", bus, 1).replace("  cameras:", f"{BUSES}  cameras:", 1)
        (path.parent / "two.yaml").write_text(text)
        station = vtb.Station(path.parent / "two.yaml#Torque", dps=lambda station: ports(inputs={}, outputs=outputs))
        assert station.url() == "tcpq://127.0.0.1:7700"
        return vtb.Deployment.of(station)

    with pytest.raises(ScenarioError, match="iiwa and left both send on the channel IIWA_STATUS: .*channel_suffix"):
        deployment("default")
    protocol = deployment("second").protocol
    assert protocol is not None
    assert [map.channel for map in protocol.act] == ["IIWA_COMMAND", "IIWA_COMMAND_LEFT"]
    assert [map.channel for map in protocol.sense] == ["IIWA_STATUS", "IIWA_STATUS_LEFT"]


SECOND = """  - add_model: { name: left, file: package://vtbdrake_station/models/iiwa14.urdf }
  - add_weld: { parent: world, child: "left::iiwa_link_0", X_PC: { translation: [0, 2, 0] } }
"""
BUSES = """  lcm_buses:
    default: { lcm_url: "tcpq://127.0.0.1:7700" }
    second: { lcm_url: "tcpq://127.0.0.1:7700", channel_suffix: _LEFT }
"""
