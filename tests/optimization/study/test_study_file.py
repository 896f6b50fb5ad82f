"""The file of a study when it cannot be used: what is said, and that nothing is lost."""

import contextlib
import json
import os
import random
import shutil
import signal
import sqlite3
import zlib
from functools import partial
from time import process_time

import pytest

from tests.folders import open_folder, that_cannot_be_written
from tests.optimization.studies import DAMPING, pendulum_problem
from vtbdrake.optimization import Study, StudyError
from vtbdrake.optimization.records import Outcome
from vtbdrake.optimization.study import database
from vtbdrake.optimization.study.study_file import Mark, StudyFile

# Files and SQL.
pytestmark = pytest.mark.one_python


class OnSmallDisk(sqlite3.Connection):
    """A connection to a file on a disk that is soon full, as SQLite sees it."""

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.execute("PRAGMA max_page_count = 20")


def test_a_full_disk_ends_a_study_and_keeps_what_is_finished(tmp_path, monkeypatch):
    path = tmp_path / "a.db"
    with monkeypatch.context() as patch:
        patch.setattr(sqlite3, "connect", partial(sqlite3.connect, factory=OnSmallDisk))
        study = pendulum_problem().study(path, solver="random")
    with pytest.raises(StudyError, match=r"a\.db cannot be used .database or disk is full.*what was recorded is kept"):
        study.run(rollouts=500, executor="serial", progress=False)
    finished = len(study)
    study.close()
    with pendulum_problem().study(path) as again:
        assert len(again) == finished > 0
        again.run(rollouts=finished + 5, executor="serial", progress=False)
        assert len(again.trials) == finished + 5


def test_a_study_in_a_read_only_folder_can_be_read():
    with open_folder() as folder:
        path = folder / "a study?.db"
        with pendulum_problem().study(path, solver="sobol") as study:
            best = study.run(rollouts=4, executor="serial", progress=False).best
        with that_cannot_be_written(folder):
            with Study.open(path) as study:
                assert study.best == best
                with pytest.raises(StudyError, match="the permissions of the file and its folder"):
                    study.add([0.0, 0.0])
            with pytest.raises(StudyError, match="the permissions of the file and its folder"):
                pendulum_problem().study(path)
        assert [file.name for file in folder.iterdir()] == [path.name]


def test_a_folder_is_no_study(tmp_path):
    for use in (Study.open, pendulum_problem().study):
        with pytest.raises(StudyError, match=r"is a folder: a study is a file, such as .*study\.db$"):
            use(tmp_path)


def test_what_to_do_fits_what_is_wrong(tmp_path, monkeypatch):
    monkeypatch.setattr(database, "PATIENCE", 0.0)
    study = pendulum_problem().study(tmp_path / "a.db")
    file = StudyFile(study.path)
    with contextlib.closing(file), contextlib.closing(sqlite3.connect(study.path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        for change in (
            lambda: study.add([0.0, 0.0]),
            lambda: file.add((0.0, 0.0), 0, Outcome(1.0, 1.0, (), 0.1, "end", "", 0.1)),
        ):
            with pytest.raises(StudyError, match=r"another process has been writing to it.* wait for it") as told:
                change()
            assert "free space" not in str(told.value)
    study.add([0.0, 0.0])
    assert len(study.queue) == 1


def test_ctrl_c_ends_the_wait_for_another_process(tmp_path):
    study = pendulum_problem().study(tmp_path / "a.db")
    with contextlib.closing(sqlite3.connect(study.path, isolation_level=None, check_same_thread=False)) as other:
        other.execute("BEGIN IMMEDIATE")
        begun = process_time()
        alarm = signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
        try:
            signal.setitimer(signal.ITIMER_REAL, 0.05)
            with pytest.raises(KeyboardInterrupt):
                study.add([0.0, 0.0])
        finally:
            signal.signal(signal.SIGALRM, alarm)
        assert process_time() - begun < 3.0
        other.execute("ROLLBACK")
    study.add([0.0, 0.0])
    assert len(study.queue) == 1


def test_messages_about_damage_are_one_line(tmp_path, whole_study):
    content, seen = whole_study.read_bytes(), 0
    for page in range(1, len(content) // 4096):
        changed = bytearray(content)
        changed[page * 4096 : page * 4096 + 16] = bytes(range(16))
        (tmp_path / "a.db").write_bytes(changed)
        with contextlib.suppress(StudyError):
            try:
                Study.open(tmp_path / "a.db").close()
            except StudyError as error:
                assert "\n" not in str(error), error
                seen += 1
                raise
    assert seen > 3


@pytest.fixture
def copied_during_a_run(tmp_path):
    """A study that was copied in the middle of its run: file and log."""
    copy = tmp_path / "copy.db"

    def copied(study, trial):
        if trial.number == 0:  # After the batch, in which is all.
            for end in ("", "-wal"):
                shutil.copy(f"{study.path}{end}", f"{copy}{end}")

    with pendulum_problem().study(tmp_path / "a.db", solver="sobol") as study:
        study.run(rollouts=16, executor="serial", progress=False, callbacks=[copied])
    return copy


def warnings_of(caplog, path):
    caplog.clear()
    with Study.open(path) as study:
        return len(study), [record.getMessage() for record in caplog.records]


def test_a_study_copied_without_its_log_says_so(tmp_path, copied_during_a_run, caplog):
    alone = shutil.copy(copied_during_a_run, tmp_path / "alone.db")
    for _ in range(2):  # Reading it does not make it whole.
        count, (told,) = warnings_of(caplog, alone)
        assert count < 16 and "alone.db-wal is not there" in told and "copy both files" in told
    with pendulum_problem().study(alone) as study:
        study.run(rollouts=16, executor="serial", progress=False)
    assert warnings_of(caplog, alone) == (16, [])


def test_a_study_copied_with_its_log_or_killed_is_whole_in_silence(tmp_path, copied_during_a_run, caplog):
    for _ in range(2):  # SQLite removes the log that it has read.
        assert warnings_of(caplog, copied_during_a_run) == (16, [])
    assert not copied_during_a_run.with_name("copy.db-wal").exists()
    assert warnings_of(caplog, tmp_path / "a.db") == (16, [])
    with Study.open(tmp_path / "a.db") as ended:
        assert ended.sessions[-1]["reason"] == "solver"


def test_a_closed_study_says_that_it_is_closed(tmp_path):
    study = pendulum_problem().study(tmp_path / "a.db")
    study.close()
    for use in (lambda: study.trials, lambda: study.add([0.0, 0.0]), lambda: study.run(rollouts=1, progress=False)):
        with pytest.raises(StudyError, match=r"a\.db is closed"):
            use()


def test_a_file_with_trials_at_negative_positions_goes_on(tmp_path):
    path = tmp_path / "a.db"
    with pendulum_problem().study(path, solver="sobol") as study:
        study.run(rollouts=8, executor="serial", progress=False)
    # Files used to keep the trials of an earlier solver there.
    with sqlite3.connect(path) as db:
        rows = [
            ("trials", (batch, position - 100, *rest))
            for batch, position, *rest, _ in db.execute("SELECT * FROM trials").fetchall()
        ]
        db.execute("DELETE FROM trials")
        db.execute("DELETE FROM meta WHERE key IN ('told', 'first_position')")
        for table, row in [*rows, ("meta", ("told", json.dumps(0)))]:
            sealed = (*row, zlib.crc32(repr((table, *row)).encode()))
            db.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * len(sealed))})", sealed)
    db.close()
    whole = pendulum_problem().study(solver="sobol").run(rollouts=16, executor="serial", progress=False)
    with pendulum_problem().study(path) as study:
        assert len(study.trials) == 8
        study.run(rollouts=16, executor="serial", progress=False)
        assert [trial.point for trial in study.trials] == [trial.point for trial in whole.trials]


def everything(path):
    """All that a study says of itself, in comparable form."""
    with Study.open(path) as study, contextlib.closing(StudyFile(path)) as file:
        about = (study.record, study.attributes, study.queue, [t.attributes for t in study.trials], study.finished)
        runs = (study.rollouts, study.sessions, file.gradients())
        return repr((about, study.trials, runs, study.best, len(study)))


@pytest.fixture(scope="module")
def whole_study(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "a.db"
    with pendulum_problem(conditions=[{DAMPING: 0.0}, {DAMPING: 0.3}]).study(path, solver="cmaes") as study:
        study.add([0.25, 0.0])
        study.run(rollouts=60, executor="serial", progress=False)
        study.add([0.5, 0.0], [0.0, 1.0])
        with contextlib.closing(StudyFile(path)) as file:
            file.add_gradient((0.25, 0.0), (1.0, 2.0))
        study.set_attribute("operator", "somebody")
        study.set_attribute("seen", True, point=[0.25, 0.0])
    return path


@pytest.mark.slow_cases
@pytest.mark.parametrize("kind", ["bit", "byte", "page", "end"])
def test_a_damaged_file_is_refused_or_says_what_it_said(tmp_path, whole_study, kind):
    before, content = everything(whole_study), whole_study.read_bytes()
    chance, refused = random.Random(kind), 0
    for _ in range(120):
        changed, at = bytearray(content), chance.randrange(len(content))
        if kind == "bit":
            changed[at] ^= 1 << chance.randrange(8)
        elif kind == "byte":
            changed[at] = chance.randrange(256)
        elif kind == "page":
            page = at // 4096 * 4096
            changed[page : page + 4096] = bytes(4096)
        else:
            del changed[at:]
        path = tmp_path / "a.db"
        path.write_bytes(changed)
        try:
            assert everything(path) == before
        except StudyError:
            refused += 1
        assert path.read_bytes() == changed, "it is left as it is"
    assert refused > 20


@pytest.fixture(scope="module", params=["new log", "log used again"])
def killed_study(request, tmp_path_factory):
    """A study as a killed process leaves it: its last rollouts are in the log."""
    path, left = (tmp_path_factory.mktemp(name) / "a.db" for name in ("running", "killed"))
    with pendulum_problem().study(path, solver="sobol") as study:
        if request.param == "log used again":
            study.add(*([angle, 0.0] for angle in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)))
            with contextlib.closing(sqlite3.connect(path)) as db:
                db.execute("PRAGMA wal_checkpoint(RESTART)")
        for number in range(12):
            study.set_attribute(f"note {number}", number)
        for end in ("", "-wal"):
            shutil.copy(f"{path}{end}", f"{left}{end}")
    return left


def test_a_damaged_log_is_told_and_left_as_it_is(tmp_path, killed_study):
    def attributes():
        with Study.open(path) as study:
            return study.attributes

    path, log = tmp_path / "a.db", tmp_path / "a.db-wal"
    db, content = killed_study.read_bytes(), killed_study.with_name("a.db-wal").read_bytes()
    path.write_bytes(db)
    log.write_bytes(content)
    before = attributes()
    assert before == {f"note {number}": number for number in range(12)}
    chance, refused = random.Random(1), 0
    for _ in range(60):
        changed, at = bytearray(content), chance.randrange(len(content))
        changed[at] ^= 1 << chance.randrange(8)
        path.write_bytes(db)
        log.write_bytes(changed)
        try:
            assert attributes() == before
        except StudyError as error:
            refused += 1
            assert "a.db-wal is damaged after" in str(error)
            assert path.read_bytes() == db and log.read_bytes() == changed
            # What the message offers: without the rest of the log, it is the study of an earlier time.
            cut = int(str(error).partition("truncate -s ")[2].split()[0])
            os.truncate(log, cut)
            assert attributes().items() <= before.items()
    assert refused > 20


def test_a_log_that_ends_within_a_write_is_no_damage(tmp_path, killed_study):
    path, log = tmp_path / "a.db", tmp_path / "a.db-wal"
    content = killed_study.with_name("a.db-wal").read_bytes()
    for length in random.Random(2).sample(range(len(content)), 20):
        shutil.copy(killed_study, path)
        log.write_bytes(content[:length])
        with Study.open(path) as study:
            assert study.attributes.items() <= {f"note {number}": number for number in range(12)}.items()


@pytest.mark.slow
def test_the_log_of_a_long_run_stays_short_and_is_empty_after_it(tmp_path):
    path = tmp_path / "a.db"
    longest = 0

    def look(study, trial):
        nonlocal longest
        longest = max(longest, path.with_name("a.db-wal").stat().st_size)

    with pendulum_problem().study(path, solver="random") as study:
        study.run(rollouts=300, executor="serial", progress=False, callbacks=[look])
        assert path.with_name("a.db-wal").stat().st_size == 0
    assert 0 < longest < 300 * 4096


# -- what is new, for those who watch


@pytest.mark.slow
def test_who_watches_knows_what_the_file_has(tmp_path):
    path, problem = tmp_path / "study.db", pendulum_problem()
    problem.study(path, solver="bayesian", seed=3).close()
    watcher, trials, mark, returned = StudyFile(path), [], Mark(), 0
    version = watcher.version()
    # Batches of four: most runs end within one, whose trials the next run records again; a larger budget is a new
    # solver, whose trials follow all others.
    for rollouts in (3, 5, 9, 10, 17, 26, 27):
        with problem.study(path) as study:
            study.run(rollouts=rollouts, executor="serial", progress=False)
            assert watcher.version() != version
            version = watcher.version()
            kept, new, mark = watcher.trials_since(mark)
            trials = trials[:kept] + new
            returned += len(new)
            assert sorted(t.batch for t in trials) == sorted(t.batch for t in study.trials)
            values = [(t.point, t.values, t.batch, t.method) for t in trials]
            assert all((t.point, t.values, t.batch, t.method) in values for t in study.trials)
            assert len(trials) == len(study.trials)
    assert returned < 2 * len(trials)
    assert watcher.version() == version and watcher.trials_since(mark)[1] == trials[mark.count :]
    kept, outcomes, after = watcher.outcomes_since(Mark())
    assert {key: outcome for key, outcome, _ in outcomes} == watcher.outcomes() and kept == 0
    assert watcher.outcomes_since(after) == (27, [], after)


def test_who_watches_reads_again_what_was_forgotten(tmp_path):
    path, problem = tmp_path / "study.db", pendulum_problem()
    with problem.study(path, solver="sobol") as study:
        study.run(rollouts=8, executor="serial", progress=False)
    watcher = StudyFile(path)
    _, old, mark = watcher.trials_since(Mark())
    conditions = [{}, {DAMPING: 0.2}]
    with pendulum_problem(conditions=conditions).study(path, more_conditions=True) as study:
        assert watcher.trials_since(mark) == (0, [], Mark(changes=1))
        study.run(rollouts=16, executor="serial", progress=False)
        kept, new, _ = watcher.trials_since(mark)
        assert kept == 0 and [t.values for t in new] == [t.values for t in study.trials] != [t.values for t in old]
