r"""Closed-form kinematics of the six legs, compiled.

With hip p_BH, outward direction (0, s, 0), s = +-1, and joint angles (q0, q1, q2) = (thorax, basal, distal), the foot's
centre F lies at the distance rho from the thorax axis and at the height z over the basal axis:

    rho = coxa + femur cos(q1) + tibia cos(q1 + q2)
      z = -(femur sin(q1) + tibia sin(q1 + q2))

in the vertical plane that q0 turns out of the outward direction. The inverse is the law of cosines with the knee up
(q2 >= 0).
"""

from libc.math cimport acos, atan2, copysign, cos, sin, sqrt

import numpy as np

from vtbdrake_diagrams.space_climber.morphology import Morphology


cdef class LegKinematics:
    """Forward and inverse kinematics of the legs, in the order of LEGS."""

    def __init__(self, morphology=None):
        m = morphology or Morphology()
        for k, (x, y, z) in enumerate(m.hips.tolist()):
            self._hips[k] = [x, y, z]
            self._sides[k] = copysign(1.0, y)
        self._coxa, self._femur, self._tibia = m.coxa, m.femur, m.tibia

    def forward(self, q):
        """Return p_BF, (6, 3), for joint angles q, (6, 3) or (18,)."""
        cdef double[::1] angles = np.array(q, dtype=float).reshape(3 * LEG_COUNT)
        cdef double[::1] feet = np.empty(3 * LEG_COUNT)
        self.feet(&angles[0], &feet[0])
        return np.asarray(feet).reshape(LEG_COUNT, 3)

    def inverse(self, p_BF):
        """Return the joint angles, (6, 3), that put the feet at p_BF, (6, 3).

        A target out of reach is replaced by the point of the leg plane's reach in its direction from the basal joint.
        Joint ranges are ignored.
        """
        cdef double[::1] feet = np.array(p_BF, dtype=float).reshape(3 * LEG_COUNT)
        cdef double[::1] angles = np.empty(3 * LEG_COUNT)
        self.angles(&feet[0], &angles[0])
        return np.asarray(angles).reshape(LEG_COUNT, 3)

    cdef void feet(self, const double* q, double* p_BF) noexcept nogil:
        """Compute `forward`, flat."""
        cdef double q0, q1, q12, rho
        cdef Py_ssize_t k
        for k in range(LEG_COUNT):
            q0, q1, q12 = q[0], q[1], q[1] + q[2]
            rho = self._sides[k] * (self._coxa + self._femur * cos(q1) + self._tibia * cos(q12))
            p_BF[0] = self._hips[k][0] - rho * sin(q0)
            p_BF[1] = self._hips[k][1] + rho * cos(q0)
            p_BF[2] = self._hips[k][2] - self._femur * sin(q1) - self._tibia * sin(q12)
            q += 3
            p_BF += 3

    cdef void angles(self, const double* p_BF, double* q) noexcept nogil:
        """Compute `inverse`, flat."""
        cdef double femur = self._femur, tibia = self._tibia
        cdef double squares = femur * femur + tibia * tibia, products = 2.0 * femur * tibia
        cdef double out, side, r, drop, cosine, q2
        cdef Py_ssize_t k
        for k in range(LEG_COUNT):
            out = self._sides[k] * (p_BF[1] - self._hips[k][1])
            side = -self._sides[k] * (p_BF[0] - self._hips[k][0])
            r = sqrt(out * out + side * side) - self._coxa
            drop = self._hips[k][2] - p_BF[2]
            cosine = (r * r + drop * drop - squares) / products
            cosine = 1.0 if cosine > 1.0 else (-1.0 if cosine < -1.0 else cosine)
            q2 = acos(cosine)
            q[0] = atan2(side, out)
            q[1] = atan2(drop, r) - atan2(tibia * sin(q2), femur + tibia * cosine)
            q[2] = q2
            p_BF += 3
            q += 3
