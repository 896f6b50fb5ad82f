"""Solvers of problem (18), behind one interface: ask for points, and be told how good they are."""

from vtbdrake.optimization.solvers.catalogue import known_solvers, make_solver
from vtbdrake.optimization.solvers.solver import Evaluation, Point, Solver, SolverError

__all__ = ["Evaluation", "Point", "Solver", "SolverError", "known_solvers", "make_solver"]
