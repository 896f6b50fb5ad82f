"""Switching between simulation and reality in two phases: prepare checks and changes nothing, perform is quick."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import Context

from vtbdrake.common.failures import FAILURES, error_text
from vtbdrake.control.stepping import ChangeKind
from vtbdrake.testbed import DpsAlone, Interface, VirtualTestbed
from vtbdrake.testbed.switch import Position
from vtbdrake.testbed.testbed import Positions, wanted_positions

if TYPE_CHECKING:
    from vtbdrake.control.runtime import Runtime

_log = logging.getLogger(__name__)

Continuity = Mapping[str, str | tuple[str, ArrayLike] | None]
"""Actuator signal -> what its commands continue when it is switched to real; see `Runtime`."""


class SwitchRefusedError(RuntimeError):
    """A switch that was not thrown; the message lists all reasons against it."""


@dataclass(frozen=True)
class Preparation:
    """The first phase of a switch: the planned changes, and the reasons against them.

    Attributes:
        sense: New positions by sensor signal.
        act: New positions by actuator signal.
        reasons: The reasons against the switch; empty if there are none.
        cycle: Number of the runtime's cycles when they were collected.
    """

    sense: Mapping[str, Position]
    act: Mapping[str, Position]
    reasons: tuple[str, ...]
    cycle: int


def prepare(
    runtime: Runtime,
    mode: str | None = None,
    *,
    sense: Positions = None,
    act: Positions = None,
) -> Preparation:
    """Collect the reasons against a switch; `Runtime.prepare` calls this.

    A sensor signal that becomes real must be fresh and plausible. If an actuator signal is to be on real, so must all
    sensor signals on real, and the one that its command departs from. The command of an actuator signal that becomes
    real must continue what is measured. The machine must be ready and connected, report what acts if its protocol says
    so, and have no other commander. Messages that pace the loop must come once per period.

    Args:
        runtime: The loop.
        mode: Mode for all switches: ``sim``, ``shadow``, ``real`` or ``twin``; None to name them one by one.
        sense: Position of the sensor switches, or positions by signal; None leaves them.
        act: Position of the actuator switches, or positions by signal; None leaves them.

    Raises:
        ValueError: The mode, a signal or a position is unknown, or there are a mode and positions.
    """
    target = runtime.target
    senses, acts = wanted_positions(target.interface, mode, sense, act)
    if isinstance(target, DpsAlone) and any(
        position != Position.REAL for position in [*senses.values(), *acts.values()]
    ):
        raise ValueError("the DPS alone has no simulated world: it can be switched to real only")
    now = runtime.clock.now()
    reasons = []
    commanding = [name for name, position in acts.items() if position != Position.SIM]
    becoming = [name for name in commanding if name not in runtime.guards.driven]
    if (commanding or Position.REAL in senses.values()) and not runtime.bridge.connected:
        reasons.append("the bridge is not connected")
    heard = [name for name, position in senses.items() if position == Position.REAL]
    if commanding:
        heard += [name for name in runtime.watched if senses.get(name) != Position.SIM]
        heard += [runtime.continuity[name][0] for name in becoming if name in runtime.continuity]
    for name in dict.fromkeys(heard):
        reasons += runtime.guards.sensor_faults(name, now, runtime.bridge.sensed[name])
    if commanding:
        reasons += [f"the guards are latched ({fault.reason}): reset them first" for fault in runtime.guards.latched]
        blocked = runtime.blocked_reason()
        if blocked is not None:
            reasons.append(f"the machine must not be commanded: {blocked}")
        if runtime.pace_problem is not None:
            reasons.append(runtime.pace_problem)
        for name in becoming:
            if name in runtime.bridge.reported and not runtime.bridge.reported[name].count:
                reasons.append(f"the machine has never reported what acts on {name}, and is to (Protocol.reported)")
        competing = runtime.bridge.competing_publisher
        if becoming and competing is not None:
            reasons.append(competing)
        reasons += discontinuities(runtime, becoming)

    return Preparation(senses, acts, tuple(reasons), runtime.cycles)


def checked_continuity(
    interface: Interface, continuity: Continuity, *, period: float
) -> dict[str, tuple[str, NDArray[np.float64]]]:
    """Return the ``continuity`` argument of `Runtime` as sensor signal and largest differences, by actuator signal.

    Args:
        interface: The signals of the DPS.
        continuity: By actuator signal: a sensor signal, (sensor signal, largest difference), or None.
        period: Period of the loop, in seconds: without a largest difference, it is the rate times the period.

    Raises:
        ValueError: An entry is none of the three forms, a signal does not exist, two signals have different sizes, a
            largest difference is negative, or there is none because the actuator signal has no limited rate.
    """
    actuators = {signal.name: signal for signal in interface.act}
    sensors = {signal.name: signal for signal in interface.sense}
    checked = {}
    for name, entry in continuity.items():
        if name in actuators and entry is None:
            continue
        if not (isinstance(entry, str) or (isinstance(entry, tuple | list) and len(entry) == 2)):
            raise ValueError(f"continuity of {name} is (sensor signal, largest difference), not {entry!r}")
        sensor, limit = (entry, None) if isinstance(entry, str) else entry
        if name not in actuators or sensor not in sensors or actuators[name].size != sensors[sensor].size:
            raise ValueError(
                "continuity goes from an actuator signal to a sensor signal of its size, not from "
                f"{name!r} to {sensor!r}; there are {', '.join(actuators)} and {', '.join(sensors)}"
            )
        signal = actuators[name]
        if limit is None:
            if not np.isfinite(signal.rate).all():
                raise ValueError(
                    f"the largest difference of {name} from {sensor} does not follow from its rate, which is not "
                    f"limited: give continuity={{{name!r}: ({sensor!r}, largest difference)}}"
                )
            limit = np.asarray(signal.rate) * period
        if np.shape(limit) not in ((), (signal.size,)) or not (np.asarray(limit) >= 0.0).all():
            raise ValueError(
                f"the largest difference of {name} from {sensor} must not be negative, a number or {signal.size} of "
                f"them, unlike {limit}"
            )
        checked[name] = (sensor, signal.vector(limit))
    return checked


def discontinuities(runtime: Runtime, names: Iterable[str]) -> list[str]:
    """Return the reasons why commands of actuator signals would not continue the measured values.

    Args:
        runtime: The loop, with the newest measurements.
        names: The actuator signals that become real.
    """
    reasons = []
    for name in names:
        if name not in runtime.continuity:
            if runtime.guards.limiters[name].needs_start:
                reasons.append(
                    f"the actuator command {name} is limited in rate or acceleration and needs a measurement to depart "
                    f"from: give continuity={{{name!r}: (sensor signal, largest difference)}}"
                )
            continue
        sensor, _ = runtime.continuity[name]
        if runtime.bridge.sensed[sensor].value is None:
            reasons.append(f"the actuator command {name} departs from {sensor}, which has never been measured")
            continue
        try:
            command = runtime.actuator_command(name)
        except FAILURES as error:
            reasons.append(f"the actuator command {name} cannot be computed: {error_text(error)}")
            continue
        if command is not None:  # A DPS that has not started has no command; its first one is compared in its cycle.
            reasons += discontinuity(runtime, name, command)
    return reasons


def discontinuity(runtime: Runtime, name: str, command: Any) -> list[str]:
    """Return the reasons why a command does not continue the measured value, and a remedy; empty if it does.

    Args:
        runtime: The loop, with the newest measurements.
        name: The actuator signal.
        command: Its command, shape (size,), in the signal's unit.
    """
    if name not in runtime.continuity:
        return []
    sensor, limit = runtime.continuity[name]
    measured = runtime.bridge.sensed[sensor].value
    gap = np.abs(command - measured)
    if (gap <= limit).all():
        return []
    # The entry that exceeds its limit most; a NaN is one.
    k = int(np.argmax(np.where(gap <= limit, -np.inf, gap - limit)))
    entry = f"[{k}]" if len(gap) > 1 else ""
    reason = f"the actuator command {name}{entry} is {gap[k]:.3g} away from {sensor}{entry}; {limit[k]:g} is allowed"
    hint = runtime.hint
    if (np.abs(command + measured) <= limit).all():
        hint = "it would fit with the opposite sign, so the machine may measure with another sign than it obeys"
    return [f"{reason}: {hint}"]


def perform(runtime: Runtime, senses: Mapping[str, Position], acts: Mapping[str, Position]) -> None:
    """Throw the switches of a preparation without reasons against it; `Runtime.perform` calls this.

    Args:
        runtime: The loop.
        senses: New positions by sensor signal.
        acts: New positions by actuator signal.
    """
    for name, position in acts.items():
        if position != Position.SIM and name in runtime.continuity and name not in runtime.guards.driven:
            # The actuator commands start from the measured values; a signal that is commanded already goes on.
            runtime.guards.start(name, runtime.bridge.sensed[runtime.continuity[name][0]].value)
            runtime.uncompared.add(name)
    runtime.note_change(
        ChangeKind.SWITCH,
        {f"sense.{name}": position.value for name, position in senses.items()}
        | {f"act.{name}": position.value for name, position in acts.items()},
    )
    if isinstance(runtime.target, DpsAlone):
        runtime.start_dps()
        return
    runtime.feed()
    throw(runtime.target, runtime.context, senses, acts)
    runtime.read_switches()


def throw(target: VirtualTestbed, context: Context, senses: Mapping[str, str], acts: Mapping[str, str]) -> None:
    """Throw switches of a running testbed.

    If a signal goes back to sim, the simulated world continues from the DPS's belief of the machine, if it can.

    Args:
        target: The testbed.
        context: Its root context, in which the switches are thrown.
        senses: New positions by sensor signal; the others stay.
        acts: New positions by actuator signal; the others stay.
    """
    before = target.positions(context)
    target.switch(context, sense=senses or None, act=acts or None)
    back = any(
        position == Position.SIM != before[side][name]
        for side, positions in (("sense", senses), ("act", acts))
        for name, position in positions.items()
    )
    if back and target.believes:
        try:
            target.start_from_belief(context)
        except Exception:
            # A switch back to sim must always work, even if the DPS's belief is invalid.
            _log.exception("the belief cannot be set; the simulated world continues from where it was")
