"""The main program of a worker process: tasks and points in, results out, through the socket that it inherits."""

from __future__ import annotations

import pickle
import sys
from multiprocessing.connection import Connection
from typing import Any

from vtbdrake.rollout.runner import RolloutRunner


def serve(connection: Connection) -> None:
    """Answers until the other end closes, which it also does by dying.

    A task (T) has no answer. A rollout (R) has two: None when it begins, then (its index, its result or an exception).
    """
    runner: RolloutRunner | None = None
    trouble: BaseException | None = None
    while True:
        try:
            message = connection.recv_bytes()
            kind, content = message[:1], message[1:]
            if kind == b"T":
                runner, trouble = None, None
                try:
                    runner = RolloutRunner(pickle.loads(content))
                except (Exception, SystemExit) as error:  # A failed assertion inside Drake arrives as SystemExit.
                    trouble = error
            else:
                index, parameters = pickle.loads(content)
                connection.send_bytes(pickle.dumps(None))
                connection.send_bytes(_answer(runner, trouble, index, parameters))
        except (EOFError, OSError):
            return


def _answer(
    runner: RolloutRunner | None, trouble: BaseException | None, index: int, parameters: dict[str, Any]
) -> bytes:
    try:
        if runner is None:
            raise trouble or RuntimeError("a worker got a rollout before its task")
        result = runner.run(parameters)
    except (Exception, SystemExit) as error:
        return _pickled_error(index, error)
    try:
        return pickle.dumps((index, result))
    except Exception as error:
        remedy = f"a result cannot be sent from a worker process ({error}): record vectors, or use executor='serial'"
        return _pickled_error(index, TypeError(remedy))


def _pickled_error(index: int, error: BaseException) -> bytes:
    try:
        if isinstance(error, SystemExit):
            raise TypeError("an exit of the worker is an error of the main program")
        reply = pickle.dumps((index, error))
        pickle.loads(reply)  # Some exceptions pickle but cannot be read again.
    except Exception:
        reply = pickle.dumps((index, RuntimeError(f"{type(error).__name__}: {error}")))
    return reply


def main() -> None:
    connection = Connection(int(sys.argv[1]))
    connection.send_bytes(b"ready")
    serve(connection)
