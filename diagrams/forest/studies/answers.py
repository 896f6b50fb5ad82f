"""Row C2 of the table of answers: the accuracy of the localization unit, in simulation and over LCM."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vtbdrake.components.localization.unit import TRACKING
from vtbdrake.deployment import Deployment
from vtbdrake.lcm.hub import Hub
from vtbdrake.machine import MachineProcess
from vtbdrake.testbed import DpsAlone
from vtbdrake_diagrams.answers import Answer
from vtbdrake_diagrams.forest.dps import PERIOD
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.studies import fusion, on_foot, revised_maps, trees_and_rocks
from vtbdrake_diagrams.forest.studies.best_estimate import REACH, BestError, against_best
from vtbdrake_diagrams.forest.studies.drives import GOALS, SEED, Drives, Score, scores

CYCLES = 150
"""The number of cycles of the loop in lock-step with the process that sends the sensors' data."""
PATIENCE = 60.0
"""The longest time to wait for a result of the slow part, in s."""
LARGEST_DIFFERENCE = 1e-3
"""The largest difference of the pose over LCM from the simulated one, in m and rad: points travel with 32 bits."""
BOUNDED = "poor"
"""The map whose goal no estimate can meet (see `best_estimates`): it is judged by the error of the best estimate."""
LEAST_LOCALIZED = 0.9
"""The least share of the scans that must have a pose, with each map."""
LARGEST_RATIO = 1.1
"""The largest ratio of the error with that map to the error of the best estimate on the same maps, see `BestError`."""


@dataclass(frozen=True)
class OverLcm:
    """The comparison of the unit beside a machine with the simulated unit at the same time.

    Attributes:
        is_tracking: Whether the unit tracks beside the machine.
        difference: The largest difference of the two poses, in m or rad.
    """

    is_tracking: bool
    difference: float

    @property
    def agrees(self) -> bool:
        """Return whether the poses are the same."""
        return self.is_tracking and self.difference < LARGEST_DIFFERENCE


def over_lcm(scenario: ForestScenario, *, cycles: int = CYCLES) -> OverLcm:
    """Run the DPS alone, fed over LCM by a process that simulates the sensors, and compare it with the simulation.

    Args:
        scenario: The carrier in its forest.
        cycles: The number of cycles, in lock-step: the result does not depend on the load of this computer.
    """
    dps = DpsAlone(scenario)
    context = dps.default_context()
    with (
        Hub(port=0) as hub,
        MachineProcess(scenario, hub.url, lock_step=True),
        scenario.deploy(
            hub.url, target=dps, context=context, deployment=Deployment.of(scenario).in_lock_step("imu")
        ) as loop,
    ):
        loop.take_over()
        loop.run(cycles=cycles - loop.cycles, until=lambda: not loop.slow_parts.wait(PATIENCE))
    testbed = scenario.build()
    simulated = testbed.default_context()
    testbed.simulator(simulated).AdvanceTo((cycles - 1) * PERIOD)
    poses = [
        np.append(system.read(of, "dps.env.pose.position"), system.read(of, "dps.env.pose.heading"))
        for system, of in ((dps, context), (testbed, simulated))
    ]
    status = dps.read(context, "dps.env.pose.status")
    return OverLcm(bool(status == TRACKING), float(np.abs(poses[0] - poses[1]).max()))


@dataclass(frozen=True)
class LocalizationAnswer:
    """Accuracy of the localization unit with each map.

    Attributes:
        scores: The scores of all drives by map.
        best: The unit beside the best estimate, with the map `BOUNDED`.
        machine: The unit fed over LCM beside the simulated one.
        fused: Whether scanner and cameras in one filter are no worse than each alone, see `fusion.holds`.
    """

    scores: Mapping[str, Score]
    best: BestError
    machine: OverLcm
    fused: bool

    @property
    def holds(self) -> bool:
        """Return whether the goal of each map is met, without a wrong claim, the same over LCM, and fusion holds."""
        bounded = self.scores[BOUNDED]
        goals = all(GOALS[name].is_met(score) for name, score in self.scores.items() if name != BOUNDED)
        as_good = self.best.ratio <= LARGEST_RATIO and bounded.independent_nees <= bounded.bounds[1]
        sure = all(score.localized >= LEAST_LOCALIZED and not score.wrong for score in self.scores.values())
        return self.machine.agrees and self.fused and goals and as_good and sure


def localization(full: bool) -> Answer:
    """Answer C2: how accurately does the unit localize itself?

    The short version drives 25 m in each of 4 forests, the long one 500 m in each of 20. The unit with scanner and
    cameras (`fusion`), the one that revises its map (`revised_maps`), the one on foot (`on_foot`) and the one with
    rocks as landmarks (`trees_and_rocks`) were moved before.
    """
    drives = Drives(length=500.0 if full else 25.0)
    seeds = range(SEED, SEED + (20 if full else 4))
    tracks = list(drives.through(seeds))
    scores_by_map = scores(tracks)
    best = against_best(
        {seed: by_map[BOUNDED] for seed, by_map in zip(seeds, tracks, strict=True)}, BOUNDED, scenario=drives.scenario
    )
    machine = over_lcm(ForestScenario(seed=1, length=60.0, width=60.0))
    accurate, fused = scores_by_map["accurate"], fusion.load()
    return Answer(
        id="C2",
        question="How well does a localization unit, developed in a virtual forest, know where it is among the trees?",
        answer=", ".join(f"{name} map {score.position:.3f} m" for name, score in scores_by_map.items()),
        unit="(RMS)",
        interval=None,
        paper="done on a harvester; no figures",
        cases="forests of other seeds, on which the unit was developed",
        held_out=f"{accurate.forests} forests, {accurate.path:.0f} m of path, each drive begins without a guess",
        baseline=f"the best unbiased estimate with the {BOUNDED} map, {best.least:.2f} m",
        refused=sum(score.localized < LEAST_LOCALIZED for score in scores_by_map.values()),
        holds=LocalizationAnswer(scores_by_map, best, machine, fusion.holds(fused)).holds,
        note="; ".join(_summary(name, score) for name, score in scores_by_map.items())
        + f". Neighbours on the poor map share their errors: over many such maps, the best unbiased estimate by the "
        f"trees within {REACH:g} m of the path so far errs by {best.least:.2f} m (RMS); on these very maps the unit's "
        f"error is {best.ratio:.2f} times as large ({best.interval[0]:.2f} to {best.interval[1]:.2f} with "
        f"95 % over forests; at most {LARGEST_RATIO:g}). Over LCM, fed by another process, "
        + ("the pose is the same. " if machine.agrees else f"the pose DIFFERS by {machine.difference:.1e}. ")
        + _fused(fused)
        + " "
        + " ".join(
            (
                revised_maps.in_words(revised_maps.load()),
                on_foot.in_words(on_foot.load()),
                trees_and_rocks.in_words(on_foot.load(trees_and_rocks.FILE)),
            )
        ),
    )


def _fused(forests: fusion.Forests) -> str:
    """Return what scanner and cameras in one filter gain, in words."""
    worst = {
        condition: max(
            ratio for name in fusion.MAP_NAMES for ratio in fusion.summary(forests, condition, name).ratios.values()
        )
        for condition in fusion.CONDITIONS
    }
    ratios = ", ".join(f"{condition}: {ratio:.2f}" for condition, ratio in worst.items())
    verdict = "no worse" if fusion.holds(forests) else "WORSE"
    return (
        f"Scanner and cameras in one filter, in {len(forests)} other forests, are {verdict} than each alone. "
        f"Error over each one's at common times, with the map and the sensor where it is largest: {ratios}."
    )


def _summary(name: str, score: Score) -> str:
    unreachable = " (judged by the best estimate, below)" if name == BOUNDED else ""
    goal = ("reached" if GOALS[name].is_met(score) else "NOT reached") + unreachable
    return (
        f"{name}: {score.position:.3f} m (goal {GOALS[name].position:g} m), {np.degrees(score.heading):.2f} deg, NEES "
        f"{score.independent_nees:.1f} in [{score.bounds[0]:.1f}, {score.bounds[1]:.1f}], a pose in "
        f"{score.localized:.0%}, {score.wrong} wrong claims, goal {goal}"
    )
