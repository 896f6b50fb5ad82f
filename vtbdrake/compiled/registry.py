"""The equations by class of system."""

from __future__ import annotations

from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, System
from pydrake.systems.primitives import ConstantValueSource, PortSwitch, TrajectorySource

from vtbdrake.compiled.components import (
    BoardEquations,
    CasadiEquations,
    ContactEquations,
    DriveEquations,
    ForceTorqueEquations,
    ImuEquations,
    JointSensorEquations,
    JointTorqueEquations,
    SplineEquations,
)
from vtbdrake.compiled.drake_systems import (
    ConstantValueEquations,
    PortSwitchEquations,
    SymbolicEquations,
    TrajectoryEquations,
)
from vtbdrake.compiled.equations import REMEDY, Equations, refusal
from vtbdrake.compiled.plant import PlantEquations
from vtbdrake.components.actuators import JointDrives
from vtbdrake.components.casadi_system import CasadiSystem
from vtbdrake.components.sensors import (
    BasePoseSensor,
    BaseTwistSensor,
    ContactSensor,
    ForceTorqueSensor,
    Imu,
    JointEncoders,
    JointTachometers,
    JointTorqueSensors,
)
from vtbdrake.components.spline_command import SplineCommand
from vtbdrake.state.systems import is_python
from vtbdrake.testbed.switch import SwitchBoard

EQUATIONS: dict[type, type[Equations]] = {
    BasePoseSensor: JointSensorEquations,
    BaseTwistSensor: JointSensorEquations,
    CasadiSystem: CasadiEquations,
    ConstantValueSource: ConstantValueEquations,
    ContactSensor: ContactEquations,
    JointDrives: DriveEquations,
    ForceTorqueSensor: ForceTorqueEquations,
    Imu: ImuEquations,
    JointEncoders: JointSensorEquations,
    JointTachometers: JointSensorEquations,
    JointTorqueSensors: JointTorqueEquations,
    MultibodyPlant: PlantEquations,
    PortSwitch: PortSwitchEquations,
    SplineCommand: SplineEquations,
    SwitchBoard: BoardEquations,
    TrajectorySource: TrajectoryEquations,
}
"""The equations of each class of systems, to which others can be added: ``EQUATIONS[TheirSystem] = MyEquations``.

A system of your own may rather have a method ``compiled_equations(context, varied)`` that returns them. A class that is
not here is compiled if Drake converts it to symbolic expressions.
"""


def equations_of(system: System, context: Context, varied: frozenset[str]) -> Equations:
    """Return the equations of a leaf system.

    Args:
        system: The leaf system.
        context: Its own context, with the values that are compiled in.
        varied: Names within the system of the variables that will be varied, and so stay arguments.

    Raises:
        UnsupportedTestbedError: There are none.
    """
    if hasattr(system, "compiled_equations"):
        equations: Equations = system.compiled_equations(context, varied)
        return equations
    # A subclass may compute something else.
    if type(system) in EQUATIONS:
        return EQUATIONS[type(system)](system, context, varied)
    if is_python(system) and system.ToSymbolicMaybe() is None:
        raise refusal(system, f"is a LeafSystem in Python: {REMEDY}")
    return SymbolicEquations(system, context, varied)
