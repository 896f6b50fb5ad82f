"""Raises a Ctrl-C again that pydrake has dropped.

Fault: while pybind11 converts an argument (numpy makes an array of a list, for example) it drops any exception, also
the KeyboardInterrupt that Python raises wherever its main thread is, and reports arguments that do not fit (TypeError)
or tries the next overload. Issue: https://github.com/pybind/pybind11/issues/2862
"""

from __future__ import annotations

from functools import partial
from types import FrameType, TracebackType
from typing import Self

from vtbdrake.common.interrupt import Handler, Uninterrupted, restore_handlers, set_handlers, signal_handlers


class Interruptible:
    """A context manager that raises an exception of a handler of SIGINT, SIGTERM or SIGHUP again if it got lost.

    Python itself drops exceptions of finalizers, too. With a controller that writes its output at every step about one
    Ctrl-C of 25 is lost in one of these ways, and the failed call would be taken for a failed simulation.

    Nothing happens outside the main thread, where no handler runs, and for a signal without a handler.

    Attributes:
        uninterrupted: A context manager, to be used within the block: signals that arrive in it are handled at its end.
            For a few quick steps that belong together.
    """

    def __init__(self) -> None:
        self._handlers: dict[int, Handler] = {}
        self._raised: BaseException | None = None
        self.uninterrupted = Uninterrupted()

    def __enter__(self) -> Self:
        self._handlers, self._raised = signal_handlers(), None
        set_handlers(dict.fromkeys(self._handlers, self._handle))
        return self

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.uninterrupted.postpones(partial(self._handle, number, frame)):
            return
        try:
            self._handlers[number](number, frame)
        except BaseException as error:
            self._raised = error
            # At once: this may be raised at the end of the block, before `__exit__` restores the handlers.
            restore_handlers(self._handlers)
            raise

    def raise_interrupt(self) -> None:
        """Raise the exception of the signal handler, if any; long operations call this from time to time."""
        if self._raised is not None:
            raise self._raised

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        restore_handlers(self._handlers)
        if error is not self._raised:
            self.raise_interrupt()
