"""Ctrl-C ends rollouts, also where pybind11 or a finalizer drops the exception."""

import gc
import random
import signal
from dataclasses import dataclass

import numpy as np
import pytest

from tests.testbeds import AcrobotScenario, PendulumScenario, SampledFeedback
from vtbdrake.drake_workarounds.lost_interrupts import Interruptible
from vtbdrake.rollout import Quality, RolloutRunner, RolloutTask, SerialExecutor, ThreadExecutor
from vtbdrake.rollout.executor import run_rollouts

SHOULDER = "sim.sys.Acrobot.shoulder.position"
THETA = "sim.sys.Pendulum.theta.position"


class CtrlC:
    """Ctrl-C is pressed while pybind11 makes an array of this, and each time it is counted."""

    presses = 0

    def __array__(self, dtype=None, copy=None):
        CtrlC.presses += 1
        signal.raise_signal(signal.SIGINT)
        return np.zeros(1)


class Deletion:
    """Ctrl-C is pressed in a finalizer."""

    def __del__(self):
        CtrlC.presses += 1
        signal.raise_signal(signal.SIGINT)


class Interrupted(SampledFeedback):
    """Is interrupted in its update at 0.1 s, in the way that is asked for."""

    def __init__(self, how):
        super().__init__(0.02)
        self._how = how
        self.DeclarePeriodicDiscreteUpdateEvent(10.0, 0.1, self._press)

    def _press(self, context, discrete):
        if self._how == "conversion":
            discrete.set_value(0, CtrlC())
        elif self._how == "finalizer":
            Deletion()
        else:
            signal.raise_signal(signal.SIGINT)


@dataclass
class InterruptedScenario(AcrobotScenario):
    how: str = "conversion"

    def make_dps(self):
        return Interrupted(self.how)


@pytest.mark.filterwarnings("ignore:Exception ignored")
@pytest.mark.parametrize("how", ["conversion", "finalizer", "plainly"])
@pytest.mark.parametrize("make", [SerialExecutor, lambda: ThreadExecutor(2)])
def test_ctrl_c_in_a_simulation_ends_the_sweep_at_once(make, how, caplog):
    CtrlC.presses = 0
    task = RolloutTask(InterruptedScenario(how=how), 1e3, Quality(abs, SHOULDER))
    with make() as executor:
        # A single point is run in this thread by every executor of threads.
        assert run_rollouts(executor, task, [{}], progress=False) == [None]
    assert CtrlC.presses == (how != "plainly")
    assert "interrupted: 0 of 1 rollouts" in caplog.text
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_in_second_simulation_is_no_failure():
    task = RolloutTask(InterruptedScenario(), 1.0, Quality(abs, SHOULDER))
    with pytest.raises(KeyboardInterrupt):
        RolloutRunner(task).state({}, 0.5)


class Pressing(dict):
    """A point of a rollout; when it is looked at, Ctrl-C is pressed in a finalizer."""

    def items(self):
        Deletion()
        return super().items()


@pytest.mark.filterwarnings("ignore:Exception ignored")
def test_ctrl_c_beside_a_simulation_is_not_lost():
    task = RolloutTask(PendulumScenario(), 0.1, Quality(abs, THETA))
    with SerialExecutor() as executor, pytest.raises(KeyboardInterrupt):
        list(executor.run(task, [Pressing({THETA: 0.1})]))


class PressingLater(SerialExecutor):
    """Ctrl-C is pressed in a finalizer, beside the rollouts."""

    def run(self, task, points):
        for found in super().run(task, points):
            Deletion()
            yield found


@pytest.mark.filterwarnings("ignore:Exception ignored")
def test_ctrl_c_between_rollouts_is_not_lost(caplog):
    task = RolloutTask(PendulumScenario(), 0.1, Quality(abs, THETA))
    with PressingLater() as executor:
        results = run_rollouts(executor, task, [{THETA: 0.1}] * 3, progress=False)
    assert [result is None for result in results] == [False, True, True]
    assert "interrupted: 1 of 3 rollouts" in caplog.text


@dataclass
class InterruptedBuild(PendulumScenario):
    at: float = 0.0

    def make_dps(self):
        if self.at:
            np.add(CtrlC(), 1.0) if self.at < 0 else self._lose()
        return super().make_dps()

    def _lose(self):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise TypeError("incompatible function arguments") from None


@pytest.mark.parametrize("at", [1.0, -1.0])
def test_ctrl_c_during_a_build_is_no_failed_build(at):
    task = RolloutTask(InterruptedBuild(), 0.1, Quality(abs, THETA))
    with SerialExecutor() as executor, pytest.raises(KeyboardInterrupt):
        list(executor.run(task, [{"scenario.at": at}]))
    with SerialExecutor() as executor, pytest.raises(KeyboardInterrupt):
        list(executor.run(RolloutTask(InterruptedBuild(at=at), 0.1, Quality(abs, THETA)), [{}]))


def test_no_interrupt_of_many_is_lost():
    """Without care, about one of 25 was: the controller below has a list made an array at every step."""
    handled = 0

    def handler(number, frame):
        nonlocal handled
        handled += 1
        raise KeyboardInterrupt

    # Those of test tools (hypothesis), and finalizers of what other tests have left, would drop an interrupt outside of
    # what is tested.
    gc.collect()
    callbacks = gc.callbacks[:]
    gc.callbacks.clear()
    before = signal.signal(signal.SIGINT, handler)
    alarm = signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
    try:
        random.seed(0)
        task = RolloutTask(AcrobotScenario(), 0.2, Quality(abs, SHOULDER))
        executor = SerialExecutor()
        list(executor.run(task, [{}]))
        for i in range(150):
            with pytest.raises(KeyboardInterrupt):
                signal.setitimer(signal.ITIMER_REAL, random.uniform(1e-3, 8e-3))
                while True:
                    for _ in executor.run(task, [{SHOULDER: 0.1}]):
                        assert handled == i, "a rollout came to an end after its interruption"
            assert handled == i + 1
            assert signal.getsignal(signal.SIGINT) is handler
    finally:
        gc.callbacks.extend(callbacks)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, alarm)
        signal.signal(signal.SIGINT, before)


def test_a_handler_that_does_not_raise_ends_nothing():
    pressed = []
    before = signal.signal(signal.SIGINT, lambda *_: pressed.append(1))
    try:
        result = RolloutRunner(RolloutTask(InterruptedScenario(how="plainly"), 0.5, Quality(abs, SHOULDER))).run({})
    finally:
        signal.signal(signal.SIGINT, before)
    assert pressed == [1]
    assert result.end == "horizon"


def test_an_ignored_ctrl_c_stays_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Interruptible():
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
