"""The times of a loop's cycles."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake.control.stepping import time_after, times_after


@pytest.mark.parametrize("start", [0.0, 0.3, 0.1 + 0.2, 0.3 + 1e-12, 0.30037, 7.0, 12345.678, -0.5])
@pytest.mark.parametrize("period", [0.001, 0.002, 1.0 / 3.0, 0.25])
@pytest.mark.parametrize("first", [0, 1, 59_000])
def test_times_of_many_steps_are_those_of_each_to_the_last_bit(start: float, period: float, first: int) -> None:
    steps = first + np.arange(1000)
    expected = [time_after(int(k), start=start, period=period) for k in steps]
    assert times_after(steps, start=start, period=period).tolist() == expected


def test_times_of_no_steps_are_none() -> None:
    assert times_after(np.arange(0), start=0.0, period=0.001).shape == (0,)
