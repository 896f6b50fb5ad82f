"""Ctrl-C and SIGTERM: while Drake runs, while a machine is brought to rest, and in a program that has no handler."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, Self


class Interruptible:
    """A context manager that raises an exception of a handler of SIGINT or SIGTERM again if it got lost.

    Python raises KeyboardInterrupt wherever its main thread is. While pybind11 converts an argument (numpy makes an
    array of a list, for example) it drops that exception, and reports arguments that do not fit (TypeError) or tries
    the next overload; and Python drops exceptions of finalizers. With a controller that writes its output at every step
    about one Ctrl-C of 25 is lost in this way, and the failed call would be taken for a failed simulation.

    Nothing happens outside the main thread, where no handler runs, and for a signal without a handler.
    """

    def __init__(self) -> None:
        self._handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}
        self._raised: BaseException | None = None

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                handler = signal.getsignal(number)
                if callable(handler):
                    self._handlers[number] = handler
                    signal.signal(number, self._handle)
        return self

    def _handle(self, number: int, frame: FrameType | None) -> None:
        try:
            self._handlers[number](number, frame)
        except BaseException as error:
            self._raised = error
            # At once: this may be raised at the end of the block, before `__exit__` restores the handlers.
            self._restore()
            raise

    def _restore(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def raise_interrupt(self) -> None:
        """Raise the exception of the signal handler, if any; long operations call this from time to time."""
        if self._raised is not None:
            raise self._raised

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._restore()
        if error is not self._raised:
            self.raise_interrupt()


@contextmanager
def interrupts_postponed() -> Iterator[list[int]]:
    """Within the block, keep SIGINT and SIGTERM that have a handler; their handlers run at its end.

    Yields the numbers of the signals that have come. Nothing happens outside the main thread.
    """
    handlers: dict[int, Any] = {}
    arrived: list[int] = []
    try:
        if threading.current_thread() is threading.main_thread():
            for which in (signal.SIGINT, signal.SIGTERM):
                if callable(handler := signal.getsignal(which)):
                    handlers[which] = handler
                    signal.signal(which, lambda number, frame: arrived.append(number))
        yield arrived
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
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
