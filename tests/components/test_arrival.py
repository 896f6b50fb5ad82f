"""Samples arrive at a DPS with their dates: from sensors that sample by another clock, drop out and are late."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.sensors import ImageRgba8U

from vtbdrake.common.scan import Scan
from vtbdrake.components.arrival import Arrival
from vtbdrake.testbed import SlowPart

PERIOD = 0.02


class Received:
    """An `Arrival` whose signal is set by hand between the periods, and a part on request that reads its samples."""

    def __init__(self, model: Any, *, age: float = PERIOD) -> None:
        builder = DiagramBuilder()
        self.arrival = builder.AddNamedSystem("arrival", Arrival(model, period=PERIOD, age=age))
        self.calls: list[tuple[float, Any]] = []
        part = SlowPart(
            self._evaluate,
            inputs={"sample": model.size if isinstance(model, np.ndarray) else model, "time": 1},
            outputs={"y": 1},
            period=PERIOD,
            latency=3 * PERIOD,
            offset=PERIOD,
            on_request=True,
        )
        builder.AddNamedSystem("part", part)
        for output, port in {"sample": "sample", "time": "time", "number": "request"}.items():
            builder.Connect(self.arrival.GetOutputPort(output), part.GetInputPort(port))
        builder.ExportInput(self.arrival.GetInputPort("signal"), "signal")
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.own: Context = self.arrival.GetMyContextFromRoot(self.simulator.get_context())
        self.show(model)

    def _evaluate(self, sample: Any, time: np.ndarray, request: np.ndarray) -> np.ndarray:
        self.calls.append((float(time[0]), sample))
        return request

    def show(self, value: Any) -> None:
        port = self.diagram.GetInputPort("signal")
        port.FixValue(self.simulator.get_mutable_context(), value if isinstance(value, np.ndarray) else Value(value))

    def advance(self, time: float) -> None:
        self.simulator.AdvanceTo(time)

    def read(self, port: str) -> Any:
        return self.arrival.GetOutputPort(port).Eval(self.own)

    @property
    def number(self) -> float:
        return float(self.read("number")[0])

    @property
    def time(self) -> float:
        return float(self.read("time")[0])


def image(brightness: int) -> ImageRgba8U:
    found = ImageRgba8U(8, 6)
    found.mutable_data[:] = brightness
    return found


@pytest.mark.parametrize("phase", [0.003, 0.011, 0.017])
def test_dates_are_within_a_period_whenever_the_sensor_samples(phase: float) -> None:
    received = Received(image(0), age=0.0)
    taken = phase + 0.13 * np.arange(12)
    for k, t in enumerate(taken):
        received.advance(t)
        received.show(image(k + 1))
        received.advance(t + PERIOD)
        assert received.number == k + 1
        assert t <= received.time < t + PERIOD
        np.testing.assert_array_equal(received.read("sample").data, image(k + 1).data)
    received.advance(2.0)
    # Each sample was evaluated once, with its own date.
    assert [sample.data[0, 0, 0] for _, sample in received.calls] == list(range(1, 13))
    assert all(t <= time < t + PERIOD for t, (time, _) in zip(taken, received.calls, strict=True))


def test_image_that_stays_has_not_arrived_again() -> None:
    received = Received(image(0))
    received.show(image(5))
    received.advance(0.11)
    first = received.time
    received.show(image(5))  # As after a drop-out: another object.
    received.advance(0.31)
    assert (received.number, received.time) == (1.0, first)
    received.advance(0.4)
    assert len(received.calls) == 1


def test_age_is_subtracted_but_nothing_was_taken_before_the_start() -> None:
    received = Received(image(0), age=0.1)
    received.show(image(1))
    received.advance(0.05)
    assert (received.number, received.time) == (1.0, 0.0)
    received.show(image(2))
    received.advance(0.31)
    received.show(image(3))
    received.advance(0.33)
    assert received.time == pytest.approx(0.32 - 0.1)


def test_scan_of_another_clock_is_dated_by_its_arrival() -> None:
    received = Received(Scan.empty(), age=PERIOD)
    received.advance(0.05)
    assert received.number == 0.0
    for k, stamp in enumerate((1.7e9, 1.7e9 + 0.5, 12.0)):  # The satellite's computer starts again.
        received.show(Scan([[1.0, 0.0, 0.0]], [2.0], [-0.1], stamp))
        received.advance(0.2 * (k + 1) + 0.01)
        assert received.number == k + 1
        assert received.read("sample").stamp == stamp
    assert received.time == pytest.approx(0.42 - PERIOD)


def test_points_that_are_not_finite_are_no_news() -> None:
    cloud = PointCloud(3, Fields(int(BaseField.kXYZs)))
    cloud.mutable_xyzs()[:] = np.nan
    received = Received(cloud)
    received.show(PointCloud(cloud))
    received.advance(0.1)
    assert received.number == 0.0


def test_vector_signals_arrive_like_others() -> None:
    received = Received(np.zeros(3), age=PERIOD)
    for k in range(4):
        received.show(np.array([1.0, 2.0, k // 2]))
        received.advance(0.2 * (k + 1) + 0.01)
    assert received.number == 2.0 and received.time == pytest.approx(0.42 - PERIOD)
    np.testing.assert_array_equal([sample for _, sample in received.calls], [[1.0, 2.0, 0.0], [1.0, 2.0, 1.0]])


@pytest.mark.parametrize(
    ("times", "told"), [({"period": 0.0, "age": 0.0}, "period"), ({"period": 1.0, "age": -1.0}, "age")]
)
def test_impossible_times_are_refused(times: dict[str, float], told: str) -> None:
    with pytest.raises(ValueError, match=f"the {told} is"):
        Arrival(Scan.empty(), **times)
