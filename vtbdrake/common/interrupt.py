"""Ctrl-C, SIGTERM and SIGHUP: while a machine is brought to rest, in a program without a handler.

A program whose Ctrl-C has to end it, whatever it does, calls `end_at_interrupt` first.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType
from typing import Any

Handler = Callable[[int, FrameType | None], Any]

# s from Ctrl-C to the end of a program at the latest.
_LONGEST_END = 2.5

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def signal_handlers() -> dict[int, Handler]:
    """Return the handlers of SIGINT, SIGTERM and SIGHUP, of those that have one; none outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    handlers = {number: signal.getsignal(number) for number in _SIGNALS}
    return {number: handler for number, handler in handlers.items() if callable(handler)}


def set_handlers(handlers: Mapping[int, Handler]) -> None:
    """Set handlers of signals, by number."""
    for number, handler in handlers.items():
        signal.signal(number, handler)


def restore_handlers(handlers: Mapping[int, Handler]) -> None:
    """Set handlers of signals again, all of them, also if the first one raises as soon as it is set."""
    try:
        set_handlers(handlers)
    except BaseException:  # What the first of them has raised, as soon as it was set: the others have to be set, too.
        set_handlers(handlers)
        raise


@contextmanager
def interrupts_postponed() -> Iterator[list[int]]:
    """Within the block, keep SIGINT, SIGTERM and SIGHUP that have a handler; their handlers run at its end.

    Yields the numbers of the signals that have come. Nothing happens outside the main thread.
    """
    handlers, arrived = signal_handlers(), list[int]()
    try:
        set_handlers(dict.fromkeys(handlers, lambda number, _: arrived.append(number)))
        yield arrived
    finally:
        restore_handlers(handlers)
        if arrived:
            signal.raise_signal(arrived[0])


class Uninterrupted:
    """A context manager for a few quick steps that belong together: signals that come in it are handled at its end.

    Handlers of signals ask `postpones` first. It may be entered again within itself.
    """

    def __init__(self) -> None:
        self._depth = 0
        self._postponed: list[Callable[[], object]] = []

    def postpones(self, handle: Callable[[], object]) -> bool:
        """Return whether a signal is handled later; ``handle`` is what is called then."""
        if self._depth:
            self._postponed.append(handle)
        return self._depth > 0

    def __enter__(self) -> None:
        self._depth += 1

    def __exit__(self, *_: object) -> None:
        self._depth -= 1
        if self._postponed and not self._depth:
            handle = self._postponed[0]
            self._postponed.clear()
            handle()


@contextmanager
def termination_interrupts() -> Iterator[None]:
    """Within the block, SIGTERM and SIGHUP raise KeyboardInterrupt, as Ctrl-C does, where they would kill the process.

    Nothing happens outside the main thread, or for a signal that the program handles or ignores.
    """
    deadly = []
    if threading.current_thread() is threading.main_thread():
        deadly = [n for n in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(n) is signal.SIG_DFL]
    try:
        for number in deadly:
            signal.signal(number, signal.default_int_handler)
        yield
    finally:
        for number in deadly:
            signal.signal(number, signal.SIG_DFL)


class _InterruptedProgram:
    """What Ctrl-C does to this process, if it is a program that Ctrl-C ends."""

    def __init__(self) -> None:
        self.pending = False  # Ctrl-C has come, and nothing has taken it yet.
        self._has_come = False
        self._descriptor = -1

    def start(self, code: int) -> None:
        from vtbdrake.common import exit_guard

        if self._descriptor < 0:
            reader, self._descriptor = os.pipe()
            os.set_blocking(self._descriptor, False)
            exit_guard.start(reader, _LONGEST_END, code)
        signal.set_wakeup_fd(self._descriptor, warn_on_full_buffer=False)
        signal.signal(signal.SIGINT, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.pending = self._has_come = True
        signal.default_int_handler(number, frame)

    def release(self) -> None:
        self.pending = False
        if self._descriptor >= 0:
            from vtbdrake.common import exit_guard

            exit_guard.release()

    def leave(self) -> None:
        if self._descriptor >= 0:
            signal.set_wakeup_fd(-1)
            self.release()

    def set_code(self, code: int) -> None:
        if self._descriptor >= 0:
            from vtbdrake.common import exit_guard

            exit_guard.set_code(code)

    def end_now(self) -> None:
        if self._has_come:
            os.write(self._descriptor, bytes([signal.SIGINT]))


_PROGRAM = _InterruptedProgram()


def end_at_interrupt(code: int) -> None:
    """Let one Ctrl-C end this process within 3 s, whatever it does; for the main thread of a program.

    Ctrl-C raises KeyboardInterrupt, as always. Where that is not enough (a call of C++ that lasts, an exception that
    got lost, a thread that is waited for) the process ends without further ado; its child processes end with it. So it
    does after SIGTERM and SIGHUP, where they have a handler; else they end it at once. A program that is started with
    SIGINT ignored goes on ignoring it.

    Args:
        code: The exit code of such an end.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        _PROGRAM.start(code)


def is_interrupted() -> bool:
    """Return whether Ctrl-C has come after `end_at_interrupt`, and nothing has called `interrupt_taken` since then."""
    return _PROGRAM.pending


def interrupt_taken() -> None:
    """Let the process go on after Ctrl-C, for as long as it takes: it presents or saves what is finished."""
    _PROGRAM.release()


def end_soon_if_interrupted() -> None:
    """Let the process end within 3 s from now on, if Ctrl-C has come: it has presented what was finished."""
    _PROGRAM.end_now()


def ends_by_itself() -> None:
    """Leave it to this process from now on how it ends at Ctrl-C: it brings a machine to rest first, for example."""
    _PROGRAM.leave()


def ends_well() -> None:
    """Let Ctrl-C be the proper end of this process from now on, with the exit code 0."""
    _PROGRAM.set_code(0)
