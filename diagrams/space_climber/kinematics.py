r"""Closed-form kinematics of the six legs.

With hip p_BH, outward direction (0, s, 0), s = +-1, and joint angles (q0, q1, q2) = (thorax, basal, distal), the foot's
centre F lies at the distance rho from the thorax axis and at the height z over the basal axis:

    rho = coxa + femur cos(q1) + tibia cos(q1 + q2)
      z = -(femur sin(q1) + tibia sin(q1 + q2))

in the vertical plane that q0 turns out of the outward direction. The inverse is the law of cosines with the knee up
(q2 >= 0).
"""

from __future__ import annotations

from typing import Any

import casadi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.components.casadi_system import clamp
from vtbdrake_diagrams.space_climber.morphology import LEGS, Morphology

Expression = Any  # casadi.SX


class LegKinematics:
    """Forward and inverse kinematics of the legs, in the order of LEGS.

    Args:
        morphology: The robot's dimensions.
    """

    def __init__(self, morphology: Morphology | None = None) -> None:
        self._morphology = morphology or Morphology()
        self._hips = self._morphology.hips
        self._sides = np.copysign(1.0, self._hips[:, 1])
        table = casadi.SX.sym("table", len(LEGS), 3)
        self._forward = casadi.Function("forward", [table], [self.feet(table)])
        self._inverse = casadi.Function("inverse", [table], [self.angles(table)])

    def forward(self, q: ArrayLike) -> NDArray[np.float64]:
        """Return p_BF, (6, 3), for joint angles q, (6, 3) or (18,)."""
        return self._forward(np.reshape(q, (len(LEGS), 3))).full()

    def inverse(self, p_BF: ArrayLike) -> NDArray[np.float64]:
        """Return the joint angles, (6, 3), that put the feet at p_BF, (6, 3); see `angles`."""
        return self._inverse(np.reshape(p_BF, (len(LEGS), 3))).full()

    def feet(self, q: Expression) -> Expression:
        """Return p_BF, (6, 3), for joint angles q, (6, 3), as expressions."""
        m, hips = self._morphology, casadi.DM(self._hips)
        q0, q1, q12 = q[:, 0], q[:, 1], q[:, 1] + q[:, 2]
        rho = casadi.DM(self._sides) * (m.coxa + m.femur * casadi.cos(q1) + m.tibia * casadi.cos(q12))
        return casadi.horzcat(
            hips[:, 0] - rho * casadi.sin(q0),
            hips[:, 1] + rho * casadi.cos(q0),
            hips[:, 2] - m.femur * casadi.sin(q1) - m.tibia * casadi.sin(q12),
        )

    def angles(self, p_BF: Expression) -> Expression:
        """Return the joint angles, (6, 3), that put the feet at p_BF, (6, 3), as expressions.

        A target out of reach is replaced by the point of the leg plane's reach in its direction from the basal joint.
        Joint ranges are ignored.
        """
        m, hips, sides = self._morphology, casadi.DM(self._hips), casadi.DM(self._sides)
        out = sides * (p_BF[:, 1] - hips[:, 1])
        side = -sides * (p_BF[:, 0] - hips[:, 0])
        r = casadi.sqrt(out * out + side * side) - m.coxa
        drop = hips[:, 2] - p_BF[:, 2]
        cosine = (r * r + drop * drop - (m.femur**2 + m.tibia**2)) / (2.0 * m.femur * m.tibia)
        cosine = clamp(cosine, -1.0, 1.0)
        q2 = casadi.acos(cosine)
        q1 = casadi.atan2(drop, r) - casadi.atan2(m.tibia * casadi.sin(q2), m.femur + m.tibia * cosine)
        return casadi.horzcat(casadi.atan2(side, out), q1, q2)
