"""The model of the projection to a cluster, against a cluster that is played through event by event."""

import heapq

import pytest

from benchmarks.cluster import predicted_efficiency


def _played(workers, rollouts, *, t_r, t_x, t_s):
    """Efficiency of a cluster whose scheduler hands out one rollout in t_s, to whoever waits for the longest."""
    free = [0.0] * workers
    scheduler = end = 0.0
    for _ in range(rollouts):
        scheduler = max(heapq.heappop(free), scheduler) + t_s
        end = scheduler + t_r + t_x
        heapq.heappush(free, end)
    return rollouts * t_r / (workers * end)


@pytest.mark.parametrize(
    ("workers", "t_r", "t_x", "t_s"),
    [(10, 0.5, 0.0, 1e-6), (10, 0.5, 0.5, 1e-6), (100, 0.5, 0.01, 1e-3), (1000, 0.5, 0.01, 2e-3)],
)
def test_the_predicted_efficiency_is_that_of_a_cluster_played_through(workers, t_r, t_x, t_s):
    played = _played(workers, 400 * workers, t_r=t_r, t_x=t_x, t_s=t_s)
    assert predicted_efficiency(workers, t_r=t_r, t_x=t_x, t_s=t_s) == pytest.approx(played, rel=0.01)
