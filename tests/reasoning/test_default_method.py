"""The method of a reasoner that is told none."""

import numpy as np
import pytest

from tests.reasoning.scenarios import MassScenario
from vtbdrake.optimization import Choice, Parameter
from vtbdrake.reasoning import Belief, Budget, Reasoner, SearchConfig, Trajectory
from vtbdrake.reasoning.default_method import default_method
from vtbdrake.rollout import Pruning, Quality

X = Parameter("u.x", 0.0, 1.0)
COUNT = Parameter("u.count", 0, 4, integer=True)
WORD = Choice("u.word", ["a", "b", "c"])
PLAN = Trajectory("u.plan", 4, 1.0, lower=-1.0, upper=1.0)


@pytest.mark.parametrize(
    ("elements", "candidates", "method"),
    [
        ([COUNT, WORD], 15, "grid"),
        ([COUNT, WORD], 14, "CMA-ES"),
        ([COUNT], 3, "MPPI"),
        ([WORD], 2, "random"),
        ([WORD, X], 100, "CMA-ES"),
        ([WORD, PLAN], 100, "CMA-ES"),
        ([X] * 4, 30, "auto"),
        ([X] * 5, 30, "MPPI"),
        ([X], None, "MPPI"),
        ([WORD], None, "random"),
        ([X, COUNT], 30, "MPPI"),
        ([PLAN], 30, "MPPI"),
        ([X, PLAN], 30, "MPPI"),
    ],
)
def test_the_method_follows_from_the_kind_of_decision(elements, candidates, method):
    assert default_method(elements, candidates=candidates) == method


def _reasoner(budget, **search):
    """Decide when a mass that is pushed is pulled, so that it rests at 1."""
    return Reasoner(
        scenario=MassScenario(),
        decision=[Parameter("u.switch", 0.0, 3.0)],
        quality=Quality(lambda s: abs(s[0] - 1.0) + abs(s[1]), of="sim.sys.mass.y0", minimize=True, reading="end"),
        horizon=3.0,
        sample_period=1.0,
        budget=budget,
        search=SearchConfig(executor="serial", **search),
    )


@pytest.mark.parametrize(
    ("budget", "search", "method"),
    [
        (Budget(rollouts=20), {}, "auto"),
        (Budget(seconds=5.0), {}, "MPPI"),
        (Budget(rollouts=20, seconds=5.0), {}, "MPPI"),
        (Budget(rollouts=20), {"pruning": Pruning()}, "MPPI"),
        (Budget(rollouts=20), {"method": "CEM"}, "CEM"),
    ],
)
def test_a_reasoner_takes_it_unless_a_method_is_named(budget, search, method):
    with _reasoner(budget, **search) as reasoner:
        assert reasoner.solver(0.0, budget=budget.rollouts).name == method


def test_one_number_is_decided_better_than_by_sampling():
    testbed, costs = MassScenario().build(), {}
    for method in (None, "MPPI"):
        with _reasoner(Budget(rollouts=20), method=method) as reasoner:
            costs[method] = reasoner.decide(Belief.perfect(testbed, testbed.default_context())).quality
    assert costs[None] < 0.5 * costs["MPPI"]
    assert np.isfinite(costs["MPPI"])


def test_options_of_no_method_are_refused():
    with pytest.raises(ValueError, match="options belong to a method: name it by method=, beside options={'pop"):
        SearchConfig(options={"population": 8})
