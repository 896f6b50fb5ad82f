"""Images, scans and other samples of signals, with their times by the clock of the DPS that receives them."""

from __future__ import annotations

from math import inf, isfinite
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, EventStatus, State

from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.state.codecs import codec_of


class Arrival(AddressedSystem):
    """Holds the newest sample of a signal, with its number and the time at which it was taken.

    .. pydrake_system::

        name: Arrival
        input_ports:
        - signal
        output_ports:
        - sample
        - time (s)
        - number

    Every ``period`` it compares the signal with the sample that it holds. A value that differs in any bit is a new
    sample: sensors have noise, and their values have time stamps or change. Its ``time`` is the time of its arrival
    less the parameter ``age``, but at least 0: a sample that is there at the start was taken then. ``number`` counts
    the samples; before the first, ``sample`` is ``model_value``, of time 0 and number 0. So nothing depends on the
    clock of the sensor, or on its sample times.

    The outputs agree with each other, and stay until the next arrival. With a `SlowPart` on request, ``number`` is the
    request: then each sample is evaluated once.

    In a simulation and on a machine in lock-step, a sample that a sensor has shown in one period of the DPS arrives in
    the next: its age is one period, plus the latency of the sensor.
    """

    def __init__(self, model_value: Any, *, period: float, age: float) -> None:
        """Declare the system.

        Args:
            model_value: A value of the signal, such as an image of its size; an array (n,) of a vector signal.
            period: The period of the DPS, in s.
            age: The time from the sampling of a value to its arrival, in s.

        Raises:
            ValueError: The period or the age is out of its range, or there is no codec for the values (see `codec_of`).
        """
        super().__init__()
        if not 0.0 < period < inf:
            raise ValueError(f"Arrival: the period is positive, in s, not {period!r}")
        if not (isfinite(age) and age >= 0.0):
            raise ValueError(f"Arrival: the age is a finite time in s, and not negative, not {age!r}")
        self._is_vector = isinstance(model_value, np.ndarray)
        self._codec = codec_of(model_value, varying=True)
        if self._is_vector:
            self._signal = self.DeclareVectorInputPort("signal", model_value.size)
            sample: Any = self.declare_discrete_state(sample=Quantity(model_value)).index
        else:
            self._signal = self.DeclareAbstractInputPort("signal", Value(model_value))
            sample = self.DeclareAbstractState(Value(model_value))
        self._time = self.declare_discrete_state(time=Quantity(0.0, "s"))
        self._number = self.declare_discrete_state(number=Quantity(0.0, bounds=(0.0, inf)))
        for name, index in {"sample": sample, "time": self._time.index, "number": self._number.index}.items():
            self.DeclareStateOutputPort(name, index)
        self._sample = int(sample)
        self._settings = self.declare_parameters(age=Quantity(age, "s", (0.0, 60.0)))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: State) -> EventStatus:
        value = self._signal.Eval(context)
        if self._is_vector:
            if _equal(value, context.get_discrete_state(self._sample).value()):
                return EventStatus.DidNothing()
            state.get_mutable_discrete_state().set_value(self._sample, value)
        else:
            if self._is_same(value, context.get_abstract_state(self._sample).get_value()):
                return EventStatus.DidNothing()
            state.get_mutable_abstract_state(self._sample).set_value(value)
        numbers = state.get_mutable_discrete_state()
        self._time.mutable(numbers).time = max(context.get_time() - self._settings.view(context).age, 0.0)
        self._number.mutable(numbers).number += 1.0
        return EventStatus.Succeeded()

    def _is_same(self, value: Any, previous: Any) -> bool:
        if value is previous:
            return True
        arrays, previous_arrays = self._codec.encode(value), self._codec.encode(previous)
        return all(_equal(array, previous_arrays[part]) for part, array in arrays.items())


def _equal(array: np.ndarray, reference: np.ndarray) -> bool:
    return np.array_equal(array, reference, equal_nan=array.dtype.kind == "f")
