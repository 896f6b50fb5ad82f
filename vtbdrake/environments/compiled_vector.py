"""Many environments in machine code: all of them make a step in one call of the compiled testbed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding

from vtbdrake.common.arrays import Array
from vtbdrake.compiled import CompiledRollouts
from vtbdrake.compiled.segmented_rollouts import SegmentedRollouts
from vtbdrake.compiled.state_vector import DOUBT
from vtbdrake.compiled.tracing import traced
from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.environments.episodes import Episodes, FailedEpisodeError, seed_addresses
from vtbdrake.environments.rewards import first_score, next_score, step_reward
from vtbdrake.environments.spaces import Channels, switch_values
from vtbdrake.environments.vector import Flags, Rows, Step, TestbedVectorEnv
from vtbdrake.rollout import Quality
from vtbdrake.rollout.runner import RolloutRunner, SimulationError
from vtbdrake.rollout.start import Start
from vtbdrake.testbed import VirtualTestbed

# Number of steps over which the compiled testbed is compared with Drake's when it is made.
_CHECKED_STEPS = 12


class CompiledVectorEnv(TestbedVectorEnv):
    """Environments of the compiled testbed, whose steps equal Drake's to about 1e-15; see docs/compiled_testbeds.md.

    A step that the compiled testbed cannot make (contact does not converge, the state is not finite) is made in Drake.

    Args:
        episodes: What an episode is.
        num_envs: The number of environments.
        compile: Whether to make machine code; None: if there is a C compiler.

    Raises:
        ValueError: As `TestbedEnv`, or the number is not positive.
        UnsupportedTestbedError: The testbed cannot be compiled, or what varies is compiled in.
        CompiledDifferenceError: The compiled testbed differs from Drake's.
        CompilerError: ``compile`` is True, and there is no C compiler, or it fails.
    """

    def __init__(self, episodes: Episodes, num_envs: int, *, compile: bool | None = None) -> None:
        testbed = episodes.task.scenario.build()
        super().__init__(episodes, num_envs, testbed)
        self._testbed, self._task = testbed, episodes.task
        s0 = testbed.default_context()
        if self._task.start is not None:
            testbed.restore(s0, self._task.start)
            testbed.switch(s0, "sim")
        testbed.write(s0, switch_values(testbed, self._actions))
        self._rollouts = self._compiled(s0, compile)
        walker, t0 = self._rollouts.walker, s0.get_time()
        self._times = self._task.sample_times()
        self._segments = SegmentedRollouts(self._rollouts, self._times, every=episodes.every, t0=t0)
        self._seeds = seed_addresses(testbed.variables())
        # The seed of a sensor that is not compiled, because nothing depends on it, has no effect.
        self._without_effect = frozenset(address for address in self._seeds if not walker.vector.can_vary(address))
        self._in_drake = _StepInDrake(testbed, self._rollouts, self._segments, episodes, self._actions)
        self._action_entries = np.concatenate(
            [np.arange(walker.vector.size)[walker.place(a)] for a in self._actions.addresses]
        )
        self._observed_entries = np.concatenate([self._entries(address) for address in self._observations.addresses])
        self._z0 = self._rollouts.z_of(s0)
        self._z = np.repeat(self._z0[np.newaxis], num_envs, axis=0)
        self._random = [seeding.np_random()[0] for _ in range(num_envs)]
        self._steps = np.zeros(num_envs, dtype=np.intp)
        self._done: Flags = np.zeros(num_envs, dtype=bool)
        self._score, self._last = np.zeros(num_envs), np.zeros(num_envs)
        self._observed = np.zeros((num_envs, len(self._observed_entries)))
        self._needs_reset = "the environments are new"

    def step(self, actions: Any) -> Step:  # type: ignore[override]  # Gymnasium has one type for numbers and flags.
        """Make a step in every environment, or reset it if its episode had ended.

        Args:
            actions: An action for each, shape (num_envs, size).

        Returns:
            Observations (num_envs, size), rewards, terminations, truncations, each (num_envs,), and {"quality": the
            quality of all samples so far, "failure": why simulations have failed}.

        Raises:
            ActionError: An action is not finite, or lies beyond the limits; nothing happened.
            FailedEpisodeError: A simulation fails, and there is no ``failure_reward``: reset all.
            ResetNeeded: No episode has begun.
        """
        if self._needs_reset:
            raise ResetNeeded(f"{self._needs_reset}: call reset() before step()")
        checked = self._checked(actions)
        rows, ended = np.flatnonzero(~self._done), np.flatnonzero(self._done)
        rewards, infos = np.zeros(self.num_envs), dict[str, Any]()
        terminated, truncated = np.zeros(self.num_envs, dtype=bool), np.zeros(self.num_envs, dtype=bool)
        self._needs_reset = "a step was interrupted"
        if rows.size:
            rewards[rows], terminated[rows], failures = self._advance(rows, checked[rows])
            truncated[rows] = ~terminated[rows] & (self._steps[rows] == self.episodes.steps)
            for row, failure in failures.items():
                infos = self._add_info(infos, {"failure": failure}, row)
        if ended.size:
            self._begin(ended, None)
        self._done = terminated | truncated
        self._needs_reset = ""
        if isinstance(self.episodes.reward, Quality):
            infos |= {"quality": self._score.copy(), "_quality": np.ones(self.num_envs, dtype=bool)}
        return self._observed.copy(), rewards, terminated, truncated, infos

    def _reset(self, seeds: Sequence[int | None], options: Mapping[str, Any] | None) -> tuple[Array, dict[str, Any]]:
        for row, seed in enumerate(seeds):
            if seed is not None:
                self._random[row], _ = seeding.np_random(seed)
        self._needs_reset = "its reset has failed"
        values = self._begin(np.arange(self.num_envs), options)
        self._done[:] = False
        self._needs_reset = ""
        infos: dict[str, Any] = {}
        for row, of_row in enumerate(values):
            quality = {"quality": float(self._score[row])} if isinstance(self.episodes.reward, Quality) else {}
            infos = self._add_info(infos, {"values": dict(of_row), **quality}, row)
        return self._observed.copy(), infos

    # -- how it is done

    def _compiled(self, s0: Any, compile: bool | None) -> CompiledRollouts:
        """Return the compiled testbed, which records what is observed and the measures."""
        task, episodes = self._task, self.episodes
        functions: dict[str, tuple[casadi.Function, Sequence[str]]] = {}
        outputs = list(self._observations.addresses)
        for k, measure in enumerate(episodes.measures):
            function = traced(measure.f, [self._testbed.read(s0, address) for address in measure.of])
            if function is None:
                outputs += measure.of
            else:
                functions[_measure_name(k)] = function, measure.of
        varied = [p.address for p in episodes.parameters] + [a for c in episodes.conditions for a in c]
        return CompiledRollouts(
            self._testbed.diagram,
            self._testbed.variables(),
            s0,
            horizon=min(task.horizon, _CHECKED_STEPS * episodes.period),
            sample_period=task.sample_period,
            parameters=list(dict.fromkeys(varied)),
            outputs=list(dict.fromkeys(outputs)),
            measures=functions,
            timings=self._testbed.event_timings(),
            compile=compile,
        )

    def _entries(self, name: str) -> Array:
        """Return the indices of an output among the recorded values."""
        columns = self._rollouts.columns[name]
        return np.arange(columns.start, columns.stop)

    def _begin(self, rows: Rows, options: Mapping[str, Any] | None) -> list[Mapping[str, Any]]:
        """Begin an episode in some environments; return the values that were set."""
        variables = self._testbed.variables()
        drawn = []
        for row in rows.tolist():
            beginning = self.episodes.drawn(self._random[row], options, variables, self._seeds)
            if beginning.start is not None:
                raise ValueError(
                    "compiled environments begin at the problem's s0: state it there, Problem(start=snapshot), or take "
                    "executor='processes'"
                )
            drawn.append(beginning.values)
        alike: dict[tuple[str, ...], list[int]] = {}
        for k, values in enumerate(drawn):
            alike.setdefault(tuple(a for a in values if a not in self._without_effect), []).append(k)
        for addresses, indices in alike.items():
            arrays = {a: np.array([drawn[k][a] for k in indices], dtype=float) for a in addresses}
            self._z[rows[indices]] = self._rollouts.filled(self._z0, arrays)
        records = self._segments.begin(self._z[rows])[:, np.newaxis]
        for k in self._departed(records):
            try:
                _, records[k] = self._in_drake(self._z[rows[k]], 0, steps=0)
            except SimulationError as failure:
                raise FailedEpisodeError(
                    f"environment {rows[k]}: the simulation fails at the start of an episode: {failure}"
                ) from failure
        samples = self._samples(records, np.broadcast_to(self._times[0], (len(rows), 1)))
        first = samples[self.episodes.reward_index][:, 0]
        self._last[rows], self._score[rows] = first, first_score(self.episodes.reward, first)
        self._observed[rows], self._steps[rows] = records[:, 0, self._observed_entries], 0
        return drawn

    def _advance(self, rows: Rows, actions: Array) -> tuple[Array, Flags, dict[int, str]]:
        """Make a step of some environments; return rewards, terminations and, by environment, why simulations fail."""
        z = self._z[rows]
        z[:, self._action_entries] = actions
        steps = self._steps[rows]
        after, records = self._segments.advance(z, steps)
        failures: dict[int, str] = {}
        for k in self._departed(records):
            try:
                after[k], records[k] = self._in_drake(z[k], int(steps[k]))
            except SimulationError as failure:
                failures[k] = str(failure)
                self._refuse_failure(int(rows[k]), actions[k], failure)
                # So that all functions can be computed: these values do not count.
                after[k], records[k] = z[k], self._segments.begin(self._z0[np.newaxis])
        every = self.episodes.every
        samples = self._samples(records, self._times[steps[:, np.newaxis] * every + np.arange(1, every + 1)])
        before = self._score[rows]
        terminated, ends = self._add_up(rows, samples, steps)
        rewards = step_reward(self.episodes.reward, before, self._score[rows], self._last[rows])
        observed = records[np.arange(len(rows)), ends][:, self._observed_entries]
        for k in failures:
            rewards[k], terminated[k] = self.episodes.failure_reward or 0.0, True
            observed[k], self._score[rows[k]] = self._observed[rows[k]], before[k]
        self._z[rows], self._observed[rows], self._steps[rows] = after, observed, steps + 1
        return rewards, terminated, {int(rows[k]): failure for k, failure in failures.items()}

    def _add_up(self, rows: Rows, samples: Sequence[Array], steps: Rows) -> tuple[Flags, Rows]:
        """Add the samples of a step to the scores; return whether, and at which sample, episodes terminate."""
        score, last = self._score[rows], self._last[rows]
        terminated, ends = np.zeros(len(rows), dtype=bool), np.full(len(rows), self.episodes.every - 1)
        seconds = np.diff(self._times)
        for j in range(self.episodes.every):
            at_j = [each[:, j] for each in samples]
            sample = at_j[self.episodes.reward_index]
            added = next_score(self.episodes.reward, score, last, sample, seconds[steps * self.episodes.every + j])
            score, last = np.where(terminated, score, added), np.where(terminated, last, sample)
            now = self.episodes.terminates(at_j) & ~terminated
            ends[now] = j
            terminated |= now
        self._score[rows], self._last[rows] = score, last
        return terminated, ends

    def _samples(self, records: Array, times: Array) -> list[Array]:
        """Return the samples of each measure, shape (n, m), from records of shape (n, m, ny)."""
        samples = []
        for k, measure in enumerate(self.episodes.measures):
            if (name := _measure_name(k)) in self._rollouts.columns:
                samples.append(records[:, :, self._entries(name)[0]])
                continue
            of = [(self._entries(address), self._rollouts.shapes[address]) for address in measure.of]
            values = np.empty(records.shape[:2])
            for place in np.ndindex(*values.shape):
                arguments = [_value(records[place][entries], shape) for entries, shape in of]
                values[place] = measure(arguments, time=float(times[place]))
            samples.append(values)
        return samples

    def _departed(self, records: Array) -> list[int]:
        """Return the rows of records of shape (n, m, ny) that are not Drake's, or in which a measure is not valid."""
        departed = ~(records[:, :, DOUBT] <= 0.0).all(axis=1)
        for k, measure in enumerate(self.episodes.measures):
            if (name := _measure_name(k)) in self._rollouts.columns:
                departed |= ~measure.accepts(records[:, :, self._entries(name)[0]]).all(axis=1)
        return np.flatnonzero(departed).tolist()

    def _refuse_failure(self, row: int, action: Array, failure: SimulationError) -> None:
        if self.episodes.failure_reward is None:
            self._needs_reset = "a simulation has failed"
            raise FailedEpisodeError(
                f"environment {row}: the simulation fails in step {self._steps[row] + 1}, after the action "
                f"{action.tolist()}: {failure}; or say what that is worth, failure_reward=number, and the episode "
                "terminates"
            ) from failure


class _StepInDrake:
    """Makes a step of one environment in Drake, where the compiled testbed cannot."""

    def __init__(
        self,
        testbed: VirtualTestbed,
        rollouts: CompiledRollouts,
        segments: SegmentedRollouts,
        episodes: Episodes,
        channels: Channels,
    ) -> None:
        self._testbed, self._rollouts, self._segments, self._episodes = testbed, rollouts, segments, episodes
        self._switches, self._acted = switch_values(testbed, channels), channels.addresses
        self._runner: RolloutRunner | None = None

    def __call__(self, z: Array, number: int, *, steps: int = 1) -> tuple[Array, Array]:
        """Return z at the end of a step, shape (nz,), and the records of its samples, shape (every, ny).

        Args:
            z: State and parameters at the begin of the step, with the action, shape (nz,).
            number: The number of the step in the episode.
            steps: 1; or 0 for the record of the begin alone, shape (1, ny).

        Raises:
            SimulationError: The simulation fails.
            QualityError: A measure fails.
        """
        if self._runner is None:
            self._runner = RolloutRunner(self._episodes.task, self._testbed)
        walker, instants, testbed = self._rollouts.walker, self._segments.instants, self._testbed
        begin = testbed.default_context()
        begin.SetTime(float(instants[number * self._episodes.every]))
        walker.write(z, begin)
        values = {address: testbed.read(begin, address) for address in self._acted} | self._switches
        samples = self._runner.simulate(values, start=Start.of(testbed, begin), begun=float(instants[0]))
        with Interruptible():
            time = next(samples)
            times = [time] if steps == 0 else (next(samples) for _ in range(self._episodes.every))
            records = np.array([self._record(time) for time in times])
        return walker.read(self._runner.context), records

    def _record(self, time: float) -> Array:
        """Return the record of the present state; its last entry, the doubt, is 0."""
        assert self._runner is not None
        columns = self._rollouts.columns
        record = np.zeros(self._segments.record_size)
        measured = {_measure_name(k): value for k, value in enumerate(self._runner.measured(time))}
        for name, entries in columns.items():
            value = measured[name] if name in measured else self._rollouts.read(name, self._runner.context)
            record[entries] = np.ravel(value)
        return record


def _measure_name(number: int) -> str:
    return f"measure {number}"


def _value(entries: Array, shape: tuple[int, ...]) -> float | Array:
    return entries.reshape(shape).copy() if shape else float(entries[0])
