"""The importance of parameters: beside Optuna's evaluator, and where the answer is known."""

import warnings

import numpy as np
import pytest

from tests.optimization.recorded import point, recorded
from vtbdrake.optimization import Choice, Parameter, Study
from vtbdrake.optimization.importance import importances
from vtbdrake.optimization.parameter import Dimension

SPACE: list[Dimension] = [
    Parameter("x", 0.0, 1.0),
    Parameter("period", 1e-3, 1.0, log=True),
    Parameter("steps", 0, 7, integer=True),
    Parameter("samples", 1, 300, integer=True, log=True),
    Choice("surface", ["ice", "sand", "wood"]),
]


def study_of(count: int) -> Study:
    """Random points of all kinds of parameters with two qualities, and one point that failed."""
    units = np.random.default_rng(3).random((count, len(SPACE)))
    places = [tuple(p.from_unit(u) for p, u in zip(SPACE, row, strict=True)) for row in units]
    points = [point(p, p[0] + 0.2 * p[2] - 0.5 * (p[4] == "sand"), np.log(p[3])) for p in places]
    return recorded(SPACE, [*points, point(places[0])], qualities={"speed": "maximize", "cost": "minimize"})


@pytest.mark.one_python
@pytest.mark.parametrize("count", [10, 57])
def test_importances_are_those_of_optuna(count: int) -> None:
    optuna = pytest.importorskip("optuna")
    study = study_of(count)
    ours = importances(study)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exported = study.to_optuna(optuna.storages.InMemoryStorage(), "all kinds")
        evaluator = optuna.importance.PedAnovaImportanceEvaluator()
        for quality, sign in ((0, -1.0), (1, 1.0)):  # The evaluator takes small values for good ones.
            theirs = optuna.importance.get_param_importances(
                exported, evaluator=evaluator, target=lambda trial, k=quality, sign=sign: sign * trial.values[k]
            )
            assert ours[quality] == pytest.approx(theirs, abs=1e-12)
            assert list(ours[quality]) == list(theirs)


def test_the_parameter_that_decides_has_nearly_all_of_the_importance() -> None:
    speed, cost = importances(study_of(300))
    assert next(iter(speed)) == "steps" and speed["steps"] > 0.5
    assert next(iter(cost)) == "samples" and cost["samples"] > 0.9
    assert sum(speed.values()) == pytest.approx(1.0) == sum(cost.values())


def test_where_all_points_are_equally_likely_the_shares_are_equal() -> None:
    two = [Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0)]
    units = np.linspace(0.0, 1.0, 40)
    (shares,) = importances(recorded(two, [point((u, u), np.sin(9 * u)) for u in units], qualities={"h": "maximize"}))
    assert shares == pytest.approx({"a": 0.5, "b": 0.5})
