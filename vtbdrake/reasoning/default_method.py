"""The method of a reasoner that is told none: by the kind of decision, as the table of docs/reasoning.md has it."""

from __future__ import annotations

from collections.abc import Sequence

from vtbdrake.optimization.parameter import Choice, Parameter
from vtbdrake.optimization.solvers.designs import discrete_size
from vtbdrake.reasoning.space import Element
from vtbdrake.reasoning.trajectory import Trajectory

# Up to this number of numbers, the quadratic models that ``auto`` begins with need few candidates.
FEW = 4


def default_method(elements: Sequence[Element], *, candidates: int | None) -> str:
    """Return the name of the method for a kind of decision.

    * words and whole numbers, with no more combinations than candidates: ``grid``, which tries all;
    * words beside numbers: ``CMA-ES``; words alone: ``random``;
    * up to four continuous numbers in a budget of rollouts: ``auto``, which tries one candidate at a time at first;
    * everything else: ``MPPI``, for trajectories at a receding horizon, and in a budget of wall time.

    Args:
        elements: The decided elements.
        candidates: Number of candidates that may be proposed; None: in a budget of wall time.
    """
    parameters = [element for element in elements if not isinstance(element, Trajectory)]
    trajectories = len(parameters) < len(elements)
    discrete = not trajectories and not any(parameter.is_continuous for parameter in parameters)
    if discrete and candidates is not None and discrete_size(tuple(parameters)) <= candidates:
        return "grid"
    if any(isinstance(parameter, Choice) for parameter in parameters):
        return "CMA-ES" if trajectories or any(isinstance(p, Parameter) for p in parameters) else "random"
    continuous = not trajectories and all(parameter.is_continuous for parameter in parameters)
    if continuous and candidates is not None and len(parameters) <= FEW:
        return "auto"
    return "MPPI"
