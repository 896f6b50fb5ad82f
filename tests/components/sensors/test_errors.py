"""Every part of the error model against its definition, and its random parts against their statistics."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.components.sensors import ErrorModel, SampledSensor, normal_noise, uniform_noise

PERIOD = 0.01
STREAM = 4


class Ramp(SampledSensor):
    """Measures (t, -2 t)."""

    def __init__(self, errors: ErrorModel | None = None, *, default: tuple[float, float] = (0.0, 0.0)) -> None:
        noise = {"noise": (2, "1")}
        super().__init__("y", default=default, period=PERIOD, unit="1", noise=noise, stream=STREAM, errors=errors)

    def _measure(self, context: Context, state: DiscreteValues) -> np.ndarray:
        return np.array([1.0, -2.0]) * context.get_time()


class Constant(Ramp):
    """Measures (0.37, 0.37)."""

    def _measure(self, context: Context, state: DiscreteValues) -> np.ndarray:
        return np.array([0.37, 0.37])


def ramp(samples: int) -> np.ndarray:
    return np.outer(np.arange(samples) * PERIOD, [1.0, -2.0])


def set_element(sensor: SampledSensor, context: Context, name: str, value: object) -> None:
    (element,) = [e for e in sensor.variables if e.name == name]
    vector = context.get_mutable_numeric_parameter(element.index)
    values = vector.value().copy()
    values[element.start : element.start + int(np.prod(element.shape))] = np.ravel(value)
    vector.SetFromVector(values)


def readings(sensor: SampledSensor, samples: int, **values: object) -> np.ndarray:
    simulator = Simulator(sensor)
    context = simulator.get_mutable_context()
    for name, value in values.items():
        set_element(sensor, context, name, value)
    return advance(sensor, simulator, range(samples))


def advance(sensor: SampledSensor, simulator: Simulator, ticks: range) -> np.ndarray:
    shown = []
    for k in ticks:
        simulator.AdvanceTo((k + 0.5) * PERIOD)
        shown.append(sensor.get_output_port().Eval(simulator.get_context()).copy())
    return np.array(shown)


def test_without_errors_nothing_is_declared_and_nothing_changes() -> None:
    assert [e.name for e in Ramp().variables] == ["y", "seed", "noise"]
    np.testing.assert_array_equal(readings(Ramp(ErrorModel()), 30), readings(Ramp(), 30))


def test_white_noise_is_that_of_the_sensor_without_an_error_model() -> None:
    alone = readings(Ramp(), 30, seed=5.0, noise=0.3)
    np.testing.assert_array_equal(readings(Ramp(ErrorModel(noise=0.3, seed=5)), 30), alone)
    n = [0.3 * normal_noise(2, seed=5, stream=STREAM, tick=k) for k in range(30)]
    np.testing.assert_allclose(alone, ramp(30) + n, rtol=0, atol=1e-15)


def test_bias_is_added_entry_by_entry() -> None:
    np.testing.assert_allclose(readings(Ramp(ErrorModel(bias=0.5)), 20), ramp(20) + 0.5, atol=1e-15)
    expected = ramp(20) + np.array([0.5, -1.0])
    np.testing.assert_allclose(readings(Ramp(ErrorModel()), 20, bias=[0.5, -1.0]), expected, atol=1e-15)


def test_quantization_gives_the_nearest_multiple() -> None:
    y = readings(Ramp(ErrorModel(quantization=0.008)), 200)
    np.testing.assert_allclose(y / 0.008, np.round(y / 0.008), atol=1e-9)
    assert np.abs(y - ramp(200)).max() <= 0.004 + 1e-12
    fine = readings(Ramp(ErrorModel()), 200, quantization=[0.0, 0.008])
    np.testing.assert_array_equal(fine[:, 0], readings(Ramp(), 200)[:, 0])
    np.testing.assert_array_equal(fine[:, 1], y[:, 1])


def test_quantization_is_of_the_erroneous_value() -> None:
    # 0.37 lies nearest to 0.4; with the bias nearest to 0.5.
    assert readings(Constant(ErrorModel(quantization=0.1)), 1)[0] == pytest.approx([0.4, 0.4])
    assert readings(Constant(ErrorModel(quantization=0.1, bias=0.09)), 1)[0] == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize("latency", [0, 1, 5])
def test_latency_shows_the_sample_of_so_many_periods_ago(latency: int) -> None:
    default = (7.0, 8.0)
    y = readings(Ramp(ErrorModel(latency=latency), default=default), 20)
    np.testing.assert_array_equal(y[latency:], readings(Ramp(), 20 - latency))
    np.testing.assert_array_equal(y[:latency], np.tile(default, (latency, 1)))


def test_latency_can_be_set_up_to_the_largest() -> None:
    sensor = Ramp(ErrorModel(latency=1, max_latency=4))
    np.testing.assert_array_equal(readings(sensor, 20, latency=3)[3:], readings(Ramp(), 17))
    (latency,) = [e for e in sensor.variables if e.name == "latency"]
    assert latency.bounds == (0.0, 4.0)


def test_dropped_samples_hold_the_last_one_at_the_rate_of_their_probability() -> None:
    samples = 4000
    y = readings(Ramp(ErrorModel(dropout=0.3, seed=2)), samples)
    dropped = np.array([uniform_noise(seed=2, stream=STREAM, tick=k, channel=2) < 0.3 for k in range(samples)])
    expected, last = [], np.zeros(2)
    for k, value in enumerate(readings(Ramp(), samples)):
        last = last if dropped[k] else value
        expected.append(last)
    np.testing.assert_array_equal(y, expected)
    # Three standard deviations of a binomial distribution.
    assert dropped.mean() == pytest.approx(0.3, abs=3 * np.sqrt(0.3 * 0.7 / samples))


def test_all_samples_dropped_shows_the_default() -> None:
    np.testing.assert_array_equal(readings(Ramp(ErrorModel(dropout=1.0), default=(7.0, 8.0)), 5), [[7.0, 8.0]] * 5)


def test_drift_is_the_sum_of_independent_steps() -> None:
    y = readings(Constant(ErrorModel(drift=0.2, seed=3)), 50) - 0.37
    steps = [0.2 * np.sqrt(PERIOD) * normal_noise(2, seed=3, stream=STREAM, tick=k, channel=1) for k in range(50)]
    np.testing.assert_allclose(y, np.cumsum(steps, axis=0), atol=1e-13)


def test_errors_hold_from_the_next_sample() -> None:
    sensor = Constant(ErrorModel())
    simulator = Simulator(sensor)
    before = advance(sensor, simulator, range(3))
    set_element(sensor, simulator.get_mutable_context(), "bias", [0.5, -1.0])
    after = advance(sensor, simulator, range(3, 6))
    np.testing.assert_array_equal(before, [[0.37, 0.37]] * 3)
    np.testing.assert_allclose(after, [[0.87, -0.63]] * 3, atol=1e-15)


def test_a_walk_goes_on_being_shown_when_the_drift_ends() -> None:
    sensor = Constant(ErrorModel(drift=0.2, seed=3))
    simulator = Simulator(sensor)
    last = advance(sensor, simulator, range(10))[-1]
    set_element(sensor, simulator.get_mutable_context(), "drift", [0.0, 0.0])
    np.testing.assert_array_equal(advance(sensor, simulator, range(10, 13)), [last] * 3)
    assert np.all(last != 0.37)


ALL = ErrorModel(noise=0.1, bias=0.2, drift=0.3, quantization=0.01, latency=2, dropout=0.2, seed=11)


def test_same_seed_gives_the_same_bytes_and_another_does_not() -> None:
    assert readings(Ramp(ALL), 100).tobytes() == readings(Ramp(ALL), 100).tobytes()
    assert not np.any(readings(Ramp(ALL), 100, seed=12)[10:] == readings(Ramp(ALL), 100)[10:], axis=1).all()


def test_copy_continues_with_the_same_bytes() -> None:
    sensor = Ramp(ALL)
    simulator = Simulator(sensor)
    advance(sensor, simulator, range(30))
    copied = simulator.get_context().Clone()
    original = advance(sensor, simulator, range(30, 80))
    other = Simulator(sensor, copied)
    other.Initialize(InitializeParams(suppress_initialization_events=True))
    assert advance(sensor, other, range(30, 80)).tobytes() == original.tobytes()


def test_no_two_samples_of_a_stream_are_the_same_draw() -> None:
    draws = [normal_noise(3, seed=1, stream=1, tick=tick) for tick in range(2000)]
    assert np.unique(draws).size == 6000


def test_channels_of_a_stream_are_independent() -> None:
    draws = [normal_noise(2000, seed=1, stream=1, tick=1, channel=channel) for channel in (0, 1)]
    assert abs(np.corrcoef(draws)[0, 1]) < 0.1
    uniform = np.array([uniform_noise(seed=1, stream=1, tick=k, channel=2) for k in range(4000)])
    assert uniform.mean() == pytest.approx(0.5, abs=3 / np.sqrt(12 * 4000))
    assert uniform.var() == pytest.approx(1 / 12, rel=0.05)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("noise", -1.0),
        ("bias", np.nan),
        ("drift", np.inf),
        ("quantization", -0.1),
        ("latency", -1),
        ("latency", 1.5),
        ("dropout", 1.1),
        ("seed", -1),
    ],
)
def test_impossible_errors_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"ErrorModel.{name} must be .*, not {value}"):
        ErrorModel(**{name: value})
    errors = ErrorModel()
    setattr(errors, name, value)
    with pytest.raises(ValueError, match=rf"Ramp.errors.{name} must be .*, not {value}"):
        Ramp(errors)


def test_seed_is_at_most_what_a_double_counts_to() -> None:
    sensor = Ramp(ErrorModel(seed=2**53))
    (seed,) = [element for element in sensor.variables if element.name == "seed"]
    assert seed.bounds == (0.0, 2.0**53)
    with pytest.raises(ValueError, match=r"seed must be"):
        ErrorModel(seed=2**53 + 1)


def test_noise_of_a_sensor_that_has_none_is_refused() -> None:
    class Switch(SampledSensor):
        def __init__(self) -> None:
            super().__init__("y", default=[0.0], period=PERIOD, unit="1", errors=ErrorModel(noise=0.1))

        def _measure(self, context: Context, state: DiscreteValues) -> np.ndarray:
            return np.zeros(1)

    with pytest.raises(ValueError, match="has no noise"):
        Switch()


def test_outliers_have_their_rate_and_size_and_spare_the_rest() -> None:
    samples, p, size = 4000, 0.05, 3.0
    errors = ErrorModel(noise=0.01, outlier_probability=p, outlier_size=size, seed=4)
    off = readings(Ramp(errors), samples) - readings(Ramp(ErrorModel(noise=0.01, seed=4)), samples)
    outliers = (off != 0.0).any(axis=1)
    # The whole sample is an outlier.
    assert (off[outliers] != 0.0).all()
    assert outliers.mean() == pytest.approx(p, abs=4.0 * np.sqrt(p * (1.0 - p) / samples))
    n = off[outliers].size
    assert off[outliers].std() == pytest.approx(size, rel=4.0 / np.sqrt(2.0 * n))


def test_outliers_can_be_set_by_address() -> None:
    always = readings(Ramp(ErrorModel()), 10, outlier_probability=1.0, outlier_size=0.5) - ramp(10)
    n = np.array([normal_noise(2, seed=0, stream=STREAM, tick=k, channel=4) for k in range(10)])
    np.testing.assert_allclose(always, 0.5 * n, atol=1e-15)
    for wrong in ({"outlier_probability": 1.5}, {"outlier_size": -1.0}):
        with pytest.raises(ValueError, match="outlier"):
            Ramp(ErrorModel(**wrong))
