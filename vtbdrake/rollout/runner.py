"""Gamma: runs rollouts of one testbed from any s0; equal rollouts have identical results."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.systems.analysis import InitializeParams, Simulator, SimulatorStatus
from pydrake.systems.framework import Context

from vtbdrake.failures import FAILURES, error_text
from vtbdrake.rollout.pruning import PRUNED, Cutoff, Prospect
from vtbdrake.rollout.quality import READINGS, Measure, Quality, QualityError, best_sample, exceeds
from vtbdrake.rollout.recorded_motion import MotionPlayer, Recording
from vtbdrake.rollout.start import Beginning, Start
from vtbdrake.rollout.task import FAILED, HORIZON, QUALITY_FAILED, TERMINATED, THRESHOLD, RolloutResult, RolloutTask
from vtbdrake.testbed import Scenario, ScenarioError, VirtualTestbed
from vtbdrake.testbed.integrator import apply_simulator_config, controls_error
from vtbdrake.testbed.interrupt import Interruptible


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
        self._readers = {a: self.testbed.reader(a) for measure in self._measures for a in measure.of}
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
        self._world_state = _world_state(self.testbed, self._context)
        self._copier = self.testbed.copier_from(self.testbed)
        self._beginning = Beginning(self.testbed, self._s0, self._copier)
        self._player = MotionPlayer(task.motion, self.testbed) if task.motion is not None else None
        self._timed = False  # Whether the times are those of the present start.
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
        begin = time.perf_counter()
        self._begin(start)
        cutoff = cutoff or Cutoff()

        def check() -> None:
            if cutoff.is_over or (cancel is not None and cancel.is_set()):
                raise CancelledError
            interruptible.check()

        samples = _Samples(self, cutoff.to_beat)
        end, message = HORIZON, ""
        with Interruptible() as interruptible:
            try:
                recording = self._recording(parameters, check)
                self._reset(parameters)
                for index, (t, instant) in enumerate(zip(self._times.tolist(), self._instants.tolist(), strict=True)):
                    check()
                    self._jump(recording, index)
                    status = self._advance(t, instant)
                    if self._player is not None and index < len(recording.worlds):
                        self._player.check(self._context, recording.worlds[index])
                    terminated = _terminated(status)
                    reached = self._context.get_time() - self._t0 if terminated else t
                    if samples.take(reached) and not self.task.run_on:
                        break
                    if terminated:
                        end, message = TERMINATED, status.FormatMessage()
                        break
                    if samples.ending:
                        end, message = samples.ending
                        break
                samples.check()
            except SimulationError as failure:
                end, message = FAILED, str(failure)
            except QualityError as failure:
                if not self.task.catch:
                    raise
                end, message = FAILED, f"{QUALITY_FAILED}{failure}"
            return samples.result(dict(parameters), end, message, begin)

    def simulate(self, parameters: Mapping[str, Any], *, start: Start | None = None) -> Iterator[float]:
        """Simulate from s0, and yield every sample time when the simulation has reached it.

        Args:
            parameters: Address -> value, set in s0.
            start: Where the rollout begins instead of the task's s0.

        Raises:
            SimulationError: The simulation cannot go on.
            StartError: ``start`` does not fit the testbed.
        """
        self._begin(start)
        self._reset(parameters)
        for t, instant in zip(self._times, self._instants, strict=True):
            status = self._advance(t, instant)
            yield float(t)
            if _terminated(status):
                return

    def measured(self, t: float) -> list[float]:
        """Return f and the other measures in the present state, at the sample time ``t``."""
        with _failures_as_outcomes:
            values = {address: read(self._context) for address, read in self._readers.items()}
        return [_sample(measure, [_own(values[a]) for a in measure.of], t) for measure in self._measures]

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
        self._begin(start)
        last = int(np.argmin(np.abs(self._times - t)))
        if not abs(self._times[last] - t) <= 1e-9:
            raise ValueError(f"t = {t} s is not a sample time; the nearest is {self._times[last]:g} s")
        try:
            with Interruptible() as interruptible:
                self._reset(parameters)
                for time_, instant in zip(self._times[: last + 1], self._instants[: last + 1], strict=True):
                    interruptible.check()
                    status = self._advance(time_, instant)
                    if _terminated(status) and self._context.get_time() < self._instants[last]:
                        raise SimulationError(status.FormatMessage())
        except SimulationError as failure:
            raise RuntimeError(f"the simulation fails before t = {t} s: {failure}") from failure
        return self.testbed.snapshot(self._context)

    def _begin(self, start: Start | None) -> None:
        """Set where the next rollouts begin."""
        if start is not self._beginning.start or not self._timed:
            self._timed = False  # Ctrl-C may come before the times are set.
            try:
                self._beginning.set(start)
            finally:
                self._set_times()

    def _set_times(self) -> None:
        self._t0 = self._beginning.context.get_time()
        self._instants = self.task.instants(self._t0, self._timings)
        self._windows: list[float | None] = [None] * len(self._times)
        if self._player is not None:
            self._windows = self._player.begins(self._instants)
            by_default = self.task.start is None and self._beginning.start is None
            self._recordings = self._player.recordings(self._instants) if by_default else {}
        self._timed = True

    def _recording(self, parameters: Mapping[str, Any], check: Callable[[], None]) -> Recording:
        """Return the recorded motion, in which the parameters of the followers are as in s0; record it if necessary.

        From default starts a motion is recorded once for all tasks on this testbed with the same samples. If it fails
        or ends early, the rollouts along it are simulated from there on, and do the same.
        """
        if self._player is None:
            return Recording()
        others = self._player.fixed(parameters)
        key = _key(others)
        if key not in self._recordings:
            recording = Recording()
            with suppress(SimulationError):
                self._reset(others)
                for t, instant, window in zip(self._times, self._instants, self._windows, strict=True):
                    check()
                    if window is not None and _terminated(self._advance(window, window)):
                        break
                    start = self._player.take(self._context) if window is not None else None
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
        with _failures_as_outcomes:
            self._simulator.Initialize(InitializeParams(suppress_initialization_events=True))

    def _reset(self, parameters: Mapping[str, Any]) -> None:
        # A new integrator: the step size of a used one would change the trajectory.
        apply_simulator_config(self.testbed.simulator_config, self._simulator)
        self._simulator.set_target_realtime_rate(0.0)
        changed = None if self._changed is None else self._changed | self._beginning.hidden
        self._copier.copy(self._beginning.context, self._context, hidden=changed)
        self._changed = {self._variables[a].carried_by for a in parameters} - {""}
        restored = self.task.start is not None or self._beginning.start is not None
        with _failures_as_outcomes:
            self._variables.write(self._context, parameters)
            before = self._variables.read(self._context, list(parameters))
            # Initialization events are part of a default s0; in a restored s0 they have happened already.
            params = InitializeParams(suppress_initialization_events=restored)
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
            return self._initialized  # A system may ask for the end there already.
        try:
            with _failures_as_outcomes:
                status = self._simulator.AdvanceTo(instant)
            self._refuse_nonfinite(t)
        except SimulationError as failure:
            raise self._with_command(failure) from failure.__cause__
        return status

    def _refuse_nonfinite_derivatives(self) -> None:
        # An integrator with error control would never end its first step. It needs these derivatives anyway.
        if self._controls_error:
            derivatives = self.testbed.diagram.EvalTimeDerivatives(self._context)
            if not np.isfinite(derivatives.CopyToVector()).all():
                raise SimulationError("the time derivatives are not finite at t = 0 s")

    def _with_command(self, failure: SimulationError) -> SimulationError:
        """Return the failure; if the DPS commands what is not finite, with the name of that signal."""
        own = self.testbed.dps.GetMyContextFromRoot(self._context)
        for signal in self.testbed.interface.act:
            with suppress(*FAILURES):
                command = self.testbed.dps.GetOutputPort(signal.name).Eval(own) if signal.is_vector else np.zeros(0)
                if not np.isfinite(command).all() and signal.name not in str(failure):
                    return SimulationError(f"the DPS commands {signal.name} = {command}; {failure}")
        return failure

    def _refuse_nonfinite(self, t: float) -> None:
        # NaN is allowed in a DPS, for unknown values, but not in the simulated world.
        if not np.isfinite(self._world_state()).all():
            raise SimulationError(f"the state is not finite at t = {t:g} s: the simulation diverged")

    @property
    def steps(self) -> int:
        """Return how many steps the integrator took in the last rollout."""
        return int(self._simulator.get_num_steps_taken())

    @property
    def context(self) -> Context:
        """Return the context of the last rollout, at its end."""
        return self._context


def same_scenario(testbed: VirtualTestbed, task: RolloutTask) -> bool:
    """Return whether the testbed was built from the scenario of the task."""
    return testbed.scenario is not None and testbed.scenario.record() == task.scenario.record()


def _world_state(testbed: VirtualTestbed, context: Context) -> Callable[[], np.ndarray]:
    """Return a function that returns what moves in the simulated world of this context."""
    plant = testbed.plant
    if plant is None or plant.time_step() == 0.0:
        return lambda: context.get_continuous_state_vector().CopyToVector()
    own = plant.GetMyContextFromRoot(context)
    return lambda: plant.GetPositionsAndVelocities(own)


def _terminated(status: SimulatorStatus) -> bool:
    return not status.succeeded()


class _FailuresAsOutcomes:
    """A context manager that turns the exceptions of a failing simulation into SimulationError."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, FAILURES) and not isinstance(error, SimulationError):
            raise SimulationError(error_text(error)) from error


_failures_as_outcomes = _FailuresAsOutcomes()


class _Samples:
    """The samples of the present rollout."""

    def __init__(self, runner: RolloutRunner, to_beat: float) -> None:
        self._runner = runner
        task = runner.task
        self._prospect: Prospect | None = None
        if task.pruning is not None and task.quality is not None:
            self._prospect = Prospect(task.pruning, task.quality, task.measures, task.horizon, to_beat)
        # Why the rollout ends early, in a word and in a sentence.
        self.ending: tuple[str, str] | None = None
        self._times: list[float] = []
        self._clock = np.nan
        self._samples: list[list[float]] = [[] for _ in runner._measures]
        self._record: dict[str, list[Any]] = {address: [] for address in runner.task.record}

    def take(self, t: float) -> bool:
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
            self.ending = self._prospect.take(t, new, values)
        if task.quality is None or task.threshold is None:
            return False
        return bool(exceeds(np.array(new[0]), task.threshold, minimize=task.minimize))

    def check(self) -> None:
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

    def result(self, parameters: dict[str, Any], end: str, message: str, begin: float) -> RolloutResult:
        task, f = self._runner.task, self._runner.task.quality
        times = np.array(self._times)
        samples = np.array(self._samples[0]) if f is not None else np.array([])
        exceeded = exceeds(samples, task.threshold, minimize=task.minimize)
        t_star, h, value, state = np.nan, np.nan, np.nan, None
        measures: tuple[float, ...] = ()
        if exceeded.any():
            # t* = min G1, also in a rollout that runs on and fails later.
            end = THRESHOLD
        if times.size and end != FAILED:
            if f is not None:
                t_star, value = _t_star(f, times, samples, task.threshold)
                if end == PRUNED and self._prospect is not None:
                    value = self._prospect.reachable
                h = float(f.quality(np.array(value)))
                if task.keep_state:
                    state = self._state(parameters, t_star)
            pairs = zip(task.measures, self._samples[len(self._samples) - len(task.measures) :], strict=True)
            measures = tuple(measure.read(times, np.array(measured)) for measure, measured in pairs)
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
            quality=f.quality(samples) if f is not None else np.array([]),
            record={address: _stack(values) for address, values in self._record.items()},
            state=state,
            wall_time=time.perf_counter() - begin,
        )

    def _state(self, parameters: dict[str, Any], t_star: float) -> Any:
        runner = self._runner
        # After t*, a rollout may have gone on and failed: simulate it again up to t*. Along a recorded motion, the
        # followers have only the state that f needs.
        at_end = runner.task.motion is None and t_star == self._times[-1] and runner.context.get_time() == self._clock
        if at_end:
            return runner.testbed.snapshot(runner.context)
        return runner.state(parameters, t_star, start=runner._beginning.start)


def _own(value: Any) -> Any:
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


def _t_star(f: Quality, times: np.ndarray, samples: np.ndarray, threshold: float | None) -> tuple[float, float]:
    """Return (t*, f or the cost there), equations (14) to (17); for other readings than ``best``, time and number."""
    if f.reading != "best":
        return READINGS[f.reading](times, samples, not f.minimize)
    index = best_sample(samples, threshold=threshold, minimize=f.minimize)
    return float(times[index]), float(samples[index])


def _stack(values: list[Any]) -> Any:
    return np.array(values) if all(isinstance(value, float | np.ndarray) for value in values) else values


FIELD = "scenario."
# Number of testbeds that are kept besides a given one.
KEPT = 4
# Number of runners that a thread keeps; an executor may run any number of tasks.
_RUNNERS = 16


class BuildError(Exception):
    """No testbed can be built with some values of its scenario's fields; the error is the outcome of the rollout."""


def split(point: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split a point into the scenario's fields, by their names, and the variables of s0, by address."""
    fields = {address.removeprefix(FIELD): value for address, value in point.items() if address.startswith(FIELD)}
    return fields, {address: value for address, value in point.items() if not address.startswith(FIELD)}


def failed(point: Mapping[str, Any], message: str) -> RolloutResult:
    """Return the result of a rollout that could not be run."""
    return RolloutResult(parameters=dict(point), end=FAILED, message=message, times=np.array([]), quality=np.array([]))


class Testbeds:
    """The testbeds last used, built once per distinct scenario and shared by threads.

    One testbed is built at a time: CasADi's expressions, of which a scenario may make its DPS, count their references
    without atomics, and its Python package gives up the interpreter lock.

    Args:
        known: A testbed that exists already and is never dropped.
        kept: Number of other testbeds that are kept; the least recently used one is dropped first.
    """

    def __init__(self, known: VirtualTestbed | None = None, *, kept: int = KEPT) -> None:
        if kept < 1:
            raise ValueError(f"at least one testbed must be kept, not {kept}")
        self.kept = kept
        self._known = known if known is not None and known.scenario is not None else None
        self._built: OrderedDict[Hashable, VirtualTestbed] = OrderedDict()
        self._lock = threading.Lock()
        self._building = threading.Lock()

    def get(self, scenario: Scenario) -> VirtualTestbed:
        """Return the testbed of ``scenario``; build it if it is not there, when other threads have built theirs."""
        key = _key(scenario.record())
        if self._known is not None and self._known.scenario is not None and key == _key(self._known.scenario.record()):
            return self._known
        if (testbed := self._used(key)) is not None:
            return testbed
        with self._building:
            if (testbed := self._used(key)) is not None:
                return testbed
            testbed = scenario.build()
            with self._lock:
                self._built[key] = testbed
                dropped = self._built.popitem(last=False) if len(self._built) > self.kept else None
            del dropped  # Here, so that it is taken apart while nothing is built, and without the lock.
            return testbed

    def _used(self, key: Hashable) -> VirtualTestbed | None:
        with self._lock:
            if key in self._built:
                self._built.move_to_end(key)
            return self._built.get(key)

    def touch(self, testbed: VirtualTestbed) -> None:
        """Mark ``testbed`` as just used."""
        with self._lock:
            for key in [key for key, built in self._built.items() if built is testbed]:
                self._built.move_to_end(key)

    def __contains__(self, testbed: object) -> bool:
        with self._lock:
            return testbed is self._known or any(built is testbed for built in self._built.values())

    def __len__(self) -> int:
        return len(self._built)

    def clear(self) -> None:
        with self._lock:
            self._built.clear()


class Runners:
    """The runners last used by each thread: one for every task and every choice of scenario fields."""

    def __init__(self, testbeds: Testbeds) -> None:
        self._testbeds = testbeds
        self._threads = threading.local()

    def get(self, task: RolloutTask, fields: Mapping[str, Any]) -> RolloutRunner:
        """Return this thread's runner of ``task``, with ``fields`` (name -> value) set in its scenario.

        Raises:
            ScenarioError: There is no such field, or the scenario refuses its value.
            BuildError: No testbed can be built with these fields for another reason.
            SnapshotError: The task starts from a snapshot of the scenario without these fields.
        """
        mine: OrderedDict[Hashable, tuple[RolloutTask, RolloutRunner]]
        mine = self._threads.__dict__.setdefault("runners", OrderedDict())
        # By identity: comparing tasks can take longer than running them.
        key = (id(task), _key(fields))
        if key not in mine:
            mine[key] = (task, self._make(task, fields))
            # Other threads may have dropped the new one's testbed already: it is used all the same.
            for old in [k for k, (_, runner) in mine.items() if k != key and runner.testbed not in self._testbeds]:
                del mine[old]
            if len(mine) > _RUNNERS:
                mine.popitem(last=False)
        mine.move_to_end(key)
        runner = mine[key][1]
        self._testbeds.touch(runner.testbed)
        return runner

    def _make(self, task: RolloutTask, fields: Mapping[str, Any]) -> RolloutRunner:
        if not fields:
            return RolloutRunner(task, self._testbeds.get(task.scenario))
        changed = replace(task, scenario=task.scenario.with_fields(fields))
        try:
            testbed = self._testbeds.get(changed.scenario)
        except ScenarioError:
            raise
        except FAILURES as error:
            chosen = ", ".join(f"{FIELD}{name} = {value!r}" for name, value in fields.items())
            raise BuildError(f"no testbed can be built with {chosen}: {error_text(error)}") from error
        return RolloutRunner(changed, testbed)

    def run(
        self,
        task: RolloutTask,
        point: Mapping[str, Any],
        *,
        start: Start | None = None,
        cutoff: Cutoff | None = None,
        cancel: threading.Event | None = None,
        begin: Callable[[], Any] | None = None,
    ) -> RolloutResult:
        """Run one rollout at ``point``, in this thread; see `RolloutRunner.run`.

        A testbed that cannot be built with the point's fields is a failed rollout; fields that the scenario refuses
        are an error.

        Args:
            task: The task of the rollout.
            point: Address, or scenario field with its prefix -> value.
            start: Where the rollout begins instead of the task's s0.
            cutoff: When to end the rollout early.
            cancel: An event that stops the rollout.
            begin: Called when the testbed has been built, before the rollout.
        """
        with Interruptible():
            fields, variables = split(point)
            try:
                runner = self.get(task, fields)
            except BuildError as error:
                return failed(point, str(error))
            if begin is not None:
                begin()
            result = runner.run(variables, start=start, cutoff=cutoff, cancel=cancel)
            return replace(result, parameters=dict(point)) if fields else result

    def clear(self) -> None:
        """Forget the runners of all threads, and the testbeds."""
        self._threads = threading.local()
        self._testbeds.clear()


def _key(values: Mapping[str, Any]) -> Hashable:
    # By their representation: 1, 1.0 and True are equal, and so are 0.0 and -0.0, but not to a testbed.
    return frozenset((name, repr(value)) for name, value in values.items())
