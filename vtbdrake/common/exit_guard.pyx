"""Threads that end the process some time after a signal, or after its parent's end, whatever it computes or waits for.

The signals are Ctrl-C, SIGTERM and SIGHUP, where Python handles them.

They need no interpreter: code in C or C++ may hold Python's lock all the time, or have dropped the KeyboardInterrupt.
"""

from libc.signal cimport SIGINT, SIGTERM
from posix.time cimport CLOCK_MONOTONIC, clock_gettime, nanosleep, timespec
from posix.unistd cimport _exit, read, write

cdef extern from "pthread.h" nogil:
    ctypedef unsigned long pthread_t
    int pthread_create(pthread_t* thread, void* attributes, void* (*start)(void*) noexcept nogil, void* argument)
    int pthread_detach(pthread_t thread)

cdef extern from "signal.h" nogil:
    int SIGHUP

cdef extern from "poll.h" nogil:
    struct pollfd:
        int fd
        short events
    int poll(pollfd* files, unsigned long count, int timeout)

cdef int _descriptor = -1
cdef double _time
cdef volatile int _code
# Counts what has been released: a countdown goes on as long as it stays the same.
cdef volatile int _released = 0


cdef double _now() noexcept nogil:
    cdef timespec time
    clock_gettime(CLOCK_MONOTONIC, &time)
    return time.tv_sec + 1e-9 * time.tv_nsec


cdef void* _guard(void* _) noexcept nogil:
    cdef unsigned char number
    cdef int released
    cdef double begin
    cdef timespec turn
    cdef const char* message = b"Aborted!\n"
    turn.tv_sec, turn.tv_nsec = 0, 20_000_000
    while read(_descriptor, &number, 1) == 1:
        if number not in (SIGINT, SIGTERM, SIGHUP):
            continue
        released, begin = _released, _now()
        while released == _released:
            nanosleep(&turn, NULL)
            if _now() - begin > _time and released == _released:
                if _code != 0:
                    write(2, message, 9)
                _exit(_code)
    return NULL


cdef int _connection = -1
cdef double _grace


cdef void* _watch_connection(void* _) noexcept nogil:
    cdef pollfd watched
    cdef timespec rest
    watched.fd, watched.events = _connection, 0  # A hang-up is always reported.
    while poll(&watched, 1, -1) != 1:  # A signal may come between.
        pass
    rest.tv_sec = <long>_grace
    rest.tv_nsec = <long>(1e9 * (_grace - rest.tv_sec))
    while nanosleep(&rest, &rest) != 0:
        pass
    _exit(1)


cdef void _start(void* (*function)(void*) noexcept nogil) except *:
    cdef pthread_t thread
    if pthread_create(&thread, NULL, function, NULL) != 0:
        raise OSError("the system grants no thread that ends the process in time")
    pthread_detach(thread)


def exit_after_hang_up(connection: int, grace: float) -> None:
    """Start a thread that ends the process, with exit code 1, some time after the other end of a connection has closed.

    Args:
        connection: The descriptor of the connection, which stays open.
        grace: The time, in s.

    Raises:
        OSError: The system grants no further thread.
    """
    global _connection, _grace
    _connection, _grace = connection, grace
    _start(_watch_connection)


def start(descriptor: int, time: float, code: int) -> None:
    """Start the thread, once in a process.

    Args:
        descriptor: The end of a pipe from which the numbers of signals are read, see `signal.set_wakeup_fd`.
        time: The time that the process may take after a SIGINT, SIGTERM or SIGHUP that it handles, in s.
        code: The exit code of the process; with another than 0, ``Aborted!`` is printed.

    Raises:
        OSError: The system grants no further thread.
    """
    global _descriptor, _time, _code
    _descriptor, _time, _code = descriptor, time, code
    _start(_guard)


def set_code(code: int) -> None:
    """Set the exit code."""
    global _code
    _code = code


def release() -> None:
    """Let the process go on: what was interrupted ends in its own way. The next signal counts anew."""
    global _released
    _released += 1
