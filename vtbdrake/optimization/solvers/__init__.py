"""Solvers of problem (18), with one interface: ask and tell."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from vtbdrake.common.argument_checks import as_number, as_whole
from vtbdrake.common.suggestions import did_you_mean
from vtbdrake.optimization.parameter import Dimension
from vtbdrake.optimization.solvers.auto import Auto
from vtbdrake.optimization.solvers.bayesian import Bayesian
from vtbdrake.optimization.solvers.cobyqa import Cobyqa
from vtbdrake.optimization.solvers.designs import Grid, LatinHypercube, RandomSearch, Sobol
from vtbdrake.optimization.solvers.drake_solvers import ALGORITHMS, Ipopt, Nlopt, Snopt
from vtbdrake.optimization.solvers.evolution import CmaEs, DifferentialEvolution
from vtbdrake.optimization.solvers.optuna_samplers import SAMPLERS, OptunaSolver
from vtbdrake.optimization.solvers.sampling import Cem, Mppi, PredictiveSampling
from vtbdrake.optimization.solvers.solver import Evaluation, Point, Search, Solver, SolverError

__all__ = ["CATALOGUE", "Evaluation", "Point", "Solver", "SolverError", "known_solvers", "make_solver", "solver_type"]

# All solvers by their names.
CATALOGUE: Mapping[str, type[Solver]] = {
    "auto": Auto,
    "grid": Grid,
    "sobol": Sobol,
    "latin-hypercube": LatinHypercube,
    "random": RandomSearch,
    "bayesian": Bayesian,
    "CMA-ES": CmaEs,
    "differential-evolution": DifferentialEvolution,
    "predictive-sampling": PredictiveSampling,
    "CEM": Cem,
    "MPPI": Mppi,
    **dict.fromkeys(SAMPLERS, OptunaSolver),
    "SNOPT": Snopt,
    "IPOPT": Ipopt,
    "COBYQA": Cobyqa,
    **dict.fromkeys(ALGORITHMS, Nlopt),
}


def known_solvers() -> tuple[str, ...]:
    """Return the names that `make_solver` takes; case and punctuation do not matter (CMA-ES, cmaes, cma_es)."""
    return tuple(CATALOGUE)


def solver_type(method: str | type[Solver]) -> type[Solver]:
    """Return the class of a solver that is given by its name or as a class.

    Raises:
        SolverError: There is no such solver.
    """
    return method if isinstance(method, type) and issubclass(method, Solver) else CATALOGUE[_find(method)]


def make_solver(
    name: str | type[Solver],
    space: Sequence[Dimension],
    *,
    objectives: int = 1,
    constraints: int = 0,
    seed: int = 0,
    budget: int | None = None,
    start: Point | None = None,
    parallel: int | None = None,
    **options: Any,
) -> Solver:
    """Return a solver for a problem.

    Args:
        name: One of `known_solvers`, or a class of your own, derived from `Solver`.
        space: The parameters.
        objectives: Number of values of an evaluation.
        constraints: Number of violations of an evaluation.
        seed: Seed of the solver's random numbers, in [0, 2^32).
        budget: The largest number of evaluations; None: until the solver converges, if it does.
        start: Where a local method starts; None: in the middle of the ranges.
        parallel: The number of points that are evaluated side by side; batches have at least as many.
        options: Options of the solver, see its class.

    Raises:
        SolverError: There is no such solver or option, or the solver cannot solve such a problem.
        ModuleNotFoundError: The solver needs a package that is not installed.
    """
    factory = solver_type(name)
    canonical = _find(name) if isinstance(name, str) else name.__name__
    allowed = _options(factory)
    for option, value in options.items():
        if option in allowed:
            options[option] = _checked(f"the option {option} of {canonical}", value, allowed[option])
        else:
            near = did_you_mean(option, allowed, count=1)
            raise SolverError(f"{canonical} has no option {option!r}{near}; it has {[*allowed]}")
    if not space and factory.needs_parameters:
        raise SolverError("there is no parameter to vary; give at least one, or take grid, which evaluates one point")
    search = Search(
        space=tuple(space),
        objectives=objectives,
        constraints=constraints,
        seed=seed,
        budget=budget,
        start=start,
        parallel=parallel,
    )
    return factory(search, name=canonical, **options)


@cache
def _options(kind: type[Solver]) -> dict[str, str]:
    """Return a solver's options with their types; cached, as a reasoner makes a solver for each decision."""
    parameters = inspect.signature(kind).parameters
    return {name: str(parameter.annotation) for name, parameter in parameters.items() if name not in ("search", "name")}


def _checked(name: str, value: Any, annotation: str) -> Any:
    """Return an option, after a check of those that are a number."""
    if value is None and annotation.endswith("| None"):
        return value
    check = {"int": as_whole, "float": as_number}.get(annotation.removesuffix(" | None"))
    try:
        return value if check is None else check(name, value)
    except (ValueError, OverflowError) as error:
        raise SolverError(str(error)) from None


def _find(name: object) -> str:
    if not isinstance(name, str):
        raise SolverError(f"a solver is given by its name, one of {', '.join(CATALOGUE)}, not by {name!r}")
    if name in CATALOGUE:
        return name
    names = {_plain(solver): solver for solver in CATALOGUE}
    if _plain(name) in names:
        return names[_plain(name)]
    near = difflib.get_close_matches(_plain(name), names, n=1, cutoff=0.5)
    hint = f"; did you mean {names[near[0]]!r}?" if near else "."
    raise SolverError(f"there is no solver {name!r}{hint} Known are: {', '.join(CATALOGUE)}")


def _plain(name: str) -> str:
    return "".join(character for character in name.lower() if character.isalnum())
