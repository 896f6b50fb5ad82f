"""Functions for background processes of the tests, apart from these: they start without pytest and numpy."""

import os
import signal


def echo(connection):
    while True:
        connection.send_frame(connection.receive_frame())


def sum_up(connection):
    total = 0
    try:
        while True:
            total += len(connection.receive_frame())
    except EOFError:
        connection.send_frame(str(total).encode())


def fall_asleep(connection):
    signal.pause()


def tell_scheduling(connection):
    connection.send_frame(f"{os.sched_getscheduler(0)} {len(os.sched_getaffinity(0))}".encode())


def fail(connection, code):
    os._exit(code)
