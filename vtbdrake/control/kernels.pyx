"""What a loop at 1 kHz does with numbers in every cycle, compiled: messages in and out, limits, ages, histograms.

Most of it is the quick way of something in Python, which has the slow one, too: for what is unusual, and to say what is
wrong. Where a value is not what the quick way takes, it does nothing, and says so.
"""

from cpython.bytes cimport PyBytes_AS_STRING, PyBytes_FromStringAndSize, PyBytes_GET_SIZE
from cpython.mem cimport PyMem_Calloc, PyMem_Free
from libc.math cimport INFINITY, NAN, fabs, isfinite, isnan, log, rint
from libc.stdint cimport int8_t, int16_t, int32_t, int64_t, uint16_t, uint32_t, uint64_t
from libc.string cimport memcmp, memcpy

cimport numpy as cnp

from vtbdrake.control.byte_order cimport (
    get_double,
    get_float,
    get_uint16,
    get_uint32,
    get_uint64,
    put_double,
    put_float,
    put_uint16,
    put_uint32,
    put_uint64,
)

cnp.import_array()


# -- vectors

cdef void* _zeros(Py_ssize_t count, size_t size) except NULL:
    cdef void* memory = PyMem_Calloc(max(count, 1), size)
    if memory is NULL:
        raise MemoryError
    return memory


cdef double* _doubles(object numbers) except NULL:
    cdef list given = [float(number) for number in numbers]
    cdef double* copy = <double*>_zeros(len(given), sizeof(double))
    cdef Py_ssize_t i
    for i in range(len(given)):
        copy[i] = given[i]
    return copy


def finite(value, Py_ssize_t size):
    """Whether ``value`` is an array of doubles of shape (size,), all finite."""
    cdef double* entries = entries_of(value, size)
    cdef Py_ssize_t i
    if entries is NULL:
        return False
    for i in range(size):
        if not isfinite(entries[i]):
            return False
    return True


cdef class Box:
    """Lower and upper limits of a vector, by entry."""

    cdef Py_ssize_t size
    cdef double* lower
    cdef double* upper

    def __cinit__(self, lower, upper):
        if len(lower) != len(upper):
            raise ValueError(f"a box has as many lower limits as upper ones, not {len(lower)} and {len(upper)}")
        self.size = len(lower)
        self.lower = _doubles(lower)
        self.upper = _doubles(upper)

    def __dealloc__(self):
        PyMem_Free(self.lower)
        PyMem_Free(self.upper)

    cdef bint holds(self, const double* entries) noexcept:
        cdef Py_ssize_t i
        for i in range(self.size):
            if not self.lower[i] <= entries[i] <= self.upper[i]:  # so a NaN is not within
                return False
        return True

    def contains(self, value):
        """Whether ``value`` is an array of doubles of this size, within the limits."""
        cdef double* entries = entries_of(value, self.size)
        return entries is not NULL and self.holds(entries)


cdef class Passage:
    """Limits (step, change, lower, upper) of each entry of a command; see `CommandGuard`, which names w and f."""

    cdef Py_ssize_t size
    cdef double* limits

    def __cinit__(self, limits):
        self.size = len(limits)
        self.limits = _doubles([number for step, change, lower, upper in limits for number in (step, change, lower, upper)])

    def __dealloc__(self):
        PyMem_Free(self.limits)

    def advance(self, command, sent, step):
        """A copy of ``command`` if it passes as it is, else None.

        If so, it is in ``sent`` afterwards, and the step that led there in ``step``; before, they are those of the cycle
        before. All are arrays of doubles of this size.
        """
        cdef double* c = entries_of(command, self.size)
        cdef double* s = entries_of(sent, self.size)
        cdef double* x = entries_of(step, self.size)
        cdef double* limit = self.limits
        cdef double w, reach, way
        cdef Py_ssize_t i
        if c is NULL or s is NULL or x is NULL:
            return None
        for i in range(self.size):
            w = c[i] - s[i]
            if not (fabs(w) <= limit[0] and limit[2] <= c[i] <= limit[3]):
                return None
            if limit[1] < INFINITY:
                # A parabola half a change ahead lies above f: what it lets pass may pass, and most does.
                reach = fabs(w) + 0.5 * limit[1]
                way = limit[3] - s[i] if w > 0.0 else s[i] - limit[2]
                if not (fabs(w - x[i]) <= limit[1] and reach * reach <= 2.0 * limit[1] * way):
                    return None
            limit += 4
        for i in range(self.size):
            x[i] = c[i] - s[i]
            s[i] = c[i]
        return cnp.PyArray_NewCopy(<cnp.ndarray>command, cnp.NPY_CORDER)


# -- sensor signals

cdef class Reception:
    """What is known of one sensor signal; the bridge keeps it up to date in place.

    Attributes:
        value: the newest accepted one: an array of the signal's size, or an abstract value; None before the first.
        arrived: when it arrived, on the clock of `time.monotonic`, in seconds; -inf before the first.
        sent: the sender's own time of it, in seconds, if the message tells; NaN if not.
        count: how many were accepted.
        rejected: how many were not, by the reason: ``fingerprint``, ``truncated``, ``trailing``, ``size``, ``not
            finite``, ``limits``, ``out of order``, ``ahead of time``, ...
        range: the `Range` that the bridge checks every value against before it accepts it; None if it leaves that to
            others.
    """

    cdef public object value
    cdef public double arrived
    cdef public double sent
    cdef public int64_t count
    cdef public dict rejected
    cdef public object range

    def __init__(self, value=None, *, arrived=-INFINITY, sent=NAN, count=0, range=None):
        self.value = value
        self.arrived = arrived
        self.sent = sent
        self.count = count
        self.rejected = {}
        self.range = range

    def __repr__(self):
        return (
            f"Reception(value={self.value!r}, arrived={self.arrived}, sent={self.sent}, count={self.count}, "
            f"rejected={self.rejected})"
        )

    def age(self, double now):
        """Seconds since it arrived; infinite before the first."""
        return now - self.arrived

    def reject(self, reason):
        """Counts a message that was not accepted."""
        self.rejected[reason] = self.rejected.get(reason, 0) + 1

    cpdef accept(self, value, double arrived, double sent):
        """Takes note of a value that was."""
        self.value = value
        self.arrived = arrived
        self.sent = sent
        self.count += 1


cdef class Freshness:
    """Looks at a sensor signal's age in every cycle, and has each of its values examined once; `Watchdog` says how.

    Args:
        max_age: in seconds.

    Attributes:
        trusted: the `Reception.range` with which values need not be examined; None if all have to be.
        value: the newest sample that nothing was wrong with; None before the first.
        arrived: when that sample arrived, in seconds; -inf before the first.
    """

    cdef readonly double max_age
    cdef readonly object value
    cdef readonly double arrived
    cdef public object trusted
    cdef int64_t count
    cdef object fault

    def __init__(self, double max_age):
        self.max_age = max_age
        self.arrived = -INFINITY

    cpdef check(self, double now, Reception reception):
        """What is wrong with the signal at the time ``now``, in seconds; None if nothing is."""
        if reception is None:
            raise TypeError("the age of a signal is that of its Reception, not of None")
        if now - reception.arrived > self.max_age or not reception.count:
            return self.stale(now, reception)
        if reception.count != self.count:
            self.count = reception.count
            if self.trusted is not None and self.trusted is reception.range:
                self.fault = None
            else:
                self.fault = self.examine(now, reception)
            if self.fault is None:
                self.value = reception.value
                self.arrived = reception.arrived
        return self.fault

    def accept(self, value, double arrived):
        """Takes a sample for accepted, whatever was found wrong with it."""
        self.value = value
        self.arrived = arrived
        self.fault = None


cdef class Reach:
    """How far the entries of a sensor signal may be from its last accepted sample.

    Args:
        rate: the fastest change of each entry, per second.
        tolerance: the change of each entry that is allowed at any time.
    """

    cdef Py_ssize_t size
    cdef double* rate
    cdef double* tolerance

    def __cinit__(self, rate, tolerance):
        if len(rate) != len(tolerance):
            raise ValueError(f"each entry has a rate and a tolerance, not {len(rate)} rates and {len(tolerance)} tolerances")
        self.size = len(rate)
        self.rate = _doubles(rate)
        self.tolerance = _doubles(tolerance)

    def __dealloc__(self):
        PyMem_Free(self.rate)
        PyMem_Free(self.tolerance)

    def contains(self, before, value, double seconds):
        """Whether entries can change from ``before`` to ``value`` in so many seconds; both are arrays of doubles."""
        cdef double* b = entries_of(before, self.size)
        cdef double* v = entries_of(value, self.size)
        cdef Py_ssize_t i
        if b is NULL or v is NULL:
            return False
        for i in range(self.size):
            if not fabs(v[i] - b[i]) <= self.rate[i] * seconds + self.tolerance[i]:  # so a NaN is not within
                return False
        return True


def found(double now, dict watches, receptions):
    """What `Freshness.check` finds at the time ``now``, with those of ``watches`` whose receptions are given, by name."""
    faults = []
    for name, reception in receptions.items():
        fault = (<Freshness?>watches[name]).check(now, reception)
        if fault is not None:
            faults.append(fault)
    return faults


# -- messages of numbers

cdef struct Run:
    # Numbers of one type, one after the other.
    char code  # as `struct` calls their type
    Py_ssize_t width  # of a number, in bytes
    Py_ssize_t offset  # of the first, in the message
    Py_ssize_t count
    Py_ssize_t vector  # whose they are
    Py_ssize_t begin  # from which of its entries on


cdef Py_ssize_t _width(char code) except -1:
    if code == b"d" or code == b"q":
        return 8
    if code == b"f" or code == b"i":
        return 4
    if code == b"h":
        return 2
    if code == b"b" or code == b"?":
        return 1
    raise ValueError(f"there is no number of type {chr(code)!r} in a message")


cdef Run* _runs(object places, Py_ssize_t size) except NULL:
    """Of (vector, begin, offset, count, code), in a message of ``size`` bytes."""
    cdef list checked = []
    cdef Run run
    cdef Run* runs
    cdef Py_ssize_t i
    for vector, begin, offset, count, code in places:
        run.width = _width(ord(code))
        if not (offset >= 0 and count >= 0 and offset + count * run.width <= size):
            raise ValueError(f"{count} numbers from byte {offset} on are not in a message of {size} bytes")
        checked.append((ord(code), run.width, offset, count, vector, begin))
    runs = <Run*>_zeros(len(checked), sizeof(Run))
    for i in range(len(checked)):
        run.code, run.width, run.offset, run.count, run.vector, run.begin = checked[i]
        runs[i] = run
    return runs


cdef Run* _run(object place, Py_ssize_t size) except NULL:
    """Of a single number, as of (offset, 1, code)."""
    offset, _, code = place
    return _runs([(0, 0, offset, 1, code)], size)


cdef inline double _read(const char* at, char code) noexcept:
    if code == b"d":
        return get_double(at)
    if code == b"q":
        return <double><int64_t>get_uint64(at)
    if code == b"f":
        return <double>get_float(at)
    if code == b"i":
        return <double><int32_t>get_uint32(at)
    if code == b"h":
        return <double><int16_t>get_uint16(at)
    if code == b"?":
        return <double>(at[0] != 0)
    return <double>(<const int8_t*>at)[0]


cdef inline bint _write(char* at, char code, double number) noexcept:
    """Whether it could be written: integers are rounded (half to even), and must fit."""
    if code == b"d":
        put_double(at, number)
        return True
    if code == b"f":
        if not isfinite(<float>number):
            return False
        put_float(at, <float>number)
        return True
    number = rint(number)
    if code == b"q":
        if not -9.2e18 < number < 9.2e18:
            return False
        put_uint64(at, <uint64_t><int64_t>number)
    elif code == b"i":
        if not -2147483648.0 <= number <= 2147483647.0:
            return False
        put_uint32(at, <uint32_t><int32_t>number)
    elif code == b"h":
        if not -32768.0 <= number <= 32767.0:
            return False
        put_uint16(at, <uint16_t><int16_t>number)
    elif code == b"b":
        if not -128.0 <= number <= 127.0:
            return False
        at[0] = <char><int8_t>number
    elif not isfinite(number):
        return False
    else:
        at[0] = number != 0.0
    return True


cdef class Intake:
    """Takes in those messages of a channel that are laid out like an example.

    Args:
        example: of such a message.
        fixed: offset and size of the bytes that all such messages have in common.
        places: where the vectors' entries are, in their order: (vector, its entry, offset, number of entries, type as
            `struct` calls it).
        stamp: offset, number (1) and type of the sender's time in microseconds; None if there is none.
        receptions: of the signals, which are vectors.
        sizes: theirs.
        lower, upper: limits of all entries.
    """

    cdef bytes example
    cdef Run* fixed
    cdef Py_ssize_t fixed_count
    cdef Run* runs
    cdef Py_ssize_t run_count
    cdef Run* stamp
    cdef list receptions
    cdef Py_ssize_t* sizes
    cdef double* numbers
    cdef Box box

    def __cinit__(self, bytes example, *, fixed, places, stamp, receptions, sizes, lower, upper):
        cdef Py_ssize_t i, size = len(example)
        if not (
            sum(place[3] for place in places) == sum(sizes) == len(lower) == len(upper)
            and len(sizes) == len(receptions)
            and min(sizes, default=0) >= 0
        ):
            raise ValueError("the message has other numbers than the signals")
        self.example = example
        self.fixed = _runs([(0, 0, offset, count, "b") for offset, count in fixed], size)
        self.fixed_count = len(fixed)
        self.runs = _runs(places, size)
        self.run_count = len(places)
        self.stamp = _run(stamp, size) if stamp is not None else NULL
        self.receptions = [<Reception?>reception for reception in receptions]
        self.sizes = <Py_ssize_t*>_zeros(len(sizes), sizeof(Py_ssize_t))
        for i in range(len(sizes)):
            self.sizes[i] = sizes[i]
        self.numbers = <double*>_zeros(sum(sizes), sizeof(double))
        self.box = Box(lower, upper)

    def __dealloc__(self):
        PyMem_Free(self.fixed)
        PyMem_Free(self.runs)
        PyMem_Free(self.stamp)
        PyMem_Free(self.sizes)
        PyMem_Free(self.numbers)

    def take(self, bytes data not None, double last, double most, double now):
        """Tells the receptions of a message that came at the time ``now``.

        Returns:
            The sender's time in seconds, NaN if there is none. None if nothing was done: the message is laid out in
            another way, its time is not above ``last`` or above ``most``, or an entry is not within its limits.
        """
        cdef const char* message = PyBytes_AS_STRING(data)
        cdef const char* example = PyBytes_AS_STRING(self.example)
        cdef const char* at
        cdef double* number = self.numbers
        cdef double sent = NAN
        cdef Run* run
        cdef Reception reception
        cdef cnp.npy_intp size
        cdef Py_ssize_t i, k
        if PyBytes_GET_SIZE(data) != PyBytes_GET_SIZE(self.example):
            return None
        for i in range(self.fixed_count):
            run = &self.fixed[i]
            if memcmp(message + run.offset, example + run.offset, run.count):
                return None
        if self.stamp is not NULL:
            sent = _read(message + self.stamp.offset, self.stamp.code) * 1e-6
            if not last < sent <= most:
                return None
        for i in range(self.run_count):
            run = &self.runs[i]
            at = message + run.offset
            for k in range(run.count):
                number[0] = _read(at, run.code)
                number += 1
                at += run.width
        if not self.box.holds(self.numbers):
            return None
        number = self.numbers
        for i in range(len(self.receptions)):
            reception = <Reception>self.receptions[i]
            size = self.sizes[i]
            value = cnp.PyArray_SimpleNew(1, &size, cnp.NPY_DOUBLE)
            memcpy(cnp.PyArray_DATA(value), number, size * sizeof(double))
            number += size
            reception.accept(value, now, sent)
        return sent


cdef class Form:
    """Writes messages that differ from an example only by the time and by entries of vectors.

    Args:
        example: of such a message.
        places, stamp: as of `Intake`.
        names: of the vectors.
        sizes: theirs.
        boxes: of those that have limits; by default of none.
    """

    cdef bytes example
    cdef Run* runs
    cdef Py_ssize_t run_count
    cdef Run* stamp
    cdef list names
    cdef list boxes
    cdef Py_ssize_t* sizes
    cdef double** vectors

    def __cinit__(self, bytes example, *, places, stamp, names, sizes, boxes=None):
        cdef Py_ssize_t i
        if not len(names) == len(sizes) == (len(names) if boxes is None else len(boxes)):
            raise ValueError(f"{len(names)} vectors have a size each, and a box each if any has one")
        self.example = example
        self.names = list(names)
        self.boxes = [None] * len(self.names) if boxes is None else list(boxes)
        self.runs = _runs(places, len(example))
        self.run_count = len(places)
        self.stamp = _run(stamp, len(example)) if stamp is not None else NULL
        self.vectors = <double**>_zeros(len(self.names), sizeof(double*))
        self.sizes = <Py_ssize_t*>_zeros(len(self.names), sizeof(Py_ssize_t))
        for i in range(len(self.names)):
            self.sizes[i] = sizes[i]
        for vector, begin, _, count, _ in places:
            if not 0 <= vector < len(names):
                raise ValueError(f"there is no vector {vector} among {', '.join(names)}")
            if not 0 <= begin <= begin + count <= sizes[vector]:
                raise ValueError(f"{names[vector]} has no entries {begin} to {begin + count - 1}")

    def __dealloc__(self):
        PyMem_Free(self.runs)
        PyMem_Free(self.stamp)
        PyMem_Free(self.vectors)
        PyMem_Free(self.sizes)

    def fill(self, values, int64_t utime):
        """The message with these vectors, by name, and this time in microseconds.

        Integers are rounded, half to even. None if one of ``values`` is missing, something else than an array of doubles
        of the right size, or not within its limits, or if a number does not fit its field.
        """
        cdef Box box
        cdef double* entries
        cdef char* message
        cdef char* at
        cdef Run* run
        cdef Py_ssize_t i, k
        # They live as long as this list, even if a mapping makes them when they are asked for.
        cdef list vectors = [values.get(name) for name in self.names]
        for i in range(len(vectors)):
            entries = entries_of(vectors[i], self.sizes[i])
            if entries is NULL:
                return None
            box = self.boxes[i]
            if box is not None and not (box.size == self.sizes[i] and box.holds(entries)):
                return None
            self.vectors[i] = entries
        data = PyBytes_FromStringAndSize(PyBytes_AS_STRING(self.example), PyBytes_GET_SIZE(self.example))
        message = PyBytes_AS_STRING(data)
        if self.stamp is not NULL and not _write_stamp(message + self.stamp.offset, self.stamp.code, utime):
            return None
        for i in range(self.run_count):
            run = &self.runs[i]
            at = message + run.offset
            entries = self.vectors[run.vector] + run.begin
            for k in range(run.count):
                if not _write(at, run.code, entries[k]):
                    return None
                at += run.width
        return data


cdef inline bint _write_stamp(char* at, char code, int64_t utime) noexcept:
    if code != b"q":
        return _write(at, code, <double>utime)
    put_uint64(at, <uint64_t>utime)  # exactly: not every integer is a double
    return True


# -- histograms

cdef class Bins:
    """Counts durations, in seconds, in bins of equal ratio.

    Args:
        lowest: bin 0 ends here, bin k > 0 at lowest exp(k / scale).
        highest: here begins the last one, which ends nowhere.
        scale: see above.
        number: of bins.

    Attributes:
        count: of durations.
        total: their sum.
        least, largest: of them; NaN if there is none.
    """

    cdef readonly int64_t count
    cdef readonly double total
    cdef double lowest, highest, scale, shift, _least, _largest
    cdef Py_ssize_t number
    cdef int64_t* bins

    def __cinit__(self, *_, **__):
        self._least, self._largest = INFINITY, -INFINITY

    def __dealloc__(self):
        PyMem_Free(self.bins)

    def __init__(self, double lowest, double highest, double scale, Py_ssize_t number):
        if self.bins is not NULL:
            raise RuntimeError("bins are divided once")
        if number < 2 or not 0.0 < lowest < highest or not 0.0 < scale < INFINITY:
            raise ValueError(f"{number} bins of the scale {scale} from {lowest} to {highest} are none")
        self.bins = <int64_t*>_zeros(number, sizeof(int64_t))
        self.number = number
        self.lowest, self.highest, self.scale = lowest, highest, scale
        self.shift = 1.0 - scale * log(lowest)

    def record(self, double seconds):
        """Adds one duration.

        Raises:
            ValueError: it is NaN.
        """
        cdef Py_ssize_t index
        if self.bins is NULL:
            raise RuntimeError("bins have to be divided first")
        if isnan(seconds):
            raise ValueError("NaN is no duration")
        if seconds <= self.lowest:
            index = 0
        elif seconds >= self.highest:
            index = self.number - 1
        else:
            # Limited before it becomes an integer: it need not be one.
            index = <Py_ssize_t>min(max(log(seconds) * self.scale + self.shift, 0.0), <double>(self.number - 1))
        self.bins[index] += 1
        self.count += 1
        self.total += seconds
        if seconds > self._largest:
            self._largest = seconds
        if seconds < self._least:
            self._least = seconds

    def counts(self):
        """By bin."""
        return [self.bins[i] for i in range(self.number)]

    def add(self, counts, double total, double least, double largest):
        """Adds durations of which this is known.

        Raises:
            ValueError: there is another number of bins.
        """
        cdef Py_ssize_t i
        cdef int64_t number
        if len(counts) != self.number:
            raise ValueError(f"this histogram has {self.number} bins, not {len(counts)}")
        cdef list given = [<int64_t>count for count in counts]  # So all of them are added, or none.
        for i in range(self.number):
            number = given[i]
            self.bins[i] += number
            self.count += number
        self.total += total
        self._least = min(self._least, least)
        self._largest = max(self._largest, largest)

    @property
    def least(self):
        return self._least if self.count else NAN

    @property
    def largest(self):
        return self._largest if self.count else NAN
