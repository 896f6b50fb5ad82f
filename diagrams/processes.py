"""One loop over processes for the cases of a study."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TypeVar

from vtbdrake.rollout.executor import cores

_Case = TypeVar("_Case")
_Result = TypeVar("_Result")


def in_processes(
    function: Callable[[_Case], _Result], cases: Sequence[_Case], *, workers: int | None = None
) -> Iterator[tuple[_Case, _Result]]:
    """Yield each case with the function's result for it, in the order of the cases.

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
        yield from zip(cases, pool.map(function, cases), strict=True)
