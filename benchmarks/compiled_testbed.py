"""Rollouts of compiled testbeds, beside the same rollouts in Drake; and how long the compilation takes."""

from __future__ import annotations

import itertools
import resource
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from benchmarks.measure import HIGHER, LOWER, Benchmark, interleaved, ratio
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.recording import DrivenScenario, Log, Series
from vtbdrake.rollout import RolloutTask, SerialExecutor
from vtbdrake.rollout.executor import run_rollouts
from vtbdrake.testbed import Scenario
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.manipulator import ManipulatorScenario
from vtbdrake_diagrams.manipulator.arm import Arm
from vtbdrake_diagrams.manipulator.studies.excited import ExcitedArmScenario
from vtbdrake_diagrams.processes import environment

STATE = "plant.state"
# Rounding grows in the motion that is compared.
TOLERANCE = 1e-9


def compiled_testbed(repeats: int = 10) -> list[Benchmark]:
    """Compare the rollouts per second of a compiled testbed with Drake's, on one core each."""
    random = np.random.default_rng(0)
    cart_pole = CartPoleScenario().mental()
    plans = np.column_stack([np.zeros(32), random.uniform(-60.0, 60.0, (32, cart_pole.knots))])
    pushes = 5.0 * random.standard_normal((8, 6))
    return [
        _compared("compiled_testbed", cart_pole, {"u.plan": plans}, horizon=1.0, goal=100.0, repeats=repeats),
        _compared(
            "compiled_testbed_arm",
            ManipulatorScenario(),
            {"sim.env.push.wrench": pushes},
            horizon=0.5,
            goal=20.0,
            repeats=max(repeats // 3, 2),
        ),
    ]


def _compared(
    name: str, scenario: Scenario, values: Mapping[str, np.ndarray], *, horizon: float, goal: float, repeats: int
) -> Benchmark:
    count = len(next(iter(values.values())))
    points = [{address: value[i] for address, value in values.items()} for i in range(count)]
    testbed = scenario.build()
    rollouts = testbed.compiled(
        horizon=horizon, sample_period=0.05, parameters=list(values), outputs=[STATE], compile=True
    )
    task = RolloutTask(scenario, horizon, record=[STATE])
    with SerialExecutor(testbed) as executor:
        in_drake = partial(run_rollouts, executor, task, points, progress=False)
        results = in_drake()
        batch = rollouts(values)
        expected = np.array([result.record[STATE] for result in results if result is not None])
        apart = float(np.max(np.abs(batch.outputs[STATE] - expected)) / max(1.0, np.max(np.abs(expected))))
        if not (batch.valid.all() and apart <= TOLERANCE):
            raise ArithmeticError(f"the compiled {type(scenario).__name__} is {apart:.2g} from Drake")
        by_drake, compiled = interleaved(in_drake, partial(rollouts, values), repeats=repeats)
    return Benchmark(
        name=name,
        value=ratio(by_drake, compiled),
        unit="1",
        goal=goal,
        better=HIGHER,
        against="the same rollouts in Drake, on one core each",
        note=f"ms per rollout of {horizon:g} s: {1e3 * np.median(compiled) / count:.3g}, in Drake "
        f"{1e3 * np.median(by_drake) / count:.3g}; states {apart:.1g} apart; n = {repeats}",
    )


def seeds_varied(repeats: int = 10, rollouts: int = 400) -> Benchmark:
    """Compare rollouts that differ in the seeds of all sensors with rollouts of one seed."""
    errors = ErrorModel(noise=0.01, drift=0.01, dropout=0.1)
    scenario = CartPoleScenario(position_errors=errors, velocity_errors=errors)
    seeds = ["sim.sense.joint_position.seed", "sim.sense.joint_velocity.seed"]
    compiled = scenario.build().compiled(
        horizon=2.0, sample_period=0.05, parameters=seeds, outputs=[STATE], compile=True, check=False
    )
    same, begin = dict.fromkeys(seeds, np.zeros(rollouts)), itertools.count()

    def of_many_seeds() -> None:
        values = np.arange(rollouts, dtype=float) + rollouts * next(begin)  # New ones: the last call's are kept.
        compiled(dict.fromkeys(seeds, values))

    of_one, of_many = interleaved(partial(compiled, same), of_many_seeds, repeats=repeats)
    return Benchmark(
        name="seeds_varied",
        value=ratio(of_many, of_one),
        unit="1",
        goal=1.5,
        better=LOWER,
        against="the same rollouts, all of one seed",
        note=f"us per rollout of 2 s: {1e6 * np.median(of_many) / rollouts:.3g}, of one seed "
        f"{1e6 * np.median(of_one) / rollouts:.3g}; n = {repeats}",
    )


def log_replay(repeats: int = 5) -> list[Benchmark]:
    """Compare how fast the compiled world of the arm and Drake's follow the torques of a log, on one core each."""
    # Without its controller, the arm falls onto a stop some time later.
    seconds, sample_period, torque = 2.0, 0.01, "joint_torque"
    machine = ExcitedArmScenario()
    turns = 0.3 * np.random.default_rng(0).standard_normal((machine.knots, 7))
    knots = np.clip(np.add(Arm().home, turns), Arm().lower, Arm().upper)
    task = RolloutTask(machine, seconds, record=[f"dps.{torque}"], sample_period=machine.period)
    with SerialExecutor() as executor:
        (recorded,) = run_rollouts(executor, task, [{"u.plan": np.append(0.0, knots)}], progress=False)
    assert recorded is not None
    # A sample is taken before the updates of its instant: it has acted since the sample before.
    commands = Series(recorded.times[:-1], recorded.record[f"dps.{torque}"][1:])
    world = DrivenScenario(scenario=machine, log=Log("the arm", {}, {torque: commands}))

    testbed = world.build()
    rollouts = testbed.compiled(horizon=seconds, sample_period=sample_period, outputs=[STATE], compile=True)
    begun = time.perf_counter()
    batch = rollouts()
    first = time.perf_counter() - begun
    replay = RolloutTask(world, seconds, record=[STATE], sample_period=sample_period)
    with SerialExecutor(testbed) as executor:
        in_drake = partial(run_rollouts, executor, replay, [{}], progress=False)
        (result,) = in_drake()
        assert result is not None
        positions, expected = (state[..., :7] for state in (batch.outputs[STATE][0], result.record[STATE]))
        apart = float(np.max(np.abs(positions - expected)))
        if not (batch.valid.all() and apart <= TOLERANCE):
            raise ArithmeticError(f"the compiled arm is {apart:.2g} rad from Drake's on the same log")
        by_drake, compiled = interleaved(in_drake, rollouts, repeats=repeats)
    moved = float(np.max(np.ptp(expected, axis=0)))
    return [
        Benchmark(
            name="log_replay",
            value=ratio(by_drake, compiled),
            unit="1",
            goal=20.0,
            better=HIGHER,
            against="the same log in Drake, the full world on one core",
            note=f"ms for {seconds:g} s of log at 1 kHz: {1e3 * np.median(compiled):.3g}, the first time "
            f"{1e3 * first:.3g}, in Drake {1e3 * np.median(by_drake):.3g}; over {moved:.2g} rad, positions {apart:.1g} "
            f"rad apart; n = {repeats}",
        )
    ]


def compile_time(repeats: int = 5) -> list[Benchmark]:
    """Processor time until the arm's testbed is compiled: the first time, and when its machine code is there."""
    testbed = ManipulatorScenario().build()
    compile_arm: Any = partial(
        testbed.compiled, horizon=0.5, sample_period=0.05, outputs=[STATE], compile=True, check=False
    )
    with tempfile.TemporaryDirectory() as folder, environment(XDG_CACHE_HOME=folder):
        first = _processor_time(compile_arm)
        again = float(np.median([_processor_time(compile_arm) for _ in range(repeats)]))
        checked = _processor_time(partial(compile_arm, check=True))
    return [
        Benchmark(
            name="compile_time",
            value=first,
            unit="s",
            goal=10.0,
            better=LOWER,
            absolute="what a person waits for, once per testbed",
            against="nothing: the arm's testbed, for the first time",
            note=f"with the check of its rollouts {checked - again:.2g} s more",
        ),
        Benchmark(
            name="compile_time_cached",
            value=again,
            unit="s",
            goal=0.1,
            better=LOWER,
            absolute="what a person does not notice",
            against="nothing: the same, whose machine code is there",
            note=f"n = {repeats}",
        ),
    ]


def _processor_time(function: Callable[[], Any]) -> float:
    """Return the seconds of processor time of a call, the compiler's included."""
    kinds = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    before = [resource.getrusage(kind) for kind in kinds]
    function()
    after = [resource.getrusage(kind) for kind in kinds]
    return sum(b.ru_utime + b.ru_stime - a.ru_utime - a.ru_stime for a, b in zip(before, after, strict=True))
