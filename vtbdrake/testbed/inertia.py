"""All ten inertial parameters of a body as ten free numbers, whose every value is a body of positive masses.

They are the log-Cholesky parametrization of the body's pseudo-inertia (C. Rucker and P. M. Wensing, "Smooth
parameterization of rigid-body inertia", IEEE Robotics and Automation Letters 7, 2022). CasADi is imported when it is
needed: most scenarios draw no samples.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.common.arrays import Array

if TYPE_CHECKING:
    import casadi

Expression = Any
"""A matrix of CasADi: SX, MX or DM."""

# The numbers of an inertia, in the order of `pseudo_inertia`.
INERTIA_SIZE = 10
PHYSICAL = ("mass", *(f"center_of_mass[{i}]" for i in range(3)), *(f"inertia[{i}]" for i in range(6)))
"""The ten physical numbers of a body, below its address."""


def pseudo_inertia(z: Expression) -> Expression:
    """Return the pseudo-inertia (4, 4) = U U' of ten numbers (alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3)."""
    import casadi

    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = casadi.vertsplit(z)
    U = casadi.exp(alpha) * casadi.blockcat(
        [
            [casadi.exp(d1), s12, s13, t1],
            [0, casadi.exp(d2), s23, t2],
            [0, 0, casadi.exp(d3), t3],
            [0, 0, 0, 1],
        ]
    )
    return U @ U.T


def inertia_of(z: Expression) -> tuple[Expression, Expression, Expression]:
    """Return mass (kg), centre of mass (3, 1) in m, and [Ixx, Iyy, Izz, Ixy, Ixz, Iyz] about it (6, 1) in kg m^2."""
    import casadi

    J = pseudo_inertia(z)
    mass = J[3, 3]
    com = J[:3, 3] / mass
    # Second moments about the centre of mass.
    sigma = J[:3, :3] - mass * (com @ com.T)
    I_cm = casadi.trace(sigma) * casadi.SX.eye(3) - sigma
    return mass, com, casadi.vertcat(I_cm[0, 0], I_cm[1, 1], I_cm[2, 2], I_cm[0, 1], I_cm[0, 2], I_cm[1, 2])


@cache
def body_function() -> casadi.Function:
    """Return the function z (10,) -> `PHYSICAL` (10,), and their Jacobian."""
    import casadi

    symbol = casadi.SX.sym("z", INERTIA_SIZE)
    physical = casadi.vertcat(*inertia_of(symbol))
    return casadi.Function("inertia", [symbol], [physical, casadi.jacobian(physical, symbol)])


def physical_numbers(body: str, z: Array) -> dict[str, float]:
    """Return the `PHYSICAL` numbers of a body by their addresses.

    Args:
        body: The address of the body.
        z: The ten free numbers of its inertia, shape (10,), in the order of `pseudo_inertia`.
    """
    numbers = np.asarray(body_function()(z)[0]).ravel()
    return {f"{body}.{part}": float(number) for part, number in zip(PHYSICAL, numbers, strict=True)}
