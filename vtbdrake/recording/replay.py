"""Replay of a log: the DPS repeats its recorded behaviour bit for bit."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.common.arrays import stacked
from vtbdrake.common.failures import error_text
from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.recording.cycle_replay import CycleReplay, Target, bit_patterns
from vtbdrake.recording.log_format import DPS, installed_versions
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.recording.recorder import StateDigest
from vtbdrake.testbed import DpsAlone

IDENTICAL = "identical"
DIFFERENT = "different"
NOT_COMPARED = "not compared"


class ReplayDifference(NamedTuple):
    """A difference between a replay and its log.

    Attributes:
        cycle: The number of the cycle.
        time: The DPS's time after the cycle, in seconds.
        subject: What differs: an actuator signal, ``time``, or ``state`` by its digest.
        recorded: The recorded value.
        replayed: The replayed value.
    """

    cycle: int
    time: float
    subject: str
    recorded: Any
    replayed: Any

    def __str__(self) -> str:
        return f"{self.subject} in cycle {self.cycle} (t = {self.time:g} s): {self.replayed} instead of {self.recorded}"


@dataclass(frozen=True, eq=False)
class ReplayReport:
    """The outcome of a replay; n is the number of cycles that were replayed.

    Attributes:
        outcome: ``identical`` (every actuator command, the time after every cycle and every digest, to the last bit),
            ``different``, or ``not compared`` (the replay had other values).
        cycles: Number of replayed cycles.
        ended: Why not all cycles of the recorded run were replayed, or may be missing; empty if all were.
        first_difference: The first difference; None if there is none.
        max_difference: Largest absolute difference by vector actuator signal; inf where an actuator command is missing
            on one side or not finite.
        digests: Number of digests of the DPS's state that were compared.
        versions: The software whose version differs from the recorded one; results may differ for that reason.
        times: Times of the DPS at the ends of the cycles, in seconds, (n,).
        actuation: Actuator commands of the DPS by vector signal, (n, size); NaN where there is none.
        errors: Exceptions of the DPS, by the number of the cycle.
        record: Recorded values at the ends of the cycles by address, (n, ...); a list, if they are not arrays.
    """

    outcome: str
    cycles: int
    ended: str
    first_difference: ReplayDifference | None
    max_difference: Mapping[str, float]
    digests: int
    versions: tuple[str, ...]
    times: np.ndarray
    actuation: Mapping[str, np.ndarray]
    errors: Mapping[int, str]
    record: Mapping[str, Any]

    @property
    def identical(self) -> bool:
        """Return whether the whole recorded run was replayed and everything is the same to the last bit."""
        return self.outcome == IDENTICAL and not self.ended

    def __str__(self) -> str:
        lines = [f"{self.cycles} cycles replayed, {self.digests} digests of the state: {self.outcome}"]
        if self.first_difference is not None:
            lines.append(f"the first difference: {self.first_difference}")
            lines += [f"{name}: up to {value:.3g}" for name, value in self.max_difference.items() if value]
        return "\n".join([*lines, *([self.ended] if self.ended else []), *self.versions])


def replay(
    log: ControlLog | str | os.PathLike[str],
    target: Target | None = None,
    *,
    values: Mapping[str, Any] | None = None,
    record: Sequence[str] = (),
) -> ReplayReport:
    """Replay a log and compare.

    The replay begins in the recorded state, feeds in every cycle what was fed, and steps as the loop did; the DPS's
    actuator commands, its time and the digests of its state must be the same to the last bit. A cycle in which the DPS
    raised raises again. The replay ends where cycles are missing in the log.

    Args:
        log: A log, or the path of its file.
        target: The testbed or DPS to step; by default the recorded one, built from the log's scenario. A `DpsAlone` can
            replay the log of a testbed whose sensor signals were all on real. A testbed can replay the log of a DPS
            alone; its simulated world is idle then.
        values: Values of variables by address, which replace the recorded ones from the beginning on, for example to
            find the commands with another gain. Nothing is compared then.
        record: Addresses of variables or output ports to be read after every cycle.

    Raises:
        OSError: The file cannot be read.
        LogError: The file is not a log, or is one of another scenario or of another version of it; the error lists the
            differences.
        AddressError: An address is unknown.
    """
    log = log if isinstance(log, ControlLog) else read_log(log)
    run = _ComparedReplay(log, target or _recorded_target(log), dict(values or {}), record)
    with Interruptible() as interruptible:
        while run.index < run.count:
            interruptible.raise_interrupt()
            run.advance()
    differences = run.differences()
    outcome = NOT_COMPARED if values else DIFFERENT if differences else IDENTICAL
    here = installed_versions()
    return ReplayReport(
        outcome=outcome,
        cycles=run.count,
        ended=run.ended or log.incomplete,
        first_difference=differences[0] if outcome == DIFFERENT else None,
        max_difference={} if values else _largest_differences(log, run.actuation),
        digests=len(run.digests),
        versions=tuple(
            f"recorded with {name} {version}, replayed with {here.get(name)}"
            for name, version in log.header.versions.items()
            if here.get(name) != version
        ),
        times=run.times,
        actuation=run.actuation,
        errors=run.errors,
        record={address: stacked(samples) for address, samples in run.record.items()},
    )


def _recorded_target(log: ControlLog) -> Target:
    scenario = log.scenario
    return DpsAlone(scenario) if log.header.target == DPS else scenario.build()


class _ComparedReplay(CycleReplay):
    """A replay from beginning to end, with what is compared with the log.

    Attributes:
        times, actuation, commanded, digests, errors, record: See `ReplayReport`.
    """

    def __init__(self, log: ControlLog, target: Target, values: dict[str, Any], record: Sequence[str]) -> None:
        super().__init__(log, target, values)
        n = self.count
        self._digest = StateDigest(target, self.context)
        self._digested = {i for i, _ in log.digests}
        self._readers = {address: target.reader(address) for address in record}
        self.times = np.empty(n)
        self.actuation = {name: np.full((n, values.shape[1]), np.nan) for name, values in log.actuation.items()}
        self.commanded = {name: np.zeros(n, bool) for name in log.commanded}
        self.digests: list[tuple[int, bytes]] = []
        self.errors: dict[int, str] = {}
        self.record: dict[str, list[Any]] = {address: [] for address in record}
        self._outputs: list[tuple[Callable[[Context], Any], np.ndarray | None, np.ndarray]] = []
        self._find_outputs()

    def advance(self) -> None:
        i = self.index
        super().advance()
        self.times[i] = self._now
        if i in self._digested:
            self.digests.append((i, self._digest()))
        for address, read in self._readers.items():
            self.record[address].append(read(self.context))

    def _evaluate(self) -> None:
        for evaluate, values, commanded in self._outputs:
            value = evaluate(self.context)
            if values is not None:
                values[self.index] = value
            commanded[self.index] = True

    def _fail(self, error: BaseException) -> None:
        # The loop may have had the same exception and gone on without actuator commands: the comparison shows.
        self.errors[int(self._log.numbers[self.index])] = error_text(error)
        for _, values, commanded in self._outputs:
            commanded[self.index] = False
            if values is not None:
                values[self.index] = np.nan

    def _find_outputs(self) -> None:
        """Find the output ports of the actuator signals that are on real."""
        self._outputs = [
            (
                self._target.diagram.GetOutputPort(f"real.act.{name}").Eval,
                self.actuation.get(name),
                self.commanded[name],
            )
            for name in (() if self._idle else self._ports.active())
        ]

    def differences(self) -> list[ReplayDifference]:
        """Return the first difference of every kind from the log, in the order of the cycles."""
        log, differences = self._log, []

        def look(subject: str, differs: np.ndarray, recorded: np.ndarray, replayed: np.ndarray) -> None:
            if differs.any():
                i = int(np.argmax(differs))
                differences.append(
                    ReplayDifference(int(log.numbers[i]), float(log.times[i]), subject, recorded[i], replayed[i])
                )

        n = len(self.times)
        look("time", log.times[:n] != self.times, log.times, self.times)
        for name, commanded in self.commanded.items():
            expected = log.commanded[name][:n]
            # Targets of different kinds have other switches: one may command where the other does not.
            differs = commanded != expected if self.same_kind else expected & ~commanded
            look(name, differs, log.commanded[name], commanded)
            if name in self.actuation:
                bits = (bit_patterns(self.actuation[name]) != bit_patterns(log.actuation[name][:n])).any(axis=1)
                look(name, commanded & expected & bits, log.actuation[name], self.actuation[name])
        digests = dict(log.digests)
        for i, digest in self.digests:
            if digest != digests[i]:
                both = digests[i].hex(), digest.hex()
                differences.append(ReplayDifference(int(log.numbers[i]), float(log.times[i]), "state", *both))
                break
        return sorted(differences, key=lambda difference: difference.cycle)


def _largest_differences(log: ControlLog, actuation: Mapping[str, np.ndarray]) -> dict[str, float]:
    largest = {}
    for name, replayed in actuation.items():
        recorded = log.actuation[name][: len(replayed)]
        same = bit_patterns(recorded) == bit_patterns(replayed)
        with np.errstate(invalid="ignore"):
            apart = np.where(same, 0.0, np.abs(recorded - replayed))
        largest[name] = float(np.where(np.isnan(apart), np.inf, apart).max(initial=0.0))
    return largest
