"""Application R2 in the capture: does a planned approach of the arm pay against resolved rate?

``python -m vtbdrake_diagrams.satellite.studies.planned_capture`` prints the table from the kept captures in
``planned_capture.json`` beside this module. With ``--count N`` it simulates the captures from N starts that are missing
there, and keeps each: from every start by resolved rate and with a planned approach, without wheels and with them.

The starts are `vtbdrake_diagrams.satellite.studies.captures.start`, from `FIRST_SEED` on, which no other study has; the
pose sensor guides. Whether a capture succeeds is decided by the criteria of ``captures.yaml``. The attitude of the
base is told when the fingers hold the bar (by then, servicer and arm have had no momentum) and when the arm has come to
rest with the target (`Mode.HOLD`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from math import inf
from pathlib import Path

import click
import numpy as np

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array
from vtbdrake.state.systems import pose_from_array
from vtbdrake.testbed import VirtualTestbed, slow_parts
from vtbdrake_diagrams.kept_results import Repetition, read_results, repeat, write_results
from vtbdrake_diagrams.processes import in_processes
from vtbdrake_diagrams.satellite.bodies import ARM_JOINT_NAMES, Servicer, Target
from vtbdrake_diagrams.satellite.clearance import ArmClearance, DrakeClearance
from vtbdrake_diagrams.satellite.scenario import APPROACHES, SatelliteScenario
from vtbdrake_diagrams.satellite.studies.captures import GRIP, bar_in_gripper, start, succeeds, turned
from vtbdrake_diagrams.satellite.supervisor import Arrival, Mode

RESULTS = Path(__file__).with_suffix(".json")
"""The captures that are kept."""
COMMAND = "python -m vtbdrake_diagrams.satellite.studies.planned_capture --count 50"
"""The command that makes them."""
FIRST_SEED = 5000
"""The seed of the first start."""
HORIZON = 75.0
"""The time that a capture may take, in s: the supervisor gives up after 60 s."""
SAMPLE_PERIOD = 0.2
"""Sample period of all readings, in s."""
CONFIDENCE = 0.9
"""Confidence of the intervals."""

# Attitudes of two simulations of one capture may differ by this, in deg.
_SAME_TURN = 0.3
# What is compared, and how it is called.
_COMPARED = {"largest": "largest", "at_grip": "at the grip", "final": "at the end", "grip": "time to grip"}
_BASE = "sim.sys.servicer.base.pose"
_TARGET = "sim.sys.target.body.pose"
_JOINTS = [f"sim.sys.servicer.{name}.position" for name in ARM_JOINT_NAMES]


@dataclass(frozen=True)
class Capture:
    """The outcome of a capture.

    Attributes:
        seed: Its start.
        wheels: Whether wheels held the base.
        approach: ``resolved_rate`` or ``planned``.
        succeeded: Whether it kept the criteria of ``captures.yaml``.
        reason: The number of the supervisor's `Reason` at the end.
        arrival: How the gripper came before the bar, an `Arrival`.
        grip: When the fingers held the bar, in s; None if they never did.
        end: When it was over, in s.
        largest: The largest deviation of the base's attitude until the fingers held the bar, in deg.
        at_grip: The deviation then, in deg; None if they never did.
        final: The deviation at the end, in deg.
        clearance: The least distance of the arm from base and itself until then, by Drake, in m.
        from_target: The least distance of the arm from the target's boxes until the gripper is before the bar, in m, by
            the spheres that cover it.
        off: How far the middle of the bar is from the middle of the hand at the end, in m.
        planning: The processor time of the plan, in s; None without one.
    """

    seed: int
    wheels: bool
    approach: str
    succeeded: bool
    reason: int
    arrival: int
    grip: float | None
    end: float
    largest: float
    at_grip: float | None
    final: float
    clearance: float
    from_target: float
    off: float
    planning: float | None


Case = tuple[int, bool, str]


def capture(case: Case) -> Capture:
    """Simulate a capture, given as (seed, wheels, approach)."""
    seed, wheels, approach = case
    testbed, (clearance, arm) = _testbed(wheels, approach), _clearance()
    context = testbed.default_context()
    testbed.write(context, start(seed))
    simulator = testbed.simulator(context)
    arrival, grip, planning = Arrival.RATES, None, None
    turns, distances, from_target, mode = [0.0], [inf], inf, Mode.WAIT
    while context.get_time() < HORIZON and mode < Mode.HOLD:
        begin = time.process_time()
        simulator.AdvanceTo(context.get_time() + SAMPLE_PERIOD)
        mode = Mode(int(testbed.read(context, "dps.impl.supervisor.mode")))
        turns.append(turned(testbed.read(context, _BASE)))
        if approach == "planned":
            before, arrival = arrival, Arrival(int(testbed.read(context, "dps.impl.supervisor.arrival")))
            if before == Arrival.PLANNING != arrival:
                planning = time.process_time() - begin
        q = np.array([testbed.read(context, name) for name in _JOINTS])
        if mode <= Mode.APPROACH:
            X_WB, X_WT = (pose_from_array(testbed.read(context, name)) for name in (_BASE, _TARGET))
            from_target = min(from_target, arm.from_boxes(q, X_WT.InvertAndCompose(X_WB), Target().boxes))
        if grip is None:
            distances.append(clearance.nearest(q)[0])
            grip = len(turns) - 1 if mode in (Mode.RETREAT, Mode.HOLD) else None
    return Capture(
        *case,
        succeeded=succeeds(testbed, context),
        reason=int(testbed.read(context, "dps.impl.supervisor.reason")),
        arrival=int(arrival),
        grip=None if grip is None else SAMPLE_PERIOD * grip,
        end=context.get_time(),
        largest=max(turns[: len(turns) if grip is None else grip + 1]),
        at_grip=None if grip is None else turns[grip],
        final=turns[-1],
        clearance=min(distances),
        from_target=from_target,
        off=float(np.linalg.norm(bar_in_gripper(*(testbed.read(context, name) for name in GRIP)))),
        planning=planning,
    )


@lru_cache
def _testbed(wheels: bool, approach: str) -> VirtualTestbed:
    """Return a testbed; the plan that all others begin near is made, too, so that its time does not count."""
    scenario = SatelliteScenario(perception="pose_sensor", wheels=wheels, approach=approach)
    testbed = scenario.build()
    if approach == "planned":
        slow_parts(testbed.diagram)["dps.impl.planner"].function.prepare()
    return testbed


@lru_cache
def _clearance() -> tuple[DrakeClearance, ArmClearance]:
    return DrakeClearance(), ArmClearance(Servicer())


@dataclass(frozen=True)
class PlannedCaptures:
    """The captures by case.

    Attributes:
        captures: The captures.
    """

    captures: Mapping[Case, Capture]

    @property
    def seeds(self) -> list[int]:
        """Return the starts from which all four captures are there, in order."""
        seeds = sorted({seed for seed, _, _ in self.captures})
        return [seed for seed in seeds if all((seed, *kind) in self.captures for kind in KINDS)]

    def of(self, wheels: bool, approach: str) -> list[Capture]:
        """Return the captures of one kind, in the order of `seeds`."""
        return [self.captures[seed, wheels, approach] for seed in self.seeds]

    def values(self, name: str, wheels: bool, approach: str) -> Array:
        """Return an attribute of all captures of one kind; a number of a grip that there was not is infinite."""
        values = [getattr(each, name) for each in self.of(wheels, approach)]
        return np.array([inf if value is None else value for value in values])

    @property
    def sentence(self) -> str:
        """Return in one sentence what planning makes of captures without wheels."""
        rates, planned = ([median(self.values(key, False, a))[0] for key in ("at_grip", "grip")] for a in APPROACHES)
        good = sum(each.succeeded for each in self.of(False, "planned"))
        return (
            f"In {len(self.seeds)} captures without wheels a planned approach leaves the base {planned[0]:.1f} deg off "
            f"at the grip instead of {rates[0]:.1f}, after {planned[1]:.0f} s instead of {rates[1]:.0f} (medians); "
            f"{good} succeed"
        )

    def __str__(self) -> str:
        header = (
            *("", "succeed", "grip (s)", "largest (deg)", "at the grip (deg)", "at the end (deg)"),
            *("clearance (mm)", "from the target (mm)", "bar off (mm)"),
        )
        rows = [self._row(wheels, approach) for wheels, approach in KINDS]
        return "\n\n".join([table(header, rows), *(self._pairs(wheels) for wheels in (False, True)), self._plans()])

    def _row(self, wheels: bool, approach: str) -> tuple[str, ...]:
        captures = self.of(wheels, approach)
        name = f"{approach.replace('_', ' ')}{', wheels' if wheels else ''}"
        medians = (median(self.values(key, wheels, approach)) for key in ("grip", "largest", "at_grip", "final"))
        least, apart = (1e3 * self.values(key, wheels, approach) for key in ("clearance", "from_target"))
        off = 1e3 * np.array([each.off for each in captures if each.succeeded])
        return (
            name,
            f"{sum(each.succeeded for each in captures)} of {len(captures)}",
            *(f"{m:.1f} [{a:.1f}, {b:.1f}]" for m, a, b in medians),
            f"{np.median(least):.0f}, least {least.min():.0f}",
            f"least {apart.min():.0f}",
            f"{np.median(off):.1f}, most {off.max():.1f}",
        )

    def _pairs(self, wheels: bool) -> str:
        """Return for how many starts planning is better, in words."""
        shares = ", ".join(f"{name} {self.better(key, wheels)}" for key, name in _COMPARED.items())
        kind = "With wheels" if wheels else "Without wheels"
        return f"{kind}, starts of {len(self.seeds)} for which planning is better: {shares}."

    def better(self, name: str, wheels: bool) -> int:
        """Return for how many starts an attribute is smaller with a plan."""
        rates, planned = (self.values(name, wheels, approach) for approach in APPROACHES)
        return int(np.sum(planned < rates))

    def _plans(self) -> str:
        planned = [each for wheels in (False, True) for each in self.of(wheels, "planned")]
        counts = {a: sum(each.arrival == a for each in planned) for a in (Arrival.REFUSED, Arrival.DROPPED)}
        seconds = np.array([each.planning for each in planned if each.planning is not None])
        return (
            f"Of {len(planned)} plans {counts[Arrival.REFUSED]} were refused and {counts[Arrival.DROPPED]} dropped. "
            f"Processor time of a plan: median {np.median(seconds):.1f} s, largest {seconds.max():.1f} s."
        )


KINDS = tuple(product((False, True), APPROACHES))
"""The kinds of captures: (wheels, approach)."""


def median(values: Sequence[float] | Array) -> tuple[float, float, float]:
    """Return the median, and the ends of its interval of `CONFIDENCE` by order statistics."""
    from scipy.stats import quantile_test  # It takes longer to load than all the rest.

    interval = quantile_test(np.asarray(values), q=0.0, p=0.5).confidence_interval(CONFIDENCE)
    return float(np.median(values)), float(interval.low), float(interval.high)


def kept_captures() -> dict[Case, Capture]:
    """Return the captures that are kept."""
    rows = read_results(RESULTS)["captures"] if RESULTS.exists() else []
    captures = (Capture(**row) for row in rows)
    return {(each.seed, each.wheels, each.approach): each for each in captures}


def keep_captures(captures: Mapping[Case, Capture]) -> None:
    """Keep captures."""
    write_results(RESULTS, {"captures": [vars(captures[case]) for case in sorted(captures)]}, command=COMMAND)


def captures_again() -> Repetition:
    """Simulate a tenth of the kept captures again, and return whether they come out the same."""
    return repeat("captures", kept_captures(), capture, agree)


def agree(before: Capture, now: Capture) -> bool:
    """Return whether two simulations of one capture are the same, but for rounding on another processor.

    The time may differ by a sample or two, attitudes by 0.3 deg; a plan's processor time is nothing to compare.
    """
    if before.succeeded != now.succeeded or (before.grip is None) != (now.grip is None):
        return False
    later = 0.0 if before.grip is None or now.grip is None else abs(before.grip - now.grip)
    turns = [abs(getattr(before, name) - getattr(now, name)) for name in ("largest", "final")]
    return later < 2.5 * SAMPLE_PERIOD and max(turns) < _SAME_TURN


@click.command()
@click.option("--count", default=0, help="Simulate what is missing of the captures from as many starts, and keep it.")
def main(count: int) -> None:
    """Print what the planned approach makes of captures."""
    captures = kept_captures()
    cases = [(seed, *kind) for seed in range(FIRST_SEED, FIRST_SEED + count) for kind in KINDS]
    for case, each in in_processes(capture, [case for case in cases if case not in captures]):
        captures[case] = each
        keep_captures(captures)
        click.echo(str(each), err=True)
    click.echo(str(PlannedCaptures(captures)))


if __name__ == "__main__":
    main(prog_name="python -m vtbdrake_diagrams.satellite.studies.planned_capture")
