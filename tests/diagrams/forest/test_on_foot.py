"""The study of the unit on foot, and the one of trees and rocks: what is counted, and what is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vtbdrake.components.localization.landmarks import Landmarks, SensorView
from vtbdrake.components.localization.unit import SEARCHING, TRACKING
from vtbdrake_diagrams.forest.scenario import CARRIERS, LANDMARKS
from vtbdrake_diagrams.forest.studies import on_foot, trees_and_rocks
from vtbdrake_diagrams.forest.studies.drive import Drive, Track
from vtbdrake_diagrams.forest.studies.on_foot import MAP_NAMES, Way, carried, holds, judged, load, report, summary
from vtbdrake_diagrams.forest.studies.trees_and_rocks import both_no_worse, with_landmarks

pytestmark = pytest.mark.one_python

WAY = Way(
    variant="hand",
    map="accurate",
    rms=0.03,
    heading=0.001,
    reckoned=1.0,
    astray=0.05,
    nees=3.0,
    last_nees=3.0,
    poses=95,
    scans=100,
    losses=0,
    wrong=0,
    tilt=(0.003, 0.004),
)


def ways(variants: tuple[str, ...] = CARRIERS, **changes: object) -> dict[int, list[Way]]:
    """Return the results of four forests; ``changes`` are made to the last variant with the accurate map."""
    cases = [replace(WAY, variant=variant, map=name) for variant in variants for name in MAP_NAMES]
    cases = [
        replace(case, **changes) if (case.variant, case.map) == (variants[-1], "accurate") else case for case in cases
    ]
    return dict.fromkeys(range(4), cases)


def landmarks(*xs: float) -> Landmarks:
    n = len(xs)
    return Landmarks(np.column_stack([xs, np.zeros(n)]), np.tile(np.eye(2), (n, 1, 1)), np.ones(n), np.ones(n))


def test_errors_are_counted_beside_dead_reckoning() -> None:
    """A way along x of 3 m; steps are taken for a tenth too long, and the first scan has no pose."""
    truth = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    drive = Drive(np.arange(4.0), truth, truth * [1.1, 1.0, 1.0], (landmarks(),) * 4, np.full((4, 2), 0.01))
    poses = truth + np.array([0.0, 0.2, 0.0])
    poses[3, 1] = 2.0
    status = np.array([SEARCHING, TRACKING, TRACKING, TRACKING])
    way = judged(Track(drive, poses, np.tile(np.eye(3), (4, 1, 1)), status), "hand", "accurate")
    assert way.rms == pytest.approx(np.sqrt((0.04 + 0.04 + 4.0) / 3.0))
    # From the true pose of the second scan on: 0, 0.1 and 0.2 m.
    assert way.reckoned == pytest.approx(np.sqrt(0.05 / 3.0))
    assert way.astray == pytest.approx(0.1)
    assert (way.poses, way.scans, way.wrong) == (3, 4, 1)
    assert way.last_nees == pytest.approx(4.0)
    never = judged(Track(drive, poses, np.tile(np.eye(3), (4, 1, 1)), np.full(4, SEARCHING)), "hand", "accurate")
    assert never.rms is None and never.poses == 0


@pytest.mark.parametrize(
    "changes",
    [{"rms": 0.06}, {"poses": 89}, {"wrong": 1}, {"last_nees": 6.0}, {"reckoned": 0.02}],
    ids=lambda changes: next(iter(changes)),
)
def test_each_criterion_counts(changes: dict[str, object]) -> None:
    assert holds(ways())
    assert not holds(ways(**changes))
    assert "all met" in on_foot.in_words(ways())
    assert "NOT met" in on_foot.in_words(ways(**changes))


def test_machine_has_no_criterion() -> None:
    assert holds(ways(CARRIERS[::-1], rms=0.5, wrong=3))


def test_summary_weighs_forests_by_their_poses() -> None:
    cases = {0: [replace(WAY, rms=0.1, poses=10)], 1: [replace(WAY, rms=0.2, poses=30)]}
    each = summary(cases, "hand", "accurate")
    assert each.rms == pytest.approx(np.sqrt((10 * 0.01 + 30 * 0.04) / 40))
    assert each.localized == pytest.approx(0.2)


def test_workers_differ_in_their_steps_and_share_forest_and_route() -> None:
    seeds = range(300_000, 300_006)
    frequencies = [carried(seed, "hand").step_frequency for seed in seeds]
    assert min(frequencies) >= 1.7 and max(frequencies) <= 2.0 and np.ptp(frequencies) > 0.1
    for name in ("seed", "density", "route", "start", "stand_kind"):
        assert len({getattr(carried(300_000, carrier), name) for carrier in CARRIERS}) == 1


def test_views_of_kinds_are_joined() -> None:
    views = [SensorView(landmarks(1.0, 2.0)), SensorView(landmarks(5.0))]
    drive = Drive(np.zeros(1), np.zeros((1, 3)), np.zeros((1, 3)), (views,))
    expected = {"trees": [1.0, 2.0], "rocks": [5.0], "both": [1.0, 2.0, 5.0]}
    for variant, kinds in LANDMARKS.items():
        (view,) = with_landmarks(drive, ("tree", "rock"), kinds).landmarks[0]
        assert view.landmarks.positions[:, 0].tolist() == expected[variant]


def test_both_kinds_must_not_be_worse_than_trunks() -> None:
    assert both_no_worse(ways(tuple(LANDMARKS)), "accurate")
    assert not both_no_worse(ways(tuple(LANDMARKS), rms=0.04), "accurate")
    assert not both_no_worse(ways(tuple(LANDMARKS), poses=93), "accurate")


@pytest.mark.parametrize(
    ("module", "variants"), [(on_foot, CARRIERS), (trees_and_rocks, tuple(LANDMARKS))], ids=["on_foot", "rocks"]
)
def test_kept_results_are_complete(module: object, variants: tuple[str, ...]) -> None:
    kept = load(module.FILE)  # type: ignore[attr-defined]
    assert list(kept) == list(range(module.SEED, module.SEED + module.FORESTS))  # type: ignore[attr-defined]
    for cases in kept.values():
        assert [(case.variant, case.map) for case in cases] == [(v, name) for v in variants for name in MAP_NAMES]
    assert str(module.FORESTS) in report(kept, variants)  # type: ignore[attr-defined]
    assert "RMS" in module.in_words(kept)  # type: ignore[attr-defined]
