"""Decisions whose answers are known; budgets, candidates, methods, executors; what is refused."""

import threading
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

from tests.reasoning.scenarios import HANG, KILL, FencedMassScenario, MassScenario, SwingUpScenario
from tests.testbeds import PendulumScenario
from vtbdrake.optimization import Choice, Parameter
from vtbdrake.reasoning import Belief, BeliefConfig, BeliefError, Budget, Reasoner, ReasonerError, SearchConfig
from vtbdrake.rollout import Constraint, ProcessExecutor, Pruning, Quality, SerialExecutor, Start, ThreadExecutor
from vtbdrake.testbed import DpsAlone

SWITCH = Parameter("u.switch", 0.0, 3.0)
STATE = "sim.sys.mass.y0"


def distance(state):
    """Distance from rest at 1 m: of position and velocity."""
    return abs(state[0] - 1.0) + abs(state[1])


MISS = Quality(distance, of=STATE, minimize=True, reading="end")


def make(scenario=None, **changes):
    settings = {
        "decision": [SWITCH],
        "quality": MISS,
        "horizon": 3.0,
        "sample_period": 0.5,
        "budget": Budget(rollouts=30),
        "executor": "serial",
        # Fills every budget, in batches.
        "method": "MPPI",
        **changes,
    }
    groups = {
        name: config(**{field.name: settings.pop(field.name) for field in fields(config) if field.name in settings})
        for name, config in (("search", SearchConfig), ("belief", BeliefConfig))
    }
    return Reasoner(scenario=scenario or MassScenario(), **{**groups, **settings})


@pytest.fixture(scope="module")
def mass():
    return MassScenario().build()


@pytest.fixture(scope="module")
def executors():
    """By name; a process takes a second to start."""
    with SerialExecutor() as serial, ThreadExecutor(2) as threads, ProcessExecutor(2) as processes:
        yield {"serial": serial, "threads": threads, "processes": processes}


def decide(reasoner, testbed, *, values=None, at=0.0, **options):
    """A decision from the defaults, or after ``at`` seconds with ``values`` set."""
    context = testbed.default_context()
    testbed.write(context, values or {})
    if at:
        simulator = testbed.simulator(context)
        simulator.AdvanceTo(at)
    with reasoner:
        return reasoner.decide(Belief.perfect(testbed, context), **options)


# -- known answers


@pytest.mark.slow_cases
@pytest.mark.parametrize("method", ["CEM", "predictive-sampling", "MPPI", "CMA-ES", "LN_COBYLA"])
def test_a_double_integrator_switches_at_half_the_time_of_bang_bang(method, mass):
    # 1 m from rest to rest with 1 m/s^2 takes 2 s.
    decision = decide(make(method=method, budget=Budget(rollouts=60)), mass)
    assert decision
    assert decision.values["u.switch"] == pytest.approx(1.0, abs=0.05)
    assert decision.quality < 0.1


@pytest.mark.slow
def test_swing_up_time_agrees_with_ode_solver():
    torque, horizon = 2.5, 1.6

    def height(switch):
        state, best = np.zeros(2), 0.0
        for begin, end, u in ((0.0, switch, torque), (switch, horizon, -torque)):
            # 0.25 kg m^2, m g l = 4.905 N m, damping 0.1 N m s
            done = solve_ivp(
                lambda t, y, u=u: [y[1], (u - 4.905 * np.sin(y[0]) - 0.1 * y[1]) / 0.25],
                (begin, end),
                state,
                max_step=0.01,
                rtol=1e-8,
            )
            state, best = done.y[:, -1], max(best, np.max(1.0 - np.cos(done.y[0])))
        return best

    expected = minimize_scalar(lambda t: -height(t), bounds=(0.3, 1.0), method="bounded", options={"xatol": 1e-3})
    reasoner = make(
        SwingUpScenario(),
        decision=[Parameter("u.switch", 0.0, horizon)],
        quality=Quality(lambda q: 1.0 - np.cos(q), of="sim.sys.Pendulum.theta.position"),
        horizon=horizon,
        sample_period=0.02,
        budget=Budget(rollouts=40),
        method="MPPI",
    )
    decision = decide(reasoner, reasoner.problem.testbed)
    assert decision.values["u.switch"] == pytest.approx(expected.x, abs=0.04)
    assert decision.quality == pytest.approx(-expected.fun, abs=0.01)
    assert decision.quality > 1.8  # 2 is upright; either torque alone reaches 0.5.


def test_what_is_left_to_decide_depends_on_the_state(mass):
    # After 1 s with full force the mass is at 0.5 m: switching now stops it at 1 m, and nothing can stop it earlier.
    reasoner = make(method="grid", options={"points": 25})
    decision = decide(reasoner, mass, values={"u.switch": 3.0}, at=1.0)
    assert decision.time == 1.0
    assert decision.values["u.switch"] == 1.0
    assert decision.candidates[0].values == {"u.switch": 3.0}


def test_a_choice_is_decided_by_a_grid(mass):
    reasoner = make(decision=[Choice("u.switch", [0.5, 1.0, 2.0])], method="grid")
    decision = decide(reasoner, mass)
    assert decision.values == {"u.switch": 1.0}
    assert decision.end == "method"


# -- candidate 0


def test_candidate_0_is_the_plan_in_use_and_changes_nothing(mass):
    decision = decide(make(method="random"), mass, values={"u.switch": 0.7})
    first = decision.candidates[0]
    assert first.values == {"u.switch": 0.7}
    assert first.rollouts[0].parameters == {}
    # It rests at 0.49 m.
    assert first.quality == pytest.approx(0.51, abs=1e-9)


def test_a_plan_in_use_that_is_best_is_kept(mass):
    for seed in range(4):
        decision = decide(make(method="random", budget=Budget(rollouts=10), seed=seed), mass, values={"u.switch": 1.0})
        assert decision.keeps_plan
        assert decision.values == {"u.switch": 1.0}
        assert decision.health.improvement == 0.0


def test_a_plan_in_use_beyond_the_ranges_is_tried(mass):
    decision = decide(make(decision=[Parameter("u.switch", 2.0, 3.0)]), mass, values={"u.switch": 1.0})
    assert decision.keeps_plan
    assert decision.values == {"u.switch": 1.0}
    assert min(candidate.values["u.switch"] for candidate in decision.candidates[1:]) >= 2.0


def test_a_given_plan_is_tried_and_starts_the_method(mass):
    reasoner = make(method="predictive-sampling", options={"sigma": 0.01, "population": 4}, budget=Budget(rollouts=6))
    decision = decide(reasoner, mass, plan={"u.switch": 1.05})
    values = [candidate.values["u.switch"] for candidate in decision.candidates]
    assert values[:2] == [0.0, 1.05]
    assert all(abs(value - 1.05) < 0.2 for value in values[2:])


# -- budgets


@pytest.mark.parametrize(
    "method",
    ["CEM", *(pytest.param(name, marks=pytest.mark.slow) for name in ("predictive-sampling", "MPPI", "random"))],
)
def test_the_quality_never_falls_with_the_budget(method, mass):
    for seed in range(2):
        costs = [
            decide(make(method=method, budget=Budget(rollouts=budget), seed=seed), mass).quality
            for budget in (1, 2, 5, 12, 30)
        ]
        assert costs == sorted(costs, reverse=True)
        assert costs[-1] < costs[0]


@pytest.mark.parametrize("method", ["CEM", "MPPI", "random", "sobol", "CMA-ES"])
def test_a_budget_of_rollouts_is_spent_and_not_exceeded(method, mass):
    decision = decide(make(method=method, budget=Budget(rollouts=13)), mass)
    assert decision.health.rollouts == 13
    assert len({tuple(c.values.items()) for c in decision.candidates}) == 13
    assert decision.health.used == 1.0


def test_a_decision_is_a_function_of_state_and_seed(mass):
    def tried(**changes):
        return [c.values["u.switch"] for c in decide(make(budget=Budget(rollouts=8), **changes), mass).candidates]

    assert tried() == tried()
    assert tried() != tried(seed=1)


def test_decisions_at_other_times_try_other_candidates(mass):
    def tried(at):
        decision = decide(make(budget=Budget(rollouts=8), method="random"), mass, at=at)
        return [c.values["u.switch"] for c in decision.candidates[1:]]

    assert not set(tried(0.0)) & set(tried(0.02))


@pytest.mark.parametrize("name", ["threads", "processes"])
def test_all_executors_give_the_same_decision(name, executors, mass):
    serial, other = (
        decide(make(executor=executor, budget=Budget(rollouts=20)), mass, at=0.3)
        for executor in ("serial", executors[name])
    )
    assert other.values == serial.values
    assert other.quality == serial.quality
    assert [c.values for c in other.candidates] == [c.values for c in serial.candidates]
    assert all(a.rollouts[0].identical(b.rollouts[0]) for a, b in zip(other.candidates, serial.candidates, strict=True))


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", ["serial", "threads", pytest.param("processes", marks=pytest.mark.slow)])
def test_when_the_time_is_over_rollouts_under_way_are_cancelled(name, executors, mass):
    # A rollout of a million samples takes longer than any budget of the test.
    reasoner = make(horizon=1e4, sample_period=0.01, executor=executors[name], budget=Budget(seconds=0.05))
    decision = decide(reasoner, mass)
    assert not decision
    assert decision.end == "time"
    assert [candidate.status for candidate in decision.candidates] == ["unfinished"]
    assert "1 did not finish" in decision.message
    assert "the budget of 0.05 s is spent" in decision.message
    assert "not even of the plan in use" in decision.warnings[0]


HALF = {"u.switch": 0.5}


def test_a_budget_of_time_gives_the_best_so_far(mass):
    decision = decide(make(method="random", budget=Budget(seconds=0.2)), mass, values=HALF)
    finished = [c.quality for c in decision.candidates if c.status == "eligible"]
    assert decision.end == "time"
    assert decision.quality == min(finished)


def test_a_late_decision_is_poor(mass):
    # No computer is so fast.
    decision = decide(make(budget=Budget(seconds=1e-6)), mass)
    (late,) = [warning for warning in decision.warnings if "its budget is 1e-06 s" in warning]
    assert f"it took {decision.health.elapsed:.3g} s" in late


def test_of_two_budgets_the_one_that_ends_first_counts(mass):
    decision = decide(make(budget=Budget(rollouts=4, seconds=1e4)), mass)
    assert (decision.end, decision.health.rollouts) == ("rollouts", 4)


def test_a_decision_may_have_a_budget_of_its_own(mass):
    assert decide(make(), mass, budget=Budget(rollouts=4)).health.rollouts == 4
    with pytest.raises(ValueError, match="a budget is Budget"):
        decide(make(), mass, budget=4)


@pytest.mark.slow
def test_workers_that_die_or_hang_make_a_decision_poor(mass):
    scenario = MassScenario(treacherous=True)
    options = {"decision": [Choice("u.switch", [1.0, KILL, HANG])], "method": "grid", "executor": "processes"}
    with make(scenario, **options, workers=2, time_limit=3.0) as reasoner:
        reasoner.warm_up()
        belief = Belief.perfect(mass, mass.default_context())
        decision = reasoner.decide(belief)
        assert decision.values == {"u.switch": 1.0}
        assert decision.poor
        assert "2 of 4 rollouts failed" in decision.warnings[0]
        messages = {c.values["u.switch"]: c.rollouts[0].message for c in decision.candidates if c.status == "failed"}
        assert "its worker process died (exit code -9)" in messages[KILL]
        assert "longer than its time limit" in messages[HANG]
        # In the budget of time that is left for one that hangs, it is ended, too.
        decision = reasoner.decide(belief, budget=Budget(seconds=0.5))
        assert decision.end == "time"
        assert not any(c.status == "eligible" for c in decision.candidates if c.values["u.switch"] == HANG)
        assert reasoner.decide(belief, budget=Budget(rollouts=1))


# -- candidates that cannot win

HIGHEST = Quality(lambda state: abs(state[0]), of=STATE)


def test_pruning_with_a_bound_gives_the_same_choice_with_shorter_rollouts(mass):
    def highest(left, state):
        # With full force from now on.
        return abs(state[0]) + abs(state[1]) * left + left**2 / 2.0

    settings = {
        "quality": HIGHEST,
        "sample_period": 0.1,
        "method": "random",
        "decision": [Parameter("u.switch", 0, 1.5)],
    }
    whole, cut = (
        decide(make(**settings, pruning=pruning), mass) for pruning in (None, Pruning(bound=highest, of=STATE))
    )
    assert cut.values == whole.values
    assert cut.quality == whole.quality
    assert cut.health.cut_off > 3
    for a, b in zip(cut.candidates, whole.candidates, strict=True):
        if a.status == "cut off":
            assert b.quality <= a.quality <= cut.quality
            assert a.rollouts[0].times[-1] < 3.0
        else:
            assert a.rollouts[0].identical(b.rollouts[0])


@pytest.mark.parametrize("reading", ["integral", "worst"])
def test_costs_that_only_grow_are_pruned_without_a_bound(reading, mass):
    cost = Quality(lambda state: abs(state[0] - 0.25), of=STATE, minimize=True, reading=reading)
    settings = {"quality": cost, "sample_period": 0.1, "method": "grid", "options": {"points": 20}}
    whole, cut = (decide(make(**settings, pruning=pruning), mass) for pruning in (None, Pruning()))
    assert cut.values == whole.values
    assert cut.quality == whole.quality
    assert cut.health.cut_off > 3
    assert sum(len(c.rollouts[0].times) for c in cut.candidates) < sum(
        len(c.rollouts[0].times) for c in whole.candidates
    )


def test_a_violated_constraint_ends_a_rollout(mass):
    slow = Constraint(lambda state: state[1], of=STATE, at_most=0.5)
    decision = decide(make(constraints=[slow], sample_period=0.1, method="grid", pruning=Pruning()), mass)
    # 0.5 m/s is exceeded after 0.6 s at the latest.
    broken = [c for c in decision.candidates if c.status == "violates"]
    assert broken
    assert {c.rollouts[0].end for c in broken} == {"pruned"}
    assert max(c.rollouts[0].times[-1] for c in broken) == pytest.approx(0.6)
    assert decision.values["u.switch"] <= 0.6


def test_patience_ends_a_rollout_that_gains_nothing(mass):
    pruning = Pruning(patience=0.35, gain=1e-6)
    reasoner = make(quality=HIGHEST, sample_period=0.1, method="grid", options={"points": 4}, pruning=pruning)
    decision = decide(reasoner, mass, values={"u.switch": 0.5})
    # It comes to rest after 1 s, a period late.
    first = decision.candidates[0].rollouts[0]
    assert first.end == "stalled"
    assert first.times[-1] == pytest.approx(1.4, abs=0.11)
    assert decision.candidates[0].status == "eligible"
    assert decision.candidates[0].quality == pytest.approx(0.25, abs=1e-6)


def test_pruning_gives_the_same_decision_in_processes(executors, mass):
    settings = {"quality": HIGHEST, "sample_period": 0.1, "pruning": Pruning(bound=lambda left: 4.5, patience=1.0)}
    serial, other = (decide(make(**settings, executor=executors[name]), mass) for name in ("serial", "processes"))
    assert [c.rollouts[0].end for c in serial.candidates] == [c.rollouts[0].end for c in other.candidates]
    assert serial.values == other.values


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"patience": 0.0}, "patience is a time in seconds, above 0"),
        ({"gain": -1.0}, "gain is at least 0"),
        ({"of": STATE}, "but no bound"),
        ({"bound": 3.0}, "the bound of a pruning is a function of the remaining time, not 3.0"),
    ],
)
def test_a_senseless_pruning_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Pruning(**options)


def test_patience_with_a_quality_at_the_end_is_refused():
    with pytest.raises(ValueError, match="patience waits for a gain of the best so far"):
        make(pruning=Pruning(patience=1.0))


def test_a_bound_that_fails_fails_its_rollouts(mass):
    decision = decide(make(pruning=Pruning(bound=lambda left: float("nan")), budget=Budget(rollouts=2)), mass)
    assert not decision
    assert "the bound of a pruning is NaN" in decision.message


# -- beliefs


def test_a_running_testbed_and_its_dps_alone_give_the_same_decision(mass):
    context = mass.default_context()
    mass.write(context, {"u.switch": 3.0})
    simulator = mass.simulator(context)
    simulator.AdvanceTo(1.0)
    alone = DpsAlone(MassScenario())
    with make(method="grid", options={"points": 25}) as reasoner:
        decision = reasoner.decide(mass, context)
        # The estimate is a period old: 0.49 m, 0.99 m/s.
        assert decision.values["u.switch"] == pytest.approx(1.0, abs=0.13)
        own = alone.continue_from(mass, context)
        alone.diagram.GetInputPort("real.sense.state").FixValue(own, mass.read(context, STATE))
        other = reasoner.decide(alone, own)
    assert other.values == decision.values
    assert [c.quality for c in other.candidates] == [c.quality for c in decision.candidates]


def test_uncertain_beliefs_are_judged_by_the_risk(mass):
    belief = Belief.of(mass, mass.default_context())

    def qualities(risk):
        settings = {"samples": 3, "uncertainty": {"sim.sys.mass.discrete_state_0": [0.1, 0.0]}, "risk": risk}
        with make(**settings, decision=[Choice("u.switch", [0.5, 1.0])], method="grid") as reasoner:
            return reasoner.decide(belief)

    worst, mean = qualities("worst"), qualities("mean")
    for candidate in worst.candidates:
        # It comes to rest as far from where it was drawn as without uncertainty.
        values = [rollout.value for rollout in candidate.rollouts]
        assert len(set(values)) == 3
        assert candidate.quality == max(values)
    assert [c.quality for c in mean.candidates] == [
        pytest.approx(np.mean([rollout.value for rollout in c.rollouts])) for c in worst.candidates
    ]
    assert worst.health.rollouts == 9
    assert worst.health.spread > 0.0


def test_a_wrong_belief_costs_and_its_spread_warns_of_it(mass):
    context = mass.default_context()
    mass.write(context, {"dps.estimate": [0.36, 0.0]})  # It is at 0.
    with make(method="grid", options={"points": 31}, budget=Budget(rollouts=32)) as reasoner:
        decision = reasoner.decide(mass, context)
    # From 0.36 m it has 0.8^2 m to go.
    assert decision.values["u.switch"] == pytest.approx(0.8)
    assert decision.quality == pytest.approx(0.0, abs=1e-9)
    uncertainty = {"sim.sys.mass.discrete_state_0": [0.36, 0.0]}
    settings = {"method": "grid", "options": {"points": 7}, "budget": Budget(rollouts=8 * 4)}
    with make(**settings, samples=4, uncertainty=uncertainty) as reasoner:
        assert reasoner.decide(mass, context).health.spread > 0.05
    decision.apply(mass, context)
    simulator = mass.simulator(context)
    simulator.AdvanceTo(3.0)
    assert distance(mass.read(context, STATE)) == pytest.approx(0.36, abs=1e-9)


def test_without_a_context_there_is_no_decision(mass):
    with make() as reasoner, pytest.raises(ValueError, match=r"decide\(testbed, context\)"):
        reasoner.decide(mass)


# -- eligible or not


def test_a_candidate_that_violates_a_constraint_is_not_chosen(mass):
    slow = Constraint(lambda state: state[1], of=STATE, at_most=0.5)
    decision = decide(make(constraints=[slow], sample_period=0.05), mass)
    # At 1 m/s^2, 0.5 m/s is reached after 0.5 s.
    assert decision.values["u.switch"] == pytest.approx(0.5, abs=0.03)
    assert decision.values["u.switch"] <= 0.51
    assert {c.status for c in decision.candidates} == {"eligible", "violates"}


def test_without_an_eligible_candidate_the_decision_is_false_and_says_why(mass):
    impossible = Constraint(lambda state: state[0], of=STATE, at_least=9.0)
    decision = decide(make(constraints=[impossible], budget=Budget(rollouts=5)), mass)
    assert not decision
    assert decision.values == {}
    assert decision.chosen is None
    assert "5 violated a constraint" in decision.message
    context = mass.default_context()
    with pytest.raises(ValueError, match="there is no decision to apply .*5 violated"):
        decision.apply(mass, context)


def test_a_quality_that_fails_fails_its_candidates_only(mass):
    def picky(state):
        assert state[0] < 1.0, "too far"
        return state[0]

    quality = Quality(picky, of=STATE, reading="end")
    decision = decide(make(quality=quality, sample_period=0.05, method="grid"), mass)
    assert 0.5 < decision.quality < 1.0
    assert decision.poor
    assert "rollouts failed, the first: QualityError: " in decision.warnings[0]
    assert decision.health.failed == sum(c.status == "failed" for c in decision.candidates) > 0


def test_an_integral_that_overflows_fails_its_rollout(mass):
    quality = Quality(lambda state: 1e308, of=STATE, reading="integral", minimize=True)
    decision = decide(make(quality=quality, budget=Budget(rollouts=3)), mass)
    assert not decision
    assert decision.health.failed == 3
    assert "the integral of f over 3 s is too large for a number; the largest sample is 1e+308" in decision.warnings[0]


def test_if_all_rollouts_fail_there_is_no_decision(mass):
    decision = decide(make(quality=Quality(lambda state: -1.0, of=STATE), budget=Budget(rollouts=3)), mass)
    assert not decision
    assert "3 failed; the first failure: QualityError" in decision.message


def test_a_mental_world_that_diverges_is_no_good_score():
    class Diverging(MassScenario):
        def mental(self):
            return MassScenario(mass=1e-310)

    reasoner = make(Diverging(), quality=Quality(lambda state: abs(state[0]), of=STATE), budget=Budget(rollouts=4))
    decision = decide(reasoner, MassScenario().build(), values={"u.switch": 1.0})
    assert not decision
    assert "4 failed" in decision.message


# -- health and display


def test_health_tells_improvement_margin_and_time(mass):
    decision = decide(make(decision=[Choice("u.switch", [0.5, 1.0])], method="grid"), mass)
    # They rest at 0, 0.25 and 1 m.
    assert decision.health.improvement == pytest.approx(1.0)
    assert decision.health.margin == pytest.approx(0.75)
    assert decision.health.rollouts == 3
    assert decision.health.used == pytest.approx(0.1)
    assert 0.0 < decision.health.rollout_time * 3 <= decision.health.elapsed


def test_a_candidate_that_there_is_not_has_no_motion(mass):
    reasoner = make(budget=Budget(rollouts=2))
    with pytest.raises(ValueError, match="the candidates 0 to 1, and no 2"):
        reasoner.motion(decide(reasoner, mass), 2)


def test_a_world_without_a_plant_has_no_motion(mass):
    reasoner = make(budget=Budget(rollouts=2))
    decision = decide(reasoner, mass)
    with pytest.raises(ValueError, match="MassScenario has no MultibodyPlant; plot the quality"):
        reasoner.motion(decision, 1)


def test_a_quality_that_ignores_the_decision_is_reported(mass):
    decision = decide(make(horizon=0.01, sample_period=0.01, budget=Budget(rollouts=6)), mass)
    assert decision.keeps_plan
    assert any("all 6 eligible candidates are equally good" in warning for warning in decision.warnings)


@pytest.mark.parametrize(("track", "is_reported"), [(-1.0, True), (0.01, True), (0.5, False), (5.0, False)])
def test_a_start_from_which_every_rollout_ends_at_once_is_reported(track, is_reported):
    """The mass is past 1 cm after 0.14 s, and past 0.5 m after 1 s at the earliest, a third of the horizon."""
    scenario = FencedMassScenario(track=track)
    reasoner = make(scenario, decision=[Parameter("u.switch", 0.5, 1.5)])
    decision = decide(reasoner, scenario.build(), values={"u.switch": 1.0})
    assert decision.poor == is_reported
    if is_reported:
        assert "all 30 rollouts were ended within" in decision.warnings[0]
        assert "the mass has left its track" in decision.warnings[0]


def test_a_budget_for_the_plan_in_use_alone_is_reported(mass):
    decision = decide(make(budget=Budget(rollouts=1)), mass)
    assert decision.keeps_plan
    assert decision.end == "rollouts"
    assert any("nothing but the plan in use was tried" in warning for warning in decision.warnings)


def test_a_decision_is_applied_and_carried_out(mass):
    decision = decide(make(), mass)
    context = mass.default_context()
    decision.apply(mass, context)
    simulator = mass.simulator(context)
    simulator.AdvanceTo(3.0)
    assert distance(mass.read(context, STATE)) == decision.quality


def test_a_decision_shows_itself(mass):
    decision = decide(make(decision=[Choice("u.switch", [0.5, 1.0])], method="grid"), mass)
    assert repr(decision).startswith("Decision(u.switch = 1: distance = ")
    lines = str(decision).split("\n")
    assert [line.split()[0] for line in lines[1:5]] == ["candidate", "2*", "1", "0"]
    html = decision._repr_html_()
    assert "<img" in html
    assert "margin to the second best" in html
    assert len(decision.plot().axes[0].lines) >= 3


# -- what is refused


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "a budget is given as"),
        ({"rollouts": 0}, "at least one rollout, not 0"),
        ({"rollouts": 1.5}, "whole number, not 1.5"),
        ({"rollouts": "many"}, "must be a number, not 'many'"),
        ({"seconds": 0.0}, "positive and finite, not 0.0 s"),
        ({"seconds": -1.0}, "positive and finite"),
        ({"seconds": float("nan")}, "positive and finite"),
        ({"seconds": float("inf")}, "positive and finite"),
    ],
)
def test_a_senseless_budget_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Budget(**arguments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"budget": 70}, "a budget is Budget.*not 70"),
        ({"scenario": "MassScenario"}, "the scenario of the running testbed, .*not 'MassScenario'"),
        ({"samples": 0}, "at least one sample, not 0"),
        (
            {"samples": 8, "uncertainty": {"sim.sys.mass.discrete_state_0": 0.1}, "budget": Budget(rollouts=7)},
            "7 rollouts does not suffice for one candidate, which takes 8",
        ),
        ({"uncertainty": {"sim.sys.mass.discrete_state_0": 0.1}}, "samples=1 with .*one is a world by chance"),
        ({"samples": 2}, "samples=2 with uncertainty=None.*of a certain one all are the same"),
        ({"decision": []}, "a reasoner decides something"),
        ({"decision": SWITCH}, "give decision as"),
        ({"decision": [Parameter("sim.sys.mass.discrete_state_0[0]", 0.0, 1.0)]}, "is neither"),
        ({"decision": [Parameter("scenario.mass", 0.5, 1.0)]}, "is neither"),
        ({"decision": [Parameter("u.swich", 0.0, 1.0)]}, "u.swich.*u.switch"),
        ({"decision": [Parameter("u.switch", -1.0, 1.0)]}, "exceeds its bounds"),
        ({"decision": [SWITCH, SWITCH]}, "given twice"),
        ({"quality": [MISS, MISS]}, "a decision has one quality"),
        ({"quality": Quality(abs, of="sim.nothing")}, "sim.nothing"),
        ({"search": {"method": "CEM"}}, r"configured by a SearchConfig\(...\), not by {'method': 'CEM'}"),
        ({"belief": 8}, r"configured by a BeliefConfig\(...\), not by 8"),
        ({"method": "simulated annealing"}, "there is no solver 'simulated annealing'"),
        ({"method": "CEM", "options": {"popsize": 3}}, "CEM has no option 'popsize'"),
        ({"method": "CEM", "decision": [Choice("u.switch", [0.5, 1.0])]}, "CEM varies numbers"),
        (
            {"method": "grid", "options": {"points": 50}},
            "budget is 29 .*: of the 30 rollouts, the plan in use takes 1 rollout$",
        ),
        (
            {"method": "grid", "budget": Budget(rollouts=2)},
            "at least two values .*: of the 2 rollouts, the plan in use takes 1 rollout$",
        ),
        ({"horizon": -1.0}, "horizon t_m must be positive"),
        ({"executor": "gpu"}, "an executor is one of"),
    ],
)
def test_a_reasoner_that_cannot_work_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make(**changes)


def test_a_mental_scenario_with_other_commands_is_refused():
    class Strange(MassScenario):
        def mental(self):
            return SwingUpScenario()

    class Stranger(SwingUpScenario):
        def interface(self):
            return super().interface().__class__(super().interface().sense, super().interface().act)

    Strange.mental = lambda self: Stranger()
    with pytest.raises(ValueError, match=r"Stranger has other commands than Strange \(switch\)"):
        make(Strange())


def test_a_mental_scenario_that_is_none_is_refused():
    class Thoughtless(MassScenario):
        def mental(self):
            return None

    with pytest.raises(ValueError, match=r"Thoughtless.mental\(\) returns a Scenario, not None"):
        make(Thoughtless())


def test_a_fresh_belief_is_not_too_old(mass):
    with make(max_age=0.1, budget=Budget(rollouts=1)) as reasoner:
        context = mass.default_context()
        assert reasoner.decide(mass, context)
        with pytest.raises(ValueError, match="give now="):
            reasoner.decide(Belief.of(mass, context))


def test_a_plan_that_cannot_be_decided_is_refused(mass):
    with pytest.raises(ValueError, match="u.switch = 9 lies outside its range"):
        decide(make(), mass, plan={"u.switch": 9.0})
    with pytest.raises(ValueError, match="wrong about u.other"):
        decide(make(), mass, plan={"u.switch": 1.0, "u.other": 1.0})


@pytest.mark.parametrize("executor", ["serial", "threads"])
def test_a_start_of_another_testbed_is_a_belief_error(mass, executor):
    other = PendulumScenario().build()
    start = Start.of(mass, mass.default_context())
    with make(executor=executor) as reasoner:
        with pytest.raises(BeliefError, match=r"no rollout can begin from Start.*of another testbed"):
            reasoner.decide(Start.of(other, other.default_context()))
        with pytest.raises(BeliefError, match=r"no rollout can begin from Start.*u\.other"):
            reasoner.decide(replace(start, values={**start.values, "u.other": 1.0}))
        assert reasoner.decide(start)


def test_a_second_decision_at_the_same_time_is_refused(mass):
    begun, go_on, refused = threading.Event(), threading.Event(), []

    def slow(state):
        begun.set()
        go_on.wait()
        return distance(state)

    reasoner = make(quality=Quality(slow, of=STATE, minimize=True, reading="end"), budget=Budget(rollouts=3))
    context = mass.default_context()

    def ask():
        begun.wait()
        try:
            reasoner.decide(Belief.perfect(mass, context))
        except ReasonerError as error:
            refused.append(str(error))
        finally:
            go_on.set()

    thread = threading.Thread(target=ask)
    thread.start()
    with reasoner:
        decision = reasoner.decide(Belief.perfect(mass, context))
        thread.join()
        assert decision
        assert "a decision is under way in another thread" in refused[0]
        assert reasoner.decide(Belief.perfect(mass, context)).values == decision.values


@pytest.mark.slow
def test_a_closed_reasoner_decides_nothing(mass):
    reasoner = make()
    reasoner.close()
    reasoner.close()
    with pytest.raises(ReasonerError, match="the reasoner is closed"):
        reasoner.decide(mass, mass.default_context())
