"""The processes of a slow part: a worker that computes, and a supervisor that restarts it.

The supervisor exists because it takes milliseconds to kill and to start a process, which the loop does not have. This
module needs no Drake, so that the supervisor starts quickly and stays small.
"""

from __future__ import annotations

import pickle
import select
import time
import traceback
from enum import StrEnum
from math import inf

from vtbdrake.common.frames import FrameConnection
from vtbdrake.control.background_process import BackgroundProcess


class SupervisorMessage(StrEnum):
    """The kinds of messages to the loop, which are pairs of a kind and its content."""

    READY = "ready"  # for the first request
    RESULT = "result"
    ERROR = "error"  # raised by the function
    LOST = "lost"  # the worker, which is replaced


def supervise(loop: FrameConnection, function: bytes, patience: float, name: str) -> None:
    """Keep a worker running, and forward requests and answers.

    Args:
        loop: The connection to the loop.
        function: See `compute`.
        patience: The time in seconds after which a worker that does not answer is replaced.
        name: The name of the slow part.
    """
    while True:
        begin = time.monotonic()
        worker = BackgroundProcess(compute, function, name=f"the worker of the slow part {name}")
        try:
            reason = _forward(loop, worker, patience)
        finally:
            worker.kill()
        loop.send((SupervisorMessage.LOST, reason))
        # A worker that dies at its start must not be restarted all the time.
        if (pause := begin + patience - time.monotonic()) > 0.0:
            try:
                loop.receive_frame(pause)
            except TimeoutError:
                continue


def _forward(loop: FrameConnection, worker: BackgroundProcess, patience: float) -> str:
    """Forward requests and answers until the worker is lost; return the reason."""
    deadline = inf
    while True:
        left = None if deadline == inf else max(0.0, deadline - time.monotonic())
        writable = [worker.fileno()] if worker.unsent else []
        readable, _, _ = select.select([loop.fileno(), worker.fileno()], writable, [], left)
        if loop.fileno() in readable:
            worker.post_frame(loop.receive_frame())
            deadline = time.monotonic() + patience
        worker.flush()
        for answer in worker.pop_frames():
            loop.send_frame(answer)
            deadline = inf
        if not worker.alive:
            return f"died (exit code {worker.close(patience)})"
        if time.monotonic() > deadline:
            return f"did not answer within {patience:g} s"


def compute(supervisor: FrameConnection, function: bytes) -> None:
    """Send READY, then answer every request (tick, arrays) by (tick, arrays) or (tick, traceback of the error).

    Args:
        supervisor: The connection to the supervisor.
        function: The pickled function of the slow part, from arrays to arrays; its ``prepare()`` is called once, first.
    """
    evaluate = pickle.loads(function)
    evaluate.prepare()
    supervisor.send((SupervisorMessage.READY, None))
    while True:
        tick, arrays = supervisor.receive()
        try:
            answer = SupervisorMessage.RESULT, (tick, evaluate(arrays))
        except Exception:
            answer = SupervisorMessage.ERROR, (tick, traceback.format_exc())
        supervisor.send(answer)
