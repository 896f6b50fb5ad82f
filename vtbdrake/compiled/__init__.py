"""A testbed as one compiled function: whole rollouts, its DPS included, without Drake and without Python."""

from vtbdrake.compiled.check import CompiledDifferenceError
from vtbdrake.compiled.equations import At, Draw, Equations, Fixed, Timing, UnsupportedTestbedError
from vtbdrake.compiled.registry import EQUATIONS
from vtbdrake.compiled.rollouts import CompiledBatch, CompiledRollouts
from vtbdrake.components.casadi_system.compiler import CompilerError

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
    "Timing",
    "UnsupportedTestbedError",
]
