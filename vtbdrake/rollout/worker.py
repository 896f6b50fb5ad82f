"""The main program of a worker process: tasks and points in, results out, through the socket that it inherits."""

from __future__ import annotations

import os
import pickle
import resource
import socket
from collections.abc import Callable
from functools import cache, partial
from math import inf
from multiprocessing.connection import Connection
from typing import Any

from vtbdrake.child_process import report_ready
from vtbdrake.pickling import dumps
from vtbdrake.rollout.blob import unpack
from vtbdrake.rollout.runner import Runners, Testbeds
from vtbdrake.rollout.task import RolloutResult, RolloutTask

# What a worker says besides its answers: the rollout of limited time begins; its memory has grown too much.
BEGUN, GROWN = b"B", b"G"


def serve(connection: Connection, runners: Runners, *, growth: float = inf) -> None:
    """Answer requests until the other end closes, which it also does when its process dies.

    A task (T) has no answer. A rollout (R) has one: (its index, its result or an exception). One of limited time (L)
    has `BEGUN` before it, unless no testbed can be had for it. Once, `GROWN` comes before an answer.

    Args:
        growth: by how many bytes the memory may grow after the first rollout.
    """
    load: Callable[[], RolloutTask] | None = None
    limit = inf
    while True:
        try:
            message = connection.recv_bytes()
            kind, content = message[:1], message[1:]
            if kind == b"T":
                # The same task each time, for its runner is known by it; what cannot be read raises each time.
                load = cache(partial(unpack, content))
                continue
            index, point = pickle.loads(content)
            assert load is not None, "a worker got a rollout before its task"
            begin = partial(connection.send_bytes, BEGUN) if kind == b"L" else None
            reply = answer(index, partial(_rollout, runners, load, point, begin))
            if limit == inf:
                limit = _memory() + growth
            elif _memory() > limit:
                connection.send_bytes(GROWN)
                limit = growth = inf
            connection.send_bytes(reply)
        except (EOFError, OSError):
            return


def _memory() -> float:
    """Return how much memory this process holds, in bytes; without /proc, the most that it ever held."""
    try:
        with open("/proc/self/statm", "rb") as file:
            return float(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        # On Linux this would not do: there a process inherits the most that the one that started it ever held.
        return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def _rollout(
    runners: Runners, load: Callable[[], RolloutTask], point: bytes, begin: Callable[[], Any] | None
) -> RolloutResult:
    return runners.run(load(), unpack(point), begin=begin)


def answer(index: int, rollout: Callable[[], RolloutResult]) -> bytes:
    """(index, the result of ``rollout`` or the exception that it raised), pickled so that it can be read again."""
    try:
        result = rollout()
    except (Exception, SystemExit) as error:  # A failed assertion inside Drake arrives as SystemExit.
        return _pickled_error(index, error)
    try:
        return _bytes((index, result))
    except Exception as error:
        remedy = f"a result cannot be sent from a worker process ({error}): record vectors, or use executor='serial'"
        return _pickled_error(index, TypeError(remedy))


def _bytes(answer: tuple[int, Any]) -> bytes:
    try:
        return pickle.dumps(answer)
    except Exception:  # Of a class that the main program defines: it goes back as it came.
        return dumps(answer)


def _pickled_error(index: int, error: BaseException) -> bytes:
    try:
        if isinstance(error, SystemExit):
            raise TypeError("an exit of the worker is an error of the main program")
        reply = _bytes((index, error))
        pickle.loads(reply)  # Some exceptions pickle but cannot be read again.
    except Exception:
        reply = pickle.dumps((index, RuntimeError(f"{type(error).__name__}: {error}")))
    return reply


def main(connection: socket.socket, kept: int, growth: float) -> None:
    """Run a worker process until it is killed.

    Args:
        connection: the connection to its executor.
        kept: the number of testbeds that it keeps.
        growth: see `serve`.
    """
    report_ready(connection)
    serve(Connection(connection.detach()), Runners(Testbeds(kept=kept)), growth=growth)
