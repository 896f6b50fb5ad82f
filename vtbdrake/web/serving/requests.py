"""Requests to a thread, which alone may use something: a testbed, a Meshcat, a robot that is led."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from queue import Empty, SimpleQueue
from threading import Thread
from typing import TypeVar

from vtbdrake.common.failures import FAILURES

_log = logging.getLogger(__name__)

_Result = TypeVar("_Result")

LONGEST_END = 10.0
"""Time to wait for the end of a thread that is busy, in seconds."""

_PERIOD = 0.5  # s between two looks at whether the thread is alive


def wait_for_end(thread: Thread, name: str, *, end: Callable[[], object] = lambda: None) -> None:
    """Wait until a thread has ended, for 10 s at most: a daemon thread that hangs is left behind, which is logged.

    Args:
        thread: The thread, which has been told to end.
        name: What the log calls it, such as "the page's server".
        end: Called again and again while the thread runs, to end what it has begun meanwhile.
    """
    limit = time.monotonic() + LONGEST_END
    while thread.is_alive() and (left := limit - time.monotonic()) > 0.0:
        end()
        thread.join(min(left, _PERIOD))
    if thread.is_alive():
        _log.error(
            "%s does not end within %g s: its thread is left behind, and may keep a core busy until the program ends",
            *(name, LONGEST_END),
        )


class Requests:
    """Requests of other threads to a thread, which carries them out in their order when it looks for them.

    Args:
        error: What is raised where a thread is asked that has ended.
        ended: Its message.
        failure: Returns what is raised where somebody has asked, from what was raised in the thread.
    """

    def __init__(self, error: type[Exception], ended: str, failure: Callable[[BaseException], Exception]) -> None:
        self._error, self._ended, self._failure = error, ended, failure
        self._waiting: SimpleQueue[Callable[[], None] | None] = SimpleQueue()

    def ask(self, thread: Thread, action: Callable[[], _Result]) -> _Result:
        """Return the result of an action in the thread, or raise its failure.

        Args:
            thread: The thread that carries out requests.
            action: What it is to do, a function without arguments.
        """
        future = self.tell(action)
        while True:
            is_alive = thread.is_alive()  # Before the look at the result, which it may have set last.
            if wait([future], _PERIOD if is_alive else 0.0).done:
                return future.result()
            if not is_alive:
                raise self._error(self._ended)

    def tell(self, action: Callable[[], _Result]) -> Future[_Result]:
        """Let the thread carry out an action, without waiting for it."""
        future: Future[_Result] = Future()

        def carry_out() -> None:
            try:
                future.set_result(action())
            except FAILURES as error:
                future.set_exception(self._failure(error))

        self._waiting.put(carry_out)
        return future

    def end(self) -> None:
        """Let the thread end, when it has done what was asked before."""
        self._waiting.put(None)

    def carry_out(self, patience: float | None = None) -> bool:
        """Carry out what has been asked, in the thread; return whether it goes on.

        Args:
            patience: How long to wait for something to do, in seconds; None for as long as it takes.
        """
        try:
            while (action := self._waiting.get(timeout=patience)) is not None:
                action()
                patience = 0.0
        except Empty:
            return True
        return False
