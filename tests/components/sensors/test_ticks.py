"""Every sample has the noise of its own tick, whatever rounding does to t / T."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from vtbdrake.components.sensors import SampledSensor, normal_noise

PERIODS = (0.02, 0.01, 0.1, 0.003)
SAMPLES = 60


class Zero(SampledSensor):
    """Measures nothing but its noise."""

    def __init__(self, period):
        super().__init__("y", default=[0.0, 0.0], period=period, unit="1", noise={"noise": (2, "1")}, stream=4)

    def _measure(self, context, state):
        return np.zeros(2)


def _samples(period):
    sensor = Zero(period)
    simulator = Simulator(sensor)
    context = simulator.get_mutable_context()
    context.get_mutable_numeric_parameter(0).SetFromVector([5.0, 2.0])
    readings = []
    for k in range(SAMPLES):
        simulator.AdvanceTo((k + 0.5) * period)
        readings.append(sensor.get_output_port().Eval(context).copy())
    return np.array(readings)


@pytest.mark.parametrize("period", PERIODS)
def test_sample_k_has_the_noise_of_tick_k(period):
    expected = [2.0 * normal_noise(2, seed=5, stream=4, tick=k) for k in range(SAMPLES)]
    np.testing.assert_array_equal(_samples(period), expected)


def test_the_ticks_of_these_periods_take_rounding():
    # Otherwise the test above would not tell rounding from truncation.
    assert int((29 * 0.02) / 0.02) == 28
