"""The wall time that is left of a decision's budget, counted in rollouts."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil, inf

# The share of the time that is left which rollouts may take together, by what the last ones took: they may take
# longer, on a computer that is busy, and the next ones are counted by what these took.
_SHARE = 0.5

# The time in s that the choice at the end takes for each rollout, which is kept for it; it takes 5e-6 to 1e-5 s.
_CHOICE = 1e-5


class TimeLeft:
    """Counts the rollouts that fit into the time that is left, by the wall time that the last ones took.

    With w workers, n rollouts take r ceil(n / w), where r is measured by the last call; a call takes at least as long
    as the shortest call so far.

    Args:
        deadline: When the budget ends, on the clock; infinity: never.
        side_by_side: The number w of rollouts that run side by side.
        clock: The clock, in seconds.
    """

    def __init__(self, deadline: float, *, side_by_side: int, clock: Callable[[], float]) -> None:
        self.deadline = deadline
        self._side_by_side = side_by_side
        self._clock = clock
        self._begun = 0.0
        self._round = self._shortest = self._reserve = 0.0

    @property
    def seconds(self) -> float:
        """Return the time that is left for rollouts, in seconds; negative after the deadline."""
        return self.deadline - self._reserve - self._clock()

    def affordable(self, most: int, *, together: int) -> int:
        """Return the number of rollouts to run next; 0 if no more fit.

        Args:
            most: The largest number.
            together: The number that makes a candidate: as many are run, or a multiple of it.
        """
        left = self.seconds
        if left == inf:
            return most
        candidate_takes = self._round * ceil(together / self._side_by_side)
        if left <= max(candidate_takes, self._shortest):
            return 0
        rounds = int(min(_SHARE * left / max(self._round, 1e-9), most))
        count = max(rounds * self._side_by_side, self._side_by_side, together)
        return min(most, count - count % together)

    def begin(self) -> None:
        """Note that rollouts begin."""
        self._begun = self._clock()

    def end(self, count: int) -> None:
        """Note that ``count`` rollouts, those that have begun last, have finished."""
        elapsed = self._clock() - self._begun
        self._shortest = elapsed if self._shortest == 0.0 else min(self._shortest, elapsed)
        self._reserve += _CHOICE * count
        self._round = elapsed / ceil(count / self._side_by_side)
