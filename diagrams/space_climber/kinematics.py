r"""Closed-form kinematics of the six legs.

With hip p_BH, outward direction (0, s, 0), s = +-1, and joint angles (q0, q1, q2) = (thorax, basal, distal), the foot's
centre F lies at the distance rho from the thorax axis and at the height z over the basal axis:

    rho = coxa + femur cos(q1) + tibia cos(q1 + q2)
      z = -(femur sin(q1) + tibia sin(q1 + q2))

in the vertical plane that q0 turns out of the outward direction. The inverse is the law of cosines with the knee up
(q2 >= 0). For six legs, plain floats are three to four times faster than numpy; the arrays are at the edge.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import acos, atan2, copysign, cos, sin, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake_diagrams.space_climber.morphology import LEGS, Morphology

Point = tuple[float, float, float]


class LegKinematics:
    """Forward and inverse kinematics of the legs, in the order of LEGS."""

    def __init__(self, morphology: Morphology | None = None) -> None:
        m = morphology or Morphology()
        self._hips = [(x, y, z, copysign(1.0, y)) for x, y, z in m.hips.tolist()]
        self._coxa, self._femur, self._tibia = m.coxa, m.femur, m.tibia

    def forward(self, q: ArrayLike) -> NDArray[np.float64]:
        """Return p_BF, (6, 3), for joint angles q, (6, 3) or (18,)."""
        return np.array(self.feet(np.ravel(q).tolist()))

    def inverse(self, p_BF: ArrayLike) -> NDArray[np.float64]:
        """Return the joint angles, (6, 3), that put the feet at p_BF, (6, 3).

        A target out of reach is replaced by the point of the leg plane's reach in its direction from the basal joint.
        Joint ranges are ignored.
        """
        return np.array(self.angles(np.asarray(p_BF, dtype=float).tolist())).reshape(len(LEGS), 3)

    def feet(self, q: Sequence[float]) -> list[Point]:
        """Compute `forward` for a sequence of 18 floats."""
        coxa, femur, tibia = self._coxa, self._femur, self._tibia
        feet = []
        k = 0
        for x, y, z, s in self._hips:
            q0, q1, q12 = q[k], q[k + 1], q[k + 1] + q[k + 2]
            k += 3
            rho = s * (coxa + femur * cos(q1) + tibia * cos(q12))
            feet.append((x - rho * sin(q0), y + rho * cos(q0), z - femur * sin(q1) - tibia * sin(q12)))
        return feet

    def angles(self, p_BF: Iterable[Sequence[float]]) -> list[float]:
        """Compute `inverse` for six points, as 18 floats."""
        coxa, femur, tibia = self._coxa, self._femur, self._tibia
        squares, products = femur * femur + tibia * tibia, 2.0 * femur * tibia
        q: list[float] = []
        for (hip_x, hip_y, hip_z, s), (x, y, z) in zip(self._hips, p_BF, strict=True):
            out, side = s * (y - hip_y), -s * (x - hip_x)
            r, drop = sqrt(out * out + side * side) - coxa, hip_z - z
            cosine = (r * r + drop * drop - squares) / products
            cosine = 1.0 if cosine > 1.0 else (-1.0 if cosine < -1.0 else cosine)
            q2 = acos(cosine)
            q += (atan2(side, out), atan2(drop, r) - atan2(tibia * sin(q2), femur + tibia * cosine), q2)
        return q
