"""What lies between a quantity and its reading: bias, drift, quantization, latency and drop-out."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite, sqrt

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from vtbdrake.components.sensors.noise import normal_noise, uniform_noise
from vtbdrake.state import Element, discrete_state, parameter

# Channels of a sensor's stream; 0 is its white noise.
_DRIFT_CHANNEL, _DROPOUT_CHANNEL = 1, 2


@dataclass
class ErrorModel:
    r"""The errors of a sampled sensor, in the order in which a sample meets them.

    With the measured quantity m_k at tick k, of the period T, and n, n' of N(0, 1), u uniform in [0, 1), all three
    functions of (seed, stream, k):

        w_k = w_{k-1} + drift sqrt(T) n'_k,   w_{-1} = 0          (a random walk, of variance drift^2 t)
        z_k = round((m_k + noise n_k + bias + w_k) / q) q         (q = quantization; left as it is where q = 0)
        y_k = y_{k-1} if u_k < dropout, else z_{k-latency}

    y is what the sensor shows; before the first sample, y and z are its default.

    The values hold for all entries of the sensor; by address, they can be set entry by entry, and changed at any time.
    """

    # Standard deviation of white noise, in the unit of the signal.
    noise: float = 0.0
    # Constant offset, in the unit of the signal.
    bias: float = 0.0
    # Standard deviation of the random walk after one second, in the signal's unit per root second.
    drift: float = 0.0
    # Distance of two values that the sensor can tell apart; 0 is infinitely fine.
    quantization: float = 0.0
    # Age of a sample when it is shown, in whole periods.
    latency: int = 0
    # The largest latency that can be set by address; at least `latency`.
    max_latency: int = 0
    # Probability that a sample does not arrive.
    dropout: float = 0.0
    # Of all random numbers, beside the stream, which belongs to the sensor.
    seed: int = 0

    def check(self, owner: str) -> None:
        """
        Raises:
            ValueError: a value that no sensor can have.
        """
        checks = {
            "noise": (0.0 <= self.noise < inf, "a standard deviation, finite and not negative"),
            "bias": (isfinite(self.bias), "finite"),
            "drift": (0.0 <= self.drift < inf, "finite and not negative"),
            "quantization": (0.0 <= self.quantization < inf, "a step, finite and not negative"),
            "latency": (self.latency >= 0 and self.latency == int(self.latency), "a whole number of periods"),
            "max_latency": (
                self.max_latency >= 0 and self.max_latency == int(self.max_latency),
                "a whole number of periods",
            ),
            "dropout": (0.0 <= self.dropout <= 1.0, "a probability, between 0 and 1"),
            "seed": (0 <= self.seed <= 2**53 and self.seed == int(self.seed), "a whole number between 0 and 2^53"),
        }
        for name, (good, expected) in checks.items():
            if not good:
                raise ValueError(f"{owner}: {name} must be {expected}, not {getattr(self, name)!r}")


class ErrorStage:
    """All of an `ErrorModel` but the white noise, in the Context of a sensor.

    Attributes:
        variables: its parameters ``bias``, ``drift``, ``quantization`` (one per entry), ``latency`` and ``dropout``,
            and its state ``walk`` (the drift) and ``in_transit`` (the samples not yet shown, newest first).
    """

    def __init__(
        self,
        sensor: LeafSystem,
        model: ErrorModel,
        *,
        default: NDArray[np.float64],
        output: int,
        period: float,
        unit: str,
    ) -> None:
        """``output`` is the discrete state of ``sensor`` that it shows."""
        n = default.size
        self._n, self._output, self._root_period = n, output, sqrt(period)
        self._longest = max(int(model.latency), int(model.max_latency))
        values = np.repeat([model.bias, model.drift, model.quantization], n)
        self._parameters = int(
            sensor.DeclareNumericParameter(BasicVector([*values, float(model.latency), float(model.dropout)]))
        )
        self._walk = int(sensor.DeclareDiscreteState(np.zeros(n)))
        self.variables: tuple[Element, ...] = (
            parameter("bias", self._parameters, shape=(n,), unit=unit),
            parameter("drift", self._parameters, start=n, shape=(n,), unit=f"({unit})/s^0.5", bounds=(0.0, inf)),
            parameter("quantization", self._parameters, start=2 * n, shape=(n,), unit=unit, bounds=(0.0, inf)),
            parameter("latency", self._parameters, start=3 * n, unit="period", bounds=(0.0, float(self._longest))),
            parameter("dropout", self._parameters, start=3 * n + 1, bounds=(0.0, 1.0)),
            discrete_state("walk", self._walk, shape=(n,), unit=unit),
        )
        if self._longest:
            self._line = int(sensor.DeclareDiscreteState(np.tile(default, self._longest)))
            self.variables += (discrete_state("in_transit", self._line, shape=(self._longest, n), unit=unit),)

    def apply(
        self, context: Context, state: DiscreteValues, y: NDArray[np.float64], *, seed: int, stream: int, tick: int
    ) -> NDArray[np.float64]:
        """What the sensor shows when it measures ``y`` (with its white noise) at ``tick``."""
        n = self._n
        values = context.get_numeric_parameter(self._parameters).value()
        walk = context.get_discrete_state(self._walk).value()
        if not (self._longest or values.any() or walk.any()):
            return y  # the quick way of a sensor without errors
        drift, q = values[n : 2 * n], values[2 * n : 3 * n]
        latency, dropout = round(float(values[3 * n])), float(values[3 * n + 1])
        if drift.any():
            step = normal_noise(n, seed=seed, stream=stream, tick=tick, channel=_DRIFT_CHANNEL)
            walk = walk + self._root_period * drift * step
            state.set_value(self._walk, walk)
        y = y + values[:n] + walk
        if q.any():
            steps = np.where(q > 0.0, q, 1.0)
            y = np.where(q > 0.0, np.round(y / steps) * steps, y)
        if self._longest:
            line = context.get_discrete_state(self._line).value()
            state.set_value(self._line, np.concatenate((y, line[:-n])))
            if latency:
                y = np.array(line[(latency - 1) * n : latency * n])
        if dropout and uniform_noise(seed=seed, stream=stream, tick=tick, channel=_DROPOUT_CHANNEL) < dropout:
            y = np.array(context.get_discrete_state(self._output).value())
        return y
