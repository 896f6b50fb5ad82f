"""The main program of a worker process: tasks and points in, results out, through the socket that it inherits."""

from __future__ import annotations

import pickle
import signal
import sys
from multiprocessing.connection import Connection
from typing import Any

from vtbdrake.rollout.runner import RolloutRunner


def serve(connection: Connection) -> None:
    """Answers until the other end closes, which it also does by dying."""
    runner: RolloutRunner | None = None
    trouble: Exception | None = None
    while True:
        try:
            message = connection.recv_bytes()
        except (EOFError, OSError):
            return
        kind, content = message[:1], message[1:]
        if kind == b"T":
            runner, trouble = None, None
            try:
                runner = RolloutRunner(pickle.loads(content))
            except Exception as error:
                trouble = error
        else:
            connection.send_bytes(_reply(runner, trouble, pickle.loads(content)))


def _reply(runner: RolloutRunner | None, trouble: Exception | None, parameters: dict[str, Any]) -> bytes:
    try:
        if runner is None:
            raise trouble or RuntimeError("a worker got a rollout before its task")
        return pickle.dumps(runner.run(parameters))
    except Exception as error:
        try:
            reply = pickle.dumps(error)
            pickle.loads(reply)  # Some exceptions pickle but cannot be read again.
        except Exception:
            reply = pickle.dumps(RuntimeError(f"{type(error).__name__}: {error}"))
        return reply


def main() -> None:
    # Ctrl-C reaches the whole group of processes; the main one decides what it means.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    connection = Connection(int(sys.argv[1]))
    connection.send_bytes(b"ready")
    serve(connection)
