from vtbdrake_diagrams.space_climber.kinematics cimport LEG_COUNT


cdef class Gait:
    cdef readonly double duty
    cdef double _delays[LEG_COUNT]

    cpdef double speed(self, double stroke, double period) noexcept
    cpdef double leg_phase(self, Py_ssize_t leg, double phase) noexcept
    cpdef double swing(self, double leg_phase) noexcept
    cpdef double height(self, Py_ssize_t leg, double phase) noexcept
    cdef void move(
        self,
        double* feet,
        const double* nominal,
        double phase,
        double next_phase,
        double forward,
        double turn,
        double stance_steps,
    ) noexcept


cdef double fraction(double cycles) noexcept
