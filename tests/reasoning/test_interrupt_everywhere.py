"""Ctrl-C in many lines of a decision: it ends, and the next decision is the one that it would have been."""

import pytest

from tests.interruptions import hanging_fails, interrupt, places
from tests.reasoning.scenarios import MassScenario
from tests.reasoning.test_reasoner import MISS, SWITCH
from vtbdrake.optimization import evaluator
from vtbdrake.reasoning import Belief, Budget, Reasoner, SearchConfig, decision_run, reasoner
from vtbdrake.rollout import SerialExecutor, ThreadExecutor, executor, runner, testbeds

MODULES = reasoner, decision_run, evaluator, executor, testbeds, runner
# Each place costs two decisions: so only some of the lines are interrupted, at equal distances.
EVERY = 6


@pytest.mark.one_python
@pytest.mark.parametrize(
    ("make", "seconds", "every"),
    [
        (lambda: ThreadExecutor(2), 3600.0, 6 * EVERY),
        *(
            pytest.param(make, seconds, EVERY, marks=pytest.mark.slow)
            for make in (SerialExecutor, lambda: ThreadExecutor(2))
            for seconds in (None, 3600.0)
        ),
    ],
)
def test_ctrl_c_in_many_lines_of_a_decision(make, seconds, every):
    testbed = MassScenario().build()
    belief = Belief.perfect(testbed, testbed.default_context())
    with (
        make() as rollouts,
        Reasoner(
            scenario=MassScenario(),
            decision=[SWITCH],
            quality=MISS,
            horizon=3.0,
            sample_period=0.5,
            budget=Budget(rollouts=6, seconds=seconds),
            search=SearchConfig(executor=rollouts),
        ) as deciding,
    ):

        def operation():
            return deciding.decide(belief)

        whole = operation()
        interrupted = 0
        for place in places(operation, *MODULES, lines=True)[::every]:
            interrupted += interrupt(operation, *MODULES, at=place) is not None
            with hanging_fails(place):
                again = operation()
            assert again.values == whole.values and again.quality == whole.quality, place
            assert [c.quality for c in again.candidates] == [c.quality for c in whole.candidates], place
        assert interrupted > 60 / every
