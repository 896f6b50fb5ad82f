"""Both satellites fly freely: conservation laws, and MuJoCo on the same masses."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.satellite.bodies import JOINT_NAMES, Servicer
from vtbdrake_diagrams.satellite.plant import add_servicer
from vtbdrake_diagrams.satellite.supervisor import Mode

TORQUES = np.array([2.0, -3.0, 1.5, 2.5, -1.0, 0.8, -0.5])


def momentum(plant: MultibodyPlant, context: Context) -> np.ndarray:
    """Angular momentum about the world's origin (N m s), then linear momentum (N s)."""
    return plant.CalcSpatialMomentumInWorldAboutPoint(context, np.zeros(3)).get_coeffs()


def servicer_alone(config: MultibodyPlantConfig) -> tuple[Diagram, MultibodyPlant]:
    """The servicer without servos, whose drives give constant torques."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(config, builder)
    add_servicer(plant, servos=False)
    plant.Finalize()
    source = builder.AddSystem(ConstantVectorSource(np.concatenate((TORQUES, np.zeros(2)))))
    builder.Connect(source.get_output_port(), plant.get_actuation_input_port())
    return builder.Build(), plant


def test_arm_motion_conserves_momentum() -> None:
    diagram, plant = servicer_alone(MultibodyPlantConfig(time_step=0.0))
    simulator = Simulator(diagram)
    ApplySimulatorConfig(SimulatorConfig(integration_scheme="runge_kutta3", accuracy=1e-8), simulator)
    own = plant.GetMyContextFromRoot(simulator.get_context())
    simulator.AdvanceTo(1.0)
    arm = plant.GetVelocities(own)[-9:]
    assert np.abs(arm).max() > 0.1
    np.testing.assert_allclose(momentum(plant, own), 0.0, atol=1e-6)


def test_capture_conserves_momentum_and_wheels_hold_the_attitude() -> None:
    turns = []
    for wheels in (False, True):
        testbed = SatelliteScenario(seed=1, tumble_deg=3.0, perception="pose_sensor", wheels=wheels).build()
        context = testbed.default_context()
        simulator = testbed.simulator(context)
        simulator.AdvanceTo(0.05)
        own = testbed.plant.GetMyContextFromRoot(context)
        before = momentum(testbed.plant, own)
        simulator.AdvanceTo(14.0)
        assert testbed.read(context, "dps.impl.supervisor.mode") == Mode.RETREAT  # With contact.
        # At a step of 10 ms the plant is accurate to the first order.
        for part in (slice(0, 3), slice(3, 6)):
            error = momentum(testbed.plant, own)[part] - before[part]
            assert np.linalg.norm(error) < 0.02 * np.linalg.norm(before[part])
        turns.append(testbed.plant.GetBodyByName("base").EvalPoseInWorld(own).rotation().ToAngleAxis().angle())
    assert turns[1] < 0.5 * turns[0]


def test_agrees_with_mujoco() -> None:
    mujoco = pytest.importorskip("mujoco")
    diagram, plant = servicer_alone(MultibodyPlantConfig(time_step=0.0))
    simulator = Simulator(diagram)
    ApplySimulatorConfig(SimulatorConfig(integration_scheme="runge_kutta3", accuracy=1e-9), simulator)
    own = plant.GetMyContextFromRoot(simulator.get_context())
    model = mujoco.MjModel.from_xml_string(mjcf(plant, own))
    data = mujoco.MjData(model)
    data.qpos[:] = plant.GetPositions(own)[[4, 5, 6, 0, 1, 2, 3, *range(7, 16)]]
    data.ctrl[:] = np.concatenate((TORQUES, np.zeros(2)))
    while data.time < 1.0 - 1e-9:
        mujoco.mj_step(model, data)
    simulator.AdvanceTo(1.0)
    q = plant.GetPositions(own)
    np.testing.assert_allclose(q[7:14], data.qpos[7:14], atol=1e-6)
    assert np.abs(q[7:14] - Servicer().stowed).max() > 0.1
    np.testing.assert_allclose(q[:4], data.qpos[3:7], atol=1e-6)
    np.testing.assert_allclose(q[4:7], data.qpos[:3], atol=1e-6)


def mjcf(plant: MultibodyPlant, context: Context) -> str:
    """The servicer for MuJoCo, from the masses, frames and axes of the plant in ``context``."""
    names = ["base", *(f"link_{k}" for k in range(1, 8)), "hand", "finger_left", "finger_right"]
    bodies = {name: plant.GetBodyByName(name) for name in names}
    parents = {name: before for before, name in pairwise(names)} | {"finger_right": "hand"}
    joints = {plant.GetJointByName(name).child_body().name(): plant.GetJointByName(name) for name in JOINT_NAMES}
    zero = plant.CreateDefaultContext()
    q = plant.GetPositions(zero)
    q[7:] = 0.0
    plant.SetPositions(zero, q)

    def numbers(values: object) -> str:
        return " ".join(f"{v:.17g}" for v in np.ravel(values))

    def element(name: str) -> str:
        body = bodies[name]
        M = body.CalcSpatialInertiaInBodyFrame(zero)
        com = M.get_com()
        J = M.Shift(com).CalcRotationalInertia().CopyToFullMatrix3()
        inertia = numbers([J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]])
        inertial = f'<inertial pos="{numbers(com)}" mass="{M.get_mass():.17g}" fullinertia="{inertia}"/>'
        if name == "base":
            X, joint = RigidTransform(), "<freejoint/>"
        else:
            X = body.body_frame().CalcPose(zero, bodies[parents[name]].body_frame())
            joint = ""
        if name in joints:
            found = joints[name]
            slides = name.startswith("finger")
            axis = found.translation_axis() if slides else found.revolute_axis()
            kind = "slide" if slides else "hinge"
            joint = f'<joint name="{found.name()}" type="{kind}" axis="{numbers(axis)}"/>'
        below = "".join(element(child) for child, parent in parents.items() if parent == name)
        pose = f'pos="{numbers(X.translation())}" quat="{numbers(X.rotation().ToQuaternion().wxyz())}"'
        return f'<body name="{name}" {pose}>{joint}{inertial}{below}</body>'

    motors = "".join(f'<motor joint="{name}"/>' for name in JOINT_NAMES)
    option = '<option gravity="0 0 0" timestep="0.001" integrator="RK4"><flag contact="disable"/></option>'
    return f"<mujoco>{option}<worldbody>{element('base')}</worldbody><actuator>{motors}</actuator></mujoco>"
