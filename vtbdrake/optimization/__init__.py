"""Section 4: problem (18), stated in five steps and solved."""

from vtbdrake.optimization.boundary import Boundary
from vtbdrake.optimization.parameter import Parameter
from vtbdrake.optimization.problem import Motion, Problem, ProblemRollout
from vtbdrake.optimization.sweep import Sweep

__all__ = ["Boundary", "Motion", "Parameter", "Problem", "ProblemRollout", "Sweep"]
