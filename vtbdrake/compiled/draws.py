"""The random numbers of a rollout, and other data that is looked up before it: the vectors w of its instants."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vtbdrake.common.arrays import Array
from vtbdrake.compiled.equations import Draw, Equations, Timing
from vtbdrake.compiled.leaf_systems import LeafSystems
from vtbdrake.compiled.schedule import Instant
from vtbdrake.compiled.state_vector import StateVector
from vtbdrake.state.declarations import PARAMETER


@dataclass(frozen=True)
class PlacedDraw:
    """The numbers of one system in w.

    Attributes:
        path: Path of the system.
        timing: When its updates take the numbers; None: it is never updated, and has them at each instant.
        draw: How they are computed.
        entries: Where they lie in w.
    """

    path: str
    timing: Timing | None
    draw: Draw
    entries: slice


class Draws:
    """The layout of w, the vector of the random numbers and other data of an instant.

    Args:
        systems: The leaf systems of the Diagram.
        vector: The layout of z, in which the seeds lie.

    Attributes:
        placed: The draws, by path of the system and name.
        size: The number of entries of w.
    """

    def __init__(self, systems: LeafSystems, vector: StateVector) -> None:
        self._timings, self._vector = systems.timings, vector
        self.placed = dict(_placed(systems.equations))
        self.size = max((each.entries.stop for each in self.placed.values()), default=0)

    def seeds(self, z: Array) -> Array:
        """Return the seeds of all draws in vectors z, shape (n, size), as an array of shape (n, draws)."""
        seeds = np.zeros((len(z), len(self.placed)))
        for k, each in enumerate(self.placed.values()):
            if each.draw.seed is not None:
                group, entry = each.draw.seed
                seeds[:, k] = z[:, self._vector.blocks[each.path, PARAMETER, group].entries.start + entry]
        return seeds

    def numbers(self, seeds: Array, instants: Sequence[Instant], count: int) -> Array:
        """Return the vectors w of instants, shape (n, count, max(1, size)), 0 where no number is used.

        Args:
            seeds: The seeds of the draws, shape (n, draws).
            instants: The instants.
            count: The number of rows, at least one for each instant.
        """
        w = np.zeros((len(seeds), count, max(1, self.size)))
        for column, each in zip(seeds.T, self.placed.values(), strict=True):
            number = None if each.timing is None else self._timings.index(each.timing)
            due = [k for k, instant in enumerate(instants) if number is None or number in instant.updates]
            times = np.array([instants[k].time for k in due])
            is_same = bool((column == column[0]).all())
            w[:, due, each.entries] = each.draw.numbers(column[:1] if is_same else column, times)
        return w


def _placed(equations: Mapping[str, Equations]) -> Iterator[tuple[tuple[str, str], PlacedDraw]]:
    start = 0
    for path, each in equations.items():
        for name, draw in each.draws.items():
            yield (path, name), PlacedDraw(path, each.timing, draw, slice(start, start + draw.size))
            start += draw.size
