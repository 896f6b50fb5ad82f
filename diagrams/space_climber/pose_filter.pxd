cpdef double wrap(double angle) noexcept
