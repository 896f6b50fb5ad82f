"""Tests of row C2: the unit over LCM, and the displacement of a map that nothing shows."""

import numpy as np
import pytest

from vtbdrake_diagrams.forest.answers import over_lcm
from vtbdrake_diagrams.forest.drives import shared_displacement
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.forest.stand import MAPS, MapErrors, Stand


def test_unit_over_lcm_finds_the_simulated_pose() -> None:
    found = over_lcm(ForestScenario(seed=1, length=50.0, width=50.0, start=12.0), cycles=40)
    assert found.agrees
    # Points travel with 32 bits: the poses come by two ways.
    assert found.difference > 0.0


def test_displacement_is_that_of_maps() -> None:
    errors = MapErrors(position=0.7, correlation=40.0)
    means = []
    for seed in range(100):
        stand = Stand(seed=seed, density=100.0)
        # Without missing and wrong trees, the sums of all positions differ by those of the errors.
        means.append(stand.map(errors).positions()[:, :2].mean(axis=0) - stand.trees().positions()[:, :2].mean(axis=0))
    rms = np.sqrt((np.array(means) ** 2).sum(axis=1).mean())
    assert rms == pytest.approx(shared_displacement(errors), rel=0.2)
    assert shared_displacement(MAPS["accurate"]) == 0.0
