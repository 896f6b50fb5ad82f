"""Requests to a thread: they are carried out in it, in their order, and their failures are raised where it is asked."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from vtbdrake.web.serving import requests as requests_module
from vtbdrake.web.serving.requests import Requests, wait_for_end


class EndedError(RuntimeError):
    pass


class FailedError(RuntimeError):
    pass


def requests() -> Requests:
    return Requests(EndedError, "the thread has ended", lambda error: FailedError(f"{type(error).__name__}: {error}"))


@contextmanager
def working(asked: Requests) -> Iterator[threading.Thread]:
    """Carry out requests in a thread, which has ended at the end."""

    def run() -> None:
        while asked.carry_out():
            pass

    thread = threading.Thread(target=run)
    thread.start()
    yield thread
    asked.end()
    thread.join(60.0)
    assert not thread.is_alive()


def test_actions_are_carried_out_in_the_thread_in_their_order() -> None:
    asked, numbers = requests(), []
    with working(asked) as thread:
        for number in range(5):
            asked.tell(lambda number=number: numbers.append(number))
        assert asked.ask(thread, threading.current_thread) is thread
    assert numbers == [*range(5)]


def test_a_failure_is_raised_where_it_is_asked_and_the_thread_goes_on() -> None:
    asked = requests()
    with working(asked) as thread:
        for error in (ValueError("wrong"), SystemExit("left")):

            def fail(error: BaseException = error) -> None:
                raise error

            with pytest.raises(FailedError, match=f"{type(error).__name__}: {error}"):
                asked.ask(thread, fail)
            assert isinstance(asked.tell(fail).exception(60.0), FailedError)
        assert asked.ask(thread, lambda: 7) == 7


def test_a_thread_that_has_ended_is_not_waited_for() -> None:
    asked = requests()
    with working(asked) as thread:
        pass
    with pytest.raises(EndedError, match="the thread has ended"):
        asked.ask(thread, lambda: 7)


def test_what_was_asked_before_the_end_is_done_and_nothing_after_it() -> None:
    asked = requests()
    before = asked.tell(lambda: "before")
    asked.end()
    after = asked.tell(lambda: "after")
    assert not asked.carry_out(0.0)
    assert before.result(0.0) == "before"
    assert not after.done()


def test_without_requests_the_thread_goes_on_after_its_patience() -> None:
    asked = requests()
    assert asked.carry_out(0.0)
    answers = [asked.tell(lambda number=number: number) for number in range(3)]
    assert asked.carry_out(0.0)
    assert [answer.result(0.0) for answer in answers] == [0, 1, 2]


def test_a_thread_that_hangs_is_left_behind(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(requests_module, "LONGEST_END", 0.01)
    hangs = threading.Event()
    thread = threading.Thread(target=hangs.wait)
    thread.start()
    wait_for_end(thread, "the worker")
    hangs.set()
    thread.join()
    assert "the worker does not end within 0.01 s: its thread is left behind" in caplog.text


def test_what_a_thread_begins_meanwhile_is_ended_too(caplog: pytest.LogCaptureFixture) -> None:
    ends = threading.Semaphore(0)
    thread = threading.Thread(target=lambda: [ends.acquire(timeout=60.0) for _ in range(2)])
    thread.start()
    wait_for_end(thread, "the worker", end=ends.release)
    assert not thread.is_alive() and not caplog.text
