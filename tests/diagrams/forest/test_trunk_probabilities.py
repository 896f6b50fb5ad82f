"""The fit of the weights of trunks' evidence, and its judges: simulated forests, streets, and real plots."""

from __future__ import annotations

import numpy as np
import pytest

from tests.real import recordings
from vtbdrake_diagrams.forest.reality import CLOUDS, NOISE, Plot
from vtbdrake_diagrams.forest.studies.clouds import PARTIAL, Cloud, rings
from vtbdrake_diagrams.forest.studies.streets import FILES, POLE, TRUNK, StreetScan
from vtbdrake_diagrams.forest.studies.trunk_probabilities import (
    JUDGING_SEEDS,
    Sample,
    SimulatedScan,
    fitted,
    plot_samples,
    reliability_rows,
)

pytestmark = pytest.mark.one_python


def drawn(recording: str, weights: np.ndarray, *, count: int, judges: bool, seed: int) -> Sample:
    """Return detections that are trunks as often as these weights say."""
    rng = np.random.default_rng(seed)
    terms = np.column_stack([np.ones(count), rng.normal(size=(count, len(weights) - 1))])
    p = 1.0 / (1.0 + np.exp(-terms @ weights))
    no = np.zeros(count, dtype=bool)
    places = rng.uniform(0.0, 1000.0, (count, 2))
    return Sample(recording, terms, p, rng.random(count) < p, no, np.full(count, judges), places)


def test_weights_are_fitted_to_what_does_not_judge():
    weights = np.array([0.5, 1.0, -2.0])
    samples = [drawn(name, weights, count=4000, judges=False, seed=k) for k, name in enumerate("ab")]
    misleading = drawn("a", -weights, count=4000, judges=True, seed=7)
    np.testing.assert_allclose(fitted([*samples, misleading]), weights, atol=0.15)


def test_recordings_count_equally_in_the_fit():
    """One of two recordings has a tenth of the detections, and the other constant: the fit is in the middle."""
    samples = [
        drawn("many", np.array([1.0, 0.0]), count=20000, judges=False, seed=0),
        drawn("few", np.array([-1.0, 0.0]), count=2000, judges=False, seed=1),
    ]
    assert abs(fitted(samples)[0]) < 0.1


def test_reliability_is_the_share_of_trunks_among_detections_that_judge():
    weights = np.array([0.0, 2.0])
    rows = list(reliability_rows([drawn("a", weights, count=3000, judges=True, seed=2)]))
    assert [row[1] for row in rows if row[0] == "a"] == [
        "0 to 0.1",
        "0.1 to 0.3",
        "0.3 to 0.5",
        "0.5 to 0.7",
        "0.7 to 0.9",
        "0.9 to 1",
    ]
    for row in rows:
        low, high = (float(part.rstrip("%")) / 100.0 for part in row[6].split(" to "))
        assert low - 0.01 <= float(row[2]) <= high + 0.01
    assert sum(int(row[3]) for row in rows if row[0] == "a") == 3000
    assert not list(reliability_rows([drawn("a", weights, count=10, judges=False, seed=2)]))


def test_a_forest_that_judges_has_no_false_trunks():
    trees, detected, false = SimulatedScan.of(JUDGING_SEEDS[0]).counts()
    assert trees > 50 and detected > 0.8 * trees and false == 0


def test_stems_and_poles_of_a_street_are_known_by_their_labels(tmp_path):
    """Two trunks and a pole in the format of SemanticKITTI, and what another label hides."""
    z = np.linspace(-1.5, 1.5, 40)
    parts = {71: [(5.0, 1.0), (5.0, -3.0)], 80: [(8.0, 0.0)], 70: [(3.0, 3.0)]}
    places = [(label, place) for label, several in parts.items() for place in several]
    points = np.array([[*place, height, 0.0] for _, place in places for height in z], dtype=np.float32)
    labels = np.repeat([label | 5 << 16 for label, _ in places], len(z)).astype(np.uint32)
    for array, name in zip((points, labels), FILES["street 3"], strict=True):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        array.tofile(tmp_path / name)
    scan = StreetScan.read(tmp_path, "street 3")
    assert sorted(tuple(stem.mean(axis=0).round(3)) for stem in scan.stems()) == [(5.0, -3.0), (5.0, 1.0)]
    kinds = scan.kinds_of(np.array([place for _, place in places]), np.full(4, 0.2))
    assert kinds == [TRUNK, TRUNK, POLE, ""]


@pytest.mark.slow
def test_probabilities_hold_in_the_half_of_a_plot_that_was_not_fitted() -> None:
    pytest.importorskip("laspy")
    (path,) = recordings(CLOUDS["ponderosa, TLS"])
    cloud = Cloud.read(path)
    plot = Plot("ponderosa, TLS", cloud, rings(cloud), rings(cloud, arc=PARTIAL, fewest=8), NOISE)
    samples = list(plot_samples(plot))
    p, is_trunk, is_unclear, judges = (
        np.concatenate([getattr(sample, name) for sample in samples])
        for name in ("probabilities", "is_trunk", "is_unclear", "judges")
    )
    clear = judges & ~is_unclear
    for low, high, least, most in ((0.0, 0.5, 0.0, 0.5), (0.5, 0.9, 0.6, 1.0), (0.9, 1.0, 0.95, 1.0)):
        chosen = clear & (p >= low) & (p <= high)
        assert chosen.sum() > 30
        assert least <= is_trunk[chosen].mean() <= most
