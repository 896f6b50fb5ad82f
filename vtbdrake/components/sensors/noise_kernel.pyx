"""Random numbers of the generator Philox 4x64, as numpy's Generator draws them, for many keys and counters; compiled."""

from libc.stdint cimport int64_t, uint32_t, uint64_t
from numpy.random cimport bitgen_t
from numpy.random.c_distributions cimport random_standard_normal_fill, random_standard_uniform_fill

cdef extern from *:
    """
    #include <stdint.h>

    typedef struct { uint64_t counter[4]; uint64_t key[2]; uint64_t words[4]; int used; } philox;

    static void philox_round(uint64_t* x, uint64_t k0, uint64_t k1) {
        unsigned __int128 a = (unsigned __int128)0xD2E7470EE14C6C93ULL * x[0];
        unsigned __int128 b = (unsigned __int128)0xCA5A826395121157ULL * x[2];
        uint64_t next0 = (uint64_t)(b >> 64) ^ x[1] ^ k0, next2 = (uint64_t)(a >> 64) ^ x[3] ^ k1;
        x[1] = (uint64_t)b;
        x[3] = (uint64_t)a;
        x[0] = next0;
        x[2] = next2;
    }

    /* As numpy, the counter is increased before its four words are made. */
    static uint64_t philox_next(void* state) {
        philox* p = (philox*)state;
        if (p->used == 4) {
            uint64_t k0 = p->key[0], k1 = p->key[1];
            for (int i = 0; i < 4 && ++p->counter[i] == 0; i++) {}
            for (int i = 0; i < 4; i++) p->words[i] = p->counter[i];
            for (int i = 0; i < 10; i++) {
                philox_round(p->words, k0, k1);
                k0 += 0x9E3779B97F4A7C15ULL;
                k1 += 0xBB67AE8584CAA73BULL;
            }
            p->used = 0;
        }
        return p->words[p->used++];
    }

    static double philox_double(void* state) { return (philox_next(state) >> 11) * (1.0 / 9007199254740992.0); }
    """
    ctypedef struct philox:
        uint64_t counter[4]
        uint64_t key[2]
        uint64_t words[4]
        int used
    uint64_t philox_next(void* state) noexcept nogil
    double philox_double(void* state) noexcept nogil


def fill(
    double[:, :, ::1] out,
    const uint64_t[::1] seeds,
    uint64_t stream,
    const uint64_t[::1] batches,
    const int64_t[::1] places,
    uint64_t channel,
    bint normal,
):
    cdef philox state
    cdef bitgen_t generator
    cdef Py_ssize_t s, m, size = out.shape[2]
    cdef int64_t drawn
    if size == 0:
        return
    generator.state = &state
    generator.next_uint64 = philox_next
    generator.next_double = philox_double
    generator.next_uint32 = NULL  # These distributions do not use it.
    generator.next_raw = philox_next
    with nogil:
        for s in range(out.shape[0]):
            state.key[0], state.key[1] = seeds[s], stream
            drawn = 0
            for m in range(out.shape[1]):
                if m == 0 or batches[m] != batches[m - 1] or places[m] < drawn:
                    state.counter[0], state.counter[1] = 0, batches[m]
                    state.counter[2], state.counter[3] = channel, 0
                    state.used = 4
                    drawn = 0
                while drawn <= places[m]:  # What comes before in the batch is drawn, and overwritten.
                    if normal:
                        random_standard_normal_fill(&generator, size, &out[s, m, 0])
                    else:
                        random_standard_uniform_fill(&generator, size, &out[s, m, 0])
                    drawn += 1
