"""Mutants of a scenario: the mistakes that one makes in wiring a diagram, and the share that its tests notice."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import degrees
from typing import Any

import numpy as np
from pydrake.systems.framework import System
from pydrake.systems.primitives import Gain, MatrixGain, ZeroOrderHold

from vtbdrake.common.failures import error_text
from vtbdrake.state.variables import entry_units
from vtbdrake.testbed import DpsAlone, Scenario, Signal, VirtualTestbedBuilder
from vtbdrake.testbed.parts import WorldAlone

SENSE = "sense"
ACT = "act"
WORLD = "world"

_FOR_EVER = 1e9  # s, the period of a sensor that is stuck


@dataclass(frozen=True)
class Mutant:
    """One mistake in a diagram.

    Attributes:
        kind: One of `KINDS`, or ``gravity off``.
        side: ``sense`` or ``act``, where a signal is changed; ``world``.
        signal: The name of the signal; empty for the world.
        period: The sample period of the DPS, in seconds.
    """

    kind: str
    side: str
    signal: str = ""
    period: float = 0.0

    def __str__(self) -> str:
        return f"{self.side}.{self.signal}: {self.kind}" if self.signal else f"{self.side}: {self.kind}"

    def change(self, builder: VirtualTestbedBuilder) -> None:
        """Make the mistake in a simulated world whose sensors and actuators have been added."""
        if self.side == WORLD:
            assert builder.plant is not None
            builder.plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
            return
        signals = {signal.name: signal for signal in getattr(builder.interface, self.side)}
        system = KINDS[self.kind](signals[self.signal], self)
        assert system is not None
        builder.add(self.side, f"mutant_{self.signal}", system)
        if self.side == SENSE:
            builder.connect(builder.sensors[self.signal], system.get_input_port())
            builder.sensors[self.signal] = system.get_output_port()
        else:
            builder.connect(system.get_output_port(), builder.actuators[self.signal])
            builder.actuators[self.signal] = system.get_input_port()


def _swapped(signal: Signal, mutant: Mutant) -> System | None:
    if signal.size is None or signal.size < 2:
        return None
    order = np.arange(signal.size)
    order[:2] = 1, 0
    return MatrixGain(np.eye(signal.size)[order])


def _sign(signal: Signal, mutant: Mutant) -> System | None:
    return None if signal.size is None else Gain(-1.0, signal.size)


def _degrees(signal: Signal, mutant: Mutant) -> System | None:
    units = entry_units(signal.unit, (signal.size or 0,))
    angles = [unit.split("/")[0] == "rad" for unit in units]
    # Entries of several units have none of their own where the groups are not equal.
    if not any(angles) or any(", " in unit for unit in units):
        return None
    return Gain([degrees(1.0) if angle else 1.0 for angle in angles])


def _late(signal: Signal, mutant: Mutant) -> System | None:
    return ZeroOrderHold(mutant.period, signal.size if signal.is_vector else signal.abstract_value())


def _half(signal: Signal, mutant: Mutant) -> System | None:
    return Gain(0.5, signal.size) if signal.size is not None and mutant.side == ACT else None


def _stuck(signal: Signal, mutant: Mutant) -> System | None:
    if mutant.side != SENSE:
        return None
    return ZeroOrderHold(_FOR_EVER, signal.size if signal.is_vector else signal.abstract_value())


KINDS: dict[str, Callable[[Signal, Mutant], System | None]] = {
    "two entries swapped": _swapped,
    "the opposite sign": _sign,
    "degrees for radians": _degrees,
    "a sample later": _late,
    "half the gain": _half,
    "stuck": _stuck,
}
"""Functions that return the system of a mistake, which is put between the simulated world and the switch of a signal;
None where it cannot be made. A sensor that is stuck shows its first value."""


def mutants_of(scenario: Scenario) -> list[Mutant]:
    """Return the mutants of a scenario: every kind of mistake at every signal where it can be made, and gravity off."""
    interface = scenario.interface()
    periods = [period for period, _ in DpsAlone(scenario).event_timings()]
    period = min(periods, default=scenario.deployment().period)
    changes = [
        Mutant(kind, side, signal.name, period)
        for side, signals in ((SENSE, interface.sense), (ACT, interface.act))
        for signal in signals
        for kind in KINDS
    ]
    signals_by_side = {side: {s.name: s for s in getattr(interface, side)} for side in (SENSE, ACT)}
    made = [m for m in changes if KINDS[m.kind](signals_by_side[m.side][m.signal], m) is not None]
    plant = WorldAlone(scenario).plant
    if plant is not None and plant.gravity_field().gravity_vector().any():
        made.append(Mutant("gravity off", WORLD))
    return made


def mutate(scenario: Scenario, mutant: Mutant) -> Scenario:
    """Return a copy of a scenario in whose simulated world a mistake is made, in this process and in others.

    It is of a subclass of the scenario's class. A mutated scenario returns itself.

    Args:
        scenario: The scenario; it stays as it is.
        mutant: The mistake, which changes the builder of the simulated world.
    """
    if hasattr(scenario, "mutant"):
        return scenario
    kind = type(scenario)

    def add_world(self: Scenario, builder: VirtualTestbedBuilder) -> None:
        kind.add_world(self, builder)
        mutant.change(builder)

    def reduce(self: Scenario, protocol: Any) -> Any:
        return mutate, (_with_class(self, kind), mutant)

    names = {"__module__": kind.__module__, "__qualname__": kind.__qualname__, "__doc__": kind.__doc__}
    body = {**names, "add_world": add_world, "__reduce_ex__": reduce, "mutant": mutant}
    return _with_class(scenario, type(kind.__name__, (kind,), body))


def _with_class(scenario: Scenario, kind: type[Scenario]) -> Scenario:
    copied = object.__new__(kind)
    vars(copied).update(vars(scenario))
    return copied


@dataclass(frozen=True)
class MutationScore:
    """Which mutants the tests notice.

    Attributes:
        killed: The reason by mutant: the test that failed, and its error.
        survived: The mutants with which all tests passed.
    """

    killed: dict[Mutant, str] = field(default_factory=dict)
    survived: list[Mutant] = field(default_factory=list)

    @property
    def share(self) -> float:
        """Return the share of the mutants that the tests notice; 1 if there are none."""
        count = len(self.killed) + len(self.survived)
        return len(self.killed) / count if count else 1.0

    def __str__(self) -> str:
        count = len(self.killed) + len(self.survived)
        lines = [f"{len(self.killed)} of {count} mutants killed ({100.0 * self.share:.0f} %)"]
        lines += [f"survived: {mutant}" for mutant in self.survived]
        return "\n".join([*lines, *(f"killed: {mutant}, by {reason}" for mutant, reason in self.killed.items())])


def mutation_score(
    tests: Callable[[Scenario], object] | Iterable[Callable[[Scenario], object]], scenario: Scenario
) -> MutationScore:
    """Return the score of tests by the mutants of a scenario that they notice, see pytest's ``--vtb-mutants``.

    Args:
        tests: Functions of a scenario that raise if something is wrong with it.
        scenario: The scenario, with which they pass.

    Raises:
        Exception: A test fails without a mutant.
    """
    tests = [tests] if callable(tests) else list(tests)
    for test in tests:
        test(scenario)
    score = MutationScore()
    for mutant in mutants_of(scenario):
        for test in tests:
            try:
                test(mutate(scenario, mutant))
            except (KeyboardInterrupt, GeneratorExit):
                raise
            except BaseException as error:  # Failures of pytest are none of Exception.
                score.killed[mutant] = f"{getattr(test, '__name__', test)} ({error_text(error)})"
                break
        else:
            score.survived.append(mutant)
    return score
