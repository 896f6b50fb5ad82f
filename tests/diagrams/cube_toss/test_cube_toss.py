"""The tossed cube: it falls and rests with every contact model, and real tosses tell its friction."""

from __future__ import annotations

import numpy as np
import pytest

from tests.real import recordings
from vtbdrake_diagrams.cube_toss import CubeTossScenario, reality


@pytest.mark.slow_cases
@pytest.mark.parametrize("name", reality.contact_models())
def test_cube_falls_freely_and_comes_to_rest(name: str) -> None:
    scenario, restitution = reality.contact_models()[name]
    assert hasattr(scenario, restitution.address.removeprefix("scenario."))
    testbed = scenario.with_fields({"dissipation": 5.0}).build()  # It hardly bounces.
    context = testbed.default_context()
    # 5 mm fall take 32 ms.
    testbed.write(context, {reality.POSITION: [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5 * scenario.edge + 0.005]})
    simulator = testbed.simulator(context)
    simulator.AdvanceTo(0.025)
    fallen = 0.5 * scenario.edge + 0.005 - testbed.read(context, reality.POSITION)[6]
    assert fallen == pytest.approx(0.5 * 9.81 * 0.025**2, rel=0.05)
    simulator.AdvanceTo(0.5)
    assert testbed.read(context, reality.POSITION)[6] == pytest.approx(0.5 * scenario.edge, abs=2e-4)
    assert np.linalg.norm(testbed.read(context, reality.VELOCITY)) < 0.01


@pytest.mark.slow_cases
@pytest.mark.parametrize("stride", [46, 23])
def test_real_tosses_tell_friction(stride: int) -> None:
    tosses = reality.recordings(recordings("contactnets_cube/0.pt")[0].parent)[::stride]
    right, wrong = (reality.errors(tosses, CubeTossScenario(friction=mu), executor="serial") for mu in (0.18, 0.10))
    position, rotation, seconds = np.median(right, axis=0)
    assert position < 20.0 and rotation < 30.0 and 0.1 < seconds < 0.8
    assert np.median(wrong[:, 0]) > 2.0 * position


def test_windows_start_as_measured_and_within_the_scatter() -> None:
    toss = reality.recordings(recordings("contactnets_cube/0.pt")[0].parent)[3]
    window = reality.window(toss, starts=3, samples=40)
    first, *perturbed = window.starts
    np.testing.assert_allclose(first[reality.POSITION], toss.sense[reality.STATE].values[0, :7])
    assert len(window.times) == 40 and len(perturbed) == 2
    for start in perturbed:
        assert np.linalg.norm(start[reality.POSITION][:4]) == pytest.approx(1.0)
        away = np.linalg.norm(start[reality.POSITION] - first[reality.POSITION])
        assert 1e-5 < away < 1e-2


def test_free_flight_of_a_real_toss_is_that_of_the_testbed() -> None:
    # Without friction, contact or air: the first 60 ms, before the first impact, to 2 mm and 3 deg.
    toss = reality.recordings(recordings("contactnets_cube/0.pt")[0].parent)[0]
    window = reality.window(toss, samples=9)
    testbed = CubeTossScenario().build()
    context = testbed.default_context()
    testbed.write(context, window.starts[0])
    testbed.simulator(context).AdvanceTo(window.times[-1])
    simulated = testbed.read(context, reality.POSITION)[np.newaxis]
    measured = window.record[reality.POSITION][-1:]
    assert reality.position_errors(measured, simulated)[0] < 2e-3
    assert np.degrees(reality.rotation_errors(measured, simulated)[0]) < 3.0
