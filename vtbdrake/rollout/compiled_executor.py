"""Rollouts in the compiled testbed: many in one call, without Drake and without Python."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Hashable, Iterator, Sequence
from math import inf, nan
from typing import Any

import casadi
import numpy as np

from vtbdrake.common.lru import LruDict
from vtbdrake.compiled import CompiledBatch, CompiledRollouts, CompilerError, FixedPiece, UnsupportedTestbedError
from vtbdrake.compiled.tracing import traced
from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.rollout.executor import Executor, Parameters, SerialExecutor, checked_workers
from vtbdrake.rollout.pruning import Cutoff
from vtbdrake.rollout.quality import Measure, QualityError, exceeds, read_quality
from vtbdrake.rollout.runner import values_key
from vtbdrake.rollout.start import Start, StartContext, StartError, Starts, start_of_each
from vtbdrake.rollout.task import HORIZON, TERMINATED, THRESHOLD, RolloutResult, RolloutTask, check_call
from vtbdrake.rollout.testbeds import FIELD, MAX_TESTBEDS, Testbeds, failed, split
from vtbdrake.state.variables import A, Variable
from vtbdrake.testbed import VirtualTestbed

_log = logging.getLogger(__name__)

COMPILED = "compiled"

# As many rollouts are computed in one call. Between calls, Ctrl-C is noticed and results come back.
_BATCH = 1024
# A share of a period at which no event of another period is due.
_BETWEEN = 0.382


class CompiledExecutor(Executor):
    """Rollouts of the compiled testbed, equal to Drake's to about 1e-15; see `VirtualTestbed.compiled`.

    The testbed is compiled for a task at the first rollout, and compared with Drake's then; machine code is kept for
    the next time. Qualities that work with CasADi's numbers (sums, products, numpy's functions; no branches) are
    compiled, too; others get the recorded samples. A rollout that the compiled testbed cannot make (contact does not
    converge, the state is not finite, f fails) is simulated in Drake: ``RolloutResult.computed`` tells how each was
    made.
    Several threads may call it at once, if that is true of ``drake``.

    Args:
        testbed: A testbed to use for tasks of its scenario; others are built.
        workers: Number of threads; by default the number of cores.
        max_testbeds: Number of testbeds that are kept, for points with different scenario fields.
        compile: Whether to make machine code; None: if there is a C compiler.
        drake: Runs the rollouts that the compiled testbed cannot make, and is closed with this executor; by default
            they run in this thread.
    """

    def __init__(
        self,
        testbed: VirtualTestbed | None = None,
        *,
        workers: int | None = None,
        max_testbeds: int = MAX_TESTBEDS,
        compile: bool | None = None,
        drake: Executor | None = None,
    ) -> None:
        self._testbeds = Testbeds(testbed, max_testbeds=max_testbeds)
        self._drake = SerialExecutor(testbed, max_testbeds=max_testbeds) if drake is None else drake
        self._workers = checked_workers(workers)
        self._compile = compile
        self._compiled: LruDict[Hashable, _CompiledTask] = LruDict(max_testbeds)
        self._pieces: Sequence[FixedPiece] | None = None
        self._lock = threading.Lock()

    def run(
        self, task: RolloutTask, points: Sequence[Parameters], *, start: Starts = None, cutoff: Cutoff | None = None
    ) -> Iterator[tuple[int, RolloutResult]]:
        """Run one rollout per point; see `Executor.run`.

        Args:
            task: The data that all rollouts share.
            points: One point per rollout, address -> value.
            start: Where the rollouts begin instead of the task's own s0: one start for all, or one for each point.
            cutoff: When to end rollouts early; what its deadline cancels is not yielded.

        Raises:
            UnsupportedTestbedError: The testbed cannot be compiled, or a varied variable is compiled in.
            CompiledDifferenceError: The compiled testbed differs from Drake's.
            ValueError: The task needs what compiled rollouts cannot do: pruning, a recorded motion, states.
        """
        check_call(task, points)
        starts = start_of_each(start, len(points))
        for fields, indices in _by_fields(points):
            compiled = self._of(task, fields, [points[i] for i in indices])
            while indices:
                count = _BATCH if cutoff is None else min(_BATCH, compiled.affordable(cutoff))
                batch, indices = indices[:count], indices[count:]
                if not batch:
                    return
                results = compiled.run([points[i] for i in batch], [starts[i] for i in batch])
                left = []
                for i, result in zip(batch, results, strict=True):
                    if result is None:
                        left.append(i)
                    else:
                        yield i, result
                if self._pieces is not None:
                    yield from ((i, failed(points[i], "what is compiled cannot make this rollout")) for i in left)
                elif left:
                    begin = None if start is None else [each for i in left if (each := starts[i])]
                    for k, result in self._drake.run(task, [points[i] for i in left], start=begin, cutoff=cutoff):
                        yield left[k], result

    def stand_on(self, pieces: Sequence[FixedPiece] | None) -> None:
        """Let all rollouts from now on be on another terrain; see `CompiledRollouts.stand_on`.

        One that the compiled testbed cannot make is then a failed one, because Drake's testbed has its own terrain.

        Args:
            pieces: The pieces of the terrain; None: the testbed's own.
        """
        with self._lock:
            self._pieces = pieces
            for compiled in self._compiled.values():
                compiled.stand_on(pieces)

    def close(self) -> None:
        self._compiled.clear()
        self._drake.close()

    def prepare(self, task: RolloutTask, points: Sequence[Parameters]) -> None:
        """Compile the testbed of a task, for points like these; raises the errors of `run`.

        Args:
            task: The task of the rollouts.
            points: Points whose addresses are those that vary, and whose fields of the scenario choose the testbeds.
        """
        for fields, indices in _by_fields(points):
            self._of(task, fields, [points[i] for i in indices])

    def suits(self, task: RolloutTask, points: Sequence[Parameters]) -> bool:
        """Compile the testbed of a task, for points like these; if that is refused, log why, and return False.

        Args:
            task: The task of the rollouts.
            points: Points whose addresses are those that vary; a field of the scenario among them is refused.
        """
        fields = sorted(address for address in frozenset().union(*points) if address.startswith(FIELD))
        try:
            if fields:
                raise UnsupportedTestbedError(f"each value of {fields[0]} would be compiled anew")
            self.prepare(task, points)
        except (ValueError, ArithmeticError, CompilerError) as error:
            _log.info("rollouts are simulated in Drake: %s", error)
            return False
        return True

    def warm_up(self, task: RolloutTask, rollouts: int) -> None:
        """Compile what rollouts need that begin with the events of the testbed or between them; make one of each.

        Args:
            task: The task of the rollouts.
            rollouts: It has no effect here: the compiled testbed is the same for any number.
        """
        self._of(task, {}, [{}]).warm_up()

    def _of(self, task: RolloutTask, fields: Parameters, points: Sequence[Parameters]) -> _CompiledTask:
        key = (id(task), values_key(fields))
        addresses = frozenset[str]().union(*points) - {f"{FIELD}{name}" for name in fields}
        with self._lock:  # What one thread compiles, others wait for.
            compiled = self._compiled.use(key)
            if compiled is None or not compiled.varies(addresses):
                if compiled is not None:
                    addresses |= compiled.addresses
                with Interruptible():
                    testbed = self._testbeds.get(task.scenario.with_fields(fields) if fields else task.scenario)
                    compiled = _CompiledTask(task, testbed, addresses, workers=self._workers, compile=self._compile)
                    if self._pieces is not None:
                        compiled.stand_on(self._pieces)
                self._compiled.add(key, compiled)
        return compiled


class AutoExecutor(Executor):
    """Rollouts in the compiled testbed, if that is possible; otherwise in Drake.

    The log tells why a testbed is not compiled, and ``RolloutResult.computed`` how a rollout was made. The choice does
    not depend on how long rollouts take, so that a study that is repeated is computed as before. Rollouts are in Drake
    without a C compiler, and where a field of the scenario is varied: each of its values would be compiled anew.

    Args:
        testbed: A testbed to use for tasks of its scenario; others are built.
        drake: Runs the rollouts in Drake, and is closed with this executor.
        workers: Number of threads of compiled rollouts; by default the number of cores.
    """

    def __init__(self, testbed: VirtualTestbed, drake: Executor, *, workers: int | None = None) -> None:
        self._compiled = CompiledExecutor(testbed, workers=workers, compile=True, drake=drake)
        self._drake = drake
        self._refused: RolloutTask | None = None

    def run(
        self, task: RolloutTask, points: Sequence[Parameters], *, start: Starts = None, cutoff: Cutoff | None = None
    ) -> Iterator[tuple[int, RolloutResult]]:
        # What was refused once is not tried again.
        if points and task is not self._refused and not self._compiled.suits(task, points):
            self._refused = task
        executor = self._drake if task is self._refused else self._compiled
        yield from executor.run(task, points, start=start, cutoff=cutoff)

    def close(self) -> None:
        self._compiled.close()


class _CompiledTask:
    """A task on the compiled testbed of one choice of scenario fields.

    Attributes:
        addresses: The variables that can be varied.
    """

    def __init__(
        self,
        task: RolloutTask,
        testbed: VirtualTestbed,
        addresses: frozenset[str],
        *,
        workers: int,
        compile: bool | None,
    ) -> None:
        refused = {
            "pruning": task.pruning is not None,
            "motion": task.motion is not None,
            "keep_state": task.keep_state,
        }
        for name, present in refused.items():
            if present:
                raise ValueError(
                    f"compiled rollouts cannot do what {name}= asks for: leave it out, or use another executor"
                )
        self._task, self._testbed = task, testbed
        self.addresses = addresses
        s0 = testbed.default_context()
        if task.start is not None:
            testbed.restore(s0, task.start)
            testbed.switch(s0, "sim")
        self._measures: list[Measure] = [*([task.quality] if task.quality else []), *task.measures]
        functions: dict[str, tuple[casadi.Function, Sequence[str]]] = {}
        for k, measure in enumerate(self._measures):
            function = traced(measure.f, [testbed.read(s0, address) for address in measure.of])
            if function is not None:
                functions[f"measure {k}"] = function, measure.of
        self._traced = tuple(functions)
        sampled = [a for k, m in enumerate(self._measures) if f"measure {k}" not in functions for a in m.of]
        variables = testbed.variables()
        # The state can be set anyway; masses and the like only if they are named.
        believed = [a for rule in testbed.belief_rules for a in rule.targets if variables[a].kind == A]
        # Such as the pose of a body: it is set in a context, from which the state is read.
        self._by_start = frozenset(a for a in addresses if _is_written_to_state(variables[a]))
        self._rollouts = CompiledRollouts(
            testbed.diagram,
            variables,
            s0,
            horizon=task.horizon,
            sample_period=task.sample_period,
            parameters=list(dict.fromkeys([*(addresses - self._by_start), *believed])),
            outputs=list(dict.fromkeys([*task.record, *sampled])),
            measures=functions,
            timings=testbed.event_timings(),
            compile=compile,
            workers=workers,
        )
        self._start_context = StartContext(testbed, s0, testbed.copier_from(testbed))
        self._z0 = self._rollouts.z_of(s0)
        self._into, self._from = self._rollouts.walker.vector.shared_with(testbed.start_layout)
        self._duration = inf  # Duration of a rollout of the last batch, in seconds.
        self._varies: dict[frozenset[str], bool] = {}
        self._last_start: tuple[Start | None, np.ndarray, float] | None = None
        self._lock = threading.Lock()

    def warm_up(self) -> None:
        """Make a rollout that begins with the periodic events, and one between them: there are more instants in it."""
        begin = self._start_context.context.get_time()
        shortest = min((period for period, _ in self._testbed.event_timings()), default=0.0)
        for t0 in (begin, begin + _BETWEEN * shortest):
            self._rollouts.from_z(self._z0[np.newaxis], t0)

    def stand_on(self, pieces: Sequence[FixedPiece] | None) -> None:
        """See `CompiledExecutor.stand_on`."""
        self._rollouts.stand_on(None if pieces is None else self._rollouts.terrain(pieces))

    def varies(self, addresses: frozenset[str]) -> bool:
        """Return whether variables can be varied without compiling again."""
        if addresses not in self._varies:
            self._varies[addresses] = all(
                self._rollouts.walker.vector.can_vary(address) for address in addresses - self._by_start
            )
        return self._varies[addresses]

    def run(self, points: Sequence[Parameters], starts: Sequence[Start | None]) -> list[RolloutResult | None]:
        """Return the results of the points; None for those that only Drake can make."""
        begun = time.perf_counter()
        results: list[RolloutResult | None] = [None] * len(points)
        by_start: dict[tuple[int, tuple[str, ...]], list[int]] = {}
        for i, (point, start) in enumerate(zip(points, starts, strict=True)):
            by_start.setdefault((id(start), tuple(point)), []).append(i)
        rows: dict[float, list[tuple[list[int], np.ndarray]]] = {}
        for (_, addresses), indices in by_start.items():
            try:
                z, t0 = self._begin(starts[indices[0]])
                entries = [a for a in addresses if not a.startswith(FIELD) and a not in self._by_start]
                values = {a: np.array([points[i][a] for i in indices]) for a in entries}
                filled = self._rollouts.filled(z, values)
            except StartError:
                raise
            except (UnsupportedTestbedError, ValueError) as error:
                _log.warning("%d rollouts are simulated in Drake: %s", len(indices), error)
                continue
            if not values:
                filled = np.repeat(filled, len(indices), axis=0)
            if written := self._by_start.intersection(addresses):
                filled = self._written(filled, [{a: points[i][a] for a in written} for i in indices])
            rows.setdefault(t0, []).append((indices, filled))
        for t0, parts in rows.items():
            batch = self._rollouts.from_z(np.concatenate([part for _, part in parts]), t0)
            order = [i for indices, _ in parts for i in indices]
            share = (time.perf_counter() - begun) / len(points)
            for row, result in self._results([points[i] for i in order], batch, share):
                results[order[row]] = result
        self._duration = (time.perf_counter() - begun) / len(points)
        return results

    def _written(self, z: np.ndarray, values: Sequence[Parameters]) -> np.ndarray:
        """Return the vectors of state and parameters after values have been written that are no entries of them.

        Args:
            z: The vectors before, shape (n, nz).
            values: The values of each, address -> value.
        """
        walker, context = self._rollouts.walker, self._start_context.context.Clone()
        rows = []
        for row, of_row in zip(z, values, strict=True):
            walker.write(row, context)
            walker.systems.variables.write(context, of_row)
            rows.append(walker.read(context))
        return np.array(rows)

    def affordable(self, cutoff: Cutoff) -> int:
        """Return the number of rollouts that take about as long as is left; 0 after the deadline."""
        left = cutoff.deadline - time.monotonic()
        return 0 if left <= 0.0 else sys.maxsize if left == inf else max(1, int(left / self._duration))

    def _begin(self, start: Start | None) -> tuple[np.ndarray, float]:
        with self._lock:  # Threads share the context of the starts, and the last start.
            if self._last_start is None or self._last_start[0] is not start:
                self._last_start = start, *self._z_of(start)
            return self._last_start[1:]

    def _z_of(self, start: Start | None) -> tuple[np.ndarray, float]:
        """Return the vector of state and parameters of a start, and its time."""
        walker = self._rollouts.walker
        is_compiled = start is not None and self._is_compiled(start)
        # Other variables change more than their own value: a mass scales an inertia.
        if start is not None and is_compiled and all(walker.systems.variables[a].place for a in start.values):
            z = self._z0.copy()
            z[self._into] = start.contents.numbers[self._from]
            return self._rollouts.filled(z, start.values)[0], start.time
        with Interruptible():
            self._start_context.set(start)
            context = self._start_context.context
            z = walker.read(context) if is_compiled else self._rollouts.z_of(context)
            return z, context.get_time()

    def _is_compiled(self, start: Start) -> bool:
        """Return whether a start has no part in which it could differ from what is compiled in."""
        is_alike = start.contents.names == self._testbed.start_layout.names
        return is_alike and self.varies(frozenset(start.values))

    def _results(
        self, points: Sequence[Parameters], batch: CompiledBatch, wall_time: float
    ) -> Iterator[tuple[int, RolloutResult]]:
        """Yield (row, result) of the rollouts of a batch, except those that Drake makes: invalid, or f fails."""
        task, valid, samples = self._task, batch.valid.copy(), []
        counts = batch.counts.copy()
        for row in np.flatnonzero(~valid).tolist():
            _log.info("a rollout is simulated in Drake: %s", batch.reasons[row])
        for k, measure in enumerate(self._measures):
            samples.append(self._samples(k, measure, batch, counts, valid))
            if k == 0 and task.threshold is not None and not task.run_on:
                exceeded = exceeds(samples[0], task.threshold, minimize=task.minimize)
                # What follows the end of a simulation repeats its last sample.
                counts = np.where(exceeded.any(axis=1), np.minimum(exceeded.argmax(axis=1) + 1, counts), counts)
        ends = np.where(counts == batch.counts, batch.ends, inf)  # Others end before, where f exceeds its threshold.
        for count, end in sorted(set(zip(counts[valid].tolist(), ends[valid].tolist(), strict=True))):
            rows = np.flatnonzero(valid & (counts == count) & (ends == end))
            times = batch.times[:count].copy()
            if end < inf:
                times[-1] = end
            of_rows = [each[rows, :count] for each in samples]
            yield from self._read(points, rows, batch, times, of_rows, HORIZON if end == inf else TERMINATED, wall_time)

    def _read(
        self,
        points: Sequence[Parameters],
        rows: np.ndarray,
        batch: CompiledBatch,
        times: np.ndarray,
        samples: Sequence[np.ndarray],
        end: str,
        wall_time: float,
    ) -> Iterator[tuple[int, RolloutResult]]:
        """Yield (row, result) of rollouts with the same sample times from their samples.

        Args:
            points: The points of all rollouts.
            rows: Which of them have these times.
            batch: The results of all of them.
            times: The sample times, shape (m,), in s.
            samples: The samples of each measure, shape (rows, m).
            end: How they ended, unless f has exceeded its threshold.
            wall_time: The share of the wall time, in s.
        """
        task, f = self._task, self._task.quality
        # So that sums over time have the same order, and result, as in a single rollout.
        samples = [np.ascontiguousarray(each) for each in samples]
        m = len(times)
        t_star = h = value = np.full(len(rows), nan)
        quality, of_measures = np.empty((len(rows), 0)), samples
        exceedances: dict[int, np.ndarray] = {}
        if f is not None:
            t_star, value = read_quality(f, times, samples[0], task.threshold)
            h, quality, of_measures = f.quality(value), f.quality(samples[0]), samples[1:]
            if task.threshold is not None:
                exceeded = exceeds(samples[0], task.threshold, minimize=task.minimize)
                exceedances = {k: times[exceeded[k]] for k in np.flatnonzero(exceeded.any(axis=1)).tolist()}
        measures = [measure.read(times, each) for measure, each in zip(task.measures, of_measures, strict=True)]
        threshold = task.f_m
        # One row per rollout.
        numbers = np.array([t_star, h, value, *measures]).T
        finite = np.isfinite(numbers[:, 3 if f is None else 2 :]).all(axis=1).tolist()
        for k, (row, (t, best, reported, *of_row)) in enumerate(zip(rows.tolist(), numbers.tolist(), strict=True)):
            if finite[k]:
                result = RolloutResult(
                    parameters=dict(points[row]),
                    end=THRESHOLD if k in exceedances else end,
                    message="" if k in exceedances or end == HORIZON else batch.messages[row],
                    times=times,
                    quality=quality[k],
                    t_star=t,
                    h=best,
                    value=reported,
                    measures=tuple(of_row),
                    threshold=threshold,
                    exceedances=exceedances.get(k, times[:0]),
                    record={address: batch.outputs[address][row, :m] for address in task.record},
                    wall_time=wall_time,
                    computed=COMPILED,
                )
                yield row, result

    def _samples(
        self, k: int, measure: Measure, batch: CompiledBatch, counts: np.ndarray, valid: np.ndarray
    ) -> np.ndarray:
        """Return the samples of a measure, shape (n, m).

        Args:
            k: The number of the measure.
            measure: The measure.
            batch: The results of the rollouts.
            counts: The number of samples of each rollout, shape (n,); later ones do not matter.
            valid: Whether a rollout is valid, shape (n,); where f fails, it is set to False.
        """
        if f"measure {k}" in self._traced:
            traced: np.ndarray = batch.outputs[f"measure {k}"]
            valid &= measure.accepts(traced).all(axis=1)
            return traced
        samples = np.full((len(valid), len(self._rollouts.times)), nan)
        recorded = [batch.outputs[address] for address in measure.of]
        for row in np.flatnonzero(valid).tolist():
            try:
                times = batch.times[: counts[row]].tolist()
                if counts[row] == batch.counts[row] and batch.ends[row] < inf:
                    times[-1] = float(batch.ends[row])
                for i, t in enumerate(times):
                    samples[row, i] = measure([_value(each[row, i]) for each in recorded], time=t)
                    if k == 0 and measure is self._task.quality and self._exceeds(samples[row, i]):
                        break
            except QualityError:
                valid[row] = False
        return samples

    def _exceeds(self, sample: float) -> bool:
        task = self._task
        if task.threshold is None or task.run_on:
            return False
        return bool(exceeds(np.array(sample), task.threshold, minimize=task.minimize))


def _is_written_to_state(variable: Variable) -> bool:
    """Return whether a variable is no entry of the state, but what sets it writes into the state alone."""
    return variable.kind != A and variable.place is None and not variable.derived and not variable.carried_by


def _by_fields(points: Sequence[Parameters]) -> list[tuple[dict[str, Any], list[int]]]:
    """Return the values of the scenario's fields, by name, each with the numbers of the points that have them."""
    if points and not any(address.startswith(FIELD) for address in frozenset[str]().union(*points)):
        return [({}, list(range(len(points))))]
    groups: dict[Hashable, tuple[dict[str, Any], list[int]]] = {}
    for i, point in enumerate(points):
        fields, _ = split(point)
        groups.setdefault(values_key(fields), (fields, []))[1].append(i)
    return list(groups.values())


def _value(value: np.ndarray) -> float | np.ndarray:
    # f may write into its arguments.
    return value.copy() if value.shape else float(value)
