"""The base class of all sensors: they are sampled, and their output is their own state."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues

from vtbdrake.components.sensors.errors import ErrorModel, ErrorStage
from vtbdrake.settings import check_settings
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
        """Return what the sensor would measure now, without its errors, shape (n,)."""
        return self._measure(context, self.AllocateDiscreteVariables())

    @abstractmethod
    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        """Return the measurement without noise. Write memory for the next measurement to ``state``."""

    def _sample(self, context: Context, state: DiscreteValues) -> None:
        y = self._measure(context, state)
        if self.errors is not None:
            y = self.errors.apply(context, state, y)
        state.set_value(self._output, y)


def connect_to_plant(builder: DiagramBuilder, sensor: SampledSensor, plant: MultibodyPlant) -> None:
    """Connect every input port of ``sensor`` to the plant's output port of the same name."""
    for k in range(sensor.num_input_ports()):
        port = sensor.get_input_port(k)
        builder.Connect(plant.GetOutputPort(port.get_name()), port)
