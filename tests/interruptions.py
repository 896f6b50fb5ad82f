"""Ctrl-C at every place of a loop, one after the other, by a trace function."""

from __future__ import annotations

import dis
import faulthandler
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from types import CodeType, FrameType, ModuleType
from typing import Any

# CPython looks for signals behind these instructions.
_CHECKED = {"CALL", "CALL_KW", "CALL_FUNCTION_EX", "JUMP_BACKWARD", "RESUME"}
# In seconds. Whatever takes longer hangs: nothing here takes more than a second.
_TOO_LONG = 60.0


@dataclass(frozen=True)
class Place:
    """An instruction of a function before which Ctrl-C can arrive, when it is reached for the nth time."""

    file: str
    function: str
    line: int
    instruction: int
    nth: int


def places(operation: Callable[[], Any], *modules: ModuleType, lines: bool = False) -> list[Place]:
    """Return where Ctrl-C can arrive during the operation in the code of some modules.

    Each instruction counts twice: when it is reached for the first and for the last time. With ``lines``, each line
    counts once.
    """
    reached: dict[tuple[str, str, int, int], int] = {}

    def count(place: Place) -> None:
        key = (place.file, place.function, place.line, place.instruction)
        reached[key] = max(place.nth, reached.get(key, 0))

    with _traced(modules, count):
        operation()
    if lines:
        firsts = {(file, line): (file, function, line, i) for file, function, line, i in reversed(list(reached))}
        return [Place(*key, 1) for key in firsts.values()]
    return [Place(*key, nth) for key, last in reached.items() for nth in dict.fromkeys((1, last))]


def interrupt(operation: Callable[[], Any], *modules: ModuleType, at: Place) -> KeyboardInterrupt | None:
    """Run the operation with Ctrl-C at a place; return the exception, if the place was reached and it came out."""

    def press(place: Place) -> None:
        if place == at:
            signal.raise_signal(signal.SIGINT)  # It is postponed where the code postpones it.

    with hanging_fails(at), _traced(modules, press):
        try:
            operation()
        except KeyboardInterrupt as error:
            return error
    return None


@contextmanager
def hanging_fails(what: object) -> Iterator[None]:
    """Within the block, something that waits for ever is an AssertionError."""

    def handler(number: int, frame: FrameType | None) -> None:
        faulthandler.dump_traceback()
        raise AssertionError(f"it hangs: {what}")

    before = signal.signal(signal.SIGALRM, handler)
    signal.setitimer(signal.ITIMER_REAL, _TOO_LONG)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@cache
def _instructions(code: CodeType) -> dict[int, tuple[bool, int]]:
    """Return offset -> whether signals are looked for there, and where an exception there is handled, or -1."""
    bytecode = dis.Bytecode(code)
    ranges = [(entry.start, entry.end, entry.target) for entry in bytecode.exception_entries]  # type: ignore[attr-defined]
    handlers = {
        i.offset: next((target for start, end, target in ranges if start <= i.offset < end), -1) for i in bytecode
    }
    return {i.offset: (i.opname in _CHECKED, handlers[i.offset]) for i in bytecode}


@contextmanager
def _traced(modules: tuple[ModuleType, ...], visit: Callable[[Place], None]) -> Iterator[None]:
    """Within the block, call a function at each place of the modules that this thread reaches."""
    files = {module.__file__ for module in modules}
    last: dict[FrameType, tuple[bool, int]] = {}
    times: dict[tuple[CodeType, int], int] = {}

    def enter(frame: FrameType, event: str, argument: Any) -> Any:
        if frame.f_code.co_filename not in files:
            return None
        frame.f_trace_opcodes = True
        return step

    def step(frame: FrameType, event: str, argument: Any) -> Any:
        if event == "opcode":
            code, offset = frame.f_code, frame.f_lasti
            before, now = last.get(frame, (False, 0)), _instructions(code)[offset]
            last[frame] = now
            # A signal is handled at the end of the instruction before, with what is to be done there if one comes.
            if before == (True, now[1]):
                times[code, offset] = times.get((code, offset), 0) + 1
                visit(Place(code.co_filename, code.co_qualname, frame.f_lineno or 0, offset, times[code, offset]))
        return step

    tracer = sys.gettrace()
    sys.settrace(enter)
    try:
        yield
    finally:
        sys.settrace(tracer)
        last.clear()
