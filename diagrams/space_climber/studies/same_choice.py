"""Application R1: does the robot choose the same heading by compiled rollouts and by Drake's?

In each crater the robot walks some legs along the route over what it sees, and then decides once: by compiled rollouts,
which stand on the pieces of its believed world, and by Drake's simulator, in a testbed that `add_to_plant` makes of the
same world. Both begin at the same belief.

``python -m vtbdrake_diagrams.space_climber.studies.same_choice`` does so in craters that are not judged.
"""

from __future__ import annotations

from dataclasses import dataclass

import click
import numpy as np

from vtbdrake.reasoning import Decision
from vtbdrake_diagrams.space_climber.route import route
from vtbdrake_diagrams.space_climber.studies.crater import HEADING, WALK
from vtbdrake_diagrams.space_climber.studies.explorer import CostToRim, Explorer, heading_reasoner, mental_reasoner
from vtbdrake_diagrams.space_climber.studies.perceived import LEG, LOOKING, Site

LEGS = 5
"""After how many legs the robot decides: it stands where the wall begins, among rocks."""


@dataclass(frozen=True)
class Choices:
    """What the robot decides in one crater.

    Attributes:
        seed: The crater's seed.
        place: Where it stands, (x, y) in m.
        compiled: The decision by compiled rollouts.
        drake: The decision by rollouts in Drake.
    """

    seed: int
    place: tuple[float, float]
    compiled: Decision
    drake: Decision

    @property
    def is_same(self) -> bool:
        """Return whether both choose the same candidate."""
        return self.compiled.chosen == self.drake.chosen

    @property
    def loss(self) -> float:
        """Return by how much the compiled choice is worse than Drake's by Drake's own rollouts, in m."""
        if self.compiled.chosen is None or self.drake.chosen is None:
            return 0.0 if self.is_same else np.inf
        candidates = self.drake.candidates
        return float(candidates[self.compiled.chosen].quality - candidates[self.drake.chosen].quality)


def choices(seed: int) -> Choices:
    """Let the robot walk `LEGS` legs in a crater, and decide twice.

    Args:
        seed: The crater's seed.
    """
    site = Site(seed)
    rover, explorer = site.rover(), Explorer(site.world, site.terrain, tries=False)
    for _ in range(LEGS):
        rover.advance(LOOKING, walk=0.0)
        rover.advance(LEG, heading=explorer.decide(rover).heading or 0.0, walk=1.0)
    rover.advance(LOOKING, walk=0.0)
    explorer.look(rover)
    way = route(explorer.terrain)
    rover.testbed.write(rover.context, {HEADING: way.heading(rover.place), WALK: 1.0})
    reasoner, executor, quality, scenario = mental_reasoner()
    quality.route = way
    world = explorer.mental(rover.place)
    executor.stand_on(scenario.pieces(world.world))
    compiled = reasoner.decide(rover.testbed, rover.context)
    with heading_reasoner(world, CostToRim(way), executor="serial") as in_drake:
        drake = in_drake.decide(rover.testbed, rover.context)
    x, y = rover.place.tolist()
    return Choices(seed, (x, y), compiled, drake)


@click.command()
@click.option("--first", default=1, show_default=True, help="Seed of the first crater.")
@click.option("--count", default=10, show_default=True, help="Number of craters.")
def main(first: int, count: int) -> None:
    """Compare the choices in some craters."""
    same = []
    for seed in range(first, first + count):
        both = choices(seed)
        same.append(both.is_same)
        headings = [
            np.degrees(float(each.values[HEADING])) if each.chosen is not None else np.nan
            for each in (both.compiled, both.drake)
        ]
        qualities = np.array([[c.quality for c in each.candidates] for each in (both.compiled, both.drake)])
        click.echo(
            f"crater {seed}, at ({both.place[0]:.1f}, {both.place[1]:.1f}) m: compiled {headings[0]:.0f} deg, Drake "
            f"{headings[1]:.0f} deg; the same: {both.is_same}, loss {both.loss:.2f} m, qualities differ by "
            f"{np.nanmedian(np.abs(qualities[0] - qualities[1])):.2f} m in the median"
        )
    click.echo(f"the same choice in {sum(same)} of {len(same)} craters")


if __name__ == "__main__":
    # Under its own name, so that its functions can be pickled.
    from vtbdrake_diagrams.space_climber.studies.same_choice import main as program

    program(prog_name="python -m vtbdrake_diagrams.space_climber.studies.same_choice")
