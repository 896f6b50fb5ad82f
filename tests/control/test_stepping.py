"""Tests of the stepped target: the times of its steps, and the parameters that are kept alive meanwhile."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from pydrake.systems.framework import BasicVector, Diagram, DiagramBuilder, LeafSystem

from vtbdrake.control.stepping import numeric_parameters, time_after


@pytest.mark.parametrize("start", [0.0, 0.3, 0.1 + 0.2, 0.3 + 1e-12, 7.0, -0.5])
@pytest.mark.parametrize("period", [0.001, 0.002])
def test_times_on_the_grid_are_multiples_of_the_period(start: float, period: float) -> None:
    first = round(start / period)
    for steps in (1, 2, 999, 59_000):
        assert time_after(steps, start=start, period=period) == (first + steps) * period


def test_times_off_the_grid_count_from_the_start() -> None:
    assert time_after(0, start=0.30037, period=0.001) == 0.30037
    assert time_after(59_000, start=0.30037, period=0.001) == 0.30037 + 59_000 * 0.001


class _Two(LeafSystem):
    def __init__(self, first: float) -> None:
        super().__init__()
        self.DeclareNumericParameter(BasicVector([first]))
        self.DeclareNumericParameter(BasicVector([first + 1.0, first + 2.0]))


def _nested() -> tuple[Diagram, Diagram, _Two]:
    inner, outer, system = DiagramBuilder(), DiagramBuilder(), _Two(1.0)
    inner.AddSystem(system)
    part = inner.Build()
    outer.AddSystem(_Two(10.0))
    outer.AddSystem(part)
    return outer.Build(), part, system


def _values(vectors: list[BasicVector]) -> list[list[float]]:
    return [vector.value().tolist() for vector in vectors]


def test_numeric_parameters_are_all_below_a_diagram() -> None:
    whole, part, _ = _nested()
    context = whole.CreateDefaultContext()
    assert _values(numeric_parameters(whole, context)) == [[10.0], [11.0, 12.0], [1.0], [2.0, 3.0]]
    assert _values(numeric_parameters(part, context)) == [[1.0], [2.0, 3.0]]


def test_system_gets_the_wrapper_that_is_kept() -> None:
    whole, part, system = _nested()
    context = whole.CreateDefaultContext()
    held = numeric_parameters(part, context)
    assert system.GetMyContextFromRoot(context).get_numeric_parameter(1) is held[1]
    assert system.GetMyContextFromRoot(context.Clone()).get_numeric_parameter(1) is not held[1]


def test_kept_wrapper_shows_new_values() -> None:
    whole, _, system = _nested()
    context, other = whole.CreateDefaultContext(), whole.CreateDefaultContext()
    held = numeric_parameters(whole, context)
    system.GetMyMutableContextFromRoot(context).get_mutable_numeric_parameter(1).SetFromVector([5.0, 6.0])
    assert held[3].value().tolist() == [5.0, 6.0]
    context.SetTimeStateAndParametersFrom(other)
    own = system.GetMyContextFromRoot(context)
    np.testing.assert_array_equal(own.get_numeric_parameter(1).value(), [2.0, 3.0])


def test_reading_parameters_leaks_no_references() -> None:
    whole, _, system = _nested()
    context = whole.CreateDefaultContext()
    held = numeric_parameters(whole, context)
    own = system.GetMyContextFromRoot(context)
    before = sys.getrefcount(own), sys.getrefcount(held[3])
    for _ in range(100):
        own.get_numeric_parameter(1)
    assert (sys.getrefcount(own), sys.getrefcount(held[3])) == before
