"""Clocks wait for absolute deadlines."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from math import inf, nan
from pathlib import Path

import pytest

from vtbdrake.control.clock import Clock, SimulatedClock, Throttle, WallClock

ROOT = Path(__file__).resolve().parents[2]


def test_wall_clock_tells_monotonic_time() -> None:
    before = time.monotonic()
    now = WallClock().now()
    assert before <= now <= time.monotonic()


@pytest.mark.parametrize("spin", [0.0, 2e-3])
def test_wall_clock_never_wakes_up_early(spin: float) -> None:
    clock = WallClock(spin=spin)
    begin = clock.now()
    for k in range(1, 21):
        deadline = begin + 1e-3 * k
        assert deadline <= clock.wait_until(deadline) <= clock.now()


def test_wall_clock_sleeps_while_it_waits() -> None:
    clock = WallClock()
    used = time.thread_time()
    clock.wait_until(clock.now() + 0.2)
    assert time.thread_time() - used < 0.1


def test_wall_clock_polls_while_it_spins() -> None:
    clock = WallClock(spin=0.2)
    used = time.thread_time()
    deadline = clock.now() + 0.2
    clock.wait_until(deadline)
    polled = time.thread_time() - used
    assert polled > 1e-3


def test_meanwhile_is_called_before_polling() -> None:
    clock = WallClock(spin=0.1)

    def left() -> float:
        done: list[float] = []
        deadline = clock.now() + 0.2
        assert clock.wait_until(deadline, lambda: done.append(clock.now())) >= deadline
        assert len(done) == 1
        return deadline - done[0]

    # A computer that is busy may let it sleep for too long.
    assert any(0.0 < left() <= 0.1 for _ in range(20))


@pytest.mark.parametrize(
    ("clock", "time_left"),
    [(WallClock(), 0.01), (WallClock(spin=0.5), 0.1), (WallClock(), -1.0), (SimulatedClock(), 1.0)],
)
def test_meanwhile_is_skipped_without_time(clock: WallClock | SimulatedClock, time_left: float) -> None:
    clock.wait_until(clock.now() + time_left, lambda: pytest.fail("it was done"))


def test_past_deadline_returns_at_once() -> None:
    clock = WallClock()
    assert clock.wait_until(clock.now() - 1e6) <= clock.now()


# Seconds to wait: on a busy computer, what happens meanwhile may come after a short time.
LONGER_AND_LONGER = [0.2 * 3**k for k in range(6)]


def test_other_threads_run_while_the_wall_clock_waits() -> None:
    def runs_meanwhile(seconds: float) -> bool:
        clock, done = WallClock(), []
        deadline = clock.now() + seconds
        thread = threading.Thread(target=lambda: done.append(clock.now()))
        timer = threading.Timer(0.01, thread.start)
        timer.start()
        clock.wait_until(deadline)
        timer.join()
        thread.join()
        return done[0] < deadline

    assert any(runs_meanwhile(seconds) for seconds in LONGER_AND_LONGER)


def test_wait_continues_after_a_signal_handler() -> None:
    def handled_meanwhile(seconds: float) -> bool:
        clock, handled = WallClock(), []
        before = signal.signal(signal.SIGALRM, lambda *_: handled.append(clock.now()))
        try:
            deadline = clock.now() + seconds
            signal.setitimer(signal.ITIMER_REAL, 0.02)
            assert clock.wait_until(deadline) >= deadline
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)
        return bool(handled) and handled[0] < deadline

    assert any(handled_meanwhile(seconds) for seconds in LONGER_AND_LONGER)


def sleeps(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] == "S"


def test_ctrl_c_ends_the_wait() -> None:
    code = (
        "from vtbdrake.control.clock import WallClock; c = WallClock()\n"
        "try: print('waits', flush=True); c.wait_until(c.now() + 60.0)\n"
        "except KeyboardInterrupt: print('interrupted')"
    )
    with subprocess.Popen([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "waits\n"
            give_up = time.monotonic() + 30.0
            while not sleeps(process.pid) and time.monotonic() < give_up:
                pass
            process.send_signal(signal.SIGINT)
            rest, _ = process.communicate(timeout=60.0)
        finally:
            process.kill()
    assert rest == "interrupted\n"


@pytest.mark.parametrize("clock", [WallClock(), SimulatedClock()])
@pytest.mark.parametrize("t", [nan, inf])
def test_deadline_must_be_finite(clock: Clock, t: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        clock.wait_until(t)


@pytest.mark.parametrize("spin", [-1e-6, 1.0, nan])
def test_spin_must_be_below_one_second(spin: float) -> None:
    with pytest.raises(ValueError, match="spin"):
        WallClock(spin=spin)


def test_simulated_clock_jumps_to_the_deadline() -> None:
    clock = SimulatedClock(start=2.0)
    assert clock.now() == 2.0
    assert clock.wait_until(3.5) == 3.5 == clock.now()


def test_simulated_clock_never_runs_backwards() -> None:
    clock = SimulatedClock(start=2.0)
    assert clock.wait_until(1.0) == 2.0


def test_simulated_clock_is_late_by_list() -> None:
    clock = SimulatedClock(lateness=[0.25, 0.0, 0.5])
    assert [clock.wait_until(float(t)) for t in (1, 2, 3, 4)] == [1.25, 2.0, 3.5, 4.0]


def test_advance_adds_simulated_time() -> None:
    clock = SimulatedClock()
    clock.advance(0.75)
    assert clock.wait_until(0.5) == 0.75


@pytest.mark.parametrize("seconds", [-1.0, nan, inf])
def test_simulated_time_cannot_run_backwards(seconds: float) -> None:
    with pytest.raises(ValueError, match="from 0 on"):
        SimulatedClock().advance(seconds)


def test_simulated_clock_is_never_early() -> None:
    with pytest.raises(ValueError, match="not be negative"):
        SimulatedClock(lateness=[-0.1]).wait_until(1.0)


def test_throttle_calls_at_once_and_then_once_per_period() -> None:
    clock, calls = SimulatedClock(start=5.0), []
    throttle = Throttle(clock, period=0.5)
    for _ in range(40):
        throttle(calls.append, clock.now())
        clock.advance(0.125)
    assert calls == [5.0 + 0.5 * k for k in range(10)]
