"""Parameters at hand."""

from __future__ import annotations

import sys

import numpy as np
from pydrake.systems.framework import BasicVector, Diagram, DiagramBuilder, LeafSystem

from vtbdrake.control.stepping import numeric_parameters


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


def test_all_parameters_below_a_diagram_are_at_hand() -> None:
    whole, part, _ = _nested()
    context = whole.CreateDefaultContext()
    assert _values(numeric_parameters(whole, context)) == [[10.0], [11.0, 12.0], [1.0], [2.0, 3.0]]
    assert _values(numeric_parameters(part, context)) == [[1.0], [2.0, 3.0]]


def test_a_system_is_given_the_object_that_is_held() -> None:
    whole, part, system = _nested()
    context = whole.CreateDefaultContext()
    held = numeric_parameters(part, context)
    assert system.GetMyContextFromRoot(context).get_numeric_parameter(1) is held[1]
    assert system.GetMyContextFromRoot(context.Clone()).get_numeric_parameter(1) is not held[1]


def test_what_is_written_is_seen() -> None:
    whole, _, system = _nested()
    context, other = whole.CreateDefaultContext(), whole.CreateDefaultContext()
    held = numeric_parameters(whole, context)
    system.GetMyMutableContextFromRoot(context).get_mutable_numeric_parameter(1).SetFromVector([5.0, 6.0])
    assert held[3].value().tolist() == [5.0, 6.0]
    context.SetTimeStateAndParametersFrom(other)
    own = system.GetMyContextFromRoot(context)
    np.testing.assert_array_equal(own.get_numeric_parameter(1).value(), [2.0, 3.0])


def test_to_ask_again_and_again_keeps_nothing() -> None:
    whole, _, system = _nested()
    context = whole.CreateDefaultContext()
    held = numeric_parameters(whole, context)
    own = system.GetMyContextFromRoot(context)
    before = sys.getrefcount(own), sys.getrefcount(held[3])
    for _ in range(100):
        own.get_numeric_parameter(1)
    assert (sys.getrefcount(own), sys.getrefcount(held[3])) == before
