"""Sensors of a floating base, compiled."""

from __future__ import annotations

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.compiled import CompiledRollouts
from vtbdrake.components.sensors import BasePoseSensor, BaseTwistSensor, ErrorModel
from vtbdrake.state.systems import collect

PERIOD = 0.01  # s


def test_noisy_sensors_of_a_tumbling_body_are_as_in_drake() -> None:
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", MultibodyPlant(PERIOD))
    plant.SetUseSampledOutputPorts(False)
    body = plant.AddRigidBody("body", SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.2, 0.3))
    plant.Finalize()
    errors = ErrorModel(noise=0.01, latency=2)
    for name, kind in (("pose", BasePoseSensor), ("twist", BaseTwistSensor)):
        sensor = builder.AddNamedSystem(name, kind(plant, body, period=PERIOD, errors=errors, stream=len(name)))
        builder.Connect(plant.get_state_output_port(), sensor.get_input_port())
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant.SetVelocities(plant.GetMyContextFromRoot(context), [1.0, 2.0, 3.0, 0.1, 0.2, 5.0])
    outputs = ["plant.state", "pose.base_pose", "twist.base_twist"]
    rollouts = CompiledRollouts(
        diagram,
        collect(diagram),
        context,
        horizon=0.2,
        sample_period=PERIOD,
        outputs=outputs,
        compile=False,
        check=True,  # Compares with Drake.
    )
    state, pose, twist = (rollouts().outputs[address][0] for address in outputs)
    # Measured three samples before: a sample is shown in the next step, and has two steps of latency.
    measured = np.column_stack([pose, twist])[4:]
    differences = measured - state[1:-3]
    assert 0.005 < differences.std() < 0.015
