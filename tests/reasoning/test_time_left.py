"""The rollouts that fit into a budget of wall time, with a clock that moves by their cost."""

import pytest

from tests.reasoning.scenarios import MassScenario
from tests.reasoning.test_reasoner import MISS, SWITCH
from vtbdrake.reasoning import Belief, BeliefConfig, Budget, Reasoner, SearchConfig, decision_run, reasoner
from vtbdrake.reasoning.time_left import TimeLeft
from vtbdrake.rollout import SerialExecutor

UNCERTAIN = {"sim.sys.mass.discrete_state_0": [0.1, 0.0]}


class Clock:
    """A clock that moves when it is told to."""

    now = 0.0

    def __call__(self):
        return self.now


@pytest.mark.parametrize("side_by_side", [1, 3])
def test_rollouts_fit_into_half_of_what_is_left(side_by_side):
    clock = Clock()
    left = TimeLeft(1.0, side_by_side=side_by_side, clock=clock)
    left.begin()
    clock.now = 0.1
    left.end(side_by_side)
    # 0.9 s are left, and 0.1 s a round.
    assert left.affordable(1000, together=1) == 4 * side_by_side
    assert left.affordable(2, together=1) == 2
    clock.now = 0.89
    assert left.affordable(1000, together=1) == side_by_side
    clock.now = 0.91
    assert left.affordable(1000, together=1) == 0


def test_all_samples_of_a_candidate_fit_or_none():
    clock = Clock()
    left = TimeLeft(1.0, side_by_side=2, clock=clock)
    left.begin()
    clock.now = 0.1
    left.end(2)
    assert left.affordable(1000, together=5) == 5
    clock.now = 0.75  # Five rollouts take three rounds.
    assert left.affordable(1000, together=5) == 0


class Costly(SerialExecutor):
    """Rollouts of a known cost, which nothing cancels. ``calls``: the number of rollouts in each call."""

    def __init__(self, clock, cost):
        super().__init__()
        self.clock, self.cost, self.calls = clock, cost, []

    def run(self, task, points, *, start=None, cutoff=None):
        self.calls.append(len(points))
        for result in super().run(task, points, start=start):
            self.clock.now += self.cost
            yield result


@pytest.fixture
def costly(monkeypatch):
    """A function that decides within 0.03 s by rollouts of a cost in s; it returns the decision and the executor."""
    clock, scenario = Clock(), MassScenario()
    testbed = scenario.build()
    for module in (reasoner, decision_run):
        monkeypatch.setattr(module, "monotonic", clock)

    def decide(cost, samples=1):
        executor = Costly(clock, cost)
        with Reasoner(
            scenario=scenario,
            decision=[SWITCH],
            quality=MISS,
            horizon=0.5,
            sample_period=0.5,
            budget=Budget(seconds=0.03),
            search=SearchConfig(executor=executor),
            belief=BeliefConfig(samples=samples, uncertainty=UNCERTAIN if samples > 1 else None),
        ) as mental:
            return mental.decide(Belief.perfect(testbed, testbed.default_context())), executor

    return decide


@pytest.mark.parametrize("cost", [0.004, 0.009, 0.014])
@pytest.mark.parametrize("samples", [1, 2])
def test_batches_fit_the_budget(costly, cost, samples):
    decision, executor = costly(cost, samples)
    assert decision.end == "time"
    assert 0.03 - (samples + 1) * cost < decision.health.elapsed <= 0.03
    # Without the warm-up: the plan in use alone, whose cost is not known before.
    assert executor.calls[1] == samples
    assert decision.health.rollouts == sum(executor.calls[1:]) == int(0.03 / cost) // samples * samples
    assert all(candidate.status == "eligible" for candidate in decision.candidates)


def test_the_plan_in_use_is_judged_though_it_takes_longer_than_the_budget(costly):
    decision, executor = costly(0.2)
    assert decision.keeps_plan
    assert executor.calls[1:] == [1]
    assert "nothing but the plan in use was tried" in decision.warnings[0]
    assert "it took 0.2 s, but its budget is 0.03 s" in decision.warnings[1]
