"""The pytest plugin, and the only module of vtbdrake that imports pytest.

pytest imports it in every run where vtbdrake is installed: nothing here imports Drake before a test asks for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from vtbdrake.testbed import Scenario


def parametrize_with_checks(
    scenarios: Iterable[Scenario],
    *,
    expected_failed_checks: Mapping[str, str] | Callable[[Scenario], Mapping[str, str]] | None = None,
    values: Mapping[str, Any] | Callable[[Scenario], Mapping[str, Any]] | None = None,
    horizon: float | None = None,
) -> pytest.MarkDecorator:
    """Return a decorator that runs a test once for every scenario and every check, each in a test of its own.

    For example::

        @parametrize_with_checks([ArmScenario()], expected_failed_checks={"check_signals_have_limits": "no datasheet"})
        def test_arm(scenario, check):
            check(scenario)

    A check that does not concern a scenario is skipped, with the reason. A check that is expected to fail, and does
    not, is an error: take it off the list.

    Args:
        scenarios: The scenarios.
        expected_failed_checks: Name of a check -> the reason why it fails; or a function that returns these for a
            scenario.
        values: Address -> value, set before every simulation; or a function that returns these for a scenario.
        horizon: Seconds that are simulated; see `check_scenario`.

    Raises:
        ValueError: There is no check of an expected name.
    """
    from vtbdrake.testing.check import CheckFailedError, CheckSkippedError, checked_expectations
    from vtbdrake.testing.checks import CHECKS
    from vtbdrake.testing.subject import Subject

    cases = []
    for number, scenario in enumerate(scenarios):
        expected = checked_expectations(_of(scenario, expected_failed_checks))
        subject = Subject(scenario, values=_of(scenario, values), horizon=horizon)
        for check in CHECKS:

            def run(scenario: Scenario, check: Any = check, subject: Subject = subject) -> None:
                error = subject.outcome(check)
                if isinstance(error, CheckSkippedError):
                    pytest.skip(str(error))
                if error is not None:
                    raise error

            name = check.__name__
            marks = []
            if name in expected:
                marks.append(pytest.mark.xfail(reason=expected[name], raises=CheckFailedError, strict=True))
            cases.append(pytest.param(scenario, run, id=f"{type(scenario).__name__}{number}-{name}", marks=marks))
    return pytest.mark.parametrize(("scenario", "check"), cases)


def _of(
    scenario: Scenario, items: Mapping[str, Any] | Callable[[Scenario], Mapping[str, Any]] | None
) -> Mapping[str, Any] | None:
    return items(scenario) if callable(items) else items
