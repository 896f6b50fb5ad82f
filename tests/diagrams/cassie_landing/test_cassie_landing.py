"""The landing biped, as far as it goes without its model, which is not part of the project."""

from __future__ import annotations

import numpy as np
import pytest

from vtbdrake.testbed import ScenarioError
from vtbdrake_diagrams.cassie_landing import CassieLandingScenario
from vtbdrake_diagrams.cassie_landing.scenario import MOTORS, PERIOD, SAMPLES, TorquePlayer


def test_model_is_asked_for() -> None:
    with pytest.raises(ScenarioError, match=r"the path of cassie_v2\.urdf of the repository DAIRLab/dairlib, not ''"):
        CassieLandingScenario().build()


def test_recorded_torques_are_played_in_their_time() -> None:
    player = TorquePlayer()
    context = player.CreateDefaultContext()
    table = np.arange(SAMPLES * len(MOTORS), dtype=float)
    context.get_mutable_numeric_parameter(0).SetFromVector(table)
    for time, row in ((0.0, 0), (0.9 * PERIOD, 0), (PERIOD, 1), (7.0 * PERIOD, 7), (1.0, SAMPLES - 1)):
        context.SetTime(time)
        played = player.get_output_port().Eval(context)
        np.testing.assert_array_equal(played, table.reshape(SAMPLES, -1)[row])
