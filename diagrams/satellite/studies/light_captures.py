"""Captures of application O3: they are simulated once, kept in a file, and replayed from there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import vtbdrake as vtb
from vtbdrake.rollout import Executor, RolloutResult, RolloutTask, SerialExecutor
from vtbdrake.rollout.pruning import Cutoff
from vtbdrake.rollout.start import Starts
from vtbdrake_diagrams.kept_results import KeptResultsError, Repetition, read_results, repeat, write_results
from vtbdrake_diagrams.satellite.studies.grips import FAILURE, SAMPLE_PERIOD
from vtbdrake_diagrams.satellite.studies.light_cases import (
    CANDIDATES,
    HORIZON,
    JUDGED_ON,
    PARAMETERS,
    RACED_ON,
    SCREENED_ON,
    UNFINISHED,
    Case,
    Values,
    lighting_problem,
    text,
)

RESULTS = Path(__file__).with_name("lighting.json")
"""The results that ``--full`` keeps."""
COMMAND = "python -m vtbdrake_diagrams.satellite.studies.lighting --full"
"""The command that makes them."""


@dataclass(frozen=True)
class Capture:
    """The result of a capture.

    Attributes:
        time: When the fingers held the bar, in s; `FAILURE` or `UNFINISHED` without success.
        error: How far the bar then was from where it was perceived, in m; `LARGEST_ERROR` without success.
    """

    time: float
    error: float

    @property
    def failed(self) -> bool:
        """Return whether the fingers never held the bar."""
        return self.time >= FAILURE


Key = tuple[Values, Case]


class KeptCaptures(Executor):
    """Runs captures one after another; those that are kept already are not simulated again.

    Args:
        captures: The captures so far; new ones are added.
        keep: Is called after each new capture; None: nothing is simulated.
    """

    cancels = False

    def __init__(self, captures: dict[Key, Capture], keep: Callable[[], Any] | None = None) -> None:
        self._captures, self._keep, self._serial = captures, keep, SerialExecutor()
        self._cases = {_mark(case.condition()): case for case in {*SCREENED_ON, *RACED_ON, *JUDGED_ON}}

    def key(self, point: Mapping[str, Any]) -> Key:
        """Return the candidate and the case of the values of a rollout, by address."""
        addresses = [parameter.address for parameter in PARAMETERS]
        condition = {address: value for address, value in point.items() if address not in addresses}
        return tuple(float(point[address]) for address in addresses), self._cases[_mark(condition)]

    def run(
        self,
        task: RolloutTask,
        points: Sequence[Mapping[str, Any]],
        *,
        start: Starts = None,
        cutoff: Cutoff | None = None,
    ) -> Iterator[tuple[int, RolloutResult]]:
        """Run one capture per point; see `Executor.run`.

        Raises:
            KeptResultsError: A capture is not kept, and nothing is to be simulated.
        """
        for index, point in enumerate(points):
            values, case = key = self.key(point)
            if key not in self._captures:
                if self._keep is None:
                    raise KeptResultsError(f"{case} with {text(values)} was not simulated: {COMMAND} goes on")
                self._captures[key] = self._simulated(task, point, start)
                self._keep()
            yield index, _as_result(task, point, self._captures[key])

    def _simulated(self, task: RolloutTask, point: Mapping[str, Any], start: Starts) -> Capture:
        ((_, result),) = self._serial.run(task, [point], start=start)
        if result.failed:
            raise RuntimeError(f"the simulation of a capture failed with {dict(point)}: {result.message}")
        (measure,), (value,) = task.measures, result.measures
        limit = measure.at_most if isinstance(measure, vtb.Constraint) else 0.0
        return Capture(result.value, value + limit)

    def close(self) -> None:
        """Release the testbeds."""
        self._serial.close()


def _as_result(task: RolloutTask, point: Mapping[str, Any], capture: Capture) -> RolloutResult:
    """Return the result of a rollout that has this capture."""
    times, quality = np.array([min(capture.time, HORIZON)]), task.quality
    assert quality is not None
    h = quality.quality(np.array([capture.time]))
    return RolloutResult(
        parameters=dict(point),
        end="horizon" if capture.time == UNFINISHED else "threshold",
        times=times,
        quality=h,
        t_star=float(times[0]),
        h=float(h[0]),
        value=capture.time,
        measures=tuple(float(m.read(times, np.array([capture.error]))) for m in task.measures),
    )


def _mark(condition: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return a condition in a form that can be a key."""
    return tuple((address, *np.ravel(value).tolist()) for address, value in sorted(condition.items()))


@dataclass
class Results:
    """The captures that are kept in `RESULTS`.

    Attributes:
        candidates: The number of candidates of the screening.
        captures: The captures by candidate and case.
    """

    candidates: int = CANDIDATES
    captures: dict[Key, Capture] = field(default_factory=dict)

    @staticmethod
    def read() -> Results:
        """Return what is kept.

        Raises:
            KeptResultsError: There is no such file, or something else than `COMMAND` has changed it.
        """
        stored = read_results(RESULTS)
        captures = {
            (tuple(row["values"]), Case(row["light"], row["seed"])): Capture(row["time"], row["error"])
            for row in stored["captures"]
        }
        return Results(stored["candidates"], captures)

    def write(self) -> None:
        """Keep the captures."""
        rows = [{"values": key[0], **vars(key[1]), **vars(capture)} for key, capture in self.captures.items()]
        write_results(RESULTS, {"candidates": self.candidates, "captures": rows}, command=COMMAND)


def captures_again(captures: Mapping[Key, Capture]) -> Repetition:
    """Simulate a tenth of the kept captures again, and return whether they come out the same."""
    return repeat("captures", captures, simulate_capture, agree)


def simulate_capture(key: Key) -> Capture:
    """Simulate the capture of a candidate in a case."""
    values, case = key
    problem, captures = lighting_problem([case]), dict[Key, Capture]()
    list(KeptCaptures(captures, keep=lambda: None).run(problem.task, [problem.values(values, condition=0)]))
    return captures[key]


def agree(before: Capture, now: Capture) -> bool:
    """Return whether two simulations of one capture agree.

    The times may differ by a sample, and the errors by a tenth of a millimetre: renderers round differently.
    """
    return abs(before.time - now.time) <= 1.5 * SAMPLE_PERIOD and abs(before.error - now.error) <= 1e-4
