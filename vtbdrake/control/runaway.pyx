"""A handler in C of SIGXCPU, which ends a process whose real-time thread computes without end.

A handler in Python would run only when the main thread returns to Python, which a step stuck in C++ never does.
"""

from libc.signal cimport SIGXCPU
from posix.signal cimport SA_RESTART, sigaction, sigaction_t, sigemptyset
from posix.unistd cimport _exit, write

cdef extern from "Python.h":
    int PyErr_SetInterruptEx(int number) nogil

EXIT_CODE = 70
cdef int _exit_code = EXIT_CODE
cdef const char* _message = b"a real-time thread computes without end: the process is ended\n"
cdef Py_ssize_t _length = len(_message)
cdef int _left = 0
cdef sigaction_t _before


cdef void _handle(int number) noexcept nogil:
    # Only functions that are safe in a signal handler.
    global _left
    if _left > 0:
        _left -= 1
        PyErr_SetInterruptEx(number)
        return
    write(2, _message, _length)
    _exit(_exit_code)


def install(int tolerated):
    """Forward the first ``tolerated`` signals to Python's handler; the next one ends the process with `EXIT_CODE`."""
    global _left
    cdef sigaction_t action
    _left = tolerated
    action.sa_handler = _handle
    action.sa_flags = SA_RESTART
    sigemptyset(&action.sa_mask)
    if sigaction(SIGXCPU, &action, &_before) != 0:
        raise OSError("sigaction failed for SIGXCPU")


def uninstall():
    """Restore the handler from before `install`."""
    sigaction(SIGXCPU, &_before, NULL)
