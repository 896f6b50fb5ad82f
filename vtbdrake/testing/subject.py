"""The subject of checks: a scenario, and what the checks of it share."""

from __future__ import annotations

from functools import cached_property

from vtbdrake.failures import FAILURES, error_text
from vtbdrake.testbed import Scenario, VirtualTestbed
from vtbdrake.testbed.scenario import check_is_scenario
from vtbdrake.testing.check import CheckSkippedError


class Subject:
    """A scenario under test. What several checks need is made once, when the first of them asks for it.

    Args:
        scenario: The scenario.
        horizon: Seconds that are simulated; None: as many as take a fifth of a second of processor time.

    Attributes:
        scenario: The scenario.
    """

    def __init__(self, scenario: Scenario, *, horizon: float | None = None) -> None:
        check_is_scenario(scenario)
        self.scenario = scenario
        self._horizon = horizon

    @cached_property
    def built(self) -> VirtualTestbed | BaseException:
        """Return the testbed, or the error for which it cannot be built."""
        try:
            return self.scenario.build()
        except FAILURES as error:
            return error

    @property
    def testbed(self) -> VirtualTestbed:
        """Return the testbed that checks share.

        Raises:
            CheckSkippedError: It cannot be built.
        """
        if not isinstance(self.built, VirtualTestbed):
            raise CheckSkippedError(f"the testbed cannot be built: {error_text(self.built)}")
        return self.built
