"""Walks with and without draws of the ground are compared crater by crater."""

from dataclasses import replace

import pytest

from vtbdrake_diagrams.space_climber.studies.drawn_terrain import comparison
from vtbdrake_diagrams.space_climber.studies.perceived import Walk


def walk(seed: int, duration: float, *, reached: bool = True) -> Walk:
    return Walk(seed, "reasoned", reached, duration, (0.0, 0.0, 0.0), "", (), 2.0)


def test_gains_losses_and_medians_are_told() -> None:
    without = [walk(1, 300.0), walk(2, 600.0, reached=False), walk(3, 340.0)]
    drawn = [replace(each, thinking=6.0, reached=not each.reached if each.seed > 1 else True) for each in without]
    assert comparison(without, drawn).splitlines() == [
        "without draws: the rim in 2 of 3 craters, in the median after 320 s, with 2.0 s of thinking",
        "with draws: the rim in 2 of 3 craters, in the median after 450 s, with 6.0 s of thinking",
        "only with draws: [2]; only without: [3]",
    ]


def test_walks_in_other_craters_are_not_compared() -> None:
    with pytest.raises(ValueError, match=r"the craters differ: \[1\] and \[2\]"):
        comparison([walk(1, 1.0)], [walk(2, 1.0)])
