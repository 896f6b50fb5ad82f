"""Start: where a rollout begins, as light data for runners and workers whose testbeds are built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context

from vtbdrake.state import AddressError, SnapshotError, VariableError
from vtbdrake.state.layout import FlatState, StateLayout, difference
from vtbdrake.state.snapshot import StateCopier
from vtbdrake.testbed import VirtualTestbed
from vtbdrake.testbed.switch import COMMAND


class StartError(ValueError):
    """A start that does not fit the testbed of a rollout."""


@dataclass(frozen=True, eq=False, repr=False)
class Start:
    """Where a rollout begins: s0 as plain data that pickles quickly, for testbeds that are built already.

    A runner sets its testbed to a start and builds nothing. The task of the rollouts stays the same, so that only the
    start is sent to workers. Everything that a start does not hold is as in the task's own s0. All switches are thrown
    to sim, as in every copy of a running robot, and initialization events, which have happened, do not happen again.

    Attributes:
        time: Time t0 at which the rollout begins, in seconds.
        contents: Contents of systems of the testbed, in one of its layouts: ``dps_layout``, ``start_layout`` or
            ``whole_layout``.
        values: Address -> value to set in addition, for example commands u.
    """

    time: float
    contents: FlatState
    values: Mapping[str, ArrayLike] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.contents, FlatState):
            raise StartError(f"a start holds the contents of a testbed's systems, not {self.contents!r}: see Start.of")
        if not np.isfinite(self.time):
            raise StartError(f"a rollout begins at a finite time, not at {self.time} s")

    def __repr__(self) -> str:
        systems = len({name.partition("/")[0] for name in self.contents.names})
        return f"Start(t0={self.time:g} s, {systems} systems, {self.contents.numbers.size} numbers)"

    @classmethod
    def of(cls, testbed: VirtualTestbed, context: Context) -> Start:
        """Return s(t) of a whole testbed as a start: its DPS, its simulated world and all parameters.

        The future of a running simulation equals a rollout from it as described at `AddressedDiagram.fork`.

        Args:
            testbed: The testbed.
            context: Its root context.

        Raises:
            ValueError: The context belongs to another testbed.
        """
        testbed.check_context(context)
        carried = [v for a, v in testbed.variables().items() if (v.hidden or a.startswith(COMMAND)) and not v.derived]
        values = {variable.address: variable.get(context) for variable in carried}
        return cls(context.get_time(), testbed.whole_layout.take(context), values)


# Where rollouts begin: one start for all, or one for each; None is the task's own s0.
Starts = Start | Sequence[Start] | None


class StartContext:
    """The context from which the rollouts of one runner begin; it is set to one start after another.

    Args:
        testbed: The testbed of the rollouts.
        default: The task's own s0, for everything that a start does not hold.
        copier: Copies between contexts of the testbed.

    Attributes:
        start: The present start; None is the task's own s0.
        context: Where the next rollout begins.
        hidden: Addresses of the hidden variables that any start so far has set.
    """

    def __init__(self, testbed: VirtualTestbed, default: Context, copier: StateCopier) -> None:
        self._testbed = testbed
        self._default = default
        self._copier = copier
        self._variables = testbed.variables()
        self._written_context: Context | None = None
        # The layout and the addresses of the last start that was written into it.
        self._last: tuple[StateLayout, frozenset[str]] | None = None
        self.start: Start | None = None
        self.context = default
        self.hidden: set[str] = set()

    def set(self, start: Start | None) -> None:
        """Begin at ``start``; None begins at the task's s0.

        Raises:
            StartError: The start does not fit the testbed. The next rollout begins at the task's s0 then.
        """
        if start is self.start:
            return
        self.start, self.context = None, self._default
        if start is not None:
            self.context = self._written(start)
            self.start = start

    def _written(self, start: Start) -> Context:
        layout = self._layout(start.contents)
        if self._written_context is None:
            self._written_context = self._testbed.default_context()
        last, self._last = self._last, None
        coverage = layout, frozenset(start.values)
        if last != coverage:  # Otherwise this start overwrites everything that the last one has set.
            self._copier.copy(self._default, self._written_context)
            self._testbed.switch(self._written_context, "sim")
        self._written_context.SetTime(start.time)
        try:
            self.hidden |= {self._variables[address].carried_by for address in start.values} - {""}
            layout.put(self._written_context, start.contents)
            self._variables.write(self._written_context, self._changes(start, self._written_context))
        except (AddressError, VariableError, SnapshotError) as error:
            raise StartError(f"the start does not fit: {error}") from error
        self._last = coverage
        return self._written_context

    def _layout(self, contents: FlatState) -> StateLayout:
        testbed = self._testbed
        layouts = testbed.start_layout, testbed.whole_layout, testbed.dps_layout
        for layout in layouts:
            if layout.names == contents.names:
                return layout
        nearest = min(layouts, key=lambda layout: len(set(layout.names) ^ set(contents.names)))
        raise StartError(
            f"the start is of another testbed than {testbed.scenario!r}, in which it is to begin: "
            f"{difference(contents.names, nearest.names)}"
        )

    def _changes(self, start: Start, context: Context) -> dict[str, Any]:
        # Writing a hidden variable invalidates the caches of SceneGraph and cameras.
        variables = {address: self._variables[address] for address in start.values}
        return {
            address: value
            for address, value in start.values.items()
            if not variables[address].hidden or not np.array_equal(variables[address].get(context), value)
        }


def start_of_each(start: Starts, count: int) -> list[Start | None]:
    """Return the start of each of ``count`` rollouts.

    Args:
        start: One for all, or one for each; None is the task's own s0.
        count: The number of rollouts.

    Raises:
        StartError: It is no start, or there are too many or too few.
    """
    starts: list[Start | None] = list(start) if isinstance(start, Sequence) else [start] * count
    for each in starts:
        if not isinstance(each, Start | None):
            raise StartError(f"a rollout begins at a Start, such as Start.of(testbed, context), not at {each!r}")
    if len(starts) != count:
        raise StartError(f"give one start for all rollouts, or one for each of the {count}, not {len(starts)}")
    return starts
