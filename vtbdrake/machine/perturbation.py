"""How a machine's world differs from the one that its controller was made with."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.systems.framework import Context

from vtbdrake.state.variables import A
from vtbdrake.testbed import WorldAlone

PERTURBED = ("mass", "damping", "friction", "rotor_inertia")
"""The static variables that are perturbed, by the last part of their addresses. An inertia changes with its mass."""


def perturbed_values(
    world: WorldAlone, context: Context, relative: float, random: np.random.Generator
) -> dict[str, Any]:
    """New values of all variables of the world that `PERTURBED` names, by address.

    Every entry is multiplied by a factor of its own, uniform in [1 - relative, 1 + relative], drawn in the order of
    the addresses; values beyond the bounds of a variable are taken to them.
    """
    changed = {}
    for address, variable in world.variables().items():
        if variable.kind != A or variable.derived or address.rpartition(".")[2] not in PERTURBED:
            continue
        factor = 1.0 + relative * random.uniform(-1.0, 1.0, variable.shape)
        value = np.clip(variable.get(context) * factor, *variable.bounds)
        changed[address] = value if variable.shape else float(value)
    return changed
