"""The reasoner on board of a mental copy, compiled: its part shows the candidate, also on request."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.systems.framework import Context

from tests.reasoning.pusher import CANDIDATE, PLANNER, STATE, Law, PusherScenario
from vtbdrake.compiled import EQUATIONS, At, Equations, UnsupportedTestbedError
from vtbdrake.compiled.equations import Expression
from vtbdrake.optimization import Parameter
from vtbdrake.reasoning import Budget, OnboardReasoner, Reasoner, SearchConfig
from vtbdrake.rollout import Quality, RolloutTask, SerialExecutor, Start
from vtbdrake.rollout.compiled_executor import CompiledExecutor

SAMPLED = 0.3
OUTPUTS = (STATE, *(f"{PLANNER}.{name}" for name in ("decision", "sampled_at", "valid", "taken")))


class LawEquations(Equations):
    def output(self, port: str, at: At) -> Expression:
        return at.state(0)

    def update(self, at: At) -> dict[int, Expression]:
        x, v = at.input("state")[0], at.input("state")[1]
        return {0: 9.0 * (at.input("valid") * at.input("setpoint") - x) - 1.5 * v}


@pytest.fixture(autouse=True)
def compiled_law(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EQUATIONS, Law, LawEquations)


def requested(scenario: PusherScenario):
    """Return a testbed that is asked to decide at 0.3 s, and its context."""
    testbed = scenario.build()
    simulator = testbed.simulator()
    context = simulator.get_mutable_context()
    testbed.write(context, {STATE: (0.1, -0.3), "u.goal": 0.4})
    simulator.AdvanceTo(SAMPLED)
    testbed.write(context, {"u.request": 3.0})
    return testbed, context


@pytest.mark.parametrize(("decides_at", "taken"), [(SAMPLED, 3.0), (SAMPLED + 0.25, 3.0), (-1.0, 0.0)])
def test_takes_the_request_of_its_candidate(decides_at: float, taken: float) -> None:
    scenario = PusherScenario()
    testbed, context = requested(scenario)
    start, task = Start.of(testbed, context), RolloutTask(scenario.mental(), 0.6, record=OUTPUTS)
    points = [{CANDIDATE: value, f"{PLANNER}.candidate_at": decides_at} for value in (-0.5, 0.25)]
    with SerialExecutor() as drake, CompiledExecutor(compile=False) as compiled:
        results = [dict(executor.run(task, points, start=start)) for executor in (drake, compiled)]
    for k in range(len(points)):
        assert results[1][k].computed == "compiled"
        for address in OUTPUTS:
            values, by_drake = (each[k].record[address] for each in results[::-1])
            np.testing.assert_allclose(values, by_drake, rtol=0.0, atol=1e-11)
        assert results[1][k].record[f"{PLANNER}.taken"][-1] == taken


def test_decides_on_request_as_in_drake() -> None:
    scenario = PusherScenario()
    testbed, context = requested(scenario)
    testbed.write(context, {f"{PLANNER}.candidate_at": SAMPLED})
    decisions = []
    for executor in ("serial", "compiled"):
        with Reasoner(
            scenario=scenario,
            decision=[Parameter(CANDIDATE, -1.0, 1.0)],
            quality=Quality(lambda state, goal: abs(state[0] - goal), [STATE, "u.goal"], minimize=True, reading="end"),
            horizon=1.0,
            budget=Budget(rollouts=12),
            search=SearchConfig(method="random", executor=executor),
        ) as reasoner:
            decisions.append(reasoner.decide(testbed, context))
    assert decisions[0].chosen == decisions[1].chosen != 0
    assert decisions[0].quality == pytest.approx(decisions[1].quality, abs=1e-11)
    assert {r.computed for candidate in decisions[1].candidates for r in candidate.rollouts} == {"compiled"}


@pytest.mark.parametrize(("executor", "computed"), [("auto", "drake"), ("compiled", "compiled")])
def test_in_a_simulation_it_decides_by_compiled_rollouts_if_asked(executor: str, computed: str) -> None:
    testbed, context = requested(PusherScenario(executor=executor))
    planner = testbed.dps.GetSubsystemByName("planner")
    planner.remember(1)
    testbed.simulator(context).AdvanceTo(SAMPLED + 0.3)
    _, decision = planner.decision_shown(planner.GetMyContextFromRoot(context))
    assert {r.computed for candidate in decision.candidates for r in candidate.rollouts} == {computed}
    assert decision.values[CANDIDATE] == pytest.approx(testbed.read(context, f"{PLANNER}.decision"))


class Configured(OnboardReasoner):
    def __init__(self, *, scenario: PusherScenario) -> None:
        super().__init__(
            1,
            scenario=scenario,
            decision=[Parameter(CANDIDATE, -1.0, 1.0)],
            quality=Quality(lambda state: state[0] + 9.0, [STATE], reading="end"),
            horizon=1.0,
            budget=Budget(rollouts=8),
            period=0.2,
            latency=0.1,
            believed={"state": 2},
            mental=not scenario.reasons,
        )


class Counting(Configured):
    def _show(self, context: Context, state: object) -> None:
        super()._show(context, state)


@dataclass
class DerivedScenario(PusherScenario):
    """The planner is of a class that is derived from `OnboardReasoner`."""

    every: float = 0.2
    counts: bool = False

    def make_planner(self) -> OnboardReasoner:
        return (Counting if self.counts else Configured)(scenario=self)


def test_a_derived_class_with_a_constructor_alone_is_compiled() -> None:
    testbed = DerivedScenario().mental().build()
    rollouts = testbed.compiled(horizon=0.5, sample_period=0.1, outputs=[f"{PLANNER}.decision"], compile=False)
    batch = rollouts({CANDIDATE: 0.7, f"{PLANNER}.candidate_at": 0.0})
    assert batch.outputs[f"{PLANNER}.decision"].ravel().tolist() == [0.0, 0.7, 0.7, 0.7, 0.7, 0.7]


def test_a_derived_class_that_does_something_else_is_refused() -> None:
    testbed = DerivedScenario(counts=True).mental().build()
    with pytest.raises(UnsupportedTestbedError, match="Counting is derived .* defines _show: define a constructor"):
        testbed.compiled(horizon=0.5, sample_period=0.1, compile=False)
