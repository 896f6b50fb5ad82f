"""A testbed as one compiled function: whole rollouts, its DPS included, without Drake and without Python."""

from vtbdrake.compiled.agreement import CompiledDifferenceError
from vtbdrake.compiled.compiled_rollouts import CompiledBatch, CompiledRollouts
from vtbdrake.compiled.components import SensorEquations
from vtbdrake.compiled.equations import At, Draw, Equations, Fixed, Timing, UnsupportedTestbedError
from vtbdrake.compiled.registry import EQUATIONS
from vtbdrake.components.casadi_system.compiler import CompilerError
from vtbdrake.components.compiled_plant.contact import FixedPiece
from vtbdrake.components.compiled_plant.ground import Terrain

__all__ = [
    "EQUATIONS",
    "At",
    "CompiledBatch",
    "CompiledDifferenceError",
    "CompiledRollouts",
    "CompilerError",
    "Draw",
    "Equations",
    "Fixed",
    "FixedPiece",
    "SensorEquations",
    "Terrain",
    "Timing",
    "UnsupportedTestbedError",
]
