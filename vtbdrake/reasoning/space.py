"""The elements of the DPS that are decided: as parameters of a search, and as values that the DPS takes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from vtbdrake.common.argument_checks import all_of
from vtbdrake.optimization.parameter import Choice, Dimension, Parameter, checked_points
from vtbdrake.optimization.solvers.solver import Point
from vtbdrake.reasoning.trajectory import Trajectory
from vtbdrake.state import Variables

Element = Parameter | Choice | Trajectory


class DecisionSpace:
    """The elements of a decision, and the parameters that a search varies for them.

    Args:
        decision: Commands (``u.<name>``) and other elements of the DPS, each a `Parameter`, a `Choice` or a
            `Trajectory`.

    Attributes:
        elements: The decided elements.
        addresses: Those that a decision sets.
        parameters: The parameters of the search: one for a parameter or a choice, the knots of a trajectory.

    Raises:
        ValueError: There is no element, or one is not a part of the DPS.
    """

    def __init__(self, decision: Sequence[Element]) -> None:
        form = "[Parameter(address, lower, upper), ...]"
        self.elements: tuple[Element, ...] = all_of(Element, decision, name="decision", form=form)
        if not self.elements:
            raise ValueError(f"a reasoner decides something: give decision={form}")
        for element in self.elements:
            if not element.address.startswith(("u.", "dps.")):
                raise ValueError(
                    f"a decision sets a command (u.<name>) or another element of the DPS (dps.<...>), but "
                    f"{element.address} is neither; other variables are varied by vtb.Problem"
                )
        parts = [e.parameters if isinstance(e, Trajectory) else (e,) for e in self.elements]
        self.parameters: tuple[Dimension, ...] = tuple(parameter for part in parts for parameter in part)
        ends = np.cumsum([len(part) for part in parts]).tolist()
        self.addresses = tuple(element.address for element in self.elements)
        self._parts = [slice(end - len(part), end) for end, part in zip(ends, parts, strict=True)]

    def find(self, variables: Variables) -> None:
        """Check that a testbed has the variables of the trajectories; `Problem` checks the variables of the parameters.

        Raises:
            ValueError: There is no such variable, or one of another size or with narrower bounds.
        """
        for element in self.elements:
            if isinstance(element, Trajectory):
                element.find(variables)

    def point(self, plan: Mapping[str, Any], time: float) -> Point:
        """Return a plan as a point of the search.

        Args:
            plan: Address -> value, as the DPS takes it; a trajectory is shifted so that it begins at ``time``.
            time: The time of the decision in seconds.

        Raises:
            ValueError: The plan lacks an element or has others, or a value lies outside its range.
        """
        wrong = set(plan) ^ set(self.addresses)
        if wrong:
            raise ValueError(f"a plan sets each element of the decision; this one is wrong about {', '.join(wrong)}")
        point: list[Any] = []
        for element in self.elements:
            value = plan[element.address]
            if isinstance(element, Trajectory):
                begin, *knots = element.as_numbers(value)
                checked_points(element.parameters, [knots])
                point += element.shifted(knots, time - begin).tolist()
            else:
                point.append(element.as_value(value))
        return tuple(point)

    def values(self, points: Sequence[Point], plan: Mapping[str, Any], time: float) -> list[dict[str, Any]]:
        """Return the values that points of the search set, address -> value as the DPS takes it, for each of them.

        Args:
            points: Points, with one value per parameter.
            plan: The plan in use, address -> value; a trajectory with limited rate continues from its value.
            time: The time of the decision in seconds, at which a trajectory begins.
        """
        columns: list[Iterable[Any]] = []
        for element, part in zip(self.elements, self._parts, strict=True):
            entries = [point[part] for point in points]
            if isinstance(element, Trajectory):
                columns.append(element.plans(entries, time, start=_value_at(element, plan[element.address], time)))
            else:
                columns.append(value for (value,) in entries)
        return [dict(zip(self.addresses, row, strict=True)) for row in zip(*columns, strict=True)]


def _value_at(trajectory: Trajectory, plan: np.ndarray, time: float) -> np.ndarray | None:
    """Return the value of a plan at ``time``, if new plans begin there."""
    if not trajectory.is_continued:
        return None
    return trajectory.values(plan[1:], [time - float(plan[0])])[0]


def same_values(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    """Return whether two mappings address -> value are equal, to the last bit.

    Args:
        a: One mapping; the order of its addresses does not matter.
        b: The other one.
    """
    return a.keys() == b.keys() and all(np.array_equal(a[address], b[address]) for address in a)
