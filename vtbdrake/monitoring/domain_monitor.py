"""The validity domain beside the loop: a watcher that says once when the machine leaves it."""

from __future__ import annotations

import logging

import numpy as np

from vtbdrake.common.closing import Closing
from vtbdrake.common.failures import FAILURES
from vtbdrake.common.validity_domain import Departure, DomainWatch, ValidityDomain
from vtbdrake.control.fault import FaultKind
from vtbdrake.control.runtime import Runtime
from vtbdrake.control.stepping import Cycle

_log = logging.getLogger(__name__)


class DomainMonitor(Closing):
    """Watches a loop, and says once when its DPS leaves the validity domain of its model.

    It watches from its construction until `close`. Once per window of the domain, after the cycle's commands were sent,
    it reads the features and compares them with the hold-out windows. It changes nothing: what follows from a departure
    is the user's rule.

    Args:
        runtime: The loop.
        domain: The validity domain of the model by which the DPS reasons.

    Attributes:
        departure: How the domain was left; None while it was not.

    Raises:
        AddressError: The loop's target lacks an address of the domain.
    """

    def __init__(self, runtime: Runtime, domain: ValidityDomain) -> None:
        self.departure: Departure | None = None
        self._runtime = runtime
        self._watch = DomainWatch(domain)
        self._readers = [runtime.target.reader(address) for address in domain.addresses]
        self._every = max(round(domain.window / runtime.period), 1)
        runtime.watch(self)

    @property
    def windows(self) -> int:
        """Return the number of windows so far."""
        return self._watch.windows

    @property
    def outside(self) -> int:
        """Return the number of windows outside."""
        return self._watch.outside

    def __call__(self, cycle: Cycle) -> None:
        """Take one cycle, as a watcher of the runtime."""
        raised = any(fault.kind == FaultKind.RAISED for fault in cycle.verdict.faults)
        if cycle.number % self._every or self._runtime.idle or raised:
            return
        try:
            values = [np.ravel(read(self._runtime.context)) for read in self._readers]
        except FAILURES:  # A port whose system raises: the step reports it.
            return
        departure = self._watch.add(cycle.time, np.concatenate(values))
        if departure is not None:
            self.departure = departure
            _log.warning("%s", departure)

    def close(self) -> None:
        """End the monitor."""
        self._runtime.unwatch(self)
