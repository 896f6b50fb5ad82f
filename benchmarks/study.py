"""Costs of a study beside its rollouts, against a bare loop and bare Optuna, and savings by racing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import vtbdrake as vtb
from benchmarks.measure import HIGHER, LOWER, Benchmark, interleaved, ratio, seconds, spread
from tests.testbeds import PendulumScenario
from vtbdrake.optimization import CVaR, Mean, Risk, Study, Worst
from vtbdrake.optimization.problem import Problem
from vtbdrake.optimization.solvers import make_solver
from vtbdrake.optimization.solvers.solver import Evaluation, Point
from vtbdrake.rollout import Executor, ProcessExecutor, Quality, RolloutRunner, RolloutTask, ThreadExecutor
from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.studies.payload import PHASE

ANGLE, RATE = "sim.sys.Pendulum.theta.position", "sim.sys.Pendulum.theta.velocity"
X = "sim.sys.climber.base.x"
PERIOD, STROKE, RAMP_TIME = (f"dps.impl.gait.{name}" for name in ("period", "stroke", "ramp_time"))
RISKS: Mapping[str, Risk] = {"worst": Worst(), "mean": Mean(), "cvar": CVaR(0.25)}
RACING_GOAL = 2.0  # times fewer rollouts, with the same best point
# The place that the robot of `racing_savings` should reach, in m ahead of its start.
PLACE = 0.05
CORES = 2


def study_overhead_threads(rollouts: int = 512, repeats: int = 9) -> Benchmark:
    """Measure what a study adds to a rollout that runs in a thread; see `_overhead`."""
    return _overhead("study_overhead_threads", ThreadExecutor(1), rollouts=rollouts, repeats=repeats)


def study_overhead_processes(rollouts: int = 512, repeats: int = 9) -> Benchmark:
    """Measure what a study adds to a rollout that runs in another process; see `_overhead`."""
    return _overhead("study_overhead_processes", ProcessExecutor(1), rollouts=rollouts, repeats=repeats)


def _overhead(name: str, executor: Executor, *, rollouts: int, repeats: int) -> Benchmark:
    """Time of a rollout of `Study.run` into a file on disk, less the time of `RolloutRunner.run` in a loop.

    It is divided by the time of a rollout that one would have, a second of the walking climber.

    The rollouts are as short as possible, a single step of a pendulum, so that they do not hide the overhead. Both
    simulate the same points, one rollout at a time: with two workers, the overhead of one would coincide with the
    rollout of the other. With a process, some of it still does: it has its next point before it has finished the last,
    and the work of this process meanwhile costs no time if there is a core for it. Points that are asked for one by one
    do not gain from that; the overhead of the executor for one of them is printed, too.

    The points are a Sobol design; the time that the solver itself takes for them is measured apart and subtracted. The
    executor has started its worker and built its testbed before. The whole of `run` is counted, with its beginning and
    its end; creating the file is not.
    """
    problem = _pendulum()
    search = partial(make_solver, "sobol", problem.parameters, budget=rollouts)
    points = _ask_and_tell(search)
    values = [problem.values(point) for point in points]
    runner = RolloutRunner(problem.task, problem.testbed)
    results: dict[str, list[float]] = {}

    def loop() -> None:
        results["loop"] = [runner.run(point).value for point in values]

    with _studies(problem, solver="sobol") as studies, executor:
        list(executor.run(problem.task, values[:2]))

        def run() -> None:
            study = next(studies).run(rollouts=rollouts, executor=executor, progress=False)
            results["study"] = [trial.value for trial in study.trials]

        def one_by_one() -> None:
            for point in values:
                list(executor.run(problem.task, [point]))

        ours, bare = interleaved(run, loop, repeats=repeats)
        single, beside = interleaved(one_by_one, loop, repeats=max(1, repeats // 3))
    solver = np.array([seconds(lambda: _ask_and_tell(search)) for _ in range(repeats)])
    ours, bare, solver, alone = (1e3 * times / rollouts for times in (ours, bare, solver, single - beside))
    added = float(np.median(ours - bare) - np.median(solver))
    climber = RolloutRunner(RolloutTask(SpaceClimberScenario(), 1.0, Quality(abs, X)))
    walk = 1e3 * float(np.median([seconds(lambda: climber.run({})) for _ in range(repeats + 1)][1:]))
    return Benchmark(
        name=name,
        value=added / walk,
        unit="1",
        goal=0.02,
        better=LOWER,
        against="a rollout of the climber of 1 s; beyond the bare rollout function in a loop",
        holds=None if results["study"] == results["loop"] else False,
        note=f"the goal was 0.4 ms: {added:.2g} ms, the climber's rollout takes {walk:.3g} ms; "
        f"a rollout: {spread(ours, unit='ms')} in the study, {spread(bare, unit='ms')} in the loop; the sampler "
        f"takes {spread(solver, unit='ms')}; one by one, the executor adds {spread(alone, unit='ms')} to a rollout; "
        f"{rollouts} rollouts, values "
        f"{'identical' if results['study'] == results['loop'] else 'DIFFER'}",
    )


def study_against_optuna(rollouts: int = 60, repeats: int = 3) -> list[Benchmark]:
    """A whole study with TPE, recorded in SQLite, against Optuna's own loop with the same sampler and options.

    Both do as many rollouts of the same pendulum with one worker. Optuna records in SQLite, as it usually does, and,
    for comparison, in its journal file. The time that TPE takes for its suggestions is part of all
    three. A part of the difference is a choice: Optuna's SQLite waits for the disk at each commit, so that even a
    power cut loses nothing; the commits of a study survive the death of its process only.
    """
    problem = _pendulum()
    runner = RolloutRunner(problem.task, problem.testbed)
    times: dict[str, list[float]] = {"ours": [], "sqlite": [], "journal": []}
    with _studies(problem, solver="TPE") as studies, TemporaryDirectory() as folder:

        def run(kind: str, repeat: int) -> None:
            if kind == "ours":
                next(studies).run(rollouts=rollouts, executor="serial", progress=False)
            else:
                _bare_optuna(problem, runner, kind, Path(folder) / f"{kind} {repeat}", trials=rollouts)

        for repeat in range(repeats + 1):
            for kind in [*times][repeat % 3 :] + [*times][: repeat % 3]:
                elapsed = 1e3 * seconds(partial(run, kind, repeat)) / rollouts
                if repeat:  # The first round warms up.
                    times[kind].append(elapsed)
    ours, sqlite, journal = (np.array(times[kind]) for kind in ("ours", "sqlite", "journal"))
    note = (
        f"a rollout, TPE included: study {spread(ours, unit='ms')}, Optuna with SQLite {spread(sqlite, unit='ms')}, "
        f"with its journal file {spread(journal, unit='ms')}; {rollouts} rollouts"
    )
    return [
        Benchmark(name="study_against_optuna", value=ratio(sqlite, ours), unit="1", goal=10.0, better=HIGHER,
                  against="bare Optuna, TPE, SQLite", note=note),
        Benchmark(name="study_against_optuna_journal", value=ratio(journal, ours), unit="1", goal=2.0, better=HIGHER,
                  against="bare Optuna, TPE, journal file"),
    ]  # fmt: skip


def racing_savings(points: int = 128) -> list[Benchmark]:
    """Rollouts of a study without racing over the rollouts of one with it; the best point is the same, to the last bit.

    Which period and stroke take the robot to a place `PLACE` ahead in 0.4 s, whichever of eight phases its gait starts
    in? A Sobol design asks for the same points with and without racing. What the best point is, is found by brute force
    from the rollouts of the study without racing, so that this one is run once for all risks.
    """
    conditions = len(_to_the_place(Worst()).conditions)
    with ProcessExecutor(CORES) as executor:
        run = partial(_design, points=points, executor=executor)
        whole = run(_to_the_place(Worst()), racing=False)
        raced = {name: run(_to_the_place(risk), racing=True) for name, risk in RISKS.items()}
    order = [trial.parameters for trial in whole.trials]
    costs = np.array([[whole.rollouts[tuple(p.values()), c].value for c in range(conditions)] for p in order])
    rows = []
    for name, study in raced.items():
        # The risk of a negative cost is the risk of a quality.
        risks = np.array([-RISKS[name](-row) for row in costs])
        best = int(np.argmin(risks))
        same_points = [trial.parameters for trial in study.trials] == order
        same_best = (study.best.number, study.best.value) == (best, risks[best])
        rows.append(
            Benchmark(
                name="racing_savings" if name == "worst" else f"racing_savings_{name}",
                value=len(whole) / len(study),
                unit="1",
                goal=RACING_GOAL,
                better=HIGHER,
                against="no racing",
                holds=same_points and same_best and len(whole) >= RACING_GOAL * len(study),
                note=f"{len(study)} rollouts instead of {len(whole)}, {points} points under {conditions} conditions; "
                f"the best point is {'the same' if same_points and same_best else 'ANOTHER'}, {study.best.value:.4g} m "
                f"from the place",
            )
        )
    return rows


def _to_the_place(risk: Risk) -> Problem:
    return vtb.Problem(
        scenario=SpaceClimberScenario(),
        parameters=[vtb.Parameter(PERIOD, 0.5, 2.0), vtb.Parameter(STROKE, 0.02, 0.2)],
        quality=vtb.Quality(_miss, X, minimize=True, reading="end"),
        horizon=0.4,
        sample_period=0.1,
        conditions=[{PHASE: k / 8, RAMP_TIME: 0.1} for k in range(8)],
        risk=risk,
    )


def _miss(x: float) -> float:
    return abs(x - PLACE)


def _design(problem: Problem, *, points: int, racing: bool, executor: Executor) -> Study:
    """A Sobol design, all of it."""
    study = problem.study(solver="sobol", seed=1, options={"points": points})
    return study.run(rollouts=points * len(problem.conditions), racing=racing, executor=executor, progress=False)


def _pendulum() -> Problem:
    return vtb.Problem(
        scenario=PendulumScenario(),
        parameters=[vtb.Parameter(ANGLE, -1.5, 1.5), vtb.Parameter(RATE, -3.0, 3.0)],
        quality=vtb.Quality(abs, ANGLE, reading="end"),
        horizon=0.01,
        sample_period=0.01,
    )


def _bare_optuna(problem: Problem, runner: RolloutRunner, kind: str, path: Path, *, trials: int) -> None:
    """The loop that one would write with Optuna alone, with a storage of that kind."""
    import optuna
    from optuna.storages import BaseStorage, JournalStorage, RDBStorage
    from optuna.storages.journal import JournalFileBackend

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    storage: BaseStorage = (
        RDBStorage(f"sqlite:///{path}") if kind == "sqlite" else JournalStorage(JournalFileBackend(str(path)))
    )

    def objective(trial: optuna.Trial) -> float:
        point = {p.address: trial.suggest_float(p.address, *p.ends) for p in problem.parameters}
        return runner.run(point).value

    # The options that the solver TPE of a study has.
    sampler = optuna.samplers.TPESampler(seed=0, constant_liar=True, multivariate=True)
    optuna.create_study(storage=storage, sampler=sampler, direction="maximize").optimize(objective, n_trials=trials)


@contextmanager
def _studies(problem: Problem, *, solver: str) -> Iterator[Iterator[Study]]:
    """New studies, one file each, closed at the end."""
    opened: list[Study] = []

    def made(folder: str) -> Iterator[Study]:
        for number in count():
            opened.append(problem.study(Path(folder) / f"{number}.db", solver=solver))
            yield opened[-1]

    with TemporaryDirectory() as folder:
        try:
            yield made(folder)
        finally:
            for study in opened:
                study.close()


def _ask_and_tell(make: Callable[[], Any]) -> list[Point]:
    """All points of a design."""
    solver, points = make(), []
    while batch := solver.ask():
        solver.tell([Evaluation(point, (1.0,)) for point in batch])
        points += batch
    return points
