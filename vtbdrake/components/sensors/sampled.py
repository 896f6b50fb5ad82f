"""What all sensors have in common: they are sampled, and their output is their own state.

What is sampled at an instant is seen by the updates after it. An update at the same instant still sees the sample
before, whatever its kind and the order of the systems are.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import AbstractStateIndex, Context, DiagramBuilder, DiscreteValues, EventStatus, State

from vtbdrake.common.settings import check_settings
from vtbdrake.components.sensors.errors import ErrorModel, ErrorStage
from vtbdrake.state import AddressedSystem, Quantity

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant


class SampledSensor(AddressedSystem):
    """A sensor that measures at t = 0, T, 2 T, ... and holds its measurement y in between.

    ``y = measurement + std * n(seed, stream, tick)`` with n independent and of N(0, 1). Until the first sample, y is
    ``default``. A reader that is sampled at the same instants sees y one period late. An `ErrorModel` adds bias, drift,
    quantization, latency and drop-out.

    The input ports have the names of the plant's output ports that they belong to, see `connect_to_plant`.
    """

    def __init__(
        self,
        signal: str,
        *,
        default: ArrayLike,
        period: float,
        unit: str,
        noise: Mapping[str, tuple[int, str]] | None = None,
        stream: int | None = None,
        errors: ErrorModel | None = None,
    ) -> None:
        """Declare the sensor.

        Args:
            signal: Name of the output port.
            default: The reading before the first sample, shape (n,).
            period: Sample period in seconds.
            unit: Unit of the reading.
            noise: Name of a standard deviation -> (number of entries of y that it applies to, unit). It is 0 without
                ``errors``.
            stream: Number of the random stream; sensors with one seed and one stream have the same noise. None: one of
                its own, which follows from the name of this system in its Diagram (`stream_of`).
            errors: The measurement errors; None for an exact sensor.

        Raises:
            ValueError: The period is not positive, or ``errors`` has noise and the sensor has none.
        """
        super().__init__()
        noise = noise or {}
        if not period > 0:
            raise ValueError(f"{type(self).__name__}: period is {period} s, but must be positive.")
        self.period: float = float(period)  # time between two samples in seconds
        y0 = np.asarray(default, dtype=float)
        reading = self.declare_discrete_state(**{signal: Quantity(y0, unit)})
        self._output = int(reading.index)
        self.DeclareStateOutputPort(signal, reading.index)
        if errors is not None:
            check_settings(errors, name=f"{type(self).__name__}.errors")
            if errors.noise and not noise:
                raise ValueError(
                    f"{type(self).__name__} has no noise, but noise={errors.noise:g} is given: leave it out."
                )
        self.errors: ErrorStage | None = None
        if noise or errors is not None:
            self.errors = ErrorStage(
                self,
                errors,
                noise=noise,
                stream=stream,
                default=y0,
                output=self._output,
                period=self.period,
                unit=unit,
            )
        self.DeclarePeriodicDiscreteUpdateEvent(self.period, 0.0, self._sample)

    def resume(self, context: Context, y: NDArray[np.float64]) -> None:
        """Continue like a sensor that has shown ``y`` last, which also counts as the samples in transit.

        So the DPS of a mental copy reads the same as the DPS itself, until the copy's sensors sample.

        Args:
            context: The Context of this sensor, in the state of the world from which it continues.
            y: The last reading, shape (n,).
        """
        context.SetDiscreteState(self._output, y)
        if self.errors is not None:
            self.errors.resume(context, y)

    def measurement(self, context: Context) -> NDArray[np.float64]:
        """Return the measurement at present, without errors, shape (n,)."""
        return self._measure(context, self.AllocateDiscreteVariables())

    @abstractmethod
    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        """Return the measurement without noise. Write memory for the next measurement to ``state``."""

    def _sample(self, context: Context, state: DiscreteValues) -> None:
        y = self._measure(context, state)
        if self.errors is not None:
            y = self.errors.apply(context, state, y)
        state.set_value(self._output, y)


class SampledValues:
    """Samples that are abstract values, such as images, with the output ports of a sensor that show them.

    What is sampled at an instant is seen by the updates after it, as with a `SampledSensor`. Abstract state alone would
    show it to the discrete updates of that instant, because Drake makes the unrestricted ones first. So the previous
    sample is kept beside the newest one, and is shown until a discrete update at the same instant, such as a
    `SampledSensor` makes, sets the variable ``shows_newest`` to 1.

    Args:
        sensor: The sensor, to which state, output ports and the discrete update are added.
        period: Time in s between two updates of the sensor; the first is at t = 0.
        models: Name of an output port -> a value like its samples, which is shown before the first.
    """

    def __init__(self, sensor: AddressedSystem, period: float, models: Mapping[str, Any]) -> None:
        # Name -> numbers of the abstract states of the newest sample, and of the one before.
        self._states = {name: self._declare_states(sensor, model) for name, model in models.items()}
        self._shown = sensor.declare_discrete_state(shows_newest=Quantity(1.0, bounds=(0.0, 1.0)))
        for name, model in models.items():
            sensor.DeclareAbstractOutputPort(
                name,
                lambda model=model: Value(model),
                self._reader(name),
                prerequisites_of_calc={
                    sensor.discrete_state_ticket(self._shown.index),
                    *(sensor.abstract_state_ticket(AbstractStateIndex(number)) for number in self._states[name]),
                },
            )
        sensor.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._show)

    @staticmethod
    def _declare_states(sensor: AddressedSystem, model: Any) -> tuple[int, int]:
        return int(sensor.DeclareAbstractState(Value(model))), int(sensor.DeclareAbstractState(Value(model)))

    def _reader(self, name: str) -> Callable[[Context, AbstractValue], None]:
        return lambda context, output: output.set_value(self.read(context, name))

    def read(self, context: Context, name: str) -> Any:
        """Return the sample that an output port shows in the sensor's own context.

        Args:
            context: The Context of the sensor.
            name: Name of the output port.
        """
        newest, previous = self._states[name]
        number = newest if self._shown.view(context).shows_newest else previous
        return context.get_abstract_state(number).get_value()

    def take(self, state: State, samples: Mapping[str, Any]) -> None:
        """Let the next updates see new samples.

        Args:
            state: The state that an unrestricted update of the sensor sets.
            samples: Name of an output port -> its new sample; all ports have one.
        """
        shown = self._shown.mutable(state.get_mutable_discrete_state())
        values = state.get_mutable_abstract_state()
        for name, sample in samples.items():
            newest, previous = (values.get_mutable_value(number) for number in self._states[name])
            # If events of one instant happen twice, the one that is shown stays.
            if shown.shows_newest:
                previous.set_value(newest.get_value())
            newest.set_value(sample)
        shown.shows_newest = 0.0

    def begin(self, state: State, samples: Mapping[str, Any]) -> None:
        """Let everybody see new samples at once, in the initialization, before all updates.

        Args:
            state: The state that the initialization of the sensor sets.
            samples: Name of an output port -> its sample; all ports have one.
        """
        self.take(state, samples)
        self._shown.mutable(state.get_mutable_discrete_state()).shows_newest = 1.0

    def resume(self, context: Context, name: str, sample: Any) -> None:
        """Continue like a sensor that has shown ``sample`` last.

        Args:
            context: The Context of the sensor, in the state of the world from which it continues.
            name: Name of the output port.
            sample: The sample, of the type of the port.
        """
        for number in self._states[name]:
            context.SetAbstractState(number, sample)

    def _show(self, context: Context, state: DiscreteValues) -> EventStatus:
        if self._shown.view(context).shows_newest:
            return EventStatus.DidNothing()
        self._shown.mutable(state).shows_newest = 1.0
        return EventStatus.Succeeded()


class StateSensor(SampledSensor):
    """Measures some entries of a plant's [q; v]; its input port is ``state``.

    Attributes:
        entries: The places of what is measured in [q; v].
    """

    def __init__(
        self,
        signal: str,
        plant: MultibodyPlant,
        entries: Sequence[int],
        *,
        default: NDArray[np.float64],
        period: float,
        unit: str,
        noise: Mapping[str, tuple[int, str]],
        stream: int | None,
        errors: ErrorModel | None,
    ) -> None:
        """Declare the sensor; see `SampledSensor` for the other arguments.

        Args:
            signal: The name of the output port.
            plant: The plant, finalized.
            entries: The places of what is measured in [q; v].
            default: The output before the first sample.
            period: Sample period in seconds.
            unit: The unit of the output.
            noise: The standard deviations by name, with how many entries each has and its unit.
            stream: Number of the random stream.
            errors: The measurement errors; None for an exact sensor.
        """
        super().__init__(signal, default=default, period=period, unit=unit, noise=noise, stream=stream, errors=errors)
        self.entries = np.array(entries, dtype=int)
        self._state_port = self.DeclareVectorInputPort("state", plant.num_multibody_states())

    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        x: NDArray[np.float64] = self._state_port.Eval(context)
        return x.take(self.entries)


def connect_to_plant(builder: DiagramBuilder, sensor: SampledSensor, plant: MultibodyPlant) -> None:
    """Connect every input port of ``sensor`` to the plant's output port of the same name.

    Args:
        builder: The builder, to which sensor and plant have been added.
        sensor: The sensor.
        plant: The plant.
    """
    for k in range(sensor.num_input_ports()):
        port = sensor.get_input_port(k)
        builder.Connect(plant.GetOutputPort(port.get_name()), port)
