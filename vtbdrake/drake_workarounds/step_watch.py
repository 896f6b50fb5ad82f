"""Ends an integration that does not advance any more.

Fault: Drake's integrators with error control shorten a step whose error is NaN, and do not apply their shortest step to
that, so that they try steps for ever; the Newton method of the implicit ones does not end on NaN. It is a loop in C++
that Ctrl-C does not reach. Issue: https://github.com/RobotLocomotion/drake/issues/12647
"""

from __future__ import annotations

import os
import threading
import time
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
from pydrake.systems.analysis import IntegratorBase, Simulator
from pydrake.systems.framework import Context
from pydrake.systems.primitives import Integrator

# Time between two looks at the integrators, in s.
PERIOD = 0.25
# The thread ends after this time without an integrator to look at, in s.
_REST = 5.0
# An integrator that tries this number of steps
_ATTEMPTS = 1000
# within this time, relative to its own (at least 1 s), gets nowhere: a thousandth of it is the shortest step that Drake
# allows.
_ADVANCE = 1e-12
# Newton's method takes some 20 evaluations of the time derivatives, and 4 per state, for a stage of a step; there are
# six of them. Times 5 + the number of states, this is ten times as many.
_EVALUATIONS = 240


class NoProgressError(RuntimeError):
    """An integration does not advance any more."""


@dataclass(frozen=True)
class _Counts:
    time: float
    attempts: int  # steps, and steps that were taken back
    evaluations: int  # of the time derivatives


class StepWatch:
    """A context manager for calls of AdvanceTo, which end with a `NoProgressError` where no step leads further.

    Where the time derivatives are NaN from some state or time on, explicit integrators take shorter and shorter steps
    for ever. Where they are NaN already, these try one step for ever, and the Newton method of the implicit ones does
    not end.

    A thread of this process, which all watches share, looks at the counters of the integrators. One that tries steps
    without getting further is given a context of another system, which Drake refuses with an error. Nothing is added to
    the steps themselves.

    Args:
        simulator: The simulator that advances in the block.
        reason: Returns why the simulation cannot go on, given its context in the last state that it has reached.
    """

    def __init__(self, simulator: Simulator, reason: Callable[[Context], str]) -> None:
        self._simulator, self._reason = simulator, reason
        size = simulator.get_context().num_continuous_states()
        self._refused = Integrator(max(1, size)).CreateDefaultContext()
        # Held while a look touches the integrator, which may be replaced between two blocks.
        self._lock = threading.Lock()
        self.active = False
        self._most_evaluations = _EVALUATIONS * (5 + size)
        # At the first look since time stands still, and in the present attempt.
        self._begin: _Counts | None = None
        self._attempt: _Counts | None = None
        self._last_state: tuple[float, np.ndarray] | None = None
        _watcher.add(self)

    def __enter__(self) -> Self:
        self._begin = self._attempt = self._last_state = None
        self.active = True
        if not _watcher.runs:
            _watcher.wake()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            self.active = False
        if self._last_state is None:
            return
        context = self._simulator.get_mutable_context()
        self._simulator.get_mutable_integrator().reset_context(context)
        context.SetTime(self._last_state[0])
        context.SetContinuousState(self._last_state[1])
        if isinstance(error, Exception):
            raise NoProgressError(self._reason(context)) from error

    def look(self) -> None:
        """End the integration if it has not advanced in many attempts."""
        with self._lock:
            if not self.active or self._last_state is not None:
                return
            integrator, context = self._simulator.get_mutable_integrator(), self._simulator.get_context()
            now = _Counts(
                time=context.get_time(),
                attempts=integrator.get_num_steps_taken()
                + integrator.get_num_step_shrinkages_from_error_control()
                + integrator.get_num_step_shrinkages_from_substep_failures(),
                evaluations=integrator.get_num_derivative_evaluations(),
            )
            if self._begin is None or not abs(now.time - self._begin.time) <= _ADVANCE * max(1.0, abs(now.time)):
                self._begin = now
            if self._attempt is None or now.attempts != self._attempt.attempts:
                self._attempt = now
            if (
                now.attempts - self._begin.attempts >= _ATTEMPTS
                or now.evaluations - self._attempt.evaluations >= self._most_evaluations
            ):
                self._last_state = state_before_attempts(integrator, context, evaluations=self._most_evaluations)
                integrator.reset_context(self._refused)


def state_before_attempts(
    integrator: IntegratorBase, context: Context, *, evaluations: int
) -> tuple[float, np.ndarray]:
    """Return the time and the state that the attempts of another thread begin with.

    Args:
        integrator: The integrator of that thread.
        context: The context that it steps.
        evaluations: The number of evaluations of the time derivatives after which an attempt has ended.
    """
    # It tries a step, often with NaN in the state, and takes it back, in turns: look on for several attempts, however
    # long that thread is held up in the midst of one.
    samples = []
    end = integrator.get_num_derivative_evaluations() + evaluations
    for _ in range(10_000):
        now, state = context.get_time(), context.get_continuous_state_vector().CopyToVector()
        if np.isfinite(state).all():
            samples.append((now, state))
        if integrator.get_num_derivative_evaluations() >= end:
            break
        time.sleep(1e-4)  # Systems in Python go on meanwhile.
    return min(samples, key=lambda sample: sample[0], default=(now, state))


class _Watcher:
    """The thread that looks at all active watches; it runs while there are any."""

    def __init__(self) -> None:
        self._watches: weakref.WeakSet[StepWatch] = weakref.WeakSet()
        self._begin()
        os.register_at_fork(after_in_child=self._begin)

    def _begin(self) -> None:
        self._lock = threading.Lock()
        self.runs = False

    def add(self, watch: StepWatch) -> None:
        with self._lock:
            self._watches.add(watch)

    def wake(self) -> None:
        """Start the thread, unless it runs."""
        with self._lock:
            if not self.runs:
                self.runs = True
                threading.Thread(target=self._run, name="step-watch", daemon=True).start()

    def _active(self) -> list[StepWatch]:
        with self._lock:
            return [watch for watch in self._watches if watch.active]

    def _look(self) -> bool:
        """Look at all active watches, and return whether there are any; none of them is held afterwards."""
        watches = self._active()
        for watch in watches:
            watch.look()
        return bool(watches)

    def _run(self) -> None:
        idle = 0.0
        while idle < _REST:
            time.sleep(PERIOD)
            idle = 0.0 if self._look() else idle + PERIOD
        self.runs = False
        if self._active():  # It became active before that was known.
            self.wake()


_watcher = _Watcher()
