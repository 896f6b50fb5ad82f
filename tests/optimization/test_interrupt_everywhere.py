"""Ctrl-C in many lines of a study, a sweep or a boundary: it ends, keeps what is finished, and goes on."""

import pytest

from tests.interruptions import hanging_fails, interrupt, places
from tests.optimization.studies import DAMPING, RATE, THETA, pendulum_problem
from vtbdrake.optimization import Parameter, boundary, evaluator, study, study_run, sweep
from vtbdrake.rollout import Quality, ThreadExecutor, executor, runner, testbeds

# Each place costs a study: so every so many of the lines are interrupted.
EVERY = 6
CONDITIONS = [{DAMPING: 0.0}, {DAMPING: 0.2}]


def table(of):
    rollouts = {key: (outcome.h, outcome.value, outcome.end) for key, outcome in of.rollouts.items()}
    return [(trial.parameters, trial.values, trial.exact, trial.batch) for trial in of.trials], rollouts


@pytest.fixture
def threads():
    with ThreadExecutor(2) as made:
        yield made


@pytest.mark.one_python
@pytest.mark.parametrize("solver", ["cmaes", "LN_COBYLA"])
def test_ctrl_c_in_many_lines_of_a_study(solver, threads):
    problem = pendulum_problem(conditions=CONDITIONS)
    budget = {"rollouts": 16, "executor": threads, "progress": False}

    def begun():
        return problem.study(solver=solver, seed=1)

    whole = table(begun().run(**budget))
    modules = study, study_run, evaluator, executor
    interrupted = 0
    for place in places(lambda: begun().run(**budget), *modules, lines=True)[::EVERY]:
        made = begun()
        error = interrupt(lambda: made.run(**budget), *modules, at=place)  # noqa: B023
        if error is None:
            assert made.reason in ("interrupted", "budget"), place
        interrupted += error is not None or made.reason == "interrupted"
        with hanging_fails(place):
            assert table(made.run(**budget)) == whole, place
    assert interrupted > 10


def test_ctrl_c_in_many_lines_of_a_sweep(threads):
    problem = pendulum_problem(parameters=[Parameter(THETA, -1.0, 1.0)], conditions=CONDITIONS)

    def operation():
        return problem.sweep(3, executor=threads, progress=False)

    whole = operation()
    by_key = dict(zip([(*p, c) for p, c in zip(whole.points, whole.condition, strict=True)], whole.h, strict=True))
    for place in places(operation, sweep, executor, testbeds, runner, lines=True)[::EVERY]:
        found = []
        interrupt(lambda: found.append(operation()), sweep, executor, testbeds, runner, at=place)  # noqa: B023
        for part in found:
            keys = [(*p, c) for p, c in zip(part.points, part.condition, strict=True)]
            assert part.complete == (len(part) == 6), place
            assert list(part.h) == [by_key[key] for key in keys], place
        with hanging_fails(place):
            assert list(operation().h) == list(whole.h), place


def test_ctrl_c_in_many_lines_of_a_boundary(threads):
    problem = pendulum_problem(
        parameters=[Parameter(RATE, 0.0, 8.0)], quality=Quality(abs, THETA), threshold=0.6, conditions=CONDITIONS
    )

    def operation():
        return problem.boundary(resolution=2.0, coarse=4.0, repeats=0, executor=threads, progress=False)

    whole = operation()
    assert 0.0 < whole.upper < 8.0
    interrupted = 0
    for place in places(operation, boundary, executor, lines=True)[::EVERY]:
        interrupted += interrupt(operation, boundary, executor, at=place) is not None
        with hanging_fails(place):
            again = operation()
        assert (again.lower, again.upper) == (whole.lower, whole.upper), place
    assert interrupted > 8
