"""Gamma: runs rollouts of one testbed from any s0; equal rollouts have identical results."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import islice
from typing import Any

import numpy as np
from pydrake.systems.analysis import InitializeParams, Simulator, SimulatorStatus
from pydrake.systems.framework import Context

from vtbdrake.common.arrays import stacked
from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.drake_workarounds.making import making
from vtbdrake.drake_workarounds.step_watch import NoProgressError
from vtbdrake.rollout.pruning import PRUNED, Cutoff, Prospect
from vtbdrake.rollout.quality import READINGS, Measure, QualityError, exceeds, read_quality
from vtbdrake.rollout.recorded_motion import MotionPlayer, Recording
from vtbdrake.rollout.start import Start, StartContext
from vtbdrake.rollout.task import FAILED, HORIZON, QUALITY_FAILED, TERMINATED, THRESHOLD, RolloutResult, RolloutTask
from vtbdrake.state import Snapshot
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.testbed.integrator import apply_simulator_config, controls_error

# Message of a rollout that somebody has ended.
BY_HAND = "ended by hand"


class SimulationError(Exception):
    """A simulation cannot continue; the error becomes the outcome of its rollout."""


class CancelledError(Exception):
    """A rollout was cancelled; it has no outcome."""


class RolloutRunner:
    """Runs the rollouts of one task on one testbed, one after another; every thread needs its own.

    Args:
        task: The data that all rollouts share.
        testbed: A testbed of the task's scenario, which several runners may share; None: a new one is built.

    Raises:
        ValueError: The testbed draws into a Meshcat, the task names an address that the testbed does not have, or (a
            `MotionError`) its recorded motion depends on the varied variables.
    """

    def __init__(self, task: RolloutTask, testbed: VirtualTestbed | None = None) -> None:
        self.task = task
        self.testbed = testbed if testbed is not None else task.scenario.build()
        if not same_scenario(self.testbed, task):
            raise ValueError(
                "the testbed was built from another scenario than the task's: leave it out, and a new one is built"
            )
        if self.testbed.visualized:
            raise ValueError(
                "a rollout does not draw: build the scenario without meshcat, and without visualizers in its world"
            )
        self._variables = self.testbed.variables()
        # f first, then what else is measured.
        self._measures = [*([task.quality] if task.quality else []), *task.measures]
        self._bound_readers = [self.testbed.reader(a) for a in task.pruning.of] if task.pruning is not None else []
        self._recorders = {address: self.testbed.reader(address) for address in task.record}
        self._times = task.sample_times()
        self._s0 = self.testbed.default_context()
        if task.start is not None:
            self.testbed.restore(self._s0, task.start)
            # A copy of the running robot is simulated.
            self.testbed.switch(self._s0, "sim")
        self._timings = self.testbed.event_timings()
        self._controls_error = controls_error(self.testbed.simulator_config) and bool(self._s0.num_continuous_states())
        self._simulator = Simulator(self.testbed.diagram, self.testbed.default_context())
        self._context = self._simulator.get_mutable_context()
        self._readers = {a: self.testbed.bound_reader(self._context, a) for m in self._measures for a in m.of}
        self._step_watch = self.testbed.step_watch(self._simulator)
        self._world_state = _world_state(self.testbed, self._context)
        self._copier = self.testbed.copier_from(self.testbed)
        self._start_context = StartContext(self.testbed, self._s0, self._copier)
        self._player = MotionPlayer(task.motion, self.testbed) if task.motion is not None else None
        self._initialized: SimulatorStatus | None = None  # what the systems said at the begin of the rollout
        self.termination = ""  # why a system has ended the rollout of `simulate`; empty if none has
        self._timed = False  # Whether the times belong to the present start.
        self._set_times()
        # The hidden variables that differ from s0; None: any may, since a snapshot was restored.
        self._changed: set[str] | None = None

    def run(
        self,
        parameters: Mapping[str, Any],
        *,
        start: Start | None = None,
        cutoff: Cutoff | None = None,
        cancel: threading.Event | None = None,
    ) -> RolloutResult:
        """Run one rollout from s0.

        Args:
            parameters: Address -> value, set in s0.
            start: Where the rollout begins instead of the task's s0. Several rollouts from the same object prepare the
                start once.
            cutoff: When to end the rollout early.
            cancel: An event that stops the rollout.

        Raises:
            QualityError: f raises, is negative or NaN, and the task does not catch that.
            StartError: ``start`` does not fit the testbed.
            CancelledError: ``cancel`` was set, or the deadline of ``cutoff`` has passed.
            MotionError: The recorded motion of the task depends on the varied variables.
        """
        started = time.perf_counter()
        self._set_start(start)
        cutoff = cutoff or Cutoff()

        def raise_if_cancelled() -> None:
            if cutoff.is_over or (cancel is not None and cancel.is_set()):
                raise CancelledError
            interruptible.raise_interrupt()

        samples = _Samples(self, cutoff.to_beat)
        with Interruptible() as interruptible:
            with samples.failures_as_ends():
                recording = self._recording(parameters, raise_if_cancelled)
                self._reset(parameters)
                for index, (t, instant) in enumerate(zip(self._times.tolist(), self._instants.tolist(), strict=True)):
                    raise_if_cancelled()
                    self._jump(recording, index)
                    status = self._advance(t, instant)
                    if self._player is not None and index < len(recording.worlds):
                        self._player.compare(self._context, recording.worlds[index])
                    if samples.take(t, status):
                        break
                    if samples.pruned:
                        samples.end, samples.message = samples.pruned
                        break
                samples.refuse_overflow()
            return samples.result(dict(parameters), started)

    def drive(self, step: float) -> Generator[float, bool | None, RolloutResult]:
        """Run one rollout from s0 whose variables somebody sets while it runs.

        It pauses at t0 and then at every multiple of ``step`` after it, and yields the time since t0: there, variables
        may be set in `context`. It ends as `run` does, or where it is sent True.

        Args:
            step: Time between two pauses, in seconds.

        Yields:
            The time of each pause, in seconds from t0. A sample at that time was taken before; that at t0, after it.

        Returns:
            The result, with no parameters.

        Raises:
            QualityError: f raises, is negative or NaN, and the task does not catch that.
        """
        started = time.perf_counter()
        self._set_start(None)
        samples = _Samples(self, Cutoff().to_beat)
        with samples.failures_as_ends():
            self._reset({})
            for t, sampled, paused, instant in self._with_pauses(step):
                if t == 0.0 and (yield t):
                    samples.end, samples.message = TERMINATED, BY_HAND
                status = self._advance(t, instant)
                if (sampled or _terminated(status)) and samples.take(t, status):
                    break
                if samples.end == TERMINATED:
                    break
                if paused and t > 0.0 and t < self._times[-1] and (yield t):
                    samples.end, samples.message = TERMINATED, BY_HAND
                    break
            samples.refuse_overflow()
        return samples.result({}, started)

    def _with_pauses(self, step: float) -> Iterator[tuple[float, bool, bool, float]]:
        """Yield the sample times and the multiples of ``step``.

        Each comes with whether it is a sample, whether it is a multiple, and the simulator's time.
        """
        close = 1e-9 * step
        multiples = step * np.arange(np.floor((self._times[-1] + close) / step) + 1.0)
        times = np.sort(np.concatenate([self._times, multiples]))
        times = times[np.diff(times, prepend=-np.inf) > close]
        marks = np.zeros((2, len(times)), bool)
        for mark, marked in zip(marks, (self._times, multiples), strict=True):
            mark[np.searchsorted(times, marked + close) - 1] = True
        instants = self.task.instants(self._t0, self._timings, times=times)
        return zip(times.tolist(), *marks.tolist(), instants.tolist(), strict=True)

    def simulate(
        self, parameters: Mapping[str, Any], *, start: Start | None = None, begun: float | None = None
    ) -> Iterator[float]:
        """Simulate from s0, and yield every sample time when the simulation has reached it.

        At each of them, variables may be set in `context`. If a system ends the simulation, `termination` tells why,
        and the last time comes early.

        Args:
            parameters: Address -> value, set in s0.
            start: Where the rollout begins instead of the task's s0.
            begun: The time (s) at which a rollout began that goes on at ``start``, which lies at one of its samples:
                the other ones follow at the same instants, to the last bit. By default, it begins at the start.

        Raises:
            SimulationError: The simulation cannot go on.
            StartError: ``start`` does not fit the testbed.
        """
        self._set_start(start)
        self._reset(parameters)
        times, instants = self._times, self._instants
        if begun is not None:
            instants = self.task.instants(begun, self._timings, times=times)
            is_left = instants >= self._t0
            times, instants = times[is_left], instants[is_left]
        for t, instant in zip(times.tolist(), instants.tolist(), strict=True):
            status = self._advance(0.0 if instant == self._t0 else t, instant)
            if _terminated(status):
                self.termination = status.FormatMessage()
            yield t
            if self.termination:
                return

    def fork(self) -> Snapshot:
        """Return the state in `context`, from which the rest follows as in the present rollout.

        See `AddressedDiagram.fork`.
        """
        return self.testbed.fork(self._simulator)

    def measured(self, t: float) -> list[float]:
        """Return f and the other measures in the present state, at the sample time ``t``."""
        with _failures_as_outcomes:
            values = {address: read() for address, read in self._readers.items()}
        return [_sample(measure, [_copied(values[a]) for a in measure.of], t) for measure in self._measures]

    def state(self, parameters: Mapping[str, Any], t: float, *, start: Start | None = None) -> Any:
        """Return s(t) = Gamma(s0, t), equation (7), at a sample time, as a Snapshot.

        Args:
            parameters: Address -> value, set in s0.
            t: Time in seconds from t0.
            start: Where the rollout begins instead of the task's s0.

        Raises:
            ValueError: ``t`` is not a sample time.
            StartError: ``start`` does not fit the testbed.
            RuntimeError: The simulation fails before ``t``.
        """
        self._set_start(start)
        last = int(np.argmin(np.abs(self._times - t)))
        if not abs(self._times[last] - t) <= 1e-9:
            raise ValueError(f"t = {t} s is not a sample time; the nearest is {self._times[last]:g} s")
        try:
            with Interruptible() as interruptible:
                for _ in islice(self.simulate(parameters, start=start), last + 1):
                    interruptible.raise_interrupt()
                if self._context.get_time() < self._instants[last]:
                    raise SimulationError(self.termination)
        except SimulationError as failure:
            raise RuntimeError(f"the simulation fails before t = {t} s: {failure}") from failure
        return self.testbed.snapshot(self._context)

    def _set_start(self, start: Start | None) -> None:
        """Set where the next rollouts begin."""
        if start is not self._start_context.start or not self._timed:
            self._timed = False  # Ctrl-C may come before the times are set.
            try:
                self._start_context.set(start)
            finally:
                self._set_times()

    def _set_times(self) -> None:
        self._t0 = self._start_context.context.get_time()
        self._instants = self.task.instants(self._t0, self._timings, times=self._times)
        self._windows: list[float | None] = [None] * len(self._times)
        if self._player is not None:
            self._windows = self._player.window_starts(self._instants)
            by_default = self.task.start is None and self._start_context.start is None
            self._recordings = self._player.recordings(self._instants) if by_default else {}
        self._timed = True

    def _recording(self, parameters: Mapping[str, Any], raise_if_cancelled: Callable[[], None]) -> Recording:
        """Return the recorded motion; record it if necessary, with the followers' parameters as in s0, or as declared.

        From default starts a motion is recorded once for all tasks on this testbed with the same samples. If it fails
        or ends early, the rollouts along it are simulated from there on, and do the same.
        """
        if self._player is None:
            return Recording()
        fixed = self._player.fixed(parameters)
        key = values_key(fixed)
        if key not in self._recordings:
            recording = Recording()
            with suppress(SimulationError):
                self._reset({**fixed, **self._player.motion.while_recording})
                for t, instant, window in zip(self._times, self._instants, self._windows, strict=True):
                    raise_if_cancelled()
                    if window is not None and _terminated(self._advance(window, window)):
                        break
                    start = self._player.state(self._context) if window is not None else None
                    status = self._advance(t, instant)
                    recording.starts.append(start)
                    recording.worlds.append(self._player.world(self._context))
                    if _terminated(status):
                        break
            self._recordings[key] = recording
        return self._recordings[key]

    def _jump(self, recording: Recording, index: int) -> None:
        """Go to the beginning of the window of a sample, if it has one and it was recorded."""
        window = self._windows[index]
        start = recording.starts[index] if index < len(recording.starts) else None
        if self._player is None or window is None or start is None:
            return
        apply_simulator_config(self.testbed.simulator_config, self._simulator)
        self._simulator.set_target_realtime_rate(0.0)
        self._player.put(self._context, window, start)
        with _failures_as_outcomes, making():
            self._simulator.Initialize(InitializeParams(suppress_initialization_events=True))

    def _reset(self, parameters: Mapping[str, Any]) -> None:
        self.termination = ""
        # A new integrator: the step size of a used one would change the trajectory.
        apply_simulator_config(self.testbed.simulator_config, self._simulator)
        self._simulator.set_target_realtime_rate(0.0)
        changed = None if self._changed is None else self._changed | self._start_context.hidden
        self._copier.copy(self._start_context.context, self._context, hidden=changed)
        self._changed = {self._variables[a].carried_by for a in parameters} - {""}
        restored = self.task.start is not None or self._start_context.start is not None
        with _failures_as_outcomes:
            self._variables.write(self._context, parameters)
            # Initialization events are part of a default s0; in a restored s0 they have happened already.
            before = {} if restored else self._variables.read(self._context, list(parameters))
            params = InitializeParams(suppress_initialization_events=restored)
            with making():
                self._initialized = self._simulator.Initialize(params)
                self._refuse_nonfinite_derivatives()
        for address, value in before.items():
            after = self._variables[address].get(self._context)
            if not np.array_equal(after, value):
                raise ValueError(
                    f"{address} was set to {value}, but an initialization event of the testbed has made {after} of "
                    "it: vary what that event reads"
                )

    def _advance(self, t: float, instant: float) -> SimulatorStatus:
        if t == 0.0:
            assert self._initialized is not None, "a rollout is reset before it advances"
            return self._initialized  # A system may ask for the end there already.
        try:
            with _failures_as_outcomes, self._step_watch:
                status = self._simulator.AdvanceTo(instant)
            self._refuse_nonfinite(t)
        except SimulationError as failure:
            raise self._with_command(failure) from failure.__cause__
        return status

    def _with_command(self, failure: SimulationError) -> SimulationError:
        """Return the failure; if the DPS commands what is not finite, with the name of that signal."""
        named = self.testbed.named_command(self._context, failure)
        return failure if named is failure else SimulationError(str(named))

    def _refuse_nonfinite_derivatives(self) -> None:
        # An integrator with error control would never end its first step. It needs these derivatives anyway.
        if self._controls_error:
            try:
                with _failures_as_outcomes:
                    derivatives = self.testbed.diagram.EvalTimeDerivatives(self._context)
            except SimulationError as failure:
                raise self._with_command(failure) from failure.__cause__
            if not np.isfinite(derivatives.CopyToVector()).all():
                raise SimulationError(self.testbed.reason_for_no_step(self._context))

    def _refuse_nonfinite(self, t: float) -> None:
        # NaN is allowed in a DPS, for unknown values, but not in the simulated world.
        if not np.isfinite(self._world_state()).all():
            raise SimulationError(f"the state is not finite at t = {t:g} s: the simulation diverged")

    @property
    def steps(self) -> int:
        """Return the number of the integrator's steps in the last rollout."""
        return int(self._simulator.get_num_steps_taken())

    @property
    def context(self) -> Context:
        """Return the context of the last rollout, at its end."""
        return self._context


def same_scenario(testbed: VirtualTestbed, task: RolloutTask) -> bool:
    """Return whether the testbed was built from the scenario of the task.

    Args:
        testbed: The testbed.
        task: The task, whose scenario is compared by its record.
    """
    return testbed.scenario is not None and testbed.scenario.record() == task.scenario.record()


def _world_state(testbed: VirtualTestbed, context: Context) -> Callable[[], np.ndarray]:
    """Return a function that returns what moves in the simulated world of this context."""
    plant = testbed.plant
    if plant is None or plant.time_step() == 0.0:
        return lambda: context.get_continuous_state_vector().CopyToVector()
    plant_context = plant.GetMyContextFromRoot(context)
    return lambda: plant.GetPositionsAndVelocities(plant_context)


def _terminated(status: SimulatorStatus) -> bool:
    return not status.succeeded()


class _FailuresAsOutcomes:
    """A context manager that turns the exceptions of a failing simulation into SimulationError."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, NoProgressError):
            raise SimulationError(str(error)) from error
        if isinstance(error, FAILURES) and not isinstance(error, SimulationError):
            raise SimulationError(error_text(error)) from error


_failures_as_outcomes = _FailuresAsOutcomes()


class _Samples:
    """The samples of the present rollout, and how it ends.

    Attributes:
        end: Why the rollout ends, see `RolloutResult`.
        message: The same in a sentence; empty at the horizon and beyond the threshold.
        pruned: Why it should end early, in a word and in a sentence, see `Prospect`.
    """

    def __init__(self, runner: RolloutRunner, to_beat: float) -> None:
        self._runner = runner
        task = runner.task
        self._prospect: Prospect | None = None
        if task.pruning is not None and task.quality is not None:
            self._prospect = Prospect(task.pruning, task.quality, task.measures, task.horizon, to_beat)
        self.end, self.message = HORIZON, ""
        self.pruned: tuple[str, str] | None = None
        self._times: list[float] = []
        self._clock = np.nan
        self._samples: list[list[float]] = [[] for _ in runner._measures]
        self._record: dict[str, list[Any]] = {address: [] for address in runner.task.record}

    @contextmanager
    def failures_as_ends(self) -> Iterator[None]:
        """Let the rollout end where its simulation fails, or a function that the task catches."""
        try:
            yield
        except SimulationError as failure:
            self.end, self.message = FAILED, str(failure)
        except QualityError as failure:
            if not self._runner.task.catch:
                raise
            self.end, self.message = FAILED, f"{QUALITY_FAILED}{failure}"

    def take(self, t: float, status: SimulatorStatus) -> bool:
        """Sample the state at t, or where a system has ended the simulation; return whether the rollout is over."""
        runner, terminated = self._runner, _terminated(status)
        is_beyond = self._add(runner.context.get_time() - runner._t0 if terminated else t)
        if is_beyond and not runner.task.run_on:
            return True
        if terminated:
            self.end, self.message = TERMINATED, status.FormatMessage()
        return terminated

    def _add(self, t: float) -> bool:
        """Sample f, the measures and the records; return whether the threshold is exceeded."""
        runner, task = self._runner, self._runner.task
        with _failures_as_outcomes:
            recorded = {address: read(runner._context) for address, read in runner._recorders.items()}
        new = runner.measured(t)
        self._times.append(t)
        self._clock = runner._context.get_time()
        for address, value in recorded.items():
            self._record[address].append(value)
        for samples, sample in zip(self._samples, new, strict=True):
            samples.append(sample)
        if self._prospect is not None:
            with _failures_as_outcomes:
                values = [read(runner._context) for read in runner._bound_readers]
            self.pruned = self._prospect.update(t, new, values)
        if task.quality is None or task.threshold is None:
            return False
        return bool(exceeds(np.array(new[0]), task.threshold, minimize=task.minimize))

    def refuse_overflow(self) -> None:
        """Check that integrals are finite, as all their samples are.

        Raises:
            QualityError: An integral has overflowed.
        """
        times = np.array(self._times)
        for measure, samples in zip(self._runner._measures, self._samples, strict=True):
            if measure.reading == "integral" and not np.isfinite(
                READINGS["integral"](times, np.array(samples), True)[1]
            ):
                raise QualityError(
                    f"the integral of {measure.name} over {times[-1]:g} s is too large for a number; the largest "
                    f"sample is {max(map(abs, samples)):g}: state it in a larger unit"
                )

    def result(self, parameters: dict[str, Any], started: float) -> RolloutResult:
        task = self._runner.task
        result = _result_of_samples(
            task,
            parameters,
            np.array(self._times),
            [np.array(samples) for samples in self._samples],
            {address: stacked(values) for address, values in self._record.items()},
            end=self.end,
            message=self.message,
            reachable=None if self._prospect is None else self._prospect.reachable,
            wall_time=time.perf_counter() - started,
        )
        if not (task.keep_state and np.isfinite(result.t_star)):
            return result
        state = self._state(parameters, result.t_star)
        return replace(result, state=state, wall_time=time.perf_counter() - started)

    def _state(self, parameters: dict[str, Any], t_star: float) -> Any:
        runner = self._runner
        # After t*, a rollout may have gone on and failed: simulate it again up to t*. Along a recorded motion, the
        # followers have only the state that f needs.
        at_end = runner.task.motion is None and t_star == self._times[-1] and runner.context.get_time() == self._clock
        if at_end:
            return runner.testbed.snapshot(runner.context)
        return runner.state(parameters, t_star, start=runner._start_context.start)


def _result_of_samples(
    task: RolloutTask,
    parameters: dict[str, Any],
    times: np.ndarray,
    samples: Sequence[np.ndarray],
    record: Mapping[str, Any],
    *,
    end: str,
    message: str,
    reachable: float | None,
    wall_time: float,
) -> RolloutResult:
    """Return the outcome of a rollout, equations (14) to (17), from what was sampled.

    Args:
        task: The task.
        parameters: Address -> value that was set in s0.
        times: The sample times from t0, in seconds, shape (n,).
        samples: Those of f, if there is one, and of the other measures, each of shape (n,).
        record: Address -> the recorded values.
        end: Why it ended, if no sample has exceeded the threshold.
        message: The reason.
        reachable: For a pruned rollout, the best that it could still have reached.
        wall_time: Wall time in seconds.
    """
    f = task.quality
    of_quality = samples[0] if f is not None else np.array([])
    exceeded = exceeds(of_quality, task.threshold, minimize=task.minimize)
    t_star, h, value = np.nan, np.nan, np.nan
    measures: tuple[float, ...] = ()
    if exceeded.any():
        # t* = min G1, also in a rollout that runs on and fails later.
        end = THRESHOLD
    if times.size and end != FAILED:
        if f is not None:
            t_star, value = map(float, read_quality(f, times, of_quality, task.threshold))
            if end == PRUNED and reachable is not None:
                value = reachable
            h = float(f.quality(np.array(value)))
        pairs = zip(task.measures, samples[len(samples) - len(task.measures) :], strict=True)
        measures = tuple(float(measure.read(times, measured)) for measure, measured in pairs)
    return RolloutResult(
        parameters=parameters,
        end=end,
        message=message,
        t_star=t_star,
        h=h,
        value=value,
        measures=measures,
        threshold=task.f_m,
        exceedances=times[exceeded] if f is not None else np.array([]),
        times=times,
        quality=f.quality(of_quality) if f is not None else np.array([]),
        record=record,
        wall_time=wall_time,
    )


def _copied(value: Any) -> Any:
    # A function may write into its arguments, which others get, too.
    return value.copy() if isinstance(value, np.ndarray) else value


def _sample(measure: Measure, values: Sequence[Any], t: float) -> float:
    try:
        return measure(values, time=t)
    except QualityError as error:
        # f may accept NaN (nothing was detected). If it does not, NaN is a failure of the simulation.
        if all(np.isfinite(v).all() for v in values if isinstance(v, float | np.ndarray)):
            raise
        raise SimulationError(f"a variable of a {measure.role} is not finite: {error}") from error


def values_key(values: Mapping[str, Any]) -> Hashable:
    """Return a key for values by name or address, compared by their representation.

    1, 1.0 and True are equal, and so are 0.0 and -0.0, but not to a testbed.
    """
    return frozenset((name, repr(value)) for name, value in values.items())
