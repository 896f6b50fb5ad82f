"""These benchmarks measure how processor time grows with the size of a task: an exponent of 1 is in proportion."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from math import log10
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import Gain, ZeroOrderHold

from benchmarks.measure import LOWER, Benchmark, processor_time
from tests.recording.servo import Servo
from tests.testbeds import PendulumScenario
from vtbdrake.campaigns.campaign import Campaign, Criterion, Seeds
from vtbdrake.optimization import Parameter, Problem, Study, Sweep
from vtbdrake.optimization.pareto import undominated
from vtbdrake.recording.log_reader import ControlLog, read_log
from vtbdrake.recording.recorder import Recorder
from vtbdrake.recording.replay import replay
from vtbdrake.recording.rewindable_replay import RewindableReplay
from vtbdrake.rollout import Executor, Quality, RolloutResult, RolloutTask, SerialExecutor
from vtbdrake.rollout.executor import Parameters, run_rollouts
from vtbdrake.testbed import Interface, Scenario, Signal
from vtbdrake.testbed.builder import VirtualTestbedBuilder
from vtbdrake.web.study.study_feed import StudyFeed

LINEAR = 1.1
"""Goal of the exponent."""
WITH_SORT = 1.2
"""Goal of the exponent where something is sorted, which takes n log n."""
SEEK_GOAL = 1.0  # s, what a person waits for

DECADE = 10
REPEATS = 3
ANGLE = "sim.sys.Pendulum.theta.position"
RATE = "sim.sys.Pendulum.theta.velocity"


def _growth(name: str, what: str, sizes: Sequence[int], prepare: Any, *, goal: float | None = LINEAR) -> Benchmark:
    """Measure an exponent from the largest of three sizes, a decade apart, and the middle one.

    The garbage collector does not pass over what was there before: other sizes and rows have made it.

    Args:
        name: The name of the row.
        what: What is counted.
        sizes: The three sizes.
        prepare: Function of a size that returns what is measured, a function without arguments, for every repeat.
        goal: The largest exponent; None if it is what others take.
    """

    def measured(size: int) -> float:
        task = prepare(size)
        gc.collect()
        gc.freeze()
        try:
            return processor_time(task)
        finally:
            gc.unfreeze()

    seconds = [float(np.median([measured(size) for _ in range(REPEATS)])) for size in sizes]
    table = ", ".join(f"{size}: {second:.3g} s" for size, second in zip(sizes, seconds, strict=True))
    return Benchmark(
        name=name,
        value=log10(seconds[-1] / seconds[-2]) / log10(sizes[-1] / sizes[-2]),
        unit="1",
        goal=goal,
        better=LOWER,
        against="itself at a tenth and a hundredth of the size",
        note=f"exponent of the processor time over the number of {what}; {table}",
    )


def _sizes(largest: int) -> tuple[int, int, int]:
    return largest // DECADE**2, largest // DECADE, largest


# -- sweeps and studies


class _Known(Executor):
    """Returns results at once, without a simulation: what is measured is what is around the rollouts."""

    cancels = False

    def run(
        self, task: RolloutTask, points: Sequence[Parameters], *, start: Any = None, cutoff: Any = None
    ) -> Iterator[tuple[int, RolloutResult]]:
        times, quality = np.array([0.0, 0.1]), np.array([0.0, 1.0])
        for index, point in enumerate(points):
            x = float(sum(value for value in point.values() if isinstance(value, float)))
            value = abs(np.sin(7.0 * x))
            measures = (1.0 - value + 0.1 * abs(np.cos(31.0 * x)),) * len(task.measures)
            yield (
                index,
                RolloutResult(point, "horizon", times, quality, 0.1, value, value, measures, wall_time=1e-3),
            )


def _problem(qualities: int = 1) -> Problem:
    return Problem(
        scenario=PendulumScenario(),
        parameters=[Parameter(ANGLE, -1.5, 1.5), Parameter(RATE, -3.0, 3.0)],
        quality=[Quality(abs, address) for address in (ANGLE, RATE)[:qualities]],
        horizon=0.1,
        sample_period=0.1,
    )


def growth_sweep(largest: int = 10_000) -> Benchmark:
    """Measure the loading of a sweep, its evaluations and its best point."""
    problem = _problem()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "sweep.vtb"

        def prepare(count: int) -> Callable[[], Any]:
            values = np.random.default_rng(0).uniform(-1.0, 1.0, (count, 2))
            problem.sweep(values=values, executor=_Known(), progress=False).save(path)
            return lambda: Sweep.load(path).best

        return _growth("growth_sweep", "rollouts of a sweep that is loaded", _sizes(largest), prepare)


def growth_study_append(largest: int = 10_000) -> list[Benchmark]:
    """Measure a study: appending rollouts, and the resumption, opening, summary and page of what was appended.

    Points are added by hand one by one, and no point of the front dominates another. With 100,000 rollouts, the
    exponents from a tenth of it were 0.98 (append), 0.99 (resume), 0.96 (open), 0.92 (summary) and 0.90 (page).
    """
    problem = _problem(qualities=2)
    with TemporaryDirectory() as folder, ExitStack() as opened:
        paths: dict[int, Path] = {}

        def append(count: int) -> Callable[[], Any]:
            paths[count] = Path(folder) / f"{count} {time.monotonic_ns()}.db"
            study = opened.enter_context(problem.study(paths[count], solver="random", seed=1))
            return lambda: _run(study, count)

        def resume(count: int) -> Callable[[], Any]:
            study = opened.enter_context(problem.study(paths[count], solver="random", seed=1))
            return lambda: _run(study, count)

        def page(count: int) -> Callable[[], Any]:
            study = opened.enter_context(Study.open(paths[count]))
            return lambda: _show(study)

        rows = [_growth("growth_study_append", "rollouts of a run", _sizes(largest), append)]
        for name, what, prepare, goal in (
            ("open", "rollouts of a study that is opened", lambda n: lambda: Study.open(paths[n]).close(), LINEAR),
            ("resume", "rollouts that the solver is told again", resume, LINEAR),
            ("summary", "rollouts of a study that is summed up", lambda n: lambda: _sum_up(paths[n]), WITH_SORT),
            ("page", "rollouts that a page shows", page, LINEAR),
        ):
            rows.append(_growth(f"growth_study_{name}", what, _sizes(largest), prepare, goal=goal))
    return [*rows, _growth_of_add(), _growth_of_pareto()]


def _run(study: Study, count: int) -> None:
    study.run(rollouts=count, executor=_Known(), progress=False)


def _sum_up(path: Path) -> None:
    with Study.open(path) as study:
        study.summary()


def _show(study: Study) -> None:
    feed = StudyFeed(study._file)
    feed.columns(0, feed.revision)
    feed.close()


def _growth_of_add(largest: int = 1000) -> Benchmark:
    problem = _problem()
    with TemporaryDirectory() as folder, ExitStack() as opened:

        def prepare(count: int) -> Callable[[], Any]:
            study = opened.enter_context(problem.study(Path(folder) / f"{count} {time.monotonic_ns()}.db"))
            return lambda: [study.add([0.001 * k, 0.1]) for k in range(count)]

        return _growth("growth_study_add", "points that are added one by one", _sizes(largest), prepare)


def _growth_of_pareto(largest: int = 100_000) -> Benchmark:
    def prepare(count: int) -> Callable[[], Any]:
        values = np.random.default_rng(0).standard_normal((count, 3))
        values[:, 2] = -values[:, 0] - values[:, 1]
        return lambda: undominated(values)

    what = "points of three qualities, all of them on the front"
    return _growth("growth_study_pareto", what, _sizes(largest), prepare, goal=WITH_SORT)


# -- logs


def growth_log_open(largest: int = 20_000, places: int = 20) -> list[Benchmark]:
    """Measure a log: its opening, its replay, and ways in it to any place, once states along it are kept.

    The row ``log_seek`` is the processor time of the longest of some ways in the longest log. With an hour at 1 kHz,
    3,600,000 cycles, the exponents were 0.98 (open, 1.8 s), 0.99 (replay, 67 s) and 0.02 (ways, the longest 0.32 s).

    Raises:
        RuntimeError: The replay was not identical.
    """
    with TemporaryDirectory() as folder, ExitStack() as opened:
        logs: dict[int, ControlLog] = {}
        for count in _sizes(largest):
            servo, path = Servo(), Path(folder) / f"{count}.lcm"
            with Recorder(servo.runtime, path):
                servo.runtime.run(cycles=count)
            logs[count] = read_log(path)
        testbed = Servo(alone=False).scenario.build()
        replays = {count: opened.enter_context(RewindableReplay(log, testbed)) for count, log in logs.items()}
        for each in replays.values():
            each.prepare()
        generator = np.random.default_rng(0)
        longest: dict[int, list[float]] = {count: [] for count in logs}

        def go(count: int) -> Callable[[], Any]:
            targets = generator.integers(0, count, places)

            def ways() -> None:
                for target in targets.tolist():
                    longest[count].append(processor_time(lambda target=target: replays[count].go_to(target)))

            return ways

        rows = [
            _growth("growth_log_open", "cycles", _sizes(largest), lambda n: lambda: read_log(logs[n].path)),
            _growth("growth_log_replay", "cycles", _sizes(largest), lambda n: lambda: _replay(logs[n])),
            _growth("growth_log_seek", f"cycles, of {places} ways to any place", _sizes(largest), go),
        ]
    worst = max(longest[largest])
    note = f"{len(longest[largest])} ways in a log of {largest} cycles, the median {np.median(longest[largest]):.3g} s"
    return [
        *rows,
        Benchmark(
            name="log_seek",
            value=worst,
            unit="s",
            goal=SEEK_GOAL,
            better=LOWER,
            absolute="what a person waits for",
            against=f"the longest way in a log of {largest // DECADE} cycles: {max(longest[largest // DECADE]):.3g} s",
            note=f"processor time; {note}",
        ),
    ]


def _replay(log: ControlLog) -> None:
    report = replay(log)
    if not report.identical:
        raise RuntimeError(f"the replay is not identical: {report}")


# -- testbeds


@dataclass
class _Large(Scenario):
    """A testbed with many systems or many bodies.

    Attributes:
        systems: Gains in a row in the DPS.
        bodies: Free bodies in the plant.
    """

    systems: int = 1
    bodies: int = 1

    def interface(self) -> Interface:
        return Interface(sense=[Signal("x", size=1)], act=[Signal("u", size=1, idle=0.0)])

    def make_dps(self) -> Diagram:
        builder = DiagramBuilder()
        last = first = builder.AddNamedSystem("gain 0", Gain(1.0, 1))
        for k in range(1, self.systems):
            following = builder.AddNamedSystem(f"gain {k}", Gain(1.0, 1))
            builder.Connect(last.get_output_port(), following.get_input_port())
            last = following
        builder.ExportInput(first.get_input_port(), "x")
        builder.ExportOutput(last.get_output_port(), "u")
        return builder.Build()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        plant, _ = builder.add_plant(MultibodyPlantConfig(time_step=1e-3))
        for k in range(self.bodies):
            plant.AddRigidBody(f"body_{k}", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        plant.Finalize()
        loop = builder.add("sys", "hold", ZeroOrderHold(1e-3, 1))
        builder.sim_sensor("x", loop.get_output_port())
        builder.sim_actuator("u", loop.get_input_port())


def growth_testbed_systems(largest: int = 1000) -> list[Benchmark]:
    """Measure how a testbed is built, and its state read, with many systems, and with many bodies and parameters."""

    def use(**sizes: int) -> None:
        testbed = _Large(**sizes).build()
        context = testbed.default_context()
        testbed.restore(context, testbed.snapshot(context))

    testbed_of = {count: _Large(bodies=count).build() for count in _sizes(largest)}

    def write(count: int) -> Callable[[], Any]:
        testbed = testbed_of[count]
        context = testbed.default_context()
        masses = {a: 2.0 for a in testbed.variables() if a.endswith(".mass")}
        return lambda: testbed.write(context, masses)

    def write_by_drake(count: int) -> Callable[[], Any]:
        plant = testbed_of[count].plant
        context = plant.GetMyMutableContextFromRoot(testbed_of[count].default_context())
        bodies = [plant.GetBodyByName(f"body_{k}") for k in range(count)]
        return lambda: [body.SetMass(context, 2.0) for body in bodies]

    sizes = _sizes(largest)
    return [
        _growth("growth_testbed_systems", "systems of a DPS", sizes, lambda n: lambda: use(systems=n)),
        _growth("growth_testbed_bodies", "bodies of a plant", sizes, lambda n: lambda: use(bodies=n)),
        _growth("growth_testbed_parameters", "parameters that are set", sizes, write),
        _growth("growth_testbed_parameters_floor", "masses that Drake sets", sizes, write_by_drake, goal=None),
    ]


def growth_recorded_variables(largest: int = 1000) -> Benchmark:
    """Measure a rollout of 80 bodies that records some of their variables at each of 200 steps."""
    testbed = _Large(bodies=80).build()
    addresses = [address for address in testbed.variables() if address.startswith("sim.sys.body_")]
    executor = SerialExecutor(testbed)

    def prepare(count: int) -> Callable[[], Any]:
        recorded = addresses[:count]
        task = RolloutTask(testbed.scenario, 0.2, record=recorded, sample_period=1e-3)

        def roll_out() -> None:
            (result,) = run_rollouts(executor, task, [{}], progress=False)
            assert result is not None and len(result.record) == count

        return roll_out

    with executor:
        return _growth("growth_recorded_variables", "variables that a rollout records", _sizes(largest), prepare)


# -- campaigns


def growth_campaign(largest: int = 10_000) -> Benchmark:
    """Measure a campaign: its rollouts, without their simulation, their verdicts and its file of results."""
    criteria = {
        "angle": Criterion(of=ANGLE, f="builtins:abs", at_most=2.0),
        "rate": Criterion(of=RATE, reading="end", at_most=2.0),
    }

    def prepare(count: int) -> Callable[[], Any]:
        campaign = Campaign(
            scenario="tests.testbeds:PendulumScenario",
            horizon=0.1,
            sample_period=0.1,
            conditions={"free": {}},
            seeds=Seeds(count=count, draw="tests.campaigns.campaign_functions:start"),
            criteria=criteria,
        )
        return lambda: campaign.run(executor=_Known(), progress=False).to_json()

    return _growth("growth_campaign", "rollouts", _sizes(largest), prepare)
