"""Application R1: does it pay to try each heading also in draws of the ground that the robot does not know well?

The walks of ``perceived.jsonl`` tried headings in the believed world alone. Here the same robot walks again in the same
craters, and tries each heading in draws of the ground, too. The worst rollout counts.

``python -m vtbdrake_diagrams.space_climber.studies.drawn_terrain`` does so, and compares.
"""

from __future__ import annotations

from collections.abc import Sequence

import click
import numpy as np

from vtbdrake_diagrams.space_climber.studies.perceived import Site, Walk, judged, load
from vtbdrake_diagrams.space_climber.studies.rover import FEW_ROCKS


def comparison(without: Sequence[Walk], drawn: Sequence[Walk]) -> str:
    """Return what draws change, in some sentences.

    Args:
        without: Walks without draws.
        drawn: Walks with draws, in the same craters.

    Raises:
        ValueError: The craters differ.
    """
    seeds = [walk.seed for walk in without]
    if seeds != [walk.seed for walk in drawn]:
        raise ValueError(f"the craters differ: {seeds} and {[walk.seed for walk in drawn]}")
    lines = []
    for name, walks in (("without draws", without), ("with draws", drawn)):
        reached = [walk for walk in walks if walk.reached]
        times = [walk.duration for walk in reached]
        lines.append(
            f"{name}: the rim in {len(reached)} of {len(walks)} craters, in the median after "
            f"{np.median(times) if times else np.nan:.0f} s, with {np.median([walk.thinking for walk in walks]):.1f} s "
            "of thinking"
        )
    gained = [a.seed for a, b in zip(without, drawn, strict=True) if b.reached and not a.reached]
    lost = [a.seed for a, b in zip(without, drawn, strict=True) if a.reached and not b.reached]
    return "\n".join([*lines, f"only with draws: {gained}; only without: {lost}"])


@click.command()
@click.option("--first", default=FEW_ROCKS.first_seed, show_default=True, help="Seed of the first crater.")
@click.option("--count", default=1, show_default=True, help="Number of craters; only passable ones count.")
@click.option("--draws", default=2, show_default=True, help="Number of draws of the ground.")
def main(first: int, count: int, draws: int) -> None:
    """Let the robot walk with draws where it has walked without."""
    without = {each.seed: each.walks["reasoned"] for each in judged(load()) if first <= each.seed < first + count}
    drawn = []
    for seed in without:
        drawn.append(Site(seed).explore(draws=draws))
        click.echo(
            f"crater {seed}: {'the rim' if drawn[-1].reached else drawn[-1].reason} in {drawn[-1].duration:.0f} s"
        )
    click.echo(comparison(list(without.values()), drawn))


if __name__ == "__main__":
    # Under its own name, so that its functions can be pickled.
    from vtbdrake_diagrams.space_climber.studies.drawn_terrain import main as program

    program(prog_name="python -m vtbdrake_diagrams.space_climber.studies.drawn_terrain")
