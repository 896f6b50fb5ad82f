"""Ctrl-C in many lines of a study, a sweep or a boundary: it ends, keeps what is finished, and goes on."""

import contextlib

import pytest

from tests.interruptions import hanging_fails, interrupt, places
from tests.optimization.studies import DAMPING, RATE, THETA, pendulum_problem
from vtbdrake.common import interrupt as interrupts
from vtbdrake.optimization import Parameter, Study, boundary, evaluator, sweep
from vtbdrake.optimization.study import claim, database, study, study_file, study_run
from vtbdrake.rollout import Quality, ThreadExecutor, executor, runner, testbeds

# Each place costs a study: so only some of the lines are interrupted, at equal distances.
EVERY = 17
CONDITIONS = [{DAMPING: 0.0}, {DAMPING: 0.2}]


def table(of):
    rollouts = {key: (outcome.h, outcome.value, outcome.end) for key, outcome in of.rollouts.items()}
    return [(trial.parameters, trial.values, trial.exact, trial.batch) for trial in of.trials], rollouts


@pytest.fixture
def threads():
    with ThreadExecutor(2) as made:
        yield made


@pytest.mark.one_python
def test_ctrl_c_anywhere_in_a_change_leaves_the_file_whole_and_unlocked(tmp_path):
    problem = pendulum_problem()
    made = problem.study(tmp_path / "a.db", seed=1)

    def change():
        made.add([0.1, 0.0])
        made.set_attribute("seen", len(made.queue))

    held = []  # As a notebook holds the last exception, and with it all frames.
    for place in places(change, study_file, database, contextlib, interrupts)[::4]:
        before = len(made.queue), made.attributes.get("seen")
        held.append(interrupt(change, study_file, database, contextlib, interrupts, at=place))
        assert len(made.queue) - before[0] in (0, 1), place
        assert made.attributes["seen"] in (before[1], len(made.queue)), place
        # Another connection, as one of another process.
        with contextlib.closing(study_file.StudyFile(made.path)) as other:
            other.set_attribute(None, "place", str(place))
        assert made.attributes["place"] == str(place)
    assert sum(error is not None for error in held) > 30


@pytest.mark.one_python
def test_ctrl_c_anywhere_at_the_ends_of_a_run_leaves_the_study_usable(tmp_path):
    problem = pendulum_problem()
    made = problem.study(tmp_path / "a.db", solver="sobol", seed=1)
    runs = []

    def run():
        runs.append(1)
        made.run(rollouts=len(runs), executor="serial", progress=False)

    run()
    held = []
    modules = study_file, database, claim, contextlib, interrupts
    for place in places(run, *modules, lines=True)[::3]:
        held.append(interrupt(run, *modules, at=place))
        assert not made.is_running, place
        with Study.open(made.path) as other:
            other.set_attribute("place", str(place))
    made.run(rollouts=len(runs) + 1, executor="serial", progress=False)
    assert len(made.trials) == len(runs) + 1 and len(held) > 20


@pytest.mark.one_python
@pytest.mark.parametrize(
    ("solver", "every"),
    [
        ("cmaes", 48),
        pytest.param("cmaes", EVERY, marks=pytest.mark.slow),
        pytest.param("LN_COBYLA", EVERY, marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_in_many_lines_of_a_study(solver, every, threads):
    problem = pendulum_problem(conditions=CONDITIONS)
    budget = {"rollouts": 16, "executor": threads, "progress": False}

    def begun():
        return problem.study(solver=solver, seed=1)

    whole = table(begun().run(**budget))
    modules = study, study_run, evaluator, executor
    interrupted = 0
    for place in places(lambda: begun().run(**budget), *modules, lines=True)[::every]:
        made = begun()
        error = interrupt(lambda: made.run(**budget), *modules, at=place)  # noqa: B023
        if error is None:
            assert made.reason in ("interrupted", "budget"), place
        interrupted += error is not None or made.reason == "interrupted"
        with hanging_fails(place):
            assert table(made.run(**budget)) == whole, place
    assert interrupted > 60 / every


@pytest.mark.slow
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


@pytest.mark.slow
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
    assert interrupted > 3
