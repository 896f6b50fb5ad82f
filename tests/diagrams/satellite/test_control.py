"""The arm's controller alone, against the Jacobian of a plant."""

from __future__ import annotations

from math import exp

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from vtbdrake.common.arrays import Array
from vtbdrake.state.systems import collect
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, JOINT_NAMES, Servicer
from vtbdrake_diagrams.satellite.control import ArmController
from vtbdrake_diagrams.satellite.plant import add_servicer, arm_positions
from vtbdrake_diagrams.satellite.supervisor import Arrival, Mode

T = 0.02
Q = np.array([0.1, 0.9, -0.2, 1.8, 0.1, 0.8, 0.3])


def arm() -> tuple[RigidTransform, Array]:
    """The pose of the gripper in the base, and its Jacobian, with the joints at `Q`."""
    plant = MultibodyPlant(0.0)
    servicer = add_servicer(plant)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    positions = plant.GetPositions(context)
    positions[arm_positions(plant, servicer)] = Q
    plant.SetPositions(context, positions)
    B, G = plant.GetFrameByName("base"), plant.GetFrameByName("gripper")
    columns = [plant.GetJointByName(name).velocity_start() for name in JOINT_NAMES[:ARM_JOINTS]]
    J = plant.CalcJacobianSpatialVelocity(context, JacobianWrtVariable.kV, G, np.zeros(3), B, B)
    return G.CalcPose(context, B), J[:, columns]


class Bench:
    """A controller whose arm stays at `Q`, with open fingers."""

    def __init__(
        self, mode: float, *, X_BH: RigidTransform, follows: bool, distance: float = 0.0, plan: Array | None = None
    ) -> None:
        builder = DiagramBuilder()
        system = builder.AddNamedSystem("controller", ArmController(period=T, plans=plan is not None))
        diagram = builder.Build()
        self.simulator = Simulator(diagram)
        self.root = self.simulator.get_mutable_context()
        self.variables = collect(diagram)
        context = system.GetMyMutableContextFromRoot(self.root)
        opening = Servicer().opening
        numbers = [(X.rotation().matrix().ravel(), X.translation()) for X in (X_BH, arm()[0])]
        values = {
            "relative": np.concatenate([[0.0, 1.0], *numbers[0], np.zeros(6), *numbers[1]]),
            "guidance": [mode, follows, distance, 0.0, opening, 0.0],
            "joint_position": [*Q, opening, opening],
        }
        if plan is not None:
            values |= {"arrival": [Arrival.PLANNED], "plan_position": plan}
        for name, value in values.items():
            system.GetInputPort(name).FixValue(context, value)
        self.set("joint_position", values["joint_position"])
        for name in ("posture_gain", "damping"):
            self.set(name, 0.0)

    def set(self, name: str, value: object) -> None:
        self.variables[f"controller.{name}"].set(self.root, value)

    def get(self, name: str) -> Array:
        return np.array(self.variables[f"controller.{name}"].get(self.root))

    def run(self, periods: int) -> None:
        self.simulator.AdvanceTo(self.root.get_time() + periods * T)


def test_gripper_moves_to_its_place_before_the_fixture() -> None:
    X_BG, J = arm()
    X_GD = RigidTransform(RollPitchYaw(0.02, -0.03, 0.01), [0.03, -0.01, 0.02])
    bench = Bench(Mode.APPROACH, X_BH=X_BG @ X_GD @ RigidTransform([0.0, 0.0, 0.25]), follows=True, distance=0.25)
    bench.run(1)
    turn = X_GD.rotation().ToAngleAxis()
    e_R = X_BG.rotation() @ (turn.angle() * turn.axis())
    e_p = X_BG.rotation() @ X_GD.translation()
    rates = bench.get("joint_rate_command")
    np.testing.assert_allclose(J @ rates, np.concatenate((e_R, e_p)), atol=1e-9)  # with gains of 1/s
    np.testing.assert_allclose(bench.get("joint_position")[:ARM_JOINTS], Q + T * rates, atol=1e-12)


def test_arm_is_led_along_a_plan_within_the_rates_of_its_drives() -> None:
    plan = Q + np.array([0.005, -0.005, 0.0, 0.1, 0.0, 0.0, 0.0])
    bench = Bench(Mode.APPROACH, X_BH=arm()[0], follows=False, plan=plan)
    bench.run(1)
    command = bench.get("joint_position")[:ARM_JOINTS]
    np.testing.assert_allclose(command - Q, [0.005, -0.005, 0.0, 0.01, 0.0, 0.0, 0.0], atol=1e-12)


def test_command_stays_near_the_arm() -> None:
    X_BG, _ = arm()
    bench = Bench(Mode.APPROACH, X_BH=X_BG @ RigidTransform([0.3, 0.0, 0.5]), follows=True)
    bench.run(300)
    assert np.abs(bench.get("joint_position")[:ARM_JOINTS] - Q).max() == pytest.approx(0.2, abs=1e-12)


def test_aborted_arm_backs_off_and_returns() -> None:
    X_BG, J = arm()
    bench = Bench(Mode.ABORT, X_BH=X_BG, follows=False)
    bench.set("back_off", 1.0)
    bench.run(40)
    away = np.concatenate((np.zeros(3), X_BG.rotation() @ [0.0, 0.0, -0.08]))
    np.testing.assert_allclose(J @ bench.get("joint_rate_command"), away, atol=1e-9)
    bench.run(20)
    command = bench.get("joint_position")[:ARM_JOINTS]
    bench.run(1)
    towards = np.clip(Servicer().stowed - command, -0.2, 0.2)  # half of the largest rate
    np.testing.assert_allclose(bench.get("joint_rate_command"), towards, atol=1e-12)


def test_rates_decay_in_the_retreat() -> None:
    X_BG, _ = arm()
    bench = Bench(Mode.RETREAT, X_BH=X_BG, follows=False)
    before = np.linspace(-0.3, 0.3, ARM_JOINTS)
    bench.set("joint_rate_command", before)
    bench.run(9)
    np.testing.assert_allclose(bench.get("joint_rate_command"), exp(-9 * T / 1.5) * before, rtol=1e-12)


def test_arm_waits_at_rest() -> None:
    X_BG, _ = arm()
    bench = Bench(Mode.WAIT, X_BH=X_BG @ RigidTransform(RotationMatrix(), [0.1, 0.0, 0.0]), follows=False)
    bench.set("joint_rate_command", np.full(ARM_JOINTS, 0.1))
    bench.run(5)
    np.testing.assert_array_equal(bench.get("joint_rate_command"), np.zeros(ARM_JOINTS))
    np.testing.assert_array_equal(bench.get("joint_position")[:ARM_JOINTS], Q)
