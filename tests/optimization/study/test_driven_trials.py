"""Rollouts that somebody has driven, in the file of a study."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.testbeds import AcrobotScenario
from tests.web.live.test_drive import COMMAND, problem
from vtbdrake.optimization import Outcome, Study
from vtbdrake.rollout.course import Course
from vtbdrake.web import SessionError, SimulationSession


def test_driven_trial_is_kept_beside_the_points_and_computed_again(tmp_path: Path) -> None:
    path = tmp_path / "tilt.db"
    with problem().study(path, solver="random", seed=1) as study:
        study.run(rollouts=3, executor="serial", progress=False)
        before = study.trials
    with SimulationSession(problem().scenario, problem=problem()) as session:
        with pytest.raises(SessionError, match="nothing has been driven"):
            session.store_trial(path)
        session.write({"sim.sys.Pendulum.theta.position": 0.25})
        session.drive([COMMAND])
        session.deflect({COMMAND: 1.0})
        session.advance(50)
        driven = session.end_drive()
        stored = session.store_trial(path, by="Ada")
    with Study.open(path) as study:
        (trial,) = study.driven
        assert study.trials == before and len(study) == 3
        assert "driven" not in {t.origin for t in study.trials}
    assert (trial.number, trial.name, trial.time) == (1, "Ada", stored.time)
    assert trial.parameters == {"sim.sys.Pendulum.theta.position": 0.25}
    assert trial.outcome == Outcome.of(driven.result) and trial.outcome.message == "ended by hand"
    assert trial.course.rollout(problem().task).identical(driven.result)
    # The solver goes on as if there were none.
    with problem().study(path) as study, problem().study(tmp_path / "alone.db", solver="random", seed=1) as alone:
        study.run(rollouts=6, executor="serial", progress=False)
        alone.run(rollouts=3, executor="serial", progress=False)
        alone.run(rollouts=6, executor="serial", progress=False)
        assert [t.point for t in study.trials] == [t.point for t in alone.trials]
        again = study.replay(tmp_path / "again.db", executor="serial", progress=False)
        assert [t.point for t in again.trials] == [t.point for t in study.trials] and not again.driven


def test_drive_of_another_problem_is_refused(tmp_path: Path) -> None:
    testbed = AcrobotScenario().build()
    course = Course(testbed.snapshot(testbed.default_context()), 0.1)
    with problem().study() as study:
        start = study.problem.testbed.snapshot(study.problem.testbed.default_context())
        result = Course(start, 0.1, (), 1).rollout(study.problem.task)
        with pytest.raises(ValueError, match="the course is one of another scenario"):
            study.add_driven(course, result, parameters={"sim.sys.Pendulum.theta.position": 0.0})
        with pytest.raises(ValueError, match=r"a driven trial has values of sim.sys.Pendulum.theta.position, not of u"):
            study.add_driven(course, result, parameters={"u": 0.0})
    with SimulationSession(problem().scenario) as session, pytest.raises(SessionError, match="has no problem"):
        session.store_trial(tmp_path / "tilt.db")
