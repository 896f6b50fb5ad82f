"""The recorder of a control loop."""

from __future__ import annotations

import logging
import os
import time
import zlib
from collections.abc import Callable, Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Any

from pydrake.systems.framework import Context

from vtbdrake.common.child_process import ProcessStartError
from vtbdrake.common.closing import Closing
from vtbdrake.common.interrupt import interrupts_postponed
from vtbdrake.control.background_process import START_TIMEOUT, BackgroundProcess
from vtbdrake.control.fault import FaultKind
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle
from vtbdrake.recording.lcm_types.lcmt_vtb_digest import lcmt_vtb_digest
from vtbdrake.recording.lcm_types.lcmt_vtb_end import lcmt_vtb_end
from vtbdrake.recording.lcm_types.lcmt_vtb_fault import lcmt_vtb_fault
from vtbdrake.recording.lcm_types.lcmt_vtb_log import lcmt_vtb_log
from vtbdrake.recording.lcm_types.lcmt_vtb_state import lcmt_vtb_state
from vtbdrake.recording.log_codec import CycleWriter
from vtbdrake.recording.log_format import (
    CHANGE,
    DIGEST,
    DIGEST_SIZE,
    END,
    FAULT,
    LOG,
    STATE,
    CycleLayout,
    LogError,
    LoggedSignal,
    LogHeader,
    encode_changes,
    event,
    scenario_record,
    target_kind,
)
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.log_writer import write_log
from vtbdrake.state import snapshot as snapshots
from vtbdrake.state.archive import PRIVATE, new_file
from vtbdrake.state.codecs import abstract_state
from vtbdrake.state.systems import read_group, stateful_leaves
from vtbdrake.testbed import Scenario, Signal, VirtualTestbed
from vtbdrake.testbed.addressed import AddressedDiagram, is_dps
from vtbdrake.testbed.scenario_text import scenario_text

_log = logging.getLogger(__name__)

_MAX_HASHED = 1 << 14  # bytes of an array in a digest


class RecordingError(RuntimeError):
    """A recording that lacks cycles of the loop."""


class Recorder(Closing):
    """Records a loop to a file from now on, until it is closed; a context manager.

    The loop only forms the bytes; a worker process writes them. If that process dies, or the disk is full, the loop
    goes on: cycles that are not in the file are counted (`lost`), logged, and missing in the log as a whole.

    Starting takes some milliseconds: do it before `Runtime.run`, or in the loop's thread between two cycles. Until the
    worker process has started (`wait_until_ready`), what it should write waits for it.

    Args:
        runtime: The loop. A loop whose state a snapshot cannot hold is rejected, see Raises.
        path: Path of the file; by custom, it ends in ``.lcm``.
        overwrite: Whether to replace an existing file.
        digest_period: Period in seconds of the loop's cycles in which a digest of the DPS's state is recorded.
        backlog: Bytes that may wait for the worker process; cycles beyond that are lost.
        mode: Permissions of the file, as far as the umask leaves them. By default only its owner reads it: it has what
            a machine has measured and done.

    Attributes:
        path: Path of the file.

    Raises:
        OSError: The file cannot be written, or exists.
        ValueError: A replay could not repeat the loop exactly; the error says why.
    """

    def __init__(
        self,
        runtime: Runtime,
        path: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        digest_period: float = 1.0,
        backlog: int = 1 << 26,
        mode: int = PRIVATE,
    ) -> None:
        _check_recordable(runtime)
        if not digest_period >= runtime.period:
            raise ValueError(f"digest_period must be at least the period, {runtime.period} s, not {digest_period} s")
        self.path = Path(path)
        self._runtime = runtime
        self._clock = runtime.clock
        self._epoch = time.time() - self._clock.now()
        self._digest = StateDigest(runtime.target, runtime.context)
        self._digest_every = round(digest_period / runtime.period)
        header = _header(runtime)
        if header.of_main_module:
            _log.warning(
                "%s can be replayed by this script or notebook only, because it defines %s: put it into a module",
                self.path,
                header.scenario_name,
            )
        self._cycle = CycleWriter(CycleLayout(header.sense, header.act), runtime)
        self._events: list[bytes] = []
        self._count = 0
        self._faults: set[tuple[str | None, FaultKind]] = set()
        self._unwritten = 0
        self._missing: int | None = None
        self._recorded = 0
        self._last = runtime.cycles - 1
        self._warned = False
        self._closed = False
        text, target, utime = header.to_json(), runtime.target, self._utime()
        state = snapshots.take(target.diagram, runtime.context, target.variables()).to_bytes()
        fields = {"utime": utime, "size": len(state), "snapshot": state, "crc": _signed_crc(state)}
        first_events = [
            self._message_event(LOG, lcmt_vtb_log(), utime=utime, header=text, crc=_signed_crc(text.encode())),
            self._message_event(STATE, lcmt_vtb_state(), **fields),
        ]
        if overwrite and self.path.is_file():
            # A new file: processes that have mapped the old one keep it.
            self.path.unlink()
        try:
            new_file(self.path, mode)
        except FileExistsError:
            raise FileExistsError(
                f"{self.path} exists: record to another file, or remove it (Recorder(..., overwrite=True) does)"
            ) from None
        self._worker = BackgroundProcess(
            write_log, os.fspath(self.path.absolute()), name=f"the recorder of {self.path}", backlog=backlog
        )
        self._worker.post_frame(*first_events)
        self._next_tap: Callable[[str, bytes], None] | None = runtime.bridge.tap
        runtime.bridge.tap = self._tap
        runtime.watch(self)

    @property
    def lost(self) -> int:
        """Return the number of cycles that are not in the file; it is exact once the recorder is closed."""
        return self._worker.dropped + self._unwritten if self._missing is None else self._missing

    @property
    def pid(self) -> int:
        """Return the process id of the worker process."""
        return self._worker.pid

    def wait_until_ready(self, timeout: float = START_TIMEOUT) -> None:
        """Wait until the worker process has started.

        Raises:
            ProcessStartError: It has ended, or has not started within ``timeout`` seconds: nothing would be recorded.
        """
        if not self._worker.wait_until_ready(timeout):
            raise ProcessStartError(
                f"the process {self.pid}, which writes {self.path}, does not start within {timeout:g} s: nothing would "
                "be recorded; see its output above, and whether the computer is overloaded"
            )

    # -- in the loop

    def _utime(self) -> int:
        return int(1e6 * (self._epoch + self._clock.now()))

    def _event(self, channel: str, data: bytes, utime: int) -> bytes:
        self._count += 1
        return event(self._count - 1, utime, channel.encode(), data)

    def _message_event(self, channel: str, message: Any, **fields: Any) -> bytes:
        """Return the event of an LCM message after its fields have been set."""
        for name, value in fields.items():
            setattr(message, name, value)
        return self._event(channel, message.encode(), message.utime)

    def _tap(self, channel: str, data: bytes) -> None:
        if self._next_tap is not None:
            self._next_tap(channel, data)
        if self._closed:  # Another recorder that began later may still call this tap.
            return
        self._cycle.note_message(channel, self._count)
        self._events.append(self._event(channel, data, self._utime()))

    def __call__(self, cycle: Cycle) -> None:
        """Record a cycle, as a watcher of the runtime."""
        with self._runtime.uninterrupted:
            self._record(cycle)

    def _record(self, cycle: Cycle) -> None:
        utime = self._utime()
        if cycle.changes:
            for change in encode_changes(cycle.changes, cycle.number, utime):
                self._events.append(self._event(CHANGE, change.encode(), utime))
        faults = cycle.verdict.faults
        if faults or self._faults:
            self._add_faults(cycle, utime)
        if (cycle.number + 1) % self._digest_every == 0:
            fields = {"utime": utime, "number": cycle.number, "digest": self._digest()}
            self._events.append(self._message_event(DIGEST, lcmt_vtb_digest(), **fields))
            self._take_losses()
        self._events.append(self._cycle.event(cycle, self._count, utime, sum(map(len, self._events))))
        self._count += 1
        frame = b"".join(self._events)
        self._events.clear()
        self._recorded += 1
        self._last = cycle.number
        if not self._worker.post_frame(frame, zlib.crc32(frame).to_bytes(4, "big")):
            self._warn("its process does not take them")

    def _add_faults(self, cycle: Cycle, utime: int) -> None:
        """Record the faults if they are others than before."""
        faults = {(fault.signal, fault.kind) for fault in cycle.verdict.faults}
        if faults == self._faults:
            return
        self._faults = faults
        reasons = [fault.reason for fault in cycle.verdict.faults]
        fields = {"utime": utime, "number": cycle.number, "count": len(reasons), "reasons": reasons}
        self._events.append(self._message_event(FAULT, lcmt_vtb_fault(), **fields))

    def _take_losses(self) -> None:
        for data in self._worker.pop_frames():
            lost, _, reason = data.decode().partition(" ")
            self._unwritten = int(lost)
            self._warn(reason)

    def _warn(self, reason: str) -> None:
        if not self._warned:
            self._warned = True
            _log.error("cycles of the loop are not recorded in %s: %s", self.path, reason)

    # -- begin and end

    def close(self) -> None:
        """End the recording: write the pending events and count the lost ones.

        Call it in the loop's thread, or after the loop.
        """
        if self._closed:
            return
        with interrupts_postponed():  # Another Ctrl-C would lose the messages that were sent after the last cycle.
            self._closed = True
            self._runtime.unwatch(self)
            if self._runtime.bridge.tap == self._tap:
                self._runtime.bridge.tap = self._next_tap
            if self._events:
                self._worker.post_frame(*self._events)
                self._events.clear()
        # A process that is still starting has not written anything; then this makes room for the last frame.
        self._worker.wait_until_ready()
        self._worker.drain()
        self._take_losses()
        message = lcmt_vtb_end()
        message.utime, message.number, message.lost = self._utime(), self._last, self.lost
        message.crc = _signed_crc(message.encode()[:-4])
        self._worker.post_frame(self._event(END, message.encode(), message.utime))
        code = self._worker.close()
        self._take_losses()
        if code or self.lost:
            # Bytes on their way to a process that died are lost, too: count the cycles that arrived in the file.
            self._missing = self._recorded - self._num_arrived()
        if self.lost:
            _log.error("%d of %d cycles are not in %s", self.lost, self._recorded, self.path)

    def _num_arrived(self) -> int:
        try:
            return len(read_log(self.path))
        except (LogError, OSError):
            return 0


def _signed_crc(data: bytes) -> int:
    crc = zlib.crc32(data)
    return crc - (1 << 32) if crc >> 31 else crc  # Integers of LCM are signed.


def _check_recordable(runtime: Runtime) -> None:
    """Raise a ValueError if a replay could not repeat what this loop does from now on."""
    context, bridge, diagram = runtime.context, runtime.bridge, runtime.target.diagram
    if runtime.steps and context.num_continuous_states() and runtime.target.simulator_config.use_error_control:
        raise ValueError(
            f"the integrator has a memory of its first {runtime.steps} steps, which a replay would not have: start to "
            "record before the first step, or switch error control off"
        )
    for signal in runtime.target.interface.sense:
        if signal.is_vector:
            continue
        if signal.name not in bridge.channels:
            raise ValueError(
                f"sensor signal {signal.name} is abstract and is recorded by its raw messages, which "
                f"{type(bridge).__name__} does not have: make it a vector, or use a bridge with raw messages"
            )
        if bridge.sensed[signal.name].count or diagram.GetInputPort(f"real.sense.{signal.name}").HasValue(context):
            raise ValueError(
                f"sensor signal {signal.name} is abstract, and the message with its present value was not recorded: "
                "start to record before the bridge is opened"
            )


def _header(runtime: Runtime) -> LogHeader:
    def logged(signals: Sequence[Signal]) -> tuple[LoggedSignal, ...]:
        return tuple(LoggedSignal(signal.name, signal.size, signal.unit) for signal in signals)

    target, interface = runtime.target, runtime.target.interface
    return LogHeader(
        scenario=_scenario_text(target.scenario) if target.scenario else "",
        record=scenario_record(target.scenario),
        target=target_kind(target),
        sense=logged(interface.sense),
        act=logged(interface.act),
        commands=logged(interface.commands),
        period=runtime.period,
        start_time=runtime.start_time,
        steps=runtime.steps,
        first_cycle=runtime.cycles,
        initialized=runtime.initialized,
        idle=runtime.idle,
        pace=runtime.pace,
        positions=target.positions(runtime.context) if isinstance(target, VirtualTestbed) else {},
    )


def _scenario_text(scenario: Scenario) -> str:
    try:
        return scenario_text(scenario)
    except Exception as error:  # Drake's writer refuses types in many ways, failed assertions among them.
        _log.warning("YAML cannot hold the scenario, so a replay needs it as an argument: %r", error)
        return ""


class StateDigest:
    """A BLAKE2b digest of the DPS's state: all its numeric groups, and its abstract states as their codecs give them.

    An array beyond 16 KiB, such as an image, enters by name and shape only, so that the loop need not wait for it. The
    digest of the DPS alone and the digest of the DPS in its testbed are equal if their states are.

    Args:
        target: The testbed, or the DPS alone.
        context: The root context whose state is digested.
    """

    def __init__(self, target: AddressedDiagram, context: Context) -> None:
        self._parts = []
        for path, system, groups in stateful_leaves(target.diagram, context, only=is_dps):
            leaf_context = system.GetMyContextFromRoot(context)
            abstract = abstract_state(path, system, leaf_context)
            if groups or abstract:
                self._parts.append((leaf_context, groups, abstract))

    def __call__(self) -> bytes:
        """Return the digest of the present state, 16 bytes."""
        digest = blake2b(digest_size=DIGEST_SIZE)
        for leaf_context, groups, abstract in self._parts:
            for kind, index, _ in groups:
                digest.update(read_group(leaf_context, kind, index).tobytes())
            arrays = abstract.read(leaf_context)
            for key in sorted(arrays, key=_index_and_name):
                array = arrays[key]
                digest.update(f"{_index_and_name(key)[1]}{array.shape}".encode())
                if array.nbytes <= _MAX_HASHED:
                    digest.update(array.tobytes())
        return digest.digest()


def _index_and_name(key: str) -> tuple[int, str]:
    index, _, name = key.partition("/")
    return int(index), name
