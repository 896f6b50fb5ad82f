"""Checks of scenarios, and what their tests in pytest are made of."""

from vtbdrake.testing.check import CheckFailedError as CheckFailedError
from vtbdrake.testing.check import CheckResult as CheckResult
from vtbdrake.testing.check import CheckSkippedError as CheckSkippedError
from vtbdrake.testing.check import Report as Report
from vtbdrake.testing.check import ScenarioCheckError as ScenarioCheckError
from vtbdrake.testing.check import check_scenario as check_scenario
from vtbdrake.testing.plugin import parametrize_with_checks as parametrize_with_checks
from vtbdrake.testing.subject import Subject as Subject
