"""Commands as the machine reports them: what it says of its actuators, which is no sensor signal of the DPS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import inf

from vtbdrake.testbed import Interface, Signal


def reported_signals(interface: Interface, reported: Mapping[str, str]) -> dict[str, Signal]:
    """The signals that carry reported commands, by actuator signal.

    They have no limits: what is reported is looked at, not obeyed.

    Args:
        reported: by actuator signal, the name of the signal in a message that tells what acts on it.

    Raises:
        ValueError: there is no such actuator signal, or the name is another signal's.
    """
    actuators = {signal.name: signal for signal in interface.act}
    taken = {signal.name for signal in interface.sense}
    found = {}
    for name, carrier in reported.items():
        if name not in actuators:
            known = ", ".join(actuators) or "none"
            raise ValueError(f"the machine cannot report {name!r}, which is no actuator signal; there are: {known}")
        if carrier in taken:
            raise ValueError(f"the reported command of {name} needs a name of its own: {carrier!r} is taken")
        taken.add(carrier)
        found[name] = replace(actuators[name], name=carrier, lower=-inf, upper=inf, rate=inf, acceleration=inf)
    return found
