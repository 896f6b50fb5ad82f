"""Signals that come in steps that belong together are handled after them."""

from __future__ import annotations

import signal

import pytest

from vtbdrake.drake_workarounds.lost_interrupts import Interruptible


def test_signal_waits_for_the_end_of_steps_that_belong_together() -> None:
    steps = []
    with pytest.raises(KeyboardInterrupt), Interruptible() as interruptible:
        with interruptible.uninterrupted:
            steps.append("without a signal")
        with interruptible.uninterrupted:
            signal.raise_signal(signal.SIGINT)
            steps.append("after a signal")
            with interruptible.uninterrupted:
                signal.raise_signal(signal.SIGINT)
            steps.append("after an inner block")
        steps.append("never")
    assert steps == ["without a signal", "after a signal", "after an inner block"]
