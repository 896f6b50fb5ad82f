"""Compares a compiled Diagram with the Diagram itself, as Drake's Simulator advances it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.systems.analysis import InitializeParams, Simulator, SimulatorStatus
from pydrake.systems.framework import Context

from vtbdrake.common.arrays import Array
from vtbdrake.compiled.equations import Equations
from vtbdrake.compiled.schedule import Instant
from vtbdrake.compiled.state_vector import DOUBT, ENDING, ENDING_TIME
from vtbdrake.compiled.walker import Walker
from vtbdrake.state.declarations import DISCRETE

if TYPE_CHECKING:
    from vtbdrake.compiled.compiled_rollouts import CompiledRollouts

LOOSE_TOLERANCE = 1e-9
"""The largest difference of an output along a rollout that hardly depends on its begin.

In others, what rounding makes grows: a rollout may differ by 100 times as much as one that begins `_ASIDE` beside it
has differed so far.
"""

# The share of the state by which a second rollout begins beside the first one, far above rounding.
_ASIDE = 1e-12

_TRIALS = 2
# The number of steps from beside a state, and how many times their spread a difference may be that rounding makes.
_TRIALS_ASIDE = 8
_MOST_OF_SPREAD = 3.0
_MOST_UPDATES = 60
_SPREAD = 0.02


class CompiledDifferenceError(ArithmeticError):
    """A compiled Diagram does something else than the Diagram itself."""


def check_rollouts(rollouts: CompiledRollouts, context: Context) -> None:
    """Compare random rollouts near a context, step by step.

    Args:
        rollouts: The compiled rollouts.
        context: A root context of the Diagram, around which states and parameters are drawn; it is left as it is.

    Raises:
        CompiledDifferenceError: They differ; the system and the time are named.
    """
    walker = rollouts.walker
    random = np.random.default_rng(0)
    for trial in range(_TRIALS):
        begin = context.Clone()
        if trial:
            walker.write(_near(walker, walker.read(begin), random, _SPREAD), begin)
        compare(rollouts, begin)


def compare(rollouts: CompiledRollouts, begin: Context, *, updates: int = _MOST_UPDATES) -> float:
    """Compare one rollout from a root context with Drake's, and return the largest difference after one step.

    Each step begins with Drake's state; `Equations.agreement` tells how near it must come, unless rounding decides the
    step. Beside that, what the whole rollout records is compared, loosely: in a fast or chaotic testbed, rounding
    grows. It is not compared where a step with contact is as good as its iteration.

    Args:
        rollouts: The compiled Diagram.
        begin: Where the rollout begins.
        updates: How many instants are compared.

    Raises:
        CompiledDifferenceError: They differ.
    """
    walker = rollouts.walker
    agreement = max((equations.agreement for equations in walker.equations.values()), default=Equations.agreement)
    z = walker.read(begin)
    batch = rollouts.from_z(np.array([z, _near(walker, z, np.random.default_rng(1), _ASIDE)]), begin.get_time())
    simulator = Simulator(walker.systems.diagram, begin.Clone())
    simulator.Initialize(InitializeParams(suppress_initialization_events=True))
    sample, largest, growth = 0, 0.0, 0.0
    before: tuple[Array, Instant] = z, Instant(begin.get_time(), False, ())
    for instant in rollouts.schedule_at(begin.get_time())[:updates]:
        message = walker.message(z[ENDING], z[ENDING_TIME])
        if instant.time > begin.get_time():  # Else, the updates of the first instant would happen.
            status = simulator.AdvanceTo(instant.time)
            if status.reason() != SimulatorStatus.ReturnReason.kReachedBoundaryTime:
                if message != status.FormatMessage():
                    raise CompiledDifferenceError(
                        f"the Diagram ends its simulation, and what is compiled does not: {status.FormatMessage()}; "
                        "keep this testbed in Drake"
                    )
                break
        if message:
            raise CompiledDifferenceError(
                f"what is compiled ends the simulation, and the Diagram does not: {message}; keep this testbed in Drake"
            )
        if z[DOUBT] > 0.0:
            break  # The plant has felt a joint stop, for example.
        state = simulator.get_context()
        expected = walker.read(state)
        try:
            largest = max(largest, _difference(walker, z, expected, instant.time))
        except CompiledDifferenceError:
            if not _hangs_on_rounding(rollouts, before, expected):
                raise
        if instant.is_sample:
            values, doubt = rollouts.recorded(expected, instant)
            if doubt > 0.0:
                break
            for address in rollouts.outputs:
                expected_value = rollouts.read(address, state)
                along, aside = batch.outputs[address][:, sample]
                growth = max(growth, _relative(aside, along))
                difference = _output_difference(address, values[address], expected_value, instant.time, agreement)
                largest = max(largest, difference)
                if agreement < LOOSE_TOLERANCE:
                    loose = LOOSE_TOLERANCE + 100.0 * growth
                    _output_difference(address, along, expected_value, instant.time, loose)
            sample += 1
        before = expected, instant
        z = rollouts.advanced(expected, instant)
    return largest


def _hangs_on_rounding(rollouts: CompiledRollouts, step: tuple[Array, Instant], expected: Array) -> bool:
    """Return whether rounding decides a step, such as at a foot that is placed on the ground: does it touch?

    Then steps from beside the same state differ about as much as the Diagram's does.

    Args:
        rollouts: The compiled Diagram.
        step: The vector z before the step, and its instant.
        expected: The Diagram's vector z after it.
    """
    (z, instant), walker, random = step, rollouts.walker, np.random.default_rng(2)
    here = rollouts.advanced(z, instant)
    spread = [rollouts.advanced(_near(walker, z, random, _ASIDE), instant) for _ in range(_TRIALS_ASIDE)]
    for block in walker.vector.blocks.values():
        if block.kind == DISCRETE:
            difference = _relative(here[block.entries], expected[block.entries])
            largest = max(_relative(each[block.entries], here[block.entries]) for each in spread)
            if difference > walker.equations[block.path].agreement and difference > _MOST_OF_SPREAD * largest:
                return False
    return True


def _output_difference(address: str, value: Any, expected: Any, time: float, tolerance: float) -> float:
    difference = _relative(value, expected)
    if not difference <= tolerance:
        raise CompiledDifferenceError(
            f"the compiled {address} differs from the Diagram's by {difference:.2g} at t = {time:g} s: keep this "
            "testbed in Drake"
        )
    return difference


def _difference(walker: Walker, z: Array, expected: Array, time: float) -> float:
    largest = 0.0
    for block in walker.vector.blocks.values():
        if block.kind == DISCRETE:
            difference = _relative(z[block.entries], expected[block.entries])
            if not difference <= walker.equations[block.path].agreement:
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


def _near(walker: Walker, z: Array, random: np.random.Generator, spread: float) -> Array:
    """Return another vector of state and parameters, a share of it from z; what is compiled in stays."""
    near = z.copy()
    for block in walker.vector.blocks.values():
        if block.kind == DISCRETE:
            part = near[block.entries]
            finite = np.where(np.isfinite(part), part, 0.0)  # No decision has an infinite time, for example.
            part += spread * (1.0 + np.abs(finite)) * random.uniform(-1.0, 1.0, part.size)
    return near
