"""The task of rollouts, and their results."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite, isnan, nan
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from vtbdrake.common.argument_checks import as_addresses, as_number
from vtbdrake.rollout.pruning import Pruning
from vtbdrake.rollout.quality import Measure, Quality
from vtbdrake.rollout.recorded_motion import RecordedMotion
from vtbdrake.state import Snapshot
from vtbdrake.testbed import Scenario
from vtbdrake.testbed.instants import sample_instants, sample_times
from vtbdrake.testbed.scenario import check_is_scenario

THRESHOLD = "threshold"
HORIZON = "horizon"
TERMINATED = "terminated"
FAILED = "failed"
# Begin of the message of a rollout in which the function of a quality or constraint failed.
QUALITY_FAILED = "QualityError: "


def catches(on_error: str) -> bool:
    """Return whether an error of f fails only its rollout, see `RolloutTask.catch`.

    Raises:
        ValueError: ``on_error`` is neither ``record`` nor ``raise``.
    """
    if on_error not in ("record", "raise"):
        raise ValueError(f"on_error is 'record' or 'raise', not {on_error!r}")
    return on_error == "record"


def quality_warning(message: str) -> str:
    """Return a warning if a rollout's message says that f failed, as f itself may be wrong; else an empty text."""
    if not message.startswith(QUALITY_FAILED):
        return ""
    text = message.removeprefix(QUALITY_FAILED)
    return f"{text}. The rollout counts as failed, and so do others of this kind; on_error='raise' ends the run"


@dataclass(frozen=True, repr=False)
class RolloutResult:
    """The outcome of one rollout.

    Attributes:
        parameters: Address -> value that was set in s0.
        end: Why the rollout ended: ``threshold`` (f' exceeded f_m), ``horizon`` (t_m was reached), ``terminated`` (a
            system of the testbed requested it), ``pruned`` or ``stalled`` (see `Pruning`) or ``failed``.
        message: The reason for a failure, termination or pruning.
        t_star: Time t* in seconds from t0, equation (16). For the reading ``worst``, the time of the worst sample; for
            ``end`` and ``integral``, the end. NaN if the rollout failed or had no quality.
        h: Quality f'(s^0, t*), equation (17), or its other reading; larger is better. NaN where t_star is.
        value: The value h in the user's terms: the cost, if f is one, else h. For a pruned rollout, the best that it
            could still have reached.
        measures: The values of the task's other measures, in their order; empty if the rollout failed.
        threshold: Threshold f_m of f'; for a cost, 1 / (1 + the threshold of the cost).
        exceedances: The set G1, equation (14): the sample times at which f' exceeded f_m, in seconds from t0; complete
            only with ``run_on``.
        times: Sample times from t0, in seconds, shape (n,).
        quality: The quality trajectory f' at ``times``, equation (13), shape (n,); for a cost, 1 / (1 + cost).
        record: Address -> the recorded values at ``times``: arrays of shape (n, ...), lists for abstract ports.
        state: The state s(t*) with ``keep_state``, else None.
        wall_time: Wall time in seconds; of a compiled rollout, its share of the batch.
        computed: How it was computed: ``drake``, or ``compiled`` (see `CompiledExecutor`).
    """

    parameters: Mapping[str, Any]
    end: str
    times: np.ndarray
    quality: np.ndarray
    t_star: float = nan
    h: float = nan
    value: float = nan
    measures: tuple[float, ...] = ()
    threshold: float = inf
    exceedances: np.ndarray = field(default_factory=lambda: np.array([]))
    message: str = ""
    record: Mapping[str, Any] = field(default_factory=dict)
    state: Snapshot | None = None
    wall_time: float = nan
    computed: str = "drake"

    def __repr__(self) -> str:
        values = ", ".join(f"{address}={np.asarray(v).tolist()}" for address, v in self.parameters.items())
        if self.failed:
            return f"{type(self).__name__}({{{values}}}: failed: {self.message})"
        end = float(self.times[-1]) if len(self.times) else nan
        best = "" if isnan(self.value) else f", value {self.value:g} at t* = {self.t_star:g} s"
        return f"{type(self).__name__}({{{values}}}: {self.end} after {end:g} s{best})"

    @property
    def failed(self) -> bool:
        """Return whether the rollout failed."""
        return self.end == FAILED

    def identical(self, other: RolloutResult) -> bool:
        """Return whether nothing but the wall time and the way it was computed differs, to the last bit."""
        return (
            (self.end, self.message) == (other.end, other.message)
            and self.parameters.keys() == other.parameters.keys()
            and all(np.array_equal(v, other.parameters[k]) for k, v in self.parameters.items())
            and _same(self.t_star, other.t_star)
            and _same(self.h, other.h)
            and _same(self.value, other.value)
            and _same(list(self.measures), list(other.measures))
            and self.threshold == other.threshold
            and _same(self.exceedances, other.exceedances)
            and _same(self.times, other.times)
            and _same(self.quality, other.quality)
            and self.record.keys() == other.record.keys()
            and all(_same(value, other.record[key]) for key, value in self.record.items())
            and (self.state is None) == (other.state is None)
            and (self.state is None or other.state is None or not self.state.compare(other.state))
        )


def check_call(task: Any, points: Any) -> None:
    """Refuse what no executor can run.

    Args:
        task: What the user gives as the task.
        points: What the user gives as the points.

    Raises:
        ValueError: It is no task, or the points are no list of mappings.
    """
    if not isinstance(task, RolloutTask):
        raise ValueError(f"an executor runs a RolloutTask, such as problem.task, not {task!r}")
    if not isinstance(points, Sequence) or not all(isinstance(point, Mapping) for point in points):
        raise ValueError(f"an executor runs a list of points, {{address: value, ...}} each, not {points!r}")


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, RigidTransform):
        return isinstance(b, RigidTransform) and a.IsExactlyEqualTo(b)
    if isinstance(a, float | int | np.ndarray):
        return bool(np.array_equal(a, b, equal_nan=True))
    # Drake's images and other objects compare by identity: compare their bytes.
    return pickle.dumps(a) == pickle.dumps(b)


_MOST_SAMPLES = 1e8


@dataclass(frozen=True)
class RolloutTask:
    """A rollout s(t) = Gamma(s0, t), equation (7), without the parameters that are set in s0.

    Attributes:
        scenario: The scenario that builds the testbed.
        horizon: Horizon t_m in seconds from t0.
        quality: Quality f and its variables; None for a rollout that only records.
        threshold: The first sample of f strictly above the threshold ends the rollout (of a cost, the first one below
            it). None: never. Only for a quality with the reading ``best``.
        sample_period: Sample period in seconds; f is sampled at its multiples and at t_m. The simulation pauses there,
            which with error control changes the trajectory.
        record: Addresses of variables, and output ports as ``path.port``, to record at the sample times.
        run_on: Whether to simulate to t_m although the threshold was exceeded.
        start: Snapshot with s0, with all switches thrown to sim; None takes the scenario's defaults. For a running
            simulation with error control take it by `AddressedDiagram.fork`, or its future will differ a little.
        keep_state: Whether to return s(t*), at the price of a second simulation up to t* if t* is not the end.
        measures: Further functions that are sampled and read as one number each: objectives and constraints.
        catch: Whether an error of f or of a measure (it raises, or returns no quality) fails only its rollout.
            Otherwise the error is raised, and ends the other rollouts.
        pruning: When to end a rollout that cannot win any more; None: never.
        motion: Simulate candidates along recorded motions, see `RecordedMotion`; None: simulate each as a whole.
    """

    scenario: Scenario
    horizon: float
    quality: Quality | None = None
    threshold: float | None = None
    sample_period: float = 0.05
    record: Sequence[str] = ()
    run_on: bool = False
    start: Snapshot | None = None
    keep_state: bool = False
    measures: tuple[Measure, ...] = ()
    catch: bool = False
    pruning: Pruning | None = None
    motion: RecordedMotion | None = None

    def __post_init__(self) -> None:
        check_is_scenario(self.scenario)
        if not isinstance(self.quality, Quality | None):
            raise ValueError(f"the quality of a rollout is a Quality(f, of=[address, ...]), not {self.quality!r}")
        if not isinstance(self.start, Snapshot | None):
            raise ValueError(f"the start of rollouts is a Snapshot, such as Snapshot.load(file), not {self.start!r}")
        for name, description in {"horizon": "the horizon t_m", "sample_period": "the sample period"}.items():
            object.__setattr__(self, name, as_number(description, getattr(self, name)))
        object.__setattr__(self, "record", as_addresses("what to record", self.record))
        object.__setattr__(self, "measures", tuple(self.measures))
        # A copy: the caller may change the scenario afterwards.
        object.__setattr__(self, "scenario", copy.deepcopy(self.scenario))
        if not (isfinite(self.horizon) and self.horizon > 0.0):
            raise ValueError(f"the horizon t_m must be positive and finite, not {self.horizon} s")
        if not (isfinite(self.sample_period) and 0.0 < self.sample_period <= self.horizon):
            raise ValueError(
                f"the sample period must be positive and at most the horizon of {self.horizon:g} s, not "
                f"{self.sample_period} s"
            )
        if self.horizon / self.sample_period > _MOST_SAMPLES:
            raise ValueError(
                f"a horizon of {self.horizon:g} s has {self.horizon / self.sample_period:.3g} samples, one every "
                f"{self.sample_period:g} s, but at most {_MOST_SAMPLES:g} fit into memory: take a longer sample period"
            )
        if not isinstance(self.motion, RecordedMotion | None):
            raise ValueError(f"rollouts go along a RecordedMotion(memory=seconds), or None, not {self.motion!r}")
        self._check_threshold()
        self._check_pruning()

    def _check_threshold(self) -> None:
        if self.threshold is None:
            return
        threshold, minimize = as_number("the threshold f_m", self.threshold), self.minimize
        if isnan(threshold) or threshold < 0.0:
            raise ValueError(f"the threshold f_m must not be negative, as f is not, but it is {threshold}")
        if minimize and not 0.0 < threshold < inf:
            raise ValueError(f"the cost below which a rollout ends is positive and finite, not {threshold}")
        # No quality is above infinity.
        object.__setattr__(self, "threshold", None if threshold == inf else threshold)
        if self.quality is not None and self.quality.reading != "best" and self.threshold is not None:
            raise ValueError(
                f"a threshold ends a rollout at its best so far, but {self.quality.name} is read as "
                f"{self.quality.reading!r}: leave the threshold out, or read it as 'best'"
            )

    def _check_pruning(self) -> None:
        if self.pruning is None:
            return
        if not isinstance(self.pruning, Pruning):
            raise ValueError(f"what ends a rollout early is a Pruning(...), not {self.pruning!r}")
        if self.quality is None:
            raise ValueError("pruning compares a quality, and the task has none: leave pruning out")
        if self.pruning.patience < inf and self.quality.reading != "best":
            raise ValueError(
                f"patience waits for a gain of the best so far, but {self.quality.name} is read as "
                f"{self.quality.reading!r}: leave patience out, or read it as 'best'"
            )

    @property
    def minimize(self) -> bool:
        """Return whether f is a cost."""
        return self.quality is not None and self.quality.minimize

    @property
    def f_m(self) -> float:
        """Return the threshold of f', as in equations (14) to (16); infinite if there is none."""
        if self.threshold is None:
            return inf
        return 1.0 / (1.0 + self.threshold) if self.minimize else self.threshold

    def sample_times(self) -> np.ndarray:
        """Return the sample times from 0 to t_m, in seconds: the multiples of the sample period, and t_m."""
        return sample_times(self.horizon, self.sample_period)

    def instants(
        self, t0: float, timings: Sequence[tuple[float, float]], *, times: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the simulator's time at each sample from t0 (s) on; see `sample_instants`.

        Args:
            t0: Time at which rollouts begin, in seconds.
            timings: (period, offset) of the testbed's periodic events, see `AddressedDiagram.event_timings`.
            times: Other times from t0 instead of the samples', in seconds; the first is 0.
        """
        return sample_instants(self.sample_times() if times is None else times, t0, timings)
