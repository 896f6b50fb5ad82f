"""The testbed: what it refuses, that copies of it continue exactly, and that the DPS cannot tell sim from real."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import Context

from vtbdrake.components.sensors import ErrorModel
from vtbdrake.testbed import ScenarioError, VirtualTestbed
from vtbdrake.testing import Subject
from vtbdrake.testing.checks.boundary_checks import check_dps_alone_commands_the_same, check_dps_cannot_tell_the_switch
from vtbdrake.testing.checks.scenario_checks import check_yaml_round_trip
from vtbdrake.testing.checks.signal_checks import check_parameters_have_bounds, check_variables_do_not_overlap
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.laws import LAWS
from vtbdrake_diagrams.manipulator.motions import Motion

T = 0.001
SIGNALS = ("joint_position", "joint_velocity", "joint_torque_measured", "wrench")


# Set after the construction, which refuses it.
IMPOSSIBLE = ErrorModel()
IMPOSSIBLE.dropout = 2.0


def rough(law: str = "admittance", **fields: object) -> ManipulatorScenario:
    """Every sensor with every error, and a wall in the way."""
    errors = dict(drift=1e-4, latency=2, dropout=0.1)
    return ManipulatorScenario(
        law=law,
        wall=True,
        wall_distance=0.79,
        position_errors=ErrorModel(noise=1e-5, quantization=1e-6, seed=1, **errors),
        velocity_errors=ErrorModel(noise=1e-3, seed=2, **errors),
        torque_errors=ErrorModel(noise=0.1, bias=0.2, seed=3, **errors),
        wrench_errors=ErrorModel(noise=0.05, seed=4, **errors),
        **fields,  # type: ignore[arg-type]
    )


def start(testbed: VirtualTestbed, motion: int) -> Context:
    context = testbed.default_context()
    testbed.write(context, {"u.motion": float(motion), "sim.act.drives.delay": 2.0})
    return context


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"law": "magic"}, "law must be one of joint_impedance, cartesian_impedance, admittance"),
        ({"period": 0.0}, "period must be a finite number above 0 s"),
        ({"wall_stiffness": -1.0}, "wall_stiffness must be a finite number above 0 N/m"),
        ({"plant_config": MultibodyPlantConfig(time_step=0.0)}, "time_step must be a number above 0 s"),
        ({"position_errors": IMPOSSIBLE}, "ManipulatorScenario.position_errors.dropout must be"),
    ],
)
def test_bad_fields_are_refused(fields: dict, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        ManipulatorScenario(**fields).build()


def test_signals_fit_the_robots_messages() -> None:
    interface = ManipulatorScenario().interface()
    assert [(s.name, s.size) for s in interface.sense] == [*((name, 7) for name in SIGNALS[:3]), ("wrench", 6)]
    (torque,) = interface.act
    assert (torque.name, torque.size) == ("joint_torque", 7)
    np.testing.assert_array_equal(torque.upper, [320, 320, 176, 176, 110, 40, 40])


@pytest.mark.slow
def test_snapshot_continues_with_the_same_bytes(tmp_path: Path) -> None:
    testbed = rough().build()
    context = start(testbed, Motion.PRESS)
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(1.2)
    assert testbed.read(context, "dps.env.contact_wrench")[3] < -2.0  # in contact
    snapshot = testbed.snapshot(context)
    simulator.AdvanceTo(1.3)

    other = rough().build()
    copied = other.default_context()
    other.restore(copied, snapshot)
    other.simulator(copied, restored=True).AdvanceTo(1.3)
    assert other.read(copied, "dps.joint_torque").tobytes() == testbed.read(context, "dps.joint_torque").tobytes()
    assert other.snapshot(copied).compare(testbed.snapshot(context)) == {}


@cache
def subject(law: str) -> Subject:
    return Subject(rough(law), values={"u.motion": float(Motion.SWING), "sim.act.drives.delay": 2.0}, horizon=0.2)


@pytest.mark.slow_cases
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    "check",
    [
        check_yaml_round_trip,
        check_parameters_have_bounds,
        check_variables_do_not_overlap,
        check_dps_cannot_tell_the_switch,
        check_dps_alone_commands_the_same,
    ],
    ids=lambda check: check.__name__,
)
def test_every_law_passes_with_every_error(law: str, check: Callable[[Subject], None]) -> None:
    check(subject(law))


def test_simulated_arm_starts_from_what_the_dps_perceives() -> None:
    testbed = ManipulatorScenario().build()
    context = start(testbed, Motion.SWING)
    testbed.simulator(context).AdvanceTo(0.5)
    q = testbed.read(context, "dps.env.joint_position")
    testbed.write(context, {f"sim.sys.arm.joint_{k}.position": 0.0 for k in range(1, 8)})
    testbed.start_from_belief(context)
    assert [testbed.read(context, f"sim.sys.arm.joint_{k}.position") for k in range(1, 8)] == q.tolist()
    v = testbed.read(context, "dps.env.joint_velocity")
    assert [testbed.read(context, f"sim.sys.arm.joint_{k}.velocity") for k in range(1, 8)] == v.tolist()


def test_wall_can_be_moved_by_address() -> None:
    scenario = ManipulatorScenario(wall=True)
    testbed = scenario.build()
    forces = []
    for shift in (0.0, -0.06):  # 5 cm of the tip, and then 1 cm into it
        context = testbed.default_context()
        pose = testbed.read(context, "sim.env.wall.mount.pose")
        pose[0] += shift
        testbed.write(context, {"sim.env.wall.mount.pose": pose})
        testbed.simulator(context).AdvanceTo(0.5)
        forces.append(testbed.read(context, "dps.env.contact_wrench")[3])
    assert forces[0] == pytest.approx(0.0, abs=0.1)
    assert forces[1] < -5.0


def test_simulation_starts_in_equilibrium() -> None:
    testbed = ManipulatorScenario(law="joint_impedance").build()
    context = testbed.default_context()
    simulator = testbed.simulator(context)
    for t in (0.005, 0.05, 0.2):
        simulator.AdvanceTo(t)
        velocities = [testbed.read(context, f"sim.sys.arm.joint_{k}.velocity") for k in range(1, 8)]
        np.testing.assert_allclose(velocities, 0.0, atol=1e-9)


@pytest.mark.slow_cases
@pytest.mark.parametrize("law", LAWS)
def test_compiled_dps_gives_the_same_torques(law: str) -> None:
    torques = []
    for compiled in (False, True):
        testbed = ManipulatorScenario(law=law, compile=compiled).build()
        context = start(testbed, Motion.SWING)
        testbed.simulator(context).AdvanceTo(0.2)
        torques.append(testbed.read(context, "dps.joint_torque"))
    np.testing.assert_array_equal(*torques)
