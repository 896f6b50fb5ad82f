"""Checks of a scenario: how they are run, and what they report."""

from __future__ import annotations

import inspect
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vtbdrake.common.argument_checks import suggestion
from vtbdrake.testing.checks import CHECKS
from vtbdrake.testing.subject import CheckSkippedError, Subject

if TYPE_CHECKING:
    from vtbdrake.testbed import Scenario

# Pytest shows none of the frames of this module: what a check has found is its message.
__tracebackhide__ = True


class ScenarioCheckError(AssertionError):
    """Checks of a scenario failed that were not expected to, or passed that were expected to fail.

    Attributes:
        report: The results of all checks.
    """

    def __init__(self, report: Report) -> None:
        super().__init__(str(report))
        self.report = report


@dataclass(frozen=True)
class CheckResult:
    """The result of one check.

    Attributes:
        name: Name of the check.
        status: ``passed``, ``failed``, ``skipped``, ``xfail`` (failed, as expected) or ``xpass`` (passed, although it
            was expected to fail).
        message: What is wrong, where, and the remedy; of a skipped check, the reason.
        reason: The reason for which the check was expected to fail; empty if it was not.
        seconds: Processor time of the check, with its threads, in seconds.
    """

    name: str
    status: str
    message: str
    reason: str
    seconds: float

    def __str__(self) -> str:
        lines = [f"{self.status:8}{self.name} ({self.seconds:.2f} s)"]
        if self.reason:
            lines.append(f"expected to fail: {self.reason}")
        if self.message:
            lines.append(self.message)
        if self.status == "xpass":
            lines.append("it passes: take it off expected_failed_checks")
        return "\n        ".join(lines)


class Report(tuple[CheckResult, ...]):
    """The results of the checks of one scenario; prints as a list of them."""

    @property
    def ok(self) -> bool:
        """Return whether every check passed, was skipped, or failed as expected."""
        return not any(result.status in ("failed", "xpass") for result in self)

    def __str__(self) -> str:
        counts = Counter(result.status for result in self)
        slowest = max(self, key=lambda result: result.seconds)
        summary = (
            f"{len(self)} checks: {', '.join(f'{count} {status}' for status, count in counts.items())}; "
            f"{sum(result.seconds for result in self):.1f} s of processor time, "
            f"{slowest.seconds:.1f} s of them for {slowest.name}"
        )
        return "\n".join([*map(str, self), summary])


def check_names() -> dict[str, str]:
    """Return the names of all checks, with the first line of what each asks for."""
    return {check.__name__: (inspect.getdoc(check) or "").partition("\n")[0] for check in CHECKS}


def checked_expectations(expected_failed_checks: Mapping[str, str] | None) -> dict[str, str]:
    """Return ``expected_failed_checks`` as a dictionary.

    Raises:
        ValueError: There is no check of such a name, or a reason is empty.
    """
    expected, names = dict(expected_failed_checks or {}), check_names()
    for name, reason in expected.items():
        if name not in names:
            raise ValueError(f"there is no check {name!r}{suggestion(name, names)}")
        if not isinstance(reason, str) or not reason:
            raise ValueError(f"say in a sentence why {name} is expected to fail, instead of {reason!r}")
    return expected


def check_scenario(
    scenario: Scenario,
    *,
    expected_failed_checks: Mapping[str, str] | None = None,
    values: Mapping[str, Any] | None = None,
    horizon: float | None = None,
) -> Report:
    """Put a scenario through all checks, and return their results.

    Args:
        scenario: The scenario.
        expected_failed_checks: Name of a check -> the reason why it fails.
        values: Address -> value, set before every simulation: a command that lets the robot move, say. Where nothing
            moves, nothing can differ.
        horizon: Seconds that are simulated; by default, as many as take a fifth of a second of processor time, up to
            2 s.

    Raises:
        ScenarioCheckError: A check failed that was not expected to, or passed although it was expected to fail.
        ValueError: ``scenario`` is no scenario, or there is no check of an expected name, or no variable of an address.
    """
    expected = checked_expectations(expected_failed_checks)
    report = Report(_results(Subject(scenario, values=values, horizon=horizon), expected))
    if not report.ok:
        raise ScenarioCheckError(report)
    return report


def _results(subject: Subject, expected: Mapping[str, str]) -> Iterator[CheckResult]:
    for check in CHECKS:
        name = check.__name__
        begin = time.process_time()
        error = subject.outcome(check)
        seconds = time.process_time() - begin
        if isinstance(error, CheckSkippedError):
            status = "skipped"
        elif name in expected:
            status = "xpass" if error is None else "xfail"
        else:
            status = "passed" if error is None else "failed"
        yield CheckResult(name, status, "" if error is None else str(error), expected.get(name, ""), seconds)
