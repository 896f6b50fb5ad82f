"""The recorder of a control loop: it writes down all that determined the DPS, and all that crossed the boundary."""

from __future__ import annotations

import logging
import os
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from vtbdrake.control.cycle import Cycle
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.worker_process import WorkerProcess
from vtbdrake.recording.changes import change_events
from vtbdrake.recording.cycle_writer import CycleWriter
from vtbdrake.recording.digest import StateDigest
from vtbdrake.recording.lcm_types.lcmt_vtb_digest import lcmt_vtb_digest
from vtbdrake.recording.lcm_types.lcmt_vtb_end import lcmt_vtb_end
from vtbdrake.recording.lcm_types.lcmt_vtb_fault import lcmt_vtb_fault
from vtbdrake.recording.lcm_types.lcmt_vtb_log import lcmt_vtb_log
from vtbdrake.recording.lcm_types.lcmt_vtb_state import lcmt_vtb_state
from vtbdrake.recording.log_format import CHANGE, DIGEST, END, FAULT, LOG, STATE, CycleLayout, LogError, event
from vtbdrake.recording.log_header import LogHeader
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.log_writer import Loss, write_log
from vtbdrake.recording.start import check_recordable
from vtbdrake.state import snapshot as snapshots

_log = logging.getLogger(__name__)


class Recorder:
    """Records a loop to a file from now on, until it is closed; a context manager.

    The loop only makes the bytes; another process writes them. When that process dies, or the disk is full, the loop
    goes on: what is not in the file is counted (`lost`), logged, and missing in the log in whole cycles.

    To begin takes some milliseconds: it is done before `Runtime.run`, or in the loop's thread between two cycles.

    Args:
        runtime: the loop. What a snapshot cannot hold of it is refused, see Raises.
        path: of the file; by custom, its name ends in ``.lcm``.
        overwrite: whether the file may exist.
        digest_period: how often, in seconds of the loop's cycles, a digest of the DPS's state is recorded.
        backlog: bytes that may wait for the other process; what is beyond them is lost.

    Attributes:
        path: of the file.

    Raises:
        OSError: the file cannot be written, or exists.
        ValueError: a replay could not repeat the loop exactly; it says why.
    """

    def __init__(
        self,
        runtime: Runtime,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        digest_period: float = 1.0,
        backlog: int = 1 << 26,
    ) -> None:
        check_recordable(runtime)
        if not digest_period >= runtime.period:
            raise ValueError(f"a digest is recorded once in {runtime.period} s or more, not in {digest_period} s")
        self.path = Path(path)
        self._runtime = runtime
        self._clock = runtime.clock
        self._epoch = time.time() - self._clock.now()
        self._digest = StateDigest(runtime.target, runtime.context)
        self._digest_every = round(digest_period / runtime.period)
        header = LogHeader.of(runtime)
        self._cycle = CycleWriter(CycleLayout(header.sense, header.act), runtime)
        self._events: list[bytes] = []
        self._count = 0
        self._faults: set[tuple[str | None, str]] = set()
        self._unwritten = 0
        self._missing: int | None = None
        self._recorded = 0
        self._last = runtime.cycles - 1
        self._told = False
        self._closed = False
        begin = [self._header_event(header), self._state_event()]
        if overwrite and self.path.is_file():
            # A new file: who has read the old one still has it open, and must not lose it under his hands.
            self.path.unlink()
        try:
            self.path.open("wb" if overwrite else "xb").close()
        except FileExistsError:
            raise FileExistsError(f"{self.path} exists: record to another file, or with overwrite=True") from None
        self._worker = WorkerProcess(
            write_log, os.fspath(self.path.absolute()), name=f"the recorder of {self.path}", backlog=backlog
        )
        self._worker.post(*begin)
        self._next_tap: Callable[[str, bytes], None] | None = runtime.bridge.tap
        runtime.bridge.tap = self._tap
        runtime.watch(self)

    @property
    def lost(self) -> int:
        """How many cycles (with their messages) are not in the file; exact once the recorder is closed."""
        return self._worker.dropped + self._unwritten if self._missing is None else self._missing

    @property
    def pid(self) -> int:
        """Of the process that writes."""
        return self._worker.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # -- in the loop

    def _utime(self) -> int:
        return int(1e6 * (self._epoch + self._clock.now()))

    def _add(self, channel: str, data: bytes, utime: int) -> None:
        self._events.append(event(self._count, utime, channel.encode(), data))
        self._count += 1

    def _tap(self, channel: str, data: bytes) -> None:
        if self._next_tap is not None:
            self._next_tap(channel, data)
        if self._closed:  # before another recorder that began later, and still calls it
            return
        self._cycle.hear(channel, self._count)
        self._add(channel, data, self._utime())

    def __call__(self, cycle: Cycle) -> None:
        """Records a cycle; the runtime calls it."""
        utime = self._utime()
        if cycle.changes:
            for message in change_events(cycle.changes, cycle.number, utime):
                self._add(CHANGE, message.encode(), utime)
        faults = cycle.verdict.faults
        if faults or self._faults:
            self._note(cycle, utime)
        if (cycle.number + 1) % self._digest_every == 0:
            self._add(DIGEST, self._digest_message(cycle.number, utime), utime)
            self._take_losses()
        self._events.append(self._cycle.event(cycle, self._count, utime, sum(map(len, self._events))))
        self._count += 1
        frame = b"".join(self._events)
        self._events.clear()
        self._recorded += 1
        self._last = cycle.number
        if not self._worker.post(frame, zlib.crc32(frame).to_bytes(4, "big")):
            self._tell("its process does not take them")

    def _note(self, cycle: Cycle, utime: int) -> None:
        """Faults are recorded when they begin and end."""
        faults = {(fault.signal, fault.kind) for fault in cycle.verdict.faults}
        if faults == self._faults:
            return
        self._faults = faults
        message = lcmt_vtb_fault()
        message.utime, message.number = utime, cycle.number
        message.reasons = [fault.reason for fault in cycle.verdict.faults]
        message.count = len(message.reasons)
        self._add(FAULT, message.encode(), utime)

    def _digest_message(self, number: int, utime: int) -> bytes:
        message = lcmt_vtb_digest()
        message.utime, message.number, message.digest = utime, number, self._digest()
        return bytes(message.encode())

    def _take_losses(self) -> None:
        for data in self._worker.take():
            loss = Loss.from_bytes(data)
            self._unwritten = loss.frames
            self._tell(loss.reason)

    def _tell(self, reason: str) -> None:
        if not self._told:
            self._told = True
            _log.error("cycles of the loop are not recorded in %s: %s", self.path, reason)

    # -- begin and end

    def _header_event(self, header: LogHeader) -> bytes:
        message = lcmt_vtb_log()
        message.utime = self._utime()
        message.header = header.to_json()
        message.crc = _signed_crc(message.header.encode())
        return self._single(LOG, message)

    def _state_event(self) -> bytes:
        runtime = self._runtime
        target = runtime.target
        message = lcmt_vtb_state()
        message.utime = self._utime()
        message.snapshot = snapshots.take(target.diagram, runtime.context, target.variables()).to_bytes()
        message.size = len(message.snapshot)
        message.crc = _signed_crc(message.snapshot)
        return self._single(STATE, message)

    def _single(self, channel: str, message: Any) -> bytes:
        self._add(channel, message.encode(), message.utime)
        return self._events.pop()

    def close(self) -> None:
        """Ends the recording, in the loop's thread or after the loop: what is under way is written, what is lost is
        counted."""
        if self._closed:
            return
        self._closed = True
        self._runtime.unwatch(self)
        if self._runtime.bridge.tap == self._tap:
            self._runtime.bridge.tap = self._next_tap
        # So that there is room for the last frame.
        self._worker.drain()
        self._take_losses()
        message = lcmt_vtb_end()
        message.utime, message.number, message.lost = self._utime(), self._last, self.lost
        message.crc = _signed_crc(message.encode()[:-4])
        self._events.append(self._single(END, message))
        self._worker.post(*self._events)
        self._events.clear()
        code = self._worker.close()
        self._take_losses()
        if code or self.lost:
            # What was on its way to a process that died is lost as well: the file tells what has arrived.
            self._missing = self._recorded - self._arrived()
        if self.lost:
            _log.error("%d of %d cycles are not in %s", self.lost, self._recorded, self.path)

    def _arrived(self) -> int:
        try:
            return len(read_log(self.path).numbers)
        except (LogError, OSError):
            return 0


def _signed_crc(data: bytes) -> int:
    crc = zlib.crc32(data)
    return crc - (1 << 32) if crc >> 31 else crc  # LCM's integers have a sign
