"""check_scenario: what it returns, raises and refuses."""

import pytest

from tests.testbeds import AcrobotScenario
from tests.testing import zoo
from vtbdrake.testing import CheckFailedError, CheckSkippedError, ScenarioCheckError, Subject, check_scenario
from vtbdrake.testing.checks.scenario_checks import check_builds, check_mental_copy_continues

LIMITS = {"check_signals_have_limits": "Drake's model of it has none"}
SHOULDER = {"sim.sys.Acrobot.shoulder.position": 0.5}


def results(scenario, **options):
    with pytest.raises(ScenarioCheckError) as failure:
        check_scenario(scenario, horizon=0.1, **options)
    return {result.name: result for result in failure.value.report}, str(failure.value)


@pytest.mark.slow
def test_report_has_status_reason_and_time_of_every_check():
    report = check_scenario(AcrobotScenario(), horizon=0.1, values=SHOULDER, expected_failed_checks=LIMITS)
    assert report.ok
    by_name = {result.name: result for result in report}
    assert by_name["check_runs_repeat"].status == "passed"
    assert by_name["check_signals_have_limits"].status == "xfail"
    assert by_name["check_loop_commands_its_machine"].status == "skipped"
    assert "Drake's model of it has none" in str(report)
    assert all(result.seconds >= 0.0 for result in report)


@pytest.mark.slow
def test_failure_is_raised_with_all_results_and_where_it_lies():
    by_name, text = results(AcrobotScenario())
    assert [name for name, result in by_name.items() if result.status == "failed"] == ["check_signals_have_limits"]
    assert "joint_state has no limits" in text


@pytest.mark.slow
def test_failure_that_was_expected_and_is_mended_is_an_error():
    mended = {"check_builds": "it did not, once"}
    by_name, text = results(AcrobotScenario(), expected_failed_checks=LIMITS | mended)
    assert by_name["check_builds"].status == "xpass"
    assert "it passes: take it off expected_failed_checks" in text


class Wild(AcrobotScenario):
    def mental(self):
        raise KeyError("an error of the user")


@pytest.mark.slow
def test_error_of_the_user_fails_a_check_and_ends_none():
    by_name, _ = results(Wild(), expected_failed_checks=LIMITS)
    assert by_name["check_mental_copy_continues"].status == "failed"
    assert "KeyError: 'an error of the user'" in by_name["check_mental_copy_continues"].message
    assert by_name["check_derivatives_are_right"].status in ("passed", "skipped")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"expected_failed_checks": {"check_build": "misspelt"}}, "no check 'check_build'.*check_builds"),
        ({"expected_failed_checks": {"check_builds": ""}}, "say in a sentence why check_builds is expected to fail"),
        ({"values": {"sim.sys.Acrobot.sholder.position": 0.5}}, "sholder.*shoulder"),
    ],
)
def test_misspelt_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        check_scenario(AcrobotScenario(), horizon=0.1, **options)


def test_class_instead_of_a_scenario_is_refused():
    with pytest.raises(ValueError, match="a scenario is an instance"):
        check_scenario(AcrobotScenario)


def test_single_check_can_be_called():
    check_builds(Subject(zoo.GoodScenario()))
    with pytest.raises(CheckFailedError, match="the DPS has no input port position"):
        check_builds(Subject(zoo.BAD["check_builds"]()))
    with pytest.raises(CheckSkippedError, match="its own mental copy"):
        check_mental_copy_continues(Subject(zoo.GoodScenario()))
