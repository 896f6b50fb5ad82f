"""Contact forces by body, compiled."""

from libc.math cimport sqrt

import numpy as np

cimport numpy as cnp

from vtbdrake.common.array_memory cimport numbers, writable

cnp.import_array()


def contact_forces(results, list body_slots, dict geometry_slots, Py_ssize_t count):
    # The last place is for all that are not asked for.
    sums = np.zeros(count + 1)
    cdef double* forces = writable(sums, count + 1)
    cdef double magnitude
    cdef Py_ssize_t k
    for k in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(k)
        magnitude = norm(info.contact_force())
        forces[<Py_ssize_t>body_slots[info.bodyA_index()]] += magnitude
        forces[<Py_ssize_t>body_slots[info.bodyB_index()]] += magnitude
    for k in range(results.num_hydroelastic_contacts()):
        info = results.hydroelastic_contact_info(k)
        magnitude = norm(info.F_Ac_W().translational())
        surface = info.contact_surface()
        for geometry in (surface.id_M(), surface.id_N()):
            forces[<Py_ssize_t>geometry_slots.get(geometry.get_value(), count)] += magnitude
    return sums[:count]


cdef double norm(vector) except -1.0:
    cdef const double* v = numbers(vector, 3)
    return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
