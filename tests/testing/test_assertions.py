"""Assertions pass where they should, and name the first offending time and address, with a plot."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.control.scripted import PERIOD, ScriptedBridge, ServoScenario
from tests.testbeds import AcrobotScenario, PendulumScenario
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.statistics import Histogram, LoopStatistics
from vtbdrake.deployment import Deployment
from vtbdrake.machine import MachineStatistics
from vtbdrake.recording.log_reader import read_log
from vtbdrake.recording.recorder import Recorder
from vtbdrake.rollout import RolloutRunner, RolloutTask
from vtbdrake.testbed import DpsAlone
from vtbdrake.testing.assertions import (
    assert_bounded,
    assert_continuous_at_switch,
    assert_cycle_budget,
    assert_energy_never_rises,
    assert_replays,
    assert_same_motion,
    assert_settles,
    assert_succeeds,
)
from vtbdrake.testing.failure import failures_in
from vtbdrake.testing.trace import ENERGY, Trace, TraceError, simulate

pytestmark = pytest.mark.one_python

ANGLE = "plant.state"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path) -> Iterator[Path]:
    with failures_in(tmp_path / "failures"):
        yield tmp_path / "failures"


def failure(call: Callable[[], None], *, plot: bool = True) -> str:
    """The message of a failed assertion, whose plot exists."""
    with pytest.raises(AssertionError) as raised:
        call()
    text = str(raised.value)
    if plot:
        [path] = re.findall(r"^plot: (.*)$", text, re.MULTILINE)
        assert Path(path).read_bytes()[:4] == b"\x89PNG"
    return text


def ramp(*, until: float = 1.0, count: int = 101) -> Trace:
    """x = t and y = (t, -2 t), in m."""
    times = np.linspace(0.0, until, count)
    return Trace(times, {"x": times, "y": np.stack([times, -2.0 * times], axis=1)}, {"x": "m"})


# -- bounded


def test_bounds_are_inclusive() -> None:
    assert_bounded(ramp(), "x", lower=0.0, upper=1.0)


def test_first_time_out_of_bounds_is_named() -> None:
    text = failure(lambda: assert_bounded(ramp(), "x", upper=0.55))
    assert "x leaves its bounds at t = 0.56 s: 0.56 m instead of at most 0.55" in text


def test_entry_out_of_its_own_bounds_is_named() -> None:
    text = failure(lambda: assert_bounded(ramp(), "y", lower=[-1.0, -1.0]))
    assert "y[1] leaves its bounds at t = 0.51 s: -1.02 instead of at least -1" in text


def test_nan_is_out_of_bounds() -> None:
    values = np.array([0.0, np.nan])
    text = failure(lambda: assert_bounded(Trace(np.array([0.0, 1.0]), {"x": values}), "x", upper=1.0))
    assert "at t = 1 s: nan instead of a number" in text


def test_assertion_without_content_is_an_error() -> None:
    with pytest.raises(ValueError, match="give lower= or upper="):
        assert_bounded(ramp(), "x")
    with pytest.raises(TraceError, match="x has no value 2 s after the first sample, or later"):
        assert_bounded(ramp(), "x", upper=1.0, after=2.0)
    with pytest.raises(TraceError, match="z has not been recorded"):
        assert_bounded(ramp(), "z", upper=1.0)


@pytest.mark.parametrize("wrong", [np.zeros(3), np.zeros((1, 2)), np.zeros(101), "0.5", [[0.0], [0.0, 1.0]]])
def test_a_bound_of_another_shape_is_refused(wrong: Any) -> None:
    trace = ramp()
    assert trace["x"].shape == (101,) and trace["y"].shape == (101, 2)
    for name, check in {
        "lower of y": partial(assert_bounded, trace, "y", lower=wrong),
        "upper of x": partial(assert_bounded, trace, "x", upper=wrong),
        "to of y": partial(assert_settles, trace, "y", to=wrong, within=0.0, tolerance=1.0),
        "tolerance of y": partial(assert_settles, trace, "y", to=0.0, within=0.0, tolerance=wrong),
    }.items():
        with pytest.raises(ValueError, match=rf"{name} (has the shape .* is expected|must be a number or several)"):
            check()
    with pytest.raises(ValueError, match="tolerance of y (has the shape|must be a number)"):
        assert_same_motion(trace, trace, "y", tolerance={"y": wrong})


# -- settles


def test_value_that_comes_back_has_settled_later() -> None:
    times = np.arange(0.0, 10.0, 0.01)
    trace = Trace(times, {"x": 1.0 + np.exp(-times) * np.cos(5.0 * times)})
    # The envelope is below 0.01 from log(100) = 4.6 s on; the last crossing lies within a half period before.
    assert_settles(trace, "x", to=1.0, within=4.61, tolerance=0.01)
    text = failure(lambda: assert_settles(trace, "x", to=1.0, within=3.0, tolerance=0.01))
    assert "x has not settled at t = 3 s: 0.962" in text and "1 +- 0.01 from 3 s on" in text


def test_value_that_leaves_again_has_not_settled() -> None:
    trace = Trace(np.arange(5.0), {"x": np.array([0.0, 1.0, 1.0, 1.0, 2.0])})
    assert "at t = 4 s: 2 instead of 1" in failure(
        lambda: assert_settles(trace, "x", to=1.0, within=1.0, tolerance=0.1)
    )


# -- energy


def test_energy_of_a_free_pendulum_stays_and_of_a_damped_one_falls() -> None:
    start = {"sim.sys.Pendulum.theta.position": 1.0, "sim.sys.Pendulum.theta.damping": 0.0}
    free = simulate(PendulumScenario().build(), 2.0, record=ENERGY, values=start)
    assert_energy_never_rises(free, tolerance=1e-3)
    energy = free[ENERGY]
    assert np.ptp(energy) < 1e-3 < np.abs(energy).max()
    damped = simulate(PendulumScenario(damping=0.5).build(), 2.0, record=ENERGY, values=start)
    assert_energy_never_rises(damped)
    assert damped[ENERGY][-1] < energy[-1] - 0.5


def test_driven_pendulum_gains_energy() -> None:
    start = {"sim.sys.Pendulum.theta.position": 1.0}
    trace = simulate(PendulumScenario(damping=-0.5).build(), 1.0, record=ENERGY, values=start)
    text = failure(lambda: assert_energy_never_rises(trace, tolerance=1e-6))
    first = np.flatnonzero(np.diff(trace[ENERGY]) > 1e-6)[0] + 1
    assert f"at t = {trace.times[first]:g} s" in text


# -- sources


def test_rollouts_are_traces() -> None:
    task = RolloutTask(AcrobotScenario(), horizon=1.0, sample_period=0.1, record=[ANGLE])
    rollout = RolloutRunner(task).run({})
    assert_bounded(rollout, ANGLE, lower=-1.0, upper=1.0)
    testbed = AcrobotScenario().build()
    assert_same_motion(simulate(testbed, 1.0, record=ANGLE, sample_period=0.1), rollout, ANGLE)
    with pytest.raises(AssertionError, match="the rollout failed: it fell"):
        assert_bounded(replace(rollout, end="failed", message="it fell"), ANGLE, upper=1.0)


def test_simulation_continues_in_its_context() -> None:
    testbed = AcrobotScenario(time_step=0.001).build()
    start = {"sim.sys.Acrobot.shoulder.position": 0.5}
    record = [ANGLE, "sense.joint_state", "act.torque", "dps.ticks"]
    whole = simulate(testbed, 1.0, record=record, values=start)
    context = testbed.default_context()
    simulate(testbed, 0.4, record=record, values=start, context=context)
    rest = simulate(testbed, 0.6, record=record, context=context)
    assert rest.times == pytest.approx(whole.times[40:])
    for address in record:
        np.testing.assert_array_equal(rest[address], whole[address][40:])
    assert whole.units["act.torque"] == "N m"
    assert whole["act.torque"].shape == (101, 1)


# -- same motion


def test_same_motion_is_exact_by_default() -> None:
    other = ramp()
    other.values["y"][70, 1] = np.nextafter(other.values["y"][70, 1], 0.0)
    assert_same_motion(ramp(), other, "x")
    text = failure(lambda: assert_same_motion(ramp(), other, ["x", "y"]))
    assert "y[1] differs first at t = 0.7 s" in text
    assert_same_motion(ramp(), other, ["x", "y"], tolerance=1e-12)
    assert_same_motion(ramp(), other, ["x", "y"], tolerance={"y": [0.0, 1e-12]})


def test_shorter_motion_is_not_the_same() -> None:
    short = Trace(ramp().times[:50], {"x": ramp()["x"][:50]})
    assert "one ends at t = 0.49 s" in failure(lambda: assert_same_motion(short, ramp(), "x"), plot=False)
    with pytest.raises(TraceError, match="other sample times"):
        assert_same_motion(ramp(), ramp(until=2.0), "x")


# -- succeeds


def test_rate_is_the_lower_limit_of_clopper_and_pearson() -> None:
    """The limit p solves P(X >= k) = 0.05; for k = n it is 0.05^(1/n)."""
    assert 0.05 ** (1 / 29) > 0.9 > 0.05 ** (1 / 28)
    assert_succeeds([True] * 29, rate=0.9)
    with pytest.raises(ValueError, match="28 trials cannot show a rate of 0.9 .* 29 are needed"):
        assert_succeeds([True] * 28, rate=0.9)
    text = failure(lambda: assert_succeeds([True] * 40 + [False], rate=0.9), plot=False)
    assert "40 of 41 trials succeed" in text and "1 fail, such as number 40" in text
    # P(X >= 45 | n = 46, p) = 46 p^45 - 45 p^46.
    p = 0.9
    assert 46 * p**45 - 45 * p**46 < 0.05
    assert_succeeds([True] * 45 + [False], rate=p)


def test_trials_fail_by_their_assertions() -> None:
    def trial(seed: int) -> None:
        assert seed % 10 != 7, f"seed {seed} tips over"

    text = failure(lambda: assert_succeeds(trial, rate=0.9), plot=False)
    assert "52 of 58 trials succeed" in text and "number 7: AssertionError: seed 7 tips over" in text
    assert_succeeds(trial, rate=0.8, count=200)


@pytest.mark.parametrize("false", [False, np.False_, np.array(False), 0])
def test_trials_fail_by_what_is_false(false: object) -> None:
    for trials in (lambda seed: false, [false] * 58):
        assert "0 of 58 trials succeed" in failure(partial(assert_succeeds, trials, rate=0.9), plot=False)


@pytest.mark.parametrize("outcome", ["failed", 0.0, np.nan, np.array([True, False]), 2])
def test_an_outcome_that_is_neither_true_nor_false_is_refused(outcome: object) -> None:
    for trials in (lambda seed: outcome, [outcome] * 58):
        with pytest.raises(ValueError, match="the outcome of a trial is True or False, not"):
            assert_succeeds(trials, rate=0.9)


# -- budget


def test_budget_is_a_share_of_the_period() -> None:
    statistics, slower = LoopStatistics(1e-3), LoopStatistics(1e-3)
    for k in range(1000):
        statistics.record(lateness=0.0, step=1e-4, cycle=2e-4 if k < 985 else 9e-4)
        slower.record(lateness=0.0, step=1e-4, cycle=4e-4)
    assert_cycle_budget(statistics, at_most=0.21, percentile=95.0)
    text = failure(lambda: assert_cycle_budget(statistics, at_most=0.5), plot=False)
    assert "99 % of the loop's 1000 cycles have a cycle of up to 90" in text and "0.5 times is allowed" in text
    assert_cycle_budget(slower, at_most=2.1, percentile=50.0, against=statistics)
    with pytest.raises(AssertionError, match="times the other loop's"):
        assert_cycle_budget(slower, at_most=1.9, percentile=50.0, against=statistics)
    assert_cycle_budget(MachineStatistics(statistics, Histogram(), 0.0), at_most=0.21, percentile=95.0)
    with pytest.raises(ValueError, match="has run no cycle"):
        assert_cycle_budget(LoopStatistics(1e-3), at_most=1.0)


# -- logs


class ContinuousServo(ServoScenario):
    """The velocity that is commanded departs from the measured speed."""

    def deployment(self) -> Deployment:
        return Deployment(continuity={"velocity": ("speed", 0.1)})


@pytest.fixture(scope="module")
def recorded_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of two axes that are switched to real in cycle 10, and stand still until then."""
    scenario, clock, path = ContinuousServo(), SimulatedClock(), tmp_path_factory.mktemp("log") / "servo.lcm"

    def sensors(t: float) -> dict[str, Any]:
        return {"position": [0.0, 0.0], "speed": [0.0, 0.0]}

    bridge = ScriptedBridge(scenario.interface(), clock, sensors)
    runtime = scenario.deployment().runtime(DpsAlone(scenario), bridge, clock=clock)
    with runtime, Recorder(runtime, path) as recorder:
        recorder.wait_until_ready()
        runtime.run(cycles=10)
        runtime.switch("real")
        runtime.write({"u.target": [0.01, 0.0]})
        runtime.run(cycles=30)
    return path


@pytest.fixture
def log(recorded_log: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(recorded_log, tmp_path))


def test_log_is_a_trace(log: Path) -> None:
    assert_bounded(log, "sense.position", lower=0.0, upper=0.0)
    assert_settles(read_log(log), "sent.velocity", to=[0.05, 0.0], within=29 * PERIOD, tolerance=1e-12)
    text = failure(lambda: assert_bounded(log, "dps.seen", lower=1.0))
    assert "dps.seen[0] leaves its bounds" in text


def test_nothing_is_asserted_where_nothing_was_commanded(log: Path) -> None:
    """The first ten cycles have no command."""
    assert np.isnan(read_log(log).sent["velocity"][:10]).all()
    assert_bounded(log, "sent.velocity", lower=0.0, upper=1.0)
    text = failure(lambda: assert_bounded(log, "act.velocity", upper=[0.0, 1.0]))
    assert "act.velocity[0] leaves its bounds at t = 0.001 s: 0.05 m/s" in text


def test_nan_that_was_commanded_is_a_value(log: Path) -> None:
    recorded = read_log(log)
    recorded.actuation["velocity"][20] = np.nan
    text = failure(lambda: assert_bounded(recorded, "act.velocity", upper=1.0))
    assert "nan m/s instead of a number" in text


def test_log_replays_and_a_changed_dps_does_not(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_replays(log)
    monkeypatch.setattr("tests.control.scripted.Servo.law", staticmethod(lambda gain, error: 0.5 * gain * error))
    text = failure(lambda: assert_replays(log))
    assert "replays differently: velocity in cycle 10" in text


def test_log_that_was_cut_off_does_not_replay(log: Path) -> None:
    log.write_bytes(log.read_bytes()[:-400])
    with pytest.raises(AssertionError, match="is not replayed as a whole"):
        assert_replays(log)


def test_jump_at_the_switch_is_named(log: Path) -> None:
    assert_continuous_at_switch(log)
    # The first command departs from the speed of 0 by its rate of 2 m/s^2 in a period.
    assert_continuous_at_switch(log, at_most={"velocity": 2.0 * PERIOD})
    text = failure(lambda: assert_continuous_at_switch(log, at_most={"velocity": [1e-3, 1.0]}))
    assert "sent.velocity[0] jumps where a switch is thrown" in text and "0.002 m/s away from sense.speed" in text


def test_jump_where_a_sensor_is_switched_is_named(tmp_path: Path) -> None:
    """The command goes on from the one before, by its rate of 2 m/s^2 in a period; the DPS answers a cycle later."""
    scenario, clock, path = ContinuousServo(), SimulatedClock(), tmp_path / "servo.lcm"

    def sensors(t: float) -> dict[str, Any]:
        return {"position": [0.0, 0.0], "speed": [0.0, 0.0]}

    bridge = ScriptedBridge(scenario.interface(), clock, sensors)
    runtime = scenario.deployment().runtime(scenario.build(), bridge, clock=clock)
    with runtime, Recorder(runtime, path) as recorder:
        recorder.wait_until_ready()
        runtime.run(cycles=10)
        runtime.switch("real")
        runtime.run(cycles=10)
        runtime.write({"u.target": [0.01, 0.0]})
        runtime.switch(sense={"speed": "sim"})
        runtime.run(cycles=10)
    assert_continuous_at_switch(path)
    text = failure(lambda: assert_continuous_at_switch(path, at_most={"velocity": 1e-3}))
    assert "sent.velocity[0] jumps where a switch is thrown" in text and "away from the command before" in text
