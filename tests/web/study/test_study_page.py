"""The page of a study: what its server tells, and what it does."""

from __future__ import annotations

import json
import math
import os
import signal
import sqlite3
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from websockets.sync.client import ClientConnection

from tests.folders import open_folder, that_cannot_be_written
from tests.optimization.studies import pendulum_problem
from tests.web.live.test_session_server import PATIENCE, ask, page
from tests.web.serving.entrance import entered
from tests.web.study.studies import ANGLE, HORIZON, PLACE, RATE, cart_pole_problem, drive_cart, run_elsewhere
from vtbdrake.optimization import Choice, Parameter, Study, StudyError
from vtbdrake.optimization.importance import importances
from vtbdrake.rollout import Quality, RolloutResult, RolloutTask
from vtbdrake.rollout.executor import SerialExecutor, WorkerError
from vtbdrake.web import StudyView, view_study
from vtbdrake.web.study import study_worker
from vtbdrake.web.study.study_worker import PointError, PointSimulator

pytestmark = pytest.mark.one_python


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("study") / "cart.db"
    with cart_pole_problem().study(path, solver="sobol", seed=2) as study:
        study.run(rollouts=16, executor="serial", progress=False)
    return path


@pytest.fixture(scope="module")
def opened(finished: Path) -> Iterator[StudyView]:
    with view_study(finished) as view:
        yield view


class Reader:
    """The page's end of the socket: it keeps the trials as the page does."""

    def __init__(self, socket: ClientConnection) -> None:
        self.socket, self.number = socket, 0
        self.hello: dict[str, Any] = {}
        self.status: dict[str, Any] = {}
        self.trials: list[tuple[Any, ...]] = []
        self.reasons: dict[int, str] = {}

    def read(self) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(self.socket.recv(PATIENCE))
        if message["type"] == "trials":
            rows = zip(*message["points"], *message["values"], message["kinds"], strict=True)
            self.trials[message["first"] :] = rows
            self.reasons |= {message["first"] + int(k): reason for k, reason in message["reasons"].items()}
        elif message["type"] in ("hello", "status"):
            setattr(self, message["type"], message)
            if message.get("left") is not None:
                left = max(0, message["budget"] - message["rollouts"])
                assert message["left"] * message["rate"] == pytest.approx(left)
        return message

    def until(self, state: str, trials: int) -> Reader:
        while self.status.get("state") != state or len(self.trials) < trials:
            self.read()
        return self

    def ask(self, command: str, **fields: Any) -> Any:
        self.number += 1
        self.socket.send(json.dumps({"id": self.number, "do": command, **fields}))
        while (answer := self.read()).get("id") != self.number:
            pass
        if answer["error"]:
            raise StudyError(answer["error"])
        return answer["result"]


def rows(study: Study) -> list[tuple[Any, ...]]:
    return [(*trial.point, *trial.values, trial.kind) for trial in study.trials]


def test_page_has_what_the_study_has(opened: StudyView, finished: Path) -> None:
    status, text, _ = ask(entered(opened.url))
    assert status == 200 and 'src="page/study.js"' in text
    with page(opened) as socket, Study.open(finished) as study:
        reader = Reader(socket).until("ended", 16)
        assert reader.trials == rows(study)
        assert {kind for *_, kind in reader.trials} == {"feasible", "broken"}
        assert [p["address"] for p in reader.hello["parameters"]] == [ANGLE, RATE]
        assert reader.hello["parameters"][0] == {
            "address": ANGLE, "unit": "rad", "lower": 0.5, "upper": 3.0, "log": False, "integer": False,
            "label": "position",
        }  # fmt: skip
        assert reader.hello["qualities"] == [{"name": "magnitude", "unit": "m", "minimize": False}]
        assert reader.hello["simulates"] and not reader.hello["changes"] and "study continue" in reader.hello["command"]
        status = {key: reader.status[key] for key in ("rollouts", "budget", "reason", "solver", "failures", "ends")}
        assert status == {
            "rollouts": 16, "budget": 16, "reason": "solver", "solver": "sobol", "failures": [], "ends": {"horizon": 16}
        }  # fmt: skip


def test_shown_and_tried_points_are_those_of_the_problem(opened: StudyView) -> None:
    problem = cart_pole_problem()
    with page(opened) as socket:
        reader = Reader(socket).until("ended", 16)
        for number in (0, 5):
            shown = reader.ask("show", role="pointed", trial=number)
            rollout = problem.rollout(reader.trials[number][:2])
            assert (shown["t_star"], shown["duration"], shown["message"]) == (rollout.t_star, HORIZON, "")
        reader.ask("time", time=0.5)
        reader.ask("hide", role="pointed")
        tried = reader.ask("try", point=[2.0, 1.0])
        rollout = problem.rollout([2.0, 1.0])
        assert (tried["values"], tried["violations"]) == ([rollout.value], list(rollout.measures))
        assert tried["kind"] == ("feasible" if rollout.measures[0] <= 0.0 else "broken")
        for point, message in (([9.0, 0.0], "lies outside its range"), ([1.0], "shorter"), (["x", 0.0], "a number")):
            with pytest.raises(StudyError, match=message):
                reader.ask("try", point=point)
        for fields, message in (
            ({"trial": 16}, "no trial 16"),
            ({"trial": -1}, "no trial -1"),
            ({"point": [1.0, 0.0], "condition": 1}, "no condition"),
        ):
            with pytest.raises(StudyError, match=message):
                reader.ask("show", role="pointed", **fields)


@pytest.mark.slow
def test_trial_is_drawn_between_its_samples_where_drake_has_it(opened: StudyView) -> None:
    time, looks = 0.53, {}
    with page(opened) as socket:
        reader = Reader(socket).until("ended", 16)
        reader.ask("show", role="best", trial=3)
        reader.ask("show", role="pointed", trial=3)
        reader.ask("time", time=time)
        drawn = None
        with page(opened, "") as meshcat:
            while drawn is None or len(looks) < 2:
                message = msgpack.unpackb(meshcat.recv(PATIENCE))
                if message["type"] == "set_transform" and message["path"].endswith("study/pointed/cart_pole/pole"):
                    drawn = message["matrix"]
                if message["type"] == "set_object" and "/cart_pole/rod" in message["path"]:
                    (material,) = message["object"]["materials"]
                    looks[message["path"].split("/")[3]] = material["opacity"]
        reader.ask("hide", role="pointed")
    # The best is as it is, others are ghosts.
    assert looks["best"] == 1.0 > looks["pointed"] > 0.2
    testbed = cart_pole_problem().testbed
    context = testbed.default_context()
    testbed.write(context, dict(zip((ANGLE, RATE), reader.trials[3][:2], strict=True)))
    testbed.simulator(context).AdvanceTo(time)
    angle, speed = testbed.read(context, ANGLE), testbed.read(context, RATE)
    assert abs(speed) > 1.0
    np.testing.assert_allclose(np.array(drawn)[[0, 2]], [np.cos(angle), np.sin(angle)], atol=0.01)
    assert drawn[12] == pytest.approx(testbed.read(context, PLACE), abs=1e-3)


def test_importances_are_those_of_the_study(opened: StudyView, finished: Path) -> None:
    with page(opened) as socket, Study.open(finished) as study:
        answer = Reader(socket).until("ended", 16).ask("importance", quality=0)
        assert answer["shares"] == importances(study)[0] and (answer["points"], answer["trials"]) == (16, 16)


def test_few_trials_have_neither_model_nor_importances() -> None:
    study = cart_pole_problem().study(solver="random")
    study.run(rollouts=3, executor="serial", progress=False)
    with study.view() as view, page(view) as socket:
        reader = Reader(socket).until("ended", 3)
        grid = reader.ask("model", x=ANGLE, y=RATE, quality=0, trial=0)
        assert grid["mean"] is None and "needs 6 trials with a value, and there are 3" in grid["remark"]
        with pytest.raises(StudyError, match="at least 10 points with a value, but the study has 3"):
            reader.ask("importance", quality=0)


@pytest.mark.slow
def test_model_is_near_the_quality_between_the_trials(tmp_path: Path) -> None:
    problem = cart_pole_problem(constraints=[])
    with problem.study(tmp_path / "a.db", solver="sobol") as study:
        study.run(rollouts=64, executor="serial", progress=False)
    with view_study(tmp_path / "a.db") as view, page(view) as socket:
        grid = Reader(socket).until("ended", 64).ask("model", x=ANGLE, y=RATE, quality=0, trial=0)
    columns, lines = range(2, 24, 7), range(2, 24, 7)
    true = np.array([[problem.rollout([grid["x"][i], grid["y"][j]]).value for i in columns] for j in lines])
    mean = np.array(grid["mean"])[np.ix_(lines, columns)]
    assert np.abs(mean - true).max() < 0.25 * np.ptp(true)
    assert (grid["trials"], len(grid["x"]), len(grid["mean"])) == (64, 24, 24)


def test_options_and_several_qualities_and_failures_reach_the_page(tmp_path: Path) -> None:
    def late(theta: float) -> float:
        return abs(theta) if theta > -0.5 else math.nan

    parameters = [Parameter("sim.sys.Pendulum.theta.position", -1.5, 1.5), Choice("scenario.stiffness", [0.0, 2.0])]
    angle = parameters[0].address
    qualities = [Quality(late, angle, reading="end"), Quality(abs, angle, minimize=True)]
    study = pendulum_problem(parameters=parameters, quality=qualities).study(solver="random")
    study.run(rollouts=20, executor="serial", progress=False)
    with study.view() as view, page(view) as socket:
        reader = Reader(socket).until("ended", 20)
        assert reader.hello["parameters"][1]["options"] == [0.0, 2.0] and reader.hello["command"] == ""
        for trial, (theta, option, *values, kind) in zip(study.trials, reader.trials, strict=True):
            assert trial.point == (theta, [0.0, 2.0][option])
            assert values == [None if math.isnan(value) else value for value in trial.values] and kind == trial.kind
        ((message, count, first),) = reader.status["failures"][:1]
        failed = [k for k, trial in enumerate(study.trials) if trial.failed]
        assert "late" in message and first == min(failed) and 0 < count <= len(failed) < 20
        assert sorted(reader.reasons) == failed and all("late" in reason for reason in reader.reasons.values())
        tried = reader.ask("try", point=[-1.4, 0])
        assert tried["kind"] == "failed" and "late" in tried["message"]
        reader.ask("give", point=[0.5, 1])
        assert list(study.queue.values()) == [{angle: 0.5, "scenario.stiffness": 2.0}]


def test_study_in_memory_is_watched_while_it_runs() -> None:
    study = cart_pole_problem().study(solver="random")
    with study.view() as view, page(view) as socket:
        reader = Reader(socket).until("new", 0)
        run = threading.Thread(target=study.run, kwargs={"rollouts": 12, "executor": "serial", "progress": False})
        run.start()
        reader.until("ended", 12)
        run.join()
        assert reader.trials == rows(study)


def test_study_is_not_resumed_twice(finished: Path) -> None:
    with view_study(finished) as view:
        view.resume()
        assert view.runner is not None
        try:
            # The first process has not even come to the study's file.
            with pytest.raises(StudyError, match="the study is running"):
                view.resume()
        finally:
            view.runner.kill()
            view.runner.wait()
        assert "has ended" in view.runner_failure


@pytest.mark.slow
def test_dead_runner_is_told_and_another_process_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    # The process that goes on compiles, and must not come to its end before it is seen.
    runner = run_elsewhere(path, rollouts=200_000, solver="random")
    with view_study(path) as view, page(view) as socket:
        reader = Reader(socket).until("running", 20)
        assert 0.0 < reader.status["left"] < 1e5 and reader.status["budget"] == 200_000
        with pytest.raises(StudyError, match="is running"):
            reader.ask("run")
        runner.send_signal(signal.SIGKILL)
        runner.wait()
        done = len(reader.until("died", 20).trials)
        reader.ask("run")
        reader.until("running", done + 20)
        with Study.open(path) as study:
            study_rows = rows(study)[:done]
        assert reader.trials[:done] == study_rows
        assert view.runner is not None
        view.runner.kill()
        view.runner.wait()
        reader.until("died", done + 20)


@pytest.mark.slow
def test_study_with_more_trials_than_a_page_reads_in_its_share_is_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vtbdrake.web.study.study_feed.READING_SHARE", 1e-9)  # What is read takes too long.
    problem = cart_pole_problem()
    with problem.study(tmp_path / "a.db", solver="random") as study, study.view() as view, page(view) as socket:
        reader = Reader(socket).until("new", 0)
        for rollouts in (4, 8, 12):
            study.run(rollouts=rollouts, executor="serial", progress=False)
            reader.until("ended", rollouts)


@pytest.mark.slow
def test_running_study_is_steered(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    runner = run_elsewhere(path, rollouts=4000)
    with view_study(path) as view, page(view) as socket:
        reader = Reader(socket).until("running", 10)
        reader.ask("intervene", kind="pause", payload={})
        while not (reader.status["paused"] and reader.status["interventions"][-1]["batch"] is not None):
            reader.read()
        region = {ANGLE: [0.5, 1.5], RATE: [None, None]}
        reader.ask("intervene", kind="forbid", payload={"region": region})
        reader.ask("intervene", kind="range", payload={"address": RATE, "lower": -4.0, "upper": 1.0})
        for kind, payload, message in (
            ("forbid", {"region": {ANGLE: [0.0, 9.0]}}, "no point is left"),
            ("range", {"address": "sim.nothing"}, "varies no parameter"),
            ("explode", {}, "explode"),
            ("budget", {"rollouts": 0}, "at least one rollout"),
        ):
            with pytest.raises(StudyError, match=message):
                reader.ask("intervene", kind=kind, payload=payload)
        # A point outside the first range, tried here with its value, costs the study nothing.
        tried = reader.ask("try", point=[2.0, -3.5])
        reader.ask("give", point=[2.0, -3.5])
        extra = reader.ask("intervene", kind="budget", payload={"rollouts": 3000})
        reader.ask("remove", number=extra)
        reader.ask("intervene", kind="resume", payload={})
        while any(row["batch"] is None for row in reader.status["interventions"]) or reader.status["paused"]:
            reader.read()
        since = reader.status["interventions"][-1]["batch"]
        assert reader.status["parameters"][1]["lower"] == -4.0 and reader.status["ranges"][1]["upper"] == 1.0
        reader.until("running", len(reader.trials) + 40)
        reader.ask("intervene", kind="stop", payload={})
        reader.until("ended", 40)
        assert reader.status["reason"] == "stopped"
    assert runner.wait() == 0
    with Study.open(path) as study:
        later = [trial for trial in study.trials if trial.batch >= since and trial.origin == "solver"]
        by_hand = [trial for trial in study.trials if trial.origin == "user"]
        kinds = [intervention.kind for intervention in study.interventions]
    assert len(later) >= 40
    assert all(trial.parameters[ANGLE] > 1.5 and -4.0 <= trial.parameters[RATE] <= 1.0 for trial in later)
    assert [(trial.point, list(trial.values)) for trial in by_hand] == [((2.0, -3.5), tried["values"])]
    assert kinds == ["pause", "forbid", "range", "try", "resume", "stop"]


def test_file_whose_modules_are_not_trusted_is_shown_without_rollouts(tmp_path: Path) -> None:
    with cart_pole_problem(quality=Quality(lambda place: abs(place), "sim.sys.cart_pole.cart_slider.position")).study(
        tmp_path / "a.db", solver="sobol"
    ) as study:
        study.run(rollouts=4, executor="serial", progress=False)
    with view_study(tmp_path / "a.db") as view, page(view) as socket:
        reader = Reader(socket).until("ended", 4)
        assert "the function f is one of a script" in reader.hello["obstacle"] and not reader.hello["simulates"]
        with pytest.raises(StudyError, match="points cannot be simulated here: the function f"):
            reader.ask("try", point=[1.0, 0.0])
        with pytest.raises(StudyError, match="only the program that began the study can resume it"):
            reader.ask("run")


@pytest.mark.slow
def test_study_on_a_read_only_disk_is_shown_and_refuses_changes() -> None:
    with open_folder() as folder:
        path = folder / "a.db"
        with cart_pole_problem().study(path, solver="sobol") as study:
            study.run(rollouts=4, executor="serial", progress=False)
        with that_cannot_be_written(folder), view_study(path) as view, page(view) as socket:
            reader = Reader(socket).until("ended", 4)
            with pytest.raises(StudyError, match="the permissions of the file and its folder"):
                reader.ask("give", point=[1.0, 0.0])
            assert reader.ask("try", point=[1.0, 0.0])["values"]


@pytest.mark.slow
def test_long_rollout_keeps_nobody_waiting() -> None:
    study = cart_pole_problem(horizon=3600.0, sample_period=1.0).study()
    with study.view() as view, page(view) as socket:
        reader = Reader(socket).until("new", 0)
        for number, command in enumerate(("try", "try", "show"), 1):
            point = {"point": [1.0, 0.1 * number]} | ({"role": "pointed"} if command == "show" else {})
            socket.send(json.dumps({"id": 1000 + number, "do": command, **point}))
        # These are answered while the worker is busy; and the page closes, whose worker is busy still.
        reader.ask("time", time=0.1)
        reader.ask("intervene", kind="budget", payload={"rollouts": 17})


def test_pointer_does_not_replace_the_best_that_waits_for_the_worker(tmp_path: Path) -> None:
    gate = tmp_path / "gate"

    def through_the_gate(place: float) -> float:
        if gate.exists():
            gate.read_bytes()  # As long as the test has the other end open.
        return abs(place)

    best = [[1.0, 0.01], [1.0, 0.02]]
    pointed = [[1.0, 0.1], [1.0, 0.2], [1.0, 0.3]]
    replaced = "another point is simulated instead"
    study = cart_pole_problem(quality=Quality(through_the_gate, PLACE)).study()
    with study.view() as view, page(view) as socket, page(view) as other:
        reader, other_reader = Reader(socket).until("new", 0), Reader(other).until("new", 0)

        def show(role: str, *points: list[float], by: Reader = reader) -> None:
            for point in points:
                by.number += 1
                by.socket.send(json.dumps({"id": by.number, "do": "show", "role": role, "point": point}))

        def answers(count: int, of: Reader = reader) -> dict[int, str]:
            found: dict[int, str] = {}
            while len(found) < count:
                if "id" in (message := of.read()):
                    found[message["id"]] = message["error"]
            return found

        os.mkfifo(gate)
        show("pointed", [1.0, 0.0])  # 1
        with gate.open("wb"):  # The worker is busy with it.
            gate.unlink()
            show("best", *best)  # 2 and 3: one of them waits, when the other has been replaced
            ((number, error),) = answers(1).items()
            assert number in (2, 3) and error == replaced
            waiting = 5 - number
            show("best", best[waiting - 2], by=other_reader)  # Another page shows the same.
            show("ghost", [1.0, 0.0], by=other_reader)
            assert answers(1, other_reader) == {2: "a rollout is shown as best, pointed, tried, not as 'ghost'"}
            show("pointed", *pointed)  # 4, 5 and 6: one of them waits
            errors = answers(2)
            assert errors.keys() < {4, 5, 6} and set(errors.values()) == {replaced}
        shown = {1, waiting} | ({4, 5, 6} - errors.keys())
        assert answers(3) == dict.fromkeys(shown, "")
        assert answers(1, other_reader) == {1: ""}


def test_removed_file_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    cart_pole_problem().study(path).close()
    with view_study(path) as view, page(view) as socket:
        reader = Reader(socket).until("new", 0)
        assert reader.status["message"] == ""
        path.unlink()
        while "has been removed or replaced" not in reader.status["message"]:
            reader.read()


def test_file_that_is_no_study_is_refused(tmp_path: Path, finished: Path) -> None:
    text = tmp_path / "text.db"
    text.write_text("no study " * 100)
    other = tmp_path / "other.db"
    other.write_bytes(finished.read_bytes())
    with sqlite3.connect(other) as db:
        db.execute("PRAGMA user_version = 99")
    db.close()
    for path, message in (
        (tmp_path / "missing.db", "there is no study file"),
        (text, "cannot be read"),
        (other, "is a study of version 99"),
    ):
        with pytest.raises(StudyError, match=message):
            view_study(path)


@pytest.mark.slow
def test_driven_trial_is_shown_by_its_course(tmp_path: Path) -> None:
    path = tmp_path / "a.db"
    with cart_pole_problem().study(path, solver="sobol", seed=2) as study:
        study.run(rollouts=4, executor="serial", progress=False)
    with view_study(path) as view, page(view) as socket:
        reader = Reader(socket).until("ended", 4)
        assert reader.status["driven"]["numbers"] == []
        drive = drive_cart(path)  # While the page is open.
        while not reader.status["driven"]["numbers"]:
            reader.read()
        driven = {key: column[0] for key, column in reader.status["driven"].items()}
        violation = drive.outcome.measures[0]
        assert driven == {
            "numbers": 1, "names": "Ada", "points": [1.5, 0.5], "values": [drive.outcome.value], "after": 4,
            "kinds": "feasible" if violation <= 0.0 else "broken", "messages": "ended by hand",
        }  # fmt: skip
        assert len(reader.trials) == 4
        shown = reader.ask("show", role="pointed", driven=1)
        assert (shown["t_star"], shown["duration"], shown["message"]) == (drive.outcome.t_star, 0.25, "ended by hand")
        with pytest.raises(StudyError, match="no driven trial 7"):
            reader.ask("show", role="pointed", driven=7)
        with Study.open(path) as study:
            result = replace(drive.course.rollout(cart_pole_problem().task), value=0.25)
            study.add_driven(drive.course, result, parameters=drive.parameters)
        while len(reader.status["driven"]["numbers"]) < 2:
            reader.read()
        assert "the code has changed since" in reader.ask("show", role="pointed", driven=2)["message"]


class Tardy:
    """An executor that is closed just before its next rollout begins."""

    started, closed, closed_again = (threading.Event() for _ in range(3))

    def __init__(self, workers: int) -> None:
        self._serial = SerialExecutor()

    def start_workers(self, rollouts: int) -> None:
        pass

    def run(self, task: RolloutTask, points: Any) -> Iterator[tuple[int, RolloutResult]]:
        self.started.set()
        if not self.closed.is_set():
            self.closed.wait(PATIENCE)
            yield from self._serial.run(task, points)
        else:
            self.closed_again.wait(PATIENCE)
            raise WorkerError("the executor was closed")

    def close(self) -> None:
        (self.closed_again if self.closed.is_set() else self.closed).set()


@pytest.mark.slow
def test_end_between_two_rollouts_of_a_point_ends_the_second(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study_worker, "ProcessExecutor", Tardy)
    simulator = PointSimulator(cart_pole_problem(conditions=[{}, {PLACE: 0.1}]))
    with ThreadPoolExecutor(1) as pool:
        attempt = pool.submit(simulator.attempt, (1.0, 0.0))
        assert Tardy.started.wait(PATIENCE)
        simulator.close()
        assert Tardy.closed_again.is_set()
        with pytest.raises(PointError, match="the executor was closed"):
            attempt.result(PATIENCE)


@pytest.mark.slow
def test_point_is_refused_after_the_end() -> None:
    simulator = PointSimulator(cart_pole_problem())
    simulator.close()
    with pytest.raises(PointError, match="the page has ended"):
        simulator.attempt((1.0, 0.0))
    with pytest.raises(PointError, match="the page has ended"):
        simulator.rollout((1.0, 0.0), condition=0)
