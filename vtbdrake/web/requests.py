"""Requests to threads: the result of one, or an error if the thread has ended."""

from __future__ import annotations

from concurrent.futures import Future, wait
from threading import Thread
from typing import TypeVar

_Result = TypeVar("_Result")

_PERIOD = 0.5  # s between two looks at whether the thread is alive


def result_of(future: Future[_Result], thread: Thread, ended: Exception) -> _Result:
    """Return the result of a request, which a thread sets.

    Args:
        future: The request.
        thread: The thread.
        ended: What is raised if the thread has ended without carrying it out.
    """
    while True:
        is_alive = thread.is_alive()  # Before the look at the result, which it may have set last.
        if wait([future], _PERIOD if is_alive else 0.0).done:
            return future.result()
        if not is_alive:
            raise ended
