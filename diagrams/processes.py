"""One loop over processes for the cases of a study."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import TypeVar

from vtbdrake.rollout.executor import cores

_Case = TypeVar("_Case")
_Result = TypeVar("_Result")


def in_processes(
    function: Callable[[_Case], _Result], cases: Sequence[_Case], *, workers: int | None = None
) -> Iterator[tuple[_Case, _Result]]:
    """Yield each case with the function's result for it, in the order of the cases.

    Linear algebra has one thread in each process: several would compete for the cores, and round in another order, so
    that a plan of a solver may be another one.

    Args:
        function: A function of a module, which processes find by its name.
        cases: Its arguments.
        workers: Number of processes; None: one per core; 1: the calling process itself.
    """
    workers = min(workers or cores(), len(cases))
    if workers < 2:
        yield from ((case, function(case)) for case in cases)
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        with environment(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1"):  # The processes start in this call.
            results = pool.map(function, cases)
        yield from zip(cases, results, strict=True)


@contextmanager
def environment(**values: str) -> Iterator[None]:
    """Set variables of the environment, for processes that are started meanwhile."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
