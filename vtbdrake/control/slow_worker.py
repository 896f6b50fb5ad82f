"""The other processes of a slow part: one that computes, and one that keeps it running; and how arrays travel."""

from __future__ import annotations

import pickle
import select
import struct
import time
import traceback
from math import inf
from typing import Any

from vtbdrake.control.worker_process import FrameConnection, WorkerProcess

# What comes back: the first of a message, before what it is about.
READY, RESULT, ERROR, LOST = "ready", "result", "error", "lost"

_COUNT = struct.Struct("<I")
_LENGTH = struct.Struct("<Q")


def keep(channel: FrameConnection, function: bytes, patience: float, name: str) -> None:
    """Keeps a process that computes, and passes requests and answers on.

    To end a process and to start one takes milliseconds that the loop does not have: so it is done from here.

    Args:
        function: see `serve`.
        patience: in seconds; who takes longer for an answer is ended.
        name: of the slow part.
    """
    while True:
        begin = time.monotonic()
        worker = WorkerProcess(serve, function, name=f"the process of the slow part {name}")
        try:
            reason = _pass_on(channel, worker, patience)
        finally:
            worker.kill()
        channel.send(*pack((LOST, reason)))
        _pause(channel, begin + patience - time.monotonic())


def _pass_on(channel: FrameConnection, worker: WorkerProcess, patience: float) -> str:
    """Until the worker is lost; says how."""
    deadline = inf
    while True:
        left = None if deadline == inf else max(0.0, deadline - time.monotonic())
        full = [worker.fileno()] if worker.unsent else []
        readable, _, _ = select.select([channel.fileno(), worker.fileno()], full, [], left)
        if channel.fileno() in readable:
            worker.post(channel.receive())
            deadline = time.monotonic() + patience
        worker.flush()
        for answer in worker.take():
            channel.send(answer)
            deadline = inf
        if not worker.alive:
            return f"died (exit code {worker.close(patience)})"
        if time.monotonic() > deadline:
            return f"did not answer within {patience:g} s"


def _pause(channel: FrameConnection, seconds: float) -> None:
    """A process that dies at its start must not be started all the time."""
    if seconds > 0.0:
        try:
            channel.receive(seconds)
        except TimeoutError:
            return


def serve(channel: FrameConnection, function: bytes) -> None:
    """Computes: says that it is ready, then answers every request (tick, arrays) by (tick, arrays) or (tick, the error
    as text).

    Args:
        function: a `SlowFunction`, by cloudpickle.
    """
    compute = pickle.loads(function)
    channel.send(*pack((READY, None)))
    while True:
        tick, arrays = unpack(channel.receive())
        try:
            answer = RESULT, (tick, compute(arrays))
        except Exception:
            answer = ERROR, (tick, traceback.format_exc())
        channel.send(*pack(answer))


def pack(message: Any) -> list[Any]:
    """A message as parts of a frame; its arrays are parts of their own, which are not copied."""
    buffers: list[pickle.PickleBuffer] = []
    body = pickle.dumps(message, protocol=5, buffer_callback=buffers.append)
    raw = [buffer.raw() for buffer in buffers]
    lengths = [len(body), *(view.nbytes for view in raw)]
    return [_COUNT.pack(len(lengths)), *map(_LENGTH.pack, lengths), body, *raw]


def unpack(frame: bytes) -> Any:
    """The message in a frame; its arrays lie in the frame, and are read only."""
    (count,) = _COUNT.unpack_from(frame)
    position = _COUNT.size + count * _LENGTH.size
    parts = []
    for (length,) in _LENGTH.iter_unpack(memoryview(frame)[_COUNT.size : position]):
        parts.append(memoryview(frame)[position : position + length])
        position += length
    return pickle.loads(parts[0], buffers=parts[1:])
