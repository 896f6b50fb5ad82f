"""Digests: equal in equal states, and in no others."""

from __future__ import annotations

import numpy as np
import pytest

from tests.control.scripted import ServoScenario
from tests.control.slow import SlowScenario
from vtbdrake.recording.recorder import StateDigest
from vtbdrake.testbed import DpsAlone


def test_the_dps_has_the_same_digest_alone_and_in_its_testbed() -> None:
    scenario = ServoScenario()
    testbed, alone = scenario.build(), DpsAlone(scenario)
    there, here = testbed.default_context(), alone.default_context()
    assert StateDigest(testbed, there)() == StateDigest(alone, here)()
    testbed.write(there, {"sim.sys.axes.discrete_state_0": [1.0, 2.0]})
    assert StateDigest(testbed, there)() == StateDigest(alone, here)(), "the world is not the DPS's state"


@pytest.mark.parametrize("address", ["dps.gain", "dps.seen[1]", "dps.ticks", "dps.velocity[0]"])
def test_any_other_bit_gives_another_digest(address: str) -> None:
    alone = DpsAlone(ServoScenario())
    context = alone.default_context()
    digest = StateDigest(alone, context)
    before = digest()
    value = alone.read(context, address)
    alone.write(context, {address: np.nextafter(value, 1e3)})
    assert digest() != before
    alone.write(context, {address: value})
    assert digest() == before


def test_abstract_state_counts() -> None:
    first, other = (DpsAlone(SlowScenario(more={"memory": np.array([0.3, x])})) for x in (0.6, 0.7))
    digests = [StateDigest(target, target.default_context())() for target in (first, other)]
    assert digests[0] != digests[1]
