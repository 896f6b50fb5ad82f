"""Big-endian numbers, as LCM sends them, at any address."""

from libc.stdint cimport uint16_t, uint32_t, uint64_t
from libc.string cimport memcpy

cdef extern from "<endian.h>" nogil:
    uint16_t be16toh(uint16_t)
    uint32_t be32toh(uint32_t)
    uint64_t be64toh(uint64_t)
    uint16_t htobe16(uint16_t)
    uint32_t htobe32(uint32_t)
    uint64_t htobe64(uint64_t)


cdef inline uint16_t get_uint16(const void* at) noexcept nogil:
    cdef uint16_t number
    memcpy(&number, at, sizeof(number))
    return be16toh(number)


cdef inline uint32_t get_uint32(const void* at) noexcept nogil:
    cdef uint32_t number
    memcpy(&number, at, sizeof(number))
    return be32toh(number)


cdef inline uint64_t get_uint64(const void* at) noexcept nogil:
    cdef uint64_t number
    memcpy(&number, at, sizeof(number))
    return be64toh(number)


cdef inline float get_float(const void* at) noexcept nogil:
    cdef uint32_t bits = get_uint32(at)
    cdef float number
    memcpy(&number, &bits, sizeof(number))
    return number


cdef inline double get_double(const void* at) noexcept nogil:
    cdef uint64_t bits = get_uint64(at)
    cdef double number
    memcpy(&number, &bits, sizeof(number))
    return number


cdef inline void put_uint16(void* at, uint16_t number) noexcept nogil:
    number = htobe16(number)
    memcpy(at, &number, sizeof(number))


cdef inline void put_uint32(void* at, uint32_t number) noexcept nogil:
    number = htobe32(number)
    memcpy(at, &number, sizeof(number))


cdef inline void put_uint64(void* at, uint64_t number) noexcept nogil:
    number = htobe64(number)
    memcpy(at, &number, sizeof(number))


cdef inline void put_float(void* at, float number) noexcept nogil:
    cdef uint32_t bits
    memcpy(&bits, &number, sizeof(bits))
    put_uint32(at, bits)


cdef inline void put_double(void* at, double number) noexcept nogil:
    cdef uint64_t bits
    memcpy(&bits, &number, sizeof(bits))
    put_uint64(at, bits)
