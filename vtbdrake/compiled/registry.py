"""The equations by class of system."""

from __future__ import annotations

from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context, System
from pydrake.systems.primitives import PortSwitch

from vtbdrake.compiled.components import (
    BoardEquations,
    CasadiEquations,
    DriveEquations,
    JointSensorEquations,
    SplineEquations,
)
from vtbdrake.compiled.drake_systems import PortSwitchEquations, SymbolicEquations
from vtbdrake.compiled.equations import REMEDY, Equations, refusal
from vtbdrake.compiled.plant import PlantEquations
from vtbdrake.components.actuators import JointDrives
from vtbdrake.components.casadi_system import CasadiSystem
from vtbdrake.components.sensors import JointEncoders, JointTachometers
from vtbdrake.components.spline_command import SplineCommand
from vtbdrake.state.systems import is_python
from vtbdrake.testbed.switch import SwitchBoard

EQUATIONS: dict[type, type[Equations]] = {
    CasadiSystem: CasadiEquations,
    JointDrives: DriveEquations,
    JointEncoders: JointSensorEquations,
    JointTachometers: JointSensorEquations,
    MultibodyPlant: PlantEquations,
    PortSwitch: PortSwitchEquations,
    SplineCommand: SplineEquations,
    SwitchBoard: BoardEquations,
}
"""The equations of each class of systems, to which yours can be added: ``EQUATIONS[MySystem] = MyEquations``.

A class that is not here, and none of whose bases is, is compiled if Drake converts it to symbolic expressions.
"""


def equations_of(system: System, context: Context, varied: frozenset[str]) -> Equations:
    """Return the equations of a leaf system.

    Raises:
        UnsupportedTestbedError: There are none.
    """
    for kind in type(system).__mro__:
        if kind in EQUATIONS:
            return EQUATIONS[kind](system, context, varied)
    if is_python(system) and system.ToSymbolicMaybe() is None:
        raise refusal(system, f"is a LeafSystem in Python: {REMEDY}")
    return SymbolicEquations(system, context, varied)
