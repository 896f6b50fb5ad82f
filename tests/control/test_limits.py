"""Limits of values: bounds and jumps agree with numpy; the rate limiter keeps all limits and changes nothing else."""

from __future__ import annotations

import math
from math import inf, nan
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vtbdrake.control.limits import ActuationError, Bounds, JumpBounds, PassThrough, RateLimiter
from vtbdrake.testbed import Signal

T = 1e-3
EPS = np.finfo(float).eps


def signal(size: int = 1, **limits: object) -> Signal:
    return Signal("joint_position", size=size, unit="rad", idle=0.0, **limits)


def limiter(start: float | None = 0.0, **limits: object) -> RateLimiter:
    made = RateLimiter(signal(**limits), period=T)
    if start is not None:
        made.start_from([start])
    return made


def way_to_rest(w: float, a: float) -> float:
    """The way of a step w and all that follow it while each is shorter by a."""
    way = 0.0
    while w > 0.0:
        way, w = way + w, w - a
    return way


def longest_step(d: float, a: float, most: float = 5e-3) -> float:
    """Return by bisection the longest step, up to ``most``, after which there is a rest within d."""
    low, high = 0.0, min(d, most)
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if way_to_rest(middle, a) <= d else (low, middle)
    return low


positive = st.floats(1e-2, 1e3)
limited = st.one_of(positive, st.just(inf))
entry = st.one_of(st.floats(-5.0, 5.0), st.floats(allow_nan=False, allow_infinity=False))


@given(
    rate=limited,
    acceleration=st.one_of(st.floats(1.0, 1e4), st.just(inf)),
    lower=st.one_of(st.floats(-3.0, 0.0), st.just(-inf)),
    upper=st.one_of(st.floats(0.0, 3.0), st.just(inf)),
    start=st.floats(-1.0, 1.0),
    commands=st.lists(st.tuples(entry, st.integers(1, 30)), min_size=1, max_size=20),
)
def test_sent_commands_keep_all_limits(
    rate: float,
    acceleration: float,
    lower: float,
    upper: float,
    start: float,
    commands: list[tuple[float, int]],
) -> None:
    one = limiter(None, rate=rate, acceleration=acceleration, lower=lower, upper=upper)
    one.start_from([start])
    before = min(max(start, lower), upper)
    step_before = 0.0
    width = max((abs(bound) for bound in (lower, upper) if bound not in (-inf, inf)), default=0.0)
    assert one.last_sent == before
    for command, times in commands:
        for _ in range(times):
            sent = one.limit([command]).item()
            step = sent - before
            rounding = 8 * EPS * max(abs(sent), abs(before), abs(step_before), width)
            assert lower <= sent <= upper
            assert abs(step) <= rate * T + rounding
            assert abs(step - step_before) <= acceleration * T**2 + rounding
            before, step_before = sent, step


@given(
    acceleration=st.floats(50.0, 1e4),
    upper=st.floats(0.01, 0.5),
    waits=st.integers(0, 60),
)
def test_steps_are_the_longest_allowed(acceleration: float, upper: float, waits: int) -> None:
    a, rate = acceleration * T**2, 5.0
    one = limiter(rate=rate, acceleration=acceleration, upper=upper)
    position, step = 0.0, 0.0
    for _ in range(waits):
        sent = one.limit([1e6]).item()
        expected = min(rate * T, step + a, longest_step(upper - position, a))
        assert sent - position == pytest.approx(expected, rel=1e-9, abs=1e-12)
        position, step = sent, sent - position


@settings(max_examples=30)
@given(acceleration=st.floats(100.0, 1e4), upper=st.floats(0.01, 0.2), excess=st.floats(1e-6, 0.02))
def test_command_that_cannot_stop_is_reduced(acceleration: float, upper: float, excess: float) -> None:
    a, rate = acceleration * T**2, 5.0
    one = limiter(rate=rate, acceleration=acceleration, upper=upper)
    position, step = 0.0, 0.0
    for _ in range(100):
        most = min(rate * T, step + a, longest_step(upper - position, a))
        sent = one.limit([position + most * (1.0 + excess)]).item()
        assert sent - position == pytest.approx(most, rel=1e-9, abs=1e-12)
        position, step = sent, sent - position


@pytest.mark.parametrize("limits", [{"acceleration": 1.0 / T**2}, {"rate": 1.0 / T}])
def test_command_at_the_limit_passes_without_rounding(limits: dict[str, float]) -> None:
    for side in (1.0, -1.0):
        one = limiter(-side, **limits, lower=min(-side, 0.0), upper=max(-side, 0.0))
        assert one.limit([-side * 1e-300]).item() == -side * 1e-300


@given(st.lists(st.floats(-0.999, 0.999), min_size=1, max_size=60))
def test_sequence_that_can_continue_passes_unchanged(shares: list[float]) -> None:
    rate, acceleration, bound = 0.5, 20.0, 0.002
    a = acceleration * T**2
    one = limiter(rate=rate, acceleration=acceleration, lower=-bound, upper=bound)
    s, x = 0.0, 0.0
    for share in shares:
        most = min(rate * T, x + a, longest_step(bound - s, a))
        least = max(-rate * T, x - a, -longest_step(bound + s, a))
        command = s + 0.5 * (most + least) + 0.5 * share * (most - least)
        assert one.limit([command]).item() == command
        s, x = command, command - s
    assert [count.changed for count in one.counts.values()] == [0, 0, 0]


def test_motion_from_end_to_end_of_the_range_passes_unchanged() -> None:
    bound, frequency = 0.3, 4.0
    one = limiter(
        -bound, rate=1.01 * bound * frequency, acceleration=1.01 * bound * frequency**2, lower=-bound, upper=bound
    )
    for k in range(2000):
        command = -bound * math.cos(frequency * k * T)
        assert one.limit([command]).item() == command


def test_step_command_takes_the_time_of_full_acceleration_and_full_braking() -> None:
    one = limiter(rate=inf, acceleration=10.0, upper=0.4)
    sent = [one.limit([1.0]).item() for _ in range(1000)]
    first_at_end = next(k for k, s in enumerate(sent, 1) if s >= 0.4 - 1e-9)
    assert first_at_end * T == pytest.approx(2.0 * math.sqrt(0.4 / 10.0), abs=2 * T)
    assert sent[-1] == 0.4


def test_speed_before_the_end_is_that_of_constant_braking() -> None:
    one = limiter(rate=inf, acceleration=10.0, upper=0.4)
    before = 0.0
    while (sent := one.limit([1.0]).item()) < 0.3:
        before = sent
    assert (sent - before) / T == pytest.approx(math.sqrt(2.0 * 10.0 * 0.1), rel=0.02)


def test_hold_after_motion_brakes_at_the_limit_of_acceleration() -> None:
    one = limiter(rate=1.0, acceleration=10.0)
    for _ in range(50):
        one.limit([10.0])
    steps = []
    for _ in range(60):
        before = one.last_sent
        steps.append((one.limit(before) - before).item() / T)
    expected = [max(0.0, 0.5 - 0.01 * k) for k in range(1, 61)]
    assert steps == pytest.approx(expected, abs=1e-9)


def test_every_entry_has_its_own_limits() -> None:
    one = RateLimiter(signal(3, rate=[1.0, 2.0, inf], lower=-1.0, upper=[1.0, 1.0, 0.5]), period=T)
    one.start_from([0.0, 0.5, 0.0])
    assert one.limit([1.0, -1.0, 2.0]).tolist() == [1e-3, 0.5 - 2e-3, 0.5]


def test_counts_contain_number_and_size_of_changes() -> None:
    one = limiter(rate=1.0, upper=0.0015)
    one.limit([0.0005])
    one.limit([0.1])
    one.limit([0.2])
    assert {name: count.changed for name, count in one.counts.items()} == {"range": 1, "rate": 1, "acceleration": 0}
    assert one.counts["rate"].largest == pytest.approx(0.1 - 0.0015)
    assert one.counts["range"].largest == pytest.approx(0.2 - 0.0015)


def test_acceleration_limit_is_counted() -> None:
    one = limiter(acceleration=10.0)
    one.limit([1.0])
    assert one.counts["acceleration"].changed == 1
    assert one.counts["acceleration"].largest == pytest.approx(1.0 - 1e-5)


@pytest.mark.parametrize("rate", [0.7e-6, 0.7, 0.7e6])
def test_rounding_at_a_limit_is_not_counted(rate: float) -> None:
    one = limiter(rate=rate)
    for k in range(1, 1000):
        command = rate * k * T
        assert one.limit([command]).item() == pytest.approx(command, rel=1e-14)
    assert one.counts["rate"].changed == 0
    one.limit([rate * 1001.001 * T])  # by a millionth of the way to it
    assert one.counts["rate"].changed == 1


def test_commands_depart_from_start_at_rest() -> None:
    one = limiter(acceleration=10.0)
    for _ in range(100):
        one.limit([1.0])
    one.start_from([0.3])
    assert one.limit([1.0]).item() == pytest.approx(0.3 + 1e-5, rel=1e-12)


@pytest.mark.parametrize(
    "limits", [{"rate": 1.0}, {"acceleration": 1.0}, {"rate": [inf, 1.0]}, {"acceleration": [1.0, inf]}]
)
def test_rate_limit_without_start_is_an_error(limits: dict[str, Any]) -> None:
    one = RateLimiter(signal(2, **limits), period=T)
    assert one.needs_start and not one.has_start
    with pytest.raises(ActuationError, match="nothing to depart from") as caught:
        one.limit([0.0, 0.0])
    assert caught.value.kind == "not started"


def test_range_alone_needs_no_start() -> None:
    one = limiter(None, lower=-1.0, upper=1.0)
    assert [one.limit([c]).item() for c in (3.0, -0.5, -2.0)] == [1.0, -0.5, -1.0]


def test_released_limiter_forgets_last_command() -> None:
    one = limiter(rate=1.0)
    one.release()
    assert one.last_sent is None and not one.has_start


@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_non_finite_entry_is_an_error_and_changes_nothing(bad: float) -> None:
    one = RateLimiter(signal(2, rate=1.0), period=T)
    one.start_from([0.0, 0.0])
    with pytest.raises(ActuationError, match="not finite") as caught:
        one.limit([1.0, bad])
    assert caught.value.kind == "not finite"
    assert one.last_sent.tolist() == [0.0, 0.0]


def test_large_finite_entries_are_finite() -> None:
    one = RateLimiter(signal(2, lower=-1.0, upper=1.0), period=T)
    assert one.limit([1.7e308, 1.7e308]).tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    "bad", [[0.0], [0.0, 0.0, 0.0], 0.0, [[0.0, 0.0]], None, "ab", [0.0, "x"], [[0.0], [1.0, 2.0]]]
)
def test_command_of_another_size_is_an_error(bad: object) -> None:
    one = RateLimiter(signal(2), period=T)
    with pytest.raises(ActuationError) as caught:
        one.limit(bad)
    assert caught.value.kind == "size"


@pytest.mark.parametrize("period", [0.0, -1.0, nan, inf])
def test_period_must_be_positive(period: float) -> None:
    with pytest.raises(ValueError, match="positive period"):
        RateLimiter(signal(), period=period)


@pytest.mark.parametrize("limit", ["rate", "acceleration"])
@pytest.mark.parametrize("value", [1e-300, [1.0, 1e-300]])
def test_limits_without_any_step_are_rejected(limit: str, value: float | list[float]) -> None:
    with pytest.raises(ValueError, match="leave no step"):
        RateLimiter(signal(2, **{limit: value}), period=T)


def test_abstract_signal_is_remembered_without_limits() -> None:
    picture = Signal("lamp", model_value="off", idle="off")
    with pytest.raises(ValueError, match="abstract"):
        RateLimiter(picture, period=T)
    one = PassThrough()
    assert not one.needs_start and not one.has_start
    assert one.limit("on") == "on" and one.last_sent == "on" and one.has_start
    with pytest.raises(ActuationError):
        one.limit(None)
    one.limit("dim")
    one.retract()
    assert one.last_sent == "on"
    one.release()
    assert not one.has_start


# -- bounds of values

VECTOR = st.lists(st.floats(-2.0, 2.0) | st.sampled_from([nan, inf, -inf]), min_size=3, max_size=3)
BOUND = st.lists(st.floats(-2.0, 2.0) | st.sampled_from([inf, -inf]), min_size=3, max_size=3)


@given(BOUND, VECTOR, BOUND)
def test_bounds_agree_with_numpy(lower: list[float], entries: list[float], upper: list[float]) -> None:
    lower, upper = np.minimum(lower, upper), np.maximum(lower, upper)
    bounds = Bounds(Signal("a", size=3, lower=lower, upper=upper))
    finite = np.isfinite(entries).all()
    expected = (
        "" if finite and ((lower <= entries) & (entries <= upper)).all() else "limits" if finite else "not finite"
    )
    assert bounds.violation(np.array(entries)) == expected


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ([0.5, 0.5], ""),
        ((0.5, 9.0), "limits"),
        (np.ones(2, dtype=np.float32), ""),
        (np.ones(2, dtype=">f8"), ""),
        (np.ones(4)[::2], ""),
        (np.ones((2, 1)), "size"),
        (np.array(1.0), "size"),
        (np.ones(3), "size"),
        ([1.0, "x"], "type"),
        ([[1.0], [1.0, 2.0]], "type"),
        (None, "size"),
    ],
)
def test_bounds_convert_other_arrays(value: Any, problem: str) -> None:
    assert Bounds(Signal("a", size=2, lower=-1.0, upper=1.0)).violation(value) == problem


def test_read_only_array_is_a_value() -> None:
    value = np.ones(2)
    value.flags.writeable = False
    assert Bounds(Signal("a", size=2)).violation(value) == ""
    assert RateLimiter(signal(2), period=T).limit(value).tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("value", "problem"), [([1.0], ""), ([1.5], "limits"), ([nan], "not finite"), ([1, 1], "size")]
)
def test_bounds_of_a_single_entry_are_checked(value: list[float], problem: str) -> None:
    assert Bounds(signal(1, lower=-1.0, upper=1.0)).violation(value) == problem


def test_abstract_value_has_its_type() -> None:
    bounds = Bounds(Signal("picture", model_value="", idle=""))
    assert [bounds.violation(value) for value in ("cat", 1.0)] == ["", "type"]


def test_bounds_of_equal_signals_are_equal() -> None:
    wide, narrow = Signal("a", size=2, upper=2.0), Signal("a", size=2, upper=1.0)
    assert Bounds(wide) == Bounds(Signal("b", size=2, upper=[2.0, 2.0])) != Bounds(narrow)
    assert Bounds(signal(1, upper=2.0)) == Bounds(signal(1, upper=2.0)) != Bounds(signal(1, upper=1.0))
    assert Bounds(Signal("a", model_value="", idle="")) != Bounds(wide)


@given(VECTOR, VECTOR, st.floats(0.0, 1.0))
def test_jump_bounds_agree_with_numpy(before: list[float], value: list[float], seconds: float) -> None:
    rate, tolerance = np.array([1.0, 2.0, 0.5]), np.array([0.1, 0.0, 1.0])
    with np.errstate(invalid="ignore"):
        expected = (abs(np.subtract(value, before)) <= rate * seconds + tolerance).all()
    assert JumpBounds(rate, tolerance).contains(np.array(before), np.array(value), seconds) == expected


@pytest.mark.parametrize("bad", [[0.0, 0.0], np.zeros(3), np.zeros(2, dtype=np.float32), None])
def test_jump_bounds_contain_arrays_of_their_size_only(bad: Any) -> None:
    bounds, good = JumpBounds([1.0, 1.0], [1.0, 1.0]), np.zeros(2)
    assert bounds.contains(good, good, 1.0)
    assert not bounds.contains(bad, good, 1.0)
    assert not bounds.contains(good, bad, 1.0)
    assert not bounds.contains(bad, bad, 1.0)


def test_jump_bounds_of_different_sizes_are_rejected() -> None:
    with pytest.raises(ValueError, match="different sizes: 3 and 1"):
        JumpBounds([1.0] * 3, [0.0])


# -- commands that did not leave


@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.booleans()), max_size=40))
def test_command_taken_back_leaves_no_trace(commands: list[tuple[float, bool]]) -> None:
    one, other = (limiter(rate=50.0, acceleration=1e4, upper=0.5) for _ in range(2))
    for command, leaves in commands:
        sent = one.limit([command])
        if leaves:
            assert other.limit([command]) == sent
        else:
            one.retract()
        assert one.last_sent == other.last_sent


# -- times between commands


@given(
    rate=positive,
    acceleration=st.one_of(st.floats(1.0, 1e4), st.just(inf)),
    bound=st.one_of(st.floats(0.01, 3.0), st.just(inf)),
    commands=st.lists(st.tuples(entry, st.sampled_from([0.0, 1e-5, 0.02, 0.3, 0.999, 1.0, 1.7, 40.0])), max_size=60),
)
def test_commands_at_any_times_keep_rate_and_range(
    rate: float, acceleration: float, bound: float, commands: list[tuple[float, float]]
) -> None:
    one = limiter(rate=rate, acceleration=acceleration, lower=-bound, upper=bound)
    one.limit([0.0], 0.0)
    now, counted, before = 0.0, 0.0, 0.0
    for command, periods in commands:
        now += periods * T
        sent = one.limit([command], now).item()
        most = rate * min(now - counted, T) if now > counted else 0.0
        rounding = 8 * EPS * max(abs(sent), abs(before)) + 1e-6 * most
        assert abs(sent - before) <= most + rounding
        assert -bound <= sent <= bound
        if now - counted > 1e-3 * T:
            counted = now
        before = sent


@given(
    acceleration=st.floats(1.0, 1e4),
    commands=st.lists(st.tuples(st.floats(-5.0, 5.0), st.floats(0.01, 2.0)), max_size=60),
)
def test_commands_at_any_times_keep_the_acceleration(acceleration: float, commands: list[tuple[float, float]]) -> None:
    one = limiter(acceleration=acceleration)
    one.limit([0.0], 0.0)
    now, before, velocity = 0.0, 0.0, 0.0
    for command, periods in commands:
        now += periods * T
        sent = one.limit([command], now).item()
        time = min(periods, 1.0) * T
        change = (sent - before) / time - velocity
        assert abs(change) <= acceleration * time * (1 + 1e-5) + 8 * EPS * max(abs(sent), abs(before)) / time
        before, velocity = sent, (sent - before) / time


@given(st.integers(0, 2**32 - 1))
def test_motion_comes_to_rest_in_the_range_at_any_times(seed: int) -> None:
    """Limits that contradict each other change the velocity by no more than it may change in a whole period."""
    random = np.random.default_rng(seed)
    acceleration, upper = 10.0 ** random.uniform(1.0, 4.0), random.uniform(0.001, 0.1)
    one = limiter(acceleration=acceleration, upper=upper)
    one.limit([0.0], 0.0)
    now, before, velocity = 0.0, 0.0, 0.0
    for _ in range(3000):
        share = random.choice([random.uniform(0.01, 1.0), 1.0])
        now += share * T
        sent = one.limit([1.0], now).item()
        new = (sent - before) / (share * T)
        rounding = 8 * EPS * upper / (share * T)
        assert abs(new - velocity) <= acceleration * T * (1 + 1e-5) + rounding
        assert sent <= upper
        before, velocity = sent, new
        if sent == upper:
            break
    assert sent == pytest.approx(upper, rel=1e-3)


@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    acceleration=st.floats(50.0, 1e4),
    upper=st.floats(1e-4, 0.1),
    side=st.sampled_from([1.0, -1.0]),
)
def test_steps_are_the_longest_allowed_at_any_times(seed: int, acceleration: float, upper: float, side: float) -> None:
    random = np.random.default_rng(seed)
    a, rate = acceleration * T**2, 5.0
    one = limiter(rate=rate, acceleration=acceleration, lower=-upper, upper=upper)
    now, position, step = 0.0, one.limit([0.0], 0.0).item(), 0.0
    for _ in range(80):
        share = random.choice([random.uniform(0.01, 0.99), 1.0])
        now += share * T
        sent = side * one.limit([side * 1e6], now).item()
        r = min(share, 1.0)
        most = min(r * rate * T, r * step + a * r**2, r * longest_step_of_share(upper - position, a, r))
        assert sent - position == pytest.approx(most, rel=1e-6, abs=1e-9 * upper)
        position, step = sent, (sent - position) / r


def longest_step_of_share(d: float, a: float, r: float) -> float:
    """Return by bisection the longest step w of a period, with a share r of it taken, and a rest within d."""
    low, high = 0.0, d / r
    for _ in range(80):
        middle = 0.5 * (low + high)
        way = r * middle + way_to_rest(middle - a, a)
        low, high = (middle, high) if way <= d else (low, middle)
    return low


@pytest.mark.parametrize(
    ("share", "counted"),
    [
        (1.0 - 0.5e-6, 1.0),  # times are rounded
        (1.0 + 0.5e-6, 1.0),
        (1.0 - 1.5e-6, 1.0 - 1.5e-6),
        (0.0015, 0.0015),
        (0.0009, 0.0),
    ],
)
def test_time_counts_as_a_share_of_the_period(share: float, counted: float) -> None:
    one = limiter(rate=1.0)
    one.limit([0.0], 0.0)
    assert one.limit([1.0], share * T).item() == pytest.approx(counted * T, rel=1e-8, abs=1e-30)


def test_short_times_add_up() -> None:
    one = limiter(rate=1.0)
    one.limit([0.0], 0.0)
    sent = [one.limit([1.0], 1e-4 * T * k).item() for k in range(1, 1001)]
    assert sent[-1] == pytest.approx(0.1 * T, abs=1.1e-3 * T)
    assert max(np.diff(sent)) <= 1.2e-3 * T


def test_command_at_the_same_time_keeps_the_velocity() -> None:
    one = limiter(acceleration=10.0)
    a = 10.0 * T**2
    sent = [one.limit([1.0], at).item() for at in (0.0, 0.0, T, T, 2.0 * T)]
    assert sent == pytest.approx([a, a, 3.0 * a, 3.0 * a, 6.0 * a], rel=1e-9)


def test_clock_that_is_set_back_holds_for_one_command() -> None:
    one = limiter(rate=1.0)
    sent = [one.limit([1.0], at).item() for at in (0.0, T, -3600.0, -3600.0 + T)]
    assert sent == pytest.approx([T, 2 * T, 2 * T, 3 * T])
