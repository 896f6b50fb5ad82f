"""Every check fails on its bad diagram, and on no other."""

import pytest

from tests.testing import zoo
from vtbdrake.testing import ScenarioCheckError, check_scenario
from vtbdrake.testing.check import check_names

HORIZON = 0.3

# Checks that do not concern the good diagram; without what the others ask for, no other check can run.
NOT_CONCERNED = {"check_mental_copy_continues", "check_derivatives_are_right"}
EVERYTHING_NEEDS = {"check_builds", "check_no_algebraic_loop", "check_simulates"}


def statuses(scenario, **options):
    try:
        report = check_scenario(scenario, horizon=HORIZON, **options)
    except ScenarioCheckError as error:
        report = error.report
    return {result.name: result for result in report}


def test_every_check_has_its_bad_diagram():
    assert list(zoo.BAD) and set(zoo.BAD) == set(check_names())


@pytest.mark.parametrize("kind", [zoo.GoodScenario, zoo.Differentiable])
def test_good_diagram_passes_every_check_that_concerns_it(kind):
    results = statuses(kind())
    assert {name for name, result in results.items() if result.status == "failed"} == set()
    skipped = {name for name, result in results.items() if result.status == "skipped"}
    assert skipped <= NOT_CONCERNED


@pytest.mark.parametrize("name", zoo.BAD)
def test_bad_diagram_fails_its_check_alone(name):
    results = statuses(zoo.BAD[name]())
    failures = {result.name: result.message for result in results.values() if result.status == "failed"}
    assert failures.keys() == {name}, failures
    for result in results.values():
        if result.status == "skipped" and result.name not in NOT_CONCERNED and name not in EVERYTHING_NEEDS:
            assert name in result.message, result
