"""Input ports carry what they were given last."""

from __future__ import annotations

import numpy as np
from pydrake.systems.primitives import Gain

from vtbdrake.testbed.signal import Feed, Signal


def test_what_depends_on_a_port_follows_every_new_value() -> None:
    doubled = Gain(2.0, 3)
    context = doubled.CreateDefaultContext()
    feed = Feed({"force": (Signal("force", size=3), doubled.get_input_port())}, context)
    for value in ([1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]):
        feed("force", np.array(value))
        assert doubled.get_output_port().Eval(context).tolist() == [2.0 * entry for entry in value]


def test_value_that_was_given_is_not_changed_by_the_next() -> None:
    doubled = Gain(2.0, 1)
    feed = Feed({"force": (Signal("force", size=1), doubled.get_input_port())}, doubled.CreateDefaultContext())
    first = np.array([1.0])
    feed("force", first)
    feed("force", np.array([2.0]))
    assert first.tolist() == [1.0]
