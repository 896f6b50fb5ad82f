"""Real-time settings of the operating system for a punctual loop, and which of them were granted."""

from __future__ import annotations

import ctypes
import errno
import faulthandler
import gc
import os
import re
import resource
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import FrameType
from typing import NoReturn, Self

from vtbdrake.control import runaway


class RealTimeError(RuntimeError):
    """A required setting was refused."""


class RunawayError(BaseException):
    """A thread under SCHED_FIFO has computed for longer than allowed without waiting once: it is in an endless loop.

    It is not an `Exception`, so that it ends the loop, which sends the fallback commands, and does not count as a fault
    of one step, which would be tried again.
    """


@dataclass(frozen=True)
class Grant:
    """The operating system's answer to one request.

    Attributes:
        request: The requested setting.
        granted: Whether it was granted.
        reason: Why it was refused; empty if granted.
        remedy: What to do about a refusal; empty if granted.
    """

    request: str
    granted: bool
    reason: str = ""
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.request}: " + ("granted" if self.granted else f"refused ({self.reason}): {self.remedy}")


class RealTime:
    """Gives the calling thread and the process real-time settings, and restores the old ones afterwards.

    ::

        with RealTime(priority=80) as real_time:
            print(real_time)
            runtime.run()

    The thread gets SCHED_FIFO (threads and processes that it starts do not) and a timer slack of 1 ns, which matters if
    SCHED_FIFO is refused. The process's memory is locked, Python's garbage collector is disabled, existing objects are
    frozen, and threads hand over the GIL quickly. Enter and leave it in the same thread.

    Args:
        priority: Priority of SCHED_FIFO, 1 to 99; None keeps the scheduler.
        lock_memory: Whether to keep present and future memory from being paged out. If locked memory is limited (see
            ``ulimit -l``), later allocations fail when the limit is reached.
        cpus: Processors to run on; None keeps them.
        awake: Whether to keep idle processors from sleeping, since a sleeping one wakes up late. It costs power.
        collect_garbage: Whether Python's garbage collector stays enabled. While it is disabled, cyclic garbage is not
            freed.
        switch_interval: Time in seconds after which a waiting thread requests the GIL; None keeps it.
        longest_step: Processor time in seconds that a thread under SCHED_FIFO may take without waiting; None sets no
            limit. Beyond it, the stacks of all threads are written to stderr, and `RunawayError` is raised in the main
            thread. If that does not help within a second, because the thread is stuck in C++, or at once if the thread
            is not the main one, the process ends: otherwise nothing else would ever run on its processor.
        require: Whether a refusal is an error.

    Attributes:
        grants: The answers, in order, after entering.
    """

    def __init__(
        self,
        *,
        priority: int | None = 80,
        lock_memory: bool = True,
        cpus: set[int] | None = None,
        awake: bool = True,
        collect_garbage: bool = False,
        switch_interval: float | None = 5e-5,
        longest_step: float | None = 2.0,
        require: bool = False,
    ) -> None:
        if priority is not None and not 1 <= priority <= 99:
            raise ValueError(f"a priority of SCHED_FIFO lies in 1 to 99, not at {priority}")
        if cpus is not None and not cpus:
            raise ValueError("a thread needs at least one processor to run on: give cpus={0}, for example, or None")
        if switch_interval is not None and not switch_interval > 0.0:
            raise ValueError(f"the switch interval is a positive time, not {switch_interval} s")
        if longest_step is not None and not 0.0 < longest_step < _LONGEST_STEP:
            raise ValueError(f"the longest step lies above 0 and below {_LONGEST_STEP:g} s, not at {longest_step} s")
        self.grants: tuple[Grant, ...] = ()
        self._require = require
        self._requests: list[tuple[str, Callable[[], AbstractContextManager[None]], str]] = []
        if cpus is not None:
            self._requests.append((f"processors {sorted(cpus)}", partial(_affinity, frozenset(cpus)), _CPUS))
        if awake:
            self._requests.append(("processors stay awake", _awake, _AWAKE))
        if lock_memory:
            self._requests.append(("locked memory", _locked_memory, _MEMORY))
        if not collect_garbage:
            self._requests.append(("no garbage collection", _no_collection, ""))
        if switch_interval is not None:
            text = f"switch interval {1e6 * switch_interval:g} us"
            self._requests.append((text, partial(_switch_interval, switch_interval), ""))
        self._requests.append(("timer slack 1 ns", _timer_slack, _SLACK))
        if priority is not None:
            self._requests.append((f"SCHED_FIFO {priority}", partial(_fifo, priority), _FIFO))
        if priority is not None and longest_step is not None:
            text = f"steps of {longest_step:g} s at most"
            self._requests.append((text, partial(_limited_steps, longest_step), _STEPS))
        self._undo = ExitStack()

    def __enter__(self) -> Self:
        """Apply the settings.

        Raises:
            RealTimeError: A setting was refused and ``require`` is set; nothing has changed.
        """
        with ExitStack() as undo:
            self.grants = tuple(_ask(undo, *request) for request in self._requests)
            refused = [str(grant) for grant in self.grants if not grant.granted]
            if refused and self._require:
                raise RealTimeError("; ".join(refused))
            self._undo = undo.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._undo.close()

    def __str__(self) -> str:
        """Return one line per request."""
        return "\n".join(map(str, self.grants))


_LATENCY = "/dev/cpu_dma_latency"
_STDERR = 2
_LONGEST_STEP = 1000.0

_FIFO = (
    "run as root, or give the user rtprio in /etc/security/limits.conf, or the container --cap-add SYS_NICE "
    "--ulimit rtprio=99"
)
_MEMORY = (
    "run as root, or give the user 'memlock unlimited' in /etc/security/limits.conf, or the container "
    "--ulimit memlock=-1"
)
_CPUS = "choose from those that the process may use (os.sched_getaffinity(0)), or widen the container's cpuset"
_AWAKE = f"run as root, or let the user write to {_LATENCY}; in a container, --device {_LATENCY}"
_STEPS = (
    "get SCHED_FIFO first; then give the user a higher rttime in /etc/security/limits.conf, or choose longest_step "
    "below it (ulimit -R tells, in us)"
)
_SLACK = "use a kernel that has PR_SET_TIMERSLACK"


def _ask(undo: ExitStack, request: str, setting: Callable[[], AbstractContextManager[None]], remedy: str) -> Grant:
    """Apply a setting, which ``undo`` restores."""
    try:
        undo.enter_context(setting())
    except OSError as error:
        name = errno.errorcode.get(error.errno or 0, str(error.errno))
        return Grant(request, False, f"{name}, {error.strerror}", remedy)
    return Grant(request, True)


@contextmanager
def _affinity(cpus: frozenset[int]) -> Iterator[None]:
    before = os.sched_getaffinity(0)
    # The kernel would silently drop processors that are not available.
    if not cpus <= before:
        raise OSError(errno.EINVAL, f"only {sorted(before)} may be used")
    os.sched_setaffinity(0, cpus)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


@contextmanager
def _awake() -> Iterator[None]:
    # The kernel's PM QoS interface: 0 us are allowed for waking up, as long as the file is open.
    with open(_LATENCY, "wb", buffering=0) as file:
        file.write(bytes(4))
        yield


@contextmanager
def _locked_memory() -> Iterator[None]:
    was_locked = _locked_kilobytes() > 0
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        raise _last_error()
    try:
        yield
    finally:
        if not was_locked:
            libc.munlockall()


def _last_error() -> OSError:
    number = ctypes.get_errno()
    return OSError(number, os.strerror(number))


def _locked_kilobytes() -> int:
    match = re.search(r"^VmLck:\s+(\d+) kB$", Path("/proc/self/status").read_text(encoding="utf-8"), re.MULTILINE)
    return int(match[1]) if match else 0


@contextmanager
def _no_collection() -> Iterator[None]:
    was_enabled, was_frozen = gc.isenabled(), gc.get_freeze_count() > 0
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        # Python unfreezes all or nothing: objects frozen by other code must stay frozen.
        if not was_frozen:
            gc.unfreeze()
        if was_enabled:
            gc.enable()


@contextmanager
def _switch_interval(seconds: float) -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(seconds)
    try:
        yield
    finally:
        # Python truncates it to whole microseconds: 49.999999999999996 would become 49.
        sys.setswitchinterval(before + 0.5e-6)


@contextmanager
def _timer_slack() -> Iterator[None]:
    libc = ctypes.CDLL(None, use_errno=True)
    before = libc.prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0)
    if before < 0 or libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0) != 0:
        raise _last_error()
    try:
        yield
    finally:
        # Under SCHED_FIFO a thread has no slack, and cannot be given any: the kernel reports 0.
        libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(before), 0, 0, 0)


@contextmanager
def _limited_steps(seconds: float) -> Iterator[None]:
    if os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK != os.SCHED_FIFO:
        raise OSError(errno.EINVAL, "only threads under SCHED_FIFO can be limited")
    before, most = resource.getrlimit(resource.RLIMIT_RTTIME)
    limit = round(1e6 * seconds)
    if most != resource.RLIM_INFINITY and limit > most:
        raise OSError(errno.EINVAL, f"only {1e-6 * most:g} s are allowed")
    main = threading.current_thread() is threading.main_thread()
    # Python can raise an error in the main thread only.
    handler = signal.signal(signal.SIGXCPU, partial(_raise_runaway, seconds)) if main else None
    runaway.install(1 if main else 0)
    faulthandler.register(signal.SIGXCPU, file=_STDERR, chain=True)
    resource.setrlimit(resource.RLIMIT_RTTIME, (limit, most))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_RTTIME, (before, most))
        faulthandler.unregister(signal.SIGXCPU)
        runaway.uninstall()
        if main:
            signal.signal(signal.SIGXCPU, handler)


def _raise_runaway(seconds: float, number: int, frame: FrameType | None) -> NoReturn:
    raise RunawayError(
        f"a real-time thread has computed for {seconds:g} s without waiting: its step does not end, or needs a larger "
        "RealTime(longest_step=...)"
    )


@contextmanager
def _fifo(priority: int) -> Iterator[None]:
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    try:
        yield
    finally:
        try:
            os.sched_setscheduler(0, policy, parameters)
        except PermissionError:
            # Without privileges the flag cannot be taken back; it only keeps children from inheriting more.
            os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, parameters)


_MCL_CURRENT = 1  # <sys/mman.h>
_MCL_FUTURE = 2
_PR_SET_TIMERSLACK = 29  # <linux/prctl.h>
_PR_GET_TIMERSLACK = 30
