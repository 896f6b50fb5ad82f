"""The numeric parameters of a Context at hand, for systems in Python that read theirs in every step."""

from __future__ import annotations

from pydrake.systems.framework import BasicVector, Context, Diagram

from vtbdrake.state.systems import leaves


def parameters_at_hand(diagram: Diagram, context: Context) -> list[BasicVector]:
    """Python's objects of all numeric parameters below ``diagram``, to be held while ``context`` is stepped.

    A system that asks its context for parameters is given the object that there is; if there is none, one is made and
    thrown away, which takes 1 us. Values are looked at through them, not held: whatever is written is seen.

    Args:
        context: of the root, of which ``diagram`` may be a part.
    """
    contexts = [system.GetMyContextFromRoot(context) for _, system in leaves(diagram)]
    return [own.get_numeric_parameter(i) for own in contexts for i in range(own.num_numeric_parameter_groups())]
