"""Readings of simulated sensors that no belief rule reaches, so that they begin anew in a mental copy."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, System

from vtbdrake.reasoning.belief import Belief, can_resume, is_hold
from vtbdrake.state.variables import Variable, VariableError, Variables, X, with_unit
from vtbdrake.testbed import VirtualTestbed

# By how much the first entry of a variable is changed, in its unit; entry k by k + 1 times as much.
_CHANGE = 0.01


class UnbelievedReadings:
    """The sensor readings that begin anew in a mental copy, whatever the DPS has received.

    They depend on the state of the simulated world, but on nothing that is believed of it: for example the angles of
    wheels, if no belief rule sets them. A DPS that counts up such a reading takes its step from the last received value
    to the mental copy's value for a motion.

    What a reading depends on is found once, by changing the state in a context, so that no threshold is needed. Only
    sensors with the methods ``resume`` and ``measurement``, as every `SampledSensor` has, and Drake's sampled holds and
    delays are examined. The states of sensors and actuators are left out, because a mental copy continues them.

    Args:
        mental: The mental testbed.
        uncertain: Addresses of the variables that are drawn for each sample of the belief.
    """

    def __init__(self, mental: VirtualTestbed, *, uncertain: Iterable[str] = ()) -> None:
        variables, context = mental.variables(), mental.default_context()
        units = {signal.name: signal.unit for signal in mental.interface.sense if signal.is_vector}
        sensors = {n: s for n, s in mental.simulated_sensors.items() if n in units and _is_examined(s)}

        def measured(context: Context) -> np.ndarray:
            return np.concatenate([np.zeros(0), *(_measurement(s, context) for s in sensors.values())])

        values = measured(context)
        entries = [(n, k) for n, s in sensors.items() for k in range(_measurement(s, context).size)]
        changed = mental.default_context()
        believed = [*(target for rule in mental.belief_rules for target in rule.targets), *uncertain]
        for number, address in enumerate(believed):
            _change(variables[address], changed, 1.0 + 0.1 * number)
        unreached = measured(changed) == values
        # Index of a reading -> address of a variable that it depends on.
        cause: dict[int, str] = {}
        for variable in _world(variables) if unreached.any() else ():
            before = variable.get(context)
            free = np.equal(before, variable.get(changed))
            if free.any() and variable.address not in believed:
                _change(variable, context, free)
                for index in np.flatnonzero(unreached & (measured(context) != values)).tolist():
                    cause.setdefault(index, variable.address)
                variable.set(context, before)
        self._readings = [(*entries[k], float(values[k]), units[entries[k][0]], cause[k]) for k in sorted(cause)]

    def warnings(self, belief: Belief) -> tuple[str, ...]:
        """Return a sentence about the first reading that does not begin with what the DPS has received, if any."""
        if belief.world is not None:
            return ()
        received = [float(belief.dps.received[name][entry]) for name, entry, *_ in self._readings]
        wrong = [k for k, (_, _, value, *_) in enumerate(self._readings) if not np.isclose(received[k], value)]
        if not wrong:
            return ()
        name, entry, value, unit, address = self._readings[wrong[0]]
        more = f"; the same holds for further readings: {len(wrong) - 1}" if len(wrong) > 1 else ""
        return (
            f"the simulated sensor signal {name}[{entry}] begins at {with_unit(f'{value:g}', unit)}, but the DPS has "
            f"received {with_unit(f'{received[wrong[0]]:g}', unit)} last: no belief rule reaches it; declare a belief "
            f"for {address} (VirtualTestbedBuilder.believe){more}",
        )


def _world(variables: Variables) -> list[Variable]:
    """Return the state of the world that can be set, without the state of sensors and actuators."""
    world = [v for v in variables.values() if v.address.startswith(("sim.sys.", "sim.env."))]
    return [v for v in world if v.kind == X and not v.derived]


def _is_examined(sensor: System) -> bool:
    return can_resume(sensor) and (is_hold(sensor) or hasattr(sensor, "measurement"))


def _measurement(sensor: System, root: Context) -> np.ndarray:
    """Return the sample that a sensor would take now, without its errors."""
    context = sensor.GetMyContextFromRoot(root)
    return np.array(sensor.get_input_port().Eval(context) if is_hold(sensor) else sensor.measurement(context))


def _change(variable: Variable, context: Context, amount: ArrayLike) -> None:
    """Change each entry of a variable within its bounds, by different amounts, so that changes do not cancel.

    Args:
        variable: The variable.
        context: Context of its testbed.
        amount: Factor of the changes, a scalar or of the variable's shape; an entry with the factor 0 stays.
    """
    value = np.asarray(variable.get(context))
    steps = _CHANGE * np.asarray(amount) * (1.0 + np.arange(value.size).reshape(value.shape))
    lower, upper = variable.bounds
    more = np.minimum(value + steps, upper)
    moved = np.where(more > value, more, np.maximum(value - steps, lower))
    if (moved != value).any():
        with suppress(VariableError):  # A variable that cannot be changed alone.
            variable.set(context, moved)
