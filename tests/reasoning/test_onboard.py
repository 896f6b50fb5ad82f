"""A reasoner on board in a simulation: what it decides, when, and that its mental rollouts are the true future."""

from __future__ import annotations

import pickle
from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ZeroOrderHold

from tests.reasoning.pusher import CANDIDATE, PERIOD, PLANNER, STATE, PusherScenario
from vtbdrake.common.pickling import dumps
from vtbdrake.components.spline_command import SplineCommand
from vtbdrake.optimization import Parameter
from vtbdrake.reasoning import Budget, OnboardReasoner, SearchConfig, Trajectory
from vtbdrake.rollout import Quality, RolloutTask, Start
from vtbdrake.rollout.runner import RolloutRunner
from vtbdrake.testbed import DpsAlone

SAMPLED, LATENCY, HORIZON = 0.3, 0.2, 1.0
GOAL, BEGIN = 0.4, (0.1, -0.3)


def asked(scenario):
    """A testbed at 0.3 s, where it is asked to decide, its simulator and its context."""
    testbed = scenario.build()
    simulator = testbed.simulator()
    context = simulator.get_mutable_context()
    testbed.write(context, {STATE: BEGIN, "u.goal": GOAL})
    simulator.AdvanceTo(SAMPLED)
    if not scenario.every:
        testbed.write(context, {"u.request": 1.0})
    return testbed, simulator, context


def planner(testbed, context):
    names = ("decision", "quality", "improvement", "rollouts", "sampled_at", "valid", "missed")
    return {name: testbed.read(context, f"{PLANNER}.{name}") for name in names}


def position_after(setpoint):
    """Where the mass is after the horizon, by the equations of the mass and of its law alone."""
    (x, v), force = BEGIN, 0.0
    for k in range(round((SAMPLED + HORIZON) / PERIOD)):
        wanted = setpoint if k * PERIOD > SAMPLED + LATENCY - 1e-6 else 0.0
        new = 9.0 * (wanted - x) - 1.5 * v
        x, v, force = x + PERIOD * v + 0.5 * PERIOD**2 * force, v + PERIOD * force, new
    return x


def best_setpoint():
    # The position is linear in the set point.
    at_0, at_1 = position_after(0.0), position_after(1.0)
    return (GOAL - at_0) / (at_1 - at_0)


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    "scenario", [PusherScenario(rollouts=50, method="predictive-sampling"), PusherScenario(rollouts=51, method="grid")]
)
def test_decision_is_the_best_one(scenario):
    testbed, simulator, context = asked(scenario)
    simulator.AdvanceTo(SAMPLED + LATENCY + 0.001)
    assert abs(best_setpoint() - GOAL) > 0.05
    assert testbed.read(context, f"{PLANNER}.decision") == pytest.approx(best_setpoint(), abs=0.03)


def test_predicted_quality_is_the_true_one_to_the_last_bit():
    testbed, simulator, context = asked(PusherScenario())
    simulator.AdvanceTo(SAMPLED + LATENCY - 0.001)
    assert planner(testbed, context)["valid"] == 0.0
    simulator.AdvanceTo(SAMPLED + LATENCY + 0.001)
    shown = planner(testbed, context)
    assert (shown["valid"], shown["sampled_at"], shown["rollouts"]) == (1.0, pytest.approx(SAMPLED), 12.0)
    assert shown["improvement"] > 0.0 and shown["decision"] != 0.0
    simulator.AdvanceTo(SAMPLED + HORIZON)
    assert abs(testbed.read(context, STATE)[0] - GOAL) == shown["quality"]


def test_mental_rollout_of_the_decision_is_the_true_future():
    scenario = PusherScenario()
    testbed, simulator, context = asked(scenario)
    start = Start.of(testbed, context)
    simulator.AdvanceTo(SAMPLED + HORIZON)
    runner = RolloutRunner(RolloutTask(scenario.mental(), HORIZON))
    chosen = {CANDIDATE: testbed.read(context, f"{PLANNER}.decision"), f"{PLANNER}.candidate_at": SAMPLED}
    mental = runner.state(chosen, HORIZON, start=start)
    told = ("candidate", "candidate_at", "quality", "improvement", "rollouts")
    differing = {key for key in testbed.snapshot(context).compare(mental) if key.startswith("sim.") or "/" not in key}
    assert differing == {f"{PLANNER}.{name}" for name in told}


def test_mental_copy_takes_no_further_request():
    scenario = PusherScenario()
    testbed, _, context = asked(scenario)
    runner = RolloutRunner(RolloutTask(scenario.mental(), 1.0))
    values = {CANDIDATE: 0.25, f"{PLANNER}.candidate_at": SAMPLED}
    for t in runner.simulate(values, start=Start.of(testbed, context)):
        if t == pytest.approx(0.5):
            runner.testbed.write(runner.context, {"u.request": 2.0})
    shown = planner(runner.testbed, runner.context)
    assert (shown["decision"], shown["sampled_at"], shown["valid"]) == (0.25, pytest.approx(SAMPLED), 1.0)
    assert runner.testbed.read(runner.context, f"{PLANNER}.taken") == 1.0


def test_plan_in_use_is_kept_where_nothing_else_is_tried():
    testbed, simulator, context = asked(PusherScenario(every=0.2, latency=0.1, rollouts=1))
    simulator.AdvanceTo(1.0)
    shown = planner(testbed, context)
    assert (shown["decision"], shown["improvement"], shown["valid"]) == (0.0, 0.0, 1.0)


def test_receding_horizon_comes_to_the_goal_and_stays():
    testbed, simulator, context = asked(PusherScenario(every=0.2, latency=0.1, horizon=0.8, rollouts=15))
    simulator.AdvanceTo(3.0)
    shown = planner(testbed, context)
    assert (shown["valid"], shown["missed"], shown["sampled_at"]) == (1.0, 0.0, pytest.approx(2.8))
    assert testbed.read(context, STATE) == pytest.approx([GOAL, 0.0], abs=0.1)


def test_without_an_eligible_candidate_the_dps_falls_back(caplog):
    testbed, simulator, context = asked(PusherScenario(wall=-5.0))
    simulator.AdvanceTo(SAMPLED + HORIZON)
    shown = planner(testbed, context)
    assert (shown["decision"], shown["valid"], shown["missed"]) == (0.0, 0.0, 1.0)
    assert testbed.read(context, STATE)[0] == pytest.approx(position_after(0.0))
    assert "nothing was decided at t = 0.3 s: no candidate is eligible (12 violated a constraint)" in caplog.text
    testbed.write(context, {"u.request": 2.0})
    simulator.AdvanceTo(SAMPLED + 2.0 * HORIZON)
    assert planner(testbed, context)["missed"] == 2.0
    assert caplog.text.count("nothing was decided") == 1


def test_what_cannot_be_believed_is_no_ground_for_a_decision(caplog):
    alone = DpsAlone(PusherScenario())
    context = alone.default_context()
    alone.diagram.GetInputPort("real.sense.state").FixValue(context, [np.nan, 0.0])
    alone.write(context, {"u.request": 1.0})
    alone.simulator(context).AdvanceTo(0.3)
    shown = planner(alone, context)
    assert (shown["decision"], shown["valid"], shown["missed"]) == (0.0, 0.0, 1.0)
    assert f"the belief about {STATE} is missing" in caplog.text


def test_copy_that_thinks_decides_alike():
    scenario = PusherScenario()
    testbed, simulator, context = asked(scenario)
    simulator.AdvanceTo(SAMPLED + 0.5 * LATENCY)
    other = scenario.build()
    copy = other.default_context()
    other.restore(copy, testbed.snapshot(context))
    # What the function keeps does not count.
    part = other.dps.GetSubsystemByName("planner")
    assert pickle.loads(dumps(part.function))
    simulator.AdvanceTo(1.0)
    other.simulator(copy, restored=True).AdvanceTo(1.0)
    assert not other.snapshot(copy).compare(testbed.snapshot(context))
    assert planner(other, copy)["valid"] == 1.0
    assert pickle.loads(dumps(part.function))


@dataclass
class PlanScenario(PusherScenario):
    """The force is a plan, decided every 0.1 s."""

    every: float = 0.1
    latency: float = 0.1

    def make_dps(self):
        plan = Trajectory(CANDIDATE, 4, 1.0, "linear", lower=-5.0, upper=5.0)
        builder = DiagramBuilder()
        reasoner = OnboardReasoner(
            5,
            scenario=self,
            decision=[plan],
            quality=Quality(distance, of=[STATE], reading="integral", minimize=True),
            horizon=1.0,
            budget=Budget(rollouts=8),
            period=self.every,
            latency=self.latency,
            believed={"state": 2},
            mental=not self.reasons,
            options={"search": SearchConfig(method="predictive-sampling")},
        )
        planner = builder.AddNamedSystem("planner", reasoner)
        follow = builder.AddNamedSystem("follow", SplineCommand(plan.spline, period=PERIOD, after=0.0))
        goal = builder.AddNamedSystem("goal", ZeroOrderHold(PERIOD, 1))
        builder.ExportInput(planner.GetInputPort("state"), "state")
        builder.ExportInput(goal.get_input_port(), "goal")
        builder.Connect(planner.GetOutputPort("decision"), follow.GetInputPort("plan"))
        builder.ExportOutput(follow.GetOutputPort("value"), "force")
        return builder.Build()


def distance(state):
    return (state[0] - GOAL) ** 2 + 0.1 * state[1] ** 2


def test_plan_that_is_decided_anew_comes_to_the_goal():
    testbed, simulator, context = asked(PlanScenario())
    simulator.AdvanceTo(1.35)
    plan = testbed.read(context, f"{PLANNER}.decision")
    # It begins at a sample, and is followed from when it is shown.
    assert testbed.read(context, f"{PLANNER}.sampled_at") == pytest.approx(1.2) and plan[0] <= 1.2 + 1e-9
    weights = Trajectory(CANDIDATE, 4, 1.0, "linear", lower=-5.0, upper=5.0).values(plan[1:], [1.34 - plan[0]])
    assert testbed.read(context, "dps.follow.value") == pytest.approx(weights.item())
    # Without a force, it would be at -0.3 m.
    assert testbed.read(context, STATE)[0] == pytest.approx(GOAL, abs=0.2)


@dataclass
class EndlessScenario(PusherScenario):
    """Its mental copy reasons, too."""

    def mental(self):
        return self


def test_mental_copy_that_reasons_itself_is_refused():
    _, simulator, _ = asked(EndlessScenario())
    with pytest.raises(ValueError, match="EndlessScenario reasons itself: give its OnboardReasoner mental=True"):
        simulator.AdvanceTo(1.0)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"budget": Budget(seconds=1.0)}, "has a budget of rollouts"),
        ({"decision": [Parameter("u.goal", 0.0, 1.0)]}, "decides its own parameter, dps.<path>.candidate, not u.goal"),
        ({"horizon": 0.2}, "a horizon of 0.2 s ends before a decision is shown"),
        ({"latency": 0.3}, "choose a period of at least 0.3 s"),
    ],
)
def test_impossible_arguments_are_refused(arguments, told):
    possible = {
        "scenario": PusherScenario(),
        "decision": [Parameter(CANDIDATE, 0.0, 1.0)],
        "quality": Quality(lambda x: x, of=["u.goal"]),
        "horizon": 1.0,
        "budget": Budget(rollouts=3),
        "period": 0.25,
        "latency": 0.2,
    }
    with pytest.raises(ValueError, match=told):
        OnboardReasoner(1, **possible | arguments)
