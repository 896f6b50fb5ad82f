"""Studies in Optuna's storage: all of a trial is there, Optuna and its dashboard work on it, and points return."""

import shutil
import socket
import subprocess
import sys
from contextlib import closing
from datetime import datetime
from math import inf, nan
from pathlib import Path

import matplotlib
import numpy as np
import pytest

optuna = pytest.importorskip("optuna")


from tests.optimization.recorded import point, recorded  # noqa: E402
from tests.optimization.studies import DAMPING, RATE, THETA, gap, pendulum_problem  # noqa: E402
from vtbdrake.optimization import Choice, Parameter, Study, StudyError, Trial  # noqa: E402
from vtbdrake.optimization.study.study_file import StudyFile  # noqa: E402
from vtbdrake.rollout import Constraint, Quality  # noqa: E402

pytestmark = pytest.mark.one_python

matplotlib.use("agg")

STATES = optuna.trial.TrialState
X, Y = Parameter("x", 0.0, 1.0), Parameter("y", 1e-3, 1.0, log=True)


def angle(theta: float) -> float:
    return theta


def mixed_problem():
    """All kinds of parameters, several conditions, a constraint."""
    return pendulum_problem(
        parameters=[
            Parameter(THETA, -1.5, 1.5),
            Parameter(DAMPING, 1e-3, 1.0, log=True),
            Parameter("scenario.stiffness", 0, 3, integer=True),
            Choice("scenario.damping", [0.0, 0.5]),
        ],
        conditions=[{RATE: rate} for rate in np.linspace(-1.0, 1.0, 12)],
        constraints=[Constraint(angle, THETA, at_most=1.2)],
    )


@pytest.fixture(scope="module")
def study() -> Study:
    return mixed_problem().study(solver="TPE", seed=1).run(rollouts=60, executor="serial", progress=False)


@pytest.fixture(scope="module")
def swing_url(tmp_path_factory) -> str:
    return f"sqlite:///{tmp_path_factory.mktemp('swing')}/optuna.db"


@pytest.fixture(scope="module")
def exported(study, swing_url):
    return study.to_optuna(swing_url, "swing")


@pytest.fixture(scope="module")
def empty(tmp_path_factory) -> Path:
    """An empty storage: to make its tables takes longer than to copy it."""
    path = tmp_path_factory.mktemp("empty") / "optuna.db"
    optuna.storages.RDBStorage(f"sqlite:///{path}")
    return path


@pytest.fixture
def url(tmp_path, empty) -> str:
    shutil.copy(empty, tmp_path / "optuna.db")
    return f"sqlite:///{tmp_path}/optuna.db"


def run(study: Study, rollouts: int) -> Study:
    return study.run(rollouts=rollouts, executor="serial", progress=False)


# -- export


@pytest.mark.usefixtures("exported")
def test_every_trial_is_there_with_its_parameters_and_values(study, swing_url):
    read = optuna.load_study(study_name="swing", storage=swing_url)
    assert [t.params for t in read.trials] == [dict(t.parameters) for t in study.trials]
    assert [t.number for t in read.trials] == [t.number for t in study.trials]
    assert {t.state for t in read.trials} == {STATES.COMPLETE, STATES.PRUNED}
    for mine, theirs in zip(study.trials, read.trials, strict=True):
        assert theirs.values == (list(mine.values) if mine.exact else None)
        assert (theirs.state is STATES.COMPLETE) == mine.exact
    assert read.direction.name == "MINIMIZE"
    assert read.best_params == dict(study.best.parameters)
    assert read.best_value == study.best.value


def test_ranges_are_those_of_the_parameters(exported):
    kinds = optuna.distributions
    assert exported.trials[0].distributions == {
        THETA: kinds.FloatDistribution(-1.5, 1.5),
        DAMPING: kinds.FloatDistribution(1e-3, 1.0, log=True),
        "scenario.stiffness": kinds.IntDistribution(0, 3),
        "scenario.damping": kinds.CategoricalDistribution([0.0, 0.5]),
    }


def test_rollouts_are_attributes_of_the_trial(study, exported):
    for mine, theirs in zip(study.trials, exported.trials, strict=True):
        at = tuple(mine.parameters.values())
        rollouts = [study.rollouts[at, k] for k in range(12) if (at, k) in study.rollouts]
        attributes = theirs.user_attrs
        assert attributes["values"] == [[outcome.value] for outcome in rollouts]
        assert attributes["t_star"] == [outcome.t_star for outcome in rollouts]
        assert attributes["end"] == [outcome.end for outcome in rollouts]
        assert attributes["wall_time"] == [outcome.wall_time for outcome in rollouts]
        assert (attributes["method"], attributes["origin"], attributes["batch"]) == ("TPE", "solver", mine.batch)
        # The worst of all conditions; of some, no more than a bound.
        worst = max(outcome.value for outcome in rollouts)
        assert worst == (mine.value if mine.exact else attributes["bound"][0])
        assert theirs.duration.total_seconds() >= max(attributes["wall_time"]) - 1e-3
        assert theirs.datetime_complete <= datetime.now()


def test_the_study_says_what_it_is_about(study, exported):
    record = study.record
    for key in ("problem", "solver", "seed", "options", "versions", "revision"):
        assert exported.user_attrs[key] == record[key]
    assert exported.user_attrs["problem"]["scenario"]["scenario"] == "tests.testbeds:PendulumScenario"
    assert exported.metric_names == ["gap"]


def of_all_kinds() -> Study:
    points = [
        point((0.1, 0.01), 1.0, 4.0, violations=(-1.0, -0.5)),
        point((0.2, 0.02), 5.0, 1.0, violations=(-1.0, 0.5)),
        point((0.3, 0.03), violations=(nan, nan)),
        point((0.4, 0.04), inf, 0.0, violations=(2.0, -1.0), exact=False),
        point((0.5, 0.05), 0.5, 5.0, violations=(-1.0, -0.5)),
    ]
    return recorded([X, Y], points, qualities={"speed": "maximize", "energy": "minimize"})


def test_failed_dropped_and_forbidden_points_are_told_apart(url):
    exported = of_all_kinds().to_optuna(url, "kinds")
    states = [STATES.COMPLETE, STATES.COMPLETE, STATES.FAIL, STATES.PRUNED, STATES.COMPLETE]
    assert [t.state for t in exported.trials] == states
    assert [d.name for d in exported.directions] == ["MAXIMIZE", "MINIMIZE"]
    assert [list(t.constraints.values()) for t in exported.trials] == [[-1, -0.5], [-1, 0.5], [], [2, -1], [-1, -0.5]]
    # A bound that is infinite is none.
    assert exported.trials[3].user_attrs["bound"] == [None, 0.0]
    # By Optuna's own account: what breaks a constraint is not on the front, nor is what is dominated.
    assert [t.number for t in exported.best_trials] == [0] == [t.number for t in of_all_kinds().pareto()]


@pytest.mark.parametrize("kind", ["memory", "journal"])
def test_every_storage_holds_the_same(study, exported, tmp_path, kind):
    storage = {
        "memory": optuna.storages.InMemoryStorage,
        "journal": lambda: optuna.storages.JournalStorage(
            optuna.storages.journal.JournalFileBackend(str(tmp_path / "journal"))
        ),
    }[kind]()
    assert content(study.to_optuna(storage, "swing").trials) == content(exported.trials)


def content(trials):
    names = ("number", "state", "values", "params", "distributions", "user_attrs", "system_attrs")
    dates = ("datetime_start", "datetime_complete")
    return [{name: getattr(trial, name) for name in (*names, *dates)} for trial in trials]


# -- export again


def test_writing_again_adds_only_what_is_new(url):
    study = run(pendulum_problem().study(solver="TPE"), 8)
    study.to_optuna(url, "growing")
    assert len(study.to_optuna(url, "growing").trials) == 8
    study.add(*[(0.1 * k, 0.2) for k in range(12)])
    exported = run(study, 20).to_optuna(url, "growing")
    assert [t.params for t in exported.trials] == [dict(t.parameters) for t in study.trials]
    assert [t.number for t in exported.trials] == list(range(20))


def test_repeated_point_in_batch_stays_twice(url, tmp_path):
    study = recorded([X, Y], [point((0.5, 0.5), 1.0)], qualities={"h": "maximize"}, path=tmp_path / "a.db")
    study.to_optuna(url, "twice")
    trial = Trial(dict(study.trials[0].parameters), (1.0,), (), True, "user", "by hand", batch=0)
    with closing(StudyFile(study.path)) as file:
        file.save_trials(0, {1: trial}, complete=False)
    exported = study.to_optuna(url, "twice")
    assert [t.user_attrs["origin"] for t in exported.trials] == ["solver", "user"]
    assert len(study.to_optuna(url, "twice").trials) == 2


def test_trials_that_others_add_stay_and_are_numbered_through(url):
    study = run(pendulum_problem().study(solver="TPE"), 4)
    exported = study.to_optuna(url, "shared")
    exported.optimize(lambda trial: trial.suggest_float(THETA, -1.5, 1.5), n_trials=2)
    study.add(*[(0.1 * k, 0.2) for k in range(4)])
    again = run(study, 8).to_optuna(url, "shared")
    assert [t.number for t in again.trials] == list(range(10))
    assert ["batch" in t.user_attrs for t in again.trials] == [True] * 4 + [False] * 2 + [True] * 4


def test_another_study_of_that_name_is_left_alone(url):
    run(pendulum_problem().study(solver="sobol"), 4).to_optuna(url, "taken")
    other = run(pendulum_problem(horizon=0.2).study(solver="sobol"), 4)
    with pytest.raises(StudyError, match="another study 'taken' already: export this one by another name"):
        other.to_optuna(url, "taken")
    assert len(optuna.load_study(study_name="taken", storage=url).trials) == 4


# -- what cannot be opened


def test_the_study_itself_is_no_storage_for_optuna(tmp_path):
    path = tmp_path / "swing.study"
    study = run(pendulum_problem().study(path, solver="sobol"), 4)
    with pytest.raises(StudyError, match="is the study itself: give Optuna another file"):
        study.to_optuna(f"sqlite:///{path}", "swing")
    study.close()
    assert len(Study.open(path)) == 4


@pytest.mark.parametrize("storage", ["swing.db", "sqlite:////no/such/folder/swing.db"])
def test_a_storage_that_cannot_be_opened_says_how_to_name_one(storage):
    with pytest.raises(StudyError, match=r"cannot open the storage '.*swing.db'.*sqlite:///study.db"):
        of_all_kinds().to_optuna(storage, "swing")


def test_without_optuna_the_extra_is_named(monkeypatch):
    study = of_all_kinds()
    monkeypatch.setitem(sys.modules, "optuna", None)
    for use in (lambda: study.to_optuna("sqlite://", "a"), lambda: study.import_optuna("sqlite://", "a")):
        with pytest.raises(ModuleNotFoundError, match=r"pip install 'vtbdrake\[optuna\]'"):
            use()


# -- import


@pytest.mark.usefixtures("exported")
def test_what_was_exported_comes_back_at_no_cost(study, swing_url):
    assert study.import_optuna(swing_url, "swing") == 0


def test_a_study_moves_to_another_file_by_way_of_optuna(url):
    first = run(pendulum_problem().study(solver="TPE"), 16)
    first.to_optuna(url, "moving")
    second = pendulum_problem().study(solver="TPE", seed=5)
    assert second.import_optuna(url, "moving") == 16
    run(second, 32)
    values = {tuple(t.parameters.values()): t.values for t in second.trials if t.origin == "user"}
    assert values == {tuple(t.parameters.values()): t.values for t in first.trials}


def test_points_of_others_are_evaluated_by_our_rollouts(url):
    theirs = optuna.create_study(storage=url, study_name="theirs")
    theirs.enqueue_trial({THETA: 0.25, RATE: -1.0})
    theirs.add_trial(
        optuna.create_trial(
            params={THETA: 0.5, RATE: 0.5},
            distributions={name: optuna.distributions.FloatDistribution(-3.0, 3.0) for name in (THETA, RATE)},
            value=-1000.0,
        )
    )
    started = theirs.ask()
    started.suggest_float(THETA, -1.5, 1.5)
    problem = pendulum_problem()
    study = problem.study(solver="TPE")
    # The one that was started waits in the queue no longer; it is the enqueued one.
    of_all_kinds().to_optuna(url, "narrow")
    assert study.import_optuna(url, "theirs") == 2
    of_all_kinds().to_optuna(url, "narrow")
    assert study.import_optuna(url, "theirs") == 0, "they wait already"
    run(study, 16)
    evaluated = {tuple(t.parameters.values()): t.value for t in study.trials if t.origin == "user"}
    assert evaluated == {at: problem.rollout(at).value for at in [(0.25, -1.0), (0.5, 0.5)]}
    of_all_kinds().to_optuna(url, "narrow")
    assert study.import_optuna(url, "theirs") == 0


def test_a_trial_that_is_still_drawing_its_parameters_is_left_out(url):
    theirs = optuna.create_study(storage=url, study_name="theirs")
    theirs.ask().suggest_float(THETA, -1.5, 1.5)
    assert pendulum_problem().study().import_optuna(url, "theirs") == 0


def test_options_that_optuna_would_confuse_are_kept_apart(url):
    space = [X, Choice("c", [1, "1"])]
    study = recorded(space, [point((0.5, c), float(k)) for k, c in enumerate([1, "1"])], qualities={"h": "maximize"})
    exported = study.to_optuna(url, "choices")
    assert [t.params["c"] for t in exported.trials] == [1, "1"]
    of_all_kinds().to_optuna(url, "narrow")
    assert study.import_optuna(url, "choices") == 0
    empty = recorded(space, [], qualities={"h": "maximize"})
    assert empty.import_optuna(url, "choices") == 2


def test_other_parameters_are_refused(url):
    of_all_kinds().to_optuna(url, "kinds")
    with pytest.raises(StudyError, match=f"trial 0 of Optuna's study 'kinds' sets x, y, but this study varies {THETA}"):
        pendulum_problem().study().import_optuna(url, "kinds")


def test_no_point_is_given_if_one_is_outside(url):
    wide = recorded(
        [X, Parameter("y", 0.0, 9.0)], [point((0.5, 0.5), 1.0), point((0.5, 8.0), 1.0)], qualities={"h": "maximize"}
    )
    wide.to_optuna(url, "wide")
    study = recorded([X, Y], [], qualities={"h": "maximize"})
    with pytest.raises(ValueError, match=r"y = 8 lies outside its range \[0.001, 1\]"):
        study.import_optuna(url, "wide")
    of_all_kinds().to_optuna(url, "narrow")
    assert study.import_optuna(url, "narrow") == 5


def test_an_unknown_name_lists_those_that_are_there(url):
    of_all_kinds().to_optuna(url, "kinds")
    with pytest.raises(StudyError, match="has no study 'kind'; it has kinds"):
        of_all_kinds().import_optuna(url, "kind")


# -- Optuna on it


@pytest.mark.usefixtures("exported")
@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
def test_plots_of_optuna_show_the_study(study, swing_url):
    plots = optuna.visualization.matplotlib
    read = optuna.load_study(study_name="swing", storage=swing_url)
    exact = [t for t in study.trials if t.exact]
    history = plots.plot_optimization_history(read)
    np.testing.assert_allclose(history.collections[0].get_offsets(), [[t.number, t.value] for t in exact])
    slices = plots.plot_slice(read, params=[THETA])
    assert sorted(slices.collections[0].get_offsets()[:, 0]) == sorted(t.parameters[THETA] for t in exact)
    assert plots.plot_contour(read, params=[THETA, DAMPING]).get_xlabel() in (THETA, DAMPING)
    matplotlib.pyplot.close("all")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::optuna.exceptions.ExperimentalWarning")
def test_pareto_front_of_optuna_is_ours(url):
    problem = pendulum_problem(
        quality=[Quality(gap, THETA, minimize=True, reading="end"), Quality(abs, RATE, reading="end")]
    )
    study = run(problem.study(solver="sobol"), 64)
    exported = study.to_optuna(url, "front")
    assert [t.number for t in exported.best_trials] == [t.number for t in study.pareto()]
    axes = optuna.visualization.matplotlib.plot_pareto_front(exported)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("gap", "abs")
    matplotlib.pyplot.close("all")


# -- the dashboard


@pytest.mark.slow
def test_the_dashboard_shows_the_study_in_a_browser(study, url, tmp_path):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    server = shutil.which("optuna-dashboard", path=Path(sys.executable).parent)
    if browser is None or server is None:
        pytest.skip("needs a Chromium and optuna-dashboard")
    study.to_optuna(url, "swing to the gap")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-u", server, url, "--host", "127.0.0.1", "--port", str(port), "--server", "wsgiref"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        # It ends, should the server end before it listens.
        assert any("Listening" in line for line in process.stdout)
        page = look(browser, f"http://127.0.0.1:{port}/dashboard/studies/1", tmp_path)
        trial = look(
            browser, f"http://127.0.0.1:{port}/dashboard/studies/1/trials?numbers={study.best.number}", tmp_path
        )
    finally:
        process.terminate()
        process.wait(timeout=60)
    assert "swing to the gap" in page
    assert f"Best Trial (number={study.best.number})" in page
    assert repr(study.best.value) in page
    assert "tests.testbeds:PendulumScenario" in page
    assert f"Trial {study.best.number} " in trial
    assert f"{THETA} {study.best.parameters[THETA]!r}" in trial


def look(browser: str, address: str, folder: Path) -> str:
    """The page as a browser has it when its scripts have run for some seconds of its own clock."""
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder / 'profile'}"]
    command = [browser, *options, "--virtual-time-budget=20000", "--dump-dom", address]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
