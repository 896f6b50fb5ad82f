"""Compares a compiled Diagram with the Diagram itself, as Drake's Simulator advances it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.systems.analysis import InitializeParams, Simulator, SimulatorStatus
from pydrake.systems.framework import Context

from vtbdrake.arrays import Array
from vtbdrake.compiled.walker import Walker
from vtbdrake.state.declarations import DISCRETE

if TYPE_CHECKING:
    from vtbdrake.compiled.rollouts import CompiledRollouts

TOLERANCE = 1e-11
"""The largest difference of an entry of the state, relative to the largest entry of its system, or to 1."""

_TRIALS = 2
_MOST_UPDATES = 60
_SPREAD = 0.02


class CompiledDifferenceError(ArithmeticError):
    """A compiled Diagram does something else than the Diagram itself."""


def check_rollouts(rollouts: CompiledRollouts, context: Context) -> None:
    """Compare random rollouts near a context, step by step.

    Raises:
        CompiledDifferenceError: They differ; the system and the time are named.
    """
    walker = rollouts.walker
    random = np.random.default_rng(0)
    for trial in range(_TRIALS):
        begin = context.Clone()
        if trial:
            walker.write(_near(walker, walker.read(begin), random), begin)
        compare(rollouts, begin)


def compare(rollouts: CompiledRollouts, begin: Context, *, updates: int = _MOST_UPDATES) -> float:
    """Compare one rollout from a root context with Drake's, and return the largest difference.

    Args:
        rollouts: The compiled Diagram.
        begin: Where the rollout begins.
        updates: How many instants are compared state by state; then only what is recorded at the samples so far.

    Raises:
        CompiledDifferenceError: They differ by more than `TOLERANCE`.
    """
    walker = rollouts.walker
    batch = rollouts.from_z(walker.read(begin)[np.newaxis], begin.get_time())
    simulator = Simulator(walker.diagram, begin.Clone())
    simulator.Initialize(InitializeParams(suppress_initialization_events=True))
    z, sample, largest = walker.read(begin), 0, 0.0
    for instant in rollouts.schedule_at(begin.get_time())[:updates]:
        if instant.time > begin.get_time():  # Else, the updates of the first instant would happen.
            status = simulator.AdvanceTo(instant.time)
            if status.reason() != SimulatorStatus.ReturnReason.kReachedBoundaryTime:
                raise CompiledDifferenceError(
                    f"the Diagram ends its simulation, which is not compiled: {status.FormatMessage()}; keep this "
                    "testbed in Drake"
                )
        state = simulator.get_context()
        if rollouts.is_beyond(z):
            break  # The plant feels a joint stop.
        largest = max(largest, _difference(walker, z, walker.read(state), instant.time))
        if instant.is_sample:
            for address, values in batch.outputs.items():
                if address in rollouts.outputs:
                    expected = rollouts.read(address, state)
                    difference = _relative(values[0, sample], expected)
                    if not difference <= TOLERANCE:
                        raise CompiledDifferenceError(
                            f"the compiled {address} differs from the Diagram's by {difference:.2g} at t = "
                            f"{instant.time:g} s: keep this testbed in Drake"
                        )
                    largest = max(largest, difference)
            sample += 1
        z = rollouts.advanced(z, instant)
    return largest


def _difference(walker: Walker, z: Array, expected: Array, time: float) -> float:
    largest = 0.0
    for block in walker.blocks.values():
        if block.kind == DISCRETE:
            difference = _relative(z[block.entries], expected[block.entries])
            if not difference <= TOLERANCE:
                raise CompiledDifferenceError(
                    f"the compiled state of {block.path} differs from the Diagram's by {difference:.2g} at t = "
                    f"{time:g} s: {z[block.entries]} instead of {expected[block.entries]}; keep this testbed in Drake"
                )
            largest = max(largest, difference)
    return largest


def _relative(value: Any, expected: Any) -> float:
    value, expected = np.ravel(value), np.ravel(expected)
    if np.array_equal(value, expected, equal_nan=True):
        return 0.0
    finite = np.abs(expected[np.isfinite(expected)])
    differences = np.abs(value - expected)[~((value == expected) | (np.isnan(value) & np.isnan(expected)))]
    largest = float(np.max(differences) / max(1.0, *finite.tolist(), 0.0))
    return largest if np.isfinite(largest) else np.inf


def _near(walker: Walker, z: Array, random: np.random.Generator) -> Array:
    """Return another vector of state and parameters near z; what is compiled in stays."""
    near = z.copy()
    for block in walker.blocks.values():
        if block.kind == DISCRETE:
            part = near[block.entries]
            finite = np.where(np.isfinite(part), part, 0.0)  # No decision has an infinite time, for example.
            part += _SPREAD * (1.0 + np.abs(finite)) * random.uniform(-1.0, 1.0, part.size)
    return near
