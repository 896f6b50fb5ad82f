"""Application O2 within a capture: which scan frequencies guide whole captures, not only approaches?

The laser scanner alone guides captures from the same starts, with scans as they come and de-skewed: it scans the target
beside a moving arm, from a base that turns, until the fingers hold the bar. That the scanner guides is a choice of the
scenario, and the scanner is the one of the approaches. Nothing else differs from the captures of ``captures.yaml``,
whose criteria decide about success, but that wheels hold the base's attitude, as in the study of lights: without them
the arm that reaches out turns the scanner's field of view by 20 deg.

Fixed before the first of these captures:

* the frequencies `FREQUENCIES`: below the window of the approaches, its lower end, the one that surely suffices, one
  that surely does not at 1 deg/s, and one that surely does not at any tumble rate;
* the starts, from `FIRST_SEED` on, which no other study has, with tumble rates up to 3 deg/s;
* the claim: with de-skewed scans, a frequency that surely suffices in approaches guides at least `SHARE` of the
  captures to success, with the error at the grip within the tolerance.

``python -m vtbdrake_diagrams.satellite.studies.scanned_captures`` prints the table from the kept captures in
``scanned_captures.json`` beside this module. With ``--count N`` it simulates first what is missing of the captures from
N starts, and keeps each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from math import inf
from pathlib import Path

import click
import numpy as np

from vtbdrake.cli.output import table
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.kept_results import Repetition, read_results, repeat, write_results
from vtbdrake_diagrams.processes import in_processes
from vtbdrake_diagrams.satellite.perception import PerceptionConfig
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.studies.captures import start, succeeds
from vtbdrake_diagrams.satellite.studies.grips import MODE, RECORDED, SAMPLE_PERIOD, bar_error
from vtbdrake_diagrams.satellite.studies.planned_capture import HORIZON, median
from vtbdrake_diagrams.satellite.studies.scan_frequency import DESKEWED, PATIENCE, RAW, ROUNDED, SCANNER, TOLERANCE
from vtbdrake_diagrams.satellite.supervisor import Mode, Reason

RESULTS = Path(__file__).with_suffix(".json")
"""The captures that are kept."""
COMMAND = "python -m vtbdrake_diagrams.satellite.studies.scanned_captures --count 20"
"""The command that makes them."""
FREQUENCIES = (0.5, 1.0, 2.0, 4.0, 16.0)
"""The scan frequencies, in Hz."""
FIRST_SEED = 6000
"""The seed of the first start."""
SHARE = 0.9
"""The share of captures that a frequency guides which surely suffices."""

# Errors at the grip in two simulations of one capture may differ by this, in m.
_SAME_ERROR = 1e-3


@dataclass(frozen=True, order=True)
class ScannedCase:
    """A capture that is simulated.

    Attributes:
        scans: `RAW` or `DESKEWED`.
        frequency: The scan frequency, in Hz.
        seed: The start.
    """

    scans: str
    frequency: float
    seed: int

    def __str__(self) -> str:
        return f"{self.scans}, {self.frequency:g} Hz, start {self.seed}"


@dataclass(frozen=True)
class ScannedCapture:
    """The outcome of a capture that the scanner has guided.

    Attributes:
        succeeded: Whether it kept the criteria of ``captures.yaml``.
        reason: The number of the supervisor's `Reason` at the end.
        grip: When the fingers held the bar, in s; None if they never did.
        error: How far the middle of the bar then was from where the DPS believed it, in m; None if they never did.
        end: When it was over, in s.
    """

    succeeded: bool
    reason: int
    grip: float | None
    error: float | None
    end: float

    @property
    def is_accurate(self) -> bool:
        """Return whether it succeeded, with the error at the grip within the tolerance."""
        return self.succeeded and self.error is not None and self.error < TOLERANCE

    def agrees(self, other: ScannedCapture) -> bool:
        """Return whether another simulation of the capture is the same, but for rounding on another processor."""
        if self.succeeded != other.succeeded or (self.grip is None) != (other.grip is None):
            return False
        later = abs((self.grip or 0.0) - (other.grip or 0.0))
        return later < 2.5 * SAMPLE_PERIOD and abs((self.error or 0.0) - (other.error or 0.0)) < _SAME_ERROR


def scanned_capture(case: ScannedCase) -> ScannedCapture:
    """Simulate a capture that the scanner alone guides."""
    testbed = _testbed(case.scans, case.frequency)
    context = testbed.default_context()
    testbed.write(context, {**start(case.seed), "dps.env.target.patience": PATIENCE})
    simulator = testbed.simulator(context)
    mode, grip, error = Mode.WAIT, None, None
    while context.get_time() < HORIZON and mode < Mode.HOLD:
        simulator.AdvanceTo(context.get_time() + SAMPLE_PERIOD)
        mode = Mode(int(testbed.read(context, MODE)))
        if grip is None and mode in (Mode.RETREAT, Mode.HOLD):
            grip, error = context.get_time(), bar_error(*(testbed.read(context, name) for name in RECORDED))
    reason = int(testbed.read(context, "dps.impl.supervisor.reason"))
    return ScannedCapture(succeeds(testbed, context), reason, grip, error, context.get_time())


@lru_cache
def _testbed(scans: str, frequency: float) -> VirtualTestbed:
    return SatelliteScenario(
        perception="scanner",
        wheels=True,
        scanner=replace(SCANNER, frequency=frequency),
        evaluation=PerceptionConfig(deskew=scans == DESKEWED),
    ).build()


@dataclass(frozen=True)
class ScannedCaptures:
    """Captures that the scanner has guided, by case."""

    captures: Mapping[ScannedCase, ScannedCapture]

    def of(self, scans: str, frequency: float) -> list[ScannedCapture]:
        """Return the captures with a kind of scans, at a frequency in Hz."""
        kind = (scans, frequency)
        return [each for case, each in self.captures.items() if (case.scans, case.frequency) == kind]

    def suffices(self, scans: str, frequency: float) -> bool:
        """Return whether at least `SHARE` of the captures at a frequency succeed, within the tolerance at the grip."""
        captures = self.of(scans, frequency)
        return bool(captures) and sum(each.is_accurate for each in captures) >= SHARE * len(captures)

    @property
    def kinds(self) -> list[tuple[str, float]]:
        """Return kinds of scans with frequencies in Hz, as they were simulated."""
        return [kind for kind in product((DESKEWED, RAW), FREQUENCIES) if self.of(*kind)]

    @property
    def sentence(self) -> str:
        """Return in one sentence how many captures succeed, how far the bar is off, and how long they take."""
        words = []
        for scans in (DESKEWED, RAW):
            rows = [
                f"{frequency:g} Hz {sum(each.succeeded for each in captures)} of {len(captures)}{_grips(captures)}"
                for kind, frequency in self.kinds
                if kind == scans and (captures := self.of(kind, frequency))
            ]
            words.append(f"{scans} {', '.join(rows)}")
        return f"Captures that the scanner guides alone, from random starts: {'; '.join(words)}"

    def __str__(self) -> str:
        header = ("", "succeed", "within the tolerance", "grip (s)", "error at the grip (mm)", "why not")
        return table(header, [self._row(*kind) for kind in self.kinds])

    def _row(self, scans: str, frequency: float) -> tuple[str, ...]:
        captures = self.of(scans, frequency)
        middle, lower, upper = median([inf if each.grip is None else each.grip for each in captures])
        errors = 1e3 * np.array([each.error for each in captures if each.succeeded])
        failed = [Reason(each.reason).name.lower() for each in captures if not each.succeeded]
        return (
            f"{scans}, {frequency:g} Hz",
            f"{sum(each.succeeded for each in captures)} of {len(captures)}",
            f"{sum(each.is_accurate for each in captures)}",
            f"{middle:.1f} [{lower:.1f}, {upper:.1f}]",
            f"{np.median(errors):.1f}, most {errors.max():.1f}" if len(errors) else "",
            ", ".join(f"{name} {failed.count(name)}" for name in sorted(set(failed))),
        )


def _grips(captures: list[ScannedCapture]) -> str:
    """Return when the fingers held the bar, and how far it was off, in captures that succeeded; in words."""
    good = [(each.grip, 1e3 * each.error) for each in captures if each.succeeded and each.grip and each.error]
    if not good:
        return ""
    times, errors = np.transpose(good)
    return f" ({np.median(times):.0f} s, {np.median(errors):.1f} mm, at most {errors.max():.1f})"


def kept_captures() -> dict[ScannedCase, ScannedCapture]:
    """Return the captures that are kept."""
    rows = read_results(RESULTS)["captures"] if RESULTS.exists() else []
    return {ScannedCase(**row["case"]): ScannedCapture(**row["capture"]) for row in rows}


def keep_captures(captures: Mapping[ScannedCase, ScannedCapture]) -> None:
    """Keep captures."""
    rows = [{"case": case, "capture": captures[case]} for case in sorted(captures)]
    write_results(RESULTS, {"captures": rows}, command=COMMAND)


def captures_again() -> Repetition:
    """Simulate a tenth of the kept captures again, and return whether they come out the same, but for `ROUNDED`."""
    return repeat("captures", kept_captures(), scanned_capture, ScannedCapture.agrees, allowed=ROUNDED)


@click.command()
@click.option("--count", default=0, help="Simulate what is missing of the captures from as many starts, and keep it.")
@click.option("--workers", type=click.IntRange(min=1), help="Number of processes; by default one per core.")
def main(count: int, workers: int | None) -> None:
    """Print which scan frequencies guide captures."""
    captures = kept_captures()
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    cases = [ScannedCase(*kind, seed) for seed, *kind in product(seeds, (DESKEWED, RAW), FREQUENCIES)]
    for case, each in in_processes(scanned_capture, [case for case in cases if case not in captures], workers=workers):
        captures[case] = each
        keep_captures(captures)
        click.echo(f"{case}: {each}", err=True)
    click.echo(str(ScannedCaptures(captures)))


if __name__ == "__main__":
    # Under its own name, so that worker processes find its classes.
    from vtbdrake_diagrams.satellite.studies.scanned_captures import main as program

    program(prog_name="python -m vtbdrake_diagrams.satellite.studies.scanned_captures")
