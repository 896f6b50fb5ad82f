"""The plugin: a test per scenario and check, and nothing of Drake before a test asks for it."""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from tests.testbeds import PendulumScenario
from tests.testing import zoo
from vtbdrake.testing import CheckFailedError, ScenarioCheckError, check_scenario, parametrize_with_checks

pytestmark = pytest.mark.one_python

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow_cases
@parametrize_with_checks(
    [PendulumScenario()],
    expected_failed_checks={"check_signals_have_limits": "Drake's model of it has none"},
    values={"sim.sys.Pendulum.theta.position": 0.5},
    horizon=0.05,
)
def test_every_check_is_a_test(scenario, check):
    check(scenario)


def test_plugin_loads_nothing_of_drake():
    code = "import sys, vtbdrake.testing.plugin; print([m for m in sys.modules if m.partition('.')[0] == 'pydrake'])"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.slow
def test_checks_need_no_pytest():
    code = """
        import sys
        sys.modules["pytest"] = None
        from tests.testbeds import AcrobotScenario
        from vtbdrake.testing import check_scenario
        if __name__ == "__main__":
            limits = {"check_signals_have_limits": "Drake's model of it has none"}
            print(check_scenario(AcrobotScenario(), horizon=0.05, expected_failed_checks=limits).ok)
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "True"


def test_pytest_shows_no_frame_of_a_check():
    cases = {case.id.partition("-")[2]: case.values for case in parametrize_with_checks([zoo.check_builds()]).args[1]}
    scenario, check = cases["check_builds"]
    with pytest.raises(CheckFailedError) as of_a_test:
        check(scenario)
    with pytest.raises(ScenarioCheckError) as of_the_report:
        check_scenario(scenario)
    for failure in (of_a_test, of_the_report):
        assert [entry.path for entry in failure.traceback.filter(failure)] == [Path(__file__)]


def test_unknown_check_is_refused_with_the_nearest():
    with pytest.raises(ValueError, match="no check 'check_build'.*check_builds"):
        parametrize_with_checks([PendulumScenario()], expected_failed_checks={"check_build": "misspelt"})
