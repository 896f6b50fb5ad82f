"""The check that rollouts repeat in every executor: memory outside the Context, and values that workers cannot get."""

from __future__ import annotations

import pickle
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from html import escape
from itertools import zip_longest
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, ContextBase

from vtbdrake.common.failures import error_text
from vtbdrake.common.pickling import dumps
from vtbdrake.rollout.executor import WorkerError
from vtbdrake.rollout.quality import QualityError
from vtbdrake.rollout.runner import RolloutRunner, SimulationError
from vtbdrake.rollout.task import RolloutTask
from vtbdrake.rollout.worker_processes import ProcessExecutor
from vtbdrake.state.codecs import abstract_state
from vtbdrake.state.systems import leaves, read_group, stateful_leaves
from vtbdrake.testbed import VirtualTestbed

# Seconds of processor time for the reference; the other rollouts are as long in simulated time.
_BUDGET = 0.1

Sample = Mapping[str, tuple[Any, ...]]
"""The numbers of each system at a sample time, by path; under "" the numbers of f and the other measures."""

Trace = Sequence[tuple[float, Sample]]
"""Sample times in seconds from t0, and the samples there."""


@dataclass(frozen=True, repr=False)
class Check:
    """The findings of `check_rollouts`.

    Attributes:
        findings: One sentence or two each: what is wrong, where, and the remedy. Empty if nothing was found.
        seconds: The simulated time of the checked part of a rollout.
        failure: The reason for which that rollout fails and cannot be checked further; empty if it does not fail.
    """

    findings: tuple[str, ...]
    seconds: float
    failure: str = ""

    @property
    def ok(self) -> bool:
        """Return whether nothing was found."""
        return not self.findings

    def __repr__(self) -> str:
        return f"Check({self})"

    def _repr_html_(self) -> str:
        """Show the findings in a notebook, one per line."""
        return "".join(f"<div>{escape(line)}</div>" for line in str(self).split("\n"))

    def __str__(self) -> str:
        lines = list(self.findings)
        if self.ok:
            lines.append(f"nothing found: rollouts repeat over {self.seconds:g} s, side by side and in another process")
        if self.failure:
            lines.append(f"no more was compared, as the rollout fails after {self.seconds:g} s: {self.failure}")
        return "\n".join(lines)


def check_rollouts(task: RolloutTask, testbed: VirtualTestbed, points: Sequence[Mapping[str, Any]]) -> Check:
    """Compare rollouts that must agree: repeated, side by side on one Diagram, and in another process.

    Args:
        task: Task of the rollouts.
        testbed: Testbed of the task's scenario, on which the rollouts run.
        points: Address -> value, without fields of the scenario; the first is repeated, the last runs beside it.

    Raises:
        QualityError: f raises, is negative or NaN, so that nothing can be compared.
    """
    point, other = points[0], points[-1]
    reference = list(within(_BUDGET, trace(RolloutRunner(task, testbed), point)))
    before = python_attributes(testbed)
    repeated = first(trace(RolloutRunner(task, testbed), point), count=len(reference))
    changed = [name for name, value in python_attributes(testbed).items() if before.get(name) != value]
    findings = list(_compare(task, reference, repeated, changed, "a second rollout of the same point"))
    if not findings:
        neighbour = trace(RolloutRunner(task, testbed), other)
        beside = first(side_by_side(trace(RolloutRunner(task, testbed), point), neighbour), count=len(reference))
        changed = [name for name, value in python_attributes(testbed).items() if before.get(name) != value]
        findings += _compare(task, reference, beside, changed, "a rollout that runs beside another one")
    short = replace(task, horizon=max(float(reference[-1][0]), task.sample_period), keep_state=False)
    sending = list(_unsendable(task))
    if not sending:
        sending = list(elsewhere(short, RolloutRunner(short, testbed), point, alone=not findings))
    end, sample = reference[-1]
    failure = next((measured for measured in sample[""] if isinstance(measured, str)), "")
    return Check((*findings, *kept_contexts(testbed), *sending), float(end), failure)


class Numbers:
    """Reads the numbers of all systems of a testbed: numeric groups, and abstract states through their codecs.

    Args:
        testbed: The testbed.
        context: A root context, which tells what the abstract states are.
    """

    def __init__(self, testbed: VirtualTestbed, context: Context) -> None:
        self._systems = [
            (leaf, abstract_state(leaf.path, leaf.system, leaf.system.GetMyContextFromRoot(context)))
            for leaf in stateful_leaves(testbed.diagram)
        ]

    def read(self, context: Context) -> dict[str, tuple[Any, ...]]:
        """Return the numbers by path."""
        numbers = {}
        for (path, system, groups), abstract in self._systems:
            leaf_context = system.GetMyContextFromRoot(context)
            arrays = [read_group(leaf_context, kind, index) for kind, index, _ in groups]
            # A codec may list its arrays in another order after a restore.
            parts = sorted(abstract.read(leaf_context).items())
            numbers[path] = (*arrays, *(entry for part in parts for entry in part))
        return numbers


def trace(runner: RolloutRunner, point: Mapping[str, Any]) -> Generator[tuple[float, Sample]]:
    """Yield the numbers of all systems at each sample time, and at last what ended the rollout, if it failed.

    Args:
        runner: The runner, which runs nothing else meanwhile.
        point: Address -> value, set in s0.
    """
    t = 0.0
    try:
        numbers = None
        for t in runner.simulate(point):
            numbers = numbers or Numbers(runner.testbed, runner.context)
            yield t, {"": tuple(runner.measured(t)), **numbers.read(runner.context)}
    except SimulationError as failure:
        yield t, {"": (str(failure),)}


def within(budget: float, samples: Iterator[tuple[float, Sample]]) -> Iterator[tuple[float, Sample]]:
    """Yield at least three samples, and as many as take ``budget`` seconds of processor time.

    Args:
        budget: Processor time of this thread, in seconds.
        samples: Sample time in seconds and sample, of a rollout that runs as they are taken.
    """
    end = time.thread_time() + budget
    for count, sample in enumerate(samples):
        yield sample
        if count >= 2 and time.thread_time() > end:
            return


def first(samples: Iterator[tuple[float, Sample]], *, count: int) -> Trace:
    """Return the first samples, at most ``count``.

    Args:
        samples: Sample time in seconds and sample, of a rollout that runs as they are taken.
        count: The largest number of samples.
    """
    return [sample for _, sample in zip(range(count), samples, strict=False)]


def side_by_side(
    samples: Iterator[tuple[float, Sample]], neighbour: Iterator[object]
) -> Iterator[tuple[float, Sample]]:
    """Yield the samples of one rollout, while another one takes its steps in turn.

    Args:
        samples: The samples of the rollout that is looked at.
        neighbour: The samples of the other rollout, which takes its step first.
    """
    pairs = zip_longest(neighbour, samples)
    return (sample for _, sample in pairs if sample is not None)


def first_difference(reference: Trace, repeated: Trace) -> tuple[float, list[str]] | None:
    """Return the first difference of two rollouts: sample time and paths of what differs; None if there is none.

    Args:
        reference: The samples of the first rollout.
        repeated: The samples of the same rollout, made again.
    """
    for (t, expected), (_, actual) in zip_longest(reference, repeated, fillvalue=(np.nan, {})):
        parted = [path for path in {**expected, **actual} if not _same(expected.get(path), actual.get(path))]
        if parted:
            return t, parted
    return None


def _compare(task: RolloutTask, reference: Trace, repeated: Trace, changed: Sequence[str], rerun: str) -> Iterator[str]:
    """Yield at most one finding: where the two rollouts differ first."""
    difference = first_difference(reference, repeated)
    if difference is None:
        return
    t, parted = difference
    name = task.quality.name if task.quality is not None else "the quality"
    if parted == [""] and not changed:
        yield (
            f"{rerun} differs at t = {t:g} s in its quality {name} (or another measure), not in its state: it must "
            "depend on its arguments alone, so keep no memory in it, and draw no random numbers"
        )
    else:
        where = ", ".join(changed) or f"a system that drives {', '.join(path for path in parted if path)}"
        yield (
            f"{rerun} differs from t = {t:g} s on: {where} has memory outside the Context. Declare it as state "
            "(DeclareDiscreteState, DeclareAbstractState) and read it from the context, so that rollouts repeat"
        )


def _same(a: tuple[Any, ...] | None, b: tuple[Any, ...] | None) -> bool:
    return a is not None and b is not None and len(a) == len(b) and all(map(_equal, a, b))


def _equal(x: Any, y: Any) -> bool:
    if isinstance(x, str) or isinstance(y, str):
        return bool(x == y)
    # As a rule arrays are equal, and their bytes are compared in a tenth of the time.
    return _same_bytes(x, y) or np.array_equal(x, y, equal_nan=np.asarray(x).dtype.kind in "fc")


def _same_bytes(x: Any, y: Any) -> bool:
    if not (isinstance(x, np.ndarray) and isinstance(y, np.ndarray)) or x.dtype.hasobject:
        return False
    return x.shape == y.shape and x.dtype == y.dtype and x.tobytes() == y.tobytes()


def python_attributes(testbed: VirtualTestbed) -> dict[str, Any]:
    """Return the attributes of the systems in Python, by name: as bytes, or their identity where they do not pickle."""
    return {
        f"self.{name} of {path} ({type(system).__name__})": _fingerprint(value)
        for path, system in leaves(testbed.diagram)
        if path in testbed.python_systems
        for name, value in vars(system).items()
        if not name.startswith("_pydrake")
    }


def kept_contexts(testbed: VirtualTestbed) -> Iterator[str]:
    """Yield a finding per Context that a system in Python keeps, of a plant with which it computes for example."""
    for path, system in leaves(testbed.diagram):
        for name, value in vars(system).items() if path in testbed.python_systems else ():
            if isinstance(value, ContextBase):
                yield (
                    f"self.{name} of {path} ({type(system).__name__}) is a Context: rollouts in threads share it, and "
                    "one computes with what another has set. Keep it in a cache entry (DeclareCacheEntry), or use "
                    "executor='processes' or 'serial'"
                )


def _fingerprint(value: Any) -> Any:
    try:
        return pickle.dumps(value)
    except Exception:  # A port or a function, for example.
        return id(value)


def _unsendable(task: RolloutTask) -> Iterator[str]:
    """Yield at most one finding: the part of the task that cannot be pickled."""
    parts: dict[str, Any] = {}
    for measure in (*([task.quality] if task.quality is not None else []), *task.measures):
        function = measure.f
        cells = getattr(function, "__closure__", None) or ()
        names = function.__code__.co_freevars if cells else ()
        for name, cell in zip(names, cells, strict=True):
            parts[f"{name!r}, which the quality {measure.name} uses,"] = cell.cell_contents
        parts[f"the quality {measure.name}"] = function
    scenario = task.scenario
    parts |= {f"the scenario's field {field.name}": getattr(scenario, field.name) for field in fields(scenario)}
    parts |= {"the scenario": scenario, "the problem": task}
    for part, value in parts.items():
        try:
            dumps(value)
        except Exception as error:
            yield (
                f"{part} cannot be sent to workers ({error_text(error)}): use executor='threads' or "
                "'serial', or make it where it is used, from plain data"
            )
            return


def elsewhere(
    task: RolloutTask, runner: RolloutRunner, point: Mapping[str, Any], *, alone: bool = True
) -> Iterator[str]:
    """Yield a finding if a rollout in another process differs; ``alone`` says whether rollouts agree in this one.

    Args:
        task: The task of the rollouts.
        runner: Runs the rollout in this process.
        point: The point, address -> value.
        alone: Whether rollouts agree in this process; if not, only an error of the worker is a finding.
    """
    here = _run(lambda: runner.run(point))
    with ProcessExecutor(1) as executor:
        there = _run(lambda: next(iter(executor.run(task, [point])))[1])
    if isinstance(there, WorkerError):
        yield str(there)
    elif alone and isinstance(here, Exception) != isinstance(there, Exception):
        yield f"in another process, a rollout ends otherwise: {there!r} instead of {here!r}"
    elif alone and not isinstance(here, Exception) and not here.identical(there):
        yield (
            "in another process, a rollout of the same point gives another result: something depends on the process "
            "(a global variable, the order of a set, the time, a file), or a system has memory outside the Context"
        )


def _run(rollout: Callable[[], Any]) -> Any:
    try:
        return rollout()
    except (QualityError, WorkerError) as error:
        return error
