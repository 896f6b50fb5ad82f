"""The cost of a study or a sweep grows with the number of rollouts, not with its square."""

from dataclasses import replace

import numpy as np
import pytest

from tests.growth import calls
from tests.optimization.studies import pendulum_problem
from vtbdrake.optimization import Study, Sweep
from vtbdrake.optimization.pareto import undominated
from vtbdrake.optimization.study.study_error import StudyError
from vtbdrake.optimization.study.study_file import Mark, StudyFile


def dominated(values):
    """Return by the definition which rows another one dominates."""
    return [any((other >= row).all() and (other > row).any() for other in values) for row in values]


@pytest.mark.slow_cases
@pytest.mark.parametrize("columns", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("kind", ["few values", "many values", "a front"])
def test_front_is_that_of_the_definition(columns, kind):
    generator = np.random.default_rng(columns)
    for count in (0, 1, 2, 70, 300):
        values = generator.integers(0, 3 if kind == "few values" else 1000, (count, columns)).astype(float)
        if kind == "a front" and columns > 1:
            values[:, -1] = -values[:, :-1].sum(axis=1)
        elif count:
            values[0, 0], values[-1, -1] = np.inf, -np.inf
        assert (~undominated(values)).tolist() == dominated(values)


def test_front_of_twice_as_many_takes_hardly_more_than_twice_the_work():
    values = np.random.default_rng(0).standard_normal((4000, 4))
    values[:, -1] = -values[:, :-1].sum(axis=1)  # no point dominates another one
    assert calls(lambda: undominated(values)) < 2.7 * calls(lambda: undominated(values[::2]))


def test_adding_a_point_costs_the_same_in_a_long_queue():
    with pendulum_problem().study() as study:
        study.add([0.1, 0.0])
        first = calls(lambda: study.add([0.1, 0.1]))
        study.add(*([0.1, 0.001 * k] for k in range(300)))
        study.intervene("budget", rollouts=1000)
        study.add([0.2, 0.0])
        assert calls(lambda: study.add([0.2, 0.1])) <= first
        number = next(iter(study.queue))
        study.edit(number, [0.2, 0.2])
        assert calls(lambda: study.edit(number, [0.2, 0.3])) <= first
        assert calls(lambda: study.parameters) < first
        assert study.queue[number] == dict(zip(study.queue[number], [0.2, 0.3], strict=True))


def test_search_follows_changes_of_another_connection(tmp_path):
    path = tmp_path / "a.db"
    with pendulum_problem().study(path) as study, Study.open(path) as other:
        theta = study.parameters[0]
        other.intervene("freeze", address=theta.address, value=0.1)
        assert study.search.frozen == {theta.address: 0.1}
        other.intervene("unfreeze", address=theta.address)
        other.add([0.1, 0.1])
        assert study.search.frozen == {}
        study.remove(2)  # what had made it free again
        assert other.search.frozen == study.search.frozen == {theta.address: 0.1}


def test_refused_removal_leaves_the_search_as_it_was(tmp_path):
    path = tmp_path / "a.db"
    with pendulum_problem().study(path) as study:
        theta = study.parameters[0].address
        study.intervene("freeze", address=theta, value=0.1)
        study.intervene("unfreeze", address=theta)
        with pytest.raises(ValueError, match="is not frozen"):
            study.remove(1)
        study.remove(2)
        assert study.search.frozen == {theta: 0.1}


def test_trials_of_a_watcher_are_counted_on(tmp_path):
    with pendulum_problem().study(tmp_path / "a.db", solver="sobol") as study:
        study.run(rollouts=8, executor="serial", progress=False)
        numbers = []
        study.set_attribute("remark", "good", point=study.trials[3].point)
        study.run(
            rollouts=16, executor="serial", progress=False, callbacks=[lambda _, trial: numbers.append(trial.number)]
        )
        assert numbers == [trial.number for trial in study.trials][-len(numbers) :]
        watcher = StudyFile(tmp_path / "a.db")
        _, trials, mark = watcher.trials_since(Mark())
        assert [trial.attributes for trial in trials] == [trial.attributes for trial in study.trials]
        assert watcher.trials_since(mark)[:2] == (len(trials), [])
        watcher.close()


def test_removed_rollouts_are_noticed_by_who_has_read_them(tmp_path):
    with pendulum_problem().study(tmp_path / "a.db", solver="sobol") as study:
        study.run(rollouts=8, executor="serial", progress=False)
        file = StudyFile(tmp_path / "a.db")
        kept, outcomes, mark = file.outcomes_since(Mark())
        assert (kept, len(outcomes)) == (0, 8)
        file.change_code(study.record["problem"], ["f"], versions={}, revision="")
        assert len(file.outcomes_since(mark)[1]) == 8  # They are read again, whichever have gone.
        file.close()
        with pytest.raises(StudyError, match="is closed"):
            file.outcomes_since(mark)


def test_loading_a_sweep_of_twice_as_many_rollouts_takes_twice_the_work(tmp_path):
    sweep = pendulum_problem().sweep(values=[[0.1, 0.0]], executor="serial", progress=False)
    record = {"sim.a": np.array([1.0, 2.0]), "sim.b": np.array([[3.0]])}

    def saved(count):
        many = replace(
            sweep,
            points=np.tile(sweep.points, (count, 1)),
            condition=np.tile(sweep.condition, count),
            rollouts=tuple(replace(sweep.rollouts[0], record={"sim.n": np.array(k), **record}) for k in range(count)),
        )
        many.save(tmp_path / f"{count}.vtb")
        return tmp_path / f"{count}.vtb"

    paths = {count: saved(count) for count in (1, 50, 100)}
    loaded = Sweep.load(paths[50])
    assert len(loaded) == 50
    for k, rollout in enumerate(loaded.rollouts):
        assert rollout.record.keys() == {"sim.n", *record} and rollout.record["sim.n"] == k
        for key, values in record.items():
            np.testing.assert_array_equal(rollout.record[key], values)
    work = {count: calls(lambda path=path: Sweep.load(path)) for count, path in paths.items()}
    assert work[100] - work[1] < 2.1 * (work[50] - work[1])
