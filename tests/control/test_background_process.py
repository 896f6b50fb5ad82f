"""Worker processes beside the loop: frames, backlog, and how they end."""

import os
import select
import signal
import socket
import time

import numpy as np
import pytest

from tests.control.background_functions import echo, fail, fall_asleep, sum_up, tell_scheduling
from tests.interruptions import hanging_fails
from vtbdrake.control.background_process import BackgroundProcess, FrameConnection

TIMEOUT = 60.0


def taken(worker, count):
    """The first ``count`` frames that come back."""
    frames, end = [], time.monotonic() + TIMEOUT
    while len(frames) < count:
        worker.flush()
        ready, _, _ = select.select((worker,), (), (), 0.05)
        frames += worker.pop_frames() if ready else []
        assert time.monotonic() < end, f"{len(frames)} frames of {count} came back"
    return frames


def test_frames_return_whole_and_in_order():
    random = np.random.default_rng(0)
    sent = [random.bytes(int(size)) for size in random.integers(0, 300_000, 60)]
    worker = BackgroundProcess(echo, name="echo")
    try:
        back = []
        for frame in sent:
            assert worker.post_frame(frame[:10], frame[10:])
            back += worker.pop_frames()
        back += taken(worker, len(sent) - len(back))
        assert back == sent and worker.dropped == 0
    finally:
        assert worker.close() == 0


def test_worker_waits_for_a_frame_as_long_as_it_says():
    ours, theirs = socket.socketpair()
    with ours, theirs, hanging_fails("a wait of 10 ms"):
        connection = FrameConnection(ours)
        with pytest.raises(TimeoutError, match=r"no frame arrived within 0\.01 s"):
            connection.receive_frame(0.01)
        FrameConnection(theirs).send_frame(b"late")
        assert connection.receive_frame(0.01) == b"late"


def test_close_sends_what_waits():
    worker = BackgroundProcess(sum_up, name="sum", backlog=1 << 26)
    for _ in range(100):
        assert worker.post_frame(bytes(100_000))
    assert worker.close() == 0
    assert worker.pop_frames() == [b"10000000"]


def test_close_receives_what_a_blocked_worker_sends():
    worker = BackgroundProcess(echo, name="echo", backlog=1 << 26)
    frames = [bytes([k]) * 100_000 for k in range(100)]
    for frame in frames:
        assert worker.post_frame(frame)
    assert worker.close() == 0
    assert worker.pop_frames() == frames


def test_long_frames_are_sent_in_pieces():
    worker = BackgroundProcess(sum_up, name="sum")
    waiting = []
    worker.post_frame(bytes(1 << 20))
    while worker.unsent:
        waiting.append(worker.unsent)
        worker.flush()
    assert worker.close() == 0
    assert worker.pop_frames() == [b"1048576"]
    assert np.diff(waiting, prepend=1 << 20).min() >= -(1 << 18)


def test_full_backlog_drops_frames_without_waiting():
    worker = BackgroundProcess(fall_asleep, name="sleeper", backlog=1 << 20)
    accepted = [worker.post_frame(bytes(1 << 16)) for _ in range(200)]
    worker.kill()
    assert worker.dropped == accepted.count(False) > 0
    assert sum(accepted) <= 200 and worker.unsent <= 1 << 20


def test_killed_worker_is_noticed_and_drops_are_counted():
    worker = BackgroundProcess(echo, name="victim")
    worker.post_frame(b"hello")
    assert taken(worker, 1) == [b"hello"]
    os.kill(worker.pid, signal.SIGKILL)
    select.select((worker,), (), (), TIMEOUT)
    assert worker.pop_frames() == [] and not worker.alive
    assert not worker.post_frame(b"again") and worker.dropped == 1
    assert worker.close() == -signal.SIGKILL


def test_end_of_the_worker_is_logged_once(caplog):
    worker = BackgroundProcess(fail, 3, name="failure")
    assert worker.wait_for_messages(TIMEOUT) == []
    assert worker.pop_frames() == worker.pop_frames() == [] and not worker.alive
    assert caplog.text.count(f"failure (process {worker.pid}) is lost: ") == 1
    assert worker.close() == 3


def test_close_and_kill_are_not_logged(caplog):
    BackgroundProcess(echo, name="echo").close()
    BackgroundProcess(fall_asleep, name="sleeper").kill()
    assert not caplog.text


def test_worker_that_does_not_end_is_killed():
    worker = BackgroundProcess(fall_asleep, name="sleeper")
    assert worker.close(timeout=1.0) == -signal.SIGKILL


def test_close_returns_the_exit_code():
    assert BackgroundProcess(fail, 3, name="failure").close() == 3


def test_worker_has_ordinary_scheduling_and_all_processors():
    processors = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(processors)})
    try:
        worker = BackgroundProcess(tell_scheduling, name="teller")
        assert taken(worker, 1) == [f"{os.SCHED_OTHER} {len(processors)}".encode()]
        worker.close()
    finally:
        os.sched_setaffinity(0, processors)
