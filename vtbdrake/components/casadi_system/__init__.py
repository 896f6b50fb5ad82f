"""Any `casadi.Function` as a system: controllers and estimators written in CasADi."""

from vtbdrake.components.casadi_system.compiler import CompilerError
from vtbdrake.components.casadi_system.kernel import clamp
from vtbdrake.components.casadi_system.system import CasadiSystem, CasadiSystem_

__all__ = ["CasadiSystem", "CasadiSystem_", "CompilerError", "clamp"]
