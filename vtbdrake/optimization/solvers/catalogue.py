"""All solvers by their names."""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from vtbdrake.optimization.parameter import Dimension
from vtbdrake.optimization.solvers.auto import Auto
from vtbdrake.optimization.solvers.bayesian import Bayesian
from vtbdrake.optimization.solvers.cmaes_solver import CmaEs
from vtbdrake.optimization.solvers.designs import Grid, LatinHypercube, RandomSearch, Sobol
from vtbdrake.optimization.solvers.drake_solvers import Ipopt, NloptDerivativeFree, NloptWithDerivatives, Snopt
from vtbdrake.optimization.solvers.nlopt_algorithms import DERIVATIVE_FREE, WITH_DERIVATIVES
from vtbdrake.optimization.solvers.optuna_samplers import SAMPLERS, OptunaSolver
from vtbdrake.optimization.solvers.scipy_solvers import DifferentialEvolution
from vtbdrake.optimization.solvers.search import Search
from vtbdrake.optimization.solvers.solver import Point, Solver, SolverError

CATALOGUE: Mapping[str, Callable[..., Solver]] = {
    "auto": Auto,
    "grid": Grid,
    "sobol": Sobol,
    "latin-hypercube": LatinHypercube,
    "random": RandomSearch,
    "bayesian": Bayesian,
    "CMA-ES": CmaEs,
    "differential-evolution": DifferentialEvolution,
    **dict.fromkeys(SAMPLERS, OptunaSolver),
    "SNOPT": Snopt,
    "IPOPT": Ipopt,
    **dict.fromkeys(DERIVATIVE_FREE, NloptDerivativeFree),
    **dict.fromkeys(WITH_DERIVATIVES, NloptWithDerivatives),
}


def known_solvers() -> tuple[str, ...]:
    """The names that `make_solver` takes; case and punctuation do not matter: CMA-ES, cmaes and cma_es are one."""
    return tuple(CATALOGUE)


def make_solver(
    name: str,
    space: Sequence[Dimension],
    *,
    objectives: int = 1,
    constraints: int = 0,
    seed: int = 0,
    budget: int | None = None,
    start: Point | None = None,
    **options: Any,
) -> Solver:
    """The solver of that name for a problem.

    Args:
        name: one of `known_solvers`, however written.
        space: the parameters.
        objectives: how many values an evaluation has.
        constraints: how many violations it has.
        seed: of its random numbers, in [0, 2^32).
        budget: how many evaluations it may ask for; None: until it ends by itself, if it does.
        start: where a method that starts at a point starts; None: in the middle of the ranges.
        options: of the solver, as its class says.

    Raises:
        SolverError: there is no such solver or option, or the solver cannot solve such a problem.
        ModuleNotFoundError: it needs a package that is not installed.
    """
    canonical = _find(name)
    factory = CATALOGUE[canonical]
    allowed = [option for option in inspect.signature(factory).parameters if option not in ("search", "name")]
    for option in options:
        if option not in allowed:
            raise SolverError(f"{canonical} has no option {option!r}{_nearest(option, allowed)}; it has {allowed}")
    search = Search(
        space=tuple(space), objectives=objectives, constraints=constraints, seed=seed, budget=budget, start=start
    )
    return factory(search, name=canonical, **options)


def _find(name: str) -> str:
    if not isinstance(name, str):
        raise SolverError(f"a solver is known by its name, unlike {name!r}; one of {', '.join(CATALOGUE)}")
    names = {_plain(known): known for known in CATALOGUE}
    if _plain(name) in names:
        return names[_plain(name)]
    near = difflib.get_close_matches(_plain(name), names, n=1, cutoff=0.5)
    hint = f"; did you mean {names[near[0]]!r}?" if near else ""
    raise SolverError(f"there is no solver {name!r}{hint} Known are: {', '.join(CATALOGUE)}")


def _plain(name: str) -> str:
    return "".join(character for character in name.lower() if character.isalnum())


def _nearest(word: str, known: Sequence[str]) -> str:
    near = difflib.get_close_matches(word, known, n=1)
    return f"; did you mean {near[0]!r}?" if near else ""
