"""Ctrl-C and SIGTERM: while Drake runs, while a machine is brought to rest, and in a program that has no handler."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, Self

Handler = Callable[[int, FrameType | None], Any]


def _handlers() -> dict[int, Handler]:
    """Return the handlers of SIGINT and SIGTERM, of those that have one; none outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    return {number: handler for number, handler in handlers.items() if callable(handler)}


def _set(handlers: Mapping[int, Handler]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)


class Interruptible:
    """A context manager that raises an exception of a handler of SIGINT or SIGTERM again if it got lost.

    Python raises KeyboardInterrupt wherever its main thread is. While pybind11 converts an argument (numpy makes an
    array of a list, for example) it drops that exception, and reports arguments that do not fit (TypeError) or tries
    the next overload; and Python drops exceptions of finalizers. With a controller that writes its output at every step
    about one Ctrl-C of 25 is lost in this way, and the failed call would be taken for a failed simulation.

    Nothing happens outside the main thread, where no handler runs, and for a signal without a handler.
    """

    def __init__(self) -> None:
        self._handlers: dict[int, Handler] = {}
        self._raised: BaseException | None = None

    def __enter__(self) -> Self:
        self._handlers = _handlers()
        _set(dict.fromkeys(self._handlers, self._handle))
        return self

    def _handle(self, number: int, frame: FrameType | None) -> None:
        try:
            self._handlers[number](number, frame)
        except BaseException as error:
            self._raised = error
            # At once: this may be raised at the end of the block, before `__exit__` restores the handlers.
            _set(self._handlers)
            raise

    def raise_interrupt(self) -> None:
        """Raise the exception of the signal handler, if any; long operations call this from time to time."""
        if self._raised is not None:
            raise self._raised

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _set(self._handlers)
        if error is not self._raised:
            self.raise_interrupt()


@contextmanager
def interrupts_postponed() -> Iterator[list[int]]:
    """Within the block, keep SIGINT and SIGTERM that have a handler; their handlers run at its end.

    Yields the numbers of the signals that have come. Nothing happens outside the main thread.
    """
    handlers, arrived = _handlers(), list[int]()
    try:
        _set(dict.fromkeys(handlers, lambda number, _: arrived.append(number)))
        yield arrived
    finally:
        _set(handlers)
        if arrived:
            signal.raise_signal(arrived[0])


@contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Within the block, SIGTERM raises KeyboardInterrupt, as Ctrl-C does, where it would kill the process at once.

    Nothing happens outside the main thread, or if the program handles or ignores SIGTERM.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
