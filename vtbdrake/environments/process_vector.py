"""Many environments on worker processes: for testbeds that cannot be compiled."""

from __future__ import annotations

import pickle
import socket
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from vtbdrake.common.arrays import Array
from vtbdrake.common.child_process import ChildProcess, report_ready
from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.common.frames import FrameConnection
from vtbdrake.environments.env import TestbedEnv
from vtbdrake.environments.episodes import Episodes
from vtbdrake.environments.vector import Step, TestbedVectorEnv, checked_count
from vtbdrake.rollout.executor import WorkerError, checked_workers
from vtbdrake.rollout.worker_processes import TIME_LIMIT


class ProcessVectorEnv(TestbedVectorEnv):
    """Environments on worker processes. Each process builds a testbed, and steps its share of the environments.

    Args:
        episodes: What an episode is.
        num_envs: The number of environments.
        workers: The number of processes; by default the number of cores.

    Raises:
        ValueError: As `TestbedEnv`, or a number is not positive.
        WorkerError: A worker does not start.
    """

    def __init__(self, episodes: Episodes, num_envs: int, *, workers: int | None = None) -> None:
        count = min(checked_workers(workers), checked_count(num_envs))
        super().__init__(episodes, num_envs, episodes.task.scenario.build())
        self._shares = [slice(int(part[0]), int(part[-1]) + 1) for part in np.array_split(np.arange(num_envs), count)]
        self._children = [
            ChildProcess(_run, episodes, share.stop - share.start, name="a worker of environments", grace=0.0)
            for share in self._shares
        ]
        self._connections = []
        for child in self._children:
            child.wait_until_ready(None)
            self._connections.append(FrameConnection(child.connection))

    def step(self, actions: Any) -> Step:  # type: ignore[override]  # Gymnasium has one type for numbers and flags.
        """Make a step in every environment, or reset it if its episode had ended.

        Args:
            actions: An action for each, shape (num_envs, size).

        Returns:
            Observations (num_envs, size), rewards, terminations, truncations, each (num_envs,), and what
            `TestbedEnv.step` tells of each.

        Raises:
            ActionError: As `TestbedEnv.step`; nothing happened.
            FailedEpisodeError: A simulation fails, and there is no ``failure_reward``: reset all.
            WorkerError: A worker process has died, or a call was interrupted before.
        """
        checked = self._checked(actions)
        return self._merged(self._call([("step", checked[share]) for share in self._shares]))

    def _reset(self, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> tuple[Array, dict[str, Any]]:
        calls = [("reset", (seeds[share], None if options is None else dict(options))) for share in self._shares]
        observations, *_, infos = self._merged(self._call(calls))
        return observations, infos

    def _merged(self, steps: Sequence[Any]) -> Step:
        observations, rewards, terminated, truncated = (np.concatenate([step[k] for step in steps]) for k in range(4))
        infos: dict[str, Any] = {}
        for number, info in enumerate(info for step in steps for info in step[4]):
            infos = self._add_info(infos, info, number)
        return observations, rewards, terminated, truncated, infos

    def _call(self, calls: Sequence[tuple[str, Any]]) -> list[Any]:
        """Let every worker do something, side by side, and return what they answer."""
        if self.closed:
            raise WorkerError("the environments are closed, by close() or by an interruption: make new ones")
        try:
            for connection, call in zip(self._connections, calls, strict=True):
                connection.send(call)
            replies = [connection.receive(TIME_LIMIT) for connection in self._connections]
        except (EOFError, OSError) as error:
            codes = [child.exit_code for child in self._children]
            self.close()
            raise WorkerError(
                f"a worker process of environments was lost (exit codes {codes}, {error}): make new environments"
            ) from error
        except BaseException:  # Ctrl-C: what the workers answer belongs to no later call.
            self.close()
            raise
        for share, reply in zip(self._shares, replies, strict=True):
            if isinstance(reply, _EnvError):
                reply.error.add_note(f"in environment {share.start + reply.number}")
                raise reply.error
        return replies

    def close_extras(self, **kwargs: Any) -> None:
        """End the workers."""
        for child in self._children:
            child.kill()
            child.close()


# -- in the worker process


class _EnvError:
    """The error of one of a worker's environments."""

    def __init__(self, number: int, error: BaseException) -> None:
        self.number = number
        try:
            pickle.loads(pickle.dumps(error))
            self.error = error if isinstance(error, Exception) else RuntimeError(error_text(error))
        except Exception:  # Some exceptions do not pickle, or cannot be read again.
            self.error = RuntimeError(error_text(error))


def _run(parent: socket.socket, episodes: Episodes, count: int) -> None:
    """Serve calls until the connection closes.

    Args:
        parent: The connection to the vector environment.
        episodes: What an episode is.
        count: The number of environments.
    """
    testbed = episodes.task.scenario.build()
    served = _Served([TestbedEnv(episodes, testbed) for _ in range(count)])
    report_ready(parent)
    connection = FrameConnection(parent)
    with suppress(EOFError, OSError):
        while True:
            name, argument = connection.receive()
            connection.send(served.answer(name, argument))


class _Served:
    """The environments of a worker, one after the other."""

    def __init__(self, envs: Sequence[TestbedEnv]) -> None:
        self._envs = envs
        self._done = np.zeros(len(envs), dtype=bool)
        self._number = 0

    def answer(self, name: str, argument: Any) -> Any:
        try:
            rows = list(self._resets(*argument) if name == "reset" else self._steps(argument))
        except FAILURES as error:
            return _EnvError(self._number, error)
        observations, rewards, terminated, truncated, infos = zip(*rows, strict=True)
        self._done = np.array(terminated) | np.array(truncated)
        return np.array(observations), np.array(rewards), np.array(terminated), np.array(truncated), infos

    def _resets(self, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> Any:
        for number, (env, seed) in enumerate(zip(self._envs, seeds, strict=True)):
            self._number = number
            observation, info = env.reset(seed=seed, options=options)
            yield observation, 0.0, False, False, info

    def _steps(self, actions: Array) -> Any:
        for number, (env, action) in enumerate(zip(self._envs, actions, strict=True)):
            self._number = number
            if self._done[number]:
                observation, info = env.reset()
                yield observation, 0.0, False, False, info
            else:
                yield env.step(action)
