"""A sensor signal is relied on while it is fresh and plausible."""

from __future__ import annotations

from math import inf, nan
from typing import Any

import numpy as np
import pytest

from vtbdrake.control.fault import Fault
from vtbdrake.control.limits import Bounds
from vtbdrake.control.received_signal import ReceivedSignal
from vtbdrake.control.sensor_monitor import SensorMonitor
from vtbdrake.control.staleness import faults_at
from vtbdrake.testbed import Signal


def signal(size: int = 2, **options: object) -> Signal:
    return Signal("encoders", size=size, unit="rad", max_age=0.05, **options)


def received(value: object, arrived: float = 0.0, count: int = 1) -> ReceivedSignal:
    return ReceivedSignal(value=value, arrived=arrived, count=count)


def kind(monitor: SensorMonitor, now: float, signal: ReceivedSignal) -> str | None:
    fault = monitor.fault_at(now, signal)
    return fault and fault.kind


@pytest.mark.parametrize("max_age", [0.05, inf])
def test_signal_that_never_arrived_is_stale(max_age: float) -> None:
    monitor = SensorMonitor(Signal("encoders", size=2, max_age=max_age))
    fault = monitor.fault_at(7.0, ReceivedSignal())
    assert (fault.kind, fault.signal, fault.time) == ("stale", "encoders", 7.0)
    assert "never arrived" in str(fault)


def test_signal_is_stale_beyond_max_age() -> None:
    monitor, sample = SensorMonitor(signal()), received(np.zeros(2), arrived=1.0)
    assert kind(monitor, 1.0499, sample) is None
    fault = monitor.fault_at(1.0625, sample)
    assert fault.kind == "stale" and fault.reason == "sensor signal encoders is stale: 62.5 ms old, 50 allowed"
    sample.arrived, sample.count = 1.0625, 2
    assert kind(monitor, 1.0625, sample) is None


def test_stale_signal_tells_which_messages_were_rejected() -> None:
    monitor, sample = SensorMonitor(signal()), ReceivedSignal()
    for _ in range(3):
        sample.reject("not finite")
    reason = "sensor signal encoders has never arrived; messages rejected so far: 3 not finite"
    assert monitor.fault_at(1.0, sample).reason == reason


def refuse(sample: ReceivedSignal, *, times: int) -> None:
    for _ in range(times):
        sample.reject("limits", np.array([0.0, 7.0]))


def test_signal_that_is_refused_more_than_ten_times_in_a_row_is_implausible() -> None:
    monitor, sample = SensorMonitor(Signal("encoders", size=2, lower=-1.0, upper=1.5)), received(np.zeros(2))
    refuse(sample, times=10)
    assert kind(monitor, 1.0, sample) is None
    refuse(sample, times=1)
    fault = monitor.fault_at(1.0, sample)
    assert (fault.kind, fault.signal) == ("implausible", "encoders")
    assert fault.reason == (
        "sensor signal encoders is refused again and again, 11 times so far: encoders[1] is 7, above its limit 1.5"
    )
    for _ in range(3):
        assert kind(monitor, 1.0, sample) == "implausible"
        sample.accept(np.zeros(2), 1.0, 1.0)
    assert kind(monitor, 1.0, sample) is None


@pytest.mark.parametrize(("accepted", "is_fault"), [(1, True), (2, True), (3, False), (10, False)])
def test_signal_of_which_every_third_value_is_refused_is_implausible(accepted: int, is_fault: bool) -> None:
    monitor, sample = SensorMonitor(Signal("encoders", size=2)), received(np.zeros(2))
    faults = set()
    for _ in range(100):
        refuse(sample, times=1)
        faults.add(kind(monitor, 1.0, sample))
        for _ in range(accepted):
            sample.accept(np.zeros(2), 1.0, 1.0)
    assert ("implausible" in faults) == is_fault


def test_messages_out_of_time_are_not_refused_values() -> None:
    monitor, sample = SensorMonitor(Signal("encoders", size=2)), received(np.zeros(2))
    for reason in ("duplicate", "out of order", "ahead of time"):
        for _ in range(20):
            sample.reject(reason)
    assert kind(monitor, 1.0, sample) is None and sample.refused == 0


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ([-2.0, 0.0], "encoders[0] is -2, below its limit -1"),
        ([0.0, nan], "encoders[1] is nan"),
        (None, "truncated"),
    ],
)
def test_refused_value_is_named_with_its_limit(value: list[float] | None, problem: str) -> None:
    monitor, sample = SensorMonitor(signal(lower=-1.0, upper=1.5)), received(np.zeros(2))
    for _ in range(11):
        sample.reject("limits" if value else "truncated", None if value is None else np.array(value))
    assert str(monitor.fault_at(0.0, sample)).endswith(f"11 times so far: {problem}")
    if value is not None:  # Where a signal is too old because of it, too.
        assert str(monitor.fault_at(1.0, sample)).endswith(f"messages rejected so far: 11 limits ({problem})")


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("size", [2, 100])
@pytest.mark.parametrize("place", [0, -1])
def test_non_finite_entry_is_implausible_without_limits(bad: float, size: int, place: int) -> None:
    value = np.zeros(size)
    value[place] = bad
    assert kind(SensorMonitor(signal(size)), 0.0, received(value)) == "implausible"


@pytest.mark.parametrize("size", [2, 100])
def test_entry_beyond_its_limit_is_implausible(size: int) -> None:
    upper = np.ones(size)
    upper[-1] = 2.0
    monitor = SensorMonitor(signal(size, lower=-1.0, upper=upper))
    assert kind(monitor, 0.0, received(upper)) is None
    assert kind(monitor, 0.0, received(1.001 * upper, count=2)) == "implausible"
    assert kind(monitor, 0.0, received(np.full(size, -1.001), count=3)) == "implausible"


@pytest.mark.parametrize("value", [np.zeros(1), np.zeros(3), np.zeros((1, 2))])
def test_sample_of_another_size_is_implausible(value: np.ndarray) -> None:
    assert kind(SensorMonitor(signal()), 0.0, received(value)) == "implausible"


def test_implausible_sample_is_a_fault_until_the_next() -> None:
    monitor, sample = SensorMonitor(signal(upper=1.0)), received(np.array([0.0, 2.0]))
    assert [kind(monitor, now, sample) for now in (0.0, 0.01)] == ["implausible"] * 2
    sample.value, sample.count = np.zeros(2), 2
    assert kind(monitor, 0.02, sample) is None


def test_jump_is_measured_from_last_accepted_sample() -> None:
    monitor = SensorMonitor(signal(rate=[10.0, 1.0]), jump_tolerance=[0.0, 0.001])
    at = [
        received(np.array([0.0, 0.0]), 0.00, 1),
        received(np.array([0.09, 0.0105]), 0.01, 2),
        received(np.array([0.09, 0.0225]), 0.02, 3),
        received(np.array([0.09, 0.0315]), 0.03, 4),
        received(np.array([-0.32, 0.0315]), 0.04, 5),
        received(np.array([-0.32, 0.0315]), 0.08, 6),
    ]
    assert [kind(monitor, r.arrived, r) for r in at] == [None, None, "jump", None, "jump", None]
    assert (monitor.value.tolist(), monitor.arrived) == ([-0.32, 0.0315], 0.08)


def test_repeated_false_level_is_not_accepted() -> None:
    monitor = SensorMonitor(signal(rate=1.0), jump_tolerance=0.01)
    monitor.fault_at(0.0, received(np.zeros(2), 0.0, 1))
    for k in range(2, 500):
        assert kind(monitor, 0.001 * k, received(np.full(2, 0.1), 0.001 * k, k)) == "jump"
    assert monitor.value.tolist() == [0.0, 0.0]
    assert kind(monitor, 0.5, received(np.full(2, 0.02), 0.5, 500)) is None


def test_true_samples_among_false_ones_are_accepted() -> None:
    monitor = SensorMonitor(signal(rate=1.0), jump_tolerance=0.01)
    samples = [received(np.full(2, 0.001 * k + (k % 3 == 1)), 0.001 * k, k + 1) for k in range(300)]
    found = [kind(monitor, r.arrived, r) for r in samples]
    # The very first is taken for true.
    assert found[1:] == ["jump" if k % 3 == 1 else None for k in range(1, 300)]


@pytest.mark.parametrize(("swing", "accepted"), [(0.0, True), (0.5, False)])
def test_steady_level_after_jump_can_be_accepted(swing: float, accepted: bool) -> None:
    monitor, begin = SensorMonitor(signal(rate=1.0), jump_tolerance=0.01), 10.0
    monitor.fault_at(begin, received(np.zeros(2), begin, 1))
    for k in range(2, 100):
        now = begin + 0.001 * k
        monitor.fault_at(now, received(np.full(2, 5.0 + swing * (k % 2)), now, k))
    monitor.accept_steady()
    assert monitor.value.tolist() == [0.0, 0.0], "not yet"
    for k in range(100, 104):
        now = begin + 0.001 * k
        last = received(np.full(2, 5.0 + swing * (k % 2)), now, k)
        monitor.fault_at(now, last)
    monitor.accept_steady()
    assert (kind(monitor, now, last) is None) == accepted


def test_longer_silence_allows_a_larger_change() -> None:
    monitor = SensorMonitor(signal(rate=1.0), jump_tolerance=0.0)
    assert kind(monitor, 0.0, received(np.zeros(2), 0.0, 1)) is None
    assert kind(monitor, 0.5, received(np.full(2, 0.49), 0.5, 2)) is None


def test_jump_is_a_fault_until_the_next_sample() -> None:
    monitor = SensorMonitor(signal(rate=1.0), jump_tolerance=0.0)
    monitor.fault_at(0.0, received(np.zeros(2), 0.0, 1))
    jumped = received(np.ones(2), 0.01, 2)
    assert [kind(monitor, now, jumped) for now in (0.01, 0.011)] == ["jump", "jump"]


def test_old_sample_is_no_jump() -> None:
    monitor, sample = SensorMonitor(signal(rate=1.0), jump_tolerance=0.0), received(np.zeros(2))
    for now in (0.0, 0.001, 0.002):
        assert kind(monitor, now, sample) is None


def test_only_age_of_abstract_signal_is_checked() -> None:
    monitor = SensorMonitor(Signal("picture", model_value="", max_age=0.1))
    assert kind(monitor, 0.0, received("cat")) is None
    assert kind(monitor, 0.2, received("cat")) == "stale"


def test_value_checked_against_other_bounds_is_checked_again() -> None:
    wide, narrow = signal(upper=2.0), signal(upper=1.0)
    sample = ReceivedSignal(value=np.full(2, 1.5), arrived=0.0, count=1, bounds=Bounds(wide))
    assert kind(SensorMonitor(narrow), 0.0, sample) == "implausible"
    assert kind(SensorMonitor(wide), 0.0, sample) is None


@pytest.mark.parametrize(
    ("options", "expected"), [({"jump_tolerance": 0.01}, "jump"), ({"max_delay": 0.02}, "stale"), ({}, None)]
)
def test_jump_and_delay_are_noticed_in_values_that_the_bridge_has_checked(
    options: dict[str, float], expected: str | None
) -> None:
    limited = signal(rate=1.0, upper=2.0)
    monitor, bounds = SensorMonitor(limited, **options), Bounds(limited)
    faults = []
    for count, (position, sent, arrived) in enumerate([(0.0, 0.0, 0.0), (0.0, 0.01, 0.01), (1.0, 0.02, 0.06)]):
        sample = ReceivedSignal(value=np.full(2, position), sent=sent, arrived=arrived, count=count + 1, bounds=bounds)
        faults.append(kind(monitor, arrived, sample))
    assert faults == [None, None, expected]


@pytest.mark.parametrize(
    ("value", "reason"),
    [(np.zeros(3), "has the shape (3,) instead of (2,)"), (np.array([0.0, 2.0]), "leaves its limits: [0.0, 2.0]")],
)
def test_size_and_limits_are_told_apart(value: np.ndarray, reason: str) -> None:
    fault = SensorMonitor(signal(upper=1.0)).fault_at(0.0, received(value))
    assert fault.reason == f"sensor signal encoders {reason}"


def delays(*samples: tuple[float, float], max_delay: float = 0.02) -> list[str | None]:
    """The faults for samples of (sent, arrived)."""
    monitor = SensorMonitor(signal(), max_delay=max_delay)
    given = [
        ReceivedSignal(value=np.zeros(2), sent=sent, arrived=arrived, count=k + 1)
        for k, (sent, arrived) in enumerate(samples)
    ]
    return [kind(monitor, sample.arrived, sample) for sample in given]


def test_sample_with_excess_latency_is_stale() -> None:
    assert delays((100.0, 5.0), (100.01, 5.02), (100.02, 5.05), (100.03, 5.04)) == [None, None, "stale", None]


def test_quickest_sample_need_not_be_the_first() -> None:
    assert delays((100.0, 5.03), (100.01, 5.01), (100.02, 5.05)) == [None, None, "stale"]


def test_latency_is_measured_anew_after_clock_reset() -> None:
    assert delays((100.0, 5.0), (90.0, 5.01), (90.01, 5.05)) == [None, None, "stale"]


def test_slowly_drifting_clocks_make_nothing_stale() -> None:
    drift = 400e-6
    assert set(delays(*[(k * (1.0 - drift), float(k)) for k in range(1000)])) == {None}


def test_sample_without_time_stamp_has_no_latency() -> None:
    assert delays((nan, 5.0), (nan, 6.0)) == [None, None]


def test_max_delay_must_be_positive() -> None:
    with pytest.raises(ValueError, match="positive max_delay"):
        SensorMonitor(signal(), max_delay=0.0)


def test_jump_tolerance_needs_a_vector_with_finite_rate() -> None:
    with pytest.raises(ValueError, match="finite rate"):
        SensorMonitor(signal(), jump_tolerance=0.1)
    with pytest.raises(ValueError, match="abstract"):
        SensorMonitor(Signal("picture", model_value=""), jump_tolerance=0.1)
    with pytest.raises(ValueError, match="not negative"):
        SensorMonitor(signal(rate=1.0), jump_tolerance=[0.1, -0.1])


def test_value_is_examined_once() -> None:
    class Counting(SensorMonitor):
        examined = 0

        def examine(self, now: float, received: ReceivedSignal) -> Fault | None:
            self.examined += 1
            return super().examine(now, received)

    monitor, sample = Counting(signal(upper=1.0)), received(np.full(2, 2.0))
    assert [kind(monitor, now, sample) for now in (0.0, 0.02, 0.06)] == ["implausible", "implausible", "stale"]
    assert monitor.examined == 1


def test_only_a_received_signal_is_checked() -> None:
    nothing: Any = None
    with pytest.raises(TypeError, match="takes the ReceivedSignal of the signal, not None"):
        SensorMonitor(signal()).fault_at(0.0, nothing)
    with pytest.raises(TypeError, match="StalenessMonitor"):
        faults_at(0.0, {"a": nothing}, {"a": ReceivedSignal()})
