"""Ctrl-C while Drake runs: an exception that pybind11 drops is raised again."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
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
