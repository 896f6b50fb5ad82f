"""Threads take turns in making testbeds."""

import threading

import pytest

from vtbdrake.drake_workarounds.making import making


@pytest.mark.one_python
def test_threads_make_testbeds_one_at_a_time_and_the_main_thread_waits_for_none() -> None:
    entered, leave, second = threading.Event(), threading.Event(), threading.Event()

    def make(begun: threading.Event) -> None:
        with making(), making():  # A testbed may be made while another one is.
            begun.set()
            leave.wait(60.0)

    threads = [threading.Thread(target=make, args=(event,)) for event in (entered, second)]
    threads[0].start()
    assert entered.wait(60.0)
    threads[1].start()
    with making():
        assert not second.wait(0.05)
    leave.set()
    for thread in threads:
        thread.join(60.0)
    assert second.is_set()
