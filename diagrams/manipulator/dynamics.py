"""The arm's kinematics and dynamics in CasADi: the model of its controllers.

The model is the controllers' own: an arm with a tool and nothing around it, with the numbers of `Arm`.
"""

from __future__ import annotations

import casadi
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint

from vtbdrake.components.compiled_plant import FrameMotion, PlantDynamics
from vtbdrake.components.compiled_plant.links import Expression
from vtbdrake_diagrams.manipulator.arm import GRAVITY, JOINT_NAMES, JOINTS, LINK_NAMES, Arm


class ArmDynamics:
    """Symbolic kinematics and dynamics of `Arm`, for joint positions q and velocities v of shape (7, 1)."""

    def __init__(self, arm: Arm | None = None) -> None:
        self.arm = arm or Arm()
        plant = _plant(self.arm)
        self._model = PlantDynamics(plant, plant.CreateDefaultContext())
        self._tip = plant.GetFrameByName("tip")

    def tip(self, q: Expression) -> FrameMotion:
        """Return pose and Jacobian of the tip T in the world."""
        return self._model.frame(self._tip, q)

    def tip_bias(self, q: Expression, v: Expression) -> Expression:
        """Return Jdot v, the [angular; linear] acceleration of the tip at constant joint velocities, in the world."""
        return self._model.frame_bias(self._tip, q, v)

    def inverse_dynamics(self, q: Expression, v: Expression, a: Expression, *, rotors: bool = True) -> Expression:
        """Return tau = M(q) a + C(q, v) v + g(q).

        With ``rotors``, M has their reflected inertia on its diagonal, and tau is the drives' torque; without, tau is
        what the joints' torque sensors see.
        """
        return casadi.densify(self._model.inverse_dynamics(q, v, a, rotors=rotors))

    def momentum(self, q: Expression, v: Expression) -> tuple[Expression, Expression]:
        """Return the momentum p = M(q) v of the links and dL/dq of their Lagrangian L = v' M v / 2 - U.

        Lagrange's equation is then dp/dt = dL/dq + tau, for the torques tau that act on the links.
        """
        return self._model.momentum(q, v, rotors=False)


def function(name: str, arguments: dict[str, Expression], results: dict[str, Expression]) -> casadi.Function:
    """Return a casadi.Function of named arguments, with common subexpressions eliminated."""
    dense = [casadi.densify(value) for value in results.values()]
    return casadi.Function(name, list(arguments.values()), dense, list(arguments), list(results), {"cse": True})


def _plant(arm: Arm) -> MultibodyPlant:
    """Return the arm on its base, with the tool, whose frame ``tip`` is T."""
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -GRAVITY])
    parent = plant.world_frame()
    for k in range(JOINTS):
        link = plant.AddRigidBody(LINK_NAMES[k], arm.link_inertia(k))
        mount = plant.AddFrame(FixedOffsetFrame(f"mount_{k}", parent, RigidTransform([0.0, 0.0, arm.offsets[k]])))
        joint = plant.AddJoint(RevoluteJoint(JOINT_NAMES[k], mount, link.body_frame(), arm.axes[k]))
        drive = plant.AddJointActuator(JOINT_NAMES[k], joint)
        drive.set_default_rotor_inertia(arm.rotor_inertias[k])
        drive.set_default_gear_ratio(arm.gear_ratio)
        parent = link.body_frame()
    tool = plant.AddRigidBody("tool", arm.tool_inertia())
    plant.WeldFrames(parent, tool.body_frame(), RigidTransform([0.0, 0.0, arm.lengths[-1]]))
    plant.AddFrame(FixedOffsetFrame("tip", tool.body_frame(), RigidTransform([0.0, 0.0, arm.tool_length])))
    plant.Finalize()
    return plant
