"""A rollout ends when it can no longer reach enough, by each reading."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.testbeds import PendulumScenario
from vtbdrake.rollout import (
    Constraint,
    Cutoff,
    FuturesExecutor,
    Pruning,
    Quality,
    QualityError,
    RolloutRunner,
    RolloutTask,
)
from vtbdrake.rollout.pruning import Prospect

HORIZON = 1.0
TIMES = np.linspace(0.0, HORIZON, 6)
READINGS = ["best", "worst", "end", "integral"]


def ending(quality, samples, *, to_beat, pruning=None, measures=()):
    """Return the number of samples, the end, and the reachable values."""
    prospect = Prospect(pruning or Pruning(), quality, measures, HORIZON, to_beat)
    for count, (t, sample) in enumerate(zip(TIMES, samples, strict=True), 1):
        end = prospect.update(t, [sample] * (1 + len(measures)), [])
        if end is not None:
            return count, end[0], prospect.reachable
    return len(samples), "", prospect.reachable


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize("minimize", [False, True])
def test_a_rollout_that_is_better_in_the_end_is_never_pruned(reading, minimize):
    rng = np.random.default_rng(1)
    limits = {"minimize": True} if minimize else {"upper": 3.0}
    quality = Quality(abs, "x", reading=reading, **limits)
    ended = 0
    for _ in range(300):
        samples = rng.uniform(0.0, 3.0, TIMES.size)
        value = quality.read(TIMES, samples)
        to_beat = value * rng.uniform(0.2, 2.0)
        _, end, reachable = ending(quality, samples, to_beat=to_beat)
        better = value < to_beat if minimize else value > to_beat
        assert not (end and better)
        if end:
            ended += 1
            # The bound lies between what it would have reached and what is to be beaten.
            assert min(value, to_beat) - 1e-6 <= reachable <= max(value, to_beat) + 1e-6
    assert ended > 20 or reading in ("best", "end")


def test_a_growing_cost_is_pruned_once_it_is_too_large():
    cost = Quality(abs, "x", minimize=True, reading="integral")
    # Trapezoids of 0.2 s under 1: 0.2, 0.4, 0.6
    assert ending(cost, np.ones(6), to_beat=0.5)[:2] == (4, "pruned")
    assert ending(cost, np.ones(6), to_beat=np.nan)[:2] == (6, "")


def test_a_users_bound_prunes_by_the_time_left():
    highest = Quality(abs, "x")
    pruning = Pruning(bound=lambda left: 2.0 * left)
    # 2 left falls to 1.2 at the third sample, and below 1 at the fourth.
    assert ending(highest, np.zeros(6), to_beat=1.0, pruning=pruning) == (4, "pruned", pytest.approx(0.8))


@pytest.mark.parametrize("bound", ["1.5", None])
def test_a_bound_that_is_no_number_is_refused(bound):
    with pytest.raises(QualityError, match=f"the bound of a pruning must return a real number, not {bound!r}"):
        ending(Quality(abs, "x"), np.zeros(6), to_beat=1.0, pruning=Pruning(bound=lambda left: bound))


def test_a_violated_constraint_prunes_unless_it_is_read_otherwise():
    quality = Quality(abs, "x")
    samples = np.arange(6.0)
    worst, end = (Constraint(abs, "x", at_most=2.5, reading=reading) for reading in ("worst", "end"))
    assert ending(quality, samples, to_beat=np.nan, measures=[worst])[:2] == (4, "pruned")
    assert ending(quality, samples, to_beat=np.nan, measures=[end])[:2] == (6, "")


def test_patience_counts_from_the_last_gain():
    quality = Quality(abs, "x")
    pruning = Pruning(patience=0.3, gain=0.5)
    # 0.4 more is no gain: the last one is at 0.2 s, and at 0.6 s nothing was gained for 0.4 s.
    assert ending(quality, [0.0, 1.0, 1.4, 1.4, 1.4, 9.0], to_beat=np.nan, pruning=pruning)[:2] == (4, "stalled")


def test_a_pruned_rollout_agrees_with_the_whole_one():
    angle = "sim.sys.Pendulum.theta.position"
    cost = Quality(lambda q: abs(q - 1.0), angle, minimize=True, reading="integral")
    whole, pruned = (RolloutTask(PendulumScenario(), 2.0, cost, pruning=pruning) for pruning in (None, Pruning()))
    expected = RolloutRunner(whole).run({angle: 0.1})
    runner = RolloutRunner(pruned)
    result = runner.run({angle: 0.1}, cutoff=Cutoff(to_beat=expected.value / 3.0))
    assert result.end == "pruned"
    assert expected.value / 3.0 <= result.value <= expected.value
    np.testing.assert_array_equal(result.quality, expected.quality[: result.quality.size])
    assert 0.0 < result.times[-1] < 2.0
    assert runner.run({angle: 0.1}, cutoff=Cutoff(to_beat=expected.value * 1.01)).identical(expected)
    assert runner.run({angle: 0.1}).identical(expected)


def test_a_pool_that_cannot_cancel_refuses_a_cutoff():
    task = RolloutTask(PendulumScenario(), 1.0)
    with ThreadPoolExecutor(1) as pool, pytest.raises(ValueError, match="cannot cancel rollouts"):
        list(FuturesExecutor(pool).run(task, [{}], cutoff=Cutoff()))
