"""The front of application R2: attitude deviations of the base at the end, at most and in the mean.

``python -m vtbdrake_diagrams.satellite.studies.arm_front [--pairs N]`` plans N random motions from near the stowed pose
to the workspace, with a limit on the deviation on the way or a weight on its mean, and simulates the plans in the full
testbed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import click
import numpy as np

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array
from vtbdrake.optimization.pareto import undominated
from vtbdrake_diagrams.processes import in_processes
from vtbdrake_diagrams.satellite.arm_planning import plan_by_casadi
from vtbdrake_diagrams.satellite.studies.arm_motion import ArmMotionScenario
from vtbdrake_diagrams.satellite.studies.trajectory import Course, random_scenarios, simulate

# Starts of the solver for a plan.
_STARTS = 2
# Seed of the motions, which no other study has.
_SEED = 4021


@dataclass(frozen=True)
class Aim:
    """A way to weigh the deviations.

    Attributes:
        turn: The largest deviation on the way, as a share of the straight path's largest.
        weight: The weight of the mean of the squared deviation beside the one at the end.
    """

    turn: float = 1.0
    weight: float = 0.0

    def __str__(self) -> str:
        parts = [f"at most {self.turn:.0%} on the way"] if self.turn < 1.0 else []
        parts += [f"mean weighed {self.weight:g}"] if self.weight else []
        return ", ".join(parts) or "the end alone"


AIMS = (
    *(Aim(turn=turn) for turn in (1.0, 0.8, 0.6, 0.4)),
    *(Aim(weight=weight) for weight in (0.1, 1.0, 10.0)),
)
"""The aims that are compared."""


@dataclass(frozen=True)
class Front:
    """The deviations under each aim, as shares of the straight path's.

    Attributes:
        aims: The aims.
        shares: Deviation at the end, largest and integral, shape (motions, aims, 3); NaN without a plan.
    """

    aims: tuple[Aim, ...]
    shares: Array

    @property
    def planned(self) -> Array:
        """Return for how many motions there is a plan under each aim, shape (aims,)."""
        return np.sum(np.isfinite(self.shares[:, :, 0]), axis=0)

    @property
    def medians(self) -> Array:
        """Return the median shares over the motions, shape (aims, 3); a motion without a plan counts as infinite."""
        return np.median(np.where(np.isnan(self.shares), np.inf, self.shares), axis=0)

    def __str__(self) -> str:
        medians = self.medians
        best = undominated(-medians)
        rows = [
            (
                f"{aim}{' *' if best[k] else ''}",
                f"{count} of {len(self.shares)}",
                *(f"{100.0 * share:.1f} %" if np.isfinite(share) else "-" for share in medians[k]),
            )
            for k, (aim, count) in enumerate(zip(self.aims, self.planned.tolist(), strict=True))
        ]
        return table(("aim (* on the front)", "planned", "end", "largest", "integral"), rows)


def front(
    scenarios: Sequence[ArmMotionScenario],
    aims: Sequence[Aim] = AIMS,
    *,
    echo: Callable[[str], None] = lambda line: None,
) -> Front:
    """Return what the plans of some motions under each aim make of the base, in the full testbed.

    Args:
        scenarios: The motions.
        aims: The aims.
        echo: Gets a line for each motion, in their order.
    """
    shares = []
    for _, of_motion in in_processes(partial(_shares, tuple(aims)), scenarios):
        shares.append(of_motion)
        echo(f"motion {len(shares)} of {len(scenarios)}")
    return Front(tuple(aims), np.array(shares))


def _shares(aims: tuple[Aim, ...], scenario: ArmMotionScenario) -> list[list[float]]:
    """Return the deviations under each aim as shares of the straight path's."""
    straight = _deviations(simulate(scenario))
    shares = []
    for aim in aims:
        plan = plan_by_casadi(replace(scenario.move(), turn=aim.turn, weight=aim.weight), attempts=_STARTS)
        planned = np.isfinite(plan.deviation)
        shares.append((_deviations(simulate(scenario, plan.knots)) / straight).tolist() if planned else [np.nan] * 3)
    return shares


def _deviations(course: Course) -> Array:
    """Return the deviation at the end and the largest one in rad, and the integral in rad s."""
    outcome = course.outcome
    return np.array([outcome.end, outcome.largest, outcome.integral])


@click.command()
@click.option("--pairs", default=10, show_default=True, type=click.IntRange(min=1), help="Number of motions.")
def main(pairs: int) -> None:
    """Print the median deviations of N random motions under each aim, as shares of the straight path's."""
    click.echo(str(front(random_scenarios(2 * pairs, seed=_SEED)[0::2], echo=partial(click.echo, err=True))))


if __name__ == "__main__":
    main(prog_name="python -m vtbdrake_diagrams.satellite.studies.arm_front")
