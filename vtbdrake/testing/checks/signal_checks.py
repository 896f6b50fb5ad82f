"""Checks of what a scenario declares: its signals and its variables."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from vtbdrake.control.limits import Bounds
from vtbdrake.state.variables import A
from vtbdrake.testbed import Signal, SignalError
from vtbdrake.testing.subject import CheckFailedError, CheckSkippedError, Subject

# Pytest shows none of the frames of this module: what a check has found is its message.
__tracebackhide__ = True

_UNITS = {
    "1",
    "rad",
    "m",
    "s",
    "kg",
    "A",
    "K",
    "mol",
    "cd",
    "N",
    "V",
    "W",
    "J",
    "Hz",
    "Pa",
    "C",
    "F",
    "T",
    "H",
    "S",
    "lx",
}
_UNITS |= {"sr", "lm", "Wb", "ohm", "Ω"}
# A symbol with its power: m, s2, s^2, m². Products are written with a blank, a point or a star.
_FACTOR = re.compile(r"([^\W\d_]+|1)(?:\^?-?\d+|[²³])?$")


def check_signals_have_units(subject: Subject) -> None:
    """Check that every signal that is a vector has an SI unit.

    Inside of a testbed all numbers are in SI units and radians: a signal in degrees or millimetres is converted at the
    edge, by the ``scale`` of its message. A number without a unit ("1", the default) has limits that tell what it
    counts.
    """
    problems = []
    for signal in _vectors(subject):
        # A list of units belongs to groups of entries, see `vtbdrake.state.variables.entry_units`.
        if not all(_is_si(unit.strip()) for unit in signal.unit.removesuffix(", ...").split(",")):
            problems.append(f"the unit of {signal.name} is {signal.unit!r}, which is no SI unit")
        elif signal.unit == "1" and _unlimited(signal).any():
            problems.append(f"{signal.name} has neither a unit nor limits: give unit='N m', say")
    _raise_if(problems)


def check_signals_have_limits(subject: Subject) -> None:
    """Check that every entry of a signal that is a vector has a lower and an upper limit.

    Guards keep commands within them, and reject measurements outside: a broken encoder that says 1e9 is noticed by
    nothing else. They are in the datasheet of the sensor or actuator.
    """
    problems = []
    for signal in _vectors(subject):
        entries = np.flatnonzero(_unlimited(signal))
        if entries.size:
            where = "" if entries.size == signal.size else f"[{', '.join(map(str, entries))}]"
            problems.append(f"{signal.name}{where} has no limits: give lower= and upper=")
    _raise_if(problems)


def check_parameters_have_bounds(subject: Subject) -> None:
    """Check that every parameter of the DPS has bounds, and its default value lies within them.

    Parameters can be set while the robot moves. Without bounds a typing error becomes a gain of 1e9. Declare them:
    ``Quantity(5.0, "1/s", bounds=(0.0, 50.0))``.
    """
    subject.presuppose_testbed()  # The DPS of a scenario that does not build tells nothing new.
    alone = subject.dps_alone
    context = alone.default_context()
    problems = []
    for address, variable in alone.variables().items():
        if variable.kind != A or variable.derived:
            continue
        lower, upper = (np.asarray(bound) for bound in variable.bounds)
        value = np.asarray(variable.get(context))
        if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
            problems.append(f"{address} has no bounds")
        elif not ((lower <= value) & (value <= upper)).all():
            problems.append(f"{address} = {value.tolist()} lies outside of its bounds, {lower} to {upper}")
    _raise_if(problems)


def check_variables_do_not_overlap(subject: Subject) -> None:
    """Check that no two variables lie in one place of the Context.

    Setting one of them would silently set the other. Give every number one name: a declaration of part of a group, and
    one of the whole, are two.
    """
    addresses: dict[tuple[str, str, int, int], str] = {}
    problems = []
    for address, variable in subject.testbed.variables().items():
        if (place := variable.place) is None:
            continue
        system = place.system.GetSystemPathname()
        for entry in range(place.start, place.start + int(np.prod(variable.shape, dtype=int))):
            other = addresses.setdefault((system, place.group, place.index, entry), address)
            if other != address:
                problems.append(f"{address} and {other} are the same number")
    _raise_if(problems)


def check_values_fit_their_signals(subject: Subject) -> None:
    """Check that measurements and commands keep type, size and limits of their signals.

    On the machine, guards reject measurements outside, and cut commands: a DPS that lives on either was developed in
    another world. Limit the command in the DPS, and let the simulated sensor saturate as the real one does.
    """
    testbed = subject.testbed
    for t, sensed, commanded in subject.signal_values(testbed):
        for signals, values in ((testbed.interface.sense, sensed), (testbed.interface.act, commanded)):
            for signal in signals:
                try:
                    signal.check_value(values[signal.name])
                except SignalError as error:
                    raise CheckFailedError(f"at t = {t:g} s, {error}") from error
                if problem := Bounds(signal).violation(values[signal.name]):
                    raise CheckFailedError(
                        f"at t = {t:g} s, {signal.name} = {np.asarray(values[signal.name]).tolist()} leaves its limits "
                        f"({problem}), {signal.lower} to {signal.upper} {signal.unit}"
                    )


def _vectors(subject: Subject) -> Iterator[Signal]:
    interface = subject.testbed.interface
    vectors = [s for s in (*interface.sense, *interface.act, *interface.commands) if s.is_vector]
    if not vectors:
        raise CheckSkippedError("no signal is a vector")
    yield from vectors


def _is_si(unit: str) -> bool:
    factors = [factor for factor in re.split(r"[\s*·/]+", unit.replace("(", " ").replace(")", " ")) if factor]
    matches = [_FACTOR.match(factor) for factor in factors]
    return bool(matches) and all(match is not None and match[1] in _UNITS for match in matches)


def _unlimited(signal: Signal) -> np.ndarray:
    return ~(np.isfinite(signal.vector(signal.lower)) & np.isfinite(signal.vector(signal.upper)))


def _raise_if(problems: list[str]) -> None:
    if problems:
        raise CheckFailedError("; ".join(problems))
