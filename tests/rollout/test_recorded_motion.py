"""Rollouts along a recorded motion give what whole rollouts give, or are refused."""

from dataclasses import replace

import numpy as np
import pytest

from tests.rollout.watched import WatchedScenario
from vtbdrake.optimization import Parameter, Problem
from vtbdrake.rollout import MotionError, ProcessExecutor, Quality, RecordedMotion, RolloutRunner, RolloutTask

PLACE = "sim.sense.sight.place"
SEEN = "dps.detector.close"
# The sensor's period and its latency of one period, the rest of a detector's period, and its latency.
MEMORY = 0.1 + 0.1 + 0.05 + 0.03
START = {"sim.sys.Acrobot.shoulder.position": 1.0}


def seen(close):
    return close


def make(scenario=None, **changes):
    settings = {"quality": Quality(seen, of=[SEEN]), "horizon": 5.0, "sample_period": 1.0, "record": [SEEN]}
    return RolloutTask(scenario or WatchedScenario(), **{**settings, **changes})


def along(task, memory=MEMORY, varied=(PLACE,)):
    return replace(task, motion=RecordedMotion(memory, varied=varied))


@pytest.mark.parametrize("reading", ["best", pytest.param("integral", marks=pytest.mark.slow)])
def test_the_result_is_that_of_the_whole_rollout(reading):
    task = make(quality=Quality(seen, of=[SEEN], reading=reading), keep_state=True)
    whole = RolloutRunner(task)
    player = RolloutRunner(along(task), whole.testbed)
    for place, start in (([0.0, 0.0, -2.0], START), ([1.0, 0.5, 1.0], START), ([1.0, 0.5, 1.0], {})):
        point = {PLACE: place, **start}
        assert player.run(point).identical(whole.run(point))


def test_a_threshold_ends_it_at_the_same_sample():
    point = {PLACE: [0.0, 0.0, -2.0], **START}
    task = make()
    task = replace(task, threshold=float(np.sort(RolloutRunner(task).run(point).quality)[-2]))
    whole, found = (RolloutRunner(t).run(point) for t in (task, along(task)))
    assert found.identical(whole)
    assert found.end == "threshold"


def test_only_what_is_read_is_measured():
    task = along(make(horizon=12.0, sample_period=1.2))
    runner = RolloutRunner(task)
    sight = runner.testbed.simulated_sensors["sight"]
    runner.run({PLACE: [0.0, 0.0, 0.0]})
    before = sight.measured
    runner.run({PLACE: [0.0, 0.0, 1.0]})
    # In a window of 0.28 s before each of ten samples, and not 120 times.
    assert 10 * 2 <= sight.measured - before <= 10 * 3


def test_a_motion_is_recorded_once_for_all_tasks():
    task = along(make(horizon=12.0, sample_period=1.2))
    first = RolloutRunner(task)
    sight = first.testbed.simulated_sensors["sight"]
    first.run({PLACE: [0.0, 0.0, 0.0]})
    recorded = sight.measured
    other = RolloutRunner(replace(task, record=()), first.testbed)
    other.run({PLACE: [0.0, 0.0, 1.0], "sim.sense.sight.noise": 0.02})
    assert sight.measured - recorded < 40
    first.run({PLACE: [0.0, 0.0, 0.0], **START})
    assert sight.measured - recorded > 120


def test_followers_may_have_other_parameters_while_the_motion_is_recorded():
    task = along(make(horizon=3.0))
    spared = replace(task, motion=replace(task.motion, while_recording={"sim.sense.sight.noise": 9.0}))
    point = {PLACE: [1.0, 0.5, 1.0], **START}
    first = RolloutRunner(task)
    assert RolloutRunner(spared, first.testbed).run(point).identical(first.run(point))


def test_what_the_motion_depends_on_has_no_other_value_while_it_is_recorded():
    task = along(make(horizon=3.0))
    motion = replace(task.motion, while_recording={"sim.sys.Acrobot.shoulder.damping": 1.0})
    with pytest.raises(MotionError, match="shoulder.damping is no parameter of a follower"):
        RolloutRunner(replace(task, motion=motion))


def test_samples_closer_than_the_memory_are_simulated_as_a_whole():
    task = make(horizon=1.0, sample_period=0.05)
    point = {PLACE: [0.3, 0.0, 0.0], **START}
    assert RolloutRunner(along(task)).run(point).identical(RolloutRunner(task).run(point))


@pytest.mark.slow
def test_workers_give_the_same():
    task = make()
    points = [{PLACE: [x, 0.0, 0.0], **START} for x in (0.0, 0.5, 1.0)]
    with ProcessExecutor(1) as executor:
        found = dict(executor.run(along(task), points))
    whole = RolloutRunner(task)
    assert all(found[index].identical(whole.run(point)) for index, point in enumerate(points))


def test_a_motion_that_depends_is_refused_with_its_way():
    with pytest.raises(MotionError, match=r"sim.sense.sight -> .* -> dps.detector -> dps.gain -> dps.torque -> T_act"):
        RolloutRunner(along(make(WatchedScenario(steered=True))))


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        ("sim.sys.Acrobot.lower_link.mass", "belongs to the plant"),
        ("dps.feedback.gain", "by way of dps.feedback"),
        ("dps.memory.total", "is a dynamic state"),
    ],
)
def test_what_moves_or_is_forgotten_is_refused(address, reason):
    with pytest.raises(MotionError, match=reason):
        RolloutRunner(along(make(), varied=[address]))


@pytest.mark.parametrize("scenario", [WatchedScenario(time_step=0.0), WatchedScenario(filtered=True)])
def test_continuous_state_is_refused(scenario):
    with pytest.raises(MotionError, match="without continuous state"):
        RolloutRunner(along(make(scenario)))


def test_a_hidden_way_is_found_while_it_runs():
    runner = RolloutRunner(along(make(WatchedScenario(leaky=True))))
    with pytest.raises(MotionError, match="no connection leads there"):
        runner.run({PLACE: [1.0, 0.0, 0.0]})


@pytest.mark.parametrize("memory", [0.0, -1.0, np.inf, np.nan])
def test_memory_is_a_time(memory):
    with pytest.raises(ValueError, match="positive, finite time"):
        RecordedMotion(memory)


def problem(**changes):
    settings = {
        "scenario": WatchedScenario(),
        "parameters": [Parameter(f"{PLACE}[0]", -1.0, 1.0), Parameter(f"{PLACE}[2]", -2.0, 2.0)],
        "quality": Quality(seen, of=[SEEN], reading="integral"),
        "horizon": 4.0,
        "sample_period": 1.0,
        "conditions": [{}, START],
        "risk": "mean",
    }
    return Problem(**{**settings, **changes})


@pytest.mark.slow
def test_a_study_finds_the_same_optimum():
    motion = RecordedMotion(MEMORY)
    bests = [
        problem(motion=m).study(solver="cmaes").run(rollouts=24, executor="serial", progress=False)
        for m in (motion, None)
    ]
    assert bests[0].best.point == bests[1].best.point
    assert bests[0].best.value == bests[1].best.value


@pytest.mark.slow
def test_the_check_finds_a_short_memory():
    assert not [
        f for f in problem(motion=RecordedMotion(MEMORY)).check_repeatability().findings if "longer memory" in f
    ]
    assert [f for f in problem(motion=RecordedMotion(0.02)).check_repeatability().findings if "longer memory" in f]


@pytest.mark.slow
def test_the_check_finds_a_filter_that_never_forgets():
    quality = Quality(seen, of=["dps.memory.total"])
    findings = problem(quality=quality, motion=RecordedMotion(MEMORY)).check_repeatability().findings
    assert [f for f in findings if "a longer memory than memory=" in f]


def test_a_field_of_the_scenario_is_refused():
    with pytest.raises(MotionError, match="scenario.period takes another testbed"):
        problem(parameters=[Parameter("scenario.period", 0.01, 0.1)], motion=RecordedMotion(MEMORY))
