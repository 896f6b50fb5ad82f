"""Interventions: a study that is steered while it runs, repeats itself, and can be had without one of them."""

from __future__ import annotations

import pytest

from tests.optimization.studies import RATE, THETA, pendulum_problem
from vtbdrake.optimization import Study

SERIAL = {"executor": "serial", "progress": False}


def table(study: Study) -> list[tuple]:
    return [(trial.point, trial.values, trial.origin, trial.method, trial.batch) for trial in study.trials]


def steering(*changes):
    """Return a callback that makes each change, (kind, payload), after so many more trials."""

    def steer(study: Study, trial) -> None:
        for number, kind, payload in changes:
            if trial.number == number:
                study.intervene(kind, by="Ada", **payload)

    return steer


CHANGES = [
    (6, "range", {"address": THETA, "lower": -0.5, "upper": 1.0}),
    (6, "try", {"point": {THETA: 0.2, RATE: 0.1}}),
    (12, "forbid", {"region": {THETA: [0.0, 0.2], RATE: [-1.0, 1.0]}}),
    (14, "budget", {"rollouts": 40}),
    (18, "freeze", {"address": RATE, "value": 0.25}),
    (22, "unfreeze", {"address": RATE}),
    (25, "range", {"address": THETA, "lower": -2.0}),
]


@pytest.mark.parametrize("solver", ["auto", "cmaes", "sobol", "TPE", "SNOPT"])
def test_a_steered_study_is_replayed_to_the_last_bit(tmp_path, solver):
    if solver == "TPE":
        pytest.importorskip("optuna")
    study = pendulum_problem().study(tmp_path / "a.db", solver=solver, seed=1)
    study.run(rollouts=30, callbacks=[steering(*CHANGES)], **SERIAL)
    assert len(study) == 40 and [i.name for i in study.interventions] == ["Ada"] * 7
    again = study.replay(tmp_path / "b.db", reuse=False, executor="threads", workers=2, progress=False)
    assert table(again) == table(study)
    assert again.interventions == study.interventions
