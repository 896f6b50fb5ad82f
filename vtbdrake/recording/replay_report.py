"""What a replay has found."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from vtbdrake.recording.control_log import ControlLog

IDENTICAL, DIFFERENT, NOT_COMPARED = "identical", "different", "not compared"


class Difference(NamedTuple):
    """Where a replay differs from its log: the cycle, the DPS's time after it, and what was recorded and replayed.

    ``what`` is an actuator signal, ``time`` or ``state`` (by its digest).
    """

    cycle: int
    time: float
    what: str
    recorded: Any
    replayed: Any

    def __str__(self) -> str:
        return f"{self.what} in cycle {self.cycle} (t = {self.time:g} s): {self.replayed} instead of {self.recorded}"


@dataclass(frozen=True, eq=False)
class ReplayReport:
    """What came out of a replay; n is the number of cycles that were replayed.

    Attributes:
        outcome: ``identical`` (every command, the time after every cycle and every digest, to the last bit),
            ``different``, or ``not compared`` (the replay had other values).
        cycles: how many were replayed.
        ended: why not all that there were; empty if they were.
        first_difference: None if there is none.
        max_difference: by vector actuator signal, the largest absolute one; inf where a command is missing on one side
            or not finite.
        digests: how many digests of the DPS's state were compared.
        versions: of what runs here and was another version when it was recorded; bits may differ for it.
        times: of the DPS at the ends of the cycles, in seconds, (n,).
        commands: by vector actuator signal, (n, size); NaN where the DPS did not command.
        errors: what the DPS raised, by the number of the cycle.
        record: by address what was asked for, at the ends of the cycles, (n, ...); a list, if it is no array.
    """

    outcome: str
    cycles: int
    ended: str
    first_difference: Difference | None
    max_difference: Mapping[str, float]
    digests: int
    versions: tuple[str, ...]
    times: np.ndarray
    commands: Mapping[str, np.ndarray]
    errors: Mapping[int, str]
    record: Mapping[str, Any]

    @property
    def identical(self) -> bool:
        """Whether all that was compared is the same to the last bit, and there was nothing that ended it early."""
        return self.outcome == IDENTICAL and not self.ended

    def __str__(self) -> str:
        lines = [f"{self.cycles} cycles replayed, {self.digests} digests of the state: {self.outcome}"]
        if self.first_difference is not None:
            lines.append(f"the first difference: {self.first_difference}")
            lines += [f"{name}: up to {value:.3g}" for name, value in self.max_difference.items() if value]
        return "\n".join([*lines, *([self.ended] if self.ended else []), *self.versions])


def differences(
    log: ControlLog,
    times: np.ndarray,
    commands: Mapping[str, np.ndarray],
    commanded: Mapping[str, np.ndarray],
    digests: Iterable[tuple[int, bytes]],
    *,
    all_told: bool,
) -> list[Difference]:
    """The first difference of every kind.

    Args:
        all_told: whether the log has every command of the DPS, not only those that were on real.
    """
    n = len(times)
    found = []

    def look(what: str, differs: np.ndarray, recorded: np.ndarray, replayed: np.ndarray) -> None:
        if differs.any():
            i = int(np.argmax(differs))
            found.append(Difference(int(log.numbers[i]), float(log.times[i]), what, recorded[i], replayed[i]))

    look("time", log.times[:n] != times, log.times, times)
    for name, there in commanded.items():
        wanted = log.commanded[name][:n]
        look(name, there != wanted if all_told else wanted & ~there, log.commanded[name], there)
        if name in commands:
            both = there & wanted
            bits = (_bits(commands[name]) != _bits(log.commands[name][:n])).any(axis=1)
            look(name, both & bits, log.commands[name], commands[name])
    expected = dict(log.digests)
    for i, digest in digests:
        if digest != expected[i]:
            told = expected[i].hex(), digest.hex()
            found.append(Difference(int(log.numbers[i]), float(log.times[i]), "state", *told))
            break
    return sorted(found, key=lambda difference: difference.cycle)


def largest_differences(log: ControlLog, commands: Mapping[str, np.ndarray]) -> dict[str, float]:
    """See `ReplayReport.max_difference`."""
    largest = {}
    for name, replayed in commands.items():
        recorded = log.commands[name][: len(replayed)]
        same = _bits(recorded) == _bits(replayed)
        with np.errstate(invalid="ignore"):
            apart = np.where(same, 0.0, np.abs(recorded - replayed))
        largest[name] = float(np.where(np.isnan(apart), np.inf, apart).max(initial=0.0))
    return largest


def _bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=float).view(np.uint64)
