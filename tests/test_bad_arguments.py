"""Wrong arguments of the public entry points: a ValueError of one line where they are given, before memory is taken."""

# mypy: disable-error-code="arg-type, list-item, call-overload, dict-item"

from __future__ import annotations

import functools
import resource
from collections.abc import Callable, Iterator
from math import hypot
from pathlib import Path

import numpy as np
import pytest

from tests.folders import open_folder, that_cannot_be_written
from tests.optimization.studies import RATE, THETA, pendulum_problem
from tests.testbeds import PendulumScenario
from vtbdrake import Constraint, Parameter, Problem, Quality, Snapshot, Study, read_log
from vtbdrake.campaigns import Campaign
from vtbdrake.optimization import Sweep
from vtbdrake.reasoning import Belief, SearchConfig
from vtbdrake.rollout import FuturesExecutor, Pruning, RolloutTask, SerialExecutor, ThreadExecutor

pytestmark = pytest.mark.one_python

HUGE = 10**9
TASK = RolloutTask(PendulumScenario(), 0.1, Quality(abs, THETA))


def one(value: float) -> float:
    return value


def two(first: float, second: float) -> float:
    return first + second


def grid(points: object) -> Study:
    study = problem().study(solver="grid", options={"points": points})
    return study.run(rollouts=10 * HUGE, executor="serial", progress=False)


def problem() -> Problem:
    return pendulum_problem(parameters=[Parameter(THETA, -1.0, 1.0)])


def limited() -> Problem:
    return pendulum_problem(parameters=[Parameter(RATE, 0.0, 1.0)], quality=Quality(abs, THETA), threshold=0.5)


@pytest.fixture(autouse=True)
def little_memory() -> Iterator[None]:
    """4 GB more than the tests have: what takes it fails, and does not end them."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (4 << 30), before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Belief(3), "a belief is made of the state of a DPS, by Belief.of"),
        (lambda: SearchConfig(options=3), "options are given by name"),
        # Numbers that are too large are told by their number.
        (lambda: problem().sweep(HUGE), "1,000,000,000 points is larger than the largest, 10,000,000: take fewer"),
        (lambda: pendulum_problem().sweep([10**5, 10**5]), "10,000,000,000 points is larger"),
        (lambda: grid(HUGE), "at most 1,000,000 values of one parameter, not 1,000,000,000 of"),
        (lambda: problem().study(solver="cmaes", options={"population": HUGE}).run(rollouts=9), "at most 1,000,000"),
        (
            lambda: limited().boundary(resolution=1e-12, coarse=1e-11),
            "may examine 100,000,000,000 values, more than 10,000,000: take larger steps",
        ),
        (
            lambda: limited().boundary(resolution=0.5, coarse=1.0, repeats=HUGE),
            "is repeated 1,000,000 times at most, not 1,000,000,000",
        ),
        # Functions of other arguments.
        (lambda: Quality(two, THETA), r"quality function two is called with 1 value \(.*\), but two takes \(first"),
        (lambda: Quality(one, [THETA, RATE]), "quality function one is called with 2 values"),
        (lambda: Constraint(two, THETA, at_most=1.0), "constraint function two is called with 1 value"),
        (lambda: Quality(functools.partial(two, 1.0), [THETA, RATE]), "called with 2 values"),
        (lambda: Pruning(bound=one, of=[THETA]), "bound of a pruning is called with 2 values"),
        (lambda: problem().study().run(rollouts=1, callbacks=3), "give callbacks as functions of a study"),
        (lambda: problem().study().run(rollouts=1, callbacks=[3]), "a callback is a function of study, trial, not 3"),
        (lambda: problem().study().run(rollouts=1, callbacks=[one]), "a callback is called with 2 values"),
        # Options, and things of another kind.
        (lambda: grid("a"), "a number of points must be a number, not 'a'"),
        (lambda: grid(2.5), "a number of points must be a whole number, not 2.5"),
        (
            lambda: problem().study(options={"points": "a"}, solver="sobol").run(rollouts=1),
            "the option points of sobol",
        ),
        (lambda: problem().study().run(rollouts=1, racing="a"), "racing must be True or False, not 'a'"),
        (lambda: problem().study(3), "a study is a file, given by its path"),
        (lambda: Study.open(b"a.db"), "a study is a file, given by its path"),
        (lambda: Quality(abs, THETA, reading=[]), "read as one of best"),
        (lambda: RolloutTask(PendulumScenario(), 0.1, abs), "the quality of a rollout is a Quality"),
        (lambda: SerialExecutor(3), "rollouts run in a testbed"),
        (lambda: FuturesExecutor(3), "has a method submit, unlike 3"),
        (lambda: list(SerialExecutor().run(3, [{}])), "an executor runs a RolloutTask"),
        (lambda: list(ThreadExecutor(2).run(TASK, 3)), "an executor runs a list of points"),
        (lambda: list(ThreadExecutor(2).run(TASK, [3])), "an executor runs a list of points"),
        (lambda: Belief.perfect(3, 4), "a perfect belief is one of a testbed"),
    ],
)
def test_wrong_argument_is_told_at_once(call: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as told:
        call()
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("load", [Sweep.load, Snapshot.load, Campaign.load, read_log])
def test_number_is_no_path(load: Callable[[object], object]) -> None:
    """0 to 2 would be the file descriptors of this process."""
    with pytest.raises(TypeError, match="expected str, bytes or os.PathLike object, not int"):
        load(2)


@pytest.mark.parametrize("function", [abs, max, float, np.abs, hypot, functools.partial(two, 1.0), lambda *x: 0.0])
def test_functions_that_fit_or_do_not_tell_are_taken(function: Callable[..., float]) -> None:
    assert Quality(function, THETA).f is function


def test_decorated_function_is_asked_for_its_own_arguments() -> None:
    @functools.wraps(two)
    def adapted(*values: float) -> float:
        return two(values[0], 1.0)

    assert Quality(adapted, THETA)([2.0], time=0.0) == 3.0


def test_sweep_that_cannot_be_written_says_what_to_do() -> None:
    swept = problem().sweep(2, executor="serial", progress=False)
    with open_folder() as folder:
        path = folder / "a.vtb"
        with that_cannot_be_written(folder), pytest.raises(OSError, match="nothing was written: ") as told:
            swept.save(path)
        assert told.value.filename == str(path) and "another one" in str(told.value.strerror)
        for wrong, remedy in [(folder, "it is a folder"), (folder / "no" / "a.vtb", "make its folder first")]:
            with pytest.raises(OSError, match=remedy):
                swept.save(wrong)
        swept.save(path)
        assert len(Sweep.load(path)) == 2 and [entry.name for entry in folder.iterdir()] == ["a.vtb"]
