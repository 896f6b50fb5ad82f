"""A worker on foot who carries the unit: the gait against the published ranges, and the unit in the testbed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from vtbdrake.common.arrays import Array
from vtbdrake.components.localization.unit import TRACKING
from vtbdrake.components.sensors import Imu
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.world.ground import Ground
from vtbdrake_diagrams.forest.world.worker import Legs, Worker, add_worker

pytestmark = pytest.mark.one_python

FLAT = Ground(relief=0.0, bumps=0.0)
STEADY = replace(Worker(), tilt_wander=0.0, yaw_wander=0.0)


def gone(worker: Worker, *, speed: float = 1.2, curvature: float = 0.0, seconds: float = 8.0) -> Array:
    """Return rows of [x, y, z, roll, pitch, yaw, the six readings of an IMU] every 0.02 s."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.01)
    base = add_worker(plant, worker, RigidTransform())
    plant.Finalize()
    legs = builder.AddSystem(Legs(plant, base, worker, FLAT, position=[0.0, 0.0], heading=0.0))
    plant.SetDefaultFloatingBaseBodyPose(base, legs.unit_pose(np.zeros(2), 0.0, 0.0, 0.0, time=0.0))
    controls = builder.AddSystem(ConstantVectorSource([speed, curvature]))
    builder.Connect(controls.get_output_port(), legs.GetInputPort("controls"))
    builder.Connect(plant.get_state_output_port(), legs.GetInputPort("state"))
    builder.Connect(legs.GetOutputPort("spatial_force"), plant.get_applied_spatial_force_input_port())
    imu = builder.AddSystem(Imu(plant, base.body_frame(), period=0.02))
    builder.Connect(plant.get_state_output_port(), imu.GetInputPort("state"))
    simulator = Simulator(builder.Build())
    rows = []
    for k in range(1, round(seconds / 0.02)):
        simulator.AdvanceTo(0.02 * k)
        X_WB = plant.EvalBodyPoseInWorld(plant.GetMyContextFromRoot(simulator.get_context()), base)
        measured = imu.get_output_port().Eval(imu.GetMyContextFromRoot(simulator.get_context()))
        rows.append([*X_WB.translation(), *RollPitchYaw(X_WB.rotation()).vector(), *measured])
    return np.array(rows)


def test_gait_has_the_published_ranges() -> None:
    rows = gone(STEADY)[150:]
    ranges = np.ptp(rows[:, 1:6], axis=0)
    assert ranges[:2] == pytest.approx([0.05, 0.04], rel=0.03)
    assert np.degrees(ranges[2:]) == pytest.approx([3.3, 4.0, 6.9], rel=0.03)
    # Up and down once per step, to the sides once per stride: 1.85 steps per second.
    spectra = np.abs(np.fft.rfft(rows[:250, 1:3] - rows[:250, 1:3].mean(axis=0), axis=0))
    sideways, upwards = spectra.argmax(axis=0) / (250 * 0.02)
    assert upwards == pytest.approx(1.85, abs=0.15)
    assert sideways == pytest.approx(1.85 / 2.0, abs=0.15)
    assert (rows[-1, 0] - rows[0, 0]) / (0.02 * (len(rows) - 1)) == pytest.approx(1.2, abs=0.01)


def test_imu_of_a_walker_weighs_the_unit_on_average_and_swings_with_each_step() -> None:
    rows = gone(STEADY)
    two_strides = rows[-216:]
    up = two_strides[:, 11]
    assert up.mean() == pytest.approx(9.81, abs=0.05)
    # An amplitude of 2 cm at 1.85 Hz.
    assert np.ptp(up) == pytest.approx(2.0 * 0.02 * (2.0 * np.pi * 1.85) ** 2, rel=0.1)


def test_worker_who_stands_holds_a_steady_unit_still() -> None:
    rows = gone(STEADY, speed=0.0, seconds=1.0)
    assert np.abs(rows[:, :6] - rows[0, :6]).max() < 1e-9


def test_unit_in_the_hand_wanders_more_than_on_the_back() -> None:
    hand, back = (
        np.degrees(gone(Worker.carrying(place, height=1.5, step_frequency=1.85), speed=0.0)[:, 3:6])
        for place in ("hand", "back")
    )
    assert (hand.std(axis=0) > back.std(axis=0)).all()
    assert np.abs(back).max() < 3.0


def test_worker_walks_on_a_circle() -> None:
    rows = gone(STEADY, curvature=0.2, seconds=9.0)
    middle = np.hypot(rows[200:, 0], rows[200:, 1] - 5.0)
    # The unit is 0.25 m behind the middle of the body, and sways by 2.5 cm.
    assert np.abs(middle - np.hypot(5.0, 0.25)).max() < 0.05


@pytest.mark.slow
def test_unit_on_foot_is_localized_without_wheels() -> None:
    scenario = ForestScenario(seed=3, length=60.0, width=60.0, start=12.0, carrier="hand", scanner_height=1.4)
    assert "odometry" not in [signal.name for signal in scenario.interface().sense]
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(4.0)
    assert testbed.read(context, "dps.env.pose.status") == TRACKING
    x, y, *_ = testbed.read(context, "sim.sys.carrier.base.pose")
    assert np.hypot(*(testbed.read(context, "dps.env.pose.position") - [x, y])) < 0.15
    assert testbed.read(context, "dps.env.pedometer.steps") >= 4.0
    # A mental copy begins where the unit believes itself to be, with the worker behind it.
    testbed.start_from_belief(context)
    believed = testbed.read(context, "sim.sys.carrier.base.pose")
    assert np.hypot(*(believed[:2] - [x, y])) < 0.2
    worker = testbed.read(context, "sim.act.legs.position")
    assert np.hypot(*(worker - believed[:2])) == pytest.approx(0.45, abs=1e-6)
    assert testbed.read(context, "sim.act.legs.speed") == pytest.approx(1.0, abs=0.3)
