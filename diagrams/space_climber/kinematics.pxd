cdef enum:
    LEG_COUNT = 6


cdef class LegKinematics:
    # Of each leg: the hip p_BH, and 1 on the left side, -1 on the right.
    cdef double _hips[LEG_COUNT][3]
    cdef double _sides[LEG_COUNT]
    cdef double _coxa, _femur, _tibia

    cdef void feet(self, const double* q, double* p_BF) noexcept nogil
    cdef void angles(self, const double* p_BF, double* q) noexcept nogil
