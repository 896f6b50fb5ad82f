"""Measurement errors of sensors: outliers, bias, drift, quantization, latency and drop-out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from math import inf, sqrt

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.common.arrays import immutable
from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.sensors.noise import normal_noise, random_stream, uniform_noise
from vtbdrake.state import AddressedSystem, Quantity

# Channels of a sensor's stream; 0 is its white noise.
_DRIFT_CHANNEL = 1
_DROPOUT_CHANNEL = 2
_OUTLIER_CHANNEL = 3
_OUTLIER_SIZE_CHANNEL = 4

# Number of contexts whose settings are kept.
_KEPT = 128


@dataclass
class ErrorModel:
    r"""The errors of a sampled sensor, in the order in which they act on a sample.

    With the measured quantity m_k at tick k, of the period T, and n, n', n'' of N(0, 1), u, u' uniform in [0, 1), all
    functions of (seed, stream, k):

        w_k = w_{k-1} + drift sqrt(T) n'_k,   w_{-1} = 0          (a random walk, of variance drift^2 t)
        o_k = outlier_size n''_k if u'_k < outlier_probability, else 0
        z_k = round((m_k + noise n_k + o_k + bias + w_k) / q) q   (q = quantization; left as it is where q = 0)
        y_k = y_{k-1} if u_k < dropout, else z_{k-latency}

    y is what the sensor shows; before the first sample, y and z are its default. Noise and outliers together have a
    contaminated normal distribution (Tukey, "A survey of sampling from contaminated distributions", 1960).

    The values hold for all entries of the sensor; by address, they can be set entry by entry, and changed at any time.

    Raises:
        ValueError: A value is not possible.
    """

    noise: float = setting(0.0, "Standard deviation of white noise, in the unit of the signal.", ge=0.0)
    bias: float = setting(0.0, "Constant offset, in the unit of the signal.")
    drift: float = setting(
        0.0, "Standard deviation of the random walk after one second, in the signal's unit per root second.", ge=0.0
    )
    quantization: float = setting(0.0, "Resolution of the sensor; 0 is infinitely fine.", ge=0.0)
    latency: int = setting(0, "Age of a sample when it is shown, in whole periods.", unit="periods", ge=0)
    max_latency: int = setting(0, "The largest latency that can be set by address; at least `latency`.", ge=0)
    dropout: float = setting(0.0, "Probability that a sample does not arrive.", ge=0.0, le=1.0)
    outlier_probability: float = setting(
        0.0, "Probability that a sample is an outlier, in all its entries.", ge=0.0, le=1.0
    )
    outlier_size: float = setting(
        0.0, "Standard deviation of the error of an outlier, in the unit of the signal.", ge=0.0
    )
    seed: int = setting(
        0,
        "Seed of all random numbers. Sensors of one seed are independent: each has a stream of random numbers.",
        ge=0,
        le=2**53,
    )

    def __post_init__(self) -> None:
        check_settings(self)

    def without_chance(self) -> ErrorModel:
        """Return the model without its random errors, as predictions need it."""
        return replace(self, noise=0.0, drift=0.0, dropout=0.0, outlier_probability=0.0)


@immutable
class _ErrorSettings:
    """The parameters of an `ErrorStage`, as they are used. None: there is no such error."""

    seed: int
    # None without random errors.
    stream: int | None = None
    noise: NDArray[np.float64] | None = None
    bias: NDArray[np.float64] | None = None
    # The drift of one step of the random walk.
    drift: NDArray[np.float64] | None = None
    quantization: NDArray[np.float64] | None = None
    latency: int = 0
    dropout: float = 0.0
    outlier_probability: float = 0.0
    outlier_size: float = 0.0


def _unless_zero(values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    return np.array(values) if values.any() else None


class ErrorStage:
    """The errors of a sensor, in its Context.

    It declares the parameters ``seed`` and the standard deviations of white noise. With an `ErrorModel` also ``bias``,
    ``drift``, ``quantization`` (one per entry), ``latency``, ``dropout``, ``outlier_probability`` and ``outlier_size``,
    and the state ``walk`` (the drift) and ``in_transit`` (the samples not yet shown, newest first).

    Attributes:
        parameters: The group of the parameters.
        noise: Name of a standard deviation -> the number of entries that it applies to.
        has_model: Whether there is an `ErrorModel`: without, there is white noise only.
        memory: The group of the state, with an `ErrorModel`.
        longest: The largest latency in periods, with an `ErrorModel`.
        stream: Function that returns the random stream.
    """

    def __init__(
        self,
        sensor: AddressedSystem,
        model: ErrorModel | None,
        *,
        noise: Mapping[str, tuple[int, str]],
        stream: int | None,
        default: NDArray[np.float64],
        output: int,
        period: float,
        unit: str,
    ) -> None:
        """Declare the state and parameters of the errors in ``sensor``.

        Args:
            sensor: The sensor to declare them in.
            model: The initial values; None declares white noise only.
            noise: As in `SampledSensor`.
            stream: As in `SampledSensor`.
            default: The reading before the first sample, shape (n,).
            output: Index of the discrete state that the sensor shows.
            period: Sample period in seconds.
            unit: Unit of the reading.
        """
        n = default.size
        self._n, self._output, self._period = n, output, period
        self.stream = random_stream(sensor, stream)
        self.noise = {name: count for name, (count, _) in noise.items()}
        self.has_model = model is not None
        seed, std = (0, 0.0) if model is None else (model.seed, model.noise)
        positive, probability = (0.0, inf), (0.0, 1.0)
        settings = {"seed": Quantity(seed, bounds=(0.0, 2.0**53))}
        settings |= {name: Quantity(std, noise_unit, positive) for name, (_, noise_unit) in noise.items()}
        if model is not None:
            self.longest = max(int(model.latency), int(model.max_latency))
            settings |= {
                "bias": Quantity(np.full(n, model.bias), unit),
                "drift": Quantity(np.full(n, model.drift), f"({unit})/s^0.5", positive),
                "quantization": Quantity(np.full(n, model.quantization), unit, positive),
                "latency": Quantity(model.latency, "period", (0.0, float(self.longest))),
                "dropout": Quantity(model.dropout, bounds=probability),
                "outlier_probability": Quantity(model.outlier_probability, bounds=probability),
                "outlier_size": Quantity(model.outlier_size, unit, positive),
            }
        self.parameters = sensor.declare_parameters(**settings)
        # What the parameters say is found again by their values, which are the same in many steps.
        self._settings = lru_cache(_KEPT)(self._settings_of)
        if model is not None:
            memory = {"walk": Quantity(np.zeros(n), unit)}
            if self.longest:
                memory["in_transit"] = Quantity(np.tile(default, (self.longest, 1)), unit)
            self.memory = sensor.declare_discrete_state(**memory)

    def _settings_of(self, values: bytes) -> _ErrorSettings:
        parameters = self.parameters.vector.view(np.frombuffer(values))
        deviations = [getattr(parameters, name) for name in self.noise]
        settings = _ErrorSettings(
            int(parameters.seed), noise=_unless_zero(np.repeat(deviations, list(self.noise.values())))
        )
        if self.has_model:
            settings = replace(
                settings,
                bias=_unless_zero(parameters.bias),
                drift=_unless_zero(sqrt(self._period) * parameters.drift),
                quantization=_unless_zero(parameters.quantization),
                latency=round(parameters.latency),
                dropout=parameters.dropout,
                outlier_probability=parameters.outlier_probability,
                outlier_size=parameters.outlier_size,
            )
        if settings.noise is not None or settings.drift is not None or settings.dropout or settings.outlier_probability:
            settings = replace(settings, stream=self.stream())
        return settings

    def resume(self, context: Context, y: NDArray[np.float64]) -> None:
        """Let ``y`` be in transit, throughout.

        Args:
            context: The Context of the sensor.
            y: The reading, shape (n,), in the sensor's unit.
        """
        if self.has_model and self.longest:
            self.memory.mutable(context.get_mutable_discrete_state()).in_transit = y

    def apply(self, context: Context, state: DiscreteValues, y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the output of the sensor when it measures ``y``.

        Args:
            context: The Context of the sensor, at the time of the sample.
            state: The discrete state that the update of the sensor sets, with the memory of the errors.
            y: The measurement without errors, shape (n,), in the sensor's unit.
        """
        settings = self._settings(self.parameters.array(context).tobytes())
        key: dict[str, int] = {}
        if settings.stream is not None:
            tick = round(context.get_time() / self._period)
            key = {"seed": settings.seed, "stream": settings.stream, "tick": tick}
        if settings.noise is not None:
            y = y + settings.noise * normal_noise(y.size, **key)
        return self._shown(context, state, y, settings, key) if self.has_model else y

    def _shown(
        self,
        context: Context,
        state: DiscreteValues,
        y: NDArray[np.float64],
        settings: _ErrorSettings,
        key: Mapping[str, int],
    ) -> NDArray[np.float64]:
        n, q = self._n, settings.quantization
        memory = self.memory.mutable(state)
        walk = memory.walk
        if settings.drift is not None:
            walk += settings.drift * normal_noise(n, channel=_DRIFT_CHANNEL, **key)
        if settings.outlier_probability and (
            uniform_noise(channel=_OUTLIER_CHANNEL, **key) < settings.outlier_probability
        ):
            y = y + settings.outlier_size * normal_noise(n, channel=_OUTLIER_SIZE_CHANNEL, **key)
        if settings.bias is not None:
            y = y + settings.bias
        if np.count_nonzero(walk):
            y = y + walk
        if q is not None:
            steps = np.where(q > 0.0, q, 1.0)
            y = np.where(q > 0.0, np.round(y / steps) * steps, y)
        if self.longest:
            in_transit, newest = memory.in_transit, y
            if settings.latency:
                y = in_transit[settings.latency - 1].copy()
            in_transit[1:] = in_transit[:-1]
            in_transit[0] = newest
        if settings.dropout and uniform_noise(channel=_DROPOUT_CHANNEL, **key) < settings.dropout:
            y = context.get_discrete_state(self._output).value()
        return y
