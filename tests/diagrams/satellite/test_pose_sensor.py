"""The reader of the pose sensor: when it shows an estimate, and of what."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from vtbdrake_diagrams.satellite.estimation import HISTORY
from vtbdrake_diagrams.satellite.pose_sensor import PoseReader

PERIOD, LATENCY = 0.02, 0.04
V_IB = np.array([0.5, 0.0, -0.25])


def _history(now: float) -> np.ndarray:
    """Return the past of a base that does not turn and drifts with ``V_IB``."""
    times = now - PERIOD * np.arange(HISTORY)
    return np.array([[time, 1.0, 0.0, 0.0, 0.0, *(time * V_IB)] for time in times]).ravel()


@pytest.mark.parametrize("first", [3, 8])
def test_each_pose_is_shown_once_from_where_the_base_was(first: int) -> None:
    reader = PoseReader(period=PERIOD, latency=LATENCY)
    simulator = Simulator(reader)
    context = simulator.get_context()
    shown = {}
    for k in range(16):
        # A pose of the time before the start does not count: the first one that does comes at 3 PERIOD.
        pose = np.array([1.0, 0.0, 0.0, 0.0, *(np.ones(3) if k < 12 else np.full(3, 2.0))])
        reader.GetInputPort("target_pose").FixValue(context, pose if k >= first else np.zeros(7))
        reader.GetInputPort("history").FixValue(context, _history((k - 1) * PERIOD))
        estimate = reader.get_output_port().Eval(context)
        if estimate.valid:
            shown[k] = estimate
        simulator.AdvanceTo((k + 0.5) * PERIOD)
    assert list(shown) == [first + 1, 13]
    for k, place in ((first + 1, 1.0), (13, 2.0)):
        measured = (k - 2) * PERIOD - LATENCY
        assert shown[k].time == pytest.approx(measured, abs=1e-12)
        np.testing.assert_allclose(shown[k].X.translation(), place + measured * V_IB, atol=1e-12)
