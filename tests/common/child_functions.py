"""Functions that child processes of the tests run, apart from the tests: they start without pytest."""

import os
import signal
import subprocess
import sys
import time

from vtbdrake.common.child_process import ProcessStartError, report_ready


def echo(connection, *parts):
    report_ready(connection)
    connection.sendall(repr(parts).encode())
    while data := connection.recv(1024):
        connection.sendall(data)


def answer_late(connection):
    """Answer no request before the second one has come, then each by itself."""
    report_ready(connection)
    lines = connection.recv(1024)
    while lines.count(b"\n") < 2:
        lines += connection.recv(1024)
    connection.sendall(lines)
    connection.recv(1)


def refuse(connection):
    raise ProcessStartError("no robot\nis connected")


def fail(connection):
    raise ArithmeticError("a failure of the test")


def sleep(connection):
    report_ready(connection)
    time.sleep(600.0)


def terminated(connection):
    """Tell how SIGTERM ends a program that the child starts, and a copy of the child."""
    report_ready(connection)
    program = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    reader, writer = os.pipe()
    copy = os.fork()
    if not copy:
        os.write(writer, b"x")  # The copy ignores signals no more.
        time.sleep(600.0)
        os._exit(0)
    os.read(reader, 1)
    connection.recv(1)
    for pid in (program.pid, copy):
        os.kill(pid, signal.SIGTERM)
    codes = program.wait(), os.waitstatus_to_exitcode(os.waitpid(copy, 0)[1])
    connection.sendall(repr(codes).encode())


def compute_in_c(connection):
    report_ready(connection)
    sum(range(10**12))  # No other thread of Python runs meanwhile.


def exit_with(connection, code):
    os._exit(code)


def accept(connection, listener):
    report_ready(connection)
    with listener.accept()[0] as accepted:
        accepted.sendall(b"accepted")
