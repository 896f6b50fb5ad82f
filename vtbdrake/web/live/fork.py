"""A copy of a running simulation that goes on by itself."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.control.limits import Bounds
from vtbdrake.testbed.switch import COMMAND, T_ACT, T_SENSE

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray
    from pydrake.systems.framework import Context

    from vtbdrake.state import Snapshot, Variable
    from vtbdrake.testbed import VirtualTestbed

# Two values are different if they differ by more than this share of their size,
_RELATIVE = 1e-6
# or by more than this, in their unit.
_ABSOLUTE = 1e-9


class Simulation:
    """A context of a testbed that is simulated.

    Args:
        testbed: The testbed; the simulation has a context of its own.
        start: The state from which it goes on; None: s0, which is initialized.
        values: Variables that are set first, by address.

    Attributes:
        context: The context.
        is_recorded: False: its states do not come from a log.
        ended: Empty: it can always go on.

    Raises:
        ValueError: There is no such variable, or it does not take the value.
    """

    is_recorded = False
    ended = ""

    def __init__(
        self, testbed: VirtualTestbed, start: Snapshot | None, values: Mapping[str, ArrayLike] | None = None
    ) -> None:
        self._testbed = testbed
        self.context: Context = testbed.default_context()
        if start is not None:
            testbed.restore(self.context, start)
        testbed.write(self.context, values or {})
        self._simulator = testbed.simulator(self.context, restored=start is not None)
        if start is None:
            self._simulator.Initialize()

    @property
    def world(self) -> Context:
        """Return the context whose world is drawn."""
        return self.context

    @property
    def time(self) -> float:
        """Return the time, in seconds."""
        return float(self.context.get_time())

    def advance_to(self, time: float) -> None:
        """Simulate until ``time``."""
        self._simulator.AdvanceTo(time)

    def what_if(self) -> Snapshot:
        """Return the state of another simulation that goes on from here."""
        return self._testbed.snapshot(self.context)

    def fork(self) -> Snapshot:
        """Return the state of another simulation with the course of this one, see `VirtualTestbed.fork`."""
        return self._testbed.fork(self._simulator)


class Fork(Simulation):
    """A copy of the simulation of a testbed, from a snapshot on, that may fail.

    Args:
        testbed: The testbed; the fork has a context of its own.
        snapshot: The state from which it goes on.
        values: Variables that are set first, by address.

    Attributes:
        failure: Why its simulation has ended; empty while it goes on.

    Raises:
        ValueError: There is no such variable, or it does not take the value.
    """

    def __init__(
        self, testbed: VirtualTestbed, snapshot: Snapshot, values: Mapping[str, ArrayLike] | None = None
    ) -> None:
        super().__init__(testbed, snapshot, values)
        self.failure = ""

    def advance_to(self, time: float) -> None:
        """Simulate until ``time``; a simulation that fails stays where it stands, and `failure` tells why."""
        if self.failure or time <= self.time:
            return
        try:
            super().advance_to(time)
        except FAILURES as error:
            self.failure = one_line(error)


class CommandLimits:
    """The limits of a DPS's vector commands, applied in any context of its testbed."""

    def __init__(self, testbed: VirtualTestbed) -> None:
        self._dps = testbed.dps
        self._bounds = {signal.name: Bounds(signal) for signal in testbed.interface.act if signal.is_vector}
        self._ports = {name: testbed.dps.GetOutputPort(name) for name in self._bounds}

    def violations(self, context: Context) -> list[str]:
        """Return a sentence for each command that its limits would refuse on a machine."""
        dps_context = self._dps.GetMyContextFromRoot(context)
        reasons = {name: bounds.violation(self._ports[name].Eval(dps_context)) for name, bounds in self._bounds.items()}
        return [f"the command {name} is refused: {reason}" for name, reason in reasons.items() if reason]


@dataclass(frozen=True)
class VariableDifference:
    """A variable that differs between two simulations.

    Attributes:
        address: Its address.
        time: When it differed first, in seconds.
    """

    address: str
    time: float


class Differences:
    """Finds the variables that differ between two contexts of a testbed, and when each did so first.

    Args:
        testbed: The testbed of both contexts.
        only: Predicate of an address that selects what is compared; by default all.

    Attributes:
        first: The differences, in the order of their times.
    """

    def __init__(self, testbed: VirtualTestbed, *, only: Callable[[str], bool] = lambda address: True) -> None:
        self._only = only
        self._layout = testbed.whole_layout
        # The address of each number; empty where variables are computed from several: `_computed` are compared then.
        self._address = np.full(self._layout.size, "", dtype=object)
        self._computed: dict[str, Variable] = {}
        # What the layout does not hold: commands u and switches.
        self._boards: dict[str, Variable] = {}
        for address, variable in testbed.variables().items():
            if (place := self._layout.slice_of(variable)) is not None:
                self._address[place] = address
            elif address.startswith((COMMAND, T_SENSE, T_ACT)):
                self._boards[address] = variable
            elif not variable.derived:
                self._computed[address] = variable
        self._differed = np.zeros(self._layout.size, dtype=bool)
        self.first: list[VariableDifference] = []

    def compare(self, ours: Context, theirs: Context) -> None:
        """Compare the two contexts, which stand at the same time.

        Args:
            ours: A root context of the testbed.
            theirs: Another one, at the same time.
        """
        differ = ~_close(self._layout.take(ours).numbers, self._layout.take(theirs).numbers) & ~self._differed
        self._differed |= differ
        addresses = set(self._address[differ])
        addresses |= {a for a, v in self._boards.items() if not np.all(_close(v.get(ours), v.get(theirs)))}
        if "" in addresses:
            addresses |= {a for a, v in self._computed.items() if not np.all(_close(v.get(ours), v.get(theirs)))}
        addresses -= {"", *(difference.address for difference in self.first)}
        self.first += [VariableDifference(a, float(ours.get_time())) for a in sorted(addresses) if self._only(a)]


def _close(a: ArrayLike, b: ArrayLike) -> NDArray[np.bool_]:
    return np.isclose(a, b, rtol=_RELATIVE, atol=_ABSOLUTE, equal_nan=True)
